# SPDX-License-Identifier: Apache-2.0
"""Batches of linear complementarity problems given as arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .arrays import check_finite, check_strides, device_of, is_single, on_device, read
from .errors import WarpLcpError, positive_number
from .kernels import solve_batch
from .kernels.types import LANES
from .methods import lcp_workspace, workspaces

#: Methods by the name that users give: solvers tried one after the other on what those before them left unsolved, each with
#: its largest number of pivots, bases or sweeps for n unknowns. 'auto' does not dwell on the first, for another follows: where it
#: does not cycle it needs about ten bases, whatever n. In float32 it comes to an end where Lemke's method does not.
METHODS: dict[str, tuple[tuple[str, Callable[[int], int]], ...]] = {
    "lemke": (("lemke", lambda n: 50 * n + 100),),
    "murty": (("murty", lambda n: 50 * n + 100),),
    "judice_pires": (("judice_pires", lambda n: 10 * n + 100),),
    "pgs": (("pgs", lambda n: 1000),),
    "auto": (
        ("judice_pires", lambda n: 10 + n // 10),
        ("lemke", lambda n: 50 * n + 100),
        ("judice_pires", lambda n: n + 20),
        ("pgs", lambda n: 1000),
    ),
}


@dataclass(frozen=True)
class LCPSolution:
    """Answers to B problems of n unknowns, as Warp arrays.

    Attributes:
        z, w: [B, n] with w = M z + q and lower <= z <= upper.
        residual: [B] max |z - clip(z - w, lower, upper)|, for a plain LCP max |min(z, w)|: absolute, in the units of z and w,
            computed from M, q, the bounds and z alone in double precision. Round-off alone makes it about 1e-16 of the
            largest sum |M_ij z_j| (1e-7 in float32): scale problems for which that is more than the tolerance.
        iterations: [B] pivots (lemke), bases solved (murty, judice_pires) or sweeps (pgs), of all methods tried.
        status: [B] :class:`warp_lcp.Status` bits: OK exactly where the residual is within the tolerance. Otherwise
            UNCERTIFIED and what stopped the methods: RAY, ITERATION_LIMIT; NOT_A_NUMBER where M or q is not finite.
    """

    z: wp.array
    w: wp.array
    residual: wp.array
    iterations: wp.array
    status: wp.array


def solve_lcp(
    M: Any,
    q: Any,
    method: str = "lemke",
    *,
    lower: Any = None,
    upper: Any = None,
    tolerance: float = 1e-8,
    device: Any = None,
) -> LCPSolution:
    """Solve B problems  w = M z + q,  0 <= w compl. z >= 0, or with bounds  lower <= z <= upper:

    w_i >= 0 where z_i = lower_i, w_i <= 0 where z_i = upper_i and w_i = 0 in between. An unknown without bounds (-inf, inf)
    is an equation w_i = 0: a mixed LCP. M needs no symmetry.

    Args:
        M: [B, n, n] or [n, n]; numpy, Warp, anything with ``__dlpack__`` (torch, jax) or nested lists. Two float32 arrays are
            solved in float32, everything else in float64. Arrays on a device stay there, nothing passes through the host.
        q: [B, n] or [n], likewise.
        method: 'lemke' (pivots from one basis to the next; the most robust; no unknowns without a finite lower bound),
            'judice_pires' (block principal pivoting, fast where M is a P-matrix or nearly), 'murty' (least-index principal
            pivoting), 'pgs' (projected Gauss-Seidel, M positive definite and symmetric) or 'auto' (judice_pires, then lemke
            where it can, then pgs for the problems not solved by then; each keeps its best answer).
        lower, upper: bounds, numbers or arrays [n] or [B, n], read on the host; None = 0 and infinity.
        tolerance: largest residual of an answer that counts as solved, in the units of z and w (see LCPSolution.residual).
            float32 seldom reaches the default.
        device: Warp device; None = that of M and q if they are on one, Warp's default otherwise.

    Raises:
        WarpLcpError: for shapes or types that do not fit, bounds that contradict each other or that the method does not take,
            and numbers that are not finite. Numbers on a GPU are not read back: there the status says NOT_A_NUMBER.
    """
    if method not in METHODS:
        raise WarpLcpError(f"solve_lcp: method is {method!r}; choose one of {', '.join(METHODS)}")
    tolerance = positive_number("solve_lcp: tolerance", tolerance)
    M, q = read("solve_lcp", "M", M), read("solve_lcp", "q", q)
    if M.ndim not in (2, 3) or M.ndim != q.ndim + 1 or M.shape != (*q.shape, q.shape[-1]):
        raise WarpLcpError(f"solve_lcp: M has shape {tuple(M.shape)} and q {tuple(q.shape)}; give [B, n, n] and [B, n], or [n, n] and [n]")
    real = wp.float32 if is_single(M) and is_single(q) else wp.float64
    device = device_of("solve_lcp", device, M=M, q=q)
    check_strides("solve_lcp", "M", M, real)
    check_finite("solve_lcp", "M", M)
    check_finite("solve_lcp", "q", q)
    M, q = on_device(M, real, device), on_device(q, real, device)
    if q.ndim == 1:
        M, q = M.reshape((1, *M.shape)), q.reshape((1, *q.shape))
    batch, n = q.shape
    low, high = _bound("lower", lower, 0.0, batch, n), _bound("upper", upper, np.inf, batch, n)
    _check_bounds(low, high)
    attempts = METHODS[method]
    if np.isneginf(low).any():
        if method == "lemke":
            raise WarpLcpError("solve_lcp: method 'lemke' takes no unknowns without a lower bound; choose judice_pires, murty, pgs or auto")
        attempts = tuple(a for a in attempts if a[0] != "lemke")
    rows = int(np.isfinite(high).sum(axis=1).max()) if any(name == "lemke" for name, _ in attempts) else 0
    size = max(n + rows, 1)
    slots = workspaces(batch, 2 * size * size, device)
    bounds: list[Any] = [wp.array(b, dtype=real, device=device) for b in (low, high)]
    workspace = lcp_workspace(real, slots, size, device)
    outputs = [wp.empty((batch, n), dtype=real, device=device) for _ in range(2)]
    outputs += [wp.empty(batch, dtype=d, device=device) for d in (real, int, int)]
    for i, (name, limit) in enumerate(attempts):
        inputs = [M, q, *bounds, limit(n + rows if name == "lemke" else n), wp.float64(tolerance), i, workspace]
        wp.launch_tiled(solve_batch.make(real, name), dim=[slots], inputs=inputs + outputs, block_dim=LANES, device=device)
    return LCPSolution(*outputs)


def _bound(name: str, x: Any, default: float, batch: int, n: int) -> np.ndarray:
    """[1 or B, n] in host memory."""
    if x is None:
        return np.full((1, n), default)
    x = read("solve_lcp", name, x)
    x = np.asarray(x.numpy() if isinstance(x, wp.array) else x, dtype=float)
    if x.shape not in ((), (n,), (1, n), (batch, n)):
        raise WarpLcpError(f"solve_lcp: {name} has shape {x.shape}; give a number, ({n},) or {(batch, n)}")
    return np.array(np.broadcast_to(x, (x.shape[0] if x.ndim == 2 else 1, n)))


def _check_bounds(low: np.ndarray, high: np.ndarray) -> None:
    wrong = ~((low <= high) & (low < np.inf) & (high > -np.inf))
    if wrong.any():
        where = tuple(int(i) for i in np.argwhere(wrong)[0])
        pair = [np.broadcast_to(b, wrong.shape)[where] for b in (low, high)]
        index = list(where if wrong.shape[0] > 1 else where[1:])
        raise WarpLcpError(f"solve_lcp: lower{index} is {pair[0]} and upper{index} is {pair[1]}; lower must not exceed upper, nor be NaN")
