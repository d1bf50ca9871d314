# SPDX-License-Identifier: Apache-2.0
"""Lead matrices of three contact laws for one movable body, put together with numpy from a simulator's contact rows.

Nothing of kernels/lcp.py is used: W = J M^-1 J^T + epsilon comes from points, frames and masses, and every matrix from W as the
papers write it. Each problem also knows how its unknowns make impulses, so that an answer of any algorithm is judged by the law
itself, in m/s, whatever the units of its unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import warp_lcp as wl

#: Singular values under this part of the largest count as zero.
RANK_TOLERANCE = 1e-10
#: Largest residual [m/s] of an answer that counts as solved, as in the simulator.
SOLVED = 1e-6


@dataclass(frozen=True)
class Rows:
    """The contact problem of one step,  u = W p + b,  three rows (n, t1, t2) a contact."""

    W: np.ndarray
    b: np.ndarray
    mu: np.ndarray  # [r, 2]
    bound: np.ndarray  # [r, 2]
    directions: np.ndarray  # [r] of kernels/friction.py
    response: np.ndarray  # [6, 3 r] M^-1 J^T: v+ = v_free + response p
    free_velocity: np.ndarray  # [6]
    applied: np.ndarray  # [3 r] the impulses that the simulator applied

    @property
    def normal(self) -> np.ndarray:
        """Indices of the normal rows."""
        return np.arange(0, len(self.b), 3)

    @property
    def tangent(self) -> np.ndarray:
        """Indices of the tangential rows, contact by contact."""
        return np.setdiff1d(np.arange(len(self.b)), self.normal)


def rows(sim: wl.Simulator) -> Rows | None:
    """Rows of the last step of environment 0, whose only movable body is body 0; None where there was no contact."""
    r = int(sim.rows.count.numpy()[0])
    if r == 0:
        return None
    names = ("frame", "point", "relaxation", "free", "mu", "bound", "directions", "body", "impulse")
    # Copies: on the CPU numpy looks at the simulator's own memory, which the next step overwrites.
    frame, point, relaxation, free, mu, bound, directions, body, impulse = (getattr(sim.rows, n).numpy()[0, :r].copy() for n in names)
    # com, inv_inertia and free_velocity are written before the step moves the body: they belong to its start, as the points do.
    arm = point - sim.bodies.com.numpy()[0, 0]
    sign = np.where(body[:, 1] == 0, 1.0, -1.0)[:, None, None]
    J = (sign * np.concatenate([frame, np.cross(arm[:, None], frame)], axis=2)).reshape(3 * r, 6)
    inverse_mass = np.zeros((6, 6))
    inverse_mass[:3, :3], inverse_mass[3:, 3:] = sim.bodies.inv_mass.numpy()[0, 0] * np.eye(3), sim.bodies.inv_inertia.numpy()[0, 0]
    response = inverse_mass @ J.T
    W = J @ response + np.diag(relaxation.ravel())
    return Rows(W, free.ravel(), mu, bound, directions, response, sim.bodies.free_velocity.numpy()[0, 0].copy(), impulse.ravel())


@dataclass(frozen=True)
class Problem:
    """w = M z + q,  0 <= w compl. z >= 0;  the impulses are P z + p_0."""

    M: np.ndarray
    q: np.ndarray
    P: np.ndarray
    p_0: np.ndarray


def _axes(counts: np.ndarray) -> np.ndarray:
    """E = diag(E_1, ..., E_r): columns e_j at angles j pi / k from t1."""
    E = np.zeros((2 * len(counts), counts.sum()))
    column = 0
    for i, k in enumerate(counts):
        angle = np.arange(k) * np.pi / k
        E[2 * i : 2 * i + 2, column : column + k] = np.cos(angle), np.sin(angle)
        column += k
    return E


def phantom_inertia(rows: Rows, alpha: float | None = 1.0, kilograms: float = 0.0) -> Problem:
    """The paper's LCP, eq. 39 after elimination; z = (p_n, w_up, w_lo).

    rho_j = alpha (E^T A^-1 E)_jj, or the same number of kilograms for every direction where alpha is None.
    """
    n, t, counts = rows.normal, rows.tangent, rows.directions
    E = _axes(counts)
    A, W_tn, W_nt = rows.W[np.ix_(t, t)], rows.W[np.ix_(t, n)], rows.W[np.ix_(n, t)]
    inverse = np.linalg.inv(A)
    K = E.T @ inverse @ E
    # Axes of a sliding contact have limits of their own (eq. 34); all directions of a sticking one share mu_s.
    mu = np.zeros((counts.sum(), len(n)))
    for i, (first, k) in enumerate(zip(np.cumsum(counts) - counts, counts, strict=True)):
        mu[first : first + k, i] = rows.mu[i, np.minimum(np.arange(k), 1)]
    rho = np.diag(np.full(len(K), kilograms) if alpha is None else alpha * np.diag(K))
    G = E.T @ inverse @ W_tn
    M = np.block(
        [
            [rows.W[np.ix_(n, n)] - W_nt @ inverse @ W_tn, W_nt @ inverse @ E, -W_nt @ inverse @ E],
            [mu - G, K, rho - K],
            [mu + G, rho - K, K],
        ]
    )
    g = E.T @ inverse @ rows.b[t]
    q = np.r_[rows.b[n] - W_nt @ inverse @ rows.b[t], -g, g]
    P, p_0 = np.zeros((len(rows.b), len(q))), np.zeros(len(rows.b))
    P[n, np.arange(len(n))] = 1.0
    P[t] = np.hstack([-inverse @ W_tn, inverse @ E, -inverse @ E])
    p_0[t] = -inverse @ rows.b[t]
    return Problem(M, q, P, p_0)


def anitescu_potra(rows: Rows) -> Problem:
    """The LCP of the paper's ref. 6; z = (p_n, beta, gamma) with friction impulses D beta, D = (E, -E)."""
    n, t, counts = rows.normal, rows.tangent, np.abs(rows.directions)
    E = _axes(counts)
    D = np.hstack([E, -E])
    share = np.zeros((len(n), counts.sum()))
    share[np.repeat(np.arange(len(n)), counts), np.arange(counts.sum())] = 1.0
    e = np.hstack([share, share]).T
    o = np.zeros((len(n), len(n)))
    M = np.block(
        [
            [rows.W[np.ix_(n, n)], rows.W[np.ix_(n, t)] @ D, o],
            [D.T @ rows.W[np.ix_(t, n)], D.T @ rows.W[np.ix_(t, t)] @ D, e],
            [np.diag(rows.mu[:, 0]), -e.T, o],
        ]
    )
    q = np.r_[rows.b[n], D.T @ rows.b[t], np.zeros(len(n))]
    P = np.zeros((len(rows.b), len(q)))
    P[n, np.arange(len(n))] = 1.0
    P[t, len(n) : len(n) + D.shape[1]] = D
    return Problem(M, q, P, np.zeros(len(rows.b)))


