# SPDX-License-Identifier: Apache-2.0
"""End of a step of trees of joints: v+, q+ (eq. 23), and v at q+ of what was hit.

c (kernels/articulated.py) turns momenta of the bodies with the paths that joints leave them, at velocities near those before the step.
What is hit moves on with v+, at once: J(q+)^T M J(q+) v+ then differs from J(q)^T M J(q) v+ by h dM/dt(v+) v+, of which c knows
nothing, and links that whip about gain energy many times over. So do some that turn by a third of a radian in a step, of which c
knows too little: more than what v+ has at q, and what c does, says. There v becomes

    v := (J+^T M J+)^-1 J+^T M J (v+ + h M^-1 c),   J+ = J(q+), M the masses and inertias of the bodies,

what the joints leave, at q+, of the momenta that bodies had without c. It is a projection in the metric of M: momenta of whole trees stay,
and energy is lost, by a part of (h w)^2 in a step that turns by h w. (An inelastic impact with the joints, one might say.) Where
c was left out (rounds that did not settle) nothing has to be put back. The midpoint rule has no landing: its poses are half-way ones.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import articulated, tree
from .types import OPTIONS, scalar_types

# What rows changed was a hit if it was more than this part of the largest velocity, and more than this many times what v_free was beyond
# what was expected. (What rests is changed by as much as its weight gave it: no hit.)
SUDDEN = wp.constant(0.25)
HIT = wp.constant(2.0)
# A step turns bodies by too much where it changes the square of their momenta, over their masses, by this part: by some 0.3 rad.
BENT = wp.constant(0.1)
# What was hit lands where momenta are off by this part of their square, by a hundredth: less than that is not worth the factors of a pose.
MISSED = wp.constant(1.0e-4)
# What turns by too much lands where the new pose would make this part of the energy.
MADE = wp.constant(0.01)
# What lands: what was hit, or what turns by too much.
HARD = wp.constant(1)
FAST = wp.constant(2)


@functools.cache
def make(real) -> SimpleNamespace:
    """Kernels ``integrate``, ``land`` after kinematics at q+, and ``drift``; launch with dim (E), ``drift`` with dim (E, B)."""
    t = scalar_types(real)
    spatial = t.spatial
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
    def energy(parameters: Parameters, trees: Trees, velocity: wp.array2d(dtype=spatial), env: int) -> real:
        """Twice that of motion, of bodies that forces move, in trees.own's pose [J]."""
        total = real(0.0)
        for b in range(trees.order.shape[0]):
            if trees.last[b] >= 0:
                total += wp.dot(velocity[env, b], momentum(parameters, trees, velocity[env, b], env, b))
        return total

    @wp.func
    def matters(
        parameters: Parameters,
        trees: Trees,
        change: wp.array2d(dtype=spatial),
        velocity: wp.array2d(dtype=spatial),
        part: real,
        env: int,
    ) -> bool:
        """Is the square of a change of momenta, over masses and moments of inertia, more than this part of that of all?"""
        changed = real(0.0)
        for b in range(trees.order.shape[0]):
            m = parameters.mass[env % parameters.mass.shape[0], b]
            if m > real(0.0) and trees.last[b] >= 0:
                push = change[env, b]
                turning = real(3.0) * wp.length_sq(wp.spatial_bottom(push)) / wp.trace(trees.own[env, b])
                changed += wp.length_sq(wp.spatial_top(push)) / m + turning
        return changed > part * energy(parameters, trees, velocity, env)

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
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
            size = real(0.0)
            changed = real(0.0)
            freely = real(0.0)
            for i in range(trees.before.shape[0]):
                after = trees.free[env, i] + trees.change[env, i]
                v[env, i] = after
                trees.left[env, i] = after
                size = wp.max(size, wp.abs(after))
                changed = wp.max(changed, wp.abs(trees.change[env, i]))
                freely = wp.max(freely, wp.abs(trees.free[env, i] - trees.expected[env, i]))
            hit = changed > wp.max(real(SUDDEN) * size, real(HIT) * freely)
            if hit:
                for i in range(trees.before.shape[0]):
                    trees.free[env, i] = trees.left[env, i]  # it is not expected to be hit again
            trees.landing[env] = 0
            # Poses of the midpoint rule are half-way ones: no momentum is of any.
            if part == real(1.0):
                if hit:
                    trees.landing[env] = HARD
                elif matters(parameters, trees, trees.bent, next_velocity, real(BENT), env):
                    trees.landing[env] = FAST
            if trees.landing[env] > 0:
                trees.allowed[env] = energy(parameters, trees, next_velocity, env)
                for b in range(trees.order.shape[0]):
                    if trees.last[b] >= 0:
                        mean = bodies.velocity[env, b] + next_velocity[env, b]
                        trees.allowed[env] = trees.allowed[env] + wp.dot(trees.bent[env, b], mean)  # what c does
                # h M^-1 c, and what it is worth of the impulses along joints.
                for i in range(trees.before.shape[0]):
                    trees.change[env, i] = real(0.0)
                for b in range(trees.order.shape[0]):
                    push_body(trees, bodies, trees.bent[env, b], env, b)
                propagate(trees, trees.push, trees.gained, env)
                for i in range(trees.before.shape[0]):
                    trees.given[env, i] = (added(trees, h, env, i) - h * trees.calming[env, i]) * trees.change[env, i]
                for b in range(trees.order.shape[0]):
                    trees.momentum[env, b] = momentum(parameters, trees, next_velocity[env, b] + gain(trees, bodies, env, b), env, b)
            for b in range(trees.order.shape[0]):
                advance(topology, trees, bodies, v, part * h, q, env, b)

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def land(parameters: Parameters, trees: Trees, bodies: Bodies, h: real, v: wp.array2d(dtype=real), stride: int):
        """v, and the velocities of bodies, at q+ of what was hit."""
        start, _ = wp.tid()
        for env in range(start, v.shape[0], stride):
            landing = trees.landing[env] > 0
            if landing:
                inertias(parameters, trees, bodies, env)
                if trees.landing[env] == FAST:
                    landing = energy(parameters, trees, bodies.velocity, env) > (real(1.0) + real(MADE)) * trees.allowed[env]
            if landing:
                for b in range(trees.order.shape[0]):
                    trees.momentum[env, b] -= momentum(parameters, trees, bodies.velocity[env, b], env, b)
                landing = matters(parameters, trees, trees.momentum, bodies.velocity, real(MISSED), env)
            if landing:
                for b in range(trees.order.shape[0]):
                    push_body(trees, bodies, trees.momentum[env, b], env, b)
                for i in range(trees.before.shape[0]):
                    trees.change[env, i] = trees.given[env, i]
                    trees.calming[env, i] = real(0.0)
                factorise(parameters, trees, bodies, h, False, env)
                propagate(trees, trees.push, trees.gained, env)
                for i in range(trees.before.shape[0]):
                    after = v[env, i] + trees.change[env, i]
                    v[env, i] = after
                    trees.left[env, i] = after
                    trees.free[env, i] = trees.free[env, i] + trees.change[env, i]  # no row did it
                for b in range(trees.order.shape[0]):
                    trees.twist[env, b] = trees.twist[env, b] + trees.gained[env, b]
                    bodies.velocity[env, b] = bodies.velocity[env, b] + gain(trees, bodies, env, b)

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
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

    return SimpleNamespace(integrate=integrate, land=land, drift=drift)
