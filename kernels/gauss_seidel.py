# SPDX-License-Identifier: Apache-2.0
"""Projected Gauss-Seidel on dense LCPs with bounds (Cryer 1971): z_i = clip(z_i - w_i / M_ii), one after the other.

Converges on symmetric positive definite M and where the diagonal dominates, and on few others: never on the paper's LCP, whose
M is neither (block PGS on contacts, pgs.py, is another method). Unknowns with M_ii <= 0 stay where they are.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import problem
from .problem import LOWER
from .types import ITERATION_LIMIT, sync

# Iterates larger than this have diverged.
HUGE = wp.constant(1.0e30)


@functools.cache
def functions(real) -> SimpleNamespace:
    """The function ``pgs`` that solves the problem in a workspace; (status bits, sweeps)."""
    resolution = real(1.0e-15) if real is wp.float64 else real(1.0e-7)
    shared = problem.functions(real)
    LcpWorkspace, rest = shared.LcpWorkspace, shared.rest

    @wp.func
    def pgs(ws: LcpWorkspace, slot: int, n: int, limit: int, lane: int) -> wp.vec2i:
        """Sweeps from rest until no unknown moves by more than round-off."""
        for i in range(lane, n, wp.block_dim()):
            ws.state[slot, i] = LOWER
            ws.z[slot, i] = rest(ws, slot, i)
        sync()
        status = int(ITERATION_LIMIT)
        sweeps = int(0)
        searching = bool(True)
        while searching:
            for i in range(lane, n, wp.block_dim()):  # anew in every sweep: what the steps below add up drifts
                total = ws.q[slot, i]
                for j in range(n):
                    total += ws.M[slot, i, j] * ws.z[slot, j]
                ws.w[slot, i] = total
            sync()
            change = real(0.0)
            size = real(0.0)
            for i in range(n):
                diagonal = ws.M[slot, i, i]
                old = ws.z[slot, i]
                new = old
                if diagonal > real(0.0):
                    new = wp.min(wp.max(old - ws.w[slot, i] / diagonal, ws.lower[slot, i]), ws.upper[slot, i])
                change = wp.max(change, wp.abs(new - old))
                size = wp.max(size, wp.abs(new))
                sync()
                if new != old:
                    for j in range(lane, n, wp.block_dim()):
                        ws.w[slot, j] += ws.M[slot, j, i] * (new - old)
                    if lane == 0:
                        ws.z[slot, i] = new
                sync()
            sweeps += 1
            if change <= resolution * size:
                status = 0
                searching = False
            elif sweeps >= limit:
                searching = False
            elif not size < real(HUGE):
                searching = False
                for i in range(lane, n, wp.block_dim()):
                    ws.z[slot, i] = rest(ws, slot, i)
                sync()
        return wp.vec2i(status, sweeps)

    return SimpleNamespace(pgs=pgs)
