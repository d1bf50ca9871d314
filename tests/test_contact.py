# SPDX-License-Identifier: Apache-2.0
"""solve_contact: closed forms, an independent residual, real recorded problems, facets against Lemke's method on their LCP."""

from pathlib import Path

import numpy as np
import pytest

import warp_lcp as wl

RECORDED = sorted((Path(__file__).parents[2] / "shared/problems/friction").glob("*.npz"))


def natural_map(W, q, mu, p):
    """|p - P_K(p - u^)| / |q|, written anew."""
    u = (W @ p + q).reshape(-1, 3)
    u[:, 0] += mu * np.linalg.norm(u[:, 1:], axis=1)
    x = p.reshape(-1, 3) - u
    normal, size = x[:, 0], np.linalg.norm(x[:, 1:], axis=1)
    projected = np.where(((size <= mu * normal) & (normal >= 0.0))[:, None], x, 0.0)
    on_cone = (size > mu * normal) & (mu * size > -normal)
    a = (normal + mu * size)[on_cone] / (1.0 + mu[on_cone] ** 2)
    projected[on_cone] = np.column_stack([a, (mu[on_cone] * a / size[on_cone])[:, None] * x[on_cone, 1:]])
    return np.linalg.norm(p - projected.ravel()) / np.linalg.norm(q)


def polygon_error(W, q, mu, p, k, within):
    """Largest violation [m/s] of facet friction with k directions: p_t in the polygon, slip in the normal cone there, u_n compl. p_n."""
    angles = np.arange(2 * k) * np.pi / k
    e = np.column_stack([np.cos(angles), np.sin(angles)])
    u, worst = (W @ p + q).reshape(-1, 3), 0.0
    diagonal = np.diag(W).reshape(-1, 3)
    for i, (v, r) in enumerate(zip(u, p.reshape(-1, 3), strict=True)):
        mass = 2.0 / (diagonal[i, 1] + diagonal[i, 2])
        corners = (
            e if within else np.column_stack([np.cos(angles + np.pi / (2 * k)), np.sin(angles + np.pi / (2 * k))]) / np.cos(np.pi / (2 * k))
        )
        normals = (
            e
            if not within
            else np.column_stack([np.cos(angles + np.pi / (2 * k)), np.sin(angles + np.pi / (2 * k))]) / np.cos(np.pi / (2 * k))
        )
        limit = mu[i] * max(r[0], 0.0)
        worst = max(worst, abs(min(v[0], r[0] * diagonal[i, 0])), (normals @ r[1:] - limit).max() / mass)
        # Maximal dissipation over the corners: -u_t . p_t >= -u_t . corner; divided by the limit it is a velocity.
        if limit > 0.0:
            worst = max(worst, (-corners @ v[1:] - -(v[1:] @ r[1:]) / limit).max())
    return worst


def load(path):
    z = np.load(path)
    n = int(z["n"])
    W = np.zeros((n, n))
    rows = np.repeat(np.arange(n), np.diff(z["W_indptr"]))
    np.add.at(W, (rows, z["W_indices"]), z["W_data"])
    return W, z["q"].astype(float), np.broadcast_to(z["mu"].astype(float), (n // 3,)).copy()


def ok(solution):
    return (solution.status.numpy() == 0).all()


@pytest.fixture(scope="module")
def heap():
    """Random problem like a heap's: 12 contacts between 3 bodies with mass ratio 100 and the ground, redundant (rank 18 of 36)."""
    rng = np.random.default_rng(3)
    J = np.zeros((36, 18))
    for i in range(12):
        normal = rng.normal(size=3)
        tangent = np.cross(normal, rng.normal(size=3))
        frame = np.array([normal / np.linalg.norm(normal), tangent / np.linalg.norm(tangent), np.zeros(3)])
        frame[2] = np.cross(frame[0], frame[1])
        for body, sign in ((i % 3, 1.0), ((i + 1) % 4, -1.0)):
            if body < 3:
                r = rng.normal(size=3)
                skew = np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])
                J[3 * i : 3 * i + 3, 6 * body : 6 * body + 6] += sign * frame @ np.hstack([np.eye(3), -skew])
    inverse = np.repeat([1.0, 0.1, 0.01], 6)
    return J @ (inverse[:, None] * J.T), J @ rng.normal(size=18), rng.uniform(0.2, 1.0, 12)


