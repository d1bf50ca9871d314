# SPDX-License-Identifier: Apache-2.0
"""Kinematic trees in generalised coordinates: poses, M(q), bias c(q, v), factors of M and free motion (eqs. 13, 24).

A joint is a few degrees of freedom, one after the other, from the frame on the parent to the frame on the body: translations
along axes of the frame on the parent, then rotations, each about an axis that those before it have turned; three of them at once
are a ball, with a quaternion. Each degree of freedom i has an axis s_i = (velocity at O, angular velocity) in world axes, O being
a point of its tree at which nothing is far away, so

    twist of a body = sum of s_i v_i over the path to it,      M_ij = s_i . I_c s_j   (j on the path to i),

I_c the inertia of all that hangs on i, about O (composite rigid bodies: Featherstone 2008, section 6.2). M is not formed in a step, its
factors M = L^T D L come from inertias I_A of what hangs on i while its joints are free to give way (articulated bodies: section 7.3):

    D_i = s_i . U_i + armature,  U_i = I_A s_i,  L_ij = U_i . s_j / D_i,      I_A - U_i U_i^T / D_i  is what the velocity before i sees.

About one O for a whole tree nothing has to be transformed on the way, and M^-1 J^T p is one sweep up and one down the tree.

c comes from the recursive Newton-Euler algorithm, at the mean of v and v_free: M (v_free - v) = h (f - c((v + v_free) / 2)). With the
present v it would feed energy to what spins. c changes by about h |v| of what the velocity does, so rounds end where the next one would
change nothing that matters.

A force r that joints pass on to a point x of a body turns with the joints above it: K_ij = a_j . sum of (dx/dq_i x r), a_j the axis
of rotation of j on the path to i. Where h^2 K is not small (light links that hold a heavy end swing at 1000 rad/s), M + h^2 K / 4 stands
for M: a swing at w then turns as before where h w is small, and is stable at any h w. Where h w > 2, which no step
resolves, it is damped as well (docs/theory.md). K_ij = s_j . G s_i, G a sum over what hangs on i, so that it enters I_A as an inertia does.

Contacts see a tree through half of J M^-1 J^T, y = D^-1/2 L^-T J^T (``Trees.half``): W_ij is the product of two halves over what their
paths share, and in z = D^1/2 L v the mass matrix is the identity.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import rigid
from .types import FREE as FREE_JOINT
from .types import KINEMATIC, OPTIONS, scalar_types

# Degrees of freedom (Tree.kind).
LINEAR = wp.constant(0)
ANGULAR = wp.constant(1)
BALL = wp.constant(2)  # the first of three about axes that the body carries, configuration a quaternion
BALL_ON = wp.constant(3)  # the other two
FREE = wp.constant(4)  # of a free body: velocity of the centre of mass and angular velocity, world axes
PRESCRIBED = wp.constant(5)  # of a kinematic body

# Rows of joints (Trees.row_kind, kernels/joint_rows.py).
LIMIT_LOW = wp.constant(0)
LIMIT_HIGH = wp.constant(1)
LOOP_WAY = wp.constant(2)
LOOP_TURN = wp.constant(3)
CLOSER = wp.constant(4)
FURTHER = wp.constant(5)

# Rounds in which c follows the mean velocity.
BIAS_ROUNDS = wp.constant(6)
SETTLED = wp.constant(1.0e-2)
# h^2 / 4 of the geometric stiffness goes into M where it is more than this part of a pivot of M...
STIFF = wp.constant(0.01)
# ... and where it is more than this part, the velocity is damped by this part of h times the stiffness.
UNRESOLVED = wp.constant(1.0)
CALM = wp.constant(0.1)
# What rows changed a step ago they are expected to change again, unless it was more than this part of the largest velocity.
LASTING = wp.constant(0.25)
# Where a step does not resolve c, M_ii is this part larger for joints, which takes a third of their velocity.
SLOWED = wp.constant(0.5)


@functools.cache
def functions(real) -> SimpleNamespace:
    """Bundle ``Trees``, and what other stages need of it."""
    t = scalar_types(real)
    vec3, mat33, transform, spatial = t.vec3, t.mat33, t.transform, t.spatial
    mat66 = wp.types.matrix(shape=(6, 6), dtype=real)

    @wp.struct
    class Trees:
        """B bodies, V velocities, N entries of M, D velocities on the longest path, R contacts, E environments.

        What a step makes is about O, in world axes.
        """

        # What does not change:
        order: wp.array(dtype=int)  # [B] bodies, parents before their children
        parent: wp.array(dtype=int)  # [B] -1 = world
        root: wp.array(dtype=int)  # [B] first body of its tree
        child_pose: wp.array(dtype=transform)  # [B] body frame in the joint's frame on the body
        first: wp.array(dtype=int)  # [B] first velocity of the joint above each body...
        end: wp.array(dtype=int)  # [B] ... and the one after its last
        last: wp.array(dtype=int)  # [B] last velocity that forces change on the path to a body, -1 = none
        kind: wp.array(dtype=int)  # [V] LINEAR ... PRESCRIBED
        axis: wp.array(dtype=vec3)  # [V] in the joint's frame
        before: wp.array(dtype=int)  # [V] the one before it on its path, -1 = none
        depth: wp.array(dtype=int)  # [V] how many come before it on its path
        path: wp.array2d(dtype=int)  # [B, D] velocities on the path to a body, from the root; -1 behind the last one
        shared: wp.array2d(dtype=int)  # [B, B] how many velocities the paths to two bodies have in common
        armature: wp.array2d(dtype=real)  # [1|E, V] added to M_ii, kg or kg m^2
        damping: wp.array2d(dtype=real)  # [1|E, V] force by velocity, N s/m or N m s
        stiffness: wp.array2d(dtype=real)  # [1|E, V] of a drive that may give any force, N/m or N m...
        rate: wp.array2d(dtype=real)  # [1|E, V] ... and what it gives by velocity
        coordinate: wp.array(dtype=int)  # [V] in q, -1 where a velocity has none of its own
        target: wp.array2d(dtype=real)  # [E, V] q* of the drives, m or rad
        target_rate: wp.array2d(dtype=real)  # [E, V] u*
        force: wp.array2d(dtype=real)  # [E, V] applied, N or N m
        # Rows of joints beside those of contacts (kernels/joint_rows.py), K of them at most:
        row_kind: wp.array(dtype=int)  # [K]
        row_velocity: wp.array(dtype=int)  # [K] of a limit, drive or friction; -1
        row_owner: wp.array(dtype=int)  # [K] body above which that velocity is
        row_body: wp.array(dtype=wp.vec2i)  # [K] of a loop or distance: a, b; -1 = world
        row_pose: wp.array2d(dtype=transform)  # [K, 2] frames on a and b
        row_held: wp.array(dtype=wp.vec3i)  # [K] of a loop: which axes of the frame on a it holds
        row_limit: wp.array(dtype=real)  # [K] m or rad
        row_length: wp.array(dtype=real)  # [K] of a loop's turns: radius of gyration that makes them velocities, m
        row_drive: wp.array2d(dtype=vec3)  # [1|E, K] k, b and greatest force of a drive that is a row
        row_friction: wp.array2d(dtype=real)  # [1|E, K] force of dry friction, N or N m
        row_scale: wp.array2d(dtype=vec3)  # [E, K] of a velocity: what its rows n, t1, t2 are times it, 0 where there is none, m or 1
        touching: wp.array(dtype=int)  # [E] number of contacts, which come before these rows
        # Shared with Bodies:
        com: wp.array2d(dtype=vec3)  # [E, B]
        inv_mass: wp.array2d(dtype=real)  # [E, B]
        free_velocity: wp.array2d(dtype=spatial)  # [E, B]
        # Of a step:
        origin: wp.array2d(dtype=vec3)  # [E, B] O of a tree, at its root
        screw: wp.array2d(dtype=spatial)  # [E, V] s_i: velocity at O, angular velocity
        taken: wp.array2d(dtype=spatial)  # [E, V] U_i / D_i: of an impulse along i what does not reach beyond it
        pivot: wp.array2d(dtype=real)  # [E, V] D_i
        scale: wp.array2d(dtype=real)  # [E, V] D^-1/2, 0 where the velocity is prescribed
        twist: wp.array2d(dtype=spatial)  # [E, B] velocity at O, angular velocity
        gained: wp.array2d(dtype=spatial)  # [E, B] what it becomes less that
        carried: wp.array2d(dtype=spatial)  # [E, B] acceleration of a body about O while all v_i stay as they are
        push: wp.array2d(dtype=spatial)  # [E, B] impulse of all but joints on a body, and its moment about O
        own: wp.array2d(dtype=mat33)  # [E, B] inertia of a body about its centre of mass
        mass: wp.array2d(dtype=real)  # [E, B] of all that hangs on a body, itself included...
        moment: wp.array2d(dtype=vec3)  # ... its mass times its centre of mass from O
        inertia: wp.array2d(dtype=mat33)  # ... and its inertia about O
        articulated: wp.array2d(dtype=mat66)  # [E, B] I_A
        pull: wp.array2d(dtype=vec3)  # [E, B] force that inertia and weight of what hangs on a body ask of its joint...
        virial: wp.array2d(dtype=mat33)  # ... and the sum of r x^T of its parts, x where it acts: what turns it into K
        given: wp.array2d(dtype=real)  # [E, V] impulse along a velocity that c does not change
        calming: wp.array2d(dtype=real)  # [E, V] damping of what no step resolves, N s/m or N m s
        free: wp.array2d(dtype=real)  # [E, V] v_free
        change: wp.array2d(dtype=real)  # [E, V] v+ - v_free in the end; scratch of the solver
        held: wp.array2d(dtype=real)  # [E, V] v+ - v_free of the step before
        expected: wp.array2d(dtype=real)  # [E, V] v and half of what rows may change of it
        longest: int  # D
        half: wp.array2d(dtype=vec3)  # [E, 2 R D] D^-1/2 L^-T J^T of each contact and side, world axes, by depth

    @wp.func
    def pair(top: vec3, bottom: vec3) -> spatial:
        return spatial(top[0], top[1], top[2], bottom[0], bottom[1], bottom[2])

    @wp.func
    def moved_by(twist: spatial, x: vec3) -> vec3:
        """Velocity at a point, x from O."""
        return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), x)

    @wp.func
    def added(trees: Trees, h: real, env: int, i: int) -> real:
        """What armature, damping and drives add to M_ii, implicit."""
        armature = trees.armature[env % trees.armature.shape[0], i]
        damping = trees.damping[env % trees.damping.shape[0], i] + trees.calming[env, i]
        stiffness = trees.stiffness[env % trees.stiffness.shape[0], i]
        return armature + h * (damping + trees.rate[env % trees.rate.shape[0], i] + h * stiffness)

    @wp.func
    def inertia_along(trees: Trees, h: real, env: int, b: int, i: int) -> real:
        """M_ii of a velocity of the joint above body b, with what damping adds to it."""
        linear = wp.spatial_top(trees.screw[env, i])
        angular = wp.spatial_bottom(trees.screw[env, i])
        moment = trees.moment[env, b]
        force = trees.mass[env, b] * linear + wp.cross(angular, moment)
        turning = trees.inertia[env, b] * angular + wp.cross(moment, linear)
        return wp.dot(linear, force) + wp.dot(angular, turning) + added(trees, h, env, i)

    @wp.func
    def descend(trees: Trees, gained: wp.array2d(dtype=spatial), env: int):
        """trees.change := L^-1 D^-1 of it, `gained` the twists of all bodies at those velocities."""
        for k in range(trees.order.shape[0]):
            b = trees.order[k]
            parent = trees.parent[b]
            twist = spatial()
            if parent >= 0:
                twist = gained[env, parent]
            for i in range(trees.first[b], trees.end[b]):
                scale = trees.scale[env, i]
                x = scale * scale * trees.change[env, i] - wp.dot(trees.taken[env, i], twist)
                trees.change[env, i] = x
                twist += x * trees.screw[env, i]
            gained[env, b] = twist

    @wp.func
    def propagate(trees: Trees, wrench: wp.array2d(dtype=spatial), gained: wp.array2d(dtype=spatial), env: int):
        """Impulses on all bodies about O and, in trees.change, along the joints become what they change of the velocities of both.

        M^-1 = L^-1 D^-1 L^-T; `gained` may be `wrench`.
        """
        bodies = trees.order.shape[0]
        for k in range(bodies):
            b = trees.order[bodies - 1 - k]
            push = wrench[env, b]
            first = trees.first[b]
            for ii in range(trees.end[b] - first):
                i = trees.end[b] - 1 - ii
                y = trees.change[env, i] + wp.dot(trees.screw[env, i], push)
                trees.change[env, i] = y
                push -= y * trees.taken[env, i]
            parent = trees.parent[b]
            if parent >= 0:
                wrench[env, parent] = wrench[env, parent] + push
        descend(trees, gained, env)

    @wp.func
    def respond(trees: Trees, velocity: wp.array2d(dtype=spatial), env: int):
        """Impulses on all bodies about their centres of mass [N s, N m s] become what they change of their velocities.

        trees.change: impulses along the joints before, what changes of their velocities after: M^-1 J^T p.
        """
        for b in range(trees.order.shape[0]):
            push = wp.spatial_top(velocity[env, b])
            r = trees.com[env, b] - trees.origin[env, trees.root[b]]
            velocity[env, b] = pair(push, wp.spatial_bottom(velocity[env, b]) + wp.cross(r, push))
        propagate(trees, velocity, velocity, env)
        for b in range(trees.order.shape[0]):
            r = trees.com[env, b] - trees.origin[env, trees.root[b]]
            velocity[env, b] = pair(moved_by(velocity[env, b], r), wp.spatial_bottom(velocity[env, b]))

    @wp.func
    def divide(trees: Trees, env: int, first: int, last: int, force: mat33, moment: mat33):
        """D^-1/2 L^-T J^T from velocity `last` on, of three wrenches about O there, the columns of force and moment."""
        i = int(last)
        while i >= 0:
            screw = trees.screw[env, i]
            taken = trees.taken[env, i]
            y = wp.spatial_top(screw) * force + wp.spatial_bottom(screw) * moment
            trees.half[env, first + trees.depth[i]] = trees.scale[env, i] * y
            force -= wp.outer(wp.spatial_top(taken), y)
            moment -= wp.outer(wp.spatial_bottom(taken), y)
            i = trees.before[i]

    @wp.func
    def halve(trees: Trees, env: int, side: int, body: int, point: vec3):
        """Of one side of a contact (number 2 i + side): J M^-1 J^T is the sum of the squares of its entries."""
        x = point - trees.origin[env, trees.root[body]]
        divide(trees, env, side * trees.longest, trees.last[body], wp.identity(n=3, dtype=real), wp.skew(x))

    @wp.func
    def product(
        shared: wp.array2d(dtype=int),
        half: wp.array2d(dtype=vec3),
        body: wp.array2d(dtype=wp.vec2i),
        longest: int,
        env: int,
        i: int,
        j: int,
    ) -> mat33:
        """Block (i, j) of J M^-1 J^T, world axes."""
        total = mat33()
        for x in range(2):
            for y in range(2):
                a = body[env, i][x]
                b = body[env, j][y]
                if a >= 0 and b >= 0:
                    block = mat33()
                    for d in range(shared[a, b]):
                        block += wp.outer(half[env, (2 * i + x) * longest + d], half[env, (2 * j + y) * longest + d])
                    if x == y:
                        total += block
                    else:
                        total -= block
        return total

    @wp.func
    def gather(trees: Trees, z: wp.array2d(dtype=real), env: int, i: int, body: wp.vec2i) -> vec3:
        """Velocity of contact i, world axes, from z = D^1/2 L v."""
        u = vec3()
        for side in range(2):
            if body[side] >= 0:
                v = trees.last[body[side]]
                while v >= 0:
                    u += real(2 * side - 1) * z[env, v] * trees.half[env, (2 * i + side) * trees.longest + trees.depth[v]]
                    v = trees.before[v]
        return u

    @wp.func
    def scatter(trees: Trees, z: wp.array2d(dtype=real), env: int, i: int, body: wp.vec2i, impulse: vec3):
        """What an impulse on contact i, world axes, adds to z."""
        for side in range(2):
            if body[side] >= 0:
                v = trees.last[body[side]]
                while v >= 0:
                    y = trees.half[env, (2 * i + side) * trees.longest + trees.depth[v]]
                    z[env, v] = z[env, v] + real(2 * side - 1) * wp.dot(y, impulse)
                    v = trees.before[v]

    @wp.func
    def push_joint(trees: Trees, wrench: wp.array2d(dtype=spatial), env: int, k: int, point: vec3, impulse: vec3):
        """Add the impulse of row k of the joints to the wrenches on the bodies, or to the impulses along the joints in trees.change."""
        i = trees.row_velocity[k]
        if i >= 0:
            scaled = wp.cw_mul(trees.row_scale[env, k], impulse)
            trees.change[env, i] = trees.change[env, i] + scaled[0] + scaled[1] + scaled[2]
        else:
            for side in range(2):
                b = trees.row_body[k][side]
                if b >= 0:
                    push = real(2 * side - 1) * impulse
                    part = pair(vec3(), push)
                    if trees.row_kind[k] != LOOP_TURN:
                        part = pair(push, wp.cross(point - trees.com[env, b], push))
                    wrench[env, b] = wrench[env, b] + part

    @wp.func
    def joint_velocity(trees: Trees, velocity: wp.array2d(dtype=spatial), env: int, k: int, point: vec3) -> vec3:
        """What row k of the joints sees of velocities of bodies, world axes, and of joints in trees.change."""
        i = trees.row_velocity[k]
        u = vec3()
        if i >= 0:
            u = trees.change[env, i] * trees.row_scale[env, k]
        else:
            for side in range(2):
                b = trees.row_body[k][side]
                if b >= 0:
                    part = wp.spatial_bottom(velocity[env, b])
                    if trees.row_kind[k] != LOOP_TURN:
                        part = wp.spatial_top(velocity[env, b]) + wp.cross(part, point - trees.com[env, b])
                    u += real(2 * side - 1) * part
        return u

    return SimpleNamespace(
        Trees=Trees,
        divide=divide,
        push_joint=push_joint,
        joint_velocity=joint_velocity,
        gather=gather,
        scatter=scatter,
        pair=pair,
        moved_by=moved_by,
        added=added,
        inertia_along=inertia_along,
        descend=descend,
        propagate=propagate,
        respond=respond,
        halve=halve,
        product=product,
    )


@functools.cache
def motion(real):
    """Function ``advance``: q+ = q + h Gamma(q) v of the joint above one body."""
    t = scalar_types(real)
    vec3, quat = t.vec3, t.quat
    Bodies, Topology = t.Bodies, t.Topology
    Trees = functions(real).Trees
    rotation_by, moved = rigid.functions(real).rotation_by, rigid.functions(real).moved

    @wp.func
    def advance(
        topology: Topology,
        trees: Trees,
        bodies: Bodies,
        v: wp.array2d(dtype=real),
        h: real,
        q: wp.array2d(dtype=real),
        env: int,
        b: int,
    ):
        i_q = topology.q_start[b]
        first = trees.first[b]
        kind = topology.joint_type[b]
        if kind == FREE_JOINT or kind == KINEMATIC:  # noqa: SIM109
            linear = vec3(v[env, first], v[env, first + 1], v[env, first + 2])
            turn = rotation_by(vec3(v[env, first + 3], v[env, first + 4], v[env, first + 5]), h)
            pose = moved(bodies.pose[env, b], bodies.com[env, b], linear, turn, h)
            for k in range(7):
                q[env, i_q + k] = pose[k]
        else:
            for i in range(first, trees.end[b]):
                if trees.kind[i] == BALL:
                    turn = quat(q[env, i_q], q[env, i_q + 1], q[env, i_q + 2], q[env, i_q + 3])
                    turn = wp.normalize(turn * rotation_by(vec3(v[env, i], v[env, i + 1], v[env, i + 2]), h))
                    for k in range(4):
                        q[env, i_q + k] = turn[k]
                    i_q += 4
                elif trees.kind[i] != BALL_ON:
                    q[env, i_q] = q[env, i_q] + h * v[env, i]
                    i_q += 1

    return advance


@functools.cache
def make(real) -> SimpleNamespace:
    """Kernels of scenes with joints; ``dynamics`` of any scene. Launch with dim (E)."""
    t = scalar_types(real)
    vec3, mat33, quat, transform, spatial = t.vec3, t.mat33, t.quat, t.transform, t.spatial
    Bodies, Parameters, Topology = t.Bodies, t.Parameters, t.Topology
    f = functions(real)
    Trees, pair, moved_by, propagate = f.Trees, f.pair, f.moved_by, f.propagate
    added, inertia_along = f.added, f.inertia_along
    mat66 = wp.types.matrix(shape=(6, 6), dtype=real)
    advance = motion(real)
    rounding = real(1.0e-16) if real is wp.float64 else real(1.0e-7)
    settled = real(1.0e-9) if real is wp.float64 else real(1.0e-6)

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def kinematics(
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        topology: Topology,
        parameters: Parameters,
        trees: Trees,
        bodies: Bodies,
        stride: int,
    ):
        """Poses, axes and velocities, from the roots to the leaves."""
        start, _ = wp.tid()
        for env in range(start, q.shape[0], stride):
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
        env: int,
    ):
        """trees.push := what gravity, wrenches and inertia give to each body within h [N s, N m s about O].

        At v + trees.change / 2, or at rest (part = 1, 0); their twists are trees.twist and trees.gained.
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
            force = m * (moved_by(acceleration, r) - gravity) + wp.cross(w, p) - wp.spatial_top(wrench[env, b])
            # The angular momentum about the centre of mass changes by w x I w and by what the acceleration adds.
            inertia = trees.own[env, b]
            moment = inertia * wp.spatial_bottom(acceleration) + wp.cross(w, inertia * w) - wp.spatial_bottom(wrench[env, b])
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

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
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
            forces(topology, parameters, trees, nothing, v, real(1.0), real(1.0), bodies, env)
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
        and v_free. (A four-bar at 2 ms turns too far by 11 mrad in 2 s with the latter, by 0.02 with the former.) A hit does not.
        """
        n = trees.before.shape[0]
        size = real(0.0)
        changed = real(0.0)
        for i in range(n):
            size = wp.max(size, wp.abs(v[env, i]))
            changed = wp.max(changed, wp.abs(trees.held[env, i]))
        part = real(0.0)
        if changed <= real(LASTING) * size:
            part = real(0.5)
        for i in range(n):
            trees.expected[env, i] = v[env, i] + part * trees.held[env, i]
        if part * changed > real(0.0):
            for k in range(trees.order.shape[0]):
                b = trees.order[k]
                more = spatial()
                if trees.parent[b] >= 0:
                    more = trees.gained[env, trees.parent[b]]
                for i in range(trees.first[b], trees.end[b]):
                    more += (part * trees.held[env, i]) * trees.screw[env, i]
                trees.gained[env, b] = more
                trees.twist[env, b] = trees.twist[env, b] + more
        return size

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
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
                forces(topology, parameters, trees, wrench, trees.expected, part, h, bodies, env)
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

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def integrate(
        topology: Topology,
        trees: Trees,
        bodies: Bodies,
        h: real,
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        stride: int,
    ):
        """v+ = v_free + M^-1 J^T p and q+ = q + h Gamma(q) v+ (eq. 23)."""
        start, b = wp.tid()
        for env in range(start, q.shape[0], stride):
            for i in range(trees.first[b], trees.end[b]):
                trees.held[env, i] = trees.change[env, i]
                v[env, i] = trees.free[env, i] + trees.change[env, i]
            advance(topology, trees, bodies, v, h, q, env, b)

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

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def reset_control(mask: wp.array(dtype=wp.bool), target: wp.array(dtype=real), rate: wp.array(dtype=real), trees: Trees):
        """Nothing is applied, nothing has held anything, and drives have the model's targets; launch with dim (E)."""
        env = wp.tid()
        if mask[env]:
            for i in range(trees.force.shape[1]):
                trees.held[env, i] = real(0.0)
                trees.force[env, i] = real(0.0)
                trees.target[env, i] = target[i]
                trees.target_rate[env, i] = rate[i]

    return SimpleNamespace(
        kinematics=kinematics,
        free_motion=free_motion,
        integrate=integrate,
        drift=drift,
        reset_control=reset_control,
        dynamics=dynamics,
    )
