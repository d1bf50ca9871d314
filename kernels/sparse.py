# SPDX-License-Identifier: Apache-2.0
"""Direct solution of block-sparse systems, the nodes of a graph being the contacts or the bodies of one environment.

Contacts are coupled where they share a body (3 x 3 blocks), bodies where they share a contact (6 x 6), so that in a heap of
hundreds each has a handful of neighbours. The graph is ordered once by minimum degree (the node with the fewest neighbours
left goes first, its neighbours become neighbours of each other), which tells where the factors have blocks; every
factorisation of any matrix with that pattern then touches those blocks only. There is no search for pivots beyond a block:
whoever solves must look at the residual. Blocks of 3 are inverted with row pivoting, for contact blocks may have zeros on the
diagonal; blocks of 6 are factorised, for a stiff body block times a rounded inverse would lose what its masses are worth
(5 % of the steps of a heap ended above 1e-6 m/s).

The lanes of one block share one problem. Neighbours are kept as bits, one row of words a node.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .types import scalar_types, sync

# Bits in a word of the adjacency.
WORD = 32


@functools.cache
def functions(real, size: int) -> SimpleNamespace:
    """Bundle ``Graph`` of blocks size x size and the functions that work on it."""
    t = scalar_types(real)
    vector = t.vec3 if size == 3 else wp.types.vector(length=size, dtype=real)
    matrix = t.mat33 if size == 3 else wp.types.matrix(shape=(size, size), dtype=real)

    @wp.struct
    class Graph:
        """A symmetric pattern of at most n nodes and m blocks off the diagonal, and matrices that have it.

        P workspaces. Rows of the matrix are in the caller's order, factors in the order of elimination. diagonal and block are
        the caller's alone: without arrays where it keeps no matrix besides the factors.
        """

        adjacent: wp.array3d(dtype=wp.uint32)  # [P, n, words] neighbours of a node among those not yet eliminated
        degree: wp.array2d(dtype=int)  # [P, n] -1 = eliminated
        order: wp.array2d(dtype=int)  # [P, n] node of each step of elimination
        step: wp.array2d(dtype=int)  # [P, n] its inverse
        row: wp.array2d(dtype=int)  # [P, n + 1] first block of each row
        column: wp.array2d(dtype=int)  # [P, m]
        target: wp.array2d(dtype=int)  # [P, m] where the factors hold a block: upper[target], or lower[-1 - target]
        diagonal: wp.array2d(dtype=matrix)  # [P, n]
        block: wp.array2d(dtype=matrix)  # [P, m]
        fill: wp.array2d(dtype=int)  # [P, n + 1] first block of each step in lower and upper
        later: wp.array2d(dtype=int)  # [P, m] the later step that shares the block
        pivot: wp.array2d(dtype=matrix)  # [P, n] inverse of the block on the diagonal, or its factors
        lower: wp.array2d(dtype=matrix)  # [P, m] row `later`, column of the step
        upper: wp.array2d(dtype=matrix)  # [P, m] row of the step, column `later`

    @wp.func
    def is_neighbour(g: Graph, slot: int, i: int, j: int) -> bool:
        return (g.adjacent[slot, i, j // WORD] >> wp.uint32(j % WORD)) & wp.uint32(1) != wp.uint32(0)

    @wp.func
    def clear(g: Graph, slot: int, n: int, i: int):
        """No neighbours yet."""
        for w in range((n + WORD - 1) // WORD):
            g.adjacent[slot, i, w] = wp.uint32(0)

    @wp.func
    def connect(g: Graph, slot: int, i: int, j: int):
        """Make j a neighbour of i; the caller does the same for i and j exchanged."""
        g.adjacent[slot, i, j // WORD] = g.adjacent[slot, i, j // WORD] | (wp.uint32(1) << wp.uint32(j % WORD))

    @wp.func
    def complete(g: Graph, slot: int, n: int, lane: int):
        """Make neighbours of each other where the one of lower number has been connected to the other."""
        for i in range(lane, n, wp.block_dim()):
            for j in range(i):
                if is_neighbour(g, slot, j, i):
                    connect(g, slot, i, j)
        sync()

    @wp.func
    def disconnect(g: Graph, slot: int, i: int, j: int):
        g.adjacent[slot, i, j // WORD] = g.adjacent[slot, i, j // WORD] & ~(wp.uint32(1) << wp.uint32(j % WORD))

    @wp.func
    def count(g: Graph, slot: int, i: int, words: int) -> int:
        total = int(0)
        for w in range(words):
            total += wp.bit_count(g.adjacent[slot, i, w])
        return total

    @wp.func
    def list_rows(g: Graph, slot: int, n: int, words: int, lane: int) -> bool:
        """row and column from the bits, columns ascending; False where there is no room for them."""
        for i in range(lane, n, wp.block_dim()):
            g.degree[slot, i] = count(g, slot, i, words)
        sync()
        if lane == 0:
            total = int(0)
            for i in range(n):
                g.row[slot, i] = total
                total += g.degree[slot, i]
            g.row[slot, n] = total
        sync()
        if g.row[slot, n] > g.column.shape[1]:
            return False
        for i in range(lane, n, wp.block_dim()):
            e = g.row[slot, i]
            for w in range(words):
                bits = g.adjacent[slot, i, w]
                while bits != wp.uint32(0):
                    rest = bits & (bits - wp.uint32(1))  # without its lowest bit
                    g.column[slot, e] = WORD * w + wp.bit_count((bits ^ rest) - wp.uint32(1))
                    e += 1
                    bits = rest
        sync()
        return True

    @wp.func
    def eliminate(g: Graph, slot: int, n: int, words: int, lane: int):
        """Order by minimum degree; row i of the bits becomes the neighbours of i when its turn came."""
        least = int(0)  # no degree is less: elimination takes one neighbour and gives those that are left
        for s in range(n):
            best = int(-1)
            i = int(0)
            while i < n and (best < 0 or g.degree[slot, best] > least):
                d = g.degree[slot, i]
                if d >= 0 and (best < 0 or d < g.degree[slot, best]):
                    best = i
                i += 1
            least = wp.max(g.degree[slot, best] - 1, 0)
            sync()
            if lane == 0:
                g.order[slot, s] = best
                g.step[slot, best] = s
                g.degree[slot, best] = -1
            for ww in range(words):
                bits = g.adjacent[slot, best, ww]
                if bits != wp.uint32(0):
                    for b in range(lane, WORD, wp.block_dim()):
                        if (bits >> wp.uint32(b)) & wp.uint32(1) != wp.uint32(0):
                            j = WORD * ww + b
                            for w in range(words):
                                g.adjacent[slot, j, w] = g.adjacent[slot, j, w] | g.adjacent[slot, best, w]
                            disconnect(g, slot, j, j)
                            disconnect(g, slot, j, best)
                            g.degree[slot, j] = count(g, slot, j, words)
            sync()

    @wp.func
    def analyse(g: Graph, slot: int, n: int, lane: int) -> bool:
        """Pattern and order from the bits (which are used up); then block and diagonal can be written.

        Returns False where the workspace has no room for the blocks.
        """
        words = (n + WORD - 1) // WORD
        if not list_rows(g, slot, n, words, lane):
            return False
        eliminate(g, slot, n, words, lane)
        if lane == 0:
            total = int(0)
            for s in range(n):
                g.fill[slot, s] = total
                total += count(g, slot, g.order[slot, s], words)
            g.fill[slot, n] = total
        sync()
        if g.fill[slot, n] > g.later.shape[1]:
            return False
        for s in range(lane, n, wp.block_dim()):
            e = g.fill[slot, s]
            for later in range(s + 1, n):
                if is_neighbour(g, slot, g.order[slot, s], g.order[slot, later]):
                    g.later[slot, e] = later
                    e += 1
        sync()
        for i in range(lane, n, wp.block_dim()):
            for e in range(g.row[slot, i], g.row[slot, i + 1]):
                s = g.step[slot, i]
                later = g.step[slot, g.column[slot, e]]
                first = wp.min(s, later)
                f = g.fill[slot, first]
                while g.later[slot, f] != wp.max(s, later):
                    f += 1
                if s < later:
                    g.target[slot, e] = f
                else:
                    g.target[slot, e] = -1 - f
        sync()
        return True

    @wp.func
    def clear_factors(g: Graph, slot: int, n: int, lane: int):
        """Zero the blocks of the factors: those that fill in start so."""
        for e in range(lane, g.fill[slot, n], wp.block_dim()):
            g.lower[slot, e] = matrix()
            g.upper[slot, e] = matrix()
        sync()

    @wp.func
    def inverse(a: matrix, n: int) -> matrix:
        """Inverse of a block by elimination with row pivoting; zero along directions in which it is singular.

        Cofactors (wp.inverse) lose all digits where two of three directions are nearly free. n is the size: as an argument it
        keeps loops from being unrolled.
        """
        b = wp.identity(n=size, dtype=real)
        for k in range(n):
            r = int(k)
            for i in range(k + 1, n):
                if wp.abs(a[i, k]) > wp.abs(a[r, k]):
                    r = i
            p = real(0.0)
            if a[r, k] != real(0.0):
                p = real(1.0) / a[r, k]
            for j in range(n):
                x = p * a[r, j]
                a[r, j] = a[k, j]
                a[k, j] = x
                y = p * b[r, j]
                b[r, j] = b[k, j]
                b[k, j] = y
            for i in range(n):
                if i != k:
                    f = a[i, k]
                    if f != real(0.0):
                        for j in range(n):
                            a[i, j] = a[i, j] - f * a[k, j]
                            b[i, j] = b[i, j] - f * b[k, j]
        return b

    # Bounds of the loops below are static: Warp unrolls no loop that starts at k + 1.

    @wp.func
    def lower_upper(a: matrix) -> matrix:
        """L and U of a block in one matrix: L below the diagonal, U above, 1 / U_kk on it."""
        for k in range(size):
            a[k, k] = real(1.0) / a[k, k]
            for i in range(wp.static(k + 1), size):
                f = a[i, k] * a[k, k]
                a[i, k] = f
                for j in range(wp.static(k + 1), size):
                    a[i, j] = a[i, j] - f * a[k, j]
        return a

    @wp.func
    def divided(x: matrix, lu: matrix, n: int) -> matrix:
        """X (L U)^-1, row by row; n is the size: as an argument it keeps the rows from being unrolled."""
        for i in range(n):
            y = x[i]
            for k in range(size):
                t = y[k]
                for j in range(k):
                    t -= y[j] * lu[j, k]
                y[k] = t * lu[k, k]
            for k in range(wp.static(size - 1), -1, -1):
                t = y[k]
                for j in range(wp.static(k + 1), size):
                    t -= y[j] * lu[j, k]
                y[k] = t
            x[i] = y
        return x

    @wp.func
    def block_solve(lu: matrix, y: vector) -> vector:
        """(L U)^-1 y."""
        for i in range(size):
            t = y[i]
            for j in range(i):
                t -= lu[i, j] * y[j]
            y[i] = t
        for i in range(wp.static(size - 1), -1, -1):
            t = y[i]
            for j in range(wp.static(i + 1), size):
                t -= lu[i, j] * y[j]
            y[i] = t * lu[i, i]
        return y

    @wp.func
    def factorise(g: Graph, slot: int, n: int, lane: int):
        """L U of the matrix in pivot, lower and upper, in place, step by step (right-looking)."""
        for s in range(n):
            if lane == 0:
                if wp.static(size == 3):
                    g.pivot[slot, s] = inverse(g.pivot[slot, s], size)
                else:
                    g.pivot[slot, s] = lower_upper(g.pivot[slot, s])
            sync()
            begin = g.fill[slot, s]
            end = g.fill[slot, s + 1]
            for e in range(begin + lane, end, wp.block_dim()):
                if wp.static(size == 3):
                    g.lower[slot, e] = g.lower[slot, e] * g.pivot[slot, s]
                else:
                    g.lower[slot, e] = divided(g.lower[slot, e], g.pivot[slot, s], size)
            sync()
            for e in range(begin + lane, end, wp.block_dim()):
                i = g.later[slot, e]
                left = g.lower[slot, e]
                right = g.upper[slot, e]
                g.pivot[slot, i] = g.pivot[slot, i] - left * right
                target = g.fill[slot, i]
                for f in range(e + 1, end):
                    while g.later[slot, target] < g.later[slot, f]:
                        target += 1
                    g.upper[slot, target] = g.upper[slot, target] - left * g.upper[slot, f]
                    g.lower[slot, target] = g.lower[slot, target] - g.lower[slot, f] * right
            sync()

    @wp.func
    def solve(g: Graph, slot: int, n: int, x: wp.array2d(dtype=vector), y: wp.array2d(dtype=vector), lane: int):
        """x := A^-1 x with the factors; y [P, n] is scratch."""
        for i in range(lane, n, wp.block_dim()):
            y[slot, g.step[slot, i]] = x[slot, i]
        sync()
        for s in range(n):
            for e in range(g.fill[slot, s] + lane, g.fill[slot, s + 1], wp.block_dim()):
                i = g.later[slot, e]
                y[slot, i] = y[slot, i] - g.lower[slot, e] * y[slot, s]
            sync()
        if lane == 0:
            for ss in range(n):
                s = n - 1 - ss
                total = y[slot, s]
                for e in range(g.fill[slot, s], g.fill[slot, s + 1]):
                    total -= g.upper[slot, e] * y[slot, g.later[slot, e]]
                if wp.static(size == 3):
                    y[slot, s] = g.pivot[slot, s] * total
                else:
                    y[slot, s] = block_solve(g.pivot[slot, s], total)
        sync()
        for i in range(lane, n, wp.block_dim()):
            x[slot, i] = y[slot, g.step[slot, i]]
        sync()

    return SimpleNamespace(
        Graph=Graph,
        clear=clear,
        connect=connect,
        complete=complete,
        analyse=analyse,
        clear_factors=clear_factors,
        factorise=factorise,
        solve=solve,
    )
