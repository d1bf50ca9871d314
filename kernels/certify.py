# SPDX-License-Identifier: Apache-2.0
"""What the impulses do, and how well they obey the law that was solved: v+, residual, history, status.

Nothing here trusts a solver. From the impulses p = h lambda alone: v+ = v_free + M^-1 J^T p (eq. 24), the relaxed
contact velocity u~ = J v+ + epsilon p + d (eq. 39), and per contact, with effective masses m = 1 / (W + epsilon),

    normal      r_n = min(u~_n, p_n / m_n)                           [m/s]
    tangential  r_t = (p_t - P(p_t - m u~_t)) / m                    [m/s]

where P projects on the admissible friction impulses of the law that was solved (kernels/friction.py); for facets this is the
complementarity of eqs. 36-38 with w_up, w_lo eliminated, and phantom inertia does not appear because w_up w_lo = 0. The
residual is the largest of them; sum m r^2 / 2 is the unit-consistent energy error E_uc [J].
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import friction, rigid, tree
from .declare import factory, kernel
from .types import HELD, NOT_A_NUMBER, OPEN, SLIDE, STICK, UNCERTIFIED, scalar_types

# Residual of an answer that is not a number.
HUGE = wp.constant(1.0e30)


@functools.cache
def functions(real, joints: bool = False) -> SimpleNamespace:
    """``judge`` and ``remember`` of one contact."""
    t = scalar_types(real)
    vec2, vec3, mat33, Slots = t.vec2, t.vec3, t.mat33, t.Slots
    law = friction.functions(real, joints)
    project_friction, weigh, law_error = law.project_friction, law.weigh, law.law_error

    @wp.func
    def contact_state(p: vec3, mu: vec2, bound: vec2, k: int) -> int:
        """Open, stick or slide: it slides where a slightly larger friction impulse would not be admissible, or none ever is."""
        state = OPEN
        if p[0] > real(0.0):
            state = STICK
            pressed = vec2(p[1], p[2]) * (real(1.0) + real(1.0e-6))  # not real(1.0 + ...): literals add up in single precision
            inside = project_friction(pressed, mu * p[0] + bound, k) - pressed
            if k == 0 or wp.dot(inside, inside) > real(0.0):
                state = SLIDE
        if wp.static(joints):  # noqa: SIM102
            if k == HELD:
                state = STICK
        return state

    @wp.func
    def judge(u: vec3, p: vec3, eps: vec3, w: vec3, shift: vec3, mu: vec2, bound: vec2, k: int):
        """Violation of the law [m/s], its energy [J], u+ and state of a contact; u = J v+ + d, w of J M^-1 J^T."""
        relaxed = u + wp.cw_mul(eps, p)
        weight = weigh(w + eps, k)
        error = law_error(relaxed, p, weight, mu, bound, k)
        energy = real(0.5) * wp.dot(wp.cw_div(error, weight), error)
        return error, energy, u - shift, contact_state(p, mu, bound, k)

    @wp.func
    def remember(slots: Slots, env: int, slot: int, closed: int, rate: real, frame: mat33, p: vec3, u: vec3, b_t: real):
        """History for the next step: the feature that touched, its normal impulse and bristle force (eq. 42); rate = 1 / h.

        An unloaded contact is remembered as such; one that never closed will be new when it does.
        """
        slots.last_feature[env, slot] = -1
        if closed != 0 or p[0] > real(0.0):
            bristle = vec3(real(0.0), p[1] * rate + b_t * u[1], p[2] * rate + b_t * u[2])
            slots.last_feature[env, slot] = slots.feature[env, slot]
            slots.last_impulse[env, slot] = p[0]
            slots.last_bristle[env, slot] = wp.transpose(frame) * bristle

    return SimpleNamespace(judge=judge, remember=remember)


@factory
def make(real, trees: bool = False):
    """Kernel ``certify``; launch with dim (E). trees: for scenes with joints."""
    t = scalar_types(real)
    vec3, spatial = t.vec3, t.spatial
    Bodies, Contacts, Slots = t.Bodies, t.Contacts, t.Slots
    law = friction.functions(real, trees)
    weigh, law_error = law.weigh, law.law_error
    f = functions(real, trees)
    judge, remember = f.judge, f.remember
    body = rigid.functions(real)
    point_velocity, wrench, response = body.point_velocity, body.wrench, body.response
    forest = tree.functions(real)
    respond, push_joint, joint_velocity = forest.respond, forest.push_joint, forest.joint_velocity
    Mechanics = forest.Trees if trees else Bodies

    @kernel()
    def certify(
        bodies: Mechanics,
        h: real,
        tolerance: real,
        attempt: int,
        final: int,
        next_velocity: wp.array2d(dtype=spatial),
        contacts: Contacts,
        slots: Slots,
        todo: wp.array(dtype=int),
        number: wp.array(dtype=int),
        left: wp.array(dtype=int),
        number_left: wp.array(dtype=int),
        unsolved: wp.array(dtype=int),
        reason: wp.array(dtype=int),
        best_residual: wp.array(dtype=real),
        residual: wp.array(dtype=real),
        residual_energy: wp.array(dtype=real),
        status: wp.array(dtype=int),
        stride: int,
    ):
        """The answers of the environments todo[:number]; those that the next method is to solve go to `left`."""
        start, _ = wp.tid()
        rate = real(1.0) / h
        for index in range(start, number[0], stride):
            env = todo[index]
            r = contacts.count[env]
            worst = real(0.0)
            energy = real(0.0)
            finite = bool(True)
            judging = bool(True)
            restored = bool(False)
            while judging:
                judging = False
                # The wrench of all impulses on each body, then what it changes: next_velocity holds v+ - v_free until the end.
                for b in range(next_velocity.shape[1]):
                    next_velocity[env, b] = spatial()
                if wp.static(trees):
                    for i in range(bodies.change.shape[1]):
                        bodies.change[env, i] = real(0.0)
                for i in range(r):
                    impulse = wp.transpose(contacts.frame[env, i]) * contacts.impulse[env, i]
                    sides = int(2)
                    if wp.static(trees):  # noqa: SIM102
                        if contacts.slot[env, i] < 0:
                            sides = 0
                            push_joint(bodies, next_velocity, env, -1 - contacts.slot[env, i], contacts.point[env, i], impulse)
                    if sides > 0:
                        for side in range(2):
                            b = contacts.body[env, i][side]
                            if b >= 0:
                                arm = contacts.point[env, i] - bodies.com[env, b]
                                next_velocity[env, b] += real(2 * side - 1) * wrench(arm, impulse)
                if wp.static(trees):
                    respond(bodies, next_velocity, env)
                else:
                    for b in range(next_velocity.shape[1]):
                        next_velocity[env, b] = response(bodies.inv_mass[env, b], bodies.inv_inertia[env, b], next_velocity[env, b])

                worst = real(0.0)
                energy = real(0.0)
                finite = bool(True)
                for i in range(r):
                    p = contacts.impulse[env, i]
                    du = vec3()
                    sides = int(2)
                    if wp.static(trees):  # noqa: SIM102
                        if contacts.slot[env, i] < 0:
                            sides = 0
                            du = joint_velocity(bodies, next_velocity, env, -1 - contacts.slot[env, i], contacts.point[env, i])
                    if sides > 0:
                        for side in range(2):
                            b = contacts.body[env, i][side]
                            if b >= 0:
                                arm = contacts.point[env, i] - bodies.com[env, b]
                                du += real(2 * side - 1) * point_velocity(next_velocity[env, b], arm)
                    u = contacts.free[env, i] + contacts.frame[env, i] * du
                    error, part, ended, state = judge(
                        u,
                        p,
                        contacts.relaxation[env, i],
                        contacts.inv_mass[env, i],
                        contacts.shift[env, i],
                        contacts.mu[env, i],
                        contacts.bound[env, i],
                        contacts.directions[env, i],
                    )
                    worst = wp.max(worst, wp.max(wp.abs(error)))
                    # A maximum passes over what is not a number, and so does an impulse that is bounded: u is all that tells of a target.
                    finite = finite and wp.isfinite(error) and wp.isfinite(u)
                    energy += part
                    contacts.velocity[env, i] = ended
                    contacts.state[env, i] = state
                for b in range(next_velocity.shape[1]):
                    next_velocity[env, b] = bodies.free_velocity[env, b] + next_velocity[env, b]
                    finite = finite and wp.isfinite(next_velocity[env, b]) and wp.isfinite(bodies.com[env, b])
                if not finite:
                    worst = real(HUGE)

                # Of several uncertified answers the best one is applied; the first of them is no impulse at all.
                if not worst <= tolerance and not restored:
                    if attempt == 0:
                        best_residual[env] = real(0.0)
                        for i in range(r):
                            k = contacts.directions[env, i]
                            w = weigh(contacts.inv_mass[env, i] + contacts.relaxation[env, i], k)
                            free = law_error(contacts.free[env, i], vec3(), w, contacts.mu[env, i], contacts.bound[env, i], k)
                            best_residual[env] = wp.max(best_residual[env], wp.max(wp.abs(free)))
                            contacts.best_impulse[env, i] = vec3()
                    if worst < best_residual[env]:
                        best_residual[env] = worst
                        for i in range(r):
                            contacts.best_impulse[env, i] = contacts.impulse[env, i]
                    if final != 0 and worst > best_residual[env] and r > 0:
                        for i in range(r):
                            contacts.impulse[env, i] = contacts.best_impulse[env, i]
                        judging = True
                        restored = True

            residual[env] = worst
            residual_energy[env] = energy
            solved = worst <= tolerance
            unsolved[env] = 1
            if solved:
                unsolved[env] = 0
            elif final == 0:
                left[wp.atomic_add(number_left, 0, 1)] = env  # in any order: environments know nothing of each other
            else:
                if finite:
                    status[env] = status[env] | reason[env] | UNCERTIFIED
                else:
                    status[env] = status[env] | NOT_A_NUMBER

            if solved or final != 0:
                for i in range(r):
                    if wp.static(trees):  # noqa: SIM102
                        if contacts.slot[env, i] < 0:
                            continue
                    remember(
                        slots,
                        env,
                        contacts.slot[env, i],
                        contacts.closed[env, i],
                        rate,
                        contacts.frame[env, i],
                        contacts.impulse[env, i],
                        contacts.velocity[env, i],
                        contacts.damping[env, i],
                    )

    return certify
