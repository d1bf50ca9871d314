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

Coulomb's cone (directions = 1) is the same thing with axes that turn: linearised at a slip y along s,

    p_t = -mu p_n y / |y|   becomes   p_t = -mu p_n s - (y - s s.y) / eps_l,   eps_l = |y| / (mu p_n),

a contact that slides along s and sticks across it with relaxation eps_l: eq. 34 with eq. 43 at the present slip. It is flipped
until s stays where it is, which makes the whole a semismooth Newton method on the exact cone.

Limits of the box and hybrid laws do not follow p_n (`bound`); they hold for open contacts too.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import linear
from .types import DISC, LANES, scalar_types, sync

# State of a contact while it is solved: bit 0 closed, bits 1-2 axis t1, bits 3-4 axis t2.
CLOSED = wp.constant(1)
AXIS_STICKS = 0
AXIS_SLIDES_UP = 1  # along +t: the impulse is -mu p_n
AXIS_SLIDES_DOWN = 2
# Friction on the cone is linearised again while it misses its direction by more than this [m/s].
CONE_TOLERANCE = wp.constant(1.0e-9)


@functools.cache
def functions(real) -> SimpleNamespace:
    """Functions of one contact, whatever solves the linear system.

    They take numbers, not bundles: Warp passes a bundle by value, a kilobyte a call.
    """
    t = scalar_types(real)
    vec2, vec3, mat33 = t.vec2, t.vec3, t.mat33
    vec6 = wp.types.vector(length=6, dtype=real)

    @wp.func
    def axis_state(state: int, axis: int) -> int:
        return (state >> (1 + 2 * axis)) & 3

    @wp.func
    def axis_impulse(relaxed: real, eps: real, limit: real, state: int) -> real:
        """Impulse of a friction axis in the given state; relaxed = f_j + J_j x, limit = mu p_n + bound."""
        p = -limit
        if state == AXIS_STICKS:
            p = -relaxed / eps
        elif state == AXIS_SLIDES_DOWN:
            p = limit
        return p

    @wp.func
    def next_axis_state(relaxed: real, eps: real, limit: real, state: int, tolerance: real) -> int:
        """State that the sign conditions ask for; `tolerance` [m/s] keeps round-off from flipping it."""
        result = state
        if state == AXIS_STICKS:
            p = -relaxed / eps
            slack = tolerance / eps * real(1.0e-6)
            if p > limit + slack:
                result = AXIS_SLIDES_DOWN
            elif p < -limit - slack:
                result = AXIS_SLIDES_UP
        elif state == AXIS_SLIDES_UP:
            if relaxed - eps * limit < -tolerance:
                result = AXIS_STICKS
        else:
            if relaxed + eps * limit > tolerance:
                result = AXIS_STICKS
        return result

    @wp.func
    def next_closed(relaxed: real, eps: real, w_nn: real, state: int, tolerance: real) -> int:
        """CLOSED or 0, as the signs of gap velocity and normal impulse ask for."""
        closed = state & CLOSED
        if closed != 0:
            if -relaxed / eps * (w_nn + eps) < -tolerance:
                closed = 0
        elif relaxed < -tolerance:
            closed = CLOSED
        return closed

    @wp.func
    def has_friction(state: int, bound: vec2, k: int) -> bool:
        """Do the axes of a contact take part? Those of an open one only with a limit of their own."""
        return k != 0 and ((state & CLOSED) != 0 or bound[0] + bound[1] > real(0.0))

    @wp.func
    def next_state(relaxed: vec3, eps: vec3, w_nn: real, mu: vec2, bound: vec2, k: int, state: int, tolerance: real) -> int:
        """State that the sign conditions of a contact ask for; relaxed = f + J x, w_nn of J M^-1 J^T."""
        closed = next_closed(relaxed[0], eps[0], w_nn, state, tolerance)
        result = closed | (state & 30)
        if has_friction(state & closed, bound, k):
            limit = bound
            if closed != 0:
                limit += mu * wp.max(-relaxed[0] / eps[0], real(0.0))
            first = next_axis_state(relaxed[1], eps[1], limit[0], axis_state(state, 0), tolerance)
            second = next_axis_state(relaxed[2], eps[2], limit[1], axis_state(state, 1), tolerance)
            result = closed | (first << 1) | (second << 3)
        return result

    @wp.func
    def state_impulse(relaxed: vec3, eps: vec3, mu: vec2, bound: vec2, k: int, state: int) -> vec3:
        """Impulse of a contact in its state; relaxed = f + J x."""
        p = vec3()
        if (state & CLOSED) != 0:
            p[0] = wp.max(-relaxed[0] / eps[0], real(0.0))
        if has_friction(state, bound, k):
            limit = mu * p[0] + bound
            p[1] = axis_impulse(relaxed[1], eps[1], limit[0], axis_state(state, 0))
            p[2] = axis_impulse(relaxed[2], eps[2], limit[1], axis_state(state, 1))
        return p

    @wp.func
    def next_cone(relaxed: vec3, eps: vec3, w: vec3, mu: real, state: int, slip: vec3, tolerance: real):
        """The same for Coulomb's cone: state, slip (s_1, s_2, eps_l), and whether either changed; w of J M^-1 J^T."""
        closed = next_closed(relaxed[0], eps[0], w[0], state, tolerance)
        result = closed | (state & 30)
        p_n = wp.max(-relaxed[0] / eps[0], real(0.0))
        limit = mu * p_n
        size = wp.sqrt(relaxed[1] * relaxed[1] + relaxed[2] * relaxed[2])
        turned = bool(False)
        after = slip
        if (state & closed) != 0:
            slides = size > limit * eps[1] * (real(1.0) + real(1.0e-12))
            if axis_state(state, 0) != AXIS_STICKS and slip[0] * relaxed[1] + slip[1] * relaxed[2] < limit * eps[1]:
                slides = False  # it would slide backwards
            result = closed
            if slides:
                result = closed | (AXIS_SLIDES_UP << 1)
                after = vec3(relaxed[1] / size, relaxed[2] / size, eps[1])
                if limit > real(0.0):
                    after[2] = wp.max(eps[1], size / limit)
                if axis_state(state, 0) != AXIS_STICKS:
                    # Friction as the linear system had it against friction along the slip that came of it.
                    along = -limit * (real(1.0) - (slip[0] * relaxed[1] + slip[1] * relaxed[2]) / size)
                    y = slip[0] * relaxed[2] - slip[1] * relaxed[1]
                    across = y * (limit / size - real(1.0) / slip[2])
                    turned = wp.max(wp.abs(along), wp.abs(across)) * w[1] > real(CONE_TOLERANCE)
        return result, after, turned or result != state

    @wp.func
    def cone_impulse(relaxed: vec3, eps: vec3, mu: real, state: int, slip: vec3) -> vec3:
        """Impulse of a contact on the cone, as the linear system of its state saw it."""
        p = vec3()
        if (state & CLOSED) != 0:
            p[0] = wp.max(-relaxed[0] / eps[0], real(0.0))
            if axis_state(state, 0) == AXIS_STICKS:
                p[1] = -relaxed[1] / eps[1]
                p[2] = -relaxed[2] / eps[1]
            else:
                size = wp.sqrt(relaxed[1] * relaxed[1] + relaxed[2] * relaxed[2])
                if size > real(0.0):
                    p[1] = -mu * p[0] * relaxed[1] / size
                    p[2] = -mu * p[0] * relaxed[2] / size
        return p

    @wp.func
    def turned_frame(frame: mat33, slip: vec3) -> mat33:
        """Rows n, the slip, across it."""
        t1 = slip[0] * frame[1] + slip[1] * frame[2]
        return wp.matrix_from_rows(frame[0], t1, wp.cross(frame[0], t1))

    @wp.func
    def row(direction: vec3, arm: vec3, sign: real) -> vec6:
        """J of one direction of a contact and one of its bodies: sign (d, r x d)."""
        m = wp.cross(arm, direction)
        return vec6(sign * direction[0], sign * direction[1], sign * direction[2], sign * m[0], sign * m[1], sign * m[2])

    return SimpleNamespace(
        axis_state=axis_state,
        has_friction=has_friction,
        next_state=next_state,
        state_impulse=state_impulse,
        next_cone=next_cone,
        cone_impulse=cone_impulse,
        turned_frame=turned_frame,
        row=row,
    )


