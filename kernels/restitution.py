# SPDX-License-Identifier: Apache-2.0
"""Newton's restitution: u_n+ >= -e u_n-, and less of it where all of it would raise the energy. Only in models with e > 0.

``bounce`` shifts the rows of the contacts that bounce in this step. With friction, or where several contacts act on a body,
Newton's law can return more energy than came in (Kane's paradox), so ``judge`` looks at the work of the impulses,

    W = sum p . (u+ + u-) / 2,

the energy that they add to the motion, in velocities relative to the surfaces, so that what a belt or a kinematic body gives
by moving is not counted. Nor is the speed s at which overlaps that do not bounce are pushed apart: u_n+ - s stands for u_n+
there. Where W > 0 it has the environment solved again with theta e for 0 <= theta <= 1: for theta = 0 first, then by
interpolation for the largest theta that adds nothing. W is a quadratic in theta as long as no contact changes its state, so
the third point gives the answer. Environments that are done are not listed for it; where all are done, which is the rule, none
of this is launched.

Both -e u_n- and W look at u- at the start of the step, not at u_free. With M (v_free - v) = h f and constant f, Euler's rule
keeps E + h f . v / 2, whose change by impulses is W exactly; so is that of E by the midpoint rule. With u_free in W a box could
gain h |p| |g| / 2 an impact.
"""

from types import SimpleNamespace

import warp as wp

from .contacts import combined_by
from .declare import factory, kernel
from .types import RESTITUTION_REDUCED, SLIDE, scalar_types

# A contact bounces where it approaches faster than this times the speed that the step adds to its approach (|g| h at least).
# Slower ones would never come to rest; a ball does so with 0.5 and more (theory.md).
RESTING_STEPS = wp.constant(2.0)
# Solves that an environment may take beyond the first: theta = 0, three to find theta, one to apply it.
EXTRA_SOLVES = 5
# Each theta tried is at least this part of the bracket inside it.
INSIDE = wp.constant(1.0e-3)

# What the answer in hand was solved for; an environment that is done stays as it is, certified or not.
DONE = wp.constant(0)
ALL = wp.constant(1)  # theta = 1
NONE = wp.constant(2)  # theta = 0
SEARCH = wp.constant(3)
APPLY = wp.constant(4)  # the theta to stay with