def test_one_contact_in_closed_form():
    """W = E / m: it sticks where |q_t| <= mu |q_n|, else it slides on with |q_t| - mu |q_n| along q_t; it lifts off where q_n > 0."""
    W = np.tile(np.eye(3) / 2.0, (3, 1, 1))
    q = np.array([[-1.0, 0.3, 0.2], [-1.0, 3.0, 4.0], [0.5, 3.0, 4.0]])
    s = wl.solve_contact(W, q, 0.5, device="cpu")
    expected = [[0, 0, 0], [0, 3.0 * (1 - 0.5 / 5), 4.0 * (1 - 0.5 / 5)], [0.5, 3.0, 4.0]]
    np.testing.assert_allclose(s.velocity.numpy(), expected, atol=1e-12)  # round-off of numbers of order 1
    np.testing.assert_allclose(s.impulse.numpy(), (np.array(expected) - q) * 2.0, atol=1e-12)
    assert ok(s)


@pytest.mark.parametrize("mu", [0.0, 1e-3, 0.3, 1.0, 3.0, 10.0])
def test_residual_is_the_one_of_the_literature(heap, mu):
    W, q, _ = heap
    s = wl.solve_contact(W, q, mu, device="cpu")
    error = natural_map(W, q, np.full(12, mu), s.impulse.numpy()[0])
    assert ok(s)
    assert error < 1e-10
    assert s.natural_map.numpy()[0] == pytest.approx(error, rel=1e-3, abs=1e-14)


def test_open_contact_without_friction_is_no_violation():
    """The cone of mu = 0 is a half-line: nothing but its tip is near -u where u_n > 0 and u_t = 0."""
    s = wl.solve_contact(np.eye(3), [1.0, 0.0, 0.0], 0.0, device="cpu")
    assert ok(s)
    assert s.natural_map.numpy()[0] == 0.0


@pytest.mark.parametrize("formulation", ["phantom_inertia", "anitescu_potra"])
@pytest.mark.parametrize("k", [2, 3, 4, 8, 16])
def test_facets_obey_their_law(heap, formulation, k):
    W, q, mu = heap
    s = wl.solve_contact(W, q, mu, formulation, directions=k, device="cpu")
    assert ok(s)
    # Round-off of a velocity over an impulse of 1e-2 or more.
    assert polygon_error(W, q, mu, s.impulse.numpy()[0], k, formulation == "anitescu_potra") < 1e-9
    cone = wl.solve_contact(W, q, mu, device="cpu")
    assert s.natural_map.numpy()[0] > 1e3 * cone.natural_map.numpy()[0]  # an error of the law, not of the solution


