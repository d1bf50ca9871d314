# SPDX-License-Identifier: Apache-2.0
"""From contact points to contact rows: frames, stick or slide, relaxation and bristles (eqs. 34, 40-43).

One thread an environment walks over its slots in order, so the rows always come in the same order. The frame of every
contact is chosen so that t1 is the direction that matters: the sliding direction while it slides, the direction in
which it would slip while it sticks. E of eq. 18 is then the same k directions at angles j pi / k for every contact.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .collide import pair_functions
from .types import FACETS, OVERFLOW, REGULARIZED, scalar_types

# Overlaps are pushed apart no faster than this [m/s], whatever the stiffness.
MAX_DEPENETRATION_SPEED = wp.constant(3.0)
# A contact that opens by more than this many static deflections under its weight has separated.
ELASTIC_RANGE = wp.constant(10.0)
# A predicted slip under this part of the free velocity is round-off and has no direction.
NO_SLIP = wp.constant(1.0e-6)
# The last normal impulse that eq. 43 divides by is at least this part of the contact's weight.
IMPULSE_FLOOR = wp.constant(1.0e-2)
# Table 1 per kilogram of the lighter movable body (warp_lcp.model.TABLE_1), in the order of Parameters.contact.
TABLE_1 = wp.constant(wp.types.vector(length=5, dtype=wp.float64)(1.0e10, 1.0e8, 1.0e8, 1.0e5, 1.0e-3))


@functools.cache
def row_functions(real) -> SimpleNamespace:
    """What a contact row is made of; shared with the stages that apply impulses."""
    t = scalar_types(real)
    vec3 = t.vec3
    Bodies, Parameters = t.Bodies, t.Parameters
    vec5 = wp.types.vector(length=5, dtype=real)

    @wp.func
    def point_velocity(velocity: wp.array2d(dtype=t.spatial), com: wp.array2d(dtype=vec3), env: int, body: int, point: vec3) -> vec3:
        """Velocity of the material point of a body at `point`, world axes; zero for the world (-1)."""
        u = vec3()
        if body >= 0:
            twist = velocity[env, body]
            u = wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), point - com[env, body])
        return u

    @wp.func
    def mobility(bodies: Bodies, env: int, body: int, point: vec3, d: vec3) -> real:
        """J M^-1 J^T of one direction at a point of a body: 1/m + (r x d) . I^-1 (r x d); zero for the world."""
        w = real(0.0)
        if body >= 0 and bodies.inv_mass[env, body] > real(0.0):
            m = wp.cross(point - bodies.com[env, body], d)
            w = bodies.inv_mass[env, body] + wp.dot(m, bodies.inv_inertia[env, body] * m)
        return w

    @wp.func
    def contact_parameters(parameters: Parameters, bodies: Bodies, env: int, shape_a: int, shape_b: int, body_a: int, body_b: int) -> vec5:
        """k_n, b_n, k_t, b_t, v_s of a pair: the mean of what its materials author, else Table 1 for the lighter body."""
        mass = real(0.0)
        if body_a >= 0 and bodies.inv_mass[env, body_a] > real(0.0):
            mass = real(1.0) / bodies.inv_mass[env, body_a]
        if body_b >= 0 and bodies.inv_mass[env, body_b] > real(0.0):
            mass_b = real(1.0) / bodies.inv_mass[env, body_b]
            if mass == real(0.0) or mass_b < mass:
                mass = mass_b
        row = env % parameters.contact.shape[0]
        result = vec5()
        for k in range(5):
            a = parameters.contact[row, shape_a, k]
            b = parameters.contact[row, shape_b, k]
            if wp.isnan(a) and wp.isnan(b):
                result[k] = real(TABLE_1[k])
                if k < 4:
                    result[k] *= mass
            elif wp.isnan(a):
                result[k] = b
            elif wp.isnan(b):
                result[k] = a
            else:
                result[k] = real(0.5) * (a + b)
        return result

    @wp.func
    def tangent_part(x: vec3, n: vec3) -> vec3:
        return x - n * wp.dot(n, x)

    @wp.func
    def any_tangent(n: vec3) -> vec3:
        """World x (or y where the normal is near x) projected on the tangent plane."""
        axis = vec3(real(1.0), real(0.0), real(0.0))
        if wp.abs(n[0]) > real(0.9):
            axis = vec3(real(0.0), real(1.0), real(0.0))
        return wp.normalize(tangent_part(axis, n))

    return SimpleNamespace(
        point_velocity=point_velocity,
        mobility=mobility,
        contact_parameters=contact_parameters,
        tangent_part=tangent_part,
        any_tangent=any_tangent,
    )


@functools.cache
def make(real):
    """Kernel ``contact_rows``; launch with dim (E)."""
    t = scalar_types(real)
    vec2, vec3 = t.vec2, t.vec3
    Bodies, Contacts, Parameters, Slots, Topology = t.Bodies, t.Contacts, t.Parameters, t.Slots, t.Topology
    f = row_functions(real)
    point_velocity, mobility, contact_parameters = f.point_velocity, f.mobility, f.contact_parameters
    tangent_part, any_tangent = f.tangent_part, f.any_tangent
    shape_pose = pair_functions(real).shape_pose

    @wp.func
    def surface_velocity(topology: Topology, bodies: Bodies, env: int, shape: int) -> vec3:
        velocity = topology.surface_velocity[shape]
        if wp.dot(velocity, velocity) > real(0.0):
            velocity = wp.transform_vector(shape_pose(topology, bodies, env, shape), velocity)
        return velocity

    @wp.func
    def write_row(
        topology: Topology,
        parameters: Parameters,
        bodies: Bodies,
        slots: Slots,
        h: real,
        sliding: int,
        directions: int,
        contacts: Contacts,
        env: int,
        slot: int,
        i: int,
        u: vec3,
        u_free: vec3,
    ):
        """Row i of an environment from its slot; u and u_free: present and free relative velocity, world axes."""
        pair = topology.slot_pair[slot]
        shape_a = topology.pairs[pair, 0]
        shape_b = topology.pairs[pair, 1]
        body_a = topology.shape_body[shape_a]
        body_b = topology.shape_body[shape_b]
        point = slots.point[env, slot]
        n = slots.normal[env, slot]
        phi = slots.gap[env, slot]
        c = contact_parameters(parameters, bodies, env, shape_a, shape_b, body_a, body_b)
        k_n = c[0]
        b_n = c[1]
        k_t = c[2]
        b_t = c[3]
        friction = real(0.5) * (
            parameters.friction[env % parameters.friction.shape[0], shape_a]
            + parameters.friction[env % parameters.friction.shape[0], shape_b]
        )
        w_nn = mobility(bodies, env, body_a, point, n) + mobility(bodies, env, body_b, point, n)
        gravity = parameters.gravity[env % parameters.gravity.shape[0]]

        # History: last normal impulse and bristle force; a new contact starts with its weight and slack bristles.
        weight = h * wp.length(gravity) / w_nn
        if weight == real(0.0):
            weight = wp.abs(wp.dot(n, u_free)) / w_nn
        impulse = weight
        bristle = vec3()
        touched = slots.last_feature[env, slot] == slots.feature[env, slot]
        if touched:
            impulse = slots.last_impulse[env, slot]
            bristle = slots.last_bristle[env, slot]
            bristle = tangent_part(bristle, n)

        # Normal row. Eqs. 40 and 41 while the surfaces touch; an open gap only may not close by more than itself.
        # Compliance moves surfaces in contact apart and together by the deflection under their load, so one that
        # touched stays in contact within that range: there an unloaded point carries on with the same law as the
        # loaded ones beside it, which is what makes redundant normal forces unique.
        eps_n = real(1.0) / (k_n * h * h + b_n * h)
        closed = phi <= real(0.0) or (touched and phi * k_n * h <= real(ELASTIC_RANGE) * weight)
        d_n = phi / h
        if closed:
            d_n = wp.max(eps_n * h * k_n * phi, -real(MAX_DEPENETRATION_SPEED))

        eps_t = real(1.0) / (k_t * h * h + b_t * h)
        slip = tangent_part(u, n)
        speed = wp.length(slip)
        slides = speed >= c[4]
        mu = friction[0]
        if slides:
            mu = friction[1]
        eps = vec3(eps_n, eps_t, eps_t)
        d_t = -(eps_t * h) * bristle  # eq. 42
        mu_row = vec2(mu, mu)
        k = directions
        t1 = any_tangent(n)
        if sliding != FACETS:
            if slides:
                # Eq. 34, and eq. 43 across the sliding direction.
                t1 = slip / speed
                d_t = t1 * wp.dot(t1, d_t)
                k = 2
                if sliding == REGULARIZED and mu > real(0.0):
                    eps[2] = wp.max(eps_t, speed / (mu * wp.max(impulse, real(IMPULSE_FLOOR) * weight)))
                else:
                    mu_row[1] = real(0.0)
            else:
                # First direction along the slip to come, so that the limit there is mu_s lambda_n exactly.
                predicted = tangent_part(u_free, n) + d_t
                length = wp.length(predicted)
                if length > real(NO_SLIP) * wp.length(u_free):
                    t1 = predicted / length
        elif slides:
            d_t = vec3()
        if mu == real(0.0):
            k = 0
        t1 = wp.normalize(tangent_part(t1, n))  # once more: a small slip is a difference of large numbers
        t2 = wp.cross(n, t1)
        frame = wp.matrix_from_rows(n, t1, t2)

        contacts.slot[env, i] = slot
        contacts.body[env, i] = wp.vec2i(body_a, body_b)
        contacts.point[env, i] = point
        contacts.gap[env, i] = phi
        contacts.closed[env, i] = int(closed)
        contacts.frame[env, i] = frame
        w_11 = mobility(bodies, env, body_a, point, t1) + mobility(bodies, env, body_b, point, t1)
        w_22 = mobility(bodies, env, body_a, point, t2) + mobility(bodies, env, body_b, point, t2)
        contacts.inv_mass[env, i] = vec3(w_nn, w_11, w_22)
        contacts.relaxation[env, i] = eps
        d = vec3(d_n, wp.dot(t1, d_t), wp.dot(t2, d_t))
        contacts.shift[env, i] = d
        contacts.free[env, i] = frame * u_free + d
        contacts.mu[env, i] = mu_row
        contacts.directions[env, i] = k
        contacts.damping[env, i] = b_t
        contacts.impulse[env, i] = vec3()
        # What velocity pivoting starts from: closed where it was loaded or is about to be, axes as they were named.
        state = int(0)
        if impulse > real(0.0) and contacts.free[env, i][0] < real(0.0):
            state = 1
        if slides and sliding != FACETS:
            state = state | 2
        contacts.state[env, i] = state

    @wp.kernel(module="unique", enable_backward=False)
    def contact_rows(
        topology: Topology,
        parameters: Parameters,
        bodies: Bodies,
        slots: Slots,
        h: real,
        sliding: int,
        directions: int,
        contacts: Contacts,
        status: wp.array(dtype=int),
    ):
        env = wp.tid()
        gravity = parameters.gravity[env % parameters.gravity.shape[0]]
        fall = h * h * wp.length(gravity) + real(1.0e-9)
        count = int(0)
        for slot in range(slots.gap.shape[1]):
            phi = slots.gap[env, slot]
            if phi < real(1.0e29):
                pair = topology.slot_pair[slot]
                shape_a = topology.pairs[pair, 0]
                shape_b = topology.pairs[pair, 1]
                body_a = topology.shape_body[shape_a]
                body_b = topology.shape_body[shape_b]
                point = slots.point[env, slot]
                belt = surface_velocity(topology, bodies, env, shape_b) - surface_velocity(topology, bodies, env, shape_a)
                u_free = point_velocity(bodies.free_velocity, bodies.com, env, body_b, point) + belt
                u_free -= point_velocity(bodies.free_velocity, bodies.com, env, body_a, point)
                # A row where the gap could close within the step. The speed counts, not just its approaching part: an
                # impact elsewhere on the body turns one into the other (1.1 mm of overlap at 1 ms without, 3 um with).
                if phi < h * wp.length(u_free) + fall:
                    if count < contacts.slot.shape[1]:
                        u = point_velocity(bodies.velocity, bodies.com, env, body_b, point) + belt
                        u -= point_velocity(bodies.velocity, bodies.com, env, body_a, point)
                        write_row(topology, parameters, bodies, slots, h, sliding, directions, contacts, env, slot, count, u, u_free)
                        count += 1
                    else:
                        status[env] = status[env] | OVERFLOW
        contacts.count[env] = count

    return contact_rows
