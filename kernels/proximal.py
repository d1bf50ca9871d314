# SPDX-License-Identifier: Apache-2.0
"""Proximal semismooth Newton on contact problems  u = W p + q,  p = pi(p - rho u)  (kernels/friction.py), any law, any W.

For the impulses p of all contacts, rho = 1 / W_ii of each contact (one number for its normal, one for its tangents),

    F(p) = p - pi(x),    x = p - gamma (rho (W p + q) + alpha (p - c)).

alpha = 0 is the problem; alpha > 0 holds p near the centre c, which makes the equations regular however redundant the contacts
are (proximal point method). A Newton step solves

    (1 - D + gamma D (rho W + alpha)) dp = -F,    D in the generalised derivative of pi at x,

a block-sparse system (kernels/sparse.py), and is shortened until sum F^2 / rho falls. Once it has fallen to a tenth, c moves to
p and alpha shrinks with it, so that the end is Newton's method on the problem itself. Where a step cannot be found alpha grows
and a few sweeps of block Gauss-Seidel take p elsewhere. The start is what Gauss-Seidel reaches in a few sweeps.

gamma > 0 has no say in the solution, only in how soon a contact is taken for open, sticking or sliding on the way: with one
value for ever some problems creep (219 factorisations for one step of the paper's box), with two, changed wherever progress is
poor, none of those recorded does (43 for that one).

Where all that fails, friction is let in by degrees: mu and the bounds times (1/16)^2, (2/16)^2, ..., 1, each problem started from
the answer of the last. Of 2000 hard random problems (benchmarks/friction/stress.py) 49 are left unsolved, 131 without.

Sources: Alart and Curnier 1991 (F and its Newton's method); proximal point around it: Acary, Bremond and Huber 2018.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import friction, sparse
from .types import ITERATION_LIMIT, scalar_types, sync

# Sweeps of Gauss-Seidel where Newton's method stalls.
RESTART_SWEEPS = 5
# gamma, and what it becomes where progress is poor.
GAMMA = 10.0
OTHER_GAMMA = 300.0
# Problems with less friction on the way to the one that failed, the last one included, and the factorisations of each.
STAGES = 16
STAGE_LIMIT = 60
# Newton steps around one centre: few, many, and the most.
FEW = 6
MANY = 15
CENTRE_STEPS = 20
# Centres in a row that do not halve the error: a problem without solution, or close to the target round-off.
MOST_STALLS = 60
MOST_STALLS_AT_END = 6
# A step is halved so many times.
HALVINGS = 7


@functools.cache
def functions(real, joints: bool = False) -> SimpleNamespace:
    """Bundle ``ContactProblem`` and the function ``proximal_newton``."""
    t = scalar_types(real)
    vec2, vec3 = t.vec2, t.vec3
    double = real is wp.float64
    alpha_start = real(1.0e-3)
    alpha_least = real(1.0e-10) if double else real(1.0e-5)
    law = friction.functions(real, joints)
    admissible, slope = law.admissible, law.slope
    s = sparse.functions(real, 3)
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
        first: wp.array2d(dtype=vec3)  # [P, n] the same of the first attempt, with all friction at once
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
    def argument(c: ContactProblem, slot: int, i: int, p: vec3, u: vec3, gamma: real, alpha: real) -> vec3:
        """x of contact i."""
        return p - gamma * (wp.cw_mul(c.rho[slot, i], u) + alpha * (p - c.centre[slot, i]))

    @wp.func
    def merit(c: ContactProblem, slot: int, n: int, share: real, gamma: real, alpha: real, s: real, lane: int) -> real:
        """sqrt(sum F^2 / rho) after the part s of the step."""
        for i in range(lane, n, wp.block_dim()):
            p = c.impulse[slot, i] + s * c.step[slot, i]
            u = c.velocity[slot, i] + s * c.change[slot, i]
            x = argument(c, slot, i, p, u, gamma, alpha)
            f = p - admissible(x, share * c.mu[slot, i], share * c.bound[slot, i], c.directions[slot, i])
            c.error[slot, i] = wp.dot(wp.cw_div(f, c.rho[slot, i]), f)
        sync()
        total = real(0.0)
        for i in range(n):
            total += c.error[slot, i]
        sync()
        return wp.sqrt(total)

    @wp.func
    def movement(c: ContactProblem, slot: int, n: int) -> real:
        """|p - c| / |p|, both weighed as F is; 0 where p and c are."""
        total = real(0.0)
        size = real(0.0)
        for i in range(n):
            p = c.impulse[slot, i]
            d = p - c.centre[slot, i]
            total += wp.dot(d, wp.cw_div(d, c.rho[slot, i]))
            size += wp.dot(p, wp.cw_div(p, c.rho[slot, i]))
        sync()
        result = real(0.0)
        if total > real(0.0):
            result = wp.sqrt(total / size)
        return result

    @wp.func
    def settle(g: Graph, c: ContactProblem, slot: int, n: int, share: real, lane: int) -> real:
        """u and F of the present p, no proximal term, no step."""
        product(g, slot, n, c.impulse, c.velocity, lane)
        for i in range(lane, n, wp.block_dim()):
            c.velocity[slot, i] = c.velocity[slot, i] + c.free[slot, i]
            c.step[slot, i] = vec3()
            c.change[slot, i] = vec3()
            c.centre[slot, i] = c.impulse[slot, i]
        sync()
        return merit(c, slot, n, share, real(1.0), real(0.0), real(0.0), lane)

    @wp.func
    def gauss_seidel(g: Graph, c: ContactProblem, slot: int, n: int, share: real, sweeps: int, least: real, lane: int) -> int:
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
                    after = admissible(p - wp.cw_mul(rho, u), share * c.mu[slot, i], share * c.bound[slot, i], c.directions[slot, i])
                    change += wp.dot(after - p, wp.cw_div(after - p, rho))
                    c.impulse[slot, i] = after
                done += 1
            c.error[slot, 0] = real(done)
        sync()
        return int(c.error[slot, 0])

    @wp.func
    def newton_step(g: Graph, c: ContactProblem, slot: int, n: int, share: real, gamma: real, alpha: real, lane: int):
        """step := dp, change := W dp."""
        clear_factors(g, slot, n, lane)
        for i in range(lane, n, wp.block_dim()):
            x = argument(c, slot, i, c.impulse[slot, i], c.velocity[slot, i], gamma, alpha)
            mu = share * c.mu[slot, i]
            bound = share * c.bound[slot, i]
            k = c.directions[slot, i]
            d = slope(x, mu, bound, k)
            c.step[slot, i] = admissible(x, mu, bound, k) - c.impulse[slot, i]
            scaled = d * wp.diag(gamma * c.rho[slot, i])
            g.pivot[slot, g.step[slot, i]] = wp.identity(n=3, dtype=real) - (real(1.0) - gamma * alpha) * d + scaled * g.diagonal[slot, i]
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
    def proximal_newton(
        g: Graph, c: ContactProblem, slot: int, n: int, target: real, rest: real, sweeps: int, limit: int, lane: int
    ) -> wp.vec2i:
        """Solve from the p in c.impulse; returns (status bits, sweeps and factorisations).

        Done when sum F^2 / rho has fallen to target^2 times what no impulse leaves, and p has moved by no more than the part
        `rest` around the last centre: where contacts are redundant a small F alone does not say that p is accurate. The best
        p found is left in c.impulse.
        """
        size = real(0.0)
        for i in range(n):
            size += wp.dot(c.free[slot, i], wp.cw_mul(c.rho[slot, i], c.free[slot, i]))
        for i in range(lane, n, wp.block_dim()):
            c.centre[slot, i] = vec3(real(1.0e30))  # none yet
            c.best[slot, i] = vec3()
        sync()
        target = target * wp.sqrt(size)
        least = real(1.0e30)
        alpha = alpha_start
        stalls = int(0)
        steps = int(0)
        status = int(0)
        searching = bool(True)
        todo = int(sweeps)
        stage = int(0)
        share = real(1.0)
        most = int(sweeps + limit)
        least_first = real(1.0e30)
        rubs = bool(False)
        for i in range(n):
            rubs = rubs or c.directions[slot, i] != 0
        gamma = real(GAMMA)
        next_gamma = real(OTHER_GAMMA)
        before = real(1.0e30)
        slow = bool(False)
        inner = int(0)
        while searching:
            # Each function is called in one place: Warp's compilers inline them all.
            steps += gauss_seidel(g, c, slot, n, share, todo, real(0.1) * target, lane)
            moved = movement(c, slot, n)
            error = settle(g, c, slot, n, share, lane)
            if slow or (inner > FEW and error > real(0.5) * before):
                other = gamma
                gamma = next_gamma
                next_gamma = other
            stalls += 1
            if error < real(0.5) * least:
                stalls = 0
            if error < least or (error <= target and moved <= rest):
                least = error
                for i in range(lane, n, wp.block_dim()):
                    c.best[slot, i] = c.impulse[slot, i]
                sync()
            at_end = least < real(100.0) * target and stalls >= MOST_STALLS_AT_END
            done = error <= target and (moved <= rest or stalls >= MOST_STALLS_AT_END)  # p may move by round-off
            failed = not done and (limit == 0 or steps >= most or stalls >= MOST_STALLS or at_end)
            if done and (stage == 0 or stage == STAGES):
                searching = False
            elif failed and (stage == STAGES or at_end or not rubs or limit == 0):
                status = ITERATION_LIMIT
                searching = False
            elif done or failed:
                # The next share of friction: from nothing where all of it at once has failed, else from the last answer.
                for i in range(lane, n, wp.block_dim()):
                    if stage == 0:
                        c.first[slot, i] = c.best[slot, i]
                        c.impulse[slot, i] = vec3()
                    else:
                        c.impulse[slot, i] = c.best[slot, i]
                    c.centre[slot, i] = vec3(real(1.0e30))
                sync()
                todo = 0
                if stage == 0:
                    least_first = least
                    todo = sweeps
                stage += 1
                share = real(stage * stage) / real(STAGES * STAGES)
                most = steps + STAGE_LIMIT
                if stage == STAGES:
                    most = steps + limit
                least = real(1.0e30)
                alpha = alpha_start
                stalls = 0
                slow = bool(False)
                inner = int(0)
                before = real(1.0e30)
            else:
                before = error
                goal = real(0.0)
                inner = int(-1)  # the first round only measures F for this gamma
                descends = bool(True)
                while descends and inner < CENTRE_STEPS and (inner < 0 or error > goal):
                    length = real(0.0)
                    if inner >= 0:
                        newton_step(g, c, slot, n, share, gamma, alpha, lane)
                        steps += 1
                        length = real(1.0)
                    descends = bool(False)
                    halvings = int(0)
                    while not descends and halvings < HALVINGS:
                        trial = merit(c, slot, n, share, gamma, alpha, length, lane)
                        if inner < 0 or trial < (real(1.0) - real(1.0e-4) * length) * error:
                            descends = bool(True)
                            error = trial
                            advance(c, slot, n, length, lane)
                        else:
                            length = real(0.5) * length
                            halvings += 1
                    if inner < 0:
                        goal = real(0.1) * error
                    inner += 1
                todo = 0
                if not descends:
                    alpha = wp.min(real(10.0) * alpha, real(1.0e3))
                    todo = RESTART_SWEEPS
                elif inner <= FEW:
                    alpha = wp.max(real(0.2) * alpha, alpha_least)
                elif inner > MANY:
                    alpha = real(3.0) * alpha
                slow = not descends or inner > MANY
        for i in range(lane, n, wp.block_dim()):
            c.impulse[slot, i] = c.best[slot, i]
            if status != 0 and stage > 0 and least_first < least:
                c.impulse[slot, i] = c.first[slot, i]
        sync()
        return wp.vec2i(status, steps)

    return SimpleNamespace(
        Graph=Graph,
        clear=s.clear,
        connect=s.connect,
        complete=s.complete,
        analyse=s.analyse,
        ContactProblem=ContactProblem,
        proximal_newton=proximal_newton,
    )
