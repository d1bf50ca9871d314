# SPDX-License-Identifier: Apache-2.0
"""Lemke's method on dense LCPs  w = M z + q,  0 <= w compl. z >= 0  (Cottle and Dantzig, the paper's ref. 8).

The lanes of one block share one problem: every lane takes the same decisions from the same numbers and updates its own
columns, so a result does not depend on the number of lanes. On the CPU a block has one lane.

What makes it robust (each measured to matter, docs/theory.md): equilibration, a ratio test in two passes that takes the
largest pivot among the rows that block first (Harris), the lexicographic order where that cycles, and a final solve
with the basis found, refactorised from the original matrix.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import linear
from .types import ITERATION_LIMIT, LANES, RAY, UNCERTIFIED, sync


@functools.cache
def functions(real) -> SimpleNamespace:
    """The workspace of a problem of at most n unknowns, and the function ``lemke`` that solves it there."""
    double = real is wp.float64
    pivot_tolerance = real(1.0e-11) if double else real(1.0e-5)
    harris_slack = real(1.0e-12) if double else real(1.0e-6)
    solve = linear.functions(real).solve

    @wp.struct
    class LcpWorkspace:
        M: wp.array3d(dtype=real)  # [P, n, n]
        q: wp.array2d(dtype=real)  # [P, n]
        z: wp.array2d(dtype=real)  # [P, n] solution
        tableau: wp.array3d(dtype=real)  # [P, n, n + 2]: x_basic = T[:, :n + 1] x_nonbasic + T[:, n + 1]
        scale: wp.array2d(dtype=real)  # [P, n]
        basic: wp.array2d(dtype=int)  # [P, n] variable of each row: w_i = i, z_i = n + i, z_0 = 2 n
        nonbasic: wp.array2d(dtype=int)  # [P, n + 1] variable of each column

    @wp.func
    def pivot(ws: LcpWorkspace, slot: int, n: int, row: int, col: int, lane: int):
        """Exchange the basic variable of `row` with the nonbasic variable of `col`, in place."""
        p = real(1.0) / ws.tableau[slot, row, col]
        sync()
        for j in range(lane, n + 2, wp.block_dim()):
            if j != col:
                ws.tableau[slot, row, j] = -p * ws.tableau[slot, row, j]
        sync()
        for i in range(n):
            if i != row:
                f = ws.tableau[slot, i, col]
                if f != real(0.0):
                    for j in range(lane, n + 2, wp.block_dim()):
                        if j != col:
                            ws.tableau[slot, i, j] += f * ws.tableau[slot, row, j]
        sync()
        for i in range(lane, n, wp.block_dim()):
            if i != row:
                ws.tableau[slot, i, col] = p * ws.tableau[slot, i, col]
        if lane == 0:
            ws.tableau[slot, row, col] = p
            entering = ws.nonbasic[slot, col]
            ws.nonbasic[slot, col] = ws.basic[slot, row]
            ws.basic[slot, row] = entering
        sync()

    @wp.func
    def lexicographically_less(ws: LcpWorkspace, slot: int, n: int, a: int, b: int, col: int) -> bool:
        """Does row a leave before row b under the perturbation q + (t, t^2, ...)? Both are divided by their pivots."""
        pa = -ws.tableau[slot, a, col]
        pb = -ws.tableau[slot, b, col]
        for k in range(n):
            ka = real(0.0)
            kb = real(0.0)
            if ws.basic[slot, a] == k:
                ka = real(1.0)
            elif ws.basic[slot, b] == k:
                kb = real(1.0)
            else:
                for j in range(n + 1):
                    if ws.nonbasic[slot, j] == k:
                        ka = -ws.tableau[slot, a, j]
                        kb = -ws.tableau[slot, b, j]
            difference = ka * pb - kb * pa
            if wp.abs(difference) > pivot_tolerance * (wp.abs(ka * pb) + wp.abs(kb * pa)):
                return difference < real(0.0)
        return a < b

    @wp.func
    def ratio_test(ws: LcpWorkspace, slot: int, n: int, col: int, slack: real, lexicographic: bool) -> int:
        """Row that blocks the entering variable first, or -1 (a ray). z_0 leaves as soon as it can."""
        largest = real(0.0)
        for i in range(n):
            largest = wp.max(largest, wp.abs(ws.tableau[slot, i, col]))
        tolerance = pivot_tolerance * wp.max(largest, real(1.0))
        bound = real(1.0e30)
        for i in range(n):
            p = -ws.tableau[slot, i, col]
            if p > tolerance:
                bound = wp.min(bound, (wp.max(ws.tableau[slot, i, n + 1], real(0.0)) + slack) / p)
        best = int(-1)
        best_pivot = real(0.0)
        for i in range(n):
            p = -ws.tableau[slot, i, col]
            if p > tolerance and ws.tableau[slot, i, n + 1] <= bound * p:
                if ws.basic[slot, i] == 2 * n:
                    return i
                if best < 0:
                    best = i
                    best_pivot = p
                elif lexicographic:
                    if lexicographically_less(ws, slot, n, i, best, col):
                        best = i
                elif p > best_pivot:
                    best = i
                    best_pivot = p
        return best

    @wp.func
    def load(ws: LcpWorkspace, slot: int, n: int, lane: int):
        """Equilibrated tableau of the start basis w."""
        for i in range(lane, n, wp.block_dim()):
            size = wp.abs(ws.M[slot, i, i])
            if size == real(0.0):
                for j in range(n):
                    size = wp.max(size, wp.max(wp.abs(ws.M[slot, i, j]), wp.abs(ws.M[slot, j, i])))
            ws.scale[slot, i] = real(1.0)
            if size > real(0.0):
                ws.scale[slot, i] = real(1.0) / wp.sqrt(size)
            ws.basic[slot, i] = i
            ws.nonbasic[slot, i] = n + i
        if lane == 0:
            ws.nonbasic[slot, n] = 2 * n
        sync()
        for i in range(n):
            for j in range(lane, n, wp.block_dim()):
                ws.tableau[slot, i, j] = ws.scale[slot, i] * ws.M[slot, i, j] * ws.scale[slot, j]
            if lane == 0:
                ws.tableau[slot, i, n] = real(1.0)
                ws.tableau[slot, i, n + 1] = ws.scale[slot, i] * ws.q[slot, i]
        sync()

    @wp.func
    def solve_basis(ws: LcpWorkspace, slot: int, n: int, lane: int) -> bool:
        """z of the basis found, from the original numbers: M_aa z_a = -q_a by Gaussian elimination with row pivoting.

        Works in the tableau's memory. Returns False (and leaves z alone) where the basis is singular.
        """
        # The rows and columns that take part, in the order of the unknowns; nonbasic[:m] becomes the list.
        m = int(0)
        if lane == 0:
            for i in range(n):
                ws.nonbasic[slot, i] = -1
            for r in range(n):
                b = ws.basic[slot, r]
                if b >= n and b < 2 * n:
                    ws.nonbasic[slot, b - n] = 0
            for i in range(n):
                if ws.nonbasic[slot, i] == 0:
                    ws.nonbasic[slot, m] = i
                    m += 1
            ws.nonbasic[slot, n] = m
        sync()
        m = ws.nonbasic[slot, n]
        for i in range(m):
            a = ws.nonbasic[slot, i]
            for j in range(lane, m, wp.block_dim()):
                b = ws.nonbasic[slot, j]
                ws.tableau[slot, i, j] = ws.scale[slot, a] * ws.M[slot, a, b] * ws.scale[slot, b]
            if lane == 0:
                ws.tableau[slot, i, m] = -ws.scale[slot, a] * ws.q[slot, a]
        sync()
        if not solve(ws.tableau, slot, m, lane):
            return False
        for i in range(lane, n, wp.block_dim()):
            ws.z[slot, i] = real(0.0)
        sync()
        for i in range(lane, m, wp.block_dim()):
            a = ws.nonbasic[slot, i]
            ws.z[slot, a] = wp.max(ws.tableau[slot, i, m], real(0.0)) * ws.scale[slot, a]
        sync()
        return True

    @wp.func
    def read_tableau(ws: LcpWorkspace, slot: int, n: int, lane: int):
        """z as the tableau has it; the rest is zero."""
        for i in range(lane, n, wp.block_dim()):
            ws.z[slot, i] = real(0.0)
        sync()
        for r in range(lane, n, wp.block_dim()):
            b = ws.basic[slot, r]
            if b >= n and b < 2 * n:
                ws.z[slot, b - n] = wp.max(ws.tableau[slot, r, n + 1], real(0.0)) * ws.scale[slot, b - n]
        sync()

    @wp.func
    def lemke(ws: LcpWorkspace, slot: int, n: int, limit: int, lane: int) -> wp.vec2i:
        """Solve the problem in ws.M, ws.q of a slot into ws.z; returns (status bits, pivots)."""
        load(ws, slot, n, lane)
        row = int(0)
        size = real(0.0)
        for i in range(n):
            size = wp.max(size, wp.abs(ws.tableau[slot, i, n + 1]))
            if ws.tableau[slot, i, n + 1] < ws.tableau[slot, row, n + 1]:
                row = i
        status = int(0)
        pivots = int(0)
        if n > 0 and ws.tableau[slot, row, n + 1] < real(0.0):
            # z_0 enters, the most negative row leaves, then the complement of what left enters, until z_0 leaves.
            col = int(n)
            searching = bool(True)
            while searching:
                left = ws.basic[slot, row]
                pivot(ws, slot, n, row, col, lane)
                pivots += 1
                if left == 2 * n:
                    searching = False
                elif pivots >= limit:
                    status = ITERATION_LIMIT
                    searching = False
                else:
                    entering = (left + n) % (2 * n)
                    for j in range(n + 1):
                        if ws.nonbasic[slot, j] == entering:
                            col = j
                    row = ratio_test(ws, slot, n, col, harris_slack * size, pivots > limit / 2)
                    if row < 0:
                        status = RAY
                        searching = False
        if status != 0:
            read_tableau(ws, slot, n, lane)
        elif not solve_basis(ws, slot, n, lane):
            # A singular basis: its tableau is gone, and what stands in z belongs to another problem.
            for i in range(lane, n, wp.block_dim()):
                ws.z[slot, i] = real(0.0)
            sync()
            status = RAY
        return wp.vec2i(status, pivots)

    return SimpleNamespace(LcpWorkspace=LcpWorkspace, lemke=lemke)


@functools.cache
def make(real):
    """Kernel ``solve_batch`` for problems given as arrays; launch tiled with dim (P), P <= B workspaces."""
    f = functions(real)
    LcpWorkspace, lemke = f.LcpWorkspace, f.lemke

    @wp.kernel(module="unique", enable_backward=False, module_options={"block_dim": LANES})
    def solve_batch(
        M: wp.array3d(dtype=real),
        q: wp.array2d(dtype=real),
        limit: int,
        tolerance: real,
        ws: LcpWorkspace,
        z: wp.array2d(dtype=real),
        w: wp.array2d(dtype=real),
        residual: wp.array(dtype=real),
        iterations: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        slot, lane = wp.tid()
        n = q.shape[1]
        for problem in range(slot, q.shape[0], ws.q.shape[0]):
            for i in range(lane, n, wp.block_dim()):
                for j in range(n):
                    ws.M[slot, i, j] = M[problem, i, j]
                ws.q[slot, i] = q[problem, i]
            sync()
            result = lemke(ws, slot, n, limit, lane)
            for i in range(lane, n, wp.block_dim()):
                x = q[problem, i]
                for j in range(n):
                    x += M[problem, i, j] * ws.z[slot, j]
                w[problem, i] = x
                z[problem, i] = ws.z[slot, i]
            sync()
            if lane == 0:
                worst = real(0.0)
                for i in range(n):
                    worst = wp.max(worst, wp.abs(wp.min(z[problem, i], w[problem, i])))
                residual[problem] = worst
                iterations[problem] = result[1]
                status[problem] = result[0]
                if not worst <= tolerance:
                    status[problem] = result[0] | UNCERTIFIED
            sync()

    return solve_batch
