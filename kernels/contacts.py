# SPDX-License-Identifier: Apache-2.0
"""From contact points to contact rows: frames, stick or slide, relaxation and bristles (eqs. 34, 40-43).

One thread an environment selects its contacts in the order of the slots, so that rows always come in the same order; then
each contact gets its row. The frame of every
contact is chosen so that t1 is the direction that matters: the sliding direction while it slides, the direction in
which it would slip while it sticks. E of eq. 18 is then the same k directions at angles j pi / k for every contact.

Functions that take bundles of arrays are called in one place of a kernel, where compilers inline them: a call would copy a kilobyte.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import rigid, tree
from .collide import NO_POINT, pair_functions
from .declare import factory, kernel
from .types import CONE, DISC, FACETS, MAX, MIN, MULTIPLY, OVERFLOW, REGULARIZED, scalar_types

# Overlaps that no load explains are pushed apart no faster than this [m/s], whatever the stiffness; what turns comes on top.
MAX_DEPENETRATION_SPEED = wp.constant(3.0)
# A contact that opens by more than this many static deflections under its weight has separated; one that is deeper than as
# many under its weight or last impulse overlaps for another reason.
ELASTIC_RANGE = wp.constant(10.0)
# Where turning shapes leave the tangent plane a contact leaves with this part at most of the speed with which it comes. A half is
# what a point on a circle needs along its chords; with all of it friction makes energy, 2e-3 of a heap's at 5 ms, 1e-5 with half.
GIVEN_BACK = wp.constant(0.5)
# Of overlaps in a tree that would be pushed against each other (the cosine of their normals in the metric of the masses is less than
# OPPOSED, and they are no parallel points of one face) each is pushed apart no faster than this [m/s].
OPPOSED = wp.constant(-0.02)
MAX_OPPOSED_SPEED = wp.constant(0.03)
# A predicted slip under this part of the free velocity is round-off and has no direction.
NO_SLIP = wp.constant(1.0e-6)
# Friction that was this part of its limit was at it.
AT_LIMIT = wp.constant(0.999)
# The last normal impulse that eq. 43 divides by is at least this part of the contact's weight.
IMPULSE_FLOOR = wp.constant(1.0e-2)


@functools.cache
def row_functions(real) -> SimpleNamespace:
    """What a contact row is made of."""
    t = scalar_types(real)
    vec2, vec3, vec5, mat33 = t.vec2, t.vec3, t.vec5, t.mat33
    Bodies, Contacts, Parameters, Slots, Topology = t.Bodies, t.Contacts, t.Parameters, t.Slots, t.Topology
    body = rigid.functions(real)
    point_velocity, direction_mobility = body.point_velocity, body.direction_mobility
    shape_pose = pair_functions(real).shape_pose

    @wp.struct
    class History:
        """The same contact one step ago."""

        touched: bool
        impulse: real  # h lambda_n, N s
        bristle: vec3  # lambda_t + b_t u_t, N

    @wp.struct
    class Row:
        frame: mat33
        inv_mass: vec3
        relaxation: vec3
        shift: vec3
        free: vec3
        damping: real
        mu: vec2
        bound: vec2
        lateral: real  # eq. 43 where Coulomb's cone is first linearised
        directions: int
        closed: bool
        state: int

    @wp.func
    def authored(a: real, b: real, default: real) -> real:
        """Mean of what the materials of a pair author (NaN = nothing), else the default."""
        result = default
        if wp.isnan(a):
            if not wp.isnan(b):
                result = b
        elif wp.isnan(b):
            result = a
        else:
            result = real(0.5) * (a + b)
        return result

    @wp.func
    def contact_parameters(a: vec5, b: vec5, mass: real) -> vec5:
        """k_n, b_n, k_t, b_t, v_s of a pair; unauthored ones are Table 1 for the mass of the lighter movable body."""
        return vec5(
            authored(a[0], b[0], real(1.0e10) * mass),
            authored(a[1], b[1], real(1.0e8) * mass),
            authored(a[2], b[2], real(1.0e8) * mass),
            authored(a[3], b[3], real(1.0e5) * mass),
            authored(a[4], b[4], real(1.0e-3)),
        )

    @wp.func
    def tangent_part(x: vec3, n: vec3) -> vec3:
        return x - n * wp.dot(n, x)

    @wp.func
    def unit(x: vec3) -> vec3:
        return x * (real(1.0) / wp.length(x))

    @wp.func
    def any_axis(n: vec3) -> vec3:
        """World x, or y where the normal is near x: fixed facets start from its projection on the tangent plane."""
        axis = vec3(real(1.0), real(0.0), real(0.0))
        if wp.abs(n[0]) > real(0.9):
            axis = vec3(real(0.0), real(1.0), real(0.0))
        return axis

    @wp.func
    def make_row(
        w_nn: real,
        n: vec3,
        phi: real,
        bend: real,
        u: vec3,
        u_free: vec3,
        c: vec5,
        friction: vec2,
        history: History,
        g: real,
        h: real,
        sliding: int,
        directions: int,
        frozen: int,
    ) -> Row:
        """Row of one contact; u and u_free: present and free velocity of b relative to a, world axes; g = |gravity|.

        w_nn: J_n M^-1 J_n^T; directions: the set that a sticking contact admits (kernels/friction.py); frozen: its limit is mu p_n
        of the last step.
        """
        k_n = c[0]
        b_n = c[1]
        k_t = c[2]
        b_t = c[3]

        # A new contact starts with its weight and slack bristles.
        weight = h * g / w_nn
        if weight == real(0.0):
            weight = wp.abs(wp.dot(n, u_free)) / w_nn
        impulse = weight
        bristle = vec3()
        if history.touched:
            impulse = history.impulse
            bristle = tangent_part(history.bristle, n)

        # Normal row. Eqs. 40 and 41 while the surfaces touch; an open gap only may not close by more than itself.
        # Compliance moves surfaces in contact apart and together by the deflection under their load, so one that
        # touched stays in contact within that range: there an unloaded point carries on with the same law as the
        # loaded ones beside it, which is what makes redundant normal forces unique.
        eps_n = real(1.0) / (k_n * h * h + b_n * h)
        closed = phi <= real(0.0) or (history.touched and phi * k_n * h <= real(ELASTIC_RANGE) * weight)
        turned = wp.clamp(real(GIVEN_BACK) * h * wp.dot(n, u), wp.min(bend, real(0.0)), real(0.0))
        d_n = (phi + wp.max(bend, real(0.0)) + turned) / h
        if closed:
            # Overlap that no load explains is pushed apart with the speed that gravity takes away until the surfaces are
            # clear, or it would stay in the bodies. Springs keep what they are owed.
            load = real(ELASTIC_RANGE) * wp.max(weight, impulse)
            spring = h * k_n * phi
            if spring < -load:
                push = real(MAX_DEPENETRATION_SPEED)
                if g > real(0.0):
                    depth = -phi - load / (k_n * h)
                    fall = real(0.5) * g * h
                    push = wp.min(push, wp.sqrt(real(2.0) * g * depth + fall * fall) - fall)
                d_n = wp.max(eps_n * spring, -eps_n * load - push)
            else:
                d_n = eps_n * spring
            d_n += turned / h

        eps_t = real(1.0) / (k_t * h * h + b_t * h)
        if directions < 0:  # Anitescu and Potra: rigid friction, no bristles
            eps_t = real(0.0)
        slip = tangent_part(u, n)
        slides = wp.length_sq(slip) >= c[4] * c[4] and wp.length_sq(slip) > real(0.0)  # a tiny threshold is 0 when squared
        speed = real(0.0)
        mu = friction[0]
        if slides:
            mu = friction[1]
            speed = wp.length(slip)
        eps = vec3(eps_n, eps_t, eps_t)
        d_t = -(eps_t * h) * bristle  # eq. 42
        mu_row = vec2(mu, mu)
        k = directions
        lateral = eps_t
        load = mu * wp.max(impulse, real(IMPULSE_FLOOR) * weight)  # zero where neither gravity nor motion presses: no eq. 43
        # t1 lies along the slip, or along the slip to come: there the limit of a sticking contact is mu_s lambda_n exactly.
        along = slip
        if not slides:
            along = tangent_part(u_free, n) + d_t
        aligned = slides or wp.length_sq(along) > real(NO_SLIP * NO_SLIP) * wp.length_sq(u_free)
        if sliding == FACETS or not aligned:
            along = any_axis(n)
        t1 = unit(tangent_part(along, n))  # once more: a small slip is a difference of large numbers
        if slides:
            if sliding == FACETS or sliding == CONE:  # noqa: SIM109
                d_t = vec3()  # the direction of friction is that of the slip alone
                if load > real(0.0):
                    lateral = wp.max(eps_t, speed / load)
            else:
                # Eq. 34, and eq. 43 across the sliding direction.
                d_t = t1 * wp.dot(t1, d_t)
                k = 2
                if sliding == REGULARIZED and load > real(0.0):
                    eps[2] = wp.max(eps_t, speed / load)
                else:
                    mu_row[1] = real(0.0)
        if mu == real(0.0):
            k = 0
        bound = vec2()
        if frozen != 0:
            if history.touched or closed:  # a point in the air has carried nothing
                bound = mu_row * impulse
            mu_row = vec2()
        t2 = wp.cross(n, t1)

        row = Row()
        row.frame = wp.matrix_from_rows(n, t1, t2)
        row.relaxation = eps
        row.shift = vec3(d_n, wp.dot(t1, d_t), wp.dot(t2, d_t))
        row.mu = mu_row
        row.bound = bound
        row.lateral = lateral
        row.directions = k
        row.closed = closed
        # What velocity pivoting starts from: closed where it was loaded or is about to be, t1 named as it is expected.
        if impulse > real(0.0) and wp.dot(n, u_free) + d_n < real(0.0):
            row.state = 1
        if slides and sliding != FACETS:
            row.state = row.state | 2
        return row

    @wp.func
    def velocities(topology: Topology, bodies: Bodies, env: int, pair: int, point: vec3):
        """Present and free velocity of b relative to a at a point, world axes, moving surfaces included."""
        u = vec3()
        u_free = vec3()
        body = topology.pair_body[pair]
        for side in range(2):
            sign = real(2 * side - 1)
            shape = topology.pairs[pair, side]
            b = body[side]
            belt = topology.surface_velocity[shape]
            if wp.dot(belt, belt) > real(0.0):
                belt = sign * wp.transform_vector(shape_pose(topology, bodies, env, shape), belt)
                u += belt
                u_free += belt
            if b >= 0:
                arm = point - bodies.com[env, b]
                u += sign * point_velocity(bodies.velocity[env, b], arm)
                u_free += sign * point_velocity(bodies.free_velocity[env, b], arm)
        return u, u_free

    @wp.func
    def mobility(bodies: Bodies, env: int, body: wp.vec2i, point: vec3, direction: vec3) -> real:
        """J M^-1 J^T of a contact along a unit direction."""
        w = real(0.0)
        for side in range(2):
            b = body[side]
            if b >= 0:
                w += direction_mobility(bodies.inv_mass[env, b], bodies.inv_inertia[env, b], point - bodies.com[env, b], direction)
        return w

    @wp.func
    def expected(row: Row, touched: bool, u_n: real, impulse: real, carried: vec3) -> int:
        """What velocity pivoting starts from in a tree, whose joints may make any other motion of a free one; carried: the last friction.

        What hung over another thing without moving is not expected to close, and what was at its limit of friction to stay there.
        """
        state = row.state
        if not touched:
            if u_n + row.shift[0] >= real(0.0):
                state = state & ~1
        elif state == 1 and row.directions == 2:
            for axis in range(2):
                limit = real(AT_LIMIT) * row.mu[axis] * impulse
                if limit > real(0.0) and carried[1 + axis] < -limit:
                    state = state | (1 << (1 + 2 * axis))
                elif limit > real(0.0) and carried[1 + axis] > limit:
                    state = state | (2 << (1 + 2 * axis))
        return state

    @wp.func
    def read_row(
        topology: Topology,
        parameters: Parameters,
        slots: Slots,
        env: int,
        slot: int,
        w_nn: real,
        u: vec3,
        u_free: vec3,
        h: real,
        sliding: int,
        directions: int,
        frozen: int,
    ) -> Row:
        """Row of the contact at a slot, all but inv_mass; u, u_free: world axes."""
        pair = topology.slot_pair[slot]
        g = wp.length(parameters.gravity[env % parameters.gravity.shape[0]])
        friction = parameters.pair_friction[env % parameters.pair_friction.shape[0], pair]
        c = parameters.pair_contact[env % parameters.pair_contact.shape[0], pair]
        history = History()
        history.touched = slots.last_feature[env, slot] == slots.feature[env, slot]
        history.impulse = slots.last_impulse[env, slot]
        history.bristle = slots.last_bristle[env, slot]
        n = slots.normal[env, slot]
        phi = slots.gap[env, slot]
        row = make_row(w_nn, n, phi, slots.bend[env, slot], u, u_free, c, friction, history, g, h, sliding, directions, frozen)
        row.free = row.frame * u_free + row.shift
        row.damping = c[3]
        return row

    @wp.func
    def write_row(contacts: Contacts, env: int, i: int, body: wp.vec2i, point: vec3, phi: real, row: Row):
        contacts.body[env, i] = body
        contacts.point[env, i] = point
        contacts.gap[env, i] = phi
        contacts.closed[env, i] = int(row.closed)
        contacts.frame[env, i] = row.frame
        contacts.inv_mass[env, i] = row.inv_mass
        contacts.relaxation[env, i] = row.relaxation
        contacts.shift[env, i] = row.shift
        contacts.free[env, i] = row.free
        contacts.mu[env, i] = row.mu
        contacts.bound[env, i] = row.bound
        if row.directions == DISC:
            contacts.slip[env, i] = vec3(real(1.0), real(0.0), row.lateral)
        contacts.directions[env, i] = row.directions
        contacts.damping[env, i] = row.damping
        contacts.impulse[env, i] = vec3()
        contacts.state[env, i] = row.state

    return SimpleNamespace(
        contact_parameters=contact_parameters,
        velocities=velocities,
        mobility=mobility,
        expected=expected,
        read_row=read_row,
        write_row=write_row,
    )


@functools.cache
def combined_by(real):
    """Function (mode, a, b): the coefficient of two materials."""

    @wp.func
    def combined(mode: int, a: real, b: real) -> real:
        result = real(0.5) * (a + b)
        if mode == MIN:
            result = wp.min(a, b)
        elif mode == MULTIPLY:
            result = a * b
        elif mode == MAX:
            result = wp.max(a, b)
        return result

    return combined


@factory
def selection(real) -> SimpleNamespace:
    """Kernels ``combine_pairs`` (dim N, P) and ``select_contacts`` (dim E)."""
    t = scalar_types(real)
    vec5 = t.vec5
    Bodies, Contacts, Parameters, Slots, Topology = t.Bodies, t.Contacts, t.Parameters, t.Slots, t.Topology
    f = row_functions(real)
    contact_parameters, velocities = f.contact_parameters, f.velocities
    combined = combined_by(real)

    @kernel()
    def combine_pairs(topology: Topology, parameters: Parameters, combine: wp.array(dtype=int)):
        """Friction and contact parameters of every pair: of its two shapes' materials the mean, or as combine [P | 0] says, or Table 1."""
        i, pair = wp.tid()
        a = topology.pairs[pair, 0]
        b = topology.pairs[pair, 1]
        if i < parameters.pair_friction.shape[0]:
            mean = real(0.5) * (parameters.friction[i, a] + parameters.friction[i, b])
            if combine.shape[0] > 0:
                for k in range(2):
                    mean[k] = combined(combine[pair], parameters.friction[i, a][k], parameters.friction[i, b][k])
            parameters.pair_friction[i, pair] = mean
        if i < parameters.pair_contact.shape[0]:
            mass = real(0.0)  # of the lighter movable body
            for side in range(2):
                body = topology.pair_body[pair][side]
                if body >= 0 and topology.movable[wp.max(body, 0)] != 0:
                    m = parameters.mass[i % parameters.mass.shape[0], body]
                    if mass == real(0.0) or m < mass:
                        mass = m
            c_a = vec5()
            c_b = vec5()
            for k in range(5):
                c_a[k] = parameters.contact[i % parameters.contact.shape[0], a, k]
                c_b[k] = parameters.contact[i % parameters.contact.shape[0], b, k]
            parameters.pair_contact[i, pair] = contact_parameters(c_a, c_b, mass)

    @wp.func
    def share(bodies: Bodies, env: int, body: wp.vec2i, side: int) -> real:
        """Of the speed of a hit, how much the body on this side may take on: all, unless the other one is lighter."""
        w = real(0.0)
        other = real(0.0)
        for k in range(2):
            if body[k] >= 0:
                if k == side:
                    w = bodies.inv_mass[env, body[k]]
                else:
                    other = bodies.inv_mass[env, body[k]]
        result = real(0.0)
        if w > real(0.0):
            result = wp.min(real(2.0) * w / (w + other), real(1.0))
        return result

    @wp.func
    def select(
        topology: Topology,
        bodies: Bodies,
        listed: wp.array2d(dtype=int),
        slots: Slots,
        env: int,
        h: real,
        fall: real,
        again: bool,
        contacts: Contacts,
        status: wp.array(dtype=int),
    ) -> int:
        """Slots whose gap could close; again: once hits are known, else they are looked for. Returns their number."""
        meet = bodies.hit.shape[1] > 0
        if meet and not again:
            for b in range(bodies.hit.shape[1]):
                bodies.hit[env, b] = real(0.0)
        alert = real(0.0)
        count = int(0)
        kinds = listed.shape[1] - 1 - topology.pairs.shape[0]
        for index in range(listed[env, 0], listed[env, kinds]):
            pair = listed[env, index]
            body = topology.pair_body[pair]
            hit = real(0.0)
            if again:
                for side in range(2):
                    if body[side] >= 0:
                        hit += bodies.hit[env, body[side]]
            for slot in range(topology.pair_slots[pair], topology.pair_slots[pair + 1]):
                phi = slots.gap[env, slot]
                selected = bool(False)
                if phi < real(NO_POINT):
                    u, u_free = velocities(topology, bodies, env, pair, slots.point[env, slot])
                    # Twice the speed counts, not its approaching part: an impact elsewhere on the body turns one into the
                    # other (1.1 mm of overlap at 1 ms with the approaching part alone, 3 um with this).
                    ahead = phi - fall - real(2.0) * h * hit
                    if ahead < real(0.0) or ahead * ahead < real(4.0) * h * h * wp.length_sq(u_free):
                        if count < contacts.room:
                            contacts.slot[env, count] = slot
                            contacts.velocity[env, count] = u
                            contacts.free[env, count] = u_free
                            count += 1
                            selected = True
                        else:
                            status[env] = status[env] | OVERFLOW  # for good: the second time there are no fewer
                    if meet and not again:
                        # Of present velocities: what gravity or a wrench presses together does not hit.
                        closing = -h * wp.dot(slots.normal[env, slot], u)
                        left = phi + wp.max(slots.bend[env, slot], real(0.0))
                        if closing > real(0.1) * fall and real(2.0) * closing + fall > left:
                            alert = wp.max(alert, closing / h)
                            if closing + fall > left:
                                for side in range(2):
                                    if body[side] >= 0:
                                        speed = share(bodies, env, body, side) * closing / h
                                        bodies.hit[env, body[side]] = wp.max(bodies.hit[env, body[side]], speed)
                if not selected:
                    slots.last_feature[env, slot] = -1
        if meet and not again:
            bodies.alert[env] = alert
        return count

    @wp.func
    def hand_on(topology: Topology, bodies: Bodies, listed: wp.array2d(dtype=int), slots: Slots, env: int, h: real) -> bool:
        """What a hit body may hit in turn within the step, up and down the pairs until nothing changes. Is there a hit at all?"""
        news = bool(False)
        for b in range(bodies.hit.shape[1]):
            if bodies.hit[env, b] > real(0.0):
                news = True
        any_hit = news
        down = bool(False)
        first = listed[env, 0]
        last = listed[env, listed.shape[1] - 1 - topology.pairs.shape[0]] - 1
        while news:
            news = bool(False)
            for k in range(first, last + 1):
                pair = listed[env, k]
                if down:
                    pair = listed[env, first + last - k]
                body = topology.pair_body[pair]
                if body[0] >= 0 and body[1] >= 0:
                    fastest = wp.max(bodies.hit[env, body[0]], bodies.hit[env, body[1]])
                    closes = bool(False)
                    if fastest > real(0.0):
                        for slot in range(topology.pair_slots[pair], topology.pair_slots[pair + 1]):
                            closes = closes or slots.gap[env, slot] < h * fastest
                    if closes:
                        for side in range(2):
                            speed = share(bodies, env, body, side) * bodies.hit[env, body[1 - side]]
                            if speed > real(1.01) * bodies.hit[env, body[side]]:
                                bodies.hit[env, body[side]] = speed
                                news = bool(True)
            down = not down
        return any_hit

    @kernel()
    def select_contacts(
        topology: Topology,
        parameters: Parameters,
        bodies: Bodies,
        listed: wp.array2d(dtype=int),
        slots: Slots,
        h: real,
        contacts: Contacts,
        status: wp.array(dtype=int),
        stride: int,
    ):
        """The slots whose gap could close within the step, in order, and the relative velocities there; others have no history.

        Where something hits a body that may touch another one they are selected once more: what a body does that is hit no
        velocity before the step tells, so the gaps of both bodies may close by the speed of the hit as well (of two that fall
        side by side a capsule entered a box by 7 mm at 2 ms), and so may those of a body that is pushed by it in turn.
        """
        start, _ = wp.tid()
        for env in range(start, contacts.count.shape[0], stride):
            fall = h * h * wp.length(parameters.gravity[env % parameters.gravity.shape[0]]) + real(1.0e-9)
            count = select(topology, bodies, listed, slots, env, h, fall, False, contacts, status)
            if hand_on(topology, bodies, listed, slots, env, h):
                count = select(topology, bodies, listed, slots, env, h, fall, True, contacts, status)
            contacts.count[env] = count

    return SimpleNamespace(combine_pairs=combine_pairs, select_contacts=select_contacts)