@factory
def make(real) -> SimpleNamespace:
    """Bundle ``Bounces`` and kernels ``bounce`` (dim E, R), ``judge`` and ``settle`` (dim E)."""
    t = scalar_types(real)
    combined = combined_by(real)
    vec2, vec3 = t.vec2, t.vec3
    Contacts, Parameters, Topology = t.Contacts, t.Parameters, t.Topology

    @wp.struct
    class Bounces:
        """E environments, R contacts, S shapes. Points are (theta, W less what is allowed [J])."""

        coefficient: wp.array2d(dtype=real)  # [1|E, S] e of each shape
        combine: wp.array(dtype=int)  # [P | 0] how a pair's two become one; none: all by their mean
        kick: wp.array2d(dtype=real)  # [E, R] what theta = 1 adds to the shift of the normal row, not positive, m/s
        before: wp.array2d(dtype=vec3)  # [E, R] u- in the contact frame, m/s
        stage: wp.array(dtype=int)  # [E]
        theta: wp.array(dtype=real)  # [E] of the present rows
        slack: wp.array(dtype=real)  # [E] J, half of what W may exceed by
        allowed: wp.array(dtype=real)  # [E] J, work that the impulses do without restitution, plus slack
        low: wp.array(dtype=vec2)  # [E] largest theta known to add no energy
        high: wp.array(dtype=vec2)  # [E] smallest known to add some
        status: wp.array(dtype=int)  # [E] status bits of the solve in hand
        todo: wp.array(dtype=int)  # [E] environments that have to be solved again...
        again: wp.array(dtype=int)  # [1] ... and their number

    @kernel()
    def bounce(
        topology: Topology,
        parameters: Parameters,
        h: real,
        tolerance: real,
        midpoint: int,
        contacts: Contacts,
        bounces: Bounces,
        stride: int,
    ):
        """After contact_rows, which leaves contacts.velocity as it was at the start of the step, in world axes.

        An open gap bounces where free motion would close it in this step, and bounces from where it is: the impact is early
        by a part of a step. With Euler's rule that is as it should be, -e u_n- keeps the energy that the rule itself keeps.
        The midpoint rule moves by the mean of u- and u+ where that closes no gap, and by u+ otherwise (kernels/integrate.py);
        then gravity has slowed nothing on the way h u+, so u_n+ is less by what gravity adds in a step.
        """
        start, i = wp.tid()
        for env in range(start, contacts.count.shape[0], stride):
            if i >= contacts.count[env]:
                continue
            if contacts.slot[env, i] < 0:  # a row of a joint
                bounces.kick[env, i] = real(0.0)
                bounces.before[env, i] = vec3()
                continue
            pair = topology.slot_pair[contacts.slot[env, i]]
            row = env % bounces.coefficient.shape[0]
            e = real(0.5) * (bounces.coefficient[row, topology.pairs[pair, 0]] + bounces.coefficient[row, topology.pairs[pair, 1]])
            if bounces.combine.shape[0] > 0:
                e_a = bounces.coefficient[row, topology.pairs[pair, 0]]
                e = combined(bounces.combine[pair], e_a, bounces.coefficient[row, topology.pairs[pair, 1]])
            free = contacts.free[env, i]
            shift = contacts.shift[env, i]
            frame = contacts.frame[env, i]
            before = frame * contacts.velocity[env, i]
            u_n = before[0]
            gain = free[0] - shift[0] - u_n  # of free motion in this step
            fall = h * wp.length(parameters.gravity[env % parameters.gravity.shape[0]])
            threshold = real(RESTING_STEPS) * wp.max(fall, -gain) + tolerance
            kick = real(0.0)
            if e > real(0.0) and free[0] < real(0.0) and u_n < -threshold:
                target = -e * u_n
                if midpoint != 0 and contacts.gap[env, i] < real(0.5) * h * (e - real(1.0)) * u_n:
                    target += gain
                kick = wp.min(-target - shift[0], real(0.0))
                shift[0] += kick
                free[0] += kick
                contacts.shift[env, i] = shift
                contacts.free[env, i] = free
            bounces.kick[env, i] = kick
            bounces.before[env, i] = before

    @wp.func
    def root(low: vec2, high: vec2, third: vec2) -> real:
        """Where the parabola through three points, or the line through two, crosses zero between low and high."""
        width = high[0] - low[0]
        slope = (high[1] - low[1]) / width
        curvature = real(0.0)
        if third[0] >= real(0.0):
            curvature = ((third[1] - high[1]) / (third[0] - high[0]) - slope) / (third[0] - low[0])
        b = slope - curvature * width
        s = -real(2.0) * low[1] / (b + wp.sqrt(wp.max(b * b - real(4.0) * curvature * low[1], real(0.0))))
        if not wp.isfinite(s):
            s = real(0.5) * width
        return low[0] + wp.clamp(s, real(INSIDE) * width, (real(1.0) - real(INSIDE)) * width)

    @wp.func
    def work(
        shift: wp.array2d(dtype=vec3),
        free: wp.array2d(dtype=vec3),
        gap: wp.array2d(dtype=real),
        impulse: wp.array2d(dtype=vec3),
        kick: wp.array2d(dtype=real),
        before: wp.array2d(dtype=vec3),
        after: wp.array2d(dtype=vec3),
        slot: wp.array2d(dtype=int),
        env: int,
        count: int,
        h: real,
        midpoint: int,
    ):
        """W [J], and sum |p| [N s].

        Where the midpoint rule moves by u+ alone, E rises by another p . (u- - u_free) / 2: gravity slows nothing on that way.
        """
        total = real(0.0)
        size = real(0.0)
        for i in range(count):
            if slot[env, i] < 0:  # a row of a joint: what a drive does is no rebound
                continue
            p = impulse[env, i]
            u = before[env, i]
            mean = real(0.5) * (u + after[env, i])
            if midpoint != 0 and gap[env, i] + h * mean[0] < real(0.0):
                mean += real(0.5) * (u - (free[env, i] - shift[env, i]))
            if kick[env, i] == real(0.0):
                mean[0] += real(0.5) * wp.min(shift[env, i][0], real(0.0))
            total += wp.dot(p, mean)
            size += wp.length(p)
        return total, size

    @wp.func
    def set_theta(
        shift: wp.array2d(dtype=vec3),
        free: wp.array2d(dtype=vec3),
        state: wp.array2d(dtype=int),
        kick: wp.array2d(dtype=real),
        env: int,
        count: int,
        change: real,
    ):
        """Rows for another theta; contact states as the certificate reports them become those that pivoting starts from."""
        for i in range(count):
            push = vec3(change * kick[env, i], real(0.0), real(0.0))
            shift[env, i] = shift[env, i] + push
            free[env, i] = free[env, i] + push
            if state[env, i] == SLIDE:
                state[env, i] = 3

    @kernel()
    def judge(
        attempt: int,
        h: real,
        tolerance: real,
        midpoint: int,
        contacts: Contacts,
        bounces: Bounces,
        unsolved: wp.array(dtype=int),
        reason: wp.array(dtype=int),
        stride: int,
    ):
        """After the certificate of solve number `attempt`: done with this environment, or the rows to solve next.

        W may exceed what the impulses do without restitution (nothing, but for bristles that give back) by what an error of
        `tolerance` [m/s] in the velocities is worth.
        """
        start, _ = wp.tid()
        for env in range(start, contacts.count.shape[0], stride):
            solved = unsolved[env] == 0
            if attempt == 0:
                stage = int(DONE)
                for i in range(contacts.count[env]):
                    # An answer that is not certified is marked anyway, and says nothing about energy.
                    if bounces.kick[env, i] < real(0.0) and solved:
                        stage = ALL
                bounces.stage[env] = stage
                bounces.theta[env] = real(1.0)
                bounces.status[env] = 0
            stage = bounces.stage[env]
            theta = bounces.theta[env]
            count = contacts.count[env]
            after = theta
            if stage == APPLY:
                stage = DONE
            elif stage != DONE:
                w, size = work(
                    contacts.shift,
                    contacts.free,
                    contacts.gap,
                    contacts.impulse,
                    bounces.kick,
                    bounces.before,
                    contacts.velocity,
                    contacts.slot,
                    env,
                    count,
                    h,
                    midpoint,
                )
                low = bounces.low[env]
                high = bounces.high[env]
                third = vec2(real(-1.0), real(0.0))
                slack = bounces.slack[env]
                if stage == ALL:
                    slack = real(0.5) * tolerance * size
                    bounces.slack[env] = slack
                    high = vec2(theta, w)
                    stage = DONE
                    if w > real(2.0) * slack:
                        stage = NONE
                        after = real(0.0)
                elif stage == NONE:
                    if not solved:
                        w = real(0.0)
                    bounces.allowed[env] = wp.max(w, real(0.0)) + slack
                    high[1] = high[1] - bounces.allowed[env]
                    low = vec2(theta, w - bounces.allowed[env])
                    stage = SEARCH
                    if high[1] <= slack:
                        stage = APPLY
                        after = high[0]
                else:
                    point = vec2(theta, w - bounces.allowed[env])
                    if not solved:
                        high[0] = theta
                    elif point[1] <= slack:
                        if low[0] < theta:
                            third = low
                        low = point
                        if point[1] >= -slack:
                            stage = DONE
                    else:
                        third = high
                        high = point
                if stage == SEARCH:
                    after = root(low, high, third)
                    if attempt >= EXTRA_SOLVES - 1:
                        after = low[0]
                        stage = APPLY
                        if theta == after:
                            stage = DONE
                bounces.low[env] = low
                bounces.high[env] = high

            bounces.stage[env] = stage
            if stage != DONE:
                bounces.todo[wp.atomic_add(bounces.again, 0, 1)] = env
                bounces.theta[env] = after
                bounces.status[env] = 0
                reason[env] = 0
                set_theta(contacts.shift, contacts.free, contacts.state, bounces.kick, env, count, after - theta)

    @kernel()
    def settle(contacts: Contacts, bounces: Bounces, status: wp.array(dtype=int), stride: int):
        """When all environments are done: contacts and status as the other stages know them."""
        start, _ = wp.tid()
        for env in range(start, contacts.count.shape[0], stride):
            theta = bounces.theta[env]
            status[env] = status[env] | bounces.status[env]
            if theta < real(1.0):
                status[env] = status[env] | RESTITUTION_REDUCED
            # What follows looks at the gap that is left, not at the speed of the rebound.
            for i in range(contacts.count[env]):
                push = vec3(theta * bounces.kick[env, i], real(0.0), real(0.0))
                contacts.shift[env, i] = contacts.shift[env, i] - push

    return SimpleNamespace(Bounces=Bounces, bounce=bounce, judge=judge, settle=settle)
