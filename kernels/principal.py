# SPDX-License-Identifier: Apache-2.0
"""Principal pivoting on dense LCPs with bounds: Murty's least-index method and Júdice and Pires' block method.

Both guess which unknowns are between their bounds (the basis), solve w = 0 for these with the others at their bounds, and
move what comes out on the wrong side. Murty (1974) moves the one with the least index: finite on P-matrices, slow. Júdice and
Pires (1992, the paper's ref. 10) move all at once, which takes a few solves but may cycle: where the number of wrong ones has
not become less for TRIES solves, Murty's steps take over until it does.

Every basis is factorised anew from the original numbers, so accuracy does not wear off. Where a basis is singular, a block step
leaves the unknowns that depend on others at their bounds, a single step puts 1e-6 in the place of the vanishing pivot: the
solution then is large and shows which unknown has to enter next to it. On matrices that are no P-matrices Murty's order cycles
too; the cycle is detected (states equal to those at a power of two steps ago, Brent) and from then on whichever is wrong and comes
next after the one moved last is moved (least recently considered). Problems that end nowhere stop at the limit.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import problem
from .problem import BETWEEN, LOWER, UPPER
from .types import ITERATION_LIMIT, sync

# Block steps that may fail to reduce the number of wrong unknowns before single steps take over.
TRIES = 5


@functools.cache
def functions(real) -> SimpleNamespace:
    """The functions ``murty`` and ``judice_pires``: solve the problem in a workspace; (status bits, bases solved)."""
    double = real is wp.float64
    # Of scaled z relative to the largest, and of w relative to the sum it is made of: less than this has no sign.
    sign_tolerance = real(1.0e-12) if double else real(1.0e-5)
    tiny_pivot = real(1.0e-12) if double else real(1.0e-5)
    substitute_pivot = real(1.0e-6) if double else real(1.0e-3)
    shared = problem.functions(real)
    LcpWorkspace, equilibrate, solve_basis = shared.LcpWorkspace, shared.equilibrate, shared.solve_basis

    @wp.func
    def judge(ws: LcpWorkspace, slot: int, n: int, lane: int) -> int:
        """Which unknowns are on the wrong side and should go where, in ws.wrong; returns their number."""
        largest = real(0.0)
        for i in range(n):
            largest = wp.max(largest, wp.abs(ws.x[slot, i]) / ws.column_scale[slot, i])
        for i in range(lane, n, wp.block_dim()):
            state = ws.state[slot, i]
            low = ws.lower[slot, i]
            high = ws.upper[slot, i]
            to = int(-1)
            if state == BETWEEN:
                margin = sign_tolerance * largest * ws.column_scale[slot, i]
                if ws.x[slot, i] < low - margin:
                    to = LOWER
                elif ws.x[slot, i] > high + margin:
                    to = UPPER
            elif low < high:
                w = ws.q[slot, i]
                size = wp.abs(w)
                for j in range(n):
                    term = ws.M[slot, i, j] * ws.x[slot, j]
                    w += term
                    size += wp.abs(term)
                if state == LOWER:
                    w = -w
                if w > sign_tolerance * size:
                    to = BETWEEN
            ws.wrong[slot, i] = to
        sync()
        number = int(0)
        for i in range(n):
            if ws.wrong[slot, i] >= 0:
                number += 1
        return number

    @wp.func
    def select_one(ws: LcpWorkspace, slot: int, n: int, after: int) -> int:
        """The first unknown on the wrong side, in cyclic order, after one of them (-1: from the start)."""
        best = int(0)
        nearest = int(n)
        for i in range(n):
            if ws.wrong[slot, i] >= 0:
                distance = (i - after - 1 + n) % n
                if distance < nearest:
                    nearest = distance
                    best = i
        return best

    @wp.func
    def remember(ws: LcpWorkspace, slot: int, n: int, lane: int):
        for i in range(lane, n, wp.block_dim()):
            ws.seen[slot, i] = ws.state[slot, i]

    @wp.func
    def were_here(ws: LcpWorkspace, slot: int, n: int) -> bool:
        same = bool(True)
        for i in range(n):
            same = same and ws.seen[slot, i] == ws.state[slot, i]
        return same

    @wp.func
    def principal(ws: LcpWorkspace, slot: int, n: int, tries: int, limit: int, lane: int) -> wp.vec2i:
        """Block steps while they help or `tries` have not, then single ones; tries = 0: single ones only."""
        equilibrate(ws, slot, n, lane)
        for i in range(lane, n, wp.block_dim()):
            ws.state[slot, i] = LOWER
            if not wp.isfinite(ws.lower[slot, i]):
                ws.state[slot, i] = BETWEEN
                if wp.isfinite(ws.upper[slot, i]):
                    ws.state[slot, i] = UPPER
        sync()
        status = int(ITERATION_LIMIT)
        iterations = int(0)
        fewest = int(n + 1)
        left = int(tries)
        block = bool(tries > 0)
        steps = int(0)  # single ones in a row
        in_turn = bool(False)
        last = int(-1)
        searching = bool(True)
        while searching:
            substitute = substitute_pivot
            if block:
                substitute = real(0.0)
            solve_basis(ws, slot, n, tiny_pivot, substitute, lane)
            iterations += 1
            number = judge(ws, slot, n, lane)
            if number <= fewest:  # the answer, or the best there is if none is found
                for i in range(lane, n, wp.block_dim()):
                    ws.z[slot, i] = wp.min(wp.max(ws.x[slot, i], ws.lower[slot, i]), ws.upper[slot, i])
            if number == 0:
                status = 0
                searching = False
            elif iterations >= limit:
                searching = False
            else:
                block = tries > 0 and (number < fewest or left > 0)
                if number < fewest:
                    left = tries
                elif left > 0:
                    left -= 1
                fewest = wp.min(fewest, number)
                if block:
                    steps = 0
                    for i in range(lane, n, wp.block_dim()):
                        if ws.wrong[slot, i] >= 0:
                            ws.state[slot, i] = ws.wrong[slot, i]
                else:
                    if steps > 0 and were_here(ws, slot, n):
                        in_turn = True
                    sync()  # lanes that still compare would see what others remember
                    if (steps & (steps - 1)) == 0:
                        remember(ws, slot, n, lane)
                    steps += 1
                    if not in_turn:
                        last = -1
                    last = select_one(ws, slot, n, last)
                    sync()
                    if lane == 0:
                        ws.state[slot, last] = ws.wrong[slot, last]
                sync()
        sync()
        return wp.vec2i(status, iterations)

    @wp.func
    def murty(ws: LcpWorkspace, slot: int, n: int, limit: int, lane: int) -> wp.vec2i:
        return principal(ws, slot, n, 0, limit, lane)

    @wp.func
    def judice_pires(ws: LcpWorkspace, slot: int, n: int, limit: int, lane: int) -> wp.vec2i:
        return principal(ws, slot, n, TRIES, limit, lane)

    return SimpleNamespace(murty=murty, judice_pires=judice_pires)
