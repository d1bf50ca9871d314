# SPDX-License-Identifier: Apache-2.0
"""Scenes with one movable body: contact rows, principal pivoting and certificate in one kernel, a thread an environment.

The stages are those of contacts, pivoting and certify, made of the same functions; with one body the system of pivoting is
6 x 6 and stays in registers, its impulses add up to one wrench, and what a contact needs is read while it is at hand.
Environments whose answer is not certified are listed, for ``certify`` to judge and the next method to solve.
"""

import warp as wp

from . import certify, contacts, pivoting, rigid
from .declare import factory, kernel
from .types import CLOSED, ITERATION_LIMIT, scalar_types


@factory
def make(real, cone: bool, frozen: bool, rows: bool):
    """Kernel ``solve_single``; launch with dim (E). Without `rows` those that stand in Contacts are solved as they are."""
    t = scalar_types(real)
    vec2, vec3, mat33, spatial = t.vec2, t.vec3, t.mat33, t.spatial
    vec6 = wp.types.vector(length=6, dtype=real)
    mat66 = wp.types.matrix(shape=(6, 6), dtype=real)
    Bodies, Contacts, Parameters, Slots, Topology = t.Bodies, t.Contacts, t.Parameters, t.Slots, t.Topology
    row_functions = contacts.row_functions(real)
    read_row, write_row = row_functions.read_row, row_functions.write_row
    states = pivoting.functions(real, cone, frozen)
    operator, update, has_friction = states.operator, states.update, states.has_friction
    certificate = certify.functions(real)
    judge, remember = certificate.judge, certificate.remember
    body_functions = rigid.functions(real)
    direction_mobility, wrench, response = body_functions.direction_mobility, body_functions.wrench, body_functions.response
    times_skew, skew_times = body_functions.times_skew, body_functions.skew_times

    @wp.func
    def natural(i: int) -> int:
        """An index that is not to be counted from the end: knowing that saves the compiler three instructions an access."""
        return wp.max(i, 0)

    @wp.func
    def solve(vv: mat33, vw: mat33, wv: mat33, ww: mat33, bv: vec3, bw: vec3) -> vec6:
        """Gaussian elimination; the certificate judges the answer, so no pivot search."""
        a = mat66()
        b = vec6()
        for i in range(3):
            b[i] = bv[i]
            b[3 + i] = bw[i]
            for j in range(3):
                a[i, j] = vv[i, j]
                a[i, 3 + j] = vw[i, j]
                a[3 + i, j] = wv[i, j]
                a[3 + i, 3 + j] = ww[i, j]
        p = vec6()
        for k in range(6):
            p[k] = real(1.0) / a[k, k]
            for i in range(wp.static(k + 1), 6):  # static: otherwise Warp does not unroll it
                g = a[i, k] * p[k]
                b[i] = b[i] - g * b[k]
                for j in range(wp.static(k + 1), 6):
                    a[i, j] = a[i, j] - g * a[k, j]
        for k in range(5, -1, -1):
            x = b[k]
            for j in range(wp.static(k + 1), 6):
                x -= a[k, j] * b[j]
            b[k] = x * p[k]
        return b

    @kernel()
    def solve_single(
        topology: Topology,
        parameters: Parameters,
        bodies: Bodies,
        slots: Slots,
        contacts: Contacts,
        body: int,
        h: real,
        sliding: int,
        directions: int,
        frozen_limits: int,
        limit: int,
        sign_tolerance: real,
        tolerance: real,
        next_velocity: wp.array2d(dtype=spatial),
        todo: wp.array(dtype=int),
        number: wp.array(dtype=int),
        left: wp.array(dtype=int),
        number_left: wp.array(dtype=int),
        unsolved: wp.array(dtype=int),
        residual: wp.array(dtype=real),
        residual_energy: wp.array(dtype=real),
        iterations: wp.array(dtype=int),
        reason: wp.array(dtype=int),
        stride: int,
    ):
        """The environments todo[:number] by pivoting; those without a certificate go to `left`."""
        start, _ = wp.tid()
        rate = real(1.0) / h
        for index in range(start, number[0], stride):
            env = natural(todo[index])
            count = contacts.count[env]
            com = bodies.com[env, body]
            if wp.static(rows):
                inv_mass = bodies.inv_mass[env, body]
                inv_inertia = bodies.inv_inertia[env, body]
                for ii in range(count):
                    i = natural(ii)
                    slot = natural(contacts.slot[env, i])
                    pair_body = topology.pair_body[topology.slot_pair[slot]]
                    point = slots.point[env, slot]
                    arm = point - com
                    w_nn = direction_mobility(inv_mass, inv_inertia, arm, slots.normal[env, slot])
                    u = contacts.velocity[env, i]
                    u_free = contacts.free[env, i]
                    row = read_row(topology, parameters, slots, env, slot, w_nn, u, u_free, h, sliding, directions, frozen_limits)
                    w_1 = direction_mobility(inv_mass, inv_inertia, arm, row.frame[1])
                    w_2 = direction_mobility(inv_mass, inv_inertia, arm, row.frame[2])
                    row.inv_mass = vec3(w_nn, w_1, w_2)
                    write_row(contacts, env, i, pair_body, point, slots.gap[env, slot], row)

            total = spatial()
            flips = count
            solves = int(0)
            # Where the flips of a lone contact go round, it sticks: open it would sink in, sliding it would pull (Painleve's paradox).
            once_more = int(0)
            if count == 1:
                once_more = limit - limit // 3
            while flips > 0 and solves < limit:
                # Not kept from one solve to the next: registers are short.
                vv = wp.diag(vec3(real(1.0) / bodies.inv_mass[env, body]))
                vw = mat33()
                wv = mat33()
                ww = wp.inverse(bodies.inv_inertia[env, body])
                bv = vec3()
                bw = vec3()
                for ii in range(count):
                    i = natural(ii)
                    state = contacts.state[env, i]
                    k = contacts.directions[env, i]
                    bound = vec2()
                    if wp.static(frozen):
                        bound = contacts.bound[env, i]
                    if (state & CLOSED) != 0 or has_friction(state, bound, k):
                        slip = vec3()
                        if wp.static(cone):
                            slip = contacts.slip[env, i]
                        matrix, shift = operator(
                            contacts.frame[env, i],
                            contacts.relaxation[env, i],
                            contacts.free[env, i],
                            contacts.mu[env, i],
                            bound,
                            k,
                            state,
                            slip,
                        )
                        if contacts.body[env, i][0] == body:
                            shift = -shift
                        arm = contacts.point[env, i] - com
                        right = times_skew(matrix, arm)
                        vv += matrix
                        vw -= right
                        wv += skew_times(arm, matrix)
                        ww -= skew_times(arm, right)
                        bv -= shift
                        bw -= wp.cross(arm, shift)
                x = solve(vv, vw, wv, ww, bv, bw)
                solves += 1
                flips = int(0)
                dv = vec3(x[0], x[1], x[2])
                dw = vec3(x[3], x[4], x[5])
                total = spatial()
                for ii in range(count):
                    i = natural(ii)
                    frame = contacts.frame[env, i]
                    arm = contacts.point[env, i] - com
                    side = real(1.0)
                    if contacts.body[env, i][0] == body:
                        side = real(-1.0)
                    bound = vec2()
                    if wp.static(frozen):
                        bound = contacts.bound[env, i]
                    slip = vec3()
                    if wp.static(cone):
                        slip = contacts.slip[env, i]
                    p, after, turned, again = update(
                        contacts.free[env, i] + side * (frame * (dv + wp.cross(dw, arm))),
                        contacts.relaxation[env, i],
                        contacts.inv_mass[env, i],
                        contacts.mu[env, i],
                        bound,
                        contacts.directions[env, i],
                        contacts.state[env, i],
                        slip,
                        sign_tolerance,
                    )
                    contacts.impulse[env, i] = p
                    total += wrench(arm, side * (wp.transpose(frame) * p))
                    if again:
                        flips += 1
                        if solves == once_more:
                            after = CLOSED  # and neither axis slides
                        contacts.state[env, i] = after
                        if wp.static(cone):
                            contacts.slip[env, i] = turned
            iterations[env] = iterations[env] + solves
            if flips > 0:
                reason[env] = reason[env] | ITERATION_LIMIT

            # The certificate, from the impulses alone: what their wrench changes, not what the system above says.
            change = response(bodies.inv_mass[env, body], bodies.inv_inertia[env, body], total)
            dv = wp.spatial_top(change)
            dw = wp.spatial_bottom(change)
            worst = real(0.0)
            energy = real(0.0)
            finite = wp.isfinite(change)
            for ii in range(count):
                i = natural(ii)
                p = contacts.impulse[env, i]
                frame = contacts.frame[env, i]
                side = real(1.0)
                if contacts.body[env, i][0] == body:
                    side = real(-1.0)
                bound = vec2()
                if wp.static(frozen):
                    bound = contacts.bound[env, i]
                error, part, ended, state = judge(
                    contacts.free[env, i] + side * (frame * (dv + wp.cross(dw, contacts.point[env, i] - com))),
                    p,
                    contacts.relaxation[env, i],
                    contacts.inv_mass[env, i],
                    contacts.shift[env, i],
                    contacts.mu[env, i],
                    bound,
                    contacts.directions[env, i],
                )
                worst = wp.max(worst, wp.max(wp.abs(error)))
                finite = finite and wp.isfinite(error)
                energy += part
                contacts.velocity[env, i] = ended
                contacts.state[env, i] = state
                remember(slots, env, contacts.slot[env, i], contacts.closed[env, i], rate, frame, p, ended, contacts.damping[env, i])
            for b in range(next_velocity.shape[1]):
                next_velocity[env, b] = bodies.free_velocity[env, b]
                finite = finite and wp.isfinite(next_velocity[env, b]) and wp.isfinite(bodies.com[env, b])
            next_velocity[env, body] = next_velocity[env, body] + change
            residual[env] = worst
            residual_energy[env] = energy
            unsolved[env] = 0
            if not finite or not worst <= tolerance:
                unsolved[env] = 1
                left[wp.atomic_add(number_left, 0, 1)] = env  # in any order: environments know nothing of each other

    return solve_single
