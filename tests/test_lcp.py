# SPDX-License-Identifier: Apache-2.0
"""Lemke's method on LCPs: recorded ones, classical ones, random ones. The residual is recomputed here, with numpy."""

import numpy as np
import pytest
from conftest import DEVICE, paper_box, simulator

import warp_lcp as wl


def minmap(M, q, z):
    """max |min(z, M z + q)| of each problem."""
    return np.abs(np.minimum(z, np.einsum("bij,bj->bi", M, z) + q)).max(axis=1)


def solve(M, q, **options):
    solution = wl.solve_lcp(M, q, device=DEVICE, **options)
    return solution.z.numpy(), solution


def test_random_positive_definite_problems():
    """A P-matrix has exactly one solution, so Lemke's must be that; unsymmetric M, 1e-10 is 1e4 round-offs."""
    rng = np.random.default_rng(0)
    for n in (1, 2, 5, 20, 60):
        A = rng.normal(size=(20, n, n))
        S = rng.normal(size=(20, n, n))
        M = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(n) + S - S.transpose(0, 2, 1)
        known = np.maximum(rng.normal(size=(20, n)), 0)
        slack = np.where(known > 0, 0, rng.uniform(0, 1, size=(20, n)))
        q = slack - np.einsum("bij,bj->bi", M, known)
        z, solution = solve(M, q)
        assert (solution.status.numpy() == 0).all()
        assert z == pytest.approx(known, abs=1e-10)
        assert minmap(M, q, z) == pytest.approx(solution.residual.numpy(), abs=1e-12)


def test_degenerate_and_trivial_problems():
    z, solution = solve(np.eye(3)[None], np.array([[1.0, 0.0, 2.0]]))
    assert (z == 0).all()
    assert solution.iterations.numpy()[0] == 0
    ones = np.ones((1, 4, 4))  # rank 1: many solutions, all with sum z = 1
    z, solution = solve(ones, -np.ones((1, 4)))
    assert solution.status.numpy()[0] == 0
    assert z.sum() == pytest.approx(1.0)


def test_a_problem_without_solution_ends_on_a_ray_and_says_so():
    """w = -z - 1 has no solution."""
    _, solution = solve(-np.eye(2)[None], -np.ones((1, 2)))
    assert solution.status.numpy()[0] & wl.Status.RAY
    assert solution.status.numpy()[0] & wl.Status.UNCERTIFIED


def test_murtys_exponential_example():
    """M lower triangular with twos below the diagonal and q = -(powers of two sums): 2^n - 1 pivots, then solved."""
    n = 6
    M = np.tril(np.full((n, n), 2.0), -1) + np.eye(n)
    q = -np.array([sum(2.0 ** (n - k) for k in range(i + 1)) for i in range(n)])
    z, solution = solve(M.T[None], q[None])
    assert solution.status.numpy()[0] == 0
    assert minmap(M.T[None], q[None], z).max() < 1e-12


def test_recorded_problems(shared):
    """Every problem whose stored solution is good to 1e-8 is solved to 1e-8, except where eq. 43 was left unfloored.

    There (PROPhyb, entries up to 1e12, which the simulator never makes) at least 70 of 75, and the others are marked.
    """
    for path in sorted((shared / "problems" / "lcp").glob("*.npz")):
        data = np.load(path)
        z, solution = solve(data["M"], data["q"])
        good = minmap(data["M"], data["q"], z) < 1e-8
        assert (good == (solution.status.numpy() == 0)).all(), path.name
        solvable = data["res"] < 1e-8
        if "PROPhyb" in path.name:
            assert np.count_nonzero(good) >= 70
        else:
            assert good[solvable].all(), path.name


def test_single_precision_never_claims_what_it_has_not(shared):
    """float32 fails on many of the box's stiff LCPs; every answer is marked or within the tolerance it was given."""
    for path in sorted((shared / "problems" / "lcp").glob("box*.npz")):
        data = np.load(path)
        z, solution = solve(data["M"].astype(np.float32), data["q"].astype(np.float32), tolerance=1e-3)
        claimed = solution.status.numpy() == 0
        assert (minmap(data["M"], data["q"], z.astype(float))[claimed] < 2e-3).all()


