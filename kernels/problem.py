# SPDX-License-Identifier: Apache-2.0
"""A dense LCP  w = M z + q,  lower <= z <= upper,  as one block works on it: workspace, equilibration, solve of a basis.

w_i >= 0 where z_i is at its lower bound, <= 0 where it is at its upper one and 0 in between; 0 <= z < infinity is the plain
LCP, an unknown without bounds an equation (mixed LCP). The lanes of one block share one problem: every lane takes the same
decisions from the same numbers and writes its own rows, so a result does not depend on the number of lanes.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import linear
from .types import sync

# Where an unknown is: at its lower bound, between the bounds (in the basis, w = 0), at its upper bound.
LOWER = wp.constant(0)
BETWEEN = wp.constant(1)
UPPER = wp.constant(2)


@functools.cache
def functions(real) -> SimpleNamespace:
    """The workspace of P problems of at most n unknowns, and what the methods share: ``equilibrate``, ``solve_basis``, ``rest``."""
    solve_deficient = linear.functions(real).solve_deficient

    @wp.struct
    class LcpWorkspace:
        M: wp.array3d(dtype=real)  # [P, n, n]
        q: wp.array2d(dtype=real)  # [P, n]
        lower: wp.array2d(dtype=real)  # [P, n] bounds of z
        upper: wp.array2d(dtype=real)  # [P, n]
        z: wp.array2d(dtype=real)  # [P, n] solution
        x: wp.array2d(dtype=real)  # [P, n] z of the basis at hand, bounds not heeded
        w: wp.array2d(dtype=real)  # [P, n] scratch: M z + q
        system: wp.array3d(dtype=real)  # [P, n, n + 2] linear system of a basis; Lemke's tableau
        row_scale: wp.array2d(dtype=real)  # [P, n] powers of two; row_scale_i M_ij column_scale_j is near 1
        column_scale: wp.array2d(dtype=real)  # [P, n]
        state: wp.array2d(dtype=int)  # [P, n] LOWER, BETWEEN, UPPER
        member: wp.array2d(dtype=int)  # [P, n + 1] the unknowns that are BETWEEN, in order; last: how many
        basic: wp.array2d(dtype=int)  # [P, n] Lemke: variable of each row: w_i = i, z_i = n + i, z_0 = 2 n
        nonbasic: wp.array2d(dtype=int)  # [P, n + 1] Lemke: variable of each column
        wrong: wp.array2d(dtype=int)  # [P, n] principal pivoting: the state that an unknown should change to, -1 = none
        seen: wp.array2d(dtype=int)  # [P, n] principal pivoting: states some steps ago
        error: wp.array2d(dtype=wp.float64)  # [P, n] natural residual of each row

    @wp.func
    def power_of_two(size: real) -> real:
        """About 1 / sqrt(size); 1 for zero."""
        scale = real(1.0)
        if size > real(0.0):
            scale = wp.pow(real(2.0), wp.round(real(-0.5) * wp.log2(size)))
        return scale

    @wp.func
    def equilibrate(ws: LcpWorkspace, slot: int, n: int, lane: int):
        """Scales of rows and columns that bring the largest entry of each near 1: one sweep of Ruiz's method (2001).

        Positive scales of w and z keep the problem. Powers of two, so that scaling does not round.
        """
        for i in range(lane, n, wp.block_dim()):
            row = real(0.0)
            column = real(0.0)
            for j in range(n):
                row = wp.max(row, wp.abs(ws.M[slot, i, j]))
                column = wp.max(column, wp.abs(ws.M[slot, j, i]))
            ws.row_scale[slot, i] = power_of_two(row)
            ws.column_scale[slot, i] = power_of_two(column)
        sync()

    @wp.func
    def rest(ws: LcpWorkspace, slot: int, i: int) -> real:
        """Where an unknown is that does nothing: at the bound of its state, or at a finite one, or at zero."""
        low = ws.lower[slot, i]
        high = ws.upper[slot, i]
        value = real(0.0)
        if ws.state[slot, i] == UPPER or not wp.isfinite(low):
            if wp.isfinite(high):
                value = high
        else:
            value = low
        return value

    @wp.func
    def solve_basis(ws: LcpWorkspace, slot: int, n: int, tiny: real, substitute: real, lane: int) -> int:
        """z of the basis in ws.state, from the original numbers, in ws.x: w = 0 for those BETWEEN, the others at their bounds.

        Gaussian elimination with row pivoting of the equilibrated matrix; for its pivots of no more than `tiny` see
        linear.solve_deficient. Returns how many of them there were; unknowns set to rest by it leave the basis if they
        have a bound to rest at.
        """
        if lane == 0:
            m = int(0)
            for i in range(n):
                if ws.state[slot, i] == BETWEEN:
                    ws.member[slot, m] = i
                    m += 1
            ws.member[slot, n] = m
        for i in range(lane, n, wp.block_dim()):
            ws.x[slot, i] = rest(ws, slot, i)
        sync()
        m = ws.member[slot, n]
        for i in range(lane, m, wp.block_dim()):
            a = ws.member[slot, i]
            right = ws.q[slot, a]
            for j in range(n):
                if ws.x[slot, j] != real(0.0):
                    right += ws.M[slot, a, j] * ws.x[slot, j]
            ws.system[slot, i, m] = -ws.row_scale[slot, a] * right
        for i in range(m):
            a = ws.member[slot, i]
            for j in range(lane, m, wp.block_dim()):
                b = ws.member[slot, j]
                ws.system[slot, i, j] = ws.row_scale[slot, a] * ws.M[slot, a, b] * ws.column_scale[slot, b]
        sync()
        deficient = solve_deficient(ws.system, slot, m, tiny, substitute, lane)
        for i in range(lane, m, wp.block_dim()):
            a = ws.member[slot, i]
            ws.x[slot, a] += ws.column_scale[slot, a] * ws.system[slot, i, m]
            if ws.system[slot, i, i] == real(0.0):
                if wp.isfinite(ws.lower[slot, a]):
                    ws.state[slot, a] = LOWER
                elif wp.isfinite(ws.upper[slot, a]):
                    ws.state[slot, a] = UPPER
        sync()
        return deficient

    @wp.func
    def violation(ws: LcpWorkspace, slot: int, n: int, lane: int) -> real:
        """How far ws.z is from a solution of the plain LCP: the largest |min(z, w)| of the equilibrated problem over its
        largest z and the largest w that this could make. Not a certificate: by it a method tells success from failure."""
        largest = real(0.0)
        for i in range(n):
            largest = wp.max(largest, ws.z[slot, i] / ws.column_scale[slot, i])
        for i in range(lane, n, wp.block_dim()):
            w = ws.q[slot, i]
            size = wp.abs(w)
            for j in range(n):
                w += ws.M[slot, i, j] * ws.z[slot, j]
                size += wp.abs(ws.M[slot, i, j]) * ws.column_scale[slot, j] * largest
            z = ws.z[slot, i] / wp.max(largest * ws.column_scale[slot, i], real(1.0e-30))
            ws.w[slot, i] = wp.abs(wp.min(z, w / wp.max(size, real(1.0e-30))))
        sync()
        worst = real(0.0)
        for i in range(n):
            worst = wp.max(worst, ws.w[slot, i])
        return worst

    return SimpleNamespace(LcpWorkspace=LcpWorkspace, equilibrate=equilibrate, rest=rest, solve_basis=solve_basis, violation=violation)
