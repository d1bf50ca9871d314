# SPDX-License-Identifier: Apache-2.0
"""End of a step of trees of joints: v+, q+ (eq. 23), and v at q+ of what was hit.

c (kernels/articulated.py) turns momenta of the bodies with the paths that joints leave them, at velocities near those before the step.
What is hit moves on with v+, at once: J(q+)^T M J(q+) v+ then differs from J(q)^T M J(q) v+ by h dM/dt(v+) v+, of which c knows
nothing, and links that whip about gain energy many times over. So do some that turn by 0.4 radians in a step, of which c
knows too little: more than what v+ has at q, and what c does, says. There v becomes

    v := (J+^T M J+)^-1 J+^T M J (v+ + h M^-1 c),   J+ = J(q+), M the masses and inertias of the bodies,

what the joints leave, at q+, of the momenta that bodies had without c. It is a projection in the metric of M: momenta of whole trees stay,
and energy is lost, by a part of (h w)^2 in a step that turns by h w. (An inelastic impact with the joints, one might say.) Where
c was left out (rounds that did not settle) trees land as what was hit does, and nothing has to be put back. The midpoint rule has no
landing: its poses are half-way ones.
"""

from types import SimpleNamespace

import warp as wp

from . import articulated, tree
from .declare import factory, kernel
from .tree import FAST, HARD
from .types import scalar_types

# What rows changed was a hit if it was, and less what they changed a step ago still is, more than this part of the largest velocity, and
# more than this many times what v_free was beyond what was expected. (What rests is changed by as much as its weight gave it, a loop
# that turns back by as much as its pull was: no hits.)
SUDDEN = wp.constant(0.25)
HIT = wp.constant(2.0)
# A step turns bodies by too much where it changes the square of their momenta, over their masses, by this part: by some 0.4 rad.
BENT = wp.constant(0.2)
# What was hit lands where momenta are off by this part of their square, by a hundredth: less than that is not worth the factors of a pose.
MISSED = wp.constant(1.0e-4)
# What turns by too much lands where the new pose would make this part of the energy. (With a hundredth, and BENT half as much, a four-bar
# at 20 ms, 0.28 rad a step, was braked and never came over the top.)
MADE = wp.constant(0.05)