def box(rows: Rows) -> Problem:
    """The law with frozen limits (ref. 7) as an LCP; z = (p_n, p_t + bound, slack of the upper limit).

    As the mixed LCP that refs. 7 and 12 solve its matrix is W alone.
    """
    n, t = rows.normal, rows.tangent
    limit, m = rows.bound.ravel(), len(t)
    W_nt, W_tn, A = rows.W[np.ix_(n, t)], rows.W[np.ix_(t, n)], rows.W[np.ix_(t, t)]
    M = np.block(
        [
            [rows.W[np.ix_(n, n)], W_nt, np.zeros((len(n), m))],
            [W_tn, A, np.eye(m)],
            [np.zeros((m, len(n))), -np.eye(m), np.zeros((m, m))],
        ]
    )
    q = np.r_[rows.b[n] - W_nt @ limit, rows.b[t] - A @ limit, 2 * limit]
    P, p_0 = np.zeros((len(rows.b), len(q))), np.zeros(len(rows.b))
    P[n, np.arange(len(n))] = 1.0
    P[t, len(n) + np.arange(m)] = 1.0
    p_0[t] = -limit
    return Problem(M, q, P, p_0)


# ------------------------------------------------------------------------------------------------------------ what they are


def scales(M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors of rows and columns that bring the largest entry of each to 1 (Ruiz)."""
    left, right = np.ones(len(M)), np.ones(len(M))
    for _ in range(20):
        scaled = np.abs(left[:, None] * M * right)
        rows, columns = scaled.max(axis=1), scaled.max(axis=0)
        rows[rows == 0.0], columns[columns == 0.0] = 1.0, 1.0
        left, right = left / np.sqrt(rows), right / np.sqrt(columns)
    return left, right


def equilibrated(M: np.ndarray) -> np.ndarray:
    """M with its rows and columns scaled."""
    left, right = scales(M)
    return left[:, None] * M * right


def rank(M: np.ndarray, tolerance: float = RANK_TOLERANCE) -> tuple[int, float]:
    """Numerical rank and condition number."""
    values = np.linalg.svd(M, compute_uv=False)
    least = max(values[-1], 1e-300 * values[0])  # a finite number, for JSON
    return int(np.count_nonzero(values > tolerance * values[0])), float(values[0] / least)


def default_tolerance(M: np.ndarray) -> float:
    """What numpy and MATLAB take for a rank where nobody says otherwise: the size of M in round-offs."""
    return len(M) * np.finfo(float).eps


# ------------------------------------------------------------------------------------------------------- solving and judging


def _nearest(point: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Nearest point of a convex polygon with the origin inside; corners in order."""
    ends = np.roll(corners, -1, axis=0)
    edge = ends - corners
    if ((edge[:, 0] * (point - corners)[:, 1] - edge[:, 1] * (point - corners)[:, 0]) >= 0.0).all():
        return point
    length = np.maximum((edge**2).sum(axis=1), np.finfo(float).tiny)
    along = np.clip(((point - corners) * edge).sum(axis=1) / length, 0.0, 1.0)
    candidates = corners + along[:, None] * edge
    return candidates[np.argmin(((candidates - point) ** 2).sum(axis=1))]


def residual(rows: Rows, p: np.ndarray) -> float:
    """Largest violation [m/s] of the law by impulses p (docs/theory.md, the certificate), written anew with polygons."""
    u = (rows.W @ p + rows.b).reshape(-1, 3)
    p, worst = p.reshape(-1, 3), 0.0
    if not np.isfinite(p).all():
        return np.inf
    for i, k in enumerate(rows.directions):
        m = np.diag(rows.W)[3 * i : 3 * i + 3].copy()
        limit = rows.mu[i] * max(p[i, 0], 0.0) + rows.bound[i]
        if k == 0 or not limit.any():
            goal = np.zeros(2)
        elif k == 2:
            goal = np.clip(p[i, 1:] - u[i, 1:] / m[1:], -limit, limit)
        else:
            m[1:] = m[1:].mean()
            # Around the disc the corners lie half-way between two directions, within it on them.
            angle = (np.arange(2 * abs(k)) + (0.5 if k > 0 else 0.0)) * np.pi / abs(k)
            radius = limit[0] / (np.cos(np.pi / (2 * k)) if k > 0 else 1.0)
            goal = _nearest(p[i, 1:] - u[i, 1:] / m[1:], radius * np.column_stack([np.cos(angle), np.sin(angle)]))
        worst = max(worst, abs(min(u[i, 0], p[i, 0] * m[0])), *np.abs((p[i, 1:] - goal) * m[1:]))
    return worst


def block_pivoting(problem: Problem, limit: int = 100) -> tuple[np.ndarray, bool]:
    """Block principal pivoting as it comes: all infeasible pairs exchanged at once, solved afresh, until there is none.

    On the equilibrated problem, from z = 0, without safeguard. Returns (z, whether a block on the way was singular); z is NaN
    where there was no end.
    """
    n = len(problem.q)
    left, right = scales(problem.M)
    M, q = left[:, None] * problem.M * right, left * problem.q
    # A step at rest is degenerate: its tangential rows are round-off, which must not count as infeasible.
    slack = 1e-9 * np.abs(q).max()
    basic = np.zeros(n, dtype=bool)
    singular, seen = False, {basic.tobytes()}
    for _ in range(limit):
        z = np.zeros(n)
        if basic.any():
            block = M[np.ix_(basic, basic)]
            singular = singular or rank(block)[0] < len(block)
            try:
                z[basic] = np.linalg.solve(block, -q[basic])
            except np.linalg.LinAlgError:  # exactly singular: there is nothing to go on with
                break
        wrong = np.where(basic, z < -slack, M @ z + q < -slack)
        if not wrong.any():
            return right * z, singular
        basic = basic ^ wrong
        if basic.tobytes() in seen:  # the same sets follow for ever
            break
        seen.add(basic.tobytes())
    return np.full(n, np.nan), singular


def solve(problems: list[Problem], method: str) -> list[np.ndarray]:
    """Answers of wl.solve_lcp, problems of one size in one batch."""
    answers: list[np.ndarray] = [np.empty(0)] * len(problems)
    for size in {len(p.q) for p in problems}:
        chosen = [i for i, p in enumerate(problems) if len(p.q) == size]
        M, q = np.array([problems[i].M for i in chosen]), np.array([problems[i].q for i in chosen])
        z = wl.solve_lcp(M, q, method, device="cpu").z.numpy()
        for i, x in zip(chosen, z, strict=True):
            answers[i] = x
    return answers
