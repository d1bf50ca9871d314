# SPDX-License-Identifier: Apache-2.0
"""Principal pivoting in velocities: the LCP of eq. 39 without ever forming it.

Every contact is open or closed, and each friction axis of a closed one sticks or slides at its limit. For given states
all rows are equations, and eliminating the impulses leaves a system of the size of the velocities: with x = v+ - v_free
and f = J v_free + d,

    closed  p_n = -(f_n + J_n x) / eps_n        stick  p_j = -(f_j + J_j x) / eps_j        slide  p_j = s mu_j p_n

    (M + sum (J_n + s mu J_j)^T J_n / eps_n + sum J_j^T J_j / eps_j) x = -sum (J_n + s mu J_j)^T f_n / eps_n - sum J_j^T f_j / eps_j.

In world axes a contact's impulse is p = -(K J x + g) with a 3 x 3 matrix K, so that it adds blocks K, -K [r], [r] K, -[r] K [r] to
its bodies' part of the system. One body: 6 unknowns in registers. Several: block-sparse, bodies that share a contact being
neighbours (kernels/sparse.py).

States whose sign conditions fail are flipped, all at once, until none does. Started from the states that the contact
rows expect (loaded or not, sliding or sticking) that takes one to three solves. It may cycle: then an environment with one body
stays unsolved and a safer method takes over; one with several goes on with a line search.

Line search. Flipping all at once is Newton's method with full steps on

    R(x) = M x - J^T p(x) = 0,    p(x) = pi(-(f + J x) / eps)        (pi of kernels/friction.py),

which is piecewise linear (the cone aside), with slopes that differ by 1e7 where a contact opens or closes. Without friction R is
the gradient of a convex function, and a step dx that ends where dx . R(x + s dx) = 0 leads to its minimum from anywhere.
Friction is no gradient; the rule works all the same. Where dx points uphill, dx . R >= 0, it is taken whole if |dx . R| falls
(first attempt only), otherwise found again without the growth of friction with p_n, which makes the matrix symmetric and
positive definite.
Steps are short where contacts are stiff, so contacts are softened, eps + softness W_ii, and hardened as soon as a step lands where
it was aimed at. What fails so is tried once more with many small reductions of softness, each followed closely.
x starts at zero: neither states nor history have a say. Each step solves for dx from the momentum R that is missing, so that
round-off of one step is taken out by the next (residuals of 1e-15 m/s; solving for x itself left 1e-6 in stacks).

Coulomb's cone (directions = 1) is the same thing with axes that turn: linearised at a slip y along s,

    p_t = -mu p_n y / |y|   becomes   p_t = -mu p_n s - (y - s s.y) / eps_l,   eps_l = |y| / (mu p_n),

a contact that slides along s and sticks across it with relaxation eps_l: eq. 34 with eq. 43 at the present slip. It is flipped
until s stays where it is, which makes the whole a semismooth Newton method on the exact cone.

Limits of the box and hybrid laws do not follow p_n (`bound`); they hold for open contacts too.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import friction, sparse, systems
from .declare import BLOCK_OPTIONS, factory, kernel
from .types import CLOSED, DISC, HELD, ITERATION_LIMIT, scalar_types, sync

AXIS_STICKS = 0
AXIS_SLIDES_UP = 1  # along +t: the impulse is -mu p_n
AXIS_SLIDES_DOWN = 2
# Friction on the cone is linearised again while it misses its direction by more than this [m/s].
CONE_TOLERANCE = wp.constant(1.0e-9)
# Newton's method (see above), first and careful attempt: what the softness is multiplied by, where it becomes zero, the steps spent
# on each, and when a step hits the problem: where no impulse is further from what was expected than this part of the largest
# velocity. Softness starts at SOFTEST; at zero the answer is as exact as MISS [m/s].
SOFTEST = 0.1
HARDER = wp.constant(wp.vec2d(0.01, 0.316))
HARDEST = wp.constant(wp.vec2d(0.9e-5, 1.0e-8))
SOFT_STEPS = wp.constant(wp.vec2i(8, 20))
SOFT_MISS = wp.constant(wp.vec2d(1.0e-2, 1.0e-4))
MISS = 1.0e-9
# The line search ends where dx . R has fallen to this part, or after so many looks.
LINE_ACCURACY = 0.1
MOST_LOOKS = 24


@functools.cache
def functions(real, cone: bool, frozen: bool, joints: bool = False) -> SimpleNamespace:
    """Functions of one contact, whatever solves the linear system: ``operator`` and ``update``.

    cone: Coulomb's cone instead of two axes; frozen: limits that do not follow p_n. They take numbers, not bundles: Warp passes
    a bundle by value, a kilobyte a call.
    """
    t = scalar_types(real)
    vec2, vec3, mat33 = t.vec2, t.vec3, t.mat33

    @wp.func
    def axis_state(state: int, axis: int) -> int:
        return (state >> (1 + 2 * axis)) & 3

    @wp.func
    def axis(relaxed: real, eps: real, limit: real, next_limit: real, state: int, tolerance: real):
        """Impulse of a friction axis in its state, and the state that its signs ask for at the limit to come.

        relaxed = f_j + J_j x, limit = mu p_n + bound; `tolerance` [m/s] keeps round-off from flipping it.
        """
        p = -limit
        result = state
        if state == AXIS_STICKS:
            stiffness = real(1.0) / eps
            p = -relaxed * stiffness
            slack = tolerance * stiffness * real(1.0e-6)
            if p > next_limit + slack:
                result = AXIS_SLIDES_DOWN
            elif p < -next_limit - slack:
                result = AXIS_SLIDES_UP
        elif state == AXIS_SLIDES_UP:
            if relaxed - eps * next_limit < -tolerance:
                result = AXIS_STICKS
        else:
            p = limit
            if relaxed + eps * next_limit > tolerance:
                result = AXIS_STICKS
        return p, result

    @wp.func
    def next_closed(relaxed: real, pressed: real, mass: real, state: int, tolerance: real) -> int:
        """CLOSED or 0, as the signs of gap velocity and normal impulse ask for; pressed = -relaxed / eps, mass = w_nn + eps."""
        closed = state & CLOSED
        if closed != 0:
            if pressed * mass < -tolerance:
                closed = 0
        elif relaxed < -tolerance:
            closed = CLOSED
        return closed

    @wp.func
    def has_friction(state: int, bound: vec2, k: int) -> bool:
        """Do the axes of a contact take part? Those of an open one only with a limit of their own."""
        result = k != 0 and (state & CLOSED) != 0
        if wp.static(frozen):
            result = k != 0 and ((state & CLOSED) != 0 or bound[0] + bound[1] > real(0.0))
        return result

    @wp.func
    def next_cone(relaxed: vec3, eps: vec3, w: vec3, mu: real, p_n: real, closed: int, state: int, slip: vec3):
        """State on Coulomb's cone, slip (s_1, s_2, eps_l), and whether either changed; w of J M^-1 J^T, closed: what comes."""
        result = closed | (state & 30)
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
    def cone_friction(relaxed: vec3, eps: vec3, limit: real, state: int) -> vec3:
        """Friction impulse of a closed contact on the cone, as the linear system of its state saw it."""
        p = vec3()
        if axis_state(state, 0) == AXIS_STICKS:
            p = vec3(real(0.0), -relaxed[1], -relaxed[2]) * (real(1.0) / eps[1])
        else:
            size = wp.sqrt(relaxed[1] * relaxed[1] + relaxed[2] * relaxed[2])
            if size > real(0.0):
                p = vec3(real(0.0), -relaxed[1], -relaxed[2]) * (limit / size)
        return p

    @wp.func
    def operator(frame: mat33, eps: vec3, free: vec3, mu: vec2, bound: vec2, k: int, state: int, slip: vec3):
        """K [kg] and g [N s], world axes, of a contact in its state: p = -(K J x + g)."""
        matrix = mat33()
        shift = vec3()
        column = frame[0]
        axes = frame
        held = bool(False)
        if wp.static(joints):
            held = k == HELD
        if held:
            matrix = wp.transpose(frame) * wp.diag(wp.cw_div(vec3(real(1.0)), eps)) * frame
            shift = wp.transpose(frame) * wp.cw_div(free, eps)
        f = free
        e = eps
        if wp.static(cone):  # noqa: SIM102
            if (k == DISC or wp.static(not joints)) and axis_state(state, 0) != AXIS_STICKS:  # axes along and across the slip
                along = slip[0] * frame[1] + slip[1] * frame[2]
                axes = wp.matrix_from_rows(frame[0], along, wp.cross(frame[0], along))
                f = vec3(free[0], slip[0] * free[1] + slip[1] * free[2], slip[0] * free[2] - slip[1] * free[1])
                e[2] = slip[2]
        if not held and has_friction(state, bound, k):
            for axis in range(2):
                t = axes[1 + axis]
                if axis_state(state, axis) == AXIS_STICKS:
                    scaled = t * (real(1.0) / e[1 + axis])
                    matrix += wp.outer(scaled, t)
                    shift += scaled * f[1 + axis]
                else:
                    sign = real(1.0)
                    if axis_state(state, axis) == AXIS_SLIDES_UP:
                        sign = real(-1.0)
                    column += (sign * mu[axis]) * t
                    if wp.static(frozen):
                        shift -= (sign * bound[axis]) * t
        if not held and (state & CLOSED) != 0:
            column = column * (real(1.0) / eps[0])
            matrix += wp.outer(column, frame[0])
            shift += column * free[0]
        return matrix, shift

    @wp.func
    def update(relaxed: vec3, eps: vec3, w: vec3, mu: vec2, bound: vec2, k: int, state: int, slip: vec3, tolerance: real):
        """Impulse (n, t1, t2) of a contact in its state, the state and slip that its signs ask for, and whether they are others.

        relaxed = f + J x; w: diagonal of J M^-1 J^T.
        """
        p = vec3()
        turned = slip
        if wp.static(joints):  # noqa: SIM102
            if k == HELD:
                return -wp.cw_div(relaxed, eps), state, turned, False
        pressed = -relaxed[0] / eps[0]
        closed = next_closed(relaxed[0], pressed, w[0] + eps[0], state, tolerance)
        after = closed | (state & 30)
        again = after != state
        pressed = wp.max(pressed, real(0.0))
        if (state & CLOSED) != 0:
            p[0] = pressed
        on_cone = bool(False)
        if wp.static(cone):
            on_cone = k == DISC or (wp.static(not joints) and k != 0)
            if on_cone:
                if (state & CLOSED) != 0:
                    p += cone_friction(relaxed, eps, mu[0] * pressed, state)
                after, turned, again = next_cone(relaxed, eps, w, mu[0], pressed, closed, state, slip)
        if not on_cone and has_friction(state, bound, k):
            limit = mu * p[0] + bound
            next_limit = bound
            if closed != 0:
                next_limit += mu * pressed
            p_1, first = axis(relaxed[1], eps[1], limit[0], next_limit[0], axis_state(state, 0), tolerance)
            p_2, second = axis(relaxed[2], eps[2], limit[1], next_limit[1], axis_state(state, 1), tolerance)
            p = vec3(p[0], p_1, p_2)
            if has_friction(state & closed, bound, k):
                after = closed | (first << 1) | (second << 3)
                again = after != state
        return p, after, turned, again

    return SimpleNamespace(has_friction=has_friction, operator=operator, update=update)