@pytest.mark.parametrize("k", [2, 4])
def test_anitescu_potra_is_their_lcp(k):
    """One body on four corners: velocities equal those of Lemke's method on the LCP of the paper's ref. 6."""
    corners = np.array([[x, y, -0.5] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    J = np.vstack([np.hstack([np.eye(3), -np.cross(np.eye(3), r)])[[2, 0, 1]] for r in corners])
    W = J @ np.diag([1, 1, 1, 6, 6, 6.0]) @ J.T + np.kron(np.eye(4), np.diag([1e-3, 0, 0]))
    q, mu, n = J @ np.array([0.3, 1.0, -0.1, 0.0, 0.0, 2.0]), np.full(4, 0.4), 4
    angles = np.arange(2 * k) * np.pi / k
    normal, tangents = np.zeros((12, n)), np.zeros((12, 2 * k * n))
    for i in range(n):
        normal[3 * i, i] = 1.0
        tangents[3 * i + 1 : 3 * i + 3, 2 * k * i : 2 * k * (i + 1)] = [np.cos(angles), np.sin(angles)]
    G, ones = np.hstack([normal, tangents]), np.kron(np.eye(n), np.ones((2 * k, 1)))
    M = np.zeros((G.shape[1] + n, G.shape[1] + n))
    M[:-n, :-n] = G.T @ W @ G
    M[n:-n, -n:], M[-n:, n:-n], M[-n:, :n] = ones, -ones.T, np.diag(mu)
    lemke = wl.solve_lcp(M, np.concatenate([G.T @ q, np.zeros(n)]), device="cpu")
    assert ok(lemke)
    s = wl.solve_contact(W, q, mu, "anitescu_potra", directions=k, device="cpu")
    assert ok(s)
    expected = W @ G @ lemke.z.numpy()[0, :-n] + q
    np.testing.assert_allclose(s.velocity.numpy()[0], expected, atol=1e-8)  # the tolerance of solve_lcp


def test_batch_equals_one_by_one(heap):
    W, q, mu = heap
    rng = np.random.default_rng(0)
    many = q + 0.1 * rng.normal(size=(7, 36))
    together = wl.solve_contact(np.tile(W, (7, 1, 1)), many, mu, device="cpu")
    for i in range(7):
        np.testing.assert_array_equal(together.impulse.numpy()[i], wl.solve_contact(W, many[i], mu, device="cpu").impulse.numpy()[0])


def test_asymmetry_is_reported_and_solved_as_given(heap):
    W, q, mu = heap
    uneven = W * (1.0 + 1e-3 * np.sin(np.arange(36 * 36)).reshape(36, 36))
    s = wl.solve_contact(uneven, q, mu, device="cpu")
    assert ok(s)
    assert natural_map(uneven, q, mu, s.impulse.numpy()[0]) < 1e-10
    assert s.asymmetry.numpy()[0] == pytest.approx(np.abs(uneven - uneven.T).max() / np.abs(uneven).max())


@pytest.mark.parametrize(("row", "column"), [(0, 1), (1, 0), (0, 39), (39, 0), (33, 31)])
def test_a_block_whose_mirror_is_zero_couples(row, column):
    """40 contacts, two of them coupled one way only, in one word of the graph's bits or two."""
    W, q = 2.0 * np.eye(120), np.tile([-1.0, 0.4, 0.3], 40)
    W[3 * row : 3 * row + 3, 3 * column : 3 * column + 3] = [[0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5]]
    s = wl.solve_contact(W, q, 0.1, device="cpu")
    p = s.impulse.numpy()[0]
    assert ok(s)
    assert natural_map(W, q, np.full(40, 0.1), p) < 1e-10
    np.testing.assert_allclose(s.velocity.numpy()[0], W @ p + q, atol=1e-14)  # round-off of numbers of order 1
    assert p[3 * row] == pytest.approx(0.375)  # (1 - 0.5 * 0.5) / 2


@pytest.mark.parametrize("ratio", [1e3, 1e6])
def test_mass_ratio(ratio):
    """A heavy cube on a light one on the ground, four points each: no impulse of a solver may be left between them."""
    corners = np.array([[x, y] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    J = np.zeros((24, 12))
    for i, (x, y) in enumerate(corners):
        for row, body, sign, z in ((i, 0, 1.0, -0.5), (4 + i, 1, 1.0, -0.5), (4 + i, 0, -1.0, 0.5)):
            skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            J[3 * row : 3 * row + 3, 6 * body : 6 * body + 6] = (sign * np.hstack([np.eye(3), -skew]))[[2, 0, 1]]
    inverse = np.concatenate([[1, 1, 1, 6, 6, 6], np.array([1, 1, 1, 6, 6, 6]) / ratio])
    W, q = J @ (inverse[:, None] * J.T), J @ np.tile([0.0, 0, -0.05, 0, 0, 0], 2)
    s = wl.solve_contact(W, q, 0.5, device="cpu")
    assert ok(s)
    np.testing.assert_allclose(s.velocity.numpy(), 0.0, atol=1e-10)


def test_a_problem_without_solution_is_marked():
    """W = 0 and q_n < 0: no impulse helps."""
    s = wl.solve_contact(np.zeros((3, 3)), [-1.0, 0.0, 0.0], 0.5, device="cpu")
    assert s.status.numpy()[0] & wl.Status.UNCERTIFIED
    assert s.residual.numpy()[0] == pytest.approx(1.0)


def test_pgs_says_where_it_stops(heap):
    W, q, mu = heap
    s = wl.solve_contact(W, q, mu, method="pgs", tolerance=1e-8, device="cpu")
    size = np.abs(q).max()
    assert bool(s.status.numpy()[0] == 0) == bool(s.residual.numpy()[0] <= 1e-8 * size)


def test_float32_answers_are_as_good_as_it_says(heap):
    W, q, mu = (x.astype(np.float32) for x in heap)
    s = wl.solve_contact(W, q, mu, device="cpu")
    assert ok(s)
    assert natural_map(*heap, s.impulse.numpy()[0].astype(float)) < 1e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.eye(3), np.zeros(6), 0.5), "W has shape .* give"),
        ((np.eye(4), np.zeros(4), 0.5), "give \\[B, 3r, 3r\\]"),
        ((np.eye(3), np.zeros(3), [0.5, 0.5]), "mu has shape"),
        ((np.eye(3), np.zeros(3), -0.5), "mu is -0.5; it must not be negative"),
        ((np.diag([1, np.nan, 1]), np.zeros(3), 0.5), "W\\[1, 1\\] is nan; it must be finite"),
        ((np.broadcast_to(0.0, (2, 16386, 16386)), np.zeros((2, 16386)), 0.5), "W has 16386 rows, .* no more than 16383; solve"),
        ((np.eye(3), np.zeros(3), 0.5, "box"), "formulation is 'box'; choose one of coulomb"),
        ((np.eye(3), np.zeros(3), 0.5, "coulomb", "lemke"), "method is 'lemke'; choose one of auto"),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(wl.WarpLcpError, match=message):
        wl.solve_contact(*arguments, device="cpu")


@pytest.mark.skipif(not RECORDED, reason="the recorded problems are not beside this repository")
@pytest.mark.parametrize("path", RECORDED, ids=lambda p: p.stem)
def test_recorded_problems(path):
    """Exact cone on all of them with the default settings: relative natural map under 1e-10 (Siconos' best solver: 21 of 22)."""
    W, q, mu = load(path)
    s = wl.solve_contact(W, q, mu, device="cpu")
    assert ok(s)
    assert natural_map(W, q, mu, s.impulse.numpy()[0]) < 1e-10


@pytest.mark.skipif(not RECORDED, reason="the recorded problems are not beside this repository")
@pytest.mark.parametrize("formulation", ["phantom_inertia", "anitescu_potra"])
@pytest.mark.parametrize("k", [4, 16])
def test_recorded_problems_with_facets(formulation, k):
    for path in RECORDED:
        s = wl.solve_contact(*load(path), formulation, directions=k, device="cpu")
        assert ok(s), path.stem


def test_what_is_not_a_number_is_never_solved(monkeypatch, heap):
    """On a GPU arrays are not read back, so the kernel itself has to say so: here without the check of the host."""
    import warp_lcp.friction_problem as module

    W, q, mu = heap
    monkeypatch.setattr(module, "check_finite", lambda *_: None)
    wrong_q, wrong_mu = q.copy(), mu.copy()
    wrong_q[4], wrong_mu[3] = np.nan, np.nan
    for problem in ((W, wrong_q, mu), (W, q, wrong_mu)):
        s = wl.solve_contact(*problem, device="cpu")
        assert s.status.numpy()[0] & wl.Status.NOT_A_NUMBER
    assert ok(wl.solve_contact(W, q, mu, device="cpu"))  # the workspace is kept: nothing of it is left


@pytest.mark.parametrize("tolerance", [-1.0, 0.0, np.nan])
def test_tolerance_is_checked(tolerance):
    with pytest.raises(wl.WarpLcpError, match=r"tolerance is .*; it must be finite and greater than zero"):
        wl.solve_contact(np.eye(3), np.zeros(3), 0.5, tolerance=tolerance, device="cpu")


@pytest.mark.parametrize("seed", [22, 85, 172])
def test_friction_let_in_by_degrees(seed):
    """Hard problems (mu from 1 to 10, redundant) that Newton's method on all the friction at once does not solve."""
    from benchmarks.friction.stress import generate

    W, q, mu, _ = generate(seed)
    s = wl.solve_contact(W, q, mu, device="cpu")
    assert ok(s)
    assert natural_map(W, q, mu, s.impulse.numpy()[0]) < 1e-8  # the round-off of W p at these mass ratios
