# SPDX-License-Identifier: Apache-2.0
"""What the impulses do, and how well they obey the law that was solved: v+, residual, history, status.

Nothing here trusts a solver. From the impulses p = h lambda alone: v+ = v_free + M^-1 J^T p (eq. 24), the relaxed
contact velocity u~ = J v+ + epsilon p + d (eq. 39), and per contact, with effective masses m = 1 / (W + epsilon),

    normal      r_n = min(u~_n, p_n / m_n)                           [m/s]
    tangential  r_t = (p_t - P(p_t - m u~_t)) / m                    [m/s]

where P projects on the admissible friction impulses {|e_j . p_t| <= mu_j p_n}: this is the complementarity of eqs.
36-38 with w_up, w_lo eliminated, and phantom inertia does not appear because w_up w_lo = 0. The residual is the largest
of them; sum m r^2 / 2 is the unit-consistent energy error E_uc [J].
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import rigid
from .types import NOT_A_NUMBER, OPEN, SLIDE, STICK, UNCERTIFIED, scalar_types

# Residual of an answer that is not a number.
HUGE = wp.constant(1.0e30)


@functools.cache
def law(real) -> SimpleNamespace:
    """The discretised friction law as a projection, for the certificate and for iterative methods."""
    t = scalar_types(real)
    vec2 = t.vec2

    @wp.func
    def project_polygon(x: vec2, apothem: real, k: int) -> vec2:
        """Nearest point of the regular polygon {|e_j . p| <= apothem}, e_j at angles j pi / k."""
        step = real(wp.pi) / real(k)
        angle = step * wp.round(wp.atan2(x[1], x[0]) / step)
        e = vec2(wp.cos(angle), wp.sin(angle))
        across = vec2(-e[1], e[0])
        half_side = apothem * wp.tan(real(0.5) * step)
        result = x
        if wp.dot(x, e) > apothem:
            result = apothem * e + wp.clamp(wp.dot(x, across), -half_side, half_side) * across
        return result

    @wp.func
    def project_friction(x: vec2, normal: real, mu: vec2, k: int) -> vec2:
        """Nearest admissible tangential impulse for the normal impulse."""
        p_n = wp.max(normal, real(0.0))
        result = vec2()
        if k == 2:
            result = vec2(wp.clamp(x[0], -mu[0] * p_n, mu[0] * p_n), wp.clamp(x[1], -mu[1] * p_n, mu[1] * p_n))
        elif k > 2:
            result = project_polygon(x, mu[0] * p_n, k)
        return result

    return SimpleNamespace(project_friction=project_friction)


@functools.cache
def make(real):
    """Kernel ``certify``; launch with dim (E)."""
    t = scalar_types(real)
    vec2, vec3, spatial = t.vec2, t.vec3, t.spatial
    Bodies, Contacts, Slots = t.Bodies, t.Contacts, t.Slots
    project_friction = law(real).project_friction
    body = rigid.functions(real)
    point_velocity, impulse_response = body.point_velocity, body.impulse_response

    @wp.func
    def law_error(relaxed: vec3, p: vec3, w: vec3, mu: vec2, k: int):
        """Violation of the law by one contact [m/s] along n, t1, t2, and the inverse masses w = 1 / m that weigh it."""
        if k > 2:  # the projection on a polygon needs one mass for both axes
            w[1] = real(0.5) * (w[1] + w[2])
            w[2] = w[1]
        p_t = vec2(p[1], p[2])
        target = project_friction(p_t - vec2(relaxed[1] / w[1], relaxed[2] / w[2]), p[0], mu, k)
        error = vec3(wp.min(relaxed[0], p[0] * w[0]), (p_t[0] - target[0]) * w[1], (p_t[1] - target[1]) * w[2])
        return error, w

    @wp.func
    def contact_state(p: vec3, mu: vec2, k: int) -> int:
        """Open, stick or slide: it slides where a slightly larger friction impulse would not be admissible."""
        state = OPEN
        if p[0] > real(0.0):
            state = STICK
            pressed = vec2(p[1], p[2]) * (real(1.0) + real(1.0e-6))  # not real(1.0 + ...): literals add up in single precision
            inside = project_friction(pressed, p[0], mu, k) - pressed
            if k > 0 and wp.dot(inside, inside) > real(0.0):
                state = SLIDE
        return state

    @wp.kernel(module="unique", enable_backward=False)
    def certify(
        bodies: Bodies,
        h: real,
        tolerance: real,
        attempt: int,
        final: int,
        next_velocity: wp.array2d(dtype=spatial),
        contacts: Contacts,
        slots: Slots,
        unsolved: wp.array(dtype=int),
        reason: wp.array(dtype=int),
        best_residual: wp.array(dtype=real),
        residual: wp.array(dtype=real),
        residual_energy: wp.array(dtype=real),
        status: wp.array(dtype=int),
        stride: int,
    ):
        start, _ = wp.tid()
        for env in range(start, contacts.count.shape[0], stride):
            if unsolved[env] == 0:
                continue
            r = contacts.count[env]
            worst = real(0.0)
            energy = real(0.0)
            finite = bool(True)
            judging = bool(True)
            restored = bool(False)
            while judging:
                judging = False
                for b in range(next_velocity.shape[1]):
                    next_velocity[env, b] = bodies.free_velocity[env, b]
                for i in range(r):
                    impulse = wp.transpose(contacts.frame[env, i]) * contacts.impulse[env, i]
                    for side in range(2):
                        b = contacts.body[env, i][side]
                        if b >= 0:
                            arm = contacts.point[env, i] - bodies.com[env, b]
                            sign = real(2 * side - 1)
                            next_velocity[env, b] += impulse_response(
                                bodies.inv_mass[env, b], bodies.inv_inertia[env, b], arm, sign * impulse
                            )

                worst = real(0.0)
                energy = real(0.0)
                finite = bool(True)
                for b in range(next_velocity.shape[1]):
                    finite = finite and wp.isfinite(next_velocity[env, b]) and wp.isfinite(bodies.com[env, b])
                for i in range(r):
                    p = contacts.impulse[env, i]
                    eps = contacts.relaxation[env, i]
                    du = vec3()
                    for side in range(2):
                        b = contacts.body[env, i][side]
                        if b >= 0:
                            arm = contacts.point[env, i] - bodies.com[env, b]
                            du += real(2 * side - 1) * point_velocity(next_velocity[env, b] - bodies.free_velocity[env, b], arm)
                    relaxed = contacts.free[env, i] + contacts.frame[env, i] * du + wp.cw_mul(eps, p)
                    k = contacts.directions[env, i]
                    mu = contacts.mu[env, i]
                    error, w = law_error(relaxed, p, contacts.inv_mass[env, i] + eps, mu, k)
                    worst = wp.max(worst, wp.max(wp.abs(error)))
                    energy += real(0.5) * wp.dot(wp.cw_div(error, w), error)
                    contacts.velocity[env, i] = relaxed - wp.cw_mul(eps, p) - contacts.shift[env, i]
                    contacts.state[env, i] = contact_state(p, mu, k)
                if not finite:
                    worst = real(HUGE)

                # Of several uncertified answers the best one is applied; the first of them is no impulse at all.
                if worst > tolerance and not restored:
                    if attempt == 0:
                        best_residual[env] = real(0.0)
                        for i in range(r):
                            free, w = law_error(
                                contacts.free[env, i],
                                vec3(),
                                contacts.inv_mass[env, i] + contacts.relaxation[env, i],
                                contacts.mu[env, i],
                                contacts.directions[env, i],
                            )
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
            if solved:
                unsolved[env] = 0
            elif final != 0:
                if finite:
                    status[env] = status[env] | reason[env] | UNCERTIFIED
                else:
                    status[env] = status[env] | NOT_A_NUMBER

            if solved or final != 0:
                # History for the next step: which features touched, with what normal impulse and bristle force (eq. 42).
                for slot in range(slots.last_feature.shape[1]):
                    slots.last_feature[env, slot] = -1
                for i in range(r):
                    p = contacts.impulse[env, i]
                    # An unloaded contact is remembered as such; one that never closed will be new when it does.
                    if p[0] > real(0.0) or contacts.closed[env, i] != 0:
                        slot = contacts.slot[env, i]
                        u = contacts.velocity[env, i]
                        b_t = contacts.damping[env, i]
                        bristle = vec3(real(0.0), p[1] / h + b_t * u[1], p[2] / h + b_t * u[2])
                        slots.last_feature[env, slot] = slots.feature[env, slot]
                        slots.last_impulse[env, slot] = p[0]
                        slots.last_bristle[env, slot] = wp.transpose(contacts.frame[env, i]) * bristle

    return certify
