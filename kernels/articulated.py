# SPDX-License-Identifier: Apache-2.0
"""Motion of trees of joints: poses, M(q) and its factors, bias c(q, v), v_free and q+ (eqs. 13, 23, 24), by what ``tree`` has of them.

c comes from the recursive Newton-Euler algorithm, at the mean of v and v_free and half of d, what rows changed of v a step
ago: M (v_free - v) = h (f - c((v + v_free + d) / 2)). With the present v it would feed energy to what spins. c changes by about h |v|
of what the velocity does, so rounds end where the next one would change nothing that matters.

A force r that joints pass on to a point x of a body turns with the joints above it: K_ij = a_j . sum of (dx/dq_i x r), a_j the axis
of rotation of j on the path to i. Where h^2 K is not small (light links that hold a heavy end swing at 1000 rad/s), M + h^2 K / 4 stands
for M: a swing at w then turns as before where h w is small, and is stable at any h w. Where h w > 2, which no step
resolves, it is damped as well (docs/theory.md). K_ij = s_j . G s_i, G a sum over what hangs on i, so that it enters I_A as an inertia does.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import tree
from .declare import factory, kernel
from .tree import ANGULAR, BALL, BALL_ON, FREE, HARD, LINEAR, PRESCRIBED
from .types import FREE as FREE_JOINT
from .types import KINEMATIC, scalar_types

# Rounds in which c follows the mean velocity.
BIAS_ROUNDS = wp.constant(6)
SETTLED = wp.constant(1.0e-2)
# h^2 / 4 of the geometric stiffness goes into M where it is more than this part of a pivot of M...
STIFF = wp.constant(0.01)
# ... and where it is more than this part, the velocity is damped by this part of h times the stiffness.
UNRESOLVED = wp.constant(1.0)
CALM = wp.constant(0.1)
# Where a step does not resolve c, M_ii is this part larger for joints, which takes a third of their velocity.
SLOWED = wp.constant(0.5)


@functools.cache
def functions(real) -> SimpleNamespace:
    """What a step needs of M(q) and c(q, v): ``inertias``, ``factorise``, ``forces``, ``impulses``, ``matters``."""
    t = scalar_types(real)
    vec3, mat33, spatial = t.vec3, t.mat33, t.spatial
    Bodies, Parameters, Topology = t.Bodies, t.Parameters, t.Topology
    f = tree.functions(real)
    Trees, pair, moved_by, added = f.Trees, f.pair, f.moved_by, f.added
    mat66 = wp.types.matrix(shape=(6, 6), dtype=real)

    @wp.func
    def cross_motion(twist: spatial, s: spatial) -> spatial:
        """How an axis that moves with `twist` changes: twist x s."""
        w = wp.spatial_bottom(twist)
        angular = wp.spatial_bottom(s)
        return pair(wp.cross(w, wp.spatial_top(s)) + wp.cross(wp.spatial_top(twist), angular), wp.cross(w, angular))

    @wp.func
    def forces(
        topology: Topology,
        parameters: Parameters,
        trees: Trees,
        wrench: wp.array2d(dtype=spatial),
        v: wp.array2d(dtype=real),
        part: real,
        h: real,
        bodies: Bodies,
        bent: wp.array2d(dtype=spatial),
        env: int,
    ):
        """trees.push := what gravity, wrenches and inertia give to each body within h [N s, N m s about O].

        `bent` := what the paths that joints leave to a body take of its momentum within h, which is the part of inertia [N s, N m s about
        its centre of mass]. At v + trees.change / 2, or at rest (part = 1, 0); their twists are trees.twist and trees.gained.
        """
        gravity = parameters.gravity[env % parameters.gravity.shape[0]]
        for k in range(trees.order.shape[0]):
            b = trees.order[k]
            parent = trees.parent[b]
            twist = part * (trees.twist[env, b] + real(0.5) * trees.gained[env, b])
            acceleration = spatial()
            if parent >= 0:
                acceleration = trees.carried[env, parent]
            kind = topology.joint_type[b]
            if kind == FREE_JOINT or kind == KINEMATIC:  # noqa: SIM109
                # The axes of rotation go through the centre of mass and move with it.
                acceleration = pair(wp.cross(wp.spatial_top(twist), wp.spatial_bottom(twist)), vec3())
            else:
                # Each axis is carried by what is before it, the three of a ball by what is before them all.
                carrier = twist
                joint = spatial()
                for ii in range(trees.end[b] - trees.first[b]):
                    i = trees.end[b] - 1 - ii
                    joint += (part * (v[env, i] + real(0.5) * trees.change[env, i])) * trees.screw[env, i]
                    if trees.kind[i] != BALL_ON:
                        carrier -= joint
                        acceleration += cross_motion(carrier, joint)
                        joint = spatial()
            trees.carried[env, b] = acceleration
            # Force at the centre of mass, r from O, and moment about O that the body takes, I a + v x* I v, less those applied.
            m = parameters.mass[env % parameters.mass.shape[0], b]
            r = bodies.com[env, b] - trees.origin[env, trees.root[b]]
            w = wp.spatial_bottom(twist)
            p = m * moved_by(twist, r)
            force = m * moved_by(acceleration, r) + wp.cross(w, p)
            # The angular momentum about the centre of mass changes by w x I w and by what the acceleration adds.
            inertia = trees.own[env, b]
            moment = inertia * wp.spatial_bottom(acceleration) + wp.cross(w, inertia * w)
            bent[env, b] = h * pair(force, moment)
            force -= m * gravity + wp.spatial_top(wrench[env, b])
            moment -= wp.spatial_bottom(wrench[env, b])
            trees.push[env, b] = (-h) * pair(force, moment + wp.cross(r, force))

    @wp.func
    def inertias(parameters: Parameters, trees: Trees, bodies: Bodies, env: int):
        for b in range(trees.parent.shape[0]):
            rotation = wp.quat_to_matrix(wp.transform_get_rotation(bodies.pose[env, b]))
            trees.own[env, b] = rotation * parameters.inertia[env % parameters.inertia.shape[0], b] * wp.transpose(rotation)

    @wp.func
    def turning(force: vec3, virial: mat33) -> mat66:
        """G: K_ij = s_j . G s_i."""
        turn = virial - wp.trace(virial) * wp.identity(n=3, dtype=real)
        shift = wp.skew(force)
        g = mat66()
        for i in range(3):
            for j in range(3):
                g[3 + i, j] = -shift[i, j]
                g[3 + i, 3 + j] = turn[i, j]
        return g

    @wp.func
    def pulled(parameters: Parameters, trees: Trees, bodies: Bodies, h: real, env: int, b: int):
        """r and the force that inertia and weight of a body ask of its joint, from trees.push and trees.gained."""
        r = bodies.com[env, b] - trees.origin[env, trees.root[b]]
        m = parameters.mass[env % parameters.mass.shape[0], b]
        return r, (m * moved_by(trees.gained[env, b], r) - wp.spatial_top(trees.push[env, b])) / h

    @wp.func
    def factorise(parameters: Parameters, trees: Trees, bodies: Bodies, h: real, stiffer: bool, env: int) -> bool:
        """M with what damping adds to it in an implicit step, and h^2 K / 4 (see above) if `stiffer`; is it positive definite?"""
        for b in range(trees.parent.shape[0]):
            m = parameters.mass[env % parameters.mass.shape[0], b]
            r = bodies.com[env, b] - trees.origin[env, trees.root[b]]
            about = trees.own[env, b] + m * (wp.diag(vec3(wp.dot(r, r))) - wp.outer(r, r))
            shift = m * wp.skew(r)
            trees.mass[env, b] = m
            trees.moment[env, b] = m * r
            trees.inertia[env, b] = about
            whole = mat66()
            for i in range(3):
                whole[i, i] = m
                for j in range(3):
                    whole[i, 3 + j] = -shift[i, j]
                    whole[3 + i, j] = shift[i, j]
                    whole[3 + i, 3 + j] = about[i, j]
            if stiffer:
                at, force = pulled(parameters, trees, bodies, h, env, b)
                whole += (real(0.25) * h * h) * turning(force, wp.outer(at, force))
            trees.articulated[env, b] = whole
        positive = bool(True)
        for k in range(trees.order.shape[0]):
            b = trees.order[trees.order.shape[0] - 1 - k]
            whole = trees.articulated[env, b]
            for ii in range(trees.end[b] - trees.first[b]):
                i = trees.end[b] - 1 - ii
                if trees.kind[i] == PRESCRIBED:
                    trees.scale[env, i] = real(0.0)
                    trees.taken[env, i] = spatial()
                    trees.pivot[env, i] = real(1.0)
                else:
                    screw = trees.screw[env, i]
                    u = whole * screw
                    pivot = wp.dot(screw, u) + added(trees, h, env, i)
                    taken = (real(1.0) / pivot) * u
                    whole -= wp.outer(taken, u)
                    positive = positive and pivot > real(0.0)
                    trees.taken[env, i] = taken
                    trees.pivot[env, i] = pivot
                    trees.scale[env, i] = real(1.0) / wp.sqrt(pivot)
            parent = trees.parent[b]
            if parent >= 0:
                trees.articulated[env, parent] = trees.articulated[env, parent] + whole
                trees.mass[env, parent] = trees.mass[env, parent] + trees.mass[env, b]
                trees.moment[env, parent] = trees.moment[env, parent] + trees.moment[env, b]
                trees.inertia[env, parent] = trees.inertia[env, parent] + trees.inertia[env, b]
        return positive

    @wp.func
    def matters(parameters: Parameters, trees: Trees, bodies: Bodies, h: real, env: int) -> bool:
        """Is h^2 K / 4 a part of M anywhere that must not be left out? Where no step resolves it the velocity is damped from now on."""
        for b in range(trees.parent.shape[0]):
            r, force = pulled(parameters, trees, bodies, h, env, b)
            trees.pull[env, b] = force
            trees.virial[env, b] = wp.outer(r, force)
        result = bool(False)
        for k in range(trees.order.shape[0]):
            b = trees.order[trees.order.shape[0] - 1 - k]
            parent = trees.parent[b]
            force = trees.pull[env, b]
            virial = trees.virial[env, b]
            if parent >= 0:
                trees.pull[env, parent] = trees.pull[env, parent] + force
                trees.virial[env, parent] = trees.virial[env, parent] + virial
            for i in range(trees.first[b], trees.end[b]):
                if trees.kind[i] != PRESCRIBED:
                    screw = trees.screw[env, i]
                    axis = wp.spatial_bottom(screw)
                    g = wp.cross(wp.spatial_top(screw), force) + virial * axis - wp.trace(virial) * axis
                    own = real(0.25) * h * h * wp.dot(g, axis)
                    pivot = trees.pivot[env, i]
                    result = result or wp.abs(own) > real(STIFF) * pivot
                    if own > real(UNRESOLVED) * pivot:
                        trees.calming[env, i] = real(CALM) * real(4.0) * own / h
        return result

    @wp.func
    def impulses(trees: Trees, q: wp.array2d(dtype=real), v: wp.array2d(dtype=real), h: real, env: int):
        """trees.given: of forces along the joints, damping and drives, implicit: what is in M is taken from them."""
        for i in range(trees.before.shape[0]):
            force = trees.force[env, i] - trees.damping[env % trees.damping.shape[0], i] * v[env, i]
            stiffness = trees.stiffness[env % trees.stiffness.shape[0], i]
            rate = trees.rate[env % trees.rate.shape[0], i]
            if stiffness > real(0.0):  # which a velocity without a coordinate does not have
                force += stiffness * (trees.target[env, i] - q[env, trees.coordinate[i]] - h * v[env, i])
            if stiffness > real(0.0) or rate > real(0.0):
                force += rate * (trees.target_rate[env, i] - v[env, i])
            trees.given[env, i] = h * force

    return SimpleNamespace(forces=forces, inertias=inertias, factorise=factorise, matters=matters, impulses=impulses)


@factory
def make(real) -> SimpleNamespace:
    """Kernels of scenes with joints; ``dynamics`` of any scene. Launch with dim (E)."""
    t = scalar_types(real)
    vec3, mat33, quat, transform, spatial = t.vec3, t.mat33, t.quat, t.transform, t.spatial
    Bodies, Parameters, Topology = t.Bodies, t.Parameters, t.Topology
    f, of = tree.functions(real), functions(real)
    Trees, pair, moved_by, propagate = f.Trees, f.pair, f.moved_by, f.propagate
    added, inertia_along = f.added, f.inertia_along
    forces, inertias, factorise, matters, impulses = of.forces, of.inertias, of.factorise, of.matters, of.impulses
    rounding = real(1.0e-16) if real is wp.float64 else real(1.0e-7)
    settled = real(1.0e-9) if real is wp.float64 else real(1.0e-6)

    @kernel()
    def kinematics(
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        topology: Topology,
        parameters: Parameters,
        trees: Trees,
        bodies: Bodies,
        some: wp.array(dtype=int),
        stride: int,
    ):
        """Poses, axes and velocities, from the roots to the leaves, of environments where some [E] is not zero; of all if it is empty."""
        start, _ = wp.tid()
        for env in range(start, q.shape[0], stride):
            asked = bool(True)
            if some.shape[0] > 0:
                asked = some[env] != 0
            if not asked:
                continue
            for k_b in range(trees.order.shape[0]):
                b = trees.order[k_b]
                parent = trees.parent[b]
                kind = topology.joint_type[b]
                i_q = topology.q_start[b]
                com = parameters.com[env % parameters.com.shape[0], b]
                pose = topology.joint_pose[b]
                twist = spatial()
                origin = vec3()
                if kind == FREE_JOINT or kind == KINEMATIC:  # noqa: SIM109
                    for k in range(7):
                        pose[k] = q[env, i_q + k]
                    # Users write q: a quaternion that is not of unit length would scale the body. Zero gives NaN, which is flagged.
                    pose = transform(wp.transform_get_translation(pose), wp.normalize(wp.transform_get_rotation(pose)))
                    origin = wp.transform_point(pose, com)
                    trees.origin[env, b] = origin
                    for k in range(3):
                        i = trees.first[b] + k
                        axis = vec3()
                        axis[k] = real(1.0)
                        trees.screw[env, i] = pair(axis, vec3())
                        trees.screw[env, i + 3] = pair(vec3(), axis)
                        twist[k] = v[env, i]
                        twist[3 + k] = v[env, i + 3]
                else:
                    if parent >= 0:
                        pose = bodies.pose[env, parent] * pose
                        twist = trees.twist[env, parent]
                    x = wp.transform_get_translation(pose)
                    turn = wp.transform_get_rotation(pose)
                    if trees.root[b] == b:
                        trees.origin[env, b] = x
                    origin = trees.origin[env, trees.root[b]]
                    for i in range(trees.first[b], trees.end[b]):
                        linear = vec3()
                        angular = vec3()
                        if trees.kind[i] == LINEAR:
                            linear = wp.quat_rotate(turn, trees.axis[i])
                            x += q[env, i_q] * linear
                            i_q += 1
                        else:
                            if trees.kind[i] == ANGULAR:
                                turn = turn * wp.quat_from_axis_angle(trees.axis[i], q[env, i_q])
                                i_q += 1
                            elif trees.kind[i] == BALL:
                                turn = turn * wp.normalize(quat(q[env, i_q], q[env, i_q + 1], q[env, i_q + 2], q[env, i_q + 3]))
                                i_q += 4
                            angular = wp.quat_rotate(turn, trees.axis[i])
                            linear = wp.cross(x - origin, angular)
                        screw = pair(linear, angular)
                        trees.screw[env, i] = screw
                        twist += v[env, i] * screw
                    pose = transform(x, turn) * trees.child_pose[b]
                bodies.pose[env, b] = pose
                trees.twist[env, b] = twist
                centre = wp.transform_point(pose, com)
                bodies.com[env, b] = centre
                bodies.velocity[env, b] = pair(moved_by(twist, centre - origin), wp.spatial_bottom(twist))

    @kernel()
    def dynamics(
        topology: Topology,
        parameters: Parameters,
        trees: Trees,
        nothing: wp.array2d(dtype=spatial),
        v: wp.array2d(dtype=real),
        bodies: Bodies,
        mass: wp.array3d(dtype=real),
        bias: wp.array2d(dtype=real),
        stride: int,
    ):
        """M(q), dense, and c(q, v) with what gravity takes from it, after kinematics; `nothing` is zero: wrenches are no part of c."""
        start, _ = wp.tid()
        for env in range(start, nothing.shape[0], stride):
            for i in range(trees.before.shape[0]):
                trees.calming[env, i] = real(0.0)
                trees.change[env, i] = real(0.0)
            for b in range(trees.order.shape[0]):
                trees.gained[env, b] = spatial()
            inertias(parameters, trees, bodies, env)
            factorise(parameters, trees, bodies, real(0.0), False, env)
            forces(topology, parameters, trees, nothing, v, real(1.0), real(1.0), bodies, trees.gained, env)
            for k in range(trees.order.shape[0]):
                b = trees.order[trees.order.shape[0] - 1 - k]
                push = trees.push[env, b]
                parent = trees.parent[b]
                if parent >= 0:
                    trees.push[env, parent] = trees.push[env, parent] + push
                moment = trees.moment[env, b]
                for i in range(trees.first[b], trees.end[b]):
                    screw = trees.screw[env, i]
                    linear = wp.spatial_top(screw)
                    angular = wp.spatial_bottom(screw)
                    taken = pair(
                        trees.mass[env, b] * linear + wp.cross(angular, moment), trees.inertia[env, b] * angular + wp.cross(moment, linear)
                    )
                    j = trees.before[i]
                    while j >= 0:
                        mass[env, i, j] = wp.dot(trees.screw[env, j], taken)
                        mass[env, j, i] = mass[env, i, j]
                        j = trees.before[j]
                    mass[env, i, i] = wp.dot(screw, taken) + added(trees, real(0.0), env, i)
                    bias[env, i] = -wp.dot(screw, push)
                    if trees.kind[i] == PRESCRIBED:
                        mass[env, i, i] = real(1.0)
                        bias[env, i] = real(0.0)

    @wp.func
    def expect(trees: Trees, v: wp.array2d(dtype=real), env: int) -> real:
        """trees.expected := v and half of what rows changed of it a step ago, trees.twist with that; returns the largest of v.

        Loops and contacts that last change as much again, and c is that of the mean velocity of a step: of v and v+, not of v
        and v_free. (A four-bar at 2 ms turns too far by 11 mrad in 2 s with the latter, by 0.02 with the former; what rests would
        feel c of half of what its weight would give it in a step.) Not where v was written since.
        """
        n = trees.before.shape[0]
        size = real(0.0)
        moved = bool(False)
        for i in range(n):
            size = wp.max(size, wp.abs(v[env, i]))
            held = real(0.0)
            if v[env, i] == trees.left[env, i]:
                held = real(0.5) * (v[env, i] - trees.free[env, i])
                moved = moved or held != real(0.0)
            trees.expected[env, i] = v[env, i] + held
            trees.change[env, i] = held
        if moved:
            for k in range(trees.order.shape[0]):
                b = trees.order[k]
                more = spatial()
                if trees.parent[b] >= 0:
                    more = trees.gained[env, trees.parent[b]]
                for i in range(trees.first[b], trees.end[b]):
                    more += trees.change[env, i] * trees.screw[env, i]
                trees.gained[env, b] = more
                trees.twist[env, b] = trees.twist[env, b] + more
        return size

    @kernel()
    def free_motion(
        topology: Topology,
        parameters: Parameters,
        trees: Trees,
        wrench: wp.array2d(dtype=spatial),
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        h: real,
        bodies: Bodies,
        stride: int,
    ):
        start, _ = wp.tid()
        for env in range(start, wrench.shape[0], stride):
            n = trees.before.shape[0]
            size = expect(trees, v, env)
            for i in range(n):
                trees.free[env, i] = v[env, i]
                trees.change[env, i] = real(0.0)
                trees.calming[env, i] = real(0.0)
            for b in range(trees.order.shape[0]):
                trees.gained[env, b] = spatial()
                trees.landing[env, b] = 0
            impulses(trees, q, v, h, env)
            inertias(parameters, trees, bodies, env)
            searching = bool(True)
            stiffer = bool(False)
            stale = bool(True)  # M is no longer what was factorised
            part = real(1.0)
            rounds = int(0)
            before = real(0.0)
            whole = real(0.0)
            while searching:
                forces(topology, parameters, trees, wrench, trees.expected, part, h, bodies, trees.bent, env)
                if rounds == 1:
                    stiffer = matters(parameters, trees, bodies, h, env)
                    stale = stiffer
                while stale:
                    stale = not factorise(parameters, trees, bodies, h, stiffer, env) and stiffer
                    if stale:  # something is about to topple: without
                        stiffer = False
                        for i in range(n):
                            trees.calming[env, i] = real(0.0)
                for i in range(n):
                    trees.change[env, i] = trees.given[env, i] - h * trees.calming[env, i] * v[env, i]
                propagate(trees, trees.push, trees.gained, env)
                moved = real(0.0)
                for i in range(n):
                    after = v[env, i] + trees.change[env, i]
                    moved = wp.max(moved, wp.abs(after - trees.free[env, i]))
                    size = wp.max(size, wp.abs(after))
                    trees.free[env, i] = after
                rounds += 1
                if rounds == 1:
                    whole = moved
                else:
                    # The next round would change it by this part of what this one did.
                    rate = wp.max(moved / before, h * size)
                    matter = wp.min(settled * size, real(SETTLED) * rate * rate * whole) + rounding * size
                    searching = moved * rate > matter and rounds < BIAS_ROUNDS
                if searching and rounds > 2 and moved > real(0.5) * before:
                    # Rounds do not settle, a joint turns by about a radian in a step: without c, which would grow with the square of v,
                    # and joints calmed, as turning from one pose to another feeds them.
                    part = real(0.0)
                    for b in range(trees.order.shape[0]):
                        trees.landing[env, b] = HARD
                        for i in range(trees.first[b], trees.end[b]):
                            if trees.kind[i] < FREE:
                                inertia = inertia_along(trees, h, env, b, i)
                                trees.calming[env, i] = trees.calming[env, i] + real(SLOWED) * inertia / h
                    stale = True
                    rounds = BIAS_ROUNDS - 1
                before = moved
            for b in range(trees.order.shape[0]):
                r = bodies.com[env, b] - trees.origin[env, trees.root[b]]
                gained = pair(moved_by(trees.gained[env, b], r), wp.spatial_bottom(trees.gained[env, b]))
                bodies.free_velocity[env, b] = bodies.velocity[env, b] + gained
            for k in range(trees.order.shape[0]):
                b = trees.order[k]
                bodies.inv_mass[env, b] = real(0.0)
                bodies.inv_inertia[env, b] = mat33()
                if trees.last[b] >= 0:
                    # What a body alone has: a scale for what is about to hit it, not its mobility. Of one without mass what carries it has.
                    m = parameters.mass[env % parameters.mass.shape[0], b]
                    if m > real(0.0):
                        bodies.inv_mass[env, b] = real(1.0) / m
                    elif trees.parent[b] >= 0:
                        bodies.inv_mass[env, b] = bodies.inv_mass[env, trees.parent[b]]

    @kernel()
    def reset_control(mask: wp.array(dtype=wp.bool), target: wp.array(dtype=real), rate: wp.array(dtype=real), trees: Trees):
        """Nothing is applied, no step has left anything, and drives have the model's targets; launch with dim (E)."""
        env = wp.tid()
        if mask[env]:
            for i in range(trees.force.shape[1]):
                trees.left[env, i] = real(wp.inf)
                trees.force[env, i] = real(0.0)
                trees.target[env, i] = target[i]
                trees.target_rate[env, i] = rate[i]

    return SimpleNamespace(
        kinematics=kinematics,
        free_motion=free_motion,
        reset_control=reset_control,
        dynamics=dynamics,
    )
