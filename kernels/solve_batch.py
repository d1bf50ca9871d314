# SPDX-License-Identifier: Apache-2.0
"""The methods by name, and the kernel that runs one of them on a batch of problems and judges its answers."""

from collections.abc import Callable
from typing import Any

import warp as wp

from . import gauss_seidel, lemke, principal, problem
from .declare import BLOCK_OPTIONS, factory, kernel
from .types import NOT_A_NUMBER, UNCERTIFIED, sync

#: Functions (workspace, slot, n, limit, lane) -> (status bits, iterations), for a scalar type.
SOLVERS: dict[str, Callable[[Any], Any]] = {
    "lemke": lambda real: lemke.functions(real).lemke,
    "murty": lambda real: principal.functions(real).murty,
    "judice_pires": lambda real: principal.functions(real).judice_pires,
    "pgs": lambda real: gauss_seidel.functions(real).pgs,
}


def solver(real: Any, method: str) -> Any:
    """The Warp function of a method."""
    return SOLVERS[method](real)


@factory
def make(real, method: str):
    """Kernel ``solve_batch`` for problems given as arrays; launch tiled with dim (P), P <= B workspaces.

    Several methods may be tried one after the other on the same outputs: from the second attempt on, problems that are
    solved are left alone and the answer with the least residual is kept.
    """
    LcpWorkspace = problem.functions(real).LcpWorkspace
    solve = solver(real, method)

    @wp.func
    def load_as_it_is(
        M: wp.array3d(dtype=real),
        q: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=real),
        upper: wp.array2d(dtype=real),
        b: int,
        ws: LcpWorkspace,
        slot: int,
        lane: int,
    ) -> int:
        """Problem b to the workspace; returns the number of unknowns."""
        n = q.shape[1]
        for i in range(lane, n, wp.block_dim()):
            for j in range(n):
                ws.M[slot, i, j] = M[b, i, j]
            ws.q[slot, i] = q[b, i]
            ws.lower[slot, i] = lower[b % lower.shape[0], i]
            ws.upper[slot, i] = upper[b % upper.shape[0], i]
        sync()
        return n

    @wp.func
    def load_with_rows(
        M: wp.array3d(dtype=real),
        q: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=real),
        upper: wp.array2d(dtype=real),
        b: int,
        ws: LcpWorkspace,
        slot: int,
        lane: int,
    ) -> int:
        """Problem b with bounds as a plain LCP in z - lower and a multiplier s of each finite upper bound.

        w = M z + q + s, and upper - z >= 0 complementary to s. Returns the number of unknowns, those multipliers included.
        """
        n = q.shape[1]
        total = int(n)
        for i in range(n):
            if wp.isfinite(upper[b % upper.shape[0], i]):
                total += 1
        for i in range(lane, total, wp.block_dim()):
            ws.lower[slot, i] = real(0.0)  # another method may have left bounds there
            ws.upper[slot, i] = real(wp.inf)
            for j in range(total):
                ws.M[slot, i, j] = real(0.0)
        sync()
        row = int(n)
        for i in range(n):
            low = lower[b % lower.shape[0], i]
            high = upper[b % upper.shape[0], i]
            if i % wp.block_dim() == lane:
                right = q[b, i]
                for j in range(n):
                    ws.M[slot, i, j] = M[b, i, j]
                    right += M[b, i, j] * lower[b % lower.shape[0], j]
                ws.q[slot, i] = right
                if wp.isfinite(high):
                    ws.M[slot, i, row] = real(1.0)
                    ws.M[slot, row, i] = real(-1.0)
                    ws.q[slot, row] = high - low
            if wp.isfinite(high):
                row += 1
        sync()
        return total

    @wp.func
    def row_of_w(M: wp.array3d(dtype=real), q: wp.array2d(dtype=real), b: int, i: int, ws: LcpWorkspace, slot: int) -> wp.float64:
        """(M z + q)_i for z in ws.x, in about twice double precision: round-off would pass wrong answers of large problems.

        Factors are split into a single-precision part and the rest, so that all products but the least are exact (also if
        the compiler fuses them with a sum), and the round-off of every sum is summed too (Ogita, Rump and Oishi 2005).
        """
        total = wp.float64(q[b, i])
        lost = wp.float64(0.0)
        for j in range(q.shape[1]):
            x = wp.float64(M[b, i, j])
            y = wp.float64(ws.x[slot, j])
            x_high = wp.float64(wp.float32(x))
            y_high = wp.float64(wp.float32(y))
            if wp.abs(x) > wp.float64(1.0e38):  # beyond single precision: not split
                x_high = x
            if wp.abs(y) > wp.float64(1.0e38):
                y_high = y
            x_low = x - x_high
            y_low = y - y_high
            for part in range(3):
                term = x_high * y_high
                if part == 1:
                    term = x_high * y_low
                elif part == 2:
                    term = x_low * y_high
                after = total + term
                added = after - total
                lost += (total - (after - added)) + (term - added)
                total = after
            lost += x_low * y_low
        return total + lost

    load = load_as_it_is
    shift = real(0.0)
    if method == "lemke":
        load = load_with_rows
        shift = real(1.0)

    @kernel(BLOCK_OPTIONS)
    def solve_batch(
        M: wp.array3d(dtype=real),
        q: wp.array2d(dtype=real),
        lower: wp.array2d(dtype=real),
        upper: wp.array2d(dtype=real),
        limit: int,
        tolerance: wp.float64,
        attempt: int,
        ws: LcpWorkspace,
        z: wp.array2d(dtype=real),
        w: wp.array2d(dtype=real),
        residual: wp.array(dtype=real),
        iterations: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        slot, lane = wp.tid()
        n = q.shape[1]
        for b in range(slot, q.shape[0], ws.q.shape[0]):
            if attempt == 0 or status[b] != 0:
                unknowns = load(M, q, lower, upper, b, ws, slot, lane)
                result = solve(ws, slot, unknowns, limit, lane)
                # The certificate: from M, q, the bounds and z alone, whatever the method says.
                for i in range(lane, n, wp.block_dim()):
                    low = lower[b % lower.shape[0], i]
                    high = upper[b % upper.shape[0], i]
                    value = ws.z[slot, i]
                    if shift > real(0.0):
                        value += low
                    ws.x[slot, i] = wp.min(wp.max(value, low), high)
                sync()
                for i in range(lane, n, wp.block_dim()):
                    y = row_of_w(M, q, b, i, ws, slot)
                    x = wp.float64(ws.x[slot, i])
                    nearest = wp.max(x - y, wp.float64(lower[b % lower.shape[0], i]))
                    nearest = wp.min(nearest, wp.float64(upper[b % upper.shape[0], i]))
                    ws.w[slot, i] = real(y)
                    ws.error[slot, i] = wp.abs(x - nearest)
                    if not (wp.isfinite(x) and wp.isfinite(y)):
                        ws.error[slot, i] = wp.float64(wp.inf)
                sync()
                worst = wp.float64(0.0)
                for i in range(n):
                    worst = wp.max(worst, ws.error[slot, i])
                better = attempt == 0 or worst <= tolerance or real(worst) < residual[b]
                sync()  # all lanes have read what lane 0 writes next
                if better:
                    for i in range(lane, n, wp.block_dim()):
                        z[b, i] = ws.x[slot, i]
                        w[b, i] = ws.w[slot, i]
                if lane == 0:
                    if attempt == 0:
                        iterations[b] = 0
                        status[b] = 0
                    iterations[b] = iterations[b] + result[1]
                    if better:
                        residual[b] = real(worst)
                    if worst <= tolerance:
                        status[b] = 0
                    elif wp.isfinite(worst):
                        status[b] = status[b] | result[0] | UNCERTIFIED
                    else:
                        status[b] = status[b] | NOT_A_NUMBER | UNCERTIFIED
            sync()

    return solve_batch
