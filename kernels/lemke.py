# SPDX-License-Identifier: Apache-2.0
"""Lemke's method on dense LCPs  w = M z + q,  0 <= w compl. z >= 0  (Cottle and Dantzig, the paper's ref. 8).

What makes it robust (each measured to matter, docs/theory.md): equilibration of rows and columns, a covering vector that
follows the size of the rows (and another where its path ends nowhere), a ratio test in two passes that takes the largest pivot
among the rows that block first (Harris), the lexicographic order where that cycles, and a final solve with the basis found,
refactorised from the original matrix.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import problem
from .problem import BETWEEN, LOWER
from .types import ITERATION_LIMIT, RAY, sync

# Covering vectors that are tried one after the other.
COVERS = 3


@functools.cache
def functions(real) -> SimpleNamespace:
    """The function ``lemke`` that solves the problem in a workspace."""
    double = real is wp.float64
    pivot_tolerance = real(1.0e-11) if double else real(1.0e-5)
    acceptable = real(1.0e-9) if double else real(1.0e-4)
    harris_slack = real(1.0e-12) if double else real(1.0e-6)
    shared = problem.functions(real)
    LcpWorkspace, equilibrate, solve_basis, violation = shared.LcpWorkspace, shared.equilibrate, shared.solve_basis, shared.violation

    @wp.func
    def pivot(ws: LcpWorkspace, slot: int, n: int, row: int, col: int, lane: int):
        """Exchange the basic variable of `row` with the nonbasic variable of `col`, in place."""
        p = real(1.0) / ws.system[slot, row, col]
        sync()
        for j in range(lane, n + 2, wp.block_dim()):
            if j != col:
                ws.system[slot, row, j] = -p * ws.system[slot, row, j]
        sync()
        for i in range(n):
            if i != row:
                f = ws.system[slot, i, col]
                if f != real(0.0):
                    for j in range(lane, n + 2, wp.block_dim()):
                        if j != col:
                            ws.system[slot, i, j] += f * ws.system[slot, row, j]
        sync()
        for i in range(lane, n, wp.block_dim()):
            if i != row:
                ws.system[slot, i, col] = p * ws.system[slot, i, col]
        if lane == 0:
            ws.system[slot, row, col] = p
            entering = ws.nonbasic[slot, col]
            ws.nonbasic[slot, col] = ws.basic[slot, row]
            ws.basic[slot, row] = entering
        sync()

    @wp.func
    def lexicographically_less(ws: LcpWorkspace, slot: int, n: int, a: int, b: int, col: int) -> bool:
        """Does row a leave before row b under the perturbation q + (t, t^2, ...)? Both are divided by their pivots."""
        pa = -ws.system[slot, a, col]
        pb = -ws.system[slot, b, col]
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
                        ka = -ws.system[slot, a, j]
                        kb = -ws.system[slot, b, j]
            difference = ka * pb - kb * pa
            if wp.abs(difference) > pivot_tolerance * (wp.abs(ka * pb) + wp.abs(kb * pa)):
                return difference < real(0.0)
        return a < b

    @wp.func
    def ratio_test(ws: LcpWorkspace, slot: int, n: int, col: int, slack: real, lexicographic: bool) -> int:
        """Row that blocks the entering variable first, or -1 (a ray). z_0 leaves as soon as it can."""
        largest = real(0.0)
        for i in range(n):
            largest = wp.max(largest, wp.abs(ws.system[slot, i, col]))
        tolerance = pivot_tolerance * wp.max(largest, real(1.0))
        bound = real(1.0e30)
        for i in range(n):
            p = -ws.system[slot, i, col]
            if p > tolerance:
                bound = wp.min(bound, (wp.max(ws.system[slot, i, n + 1], real(0.0)) + slack) / p)
        best = int(-1)
        best_pivot = real(0.0)
        for i in range(n):
            p = -ws.system[slot, i, col]
            if p > tolerance and ws.system[slot, i, n + 1] <= bound * p:
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
    def load(ws: LcpWorkspace, slot: int, n: int, cover: int, lane: int):
        """Equilibrated tableau of the start basis w: x_basic = T[:, :n + 1] x_nonbasic + T[:, n + 1].

        The covering vector, column n, is the sum of sizes of each row (0), or ones (1), or numbers from 1 to 2 (2).
        """
        for i in range(lane, n, wp.block_dim()):
            total = real(0.0)
            for j in range(n):
                entry = ws.row_scale[slot, i] * ws.M[slot, i, j] * ws.column_scale[slot, j]
                ws.system[slot, i, j] = entry
                total += wp.abs(entry)
            if cover == 1 or total == real(0.0):
                total = real(1.0)
            elif cover == 2:
                total = real(1.0) + real(i) / real(n)
            ws.system[slot, i, n] = total
            ws.system[slot, i, n + 1] = ws.row_scale[slot, i] * ws.q[slot, i]
            ws.basic[slot, i] = i
            ws.nonbasic[slot, i] = n + i
        if lane == 0:
            ws.nonbasic[slot, n] = 2 * n
        sync()

    @wp.func
    def refactorise(ws: LcpWorkspace, slot: int, n: int, lane: int) -> bool:
        """z of the basis found, from the original numbers; False where the basis is singular. Overwrites the tableau."""
        for i in range(lane, n, wp.block_dim()):
            ws.state[slot, i] = LOWER
        sync()
        for r in range(lane, n, wp.block_dim()):
            b = ws.basic[slot, r]
            if b >= n and b < 2 * n:
                ws.state[slot, b - n] = BETWEEN
        sync()
        regular = solve_basis(ws, slot, n, real(0.0), real(0.0), lane) == 0
        for i in range(lane, n, wp.block_dim()):
            # A singular basis: its tableau is gone, and what stands in z belongs to another problem.
            ws.z[slot, i] = wp.where(regular, wp.max(ws.x[slot, i], real(0.0)), real(0.0))
        sync()
        return regular

    @wp.func
    def read_tableau(ws: LcpWorkspace, slot: int, n: int, lane: int):
        """z as the tableau has it; the rest is zero."""
        for i in range(lane, n, wp.block_dim()):
            ws.z[slot, i] = real(0.0)
        sync()
        for r in range(lane, n, wp.block_dim()):
            b = ws.basic[slot, r]
            if b >= n and b < 2 * n:
                ws.z[slot, b - n] = wp.max(ws.system[slot, r, n + 1], real(0.0)) * ws.column_scale[slot, b - n]
        sync()

    @wp.func
    def follow(ws: LcpWorkspace, slot: int, n: int, cover: int, limit: int, lane: int) -> wp.vec2i:
        """Follow the path of one covering vector to its end, z to ws.z; returns (status bits, pivots)."""
        load(ws, slot, n, cover, lane)
        row = int(0)
        size = real(0.0)
        for i in range(n):
            size = wp.max(size, wp.abs(ws.system[slot, i, n + 1]))
            # q_i / d_i least, multiplied out
            if ws.system[slot, i, n + 1] * ws.system[slot, row, n] < ws.system[slot, row, n + 1] * ws.system[slot, i, n]:
                row = i
        status = int(0)
        pivots = int(0)
        if n > 0 and ws.system[slot, row, n + 1] < real(0.0):
            # z_0 enters, the row that needs most of it leaves, then the complement of what left enters, until z_0 leaves.
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
        elif not refactorise(ws, slot, n, lane):
            status = RAY
        return wp.vec2i(status, pivots)

    @wp.func
    def lemke(ws: LcpWorkspace, slot: int, n: int, limit: int, lane: int) -> wp.vec2i:
        """Solve the plain LCP in ws.M, ws.q into ws.z; returns (status bits, pivots)."""
        equilibrate(ws, slot, n, lane)
        status = int(0)
        pivots = int(0)
        cover = int(0)
        while cover < COVERS:
            result = follow(ws, slot, n, cover, limit, lane)
            status = result[0]
            pivots += result[1]
            cover += 1
            if status == 0 and violation(ws, slot, n, lane) <= acceptable:
                cover = COVERS
            sync()
        return wp.vec2i(status, pivots)

    return SimpleNamespace(lemke=lemke)