@functools.cache
def make_single(real):
    """Kernel ``pivot_single`` for scenes with one movable body: a thread an environment, 6 x 6 in registers; dim (E)."""
    t = scalar_types(real)
    vec2, vec3, mat33 = t.vec2, t.vec3, t.mat33
    vec6 = wp.types.vector(length=6, dtype=real)
    mat66 = wp.types.matrix(shape=(6, 6), dtype=real)
    Bodies, Contacts = t.Bodies, t.Contacts
    f = functions(real)
    axis_state, has_friction, next_state, state_impulse = f.axis_state, f.has_friction, f.next_state, f.state_impulse
    next_cone, cone_impulse, turned_frame, row = f.next_cone, f.cone_impulse, f.turned_frame, f.row

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
    def add_contact(
        a: mat66, b: vec6, frame: mat33, arm: vec3, sign: real, eps: vec3, free: vec3, mu: vec2, bound: vec2, k: int, state: int
    ):
        """Add what a contact contributes in its state."""
        j_n = row(frame[0], arm, sign)
        column = j_n
        if has_friction(state, bound, k):
            for axis in range(2):
                j_t = row(frame[axis + 1], arm, sign)
                s = axis_state(state, axis)
                if s == AXIS_STICKS:
                    scaled = (real(1.0) / eps[axis + 1]) * j_t
                    a += wp.outer(scaled, j_t)
                    b -= scaled * free[axis + 1]
                elif s == AXIS_SLIDES_UP:
                    column -= mu[axis] * j_t
                    b -= bound[axis] * j_t
                else:
                    column += mu[axis] * j_t
                    b += bound[axis] * j_t
        if (state & CLOSED) != 0:
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
                if contacts.directions[env, i] > 2 or contacts.directions[env, i] < 0:
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
                    bound = contacts.bound[env, i]
                    k = contacts.directions[env, i]
                    if (state & CLOSED) != 0 or has_friction(state, bound, k):
                        sign = real(1.0)
                        if contacts.body[env, i][0] == body:
                            sign = real(-1.0)
                        frame = contacts.frame[env, i]
                        free = contacts.free[env, i]
                        eps = contacts.relaxation[env, i]
                        if k == DISC and axis_state(state, 0) != AXIS_STICKS:
                            slip = contacts.slip[env, i]
                            free = turned_frame(frame, slip) * (wp.transpose(frame) * free)
                            frame = turned_frame(frame, slip)
                            eps[2] = slip[2]
                        a, b = add_contact(a, b, frame, contacts.point[env, i] - com, sign, eps, free, contacts.mu[env, i], bound, k, state)
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
                    w = contacts.inv_mass[env, i]
                    if k == DISC:
                        slip = contacts.slip[env, i]
                        contacts.impulse[env, i] = cone_impulse(relaxed, eps, mu[0], state, slip)
                        after, turned, again = next_cone(relaxed, eps, w, mu[0], state, slip, tolerance)
                        contacts.slip[env, i] = turned
                        contacts.state[env, i] = after
                        if again:
                            flips += 1
                    else:
                        bound = contacts.bound[env, i]
                        after = next_state(relaxed, eps, w[0], mu, bound, k, state, tolerance)
                        contacts.impulse[env, i] = state_impulse(relaxed, eps, mu, bound, k, state)
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
    axis_state, has_friction, next_state, state_impulse = f.axis_state, f.has_friction, f.next_state, f.state_impulse
    next_cone, cone_impulse, turned_frame, row = f.next_cone, f.cone_impulse, f.turned_frame, f.row
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
        """Add what a contact contributes in its present state."""
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
        bound = contacts.bound[env, i]
        k = contacts.directions[env, i]
        if k == DISC and axis_state(state, 0) != AXIS_STICKS:
            slip = contacts.slip[env, i]
            free = turned_frame(frame, slip) * (wp.transpose(frame) * free)
            frame = turned_frame(frame, slip)
            eps[2] = slip[2]
        n_a = row(frame[0], arm_a, real(-1.0))
        n_b = row(frame[0], arm_b, real(1.0))
        column_a = n_a
        column_b = n_b
        if has_friction(state, bound, k):
            for axis in range(2):
                t_a = row(frame[axis + 1], arm_a, real(-1.0))
                t_b = row(frame[axis + 1], arm_b, real(1.0))
                s = axis_state(state, axis)
                mu = contacts.mu[env, i][axis]
                if s == AXIS_STICKS:
                    add_term(ws, slot, start, t_a / eps[axis + 1], t_b / eps[axis + 1], t_a, t_b, free[axis + 1], lane)
                else:
                    sign = real(1.0)
                    if s == AXIS_SLIDES_UP:
                        sign = real(-1.0)
                    column_a += sign * mu * t_a
                    column_b += sign * mu * t_b
                    if bound[axis] > real(0.0):
                        add_term(ws, slot, start, -sign * t_a, -sign * t_b, vec6(), vec6(), bound[axis], lane)
        if (state & CLOSED) != 0:
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
            w = contacts.inv_mass[env, i]
            if k == DISC:
                slip = contacts.slip[env, i]
                contacts.impulse[env, i] = cone_impulse(relaxed, eps, mu[0], state, slip)
                after, turned, again = next_cone(relaxed, eps, w, mu[0], state, slip, tolerance)
                contacts.slip[env, i] = turned
                contacts.state[env, i] = after
                if again:
                    wp.atomic_add(ws.flips, slot, 1)
            else:
                bound = contacts.bound[env, i]
                after = next_state(relaxed, eps, w[0], mu, bound, k, state, tolerance)
                contacts.impulse[env, i] = state_impulse(relaxed, eps, mu, bound, k, state)
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
                if contacts.directions[env, i] > 2 or contacts.directions[env, i] < 0:
                    flips = 0
            while flips > 0 and solves < limit:
                load_masses(ws, bodies, env, slot, lane)
                for i in range(r):
                    state = contacts.state[env, i]
                    if (state & CLOSED) != 0 or has_friction(state, contacts.bound[env, i], contacts.directions[env, i]):
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
