# SPDX-License-Identifier: Apache-2.0
"""Kinematic trees in generalised coordinates: what all stages know of them (eqs. 13, 24). ``articulated`` moves them.

A joint is a few degrees of freedom, one after the other, from the frame on the parent to the frame on the body: translations
along axes of the frame on the parent, then rotations, each about an axis that those before it have turned; three of them at once
are a ball, with a quaternion. Each degree of freedom i has an axis s_i = (velocity at O, angular velocity) in world axes, O being
a point of its tree at which nothing is far away, so

    twist of a body = sum of s_i v_i over the path to it,      M_ij = s_i . I_c s_j   (j on the path to i),

I_c the inertia of all that hangs on i, about O (composite rigid bodies: Featherstone 2008, section 6.2). M is not formed in a step, its
factors M = L^T D L come from inertias I_A of what hangs on i while its joints are free to give way (articulated bodies: section 7.3):

    D_i = s_i . U_i + armature,  U_i = I_A s_i,  L_ij = U_i . s_j / D_i,      I_A - U_i U_i^T / D_i  is what the velocity before i sees.

About one O for a whole tree nothing has to be transformed on the way, and M^-1 J^T p is one sweep up and one down the tree.

Contacts see a tree through half of J M^-1 J^T, y = D^-1/2 L^-T J^T (``Trees.half``): W_ij is the product of two halves over what their
paths share, and in z = D^1/2 L v the mass matrix is the identity.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import rigid
from .types import FREE as FREE_JOINT
from .types import KINEMATIC, scalar_types

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
# What lands (Trees.landing, kernels/landing.py): what was hit or has no c, or what turns by too much.
HARD = wp.constant(1)
FAST = wp.constant(2)


@functools.cache
def functions(real) -> SimpleNamespace:
    """Bundle ``Trees``, and what other stages need of it."""
    t = scalar_types(real)
    vec2, vec3, mat33, transform, spatial = t.vec2, t.vec3, t.mat33, t.transform, t.spatial
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
        row_body: wp.array(dtype=wp.vec2i)  # [K] of a loop or distance: a, b; of a velocity: -1, the body below its joint; -1 = world
        row_pose: wp.array2d(dtype=transform)  # [K, 2] frames on a and b
        row_top: wp.array(dtype=wp.vec2i)  # [K] of a loop: uppermost bodies above a and b that no other of its bodies carries; -1 = none
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
        left: wp.array2d(dtype=real)  # [E, V] v as the step before left it
        bent: wp.array2d(dtype=spatial)  # [E, B] momentum that c takes from a body in a step, about its centre of mass
        momentum: wp.array2d(dtype=spatial)  # [E, B] what it goes on with where something was hit
        lands: wp.array(dtype=int)  # [E] may a tree have to land (kernels/landing.py)?
        # Of a tree, at its root:
        landing: wp.array2d(dtype=int)  # [E, B] was it hit, or turned by too much?
        allowed: wp.array2d(dtype=real)  # [E, B] twice the energy of motion that it may have at q+
        worth: wp.array2d(dtype=vec2)  # [E, B] twice the energy of motion, and the same of a change of momenta
        largest: wp.array2d(dtype=vec3)  # [E, B] velocity, what rows changed of one at once, and what v_free was beyond what was expected
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
        sides = int(2)  # as a variable: Warp would write out the loops, which makes four times the code
        for x in range(sides):
            a = body[env, i][x]
            if a >= 0:
                for y in range(sides):
                    b = body[env, j][y]
                    if b >= 0:
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