@factory
def make(real, trees: bool = False) -> SimpleNamespace:
    """Kernels ``contact_rows`` and with trees, for scenes with joints, ``calm_overlaps``; launch with dim (E, lanes)."""
    t = scalar_types(real)
    vec3 = t.vec3
    Bodies, Contacts, Parameters, Slots, Topology = t.Bodies, t.Contacts, t.Parameters, t.Slots, t.Topology
    f = row_functions(real)
    mobility, expected, read_row, write_row = f.mobility, f.expected, f.read_row, f.write_row
    forest = tree.functions(real)
    halve, product = forest.halve, forest.product
    Mechanics = forest.Trees if trees else Bodies

    @kernel()
    def contact_rows(
        topology: Topology,
        parameters: Parameters,
        mechanics: Mechanics,
        slots: Slots,
        h: real,
        sliding: int,
        directions: int,
        frozen: int,
        contacts: Contacts,
        lanes: int,
        stride: int,
    ):
        """Rows of the selected contacts; free holds world axes before, the contact frame after."""
        start, lane = wp.tid()
        for env in range(start, contacts.count.shape[0], stride):
            for i in range(lane, contacts.count[env], lanes):
                slot = contacts.slot[env, i]
                u = contacts.velocity[env, i]
                u_free = contacts.free[env, i]
                body = topology.pair_body[topology.slot_pair[slot]]
                point = slots.point[env, slot]
                n = slots.normal[env, slot]
                if wp.static(trees):
                    contacts.body[env, i] = body
                    for side in range(2):
                        if body[side] >= 0:
                            halve(mechanics, env, 2 * i + side, body[side], point)
                    w = product(mechanics.shared, mechanics.half, contacts.body, mechanics.longest, env, i, i)
                    row = read_row(topology, parameters, slots, env, slot, wp.dot(n, w * n), u, u_free, h, sliding, directions, frozen)
                    row.inv_mass = wp.get_diag(row.frame * w * wp.transpose(row.frame))
                    touched = slots.last_feature[env, slot] == slots.feature[env, slot]
                    carried = h * (row.frame * slots.last_bristle[env, slot])
                    row.state = expected(row, touched, wp.dot(n, u), slots.last_impulse[env, slot], carried)
                    write_row(contacts, env, i, body, point, slots.gap[env, slot], row)
                else:
                    w_nn = mobility(mechanics, env, body, point, n)
                    row = read_row(topology, parameters, slots, env, slot, w_nn, u, u_free, h, sliding, directions, frozen)
                    w_1 = mobility(mechanics, env, body, point, row.frame[1])
                    row.inv_mass = vec3(w_nn, w_1, mobility(mechanics, env, body, point, row.frame[2]))
                    write_row(contacts, env, i, body, point, slots.gap[env, slot], row)

    @wp.func
    def opposed(mechanics: Mechanics, contacts: Contacts, env: int, i: int) -> bool:
        """Would what parts contact i press another overlap together?"""
        axis = vec3(real(1.0), real(0.0), real(0.0))
        n_i = wp.transpose(contacts.frame[env, i]) * axis
        found = bool(False)
        for k in range(contacts.count[env]):
            n_k = wp.transpose(contacts.frame[env, k]) * axis
            if contacts.gap[env, k] < real(0.0) and wp.dot(n_i, n_k) < real(0.0):
                w = wp.dot(n_i, product(mechanics.shared, mechanics.half, contacts.body, mechanics.longest, env, i, k) * n_k)
                found = found or w < real(OPPOSED) * wp.sqrt(contacts.inv_mass[env, i][0] * contacts.inv_mass[env, k][0])
        return found

    @kernel()
    def calm_overlaps(mechanics: Mechanics, contacts: Contacts, lanes: int, stride: int):
        """Overlaps that are pushed against each other part slowly.

        Legs that stand in each other push to both sides at once. Each push by itself is slow, but all together are met only by turning
        about what lies between them: feet 46 mm deep left with 50 m/s at 2 ms, with 400 m/s a few steps later.
        """
        start, lane = wp.tid()
        for env in range(start, contacts.count.shape[0], stride):
            for i in range(lane, contacts.count[env], lanes):
                shift = contacts.shift[env, i]
                if shift[0] < -real(MAX_OPPOSED_SPEED) and opposed(mechanics, contacts, env, i):
                    free = contacts.free[env, i]
                    free[0] -= shift[0] + real(MAX_OPPOSED_SPEED)
                    shift[0] = -real(MAX_OPPOSED_SPEED)
                    contacts.free[env, i] = free
                    contacts.shift[env, i] = shift

    kernels = SimpleNamespace(contact_rows=contact_rows)
    if trees:
        kernels.calm_overlaps = calm_overlaps
    return kernels
