# SPDX-License-Identifier: Apache-2.0
"""Rows that joints put behind those of the contacts: limits, drives and dry friction of one velocity, and joints that close loops.

Each is a contact with another Jacobian, three rows that the same laws and methods solve:

    of a velocity   n: a limit, u_n + phi / h >= 0;  t1: a drive that gives no more than its greatest force F, |p| <= h F;
                    t2: dry friction, |p| <= h F.  All three along the velocity's axis.
    of a loop       three ways, or turns, between two frames that the joint does not let happen; any impulse (eqs. 14, 25).
    of a distance   n: no closer, or no further, than a distance.

A row that has nothing to do has a Jacobian of zero. Rows of angles are scaled by the radius of gyration of what hangs on the joint, so that
they are velocities [m/s] and impulses [N s] like all others.

A drive is implicit, p = -h (k (q + h u - q*) + b (u - u*)): a row with relaxation 1 / (h (h k + b)). One that may give any force
is no row but a part of M (kernels/tree.py).
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import tree
from .declare import factory, kernel
from .tree import CLOSER, LIMIT_HIGH, LINEAR, LOOP_TURN, LOOP_WAY
from .types import HELD, scalar_types

# Stiffness and damping of limits and distances for each kg that they hold: Table 1.
STIFFNESS = wp.constant(1.0e10)
DAMPING = wp.constant(1.0e8)
# Dry friction gives way by this part of the velocity that it stops in a step.
FRICTION_RELAXATION = wp.constant(1.0e-9)
# A loop gives way by this part of the velocity that it stops in a step, and takes it back in the next. It is no spring: one of Table 1's
# stiffness throws back what a short step resolves of it, an eighth of an impact at 0.1 ms where a light rod stops a heavy one; with
# this it is 3e-4 at any step. With less than this part, rows that are redundant in the pose but not where the loop is open take part:
# Bricard's mechanism is 0.2 mm off at 4 ms by the midpoint rule, 1.3 mm with 1e-6 and 12 mm with 1e-7.
LOOP_RELAXATION = {wp.float64: 1.0e-5, wp.float32: 1.0e-4}
# What is further from where it should be is corrected no faster than this [m/s].
MAX_CORRECTION = wp.constant(3.0)
# Near a dead point of a loop next to nothing gives way to a pull p along its links, and at 3 m/s they would fly about: p becomes W x with
# (W + lambda) x = p, lambda = max(DAMPED |p|, STIFFEST) / m, m the mass of the loop and what hangs on it. Such damped least squares vanish
# with the gap. (A chain stretched 0.1 mm short of its end turned at 888 rad/s.)
DAMPED = wp.constant(0.02)  # s/m
STIFFEST = wp.constant(1.0e-6)
# A row of a loop along which the joints of its bodies let nothing move, but for this part of what they would do without, is left out.
IMMOBILE = wp.constant(1.0e-10)


@functools.cache
def functions(real) -> SimpleNamespace:
    """``loop_error``: what a joint that closes a loop holds, and by how much it is apart."""
    t = scalar_types(real)
    vec3, mat33, transform = t.vec3, t.mat33, t.transform

    @wp.func
    def axis_of(turn: mat33, k: int) -> vec3:
        """Column k of a rotation: where it carries axis k."""
        return vec3(turn[0, k], turn[1, k], turn[2, k])

    @wp.func
    def turn_error(a: mat33, b: mat33, held: wp.vec3i):
        """Axes, in world axes, about which frame b is turned from a although they are held, and by how much [rad]; rows, zero where not."""
        number = held[0] + held[1] + held[2]
        frame = mat33()
        angle = vec3()
        if number == 3:
            # e = sum of a_k x b_k / 2: the axis times the sine of the angle; beyond a right angle its length stays where it is.
            e = real(0.5) * (wp.cross(axis_of(a, 0), axis_of(b, 0)) + wp.cross(axis_of(a, 1), axis_of(b, 1)))
            e += real(0.5) * wp.cross(axis_of(a, 2), axis_of(b, 2))
            frame = wp.transpose(a)
            angle = frame * e
        elif number == 2:
            free = int(0)
            for k in range(3):
                if held[k] == 0:
                    free = k
            e = wp.cross(axis_of(a, free), axis_of(b, free))
            for k in range(3):
                if k != free:
                    for c in range(3):
                        frame[k, c] = a[c, k]
                    angle[k] = wp.dot(axis_of(a, k), e)
        elif number == 1:
            one = int(0)
            for k in range(3):
                if held[k] != 0:
                    one = k
            # Of the two free axes the first is carried by a, the second by b: they stay perpendicular.
            first = (one + 1) % 3
            second = (one + 2) % 3
            if first > second:
                first = (one + 2) % 3
                second = (one + 1) % 3
            axis = wp.cross(axis_of(a, first), axis_of(b, second))
            angle[one] = -wp.dot(axis_of(a, first), axis_of(b, second))
            size = wp.length(axis)
            for c in range(3):
                frame[one, c] = axis[c] / size
        return frame, angle

    @wp.func
    def loop_error(kind: int, pose_a: transform, pose_b: transform, held: wp.vec3i, length: real):
        """Rows of a loop's three ways, or turns, in world axes, those of turns times a length, and how far each is off [m]."""
        a = wp.quat_to_matrix(wp.transform_get_rotation(pose_a))
        frame = mat33()
        phi = vec3()
        if kind == LOOP_WAY:
            for r in range(3):
                if held[r] != 0:
                    for c in range(3):
                        frame[r, c] = a[c, r]
            phi = frame * (wp.transform_get_translation(pose_b) - wp.transform_get_translation(pose_a))
        elif kind == LOOP_TURN:
            axes, angle = turn_error(a, wp.quat_to_matrix(wp.transform_get_rotation(pose_b)), held)
            frame = length * axes
            phi = length * angle
        return frame, phi

    @wp.func
    def damped(w: mat33, damping: real, p: vec3) -> vec3:
        """w (w + damping)^-1 p of a positive semidefinite matrix, by factors L D L^T: cofactors cancel in single precision."""
        d0 = w[0, 0] + damping
        l1 = w[1, 0] / d0
        l2 = w[2, 0] / d0
        d1 = w[1, 1] + damping - l1 * w[1, 0]
        s = w[2, 1] - l2 * w[1, 0]
        l3 = s / d1
        d2 = w[2, 2] + damping - l2 * w[2, 0] - l3 * s
        y = vec3(p[0], p[1] - l1 * p[0], real(0.0))
        x = vec3(real(0.0), real(0.0), (p[2] - l2 * p[0] - l3 * y[1]) / d2)
        x[1] = y[1] / d1 - l3 * x[2]
        x[0] = y[0] / d0 - l1 * x[1] - l2 * x[2]
        return p - damping * x

    return SimpleNamespace(loop_error=loop_error, damped=damped)


