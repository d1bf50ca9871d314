# SPDX-License-Identifier: Apache-2.0
"""Batches of linear complementarity problems given as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .errors import WarpLcpError
from .kernels import lemke
from .kernels.types import LANES
from .methods import lcp_workspace, workspaces


@dataclass(frozen=True)
class LCPSolution:
    """Answers to B problems of n unknowns, as Warp arrays.

    Attributes:
        z, w: [B, n] with w = M z + q.
        residual: [B] max |min(z, w)|, computed from z alone.
        iterations: [B] pivots.
        status: [B] :class:`warp_lcp.Status` bits; OK only where the residual is within the tolerance.
    """

    z: wp.array
    w: wp.array
    residual: wp.array
    iterations: wp.array
    status: wp.array


def solve_lcp(M: Any, q: Any, method: str = "lemke", *, tolerance: float = 1e-8, device: Any = None) -> LCPSolution:
    """Solve B problems  w = M z + q,  0 <= w compl. z >= 0.

    Args:
        M: [B, n, n] or [n, n], numpy or Warp; float32 is solved in float32, everything else in float64.
        q: [B, n] or [n].
        method: 'lemke'.
        tolerance: largest residual of an answer that counts as solved.
        device: Warp device; None = Warp's default.

    Raises:
        WarpLcpError: for shapes that do not fit or numbers that are not finite.
    """
    if method != "lemke":
        raise WarpLcpError(f"solve_lcp: method is {method!r}; choose lemke")
    M, q = (x.numpy() if isinstance(x, wp.array) else np.asarray(x) for x in (M, q))
    kind = np.float32 if M.dtype == q.dtype == np.float32 else np.float64
    M, q = (np.ascontiguousarray(x, dtype=kind) for x in (M, q))
    M, q = (M[None] if M.ndim == 2 else M), (q[None] if q.ndim == 1 else q)
    if M.ndim != 3 or q.ndim != 2 or M.shape != (*q.shape, q.shape[1]):
        raise WarpLcpError(f"solve_lcp: M has shape {M.shape} and q {q.shape}; give [B, n, n] and [B, n]")
    if not (np.isfinite(M).all() and np.isfinite(q).all()):
        raise WarpLcpError("solve_lcp: M and q must be finite")
    device, real = wp.get_device(device), wp.float64 if kind is np.float64 else wp.float32
    batch, n = q.shape
    slots = workspaces(batch, 2 * n * n, device)
    outputs = [wp.empty((batch, n), dtype=real, device=device) for _ in range(2)]
    outputs += [wp.empty(batch, dtype=d, device=device) for d in (real, int, int)]
    inputs = [wp.array(M, dtype=real, device=device), wp.array(q, dtype=real, device=device), 50 * n + 100, tolerance]
    inputs.append(lcp_workspace(real, slots, n, device))
    wp.launch_tiled(lemke.make(real), dim=[slots], inputs=inputs + outputs, block_dim=LANES, device=device)
    return LCPSolution(*outputs)