@pytest.mark.parametrize("k", [2, 3])
@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_the_assembled_lcp_is_that_of_the_paper(k, speed):
    """Lead matrix and vector against eq. 39 written out and eliminated with numpy; full rank, and not without rho.

    1e-9 of the largest entry: A has condition 1e3 to 1e5 at 1 ms.
    """
    sim = simulator(paper_box((0.0, speed, 0.0), speed), directions=k, method="lemke", rho_scale=0.7)
    sim.step()
    rows, r = sim.rows, int(sim.contacts.count.numpy()[0])
    frame, point, eps, free = (getattr(rows, name).numpy()[0, :r] for name in ("frame", "point", "relaxation", "free"))
    mu, directions = rows.mu.numpy()[0, :r], rows.directions.numpy()[0, :r]
    assert (directions == (2 if speed else k)).all()
    arm = point - sim.bodies.com.numpy()[0, 0]
    J = np.concatenate([frame, np.cross(arm[:, None], frame)], axis=2)  # [r, 3, 6]
    J_n, J_t = J[:, 0], J[:, 1:].reshape(2 * r, 6)
    m = directions[0]
    E_i = np.array([[np.cos(j * np.pi / m) for j in range(m)], [np.sin(j * np.pi / m) for j in range(m)]])
    E = np.kron(np.eye(r), E_i)
    inverse_mass = np.diag([1, 1, 1, 6, 6, 6])
    rho = 0.7 * np.diag(np.diag(E.T @ np.linalg.solve(J_t @ inverse_mass @ J_t.T + np.diag(eps[:, 1:].ravel()), E)))

    def lead(rho):
        """Unknowns (v - v_free, p_t | p_n, w_up, w_lo): the first two have equations and are eliminated."""
        top = np.block([[np.linalg.inv(inverse_mass), -J_t.T], [J_t, np.diag(eps[:, 1:].ravel())]])
        right = np.block([[-J_n.T, np.zeros((6, 2 * m * r))], [np.zeros((2 * r, r)), -E, E]])
        left = np.block([[J_n, np.zeros((r, 2 * r))], [np.zeros((m * r, 6)), E.T], [np.zeros((m * r, 6)), -E.T]])
        friction = np.kron(np.diag(mu[:, 0]), np.ones((m, 1)))
        o = np.zeros((m * r, m * r))
        corner = np.block([[np.diag(eps[:, 0]), np.zeros((r, 2 * m * r))], [friction, o, rho], [friction, rho, o]])
        known = np.r_[np.zeros(6), free[:, 1:].ravel()]
        return corner - left @ np.linalg.solve(top, right), np.r_[free[:, 0], np.zeros(2 * m * r)] - left @ np.linalg.solve(top, known)

    # The library goes contact by contact: p_n, w_up, w_lo.
    order = np.concatenate([np.r_[i, r + m * i + np.arange(m), r + m * r + m * i + np.arange(m)] for i in range(r)])
    M, q = lead(rho)
    n = r * (1 + 2 * m)
    found = sim._methods[0].lcp.M.numpy()[0, :n, :n]
    assert found == pytest.approx(M[np.ix_(order, order)], abs=1e-9 * np.abs(M).max())
    assert sim._methods[0].lcp.q.numpy()[0, :n] == pytest.approx(q[order], abs=1e-9 * np.abs(q).max() + 1e-12)

    def rank(matrix):
        scale = 1 / np.sqrt(np.abs(np.diag(matrix)))
        return np.linalg.matrix_rank(scale[:, None] * matrix * scale, tol=1e-9)

    assert rank(found) == n
    assert rank(lead(0 * rho)[0][np.ix_(order, order)]) <= n - m * r  # the paper's point: each direction counted twice


@pytest.mark.parametrize(("k", "share"), [(2, 1.0), (3, 1.0), (4, 0.99), (8, 0.99)])
def test_facets_of_the_simulator(k, share):
    """Fixed facets on 64 boxes thrown a little differently, h = 10 ms, Lemke without fallback.

    k = 2 and 3: every step is certified. From k = 4 on the directions depend on each other so much that round-off leads
    Lemke's method to a ray now and then (0.5 % at most here); those steps are marked and leave a bounded motion.
    """
    sim = simulator(paper_box(), 64, 1e-2, sliding="facets", directions=k, method="lemke")
    v = sim.v.numpy().copy()
    v[:, [0, 1, 5]] += np.random.default_rng(0).normal(size=(64, 3)) * 0.01
    sim.v.assign(v)
    certified = 0
    for _ in range(80):
        sim.step()
        ok = sim.status.numpy() == 0
        assert ((sim.residual.numpy() <= 1e-6) == ok).all()
        certified += np.count_nonzero(ok)
    assert certified >= share * 64 * 80
    assert np.abs(sim.v.numpy()).max() < 10


@pytest.mark.parametrize(
    ("M", "q", "message"),
    [
        (np.eye(3), np.zeros(2), "give .B, n, n. and .B, n."),
        (np.full((2, 2), np.nan), np.zeros(2), "must be finite"),
    ],
)
def test_bad_input(M, q, message):
    with pytest.raises(wl.WarpLcpError, match=message):
        wl.solve_lcp(M, q)
    with pytest.raises(wl.WarpLcpError, match="choose lemke"):
        wl.solve_lcp(np.eye(2), np.ones(2), method="magic")
