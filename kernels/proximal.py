# SPDX-License-Identifier: Apache-2.0
"""Proximal semismooth Newton on contact problems  u = W p + q,  p = pi(p - rho u)  (kernels/friction.py), any law, any W.

For the impulses p of all contacts, rho = 1 / W_ii of each contact (one number for its normal, one for its tangents),

    F(p) = p - pi(x),    x = p - rho (W p + q) - alpha (p - c).

alpha = 0 is the problem; alpha > 0 holds p near the centre c, which makes the equations regular however redundant the contacts
are (proximal point method). A Newton step solves

    (1 - D + D (rho W + alpha)) dp = -F,    D in the generalised derivative of pi at x,

a block-sparse system (kernels/sparse.py), and is shortened until sum F^2 / rho falls. Once it has fallen to a tenth, c moves to
p and alpha shrinks with it, so that the end is Newton's method on the problem itself. Where a step cannot be found alpha grows
and a few sweeps of block Gauss-Seidel take p elsewhere. The start is what Gauss-Seidel reaches in a few sweeps.

Sources: Alart and Curnier 1991 (F and its Newton's method); proximal point around it: Acary, Bremond and Huber 2018.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import friction, sparse
from .types import ITERATION_LIMIT, scalar_types, sync

# Sweeps of Gauss-Seidel where Newton's method stalls.
RESTART_SWEEPS = 5
# Newton steps around one centre.
CENTRE_STEPS = 20
# Centres in a row that do not halve the error: a problem without solution, or close to the target round-off.
MOST_STALLS = 30
MOST_STALLS_AT_END = 6
# A step is halved so many times.
HALVINGS = 7


@functools.cache
def functions(real) -> SimpleNamespace:
    """Bundle ``ContactProblem`` and the function ``proximal_newton``."""
    t = scalar_types(real)
    vec2, vec3 = t.vec2, t.vec3
    double = real is wp.float64
    alpha_start = real(1.0e-3)
    alpha_least = real(1.0e-9) if double else real(1.0e-5)
    law = friction.functions(real)
    admissible, slope = law.admissible, law.slope
    s = sparse.functions(real)
    Graph, clear_factors, factorise, solve = s.Graph, s.clear_factors, s.factorise, s.solve

    @wp.struct
    class ContactProblem:
        """One contact problem in each of P workspaces; W is in Graph.diagonal and Graph.block."""

        free: wp.array2d(dtype=vec3)  # [P, n] q, m/s
        mu: wp.array2d(dtype=vec2)  # [P, n]
        bound: wp.array2d(dtype=vec2)  # [P, n] N s
        directions: wp.array2d(dtype=int)  # [P, n] admissible set, kernels/friction.py
        rho: wp.array2d(dtype=vec3)  # [P, n] kg
        impulse: wp.array2d(dtype=vec3)  # [P, n] p, N s
        velocity: wp.array2d(dtype=vec3)  # [P, n] u = W p + q, m/s
        centre: wp.array2d(dtype=vec3)  # [P, n]
        best: wp.array2d(dtype=vec3)  # [P, n] p with the least F so far
        step: wp.array2d(dtype=vec3)  # [P, n] dp
        change: wp.array2d(dtype=vec3)  # [P, n] W dp; scratch of the linear solver
        error: wp.array2d(dtype=real)  # [P, n] F^2 / rho of each contact, J

    @wp.func
    def product(g: Graph, slot: int, n: int, x: wp.array2d(dtype=vec3), y: wp.array2d(dtype=vec3), lane: int):
        """y := W x."""
        for i in range(lane, n, wp.block_dim()):
            total = g.diagonal[slot, i] * x[slot, i]
            for e in range(g.row[slot, i], g.row[slot, i + 1]):
                total += g.block[slot, e] * x[slot, g.column[slot, e]]
            y[slot, i] = total
        sync()

    @wp.func
    def argument(c: ContactProblem, slot: int, i: int, alpha: real) -> vec3:
        """x of contact i."""
        p = c.impulse[slot, i]
        return p - wp.cw_mul(c.rho[slot, i], c.velocity[slot, i]) - alpha * (p - c.centre[slot, i])

    @wp.func
    def merit(c: ContactProblem, slot: int, n: int, alpha: real, s: real, lane: int) -> real:
        """sqrt(sum F^2 / rho) after the part s of the step."""
        for i in range(lane, n, wp.block_dim()):
            p = c.impulse[slot, i] + s * c.step[slot, i]
            u = c.velocity[slot, i] + s * c.change[slot, i]
            rho = c.rho[slot, i]
            x = p - wp.cw_mul(rho, u) - alpha * (p - c.centre[slot, i])
            f = p - admissible(x, c.mu[slot, i], c.bound[slot, i], c.directions[slot, i])
            c.error[slot, i] = wp.dot(wp.cw_div(f, rho), f)
        sync()
        total = real(0.0)
        for i in range(n):
            total += c.error[slot, i]
        sync()
        return wp.sqrt(total)

    @wp.func
    def settle(g: Graph, c: ContactProblem, slot: int, n: int, lane: int) -> real:
        """u and F of the present p, no proximal term, no step."""
        product(g, slot, n, c.impulse, c.velocity, lane)
        for i in range(lane, n, wp.block_dim()):
            c.velocity[slot, i] = c.velocity[slot, i] + c.free[slot, i]
            c.step[slot, i] = vec3()
            c.change[slot, i] = vec3()
            c.centre[slot, i] = c.impulse[slot, i]
        sync()
        return merit(c, slot, n, real(0.0), real(0.0), lane)

    @wp.func
    def gauss_seidel(g: Graph, c: ContactProblem, slot: int, n: int, sweeps: int, least: real, lane: int) -> int:
        """Sweeps over the contacts, each takes pi(p - rho u) at once, until sqrt(sum dp^2 / rho) <= least; returns their number.

        One lane, because the order matters.
        """
        if lane == 0:
            done = int(0)
            change = real(1.0e30)
            while done < sweeps and change > least * least:
                change = real(0.0)
                for i in range(n):
                    p = c.impulse[slot, i]
                    rho = c.rho[slot, i]
                    u = c.free[slot, i] + g.diagonal[slot, i] * p
                    for e in range(g.row[slot, i], g.row[slot, i + 1]):
                        u += g.block[slot, e] * c.impulse[slot, g.column[slot, e]]
                    after = admissible(p - wp.cw_mul(rho, u), c.mu[slot, i], c.bound[slot, i], c.directions[slot, i])
                    change += wp.dot(after - p, wp.cw_div(after - p, rho))
                    c.impulse[slot, i] = after
                done += 1
            c.error[slot, 0] = real(done)
        sync()
        return int(c.error[slot, 0])

    @wp.func
    def newton_step(g: Graph, c: ContactProblem, slot: int, n: int, alpha: real, lane: int):
        """step := dp, change := W dp."""
        clear_factors(g, slot, n, lane)
        for i in range(lane, n, wp.block_dim()):
            x = argument(c, slot, i, alpha)
            rho = c.rho[slot, i]
            mu = c.mu[slot, i]
            bound = c.bound[slot, i]
            k = c.directions[slot, i]
            d = slope(x, mu, bound, k)
            c.step[slot, i] = admissible(x, mu, bound, k) - c.impulse[slot, i]
            scaled = d * wp.diag(rho)
            g.pivot[slot, g.step[slot, i]] = wp.identity(n=3, dtype=real) - (real(1.0) - alpha) * d + scaled * g.diagonal[slot, i]
            for e in range(g.row[slot, i], g.row[slot, i + 1]):
                target = g.target[slot, e]
                if target >= 0:
                    g.upper[slot, target] = scaled * g.block[slot, e]
                else:
                    g.lower[slot, -1 - target] = scaled * g.block[slot, e]
        sync()
        factorise(g, slot, n, lane)
        solve(g, slot, n, c.step, c.change, lane)
        product(g, slot, n, c.step, c.change, lane)

    @wp.func
    def advance(c: ContactProblem, slot: int, n: int, s: real, lane: int):
        """p and u after the part s of the step."""
        for i in range(lane, n, wp.block_dim()):
            c.impulse[slot, i] = c.impulse[slot, i] + s * c.step[slot, i]
            c.velocity[slot, i] = c.velocity[slot, i] + s * c.change[slot, i]
        sync()

    @wp.func
    def proximal_newton(g: Graph, c: ContactProblem, slot: int, n: int, target: real, sweeps: int, limit: int, lane: int) -> wp.vec2i:
        """Solve from the p in c.impulse; returns (status bits, sweeps and factorisations).

        Done when sum F^2 / rho has fallen to target^2 times what no impulse leaves. The best p found is left in c.impulse.
        """
        size = real(0.0)
        for i in range(n):
            size += wp.dot(c.free[slot, i], wp.cw_mul(c.rho[slot, i], c.free[slot, i]))
        target = target * wp.sqrt(size)
        least = real(1.0e30)
        alpha = alpha_start
        stalls = int(0)
        steps = int(0)
        status = int(0)
        searching = bool(True)
        todo = int(sweeps)
        while searching:
            # Each function is called in one place: Warp's compilers inline them all.
            steps += gauss_seidel(g, c, slot, n, todo, real(0.1) * target, lane)
            error = settle(g, c, slot, n, lane)
            stalls += 1
            if error < real(0.5) * least:
                stalls = 0
            if error < least:
                least = error
                for i in range(lane, n, wp.block_dim()):
                    c.best[slot, i] = c.impulse[slot, i]
                sync()
            at_end = least < real(100.0) * target and stalls >= MOST_STALLS_AT_END
            if error <= target:
                searching = False
            elif steps >= sweeps + limit or stalls >= MOST_STALLS or at_end:
                status = ITERATION_LIMIT
                searching = False
            else:
                goal = real(0.1) * error
                inner = int(0)
                descends = bool(True)
                while descends and error > goal and inner < CENTRE_STEPS:
                    newton_step(g, c, slot, n, alpha, lane)
                    steps += 1
                    inner += 1
                    s = real(1.0)
                    descends = bool(False)
                    halvings = int(0)
                    while not descends and halvings < HALVINGS:
                        trial = merit(c, slot, n, alpha, s, lane)
                        if trial < (real(1.0) - real(1.0e-4) * s) * error:
                            descends = True
                            error = trial
                            advance(c, slot, n, s, lane)
                        else:
                            s = real(0.5) * s
                            halvings += 1
                todo = 0
                if not descends:
                    alpha = wp.min(real(10.0) * alpha, real(1.0e3))
                    todo = RESTART_SWEEPS
                elif inner <= 6:
                    alpha = wp.max(real(0.2) * alpha, alpha_least)
                elif inner > 15:
                    alpha = real(3.0) * alpha
        for i in range(lane, n, wp.block_dim()):
            c.impulse[slot, i] = c.best[slot, i]
        sync()
        return wp.vec2i(status, steps)

    return SimpleNamespace(
        Graph=Graph,
        clear=s.clear,
        connect=s.connect,
        analyse=s.analyse,
        ContactProblem=ContactProblem,
        proximal_newton=proximal_newton,
    )