@factory
def make(real):
    """Kernel ``joint_rows``; launch with dim (E), after the contacts' rows."""
    t = scalar_types(real)
    vec2, vec3, mat33 = t.vec2, t.vec3, t.mat33
    Bodies, Contacts = t.Bodies, t.Contacts
    forest = tree.functions(real)
    Trees, divide, product, inertia_along = forest.Trees, forest.divide, forest.product, forest.inertia_along
    f = functions(real)
    loop_error, damped = f.loop_error, f.damped
    loop_relaxation = real(LOOP_RELAXATION[real])

    @wp.func
    def stop(phi: real, h: real, w: real):
        """Relaxation and shift of a row that keeps phi [m] from falling below zero, w = J M^-1 J^T (eqs. 40, 41).

        Until it is reached, u + phi / h >= 0.
        """
        k = real(STIFFNESS)
        b = real(DAMPING)
        d = wp.max(k * phi / (h * k + b), -real(MAX_CORRECTION))
        if phi > real(0.0):
            d = phi / h
        return w / (h * (h * k + b)), d

    @kernel()
    def joint_rows(
        trees: Trees,
        bodies: Bodies,
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        h: real,
        contacts: Contacts,
        stride: int,
    ):
        start, _ = wp.tid()
        sides = int(2)  # as a variable: Warp would write out the loops over them, which makes twice the code
        for env in range(start, contacts.count.shape[0], stride):
            n = contacts.count[env]
            trees.touching[env] = n
            for k in range(trees.row_kind.shape[0]):
                kind = trees.row_kind[k]
                i = trees.row_velocity[k]
                body = trees.row_body[k]
                # Rows of what point, along what, how far they are from where they stop or hold, and do any of them matter?
                point = vec3()
                frame = wp.identity(n=3, dtype=real)
                phi = vec3()
                needed = bool(True)
                stops = bool(False)  # is row n kept from falling below zero?
                directions = int(HELD)
                free = vec3()
                scale = vec3()
                length = real(1.0)
                stiff = real(0.0)
                friction = real(0.0)
                drive = vec3()
                if i >= 0:
                    sign = real(1.0)
                    if kind == LIMIT_HIGH:
                        sign = real(-1.0)
                    drive = trees.row_drive[env % trees.row_drive.shape[0], k]
                    friction = trees.row_friction[env % trees.row_friction.shape[0], k]
                    gap = sign * (q[env, trees.coordinate[i]] - trees.row_limit[k])
                    stops = gap < real(2.0) * h * wp.max(wp.abs(v[env, i]), wp.abs(trees.free[env, i])) + real(1.0e-6)
                    stiff = h * (h * drive[0] + drive[1])
                    needed = stops or stiff > real(0.0) or friction > real(0.0)
                    directions = 2
                    point = bodies.com[env, body[1]]
                    if needed and trees.kind[i] != LINEAR:
                        length = wp.sqrt(inertia_along(trees, h, env, body[1], i) / trees.mass[env, body[1]])
                    phi[0] = length * gap
                    if stops:
                        scale[0] = sign * length
                    if stiff > real(0.0):
                        scale[1] = length
                    if friction > real(0.0):
                        scale[2] = length
                    free = trees.free[env, i] * scale
                else:
                    pose_a = trees.row_pose[k, 0]
                    pose_b = trees.row_pose[k, 1]
                    if body[0] >= 0:
                        pose_a = bodies.pose[env, body[0]] * pose_a
                    if body[1] >= 0:
                        pose_b = bodies.pose[env, body[1]] * pose_b
                    point = wp.transform_get_translation(pose_b)
                    frame, phi = loop_error(kind, pose_a, pose_b, trees.row_held[k], trees.row_length[k])
                    if kind != LOOP_WAY and kind != LOOP_TURN:
                        apart = point - wp.transform_get_translation(pose_a)
                        directions = 0
                        stops = bool(True)
                        distance = wp.length(apart)
                        away = real(-1.0)
                        if kind == CLOSER:
                            away = real(1.0)
                        along = apart * (away / wp.max(distance, real(1.0e-9)))
                        frame[0] = along
                        phi[0] = away * (distance - trees.row_limit[k])
                    # Velocities of b relative to a there, present and free.
                    u = vec3()
                    u_free = vec3()
                    for side in range(sides):
                        b = body[side]
                        if b >= 0:
                            s = real(2 * side - 1)
                            present = wp.spatial_bottom(bodies.velocity[env, b])
                            ahead = wp.spatial_bottom(bodies.free_velocity[env, b])
                            if kind != LOOP_TURN:
                                arm = point - bodies.com[env, b]
                                present = wp.spatial_top(bodies.velocity[env, b]) + wp.cross(present, arm)
                                ahead = wp.spatial_top(bodies.free_velocity[env, b]) + wp.cross(ahead, arm)
                            u += s * present
                            u_free += s * ahead
                    if stops:
                        needed = phi[0] < real(2.0) * h * wp.max(wp.length(u), wp.length(u_free)) + real(1.0e-6)
                    free = frame * u_free
                if needed:
                    alone = real(0.0)  # mobility that the bodies would have without their joints
                    for side in range(sides):
                        b = body[side]
                        if b >= 0:
                            alone += bodies.inv_mass[env, b]
                            first = (2 * n + side) * trees.longest
                            last = trees.last[b]
                            force = mat33()
                            moment = wp.identity(n=3, dtype=real)
                            if i >= 0:
                                while last >= 0:
                                    trees.half[env, first + trees.depth[last]] = vec3()
                                    last = trees.before[last]
                                trees.half[env, first + trees.depth[i]] = trees.scale[env, i] * scale
                                last = trees.before[i]
                                force = -wp.outer(wp.spatial_top(trees.taken[env, i]), scale)
                                moment = -wp.outer(wp.spatial_bottom(trees.taken[env, i]), scale)
                            elif kind != LOOP_TURN:
                                force = wp.identity(n=3, dtype=real)
                                moment = wp.skew(point - trees.origin[env, trees.root[b]])
                            divide(trees, env, first, last, force, moment)
                    contacts.body[env, n] = body
                    w = vec3()
                    mobility = mat33()
                    if i >= 0:
                        trees.row_scale[env, k] = scale
                        last = trees.last[body[1]]
                        while last >= 0:
                            y = trees.half[env, (2 * n + 1) * trees.longest + trees.depth[last]]
                            w += wp.cw_mul(y, y)
                            last = trees.before[last]
                    else:
                        mobility = product(trees.shared, trees.half, contacts.body, trees.longest, env, n, n)
                        mobility = frame * mobility * wp.transpose(frame)
                        w = wp.get_diag(mobility)
                    eps = vec3(real(1.0))
                    shift = vec3()
                    bound = vec2()
                    if stops:
                        eps_n, d = stop(phi[0], h, w[0])
                        eps[0] = eps_n
                        shift[0] = d
                    if i >= 0:
                        if not stops:
                            shift[0] = real(1.0)
                        if stiff > real(0.0):
                            eps[1] = length * length / stiff
                            pull = drive[0] * (trees.target[env, i] - q[env, trees.coordinate[i]]) + drive[1] * trees.target_rate[env, i]
                            shift[1] = -length * (h * pull) / stiff
                        if friction > real(0.0):
                            eps[2] = real(FRICTION_RELAXATION) * w[2]
                        bound = vec2(h * drive[2] / length, h * friction / length)
                    elif not stops:
                        for r in range(3):
                            if w[r] > real(IMMOBILE) * alone:
                                eps[r] = loop_relaxation * w[r]
                                shift[r] = wp.clamp(phi[r] / h, -real(MAX_CORRECTION), real(MAX_CORRECTION))
                            else:
                                frame[r] = vec3()
                                w[r] = real(0.0)
                                free[r] = real(0.0)
                        hanging = real(0.0)
                        for side in range(sides):
                            if trees.row_top[k][side] >= 0:
                                hanging += real(1.0) / trees.mass[env, trees.row_top[k][side]]
                        shift = damped(mobility, hanging * wp.max(real(DAMPED) * wp.length(shift), real(STIFFEST)), shift)
                    state = int(0)
                    if free[0] + shift[0] < real(0.0):
                        state = 1
                    contacts.slot[env, n] = -1 - k
                    contacts.point[env, n] = point
                    contacts.gap[env, n] = real(0.0)
                    contacts.closed[env, n] = 1
                    contacts.frame[env, n] = frame
                    contacts.inv_mass[env, n] = w
                    contacts.relaxation[env, n] = eps
                    contacts.shift[env, n] = shift
                    contacts.free[env, n] = free + shift
                    contacts.mu[env, n] = vec2()
                    contacts.bound[env, n] = bound
                    contacts.directions[env, n] = directions
                    contacts.damping[env, n] = real(0.0)
                    contacts.impulse[env, n] = vec3()
                    contacts.state[env, n] = state
                    n += 1
            contacts.count[env] = n

    return joint_rows