@factory
def make(real) -> SimpleNamespace:
    """Kernels ``integrate``, then after kinematics at q+ ``judge_landing`` and ``land``; ``drift``. Launch with dim (E), drift (E, B)."""
    t = scalar_types(real)
    vec2, vec3, spatial = t.vec2, t.vec3, t.spatial
    Bodies, Parameters, Topology = t.Bodies, t.Parameters, t.Topology
    f, of = tree.functions(real), articulated.functions(real)
    Trees, pair, moved_by, added, propagate = f.Trees, f.pair, f.moved_by, f.added, f.propagate
    inertias, factorise = of.inertias, of.factorise
    advance = tree.motion(real)

    @wp.func
    def momentum(parameters: Parameters, trees: Trees, velocity: spatial, env: int, b: int) -> spatial:
        """[N s, N m s] about the centre of mass."""
        m = parameters.mass[env % parameters.mass.shape[0], b]
        return pair(m * wp.spatial_top(velocity), trees.own[env, b] * wp.spatial_bottom(velocity))

    @wp.func
    def push_body(trees: Trees, bodies: Bodies, impulse: spatial, env: int, b: int):
        """trees.push of an impulse and a moment about the centre of mass."""
        r = bodies.com[env, b] - trees.origin[env, trees.root[b]]
        push = wp.spatial_top(impulse)
        trees.push[env, b] = pair(push, wp.spatial_bottom(impulse) + wp.cross(r, push))

    @wp.func
    def gain(trees: Trees, bodies: Bodies, env: int, b: int) -> spatial:
        """What trees.gained says of the centre of mass."""
        r = bodies.com[env, b] - trees.origin[env, trees.root[b]]
        return pair(moved_by(trees.gained[env, b], r), wp.spatial_bottom(trees.gained[env, b]))

    @wp.func
    def weigh(
        parameters: Parameters,
        trees: Trees,
        velocity: wp.array2d(dtype=spatial),
        change: wp.array2d(dtype=spatial),
        env: int,
    ):
        """trees.worth of each tree := twice the energy of motion, and the square of a change of momenta over masses and inertias."""
        for k in range(trees.order.shape[0]):
            b = trees.order[k]
            root = trees.root[b]
            if b == root:
                trees.worth[env, b] = vec2()
            m = parameters.mass[env % parameters.mass.shape[0], b]
            if m > real(0.0) and trees.last[b] >= 0:
                whole = wp.dot(velocity[env, b], momentum(parameters, trees, velocity[env, b], env, b))
                push = change[env, b]
                turning = real(3.0) * wp.length_sq(wp.spatial_bottom(push)) / wp.trace(trees.own[env, b])
                trees.worth[env, root] = trees.worth[env, root] + vec2(whole, wp.length_sq(wp.spatial_top(push)) / m + turning)

    @wp.func
    def was_hit(largest: vec3) -> bool:
        """By trees.largest of a tree."""
        return largest[1] > wp.max(real(SUDDEN) * largest[0], real(HIT) * largest[2])

    @kernel()
    def integrate(
        topology: Topology,
        parameters: Parameters,
        trees: Trees,
        bodies: Bodies,
        next_velocity: wp.array2d(dtype=spatial),
        h: real,
        part: real,
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        stride: int,
    ):
        """v+ = v_free + M^-1 J^T p and q+ = q + part h Gamma(q) v+ (eq. 23)."""
        start, _ = wp.tid()
        for env in range(start, q.shape[0], stride):
            # Of each tree the largest velocity, what rows changed but did not a step ago, and what v_free was beyond what was expected.
            for k in range(trees.order.shape[0]):
                b = trees.order[k]
                root = trees.root[b]
                largest = vec3()
                if b != root:
                    largest = trees.largest[env, root]
                for i in range(trees.first[b], trees.end[b]):
                    after = trees.free[env, i] + trees.change[env, i]
                    change = trees.change[env, i]
                    sudden = wp.min(wp.abs(change), wp.abs(change - real(2.0) * (trees.expected[env, i] - v[env, i])))
                    beyond = wp.abs(trees.free[env, i] - trees.expected[env, i])
                    largest = wp.max(largest, vec3(wp.abs(after), sudden, beyond))
                    v[env, i] = after
                    trees.left[env, i] = after
                trees.largest[env, root] = largest
            weigh(parameters, trees, next_velocity, trees.bent, env)
            # Where nothing turns by more than h w, momenta are off by at most (h w)^2 of their square, times the mass of all over the least
            # (light links turn, what is heavy rests at their end). Where that is too little, nobody needs the new pose to say so.
            turned = real(0.0)
            all_mass = real(0.0)
            least_mass = real(1.0e30)
            for b in range(trees.order.shape[0]):
                turned = wp.max(turned, h * h * wp.length_sq(wp.spatial_bottom(next_velocity[env, b])))
                m = parameters.mass[env % parameters.mass.shape[0], b]
                if m > real(0.0):
                    all_mass += m
                    least_mass = wp.min(least_mass, m)
            turns = turned * all_mass > real(MISSED) * least_mass
            landing = bool(False)
            for k in range(trees.order.shape[0]):
                b = trees.order[k]
                root = trees.root[b]
                if b == root:
                    largest = trees.largest[env, b]
                    if (turns and was_hit(largest)) or trees.landing[env, b] == HARD:
                        trees.landing[env, b] = HARD
                    elif trees.worth[env, b][1] > real(BENT) * trees.worth[env, b][0]:
                        trees.landing[env, b] = FAST
                    trees.allowed[env, b] = trees.worth[env, b][0]
                trees.push[env, b] = spatial()
                if trees.landing[env, root] > 0:
                    landing = True
                    push_body(trees, bodies, trees.bent[env, b], env, b)
                    if trees.last[b] >= 0:
                        mean = bodies.velocity[env, b] + next_velocity[env, b]
                        trees.allowed[env, root] = trees.allowed[env, root] + wp.dot(trees.bent[env, b], mean)  # what c does
                if was_hit(trees.largest[env, root]):
                    for i in range(trees.first[b], trees.end[b]):
                        trees.free[env, i] = trees.left[env, i]  # it is not expected to be hit again
            # Not by the midpoint rule, which has moved by half a step only.
            landing = landing and part == real(1.0)
            trees.lands[env] = int(landing)
            if landing:
                # h M^-1 c, and what it is worth of the impulses along joints.
                for i in range(trees.before.shape[0]):
                    trees.change[env, i] = real(0.0)
                propagate(trees, trees.push, trees.gained, env)
                for i in range(trees.before.shape[0]):
                    trees.given[env, i] = (added(trees, h, env, i) - h * trees.calming[env, i]) * trees.change[env, i]
                for b in range(trees.order.shape[0]):
                    trees.momentum[env, b] = momentum(parameters, trees, next_velocity[env, b] + gain(trees, bodies, env, b), env, b)
            for b in range(trees.order.shape[0]):
                advance(topology, trees, bodies, v, part * h, q, env, b)

    @kernel()
    def judge_landing(parameters: Parameters, trees: Trees, bodies: Bodies, stride: int):
        """After kinematics at q+: which trees land there, and by what push of their bodies."""
        start, _ = wp.tid()
        for env in range(start, trees.lands.shape[0], stride):
            if trees.lands[env] != 0:
                inertias(parameters, trees, bodies, env)
                for b in range(trees.order.shape[0]):
                    trees.momentum[env, b] -= momentum(parameters, trees, bodies.velocity[env, b], env, b)
                weigh(parameters, trees, bodies.velocity, trees.momentum, env)
                landing = bool(False)
                for k in range(trees.order.shape[0]):
                    b = trees.order[k]
                    root = trees.root[b]
                    if b == root:
                        worth = trees.worth[env, b]
                        resolved = trees.landing[env, b] == FAST and worth[0] <= (real(1.0) + real(MADE)) * trees.allowed[env, b]
                        if resolved or worth[1] <= real(MISSED) * worth[0]:
                            trees.landing[env, b] = 0
                    lands = trees.landing[env, root] > 0
                    landing = landing or lands
                    trees.push[env, b] = spatial()
                    if lands:
                        push_body(trees, bodies, trees.momentum[env, b], env, b)
                    for i in range(trees.first[b], trees.end[b]):
                        trees.calming[env, i] = real(0.0)
                        trees.change[env, i] = real(0.0)
                        if lands:
                            trees.change[env, i] = trees.given[env, i]
                trees.lands[env] = int(landing)

    @kernel()
    def land(parameters: Parameters, trees: Trees, bodies: Bodies, h: real, v: wp.array2d(dtype=real), stride: int):
        """v at q+ of what was hit; those of bodies are for the next kinematics."""
        start, _ = wp.tid()
        for env in range(start, v.shape[0], stride):
            if trees.lands[env] != 0:
                factorise(parameters, trees, bodies, h, False, env)
                propagate(trees, trees.push, trees.gained, env)
                for i in range(trees.before.shape[0]):
                    after = v[env, i] + trees.change[env, i]
                    v[env, i] = after
                    trees.left[env, i] = after
                    trees.free[env, i] = trees.free[env, i] + trees.change[env, i]  # no row did it

    @kernel()
    def drift(
        topology: Topology,
        trees: Trees,
        bodies: Bodies,
        h: real,
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        stride: int,
    ):
        """q + h Gamma(q) v."""
        start, b = wp.tid()
        for env in range(start, q.shape[0], stride):
            advance(topology, trees, bodies, v, h, q, env, b)

    return SimpleNamespace(integrate=integrate, judge_landing=judge_landing, land=land, drift=drift)