@factory
def make(real, cone: bool, frozen: bool, trees: bool = False) -> SimpleNamespace:
    """Bundle ``Workspace`` and kernel ``pivot`` for scenes with several movable bodies, or with joints; launch tiled with dim (P)."""
    t = scalar_types(real)
    vec2, vec3, mat33 = t.vec2, t.vec3, t.mat33
    vec6 = wp.types.vector(length=6, dtype=real)
    Contacts = t.Contacts
    f = functions(real, cone, frozen, trees)
    operator, update = f.operator, f.update
    law = friction.functions(real, trees, facets=False)  # laws with two axes or a disc are all that this method takes
    admissible, slope, weigh = law.admissible, law.slope, law.weigh
    s = sparse.functions(real, 6)
    Graph, clear_factors, factorise, solve = s.Graph, s.clear_factors, s.factorise, s.solve
    system = systems.trees(real) if trees else systems.bodies(real)
    Mechanics, Workspace, list_contacts, couple = system.Mechanics, system.Workspace, system.list_contacts, system.couple
    assemble_row, change_at, energies = system.assemble_row, system.change_at, system.energies
    prepare = system.prepare if trees else None

    @wp.func
    def tangent(frame: mat33, relaxed: vec3, stiffness: vec3, mu: vec2, bound: vec2, k: int, follows: real):
        """The impulse p = pi(-relaxed / eps) linearised: p - K J dx; K [kg] and -p [N s] in world axes, stiffness = 1 / eps.

        follows = 0 leaves out that friction grows with the normal impulse, which makes K symmetric.
        """
        x = -wp.cw_mul(relaxed, stiffness)
        d = slope(x, mu, bound, k)
        d[1, 0] = follows * d[1, 0]
        d[2, 0] = follows * d[2, 0]
        back = wp.transpose(frame)
        return back * (d * wp.diag(stiffness)) * frame, -(back * admissible(x, mu, bound, k))

    @wp.func
    def begin_search(ws: Workspace, mechanics: Mechanics, contacts: Contacts, env: int, slot: int, r: int, lane: int):
        """J dx, the impulses expected at x + dx, J dx . p(x), and in scratch dx . M x and dx . M dx of each node."""
        for i in range(lane, r, wp.block_dim()):
            frame = contacts.frame[env, i]
            du = change_at(ws, mechanics, contacts.body, contacts.point, env, slot, i)
            ws.ahead[slot, i] = frame * du
            shift = ws.shift[slot, i]
            ws.expected[slot, i] = -(frame * (ws.matrix[slot, i] * du + shift))
            ws.part[slot, i] = vec3(-wp.dot(du, shift), real(0.0), real(0.0))
        for b in range(lane, ws.body.shape[0], wp.block_dim()):
            energy = energies(ws, mechanics, env, slot, b)
            ws.scratch[slot, b] = vec6(energy[0], energy[1], real(0.0), real(0.0), real(0.0), real(0.0))
        sync()

    @wp.func
    def look(ws: Workspace, contacts: Contacts, env: int, slot: int, r: int, length: real, lane: int):
        """Impulses at x + length dx, and what contacts add to dx . R there, to its derivative and to the miss (`step_length`)."""
        for i in range(lane, r, wp.block_dim()):
            k = contacts.directions[env, i]
            mu = contacts.mu[env, i]
            bound = contacts.bound[env, i]
            stiffness = ws.stiffness[slot, i]
            ahead = ws.ahead[slot, i]
            x = -wp.cw_mul(ws.relaxed[slot, i] + length * ahead, stiffness)
            p = admissible(x, mu, bound, k)
            contacts.impulse[env, i] = p
            part = vec3(wp.dot(ahead, p), wp.dot(ahead, slope(x, mu, bound, k) * wp.cw_mul(ahead, stiffness)), real(0.0))
            if length == real(1.0):
                part[2] = wp.max(wp.cw_mul(weigh(contacts.inv_mass[env, i], k), wp.abs(p - ws.expected[slot, i])))
            ws.part[slot, i] = part
        sync()

    @wp.func
    def step_length(ws: Workspace, contacts: Contacts, env: int, slot: int, r: int, enough: real, lane: int):
        """The part of the step after which dx . R is next to nothing, dx . R [J] before and after it, and how far the impulses
        after the whole step are from those expected (the miss) [m/s]; the whole step where that is no more than `enough`, or where
        dx points uphill.

        R = M x - J^T p(x) is what is left of the momentum's balance. Where friction does not matter R is the gradient of a
        convex function, and this its least value along dx.
        """
        start = real(0.0)
        mass = real(0.0)
        for b in range(ws.body.shape[0]):
            moved = ws.scratch[slot, b]
            start += moved[0]
            mass += moved[1]
        balance = start
        for i in range(r):
            start -= ws.part[slot, i][0]
        sync()
        length = real(1.0)
        low = real(0.0)
        high = real(1.0)
        after = real(0.0)
        miss = real(0.0)
        looks = int(0)
        looking = bool(True)
        while looking:
            look(ws, contacts, env, slot, r, length, lane)
            after = balance + length * mass
            rate = mass
            for i in range(r):
                part = ws.part[slot, i]
                after -= part[0]
                rate += part[1]
                if looks == 0:
                    miss = wp.max(miss, part[2])
            sync()
            looks += 1
            if after > real(0.0):
                high = length
            else:
                low = length
            small = wp.abs(after) <= real(LINE_ACCURACY) * wp.abs(start)
            if miss <= enough or start >= real(0.0) or small or low == real(1.0) or looks == MOST_LOOKS:
                looking = False
            else:
                length -= after / rate
                if not (length > low and length < high):
                    # Contacts may differ in stiffness by a factor of 1e7.
                    length = real(0.5) * (low + high)
                    if low == real(0.0):
                        length = real(0.1) * high
        return length, start, after, miss

    @kernel(BLOCK_OPTIONS)
    def pivot(
        mechanics: Mechanics,
        contacts: Contacts,
        todo: wp.array(dtype=int),
        number: wp.array(dtype=int),
        g: Graph,
        ws: Workspace,
        limits: wp.vec3i,
        tolerance: real,
        iterations: wp.array(dtype=int),
        reason: wp.array(dtype=int),
    ):
        slot, lane = wp.tid()
        n = ws.body.shape[0]
        for index in range(slot, number[0], ws.flips.shape[0]):
            env = todo[index]
            r = contacts.count[env]
            solves = int(0)
            searching = r > 0
            if searching:
                if wp.static(trees):
                    prepare(ws, mechanics, contacts.body, env, slot, r, lane)
                list_contacts(ws, contacts.body, env, slot, r, lane)
                searching = couple(g, ws, contacts.body, env, slot, lane)
            stopped = r > 0 and not searching
            for b in range(lane, n, wp.block_dim()):
                ws.present[slot, b] = vec6()
            attempt = int(0)  # flips, then Newton's method, then the same carefully
            limit = limits[0]
            softness = real(0.0)
            follows = real(1.0)
            size = real(0.0)
            inner = int(0)
            while searching:
                # Each function is called in one place: Warp's compilers inline them all.
                clear_factors(g, slot, n, lane)
                for i in range(lane, r, wp.block_dim()):
                    bound = vec2()
                    if wp.static(frozen):
                        bound = contacts.bound[env, i]
                    matrix = mat33()
                    shift = vec3()
                    if attempt == 0:
                        slip = vec3()
                        if wp.static(cone):
                            slip = contacts.slip[env, i]
                        matrix, shift = operator(
                            contacts.frame[env, i],
                            contacts.relaxation[env, i],
                            contacts.free[env, i],
                            contacts.mu[env, i],
                            bound,
                            contacts.directions[env, i],
                            contacts.state[env, i],
                            slip,
                        )
                    else:
                        k = contacts.directions[env, i]
                        eps = contacts.relaxation[env, i] + softness * weigh(contacts.inv_mass[env, i], k)
                        stiffness = wp.cw_div(vec3(real(1.0)), eps)
                        ws.stiffness[slot, i] = stiffness
                        matrix, shift = tangent(
                            contacts.frame[env, i], ws.relaxed[slot, i], stiffness, contacts.mu[env, i], bound, k, follows
                        )
                    ws.matrix[slot, i] = matrix
                    ws.shift[slot, i] = shift
                if lane == 0:
                    ws.flips[slot] = 0
                sync()
                for b in range(lane, n, wp.block_dim()):
                    assemble_row(g, ws, mechanics, contacts.body, contacts.point, env, slot, b)
                sync()
                factorise(g, slot, n, lane)
                solve(g, slot, n, ws.change, ws.scratch, lane)
                solves += 1
                if attempt == 0:
                    for i in range(lane, r, wp.block_dim()):
                        du = change_at(ws, mechanics, contacts.body, contacts.point, env, slot, i)
                        bound = vec2()
                        if wp.static(frozen):
                            bound = contacts.bound[env, i]
                        slip = vec3()
                        if wp.static(cone):
                            slip = contacts.slip[env, i]
                        p, after, turned, again = update(
                            contacts.free[env, i] + contacts.frame[env, i] * du,
                            contacts.relaxation[env, i],
                            contacts.inv_mass[env, i],
                            contacts.mu[env, i],
                            bound,
                            contacts.directions[env, i],
                            contacts.state[env, i],
                            slip,
                            tolerance,
                        )
                        contacts.impulse[env, i] = p
                        if again:
                            wp.atomic_add(ws.flips, slot, 1)
                            contacts.state[env, i] = after
                            if wp.static(cone):
                                contacts.slip[env, i] = turned
                    sync()
                    searching = ws.flips[slot] > 0
                    sync()
                else:
                    begin_search(ws, mechanics, contacts, env, slot, r, lane)
                    enough = real(MISS)
                    if softness > real(0.0):
                        enough = real(SOFT_MISS[attempt - 1]) * size
                    length, first, last, miss = step_length(ws, contacts, env, slot, r, enough, lane)
                    inner += 1
                    done = miss <= enough
                    uphill = first >= real(0.0) and (attempt > 1 or wp.abs(last) >= first)
                    if uphill and not done and follows > real(0.0):
                        follows = real(0.0)  # once more from here
                    else:
                        follows = real(1.0)
                        for i in range(lane, r, wp.block_dim()):
                            ws.relaxed[slot, i] = ws.relaxed[slot, i] + length * ws.ahead[slot, i]
                        for b in range(lane, n, wp.block_dim()):
                            ws.present[slot, b] = ws.present[slot, b] + length * ws.change[slot, b]
                        sync()
                    searching = not done or softness > real(0.0)
                    if softness > real(0.0) and (done or inner >= SOFT_STEPS[attempt - 1]):
                        inner = 0
                        softness = real(HARDER[attempt - 1]) * softness
                        if softness < real(HARDEST[attempt - 1]):
                            softness = real(0.0)
                if searching and solves >= limit:
                    # Again, from no impulse at all and with soft contacts.
                    attempt += 1
                    searching = attempt <= 2
                    stopped = not searching
                    if searching:
                        limit = solves + limits[attempt]
                    softness = real(SOFTEST)
                    follows = real(1.0)
                    inner = 0
                    size = real(0.0)
                    for i in range(r):
                        size = wp.max(size, wp.max(wp.abs(contacts.free[env, i])))
                    for i in range(lane, r, wp.block_dim()):
                        ws.relaxed[slot, i] = contacts.free[env, i]
                    for b in range(lane, n, wp.block_dim()):
                        ws.present[slot, b] = vec6()
                    sync()
            if lane == 0:
                iterations[env] = iterations[env] + solves
                if stopped:
                    reason[env] = reason[env] | ITERATION_LIMIT
            sync()

    return SimpleNamespace(Graph=Graph, Workspace=Workspace, pivot=pivot)
