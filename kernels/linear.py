# SPDX-License-Identifier: Apache-2.0
"""Dense linear algebra that the lanes of one block share, on matrices in global memory [P, n, ...].

Every lane takes the same decisions and owns its columns, so results do not depend on the number of lanes.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .types import sync


@functools.cache
def functions(real) -> SimpleNamespace:
    """``invert`` for symmetric positive definite matrices, ``solve_deficient`` for general ones."""

    @wp.func
    def invert(a: wp.array3d(dtype=real), slot: int, n: int, lane: int):
        """Inverse of a symmetric positive definite matrix in place, by sweeping every pivot (Gauss-Jordan)."""
        for k in range(n):
            p = real(1.0) / a[slot, k, k]
            sync()
            for j in range(lane, n, wp.block_dim()):
                if j != k:
                    a[slot, k, j] = p * a[slot, k, j]
            sync()
            for i in range(n):
                if i != k:
                    f = a[slot, i, k]
                    for j in range(lane, n, wp.block_dim()):
                        if j != k:
                            a[slot, i, j] -= f * a[slot, k, j]
            sync()
            for i in range(lane, n, wp.block_dim()):
                if i != k:
                    a[slot, i, k] = -p * a[slot, i, k]
            if lane == 0:
                a[slot, k, k] = p
            sync()

    @wp.func
    def solve_deficient(a: wp.array3d(dtype=real), slot: int, n: int, tiny: real, substitute: real, lane: int) -> int:
        """Solve A x = b, given [A b] in a[slot, :n, :n + 1], by Gaussian elimination with row pivoting; A may be singular.

        x replaces b. A pivot of no more than `tiny` is replaced by one of size `substitute`; where that is zero, its
        unknown is set to zero instead and one equation is left out. Returns how many such pivots there were; the
        diagonal of a is 0 for unknowns that were set to zero and 1 for all others.
        """
        deficient = int(0)
        for k in range(n):
            r = int(k)
            for i in range(k + 1, n):
                if wp.abs(a[slot, i, k]) > wp.abs(a[slot, r, k]):
                    r = i
            p = a[slot, r, k]
            keep = real(1.0)
            if wp.abs(p) <= tiny:
                deficient += 1
                if substitute > real(0.0):
                    p = wp.where(p < real(0.0), -substitute, substitute)
                else:
                    p = real(1.0)
                    keep = real(0.0)
            sync()
            for j in range(k + lane, n + 1, wp.block_dim()):
                x = a[slot, r, j]
                a[slot, r, j] = a[slot, k, j]
                a[slot, k, j] = keep * (x / p)
            if lane == 0:
                a[slot, k, k] = keep  # 0 / 1, also where the pivot was replaced
            sync()
            for i in range(k + 1, n):
                f = a[slot, i, k]
                if f != real(0.0):
                    for j in range(k + 1 + lane, n + 1, wp.block_dim()):
                        a[slot, i, j] -= f * a[slot, k, j]
            sync()
        if lane == 0:
            for kk in range(n):
                k = n - 1 - kk
                x = a[slot, k, n]
                for j in range(k + 1, n):
                    x -= a[slot, k, j] * a[slot, j, n]
                a[slot, k, n] = x * a[slot, k, k]
        sync()
        return deficient

    return SimpleNamespace(invert=invert, solve_deficient=solve_deficient)
