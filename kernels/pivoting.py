# SPDX-License-Identifier: Apache-2.0
"""Principal pivoting in velocities: the LCP of eq. 39 without ever forming it.

Every contact is open or closed, and each friction axis of a closed one sticks or slides at its limit. For given states
all rows are equations, and eliminating the impulses leaves a system of the size of the velocities: with x = v+ - v_free
and f = J v_free + d,

    closed  p_n = -(f_n + J_n x) / eps_n        stick  p_j = -(f_j + J_j x) / eps_j        slide  p_j = s mu_j p_n

    (M + sum (J_n + s mu J_j)^T J_n / eps_n + sum J_j^T J_j / eps_j) x = -sum (J_n + s mu J_j)^T f_n / eps_n - sum J_j^T f_j / eps_j.

States whose sign conditions fail are flipped, all at once, until none does. Started from the states that the contact
rows expect (loaded or not, sliding or sticking) that takes one to three solves. It may cycle: then the environment
stays unsolved and a safer method takes over.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import linear
from .types import LANES, scalar_types, sync

# State of a contact while it is solved: bit 0 closed, bits 1-2 axis t1, bits 3-4 axis t2.
CLOSED = wp.constant(1)
AXIS_STICKS = 0
AXIS_SLIDES_UP = 1  # along +t: the impulse is -mu p_n
AXIS_SLIDES_DOWN = 2


@functools.cache
def functions(real) -> SimpleNamespace:
    """Functions of one contact, whatever solves the linear system.

    They take numbers, not bundles: Warp passes a bundle by value, a kilobyte a call.
    """
    t = scalar_types(real)
    vec2, vec3 = t.vec2, t.vec3
    vec6 = wp.types.vector(length=6, dtype=real)

    @wp.func
    def axis_state(state: int, axis: int) -> int:
        return (state >> (1 + 2 * axis)) & 3

    @wp.func
    def axis_impulse(relaxed: real, eps: real, mu: real, p_n: real, state: int) -> real:
        """Impulse of a friction axis in the given state; relaxed = f_j + J_j x."""
        p = -relaxed / eps
        if state == AXIS_SLIDES_UP:
            p = -mu * p_n
        elif state == AXIS_SLIDES_DOWN:
            p = mu * p_n
        return p

    @wp.func
    def next_axis_state(relaxed: real, eps: real, mu: real, p_n: real, state: int, tolerance: real) -> int:
        """State that the sign conditions ask for; `tolerance` [m/s] keeps round-off from flipping it."""
        result = state
        if state == AXIS_STICKS:
            p = -relaxed / eps
            if p > mu * p_n + tolerance / eps * real(1.0e-6):
                result = AXIS_SLIDES_DOWN
            elif p < -mu * p_n - tolerance / eps * real(1.0e-6):
                result = AXIS_SLIDES_UP
        elif state == AXIS_SLIDES_UP:
            if relaxed - eps * mu * p_n < -tolerance:
                result = AXIS_STICKS
        else:
            if relaxed + eps * mu * p_n > tolerance:
                result = AXIS_STICKS
        return result

    @wp.func
    def next_state(relaxed: vec3, eps: vec3, w_nn: real, mu: vec2, k: int, state: int, tolerance: real) -> int:
        """State that the sign conditions of a contact ask for; relaxed = f + J x, w_nn of J M^-1 J^T, k directions."""
        p_n = -relaxed[0] / eps[0]
        closed = state & CLOSED
        if closed != 0:
            if p_n * (w_nn + eps[0]) < -tolerance:
                closed = 0
        elif relaxed[0] < -tolerance:
            closed = CLOSED
        result = closed | (state & 30)
        if (state & CLOSED) != 0 and closed != 0 and k > 0:
            p_n = wp.max(p_n, real(0.0))
            first = next_axis_state(relaxed[1], eps[1], mu[0], p_n, axis_state(state, 0), tolerance)
            second = next_axis_state(relaxed[2], eps[2], mu[1], p_n, axis_state(state, 1), tolerance)
            result = CLOSED | (first << 1) | (second << 3)
        return result

    @wp.func
    def state_impulse(relaxed: vec3, eps: vec3, mu: vec2, k: int, state: int) -> vec3:
        """Impulse of a contact in its state; relaxed = f + J x."""
        p = vec3()
        if (state & CLOSED) != 0:
            p[0] = wp.max(-relaxed[0] / eps[0], real(0.0))
            if k > 0:
                p[1] = axis_impulse(relaxed[1], eps[1], mu[0], p[0], axis_state(state, 0))
                p[2] = axis_impulse(relaxed[2], eps[2], mu[1], p[0], axis_state(state, 1))
        return p

    @wp.func
    def row(direction: vec3, arm: vec3, sign: real) -> vec6:
        """J of one direction of a contact and one of its bodies: sign (d, r x d)."""
        m = wp.cross(arm, direction)
        return vec6(sign * direction[0], sign * direction[1], sign * direction[2], sign * m[0], sign * m[1], sign * m[2])

    return SimpleNamespace(axis_state=axis_state, next_state=next_state, state_impulse=state_impulse, row=row)


@functools.cache
def make_single(real):
    """Kernel ``pivot_single`` for scenes with one movable body: a thread an environment, 6 x 6 in registers; dim (E)."""
    t = scalar_types(real)
    vec2, vec3, mat33 = t.vec2, t.vec3, t.mat33
    vec6 = wp.types.vector(length=6, dtype=real)
    mat66 = wp.types.matrix(shape=(6, 6), dtype=real)
    Bodies, Contacts = t.Bodies, t.Contacts
    f = functions(real)
    axis_state, next_state, state_impulse, row = f.axis_state, f.next_state, f.state_impulse, f.row

    @wp.func
    def solve(a: mat66, b: vec6) -> vec6:
        """Gaussian elimination; the certificate judges the answer, so no pivot search."""
        p = vec6()
        for k in range(6):
            p[k] = real(1.0) / a[k, k]
            for i in range(k + 1, 6):
                g = a[i, k] * p[k]
                b[i] = b[i] - g * b[k]
                for j in range(k + 1, 6):
                    a[i, j] = a[i, j] - g * a[k, j]
        for kk in range(6):
            k = 5 - kk
            x = b[k]
            for j in range(k + 1, 6):
                x -= a[k, j] * b[j]
            b[k] = x * p[k]
        return b

    @wp.func
    def add_contact(a: mat66, b: vec6, frame: mat33, arm: vec3, sign: real, eps: vec3, free: vec3, mu: vec2, k: int, state: int):
        """Add what a closed contact contributes in its state."""
        j_n = row(frame[0], arm, sign)
        column = j_n
        if k > 0:
            for axis in range(2):
                j_t = row(frame[axis + 1], arm, sign)
                s = axis_state(state, axis)
                if s == AXIS_STICKS:
                    scaled = (real(1.0) / eps[axis + 1]) * j_t
                    a += wp.outer(scaled, j_t)
                    b -= scaled * free[axis + 1]
                elif s == AXIS_SLIDES_UP:
                    column -= mu[axis] * j_t
                else:
                    column += mu[axis] * j_t
        column = (real(1.0) / eps[0]) * column
        a += wp.outer(column, j_n)
        b -= column * free[0]
        return a, b

    @wp.kernel(module="unique", enable_backward=False)
    def pivot_single(
        bodies: Bodies,
        body: int,
        contacts: Contacts,
        limit: int,
        tolerance: real,
        iterations: wp.array(dtype=int),
        stride: int,
    ):
        start, _ = wp.tid()
        for env in range(start, contacts.count.shape[0], stride):
            r = contacts.count[env]
            if r == 0:
                continue
            com = bodies.com[env, body]
            inertia = wp.inverse(bodies.inv_inertia[env, body])
            m = real(1.0) / bodies.inv_mass[env, body]
            x = vec6()
            flips = int(1)
            solves = int(0)
            for i in range(r):
                if contacts.directions[env, i] > 2:
                    flips = 0
            while flips > 0 and solves < limit:
                a = mat66(
                    m, real(0.0), real(0.0), real(0.0), real(0.0), real(0.0),
                    real(0.0), m, real(0.0), real(0.0), real(0.0), real(0.0),
                    real(0.0), real(0.0), m, real(0.0), real(0.0), real(0.0),
                    real(0.0), real(0.0), real(0.0), inertia[0, 0], inertia[0, 1], inertia[0, 2],
                    real(0.0), real(0.0), real(0.0), inertia[1, 0], inertia[1, 1], inertia[1, 2],
                    real(0.0), real(0.0), real(0.0), inertia[2, 0], inertia[2, 1], inertia[2, 2],
                )  # fmt: skip
                b = vec6()
                for i in range(r):
                    state = contacts.state[env, i]
                    if (state & CLOSED) != 0:
                        sign = real(1.0)
                        if contacts.body[env, i][0] == body:
                            sign = real(-1.0)
                        a, b = add_contact(
                            a,
                            b,
                            contacts.frame[env, i],
                            contacts.point[env, i] - com,
                            sign,
                            contacts.relaxation[env, i],
                            contacts.free[env, i],
                            contacts.mu[env, i],
                            contacts.directions[env, i],
                            state,
                        )
                x = solve(a, b)
                solves += 1
                flips = int(0)
                dv = vec3(x[0], x[1], x[2])
                dw = vec3(x[3], x[4], x[5])
                for i in range(r):
                    du = dv + wp.cross(dw, contacts.point[env, i] - com)
                    if contacts.body[env, i][0] == body:
                        du = -du
                    relaxed = contacts.free[env, i] + contacts.frame[env, i] * du
                    eps = contacts.relaxation[env, i]
                    mu = contacts.mu[env, i]
                    k = contacts.directions[env, i]
                    state = contacts.state[env, i]
                    after = next_state(relaxed, eps, contacts.inv_mass[env, i][0], mu, k, state, tolerance)
                    contacts.impulse[env, i] = state_impulse(relaxed, eps, mu, k, state)
                    if after != state:
                        flips += 1
                        contacts.state[env, i] = after
            iterations[env] = iterations[env] + solves

    return pivot_single


@functools.cache
def make(real) -> SimpleNamespace:
    """Bundle ``Workspace`` and kernel ``pivot`` for scenes with several movable bodies; launch tiled with dim (P)."""
    t = scalar_types(real)
    vec3 = t.vec3
    vec6 = wp.types.vector(length=6, dtype=real)
    Bodies, Contacts = t.Bodies, t.Contacts
    f = functions(real)
    axis_state, next_state, state_impulse, row = f.axis_state, f.next_state, f.state_impulse, f.row
    solve = linear.functions(real).solve

    @wp.struct
    class Workspace:
        system: wp.array3d(dtype=real)  # [P, nv, nv + 1]
        start: wp.array(dtype=int)  # [B] first of a body's six unknowns, -1 = does not answer to forces
        flips: wp.array(dtype=int)  # [P]

    @wp.func
    def start_of(ws: Workspace, body: int) -> int:
        start = int(-1)
        if body >= 0:
            start = ws.start[body]
        return start

    @wp.func
    def load_masses(ws: Workspace, bodies: Bodies, env: int, slot: int, lane: int):
        n = ws.system.shape[1]
        for k in range(lane, n * (n + 1), wp.block_dim()):
            ws.system[slot, k // (n + 1), k % (n + 1)] = real(0.0)
        sync()
        for b in range(lane, ws.start.shape[0], wp.block_dim()):
            i = ws.start[b]
            if i >= 0:
                inertia = wp.inverse(bodies.inv_inertia[env, b])
                for x in range(3):
                    ws.system[slot, i + x, i + x] = real(1.0) / bodies.inv_mass[env, b]
                    for y in range(3):
                        ws.system[slot, i + 3 + x, i + 3 + y] = inertia[x, y]
        sync()

    @wp.func
    def add_term(ws: Workspace, slot: int, start: wp.vec2i, column_a: vec6, column_b: vec6, row_a: vec6, row_b: vec6, f: real, lane: int):
        """System += [column] [row], right-hand side -= [column] f; the two sides of a contact one below the other."""
        n = ws.system.shape[1]
        for k in range(lane, 12, wp.block_dim()):
            i = start[0]
            c = column_a[k % 6]
            if k >= 6:
                i = start[1]
                c = column_b[k % 6]
            if i >= 0:
                for j in range(6):
                    if start[0] >= 0:
                        ws.system[slot, i + k % 6, start[0] + j] += c * row_a[j]
                    if start[1] >= 0:
                        ws.system[slot, i + k % 6, start[1] + j] += c * row_b[j]
                ws.system[slot, i + k % 6, n] -= c * f
        sync()

    @wp.func
    def add_contact(ws: Workspace, bodies: Bodies, contacts: Contacts, env: int, slot: int, i: int, lane: int):
        """Add what a closed contact contributes in its present state."""
        body = contacts.body[env, i]
        start = wp.vec2i(start_of(ws, body[0]), start_of(ws, body[1]))
        arm_a = vec3()
        arm_b = vec3()
        if start[0] >= 0:
            arm_a = contacts.point[env, i] - bodies.com[env, body[0]]
        if start[1] >= 0:
            arm_b = contacts.point[env, i] - bodies.com[env, body[1]]
        frame = contacts.frame[env, i]
        eps = contacts.relaxation[env, i]
        free = contacts.free[env, i]
        state = contacts.state[env, i]
        n_a = row(frame[0], arm_a, real(-1.0))
        n_b = row(frame[0], arm_b, real(1.0))
        column_a = n_a
        column_b = n_b
        if contacts.directions[env, i] > 0:
            for axis in range(2):
                t_a = row(frame[axis + 1], arm_a, real(-1.0))
                t_b = row(frame[axis + 1], arm_b, real(1.0))
                s = axis_state(state, axis)
                mu = contacts.mu[env, i][axis]
                if s == AXIS_STICKS:
                    add_term(ws, slot, start, t_a / eps[axis + 1], t_b / eps[axis + 1], t_a, t_b, free[axis + 1], lane)
                elif s == AXIS_SLIDES_UP:
                    column_a -= mu * t_a
                    column_b -= mu * t_b
                else:
                    column_a += mu * t_a
                    column_b += mu * t_b
        add_term(ws, slot, start, column_a / eps[0], column_b / eps[0], n_a, n_b, free[0], lane)

    @wp.func
    def change(ws: Workspace, bodies: Bodies, env: int, slot: int, body: int, point: vec3) -> vec3:
        """J x of one body at a point."""
        u = vec3()
        i = start_of(ws, body)
        if i >= 0:
            n = ws.system.shape[1]
            dv = vec3(ws.system[slot, i, n], ws.system[slot, i + 1, n], ws.system[slot, i + 2, n])
            dw = vec3(ws.system[slot, i + 3, n], ws.system[slot, i + 4, n], ws.system[slot, i + 5, n])
            u = dv + wp.cross(dw, point - bodies.com[env, body])
        return u

    @wp.func
    def update_states(ws: Workspace, bodies: Bodies, contacts: Contacts, env: int, slot: int, tolerance: real, lane: int) -> int:
        """Flip the states that fail, keep the impulses of the others; returns the number of flips."""
        if lane == 0:
            ws.flips[slot] = 0
        sync()
        for i in range(lane, contacts.count[env], wp.block_dim()):
            body = contacts.body[env, i]
            point = contacts.point[env, i]
            du = change(ws, bodies, env, slot, body[1], point) - change(ws, bodies, env, slot, body[0], point)
            relaxed = contacts.free[env, i] + contacts.frame[env, i] * du
            eps = contacts.relaxation[env, i]
            mu = contacts.mu[env, i]
            k = contacts.directions[env, i]
            state = contacts.state[env, i]
            after = next_state(relaxed, eps, contacts.inv_mass[env, i][0], mu, k, state, tolerance)
            contacts.impulse[env, i] = state_impulse(relaxed, eps, mu, k, state)
            if after != state:
                wp.atomic_add(ws.flips, slot, 1)
                contacts.state[env, i] = after
        sync()
        return ws.flips[slot]

    @wp.kernel(module="unique", enable_backward=False, module_options={"block_dim": LANES})
    def pivot(
        bodies: Bodies,
        contacts: Contacts,
        ws: Workspace,
        limit: int,
        tolerance: real,
        iterations: wp.array(dtype=int),
    ):
        slot, lane = wp.tid()
        for env in range(slot, contacts.count.shape[0], ws.system.shape[0]):
            r = contacts.count[env]
            flips = r
            solves = int(0)
            for i in range(r):
                if contacts.directions[env, i] > 2:
                    flips = 0
            while flips > 0 and solves < limit:
                load_masses(ws, bodies, env, slot, lane)
                for i in range(r):
                    if (contacts.state[env, i] & CLOSED) != 0:
                        add_contact(ws, bodies, contacts, env, slot, i, lane)
                flips = 0
                if solve(ws.system, slot, ws.system.shape[1], lane):
                    flips = update_states(ws, bodies, contacts, env, slot, tolerance, lane)
                solves += 1
                sync()
            if lane == 0:
                iterations[env] = iterations[env] + solves
            sync()

    return SimpleNamespace(Workspace=Workspace, pivot=pivot)
