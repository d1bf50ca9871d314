# SPDX-License-Identifier: Apache-2.0
"""Kinematic trees in generalised coordinates: poses, M(q), bias c(q, v), factors of M and free motion (eqs. 13, 24).

A joint is a few degrees of freedom, one after the other, from the frame on the parent to the frame on the body: translations
along axes of the frame on the parent, then rotations, each about an axis that those before it have turned; three of them at once
are a ball, with a quaternion. Each degree of freedom i has an axis s_i = (velocity at O, angular velocity) in world axes, O being
a point of its tree at which nothing is far away, so

    twist of a body = sum of s_i v_i over the path to it,      M_ij = s_i . I_c s_j   (j on the path to i),

I_c the inertia of all that hangs on i, about O (composite rigid bodies: Featherstone 2008, section 6.2). M has an entry only
where one degree of freedom is on the path to the other; it is kept in rows: M_ii, then those with the ancestors of i, nearest
first. M = L^T D L (Featherstone 2008, section 6.5) has no other entries.

c comes from the recursive Newton-Euler algorithm, at the mean of v and v_free: M (v_free - v) = h (f - c((v + v_free) / 2)). With the
present v it would feed energy to what spins.

A force r that joints pass on to a point x of a body turns with the joints above it: K_ij = a_j . sum of (dx/dq_i x r), a_j the axis
of rotation of j on the path to i. Where h^2 K is not small (light links that hold a heavy end swing at 1000 rad/s), M + h^2 K / 4 stands
for M: a swing at w then turns as before where h w is small, and is stable at any h w. Where h w > 2, which no step
resolves, it is damped as well (docs/theory.md).

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

# Rounds in which c follows the mean velocity, and the change [of the velocity] that ends them.
BIAS_ROUNDS = wp.constant(6)
# h^2 / 4 of the geometric stiffness goes into M where it is more than this part of a pivot of M...
STIFF = wp.constant(0.01)
# ... and where it is more than this part, the velocity is damped by this part of h times the stiffness.
UNRESOLVED = wp.constant(1.0)
CALM = wp.constant(0.1)
# Where a step does not resolve c, M_ii is this part larger for joints, which takes a third of their velocity.
SLOWED = wp.constant(0.5)


@functools.cache
def functions(real) -> SimpleNamespace:
    """Bundle ``Trees``, and what other stages need of it."""
    t = scalar_types(real)
    vec3, mat33, transform, spatial = t.vec3, t.mat33, t.transform, t.spatial

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
        row: wp.array(dtype=int)  # [V + 1] first entry of its row of M
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
        linear: wp.array2d(dtype=vec3)  # [E, V] s_i: velocity at O
        angular: wp.array2d(dtype=vec3)  # [E, V]
        twist: wp.array2d(dtype=spatial)  # [E, B] velocity at O, angular velocity
        acceleration: wp.array2d(dtype=spatial)  # [E, B] of a body while all v_i stay as they are; then the force that it takes
        own: wp.array2d(dtype=mat33)  # [E, B] inertia of a body about its centre of mass
        mass: wp.array2d(dtype=real)  # [E, B] of all that hangs on a body, itself included...
        moment: wp.array2d(dtype=vec3)  # ... its mass times its centre of mass from O
        inertia: wp.array2d(dtype=mat33)  # ... and its inertia about O
        matrix: wp.array2d(dtype=real)  # [E, N] M + h (damping), row by row
        stiff: wp.array2d(dtype=real)  # [E, N] h^2 / 4 of the geometric stiffness
        factor: wp.array2d(dtype=real)  # [E, N] L, and D on the diagonal
        calming: wp.array2d(dtype=real)  # [E, V] damping of what no step resolves, N s/m or N m s
        scale: wp.array2d(dtype=real)  # [E, V] D^-1/2
        mean: wp.array2d(dtype=real)  # [E, V] (v + v_free) / 2
        free: wp.array2d(dtype=real)  # [E, V] v_free
        change: wp.array2d(dtype=real)  # [E, V] v+ - v_free in the end; scratch of the solver
        longest: int  # D
        half: wp.array2d(dtype=vec3)  # [E, 2 R D] D^-1/2 L^-T J^T of each contact and side, world axes, by depth

    @wp.func
    def factorise(before: wp.array(dtype=int), row: wp.array(dtype=int), factor: wp.array2d(dtype=real), env: int):
        """M in `factor` becomes L and D, from the leaves to the roots, without fill."""
        n = before.shape[0]
        for kk in range(n):
            k = n - 1 - kk
            at = row[k]
            inverse = real(1.0) / factor[env, at]
            i = before[k]
            e = at + 1
            while i >= 0:
                a = factor[env, e] * inverse
                for c in range(row[i + 1] - row[i]):
                    factor[env, row[i] + c] = factor[env, row[i] + c] - a * factor[env, e + c]
                factor[env, e] = a
                i = before[i]
                e += 1

    @wp.func
    def solve(before: wp.array(dtype=int), row: wp.array(dtype=int), factor: wp.array2d(dtype=real), x: wp.array2d(dtype=real), env: int):
        """x := M^-1 x = L^-1 D^-1 L^-T x."""
        n = before.shape[0]
        for kk in range(n):
            k = n - 1 - kk
            y = x[env, k]
            if y != real(0.0):
                j = before[k]
                for e in range(row[k] + 1, row[k + 1]):
                    x[env, j] = x[env, j] - factor[env, e] * y
                    j = before[j]
        for k in range(n):
            y = x[env, k] / factor[env, row[k]]
            j = before[k]
            for e in range(row[k] + 1, row[k + 1]):
                y -= factor[env, e] * x[env, j]
                j = before[j]
            x[env, k] = y

    @wp.func
    def pair(top: vec3, bottom: vec3) -> spatial:
        return spatial(top[0], top[1], top[2], bottom[0], bottom[1], bottom[2])

    @wp.func
    def moved_by(twist: spatial, x: vec3) -> vec3:
        """Velocity at a point, x from O."""
        return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), x)

    @wp.func
    def twists(trees: Trees, rates: wp.array2d(dtype=real), velocity: wp.array2d(dtype=spatial), env: int):
        """Velocities of all bodies (centre of mass, angular) from those of the joints; trees.twist about O."""
        for k in range(trees.order.shape[0]):
            b = trees.order[k]
            parent = trees.parent[b]
            twist = spatial()
            if parent >= 0:
                twist = trees.twist[env, parent]
            for i in range(trees.first[b], trees.end[b]):
                twist += rates[env, i] * pair(trees.linear[env, i], trees.angular[env, i])
            trees.twist[env, b] = twist
            r = trees.com[env, b] - trees.origin[env, trees.root[b]]
            velocity[env, b] = pair(moved_by(twist, r), wp.spatial_bottom(twist))

    @wp.func
    def respond(trees: Trees, velocity: wp.array2d(dtype=spatial), env: int):
        """Wrenches on all bodies about their centres of mass [N s, N m s] become what they change of their velocities.

        trees.change: impulses along the joints before, what changes of their velocities after: M^-1 J^T p.
        """
        for b in range(trees.order.shape[0]):
            push = wp.spatial_top(velocity[env, b])
            r = trees.com[env, b] - trees.origin[env, trees.root[b]]
            velocity[env, b] = pair(push, wp.spatial_bottom(velocity[env, b]) + wp.cross(r, push))
        for k in range(trees.order.shape[0]):
            b = trees.order[trees.order.shape[0] - 1 - k]
            wrench = velocity[env, b]
            for i in range(trees.first[b], trees.end[b]):
                trees.change[env, i] = trees.change[env, i] + wp.dot(pair(trees.linear[env, i], trees.angular[env, i]), wrench)
                if trees.kind[i] == PRESCRIBED:
                    trees.change[env, i] = real(0.0)
            parent = trees.parent[b]
            if parent >= 0:
                velocity[env, parent] = velocity[env, parent] + wrench
        solve(trees.before, trees.row, trees.factor, trees.change, env)
        twists(trees, trees.change, velocity, env)

    @wp.func
    def divide(trees: Trees, env: int, first: int, body: int):
        """J^T on the path to a body becomes D^-1/2 L^-T J^T."""
        i = trees.last[body]
        while i >= 0:
            at = first + trees.depth[i]
            y = trees.half[env, at]
            for e in range(trees.row[i] + 1, trees.row[i + 1]):
                at -= 1
                trees.half[env, at] = trees.half[env, at] - trees.factor[env, e] * y
            trees.half[env, first + trees.depth[i]] = trees.scale[env, i] * y
            i = trees.before[i]

    @wp.func
    def halve(trees: Trees, env: int, side: int, body: int, point: vec3):
        """Of one side of a contact (number 2 i + side): J M^-1 J^T is the sum of the squares of its entries."""
        x = point - trees.origin[env, trees.root[body]]
        first = side * trees.longest
        i = trees.last[body]
        while i >= 0:
            trees.half[env, first + trees.depth[i]] = trees.linear[env, i] + wp.cross(trees.angular[env, i], x)
            i = trees.before[i]
        divide(trees, env, first, body)

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
        factorise=factorise,
        solve=solve,
        pair=pair,
        moved_by=moved_by,
        twists=twists,
        respond=respond,
        halve=halve,
        product=product,
    )


@functools.cache
def make(real) -> SimpleNamespace:
    """Kernels of scenes with joints; ``dynamics`` of any scene. Launch with dim (E)."""
    t = scalar_types(real)
    vec3, mat33, quat, transform, spatial = t.vec3, t.mat33, t.quat, t.transform, t.spatial
    Bodies, Parameters, Topology = t.Bodies, t.Parameters, t.Topology
    f = functions(real)
    Trees, factorise, solve = f.Trees, f.factorise, f.solve
    pair, moved_by, twists = f.pair, f.moved_by, f.twists
    rotation_by, moved = rigid.functions(real).rotation_by, rigid.functions(real).moved
    settled = real(1.0e-10) if real is wp.float64 else real(1.0e-6)

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
                        trees.linear[env, i] = axis
                        trees.angular[env, i] = vec3()
                        trees.linear[env, i + 3] = vec3()
                        trees.angular[env, i + 3] = axis
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
                        trees.linear[env, i] = linear
                        trees.angular[env, i] = angular
                        twist += v[env, i] * pair(linear, angular)
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
    def accelerations(topology: Topology, trees: Trees, with_change: real, env: int):
        """Twists at the velocities trees.mean, and accelerations of bodies about O while dv/dt is with_change [1/s] times trees.change."""
        for k in range(trees.order.shape[0]):
            b = trees.order[k]
            parent = trees.parent[b]
            twist = spatial()
            acceleration = spatial()
            if parent >= 0:
                twist = trees.twist[env, parent]
                acceleration = trees.acceleration[env, parent]
            carried = twist  # what carries the axes of a ball, all three: what was before them
            for i in range(trees.first[b], trees.end[b]):
                s = pair(trees.linear[env, i], trees.angular[env, i])
                rate = trees.mean[env, i]
                kind = trees.kind[i]
                if kind < FREE:
                    if kind != BALL_ON:
                        carried = twist
                    acceleration += rate * cross_motion(carried, s)
                acceleration += with_change * trees.change[env, i] * s
                twist += rate * s
            if topology.joint_type[b] == FREE_JOINT or topology.joint_type[b] == KINEMATIC:
                # The axes of rotation go through the centre of mass and move with it.
                acceleration += pair(wp.cross(wp.spatial_top(twist), wp.spatial_bottom(twist)), vec3())
            trees.twist[env, b] = twist
            trees.acceleration[env, b] = acceleration

    @wp.func
    def own_force(m: real, r: vec3, inertia: mat33, twist: spatial, acceleration: spatial):
        """Force at the centre of mass, r from O, and moment about O that a body takes: I a + v x* I v; inertia about that centre."""
        w = wp.spatial_bottom(twist)
        p = m * moved_by(twist, r)
        force = m * moved_by(acceleration, r) + wp.cross(w, p)
        # Of the angular momentum L = I w + r x p about O:  w x L + v_O x p, and what the acceleration adds.
        moment = inertia * wp.spatial_bottom(acceleration) + wp.cross(r, m * moved_by(acceleration, r))
        moment += wp.cross(w, inertia * w + wp.cross(r, p)) + wp.cross(wp.spatial_top(twist), p)
        return force, moment

    @wp.func
    def forces(
        topology: Topology,
        parameters: Parameters,
        trees: Trees,
        wrench: wp.array2d(dtype=spatial),
        bodies: Bodies,
        env: int,
    ):
        """trees.change := f_a - c at the velocities trees.mean: what gravity, wrenches and inertia leave along each axis."""
        accelerations(topology, trees, real(0.0), env)
        gravity = parameters.gravity[env % parameters.gravity.shape[0]]
        for b in range(trees.parent.shape[0]):
            r = bodies.com[env, b] - trees.origin[env, trees.root[b]]
            m = parameters.mass[env % parameters.mass.shape[0], b]
            force, moment = own_force(m, r, trees.own[env, b], trees.twist[env, b], trees.acceleration[env, b])
            applied = m * gravity + wp.spatial_top(wrench[env, b])
            trees.acceleration[env, b] = pair(force - applied, moment - wp.cross(r, applied) - wp.spatial_bottom(wrench[env, b]))
        for k in range(trees.order.shape[0]):
            b = trees.order[trees.order.shape[0] - 1 - k]
            taken = trees.acceleration[env, b]
            for i in range(trees.first[b], trees.end[b]):
                trees.change[env, i] = -wp.dot(pair(trees.linear[env, i], trees.angular[env, i]), taken)
            parent = trees.parent[b]
            if parent >= 0:
                trees.acceleration[env, parent] = trees.acceleration[env, parent] + taken

    @wp.func
    def stiffen(
        topology: Topology,
        parameters: Parameters,
        trees: Trees,
        wrench: wp.array2d(dtype=spatial),
        bodies: Bodies,
        h: real,
        env: int,
    ) -> bool:
        """Add h^2 / 4 of the geometric stiffness to M where it matters, see above; trees.change is v_free - v as it is without."""
        accelerations(topology, trees, real(1.0) / h, env)
        gravity = parameters.gravity[env % parameters.gravity.shape[0]]
        for b in range(trees.parent.shape[0]):
            r = bodies.com[env, b] - trees.origin[env, trees.root[b]]
            m = parameters.mass[env % parameters.mass.shape[0], b]
            force, _ = own_force(m, r, trees.own[env, b], trees.twist[env, b], trees.acceleration[env, b])
            force -= m * gravity + wp.spatial_top(wrench[env, b])
            trees.moment[env, b] = force
            trees.inertia[env, b] = wp.outer(r, force)
        matters = bool(False)
        for k in range(trees.order.shape[0]):
            b = trees.order[trees.order.shape[0] - 1 - k]
            parent = trees.parent[b]
            force = trees.moment[env, b]
            virial = trees.inertia[env, b]
            if parent >= 0:
                trees.moment[env, parent] = trees.moment[env, parent] + force
                trees.inertia[env, parent] = trees.inertia[env, parent] + virial
            for i in range(trees.first[b], trees.end[b]):
                if trees.kind[i] != PRESCRIBED:
                    angular = trees.angular[env, i]
                    g = wp.cross(trees.linear[env, i], force) + virial * angular - wp.trace(virial) * angular
                    g = real(0.25) * h * h * g
                    at = trees.row[i]
                    matters = matters or wp.abs(wp.dot(g, angular)) > real(STIFF) * trees.factor[env, at]
                    j = int(i)
                    for e in range(at, trees.row[i + 1]):
                        trees.stiff[env, e] = wp.dot(trees.angular[env, j], g)
                        j = trees.before[j]
                    own = wp.dot(g, angular)
                    if own > real(UNRESOLVED) * trees.factor[env, at]:
                        trees.calming[env, i] = real(CALM) * real(4.0) * own / h
                        trees.stiff[env, at] = trees.stiff[env, at] + h * trees.calming[env, i]
        if matters:
            n = trees.before.shape[0]
            for e in range(trees.matrix.shape[1]):
                trees.factor[env, e] = trees.matrix[env, e] + trees.stiff[env, e]
            factorise(trees.before, trees.row, trees.factor, env)
            positive = bool(True)
            for i in range(n):
                positive = positive and trees.factor[env, trees.row[i]] > real(0.0)
            for e in range(trees.matrix.shape[1]):
                if positive:
                    trees.matrix[env, e] = trees.matrix[env, e] + trees.stiff[env, e]
                else:
                    trees.factor[env, e] = trees.matrix[env, e]
            if not positive:  # something is about to topple: without
                factorise(trees.before, trees.row, trees.factor, env)
                for i in range(n):
                    trees.calming[env, i] = real(0.0)
        return matters

    @wp.func
    def drive(trees: Trees, q: wp.array2d(dtype=real), v: wp.array2d(dtype=real), h: real, env: int):
        """trees.change from forces along the joints to impulses, with damping and drives, implicit: what is in M is taken from them."""
        for i in range(trees.before.shape[0]):
            force = trees.change[env, i] + trees.force[env, i]
            force -= (trees.damping[env % trees.damping.shape[0], i] + trees.calming[env, i]) * v[env, i]
            stiffness = trees.stiffness[env % trees.stiffness.shape[0], i]
            rate = trees.rate[env % trees.rate.shape[0], i]
            if stiffness > real(0.0):  # which a velocity without a coordinate does not have
                force += stiffness * (trees.target[env, i] - q[env, trees.coordinate[i]] - h * v[env, i])
            if stiffness > real(0.0) or rate > real(0.0):
                force += rate * (trees.target_rate[env, i] - v[env, i])
            trees.change[env, i] = h * force
            if trees.kind[i] == PRESCRIBED:
                trees.change[env, i] = real(0.0)

    @wp.func
    def mass_matrix(topology: Topology, parameters: Parameters, trees: Trees, bodies: Bodies, h: real, env: int):
        """Rows of M, with what damping adds to it in an implicit step."""
        for b in range(trees.parent.shape[0]):
            rotation = wp.quat_to_matrix(wp.transform_get_rotation(bodies.pose[env, b]))
            own = rotation * parameters.inertia[env % parameters.inertia.shape[0], b] * wp.transpose(rotation)
            m = parameters.mass[env % parameters.mass.shape[0], b]
            r = bodies.com[env, b] - trees.origin[env, trees.root[b]]
            trees.own[env, b] = own
            trees.mass[env, b] = m
            trees.moment[env, b] = m * r
            trees.inertia[env, b] = own + m * (wp.diag(vec3(wp.dot(r, r))) - wp.outer(r, r))
        for k in range(trees.order.shape[0]):
            b = trees.order[trees.order.shape[0] - 1 - k]
            parent = trees.parent[b]
            m = trees.mass[env, b]
            moment = trees.moment[env, b]
            inertia = trees.inertia[env, b]
            if parent >= 0:
                trees.mass[env, parent] = trees.mass[env, parent] + m
                trees.moment[env, parent] = trees.moment[env, parent] + moment
                trees.inertia[env, parent] = trees.inertia[env, parent] + inertia
            for i in range(trees.first[b], trees.end[b]):
                at = trees.row[i]
                linear = trees.linear[env, i]
                angular = trees.angular[env, i]
                force = m * linear + wp.cross(angular, moment)
                turning = inertia * angular + wp.cross(moment, linear)
                j = int(i)
                for e in range(at, trees.row[i + 1]):
                    trees.matrix[env, e] = wp.dot(trees.linear[env, j], force) + wp.dot(trees.angular[env, j], turning)
                    j = trees.before[j]
                added = trees.armature[env % trees.armature.shape[0], i] + h * trees.damping[env % trees.damping.shape[0], i]
                added += h * (h * trees.stiffness[env % trees.stiffness.shape[0], i] + trees.rate[env % trees.rate.shape[0], i])
                trees.matrix[env, at] = trees.matrix[env, at] + added
                if trees.kind[i] == PRESCRIBED:
                    trees.matrix[env, at] = real(1.0)
        for e in range(trees.matrix.shape[1]):
            trees.factor[env, e] = trees.matrix[env, e]
        factorise(trees.before, trees.row, trees.factor, env)

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
            mass_matrix(topology, parameters, trees, bodies, real(0.0), env)
            for i in range(trees.before.shape[0]):
                trees.mean[env, i] = v[env, i]
                j = int(i)
                for e in range(trees.row[i], trees.row[i + 1]):
                    mass[env, i, j] = trees.matrix[env, e]
                    mass[env, j, i] = trees.matrix[env, e]
                    j = trees.before[j]
            forces(topology, parameters, trees, nothing, bodies, env)
            for i in range(trees.before.shape[0]):
                bias[env, i] = -trees.change[env, i]
                if trees.kind[i] == PRESCRIBED:
                    bias[env, i] = real(0.0)

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
            mass_matrix(topology, parameters, trees, bodies, h, env)
            n = trees.before.shape[0]
            size = real(0.0)
            for i in range(n):
                trees.mean[env, i] = v[env, i]
                trees.free[env, i] = v[env, i]
                trees.calming[env, i] = real(0.0)
                size = wp.max(size, wp.abs(v[env, i]))
            searching = bool(True)
            rounds = int(0)
            before = real(0.0)
            while searching:
                forces(topology, parameters, trees, wrench, bodies, env)
                drive(trees, q, v, h, env)
                solve(trees.before, trees.row, trees.factor, trees.change, env)
                moved = real(0.0)
                for i in range(n):
                    after = v[env, i] + trees.change[env, i]
                    moved = wp.max(moved, wp.abs(after - trees.free[env, i]))
                    trees.free[env, i] = after
                    trees.mean[env, i] = real(0.5) * (v[env, i] + after)
                rounds += 1
                searching = moved > settled * size and rounds < BIAS_ROUNDS
                if rounds == 1:
                    if stiffen(topology, parameters, trees, wrench, bodies, h, env):
                        searching = True
                elif searching and rounds > 2 and moved > real(0.5) * before:
                    # Rounds do not settle, a joint turns by about a radian in a step: without c, which would grow with the square of v,
                    # and joints calmed, as turning from one pose to another feeds them.
                    for i in range(n):
                        trees.mean[env, i] = real(0.0)
                        if trees.kind[i] < FREE:
                            own = real(SLOWED) * trees.matrix[env, trees.row[i]]
                            trees.calming[env, i] = trees.calming[env, i] + own / h
                            trees.matrix[env, trees.row[i]] = trees.matrix[env, trees.row[i]] + own
                    for e in range(trees.matrix.shape[1]):
                        trees.factor[env, e] = trees.matrix[env, e]
                    factorise(trees.before, trees.row, trees.factor, env)
                    rounds = BIAS_ROUNDS - 1
                before = moved
            for i in range(n):
                trees.scale[env, i] = real(1.0) / wp.sqrt(trees.factor[env, trees.row[i]])
            twists(trees, trees.free, bodies.free_velocity, env)
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
            i_q = topology.q_start[b]
            first = trees.first[b]
            kind = topology.joint_type[b]
            for i in range(first, trees.end[b]):
                v[env, i] = trees.free[env, i] + trees.change[env, i]
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

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def reset_control(mask: wp.array(dtype=wp.bool), target: wp.array(dtype=real), rate: wp.array(dtype=real), trees: Trees):
        """Nothing is applied, and drives have the model's targets; launch with dim (E)."""
        env = wp.tid()
        if mask[env]:
            for i in range(trees.force.shape[1]):
                trees.force[env, i] = real(0.0)
                trees.target[env, i] = target[i]
                trees.target_rate[env, i] = rate[i]

    return SimpleNamespace(
        kinematics=kinematics, free_motion=free_motion, integrate=integrate, reset_control=reset_control, dynamics=dynamics
    )
