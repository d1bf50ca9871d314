# SPDX-License-Identifier: Apache-2.0
"""The friction laws: which friction impulses a normal impulse admits, and the map whose fixed points obey a law.

All laws are one law with different admissible sets. Slip is a normal of the set at p_t (maximal dissipation), hence

    p = pi(p - rho u),    pi(x) = ( max(x_n, 0),  nearest point to x_t in mu max(x_n, 0) S )       for any rho > 0.

    directions   S
        0        {0}: no friction
        1        the unit disc: Coulomb's cone
        k >= 2   {|e_j . s| <= 1}, e_j at angles j pi / k from t1: facets around the disc (eqs. 18, 19; 29, 30 without w);
                 k = 2 has a limit of its own for each axis (eq. 34)
       -k <= -2  the convex hull of +-e_j: facets within the disc (Anitescu and Potra, the paper's ref. 6)
       -1        no contact: rows of a joint that closes a loop, any impulse on all three

`bound` is a limit that does not depend on the present normal impulse: the box and hybrid laws (refs. 7, 12), with mu = 0.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .types import DISC, HELD, scalar_types


@functools.cache
def functions(real, joints: bool = False, facets: bool = True) -> SimpleNamespace:
    """``project_friction``, ``admissible`` (pi), ``slope`` (its generalised derivative), ``weigh`` and ``law_error``.

    joints: there may be rows of joints that close loops (HELD) among the contacts; facets: and sets other than {0}, disc and rectangle.
    """
    t = scalar_types(real)
    vec2, vec3, mat33 = t.vec2, t.vec3, t.mat33

    @wp.func
    def facet(x: vec2, k: int):
        """The facet of S that x points at: its outward normal, its distance from the origin, half its length."""
        step = real(wp.pi) / real(wp.abs(k))
        turn = real(0.0)
        distance = real(1.0)
        if k < 0:
            turn = real(0.5)
            distance = wp.cos(real(0.5) * step)
        angle = step * (wp.round(wp.atan2(x[1], x[0]) / step - turn) + turn)
        return vec2(wp.cos(angle), wp.sin(angle)), distance, distance * wp.tan(real(0.5) * step)

    @wp.func
    def project_friction(x: vec2, limit: vec2, k: int) -> vec2:
        """Nearest point to x in limit S; only k = 2 looks at limit[1]."""
        result = vec2()
        if k == 2:
            result = vec2(wp.clamp(x[0], -limit[0], limit[0]), wp.clamp(x[1], -limit[1], limit[1]))
        elif k == DISC:
            result = x
            size = wp.length(x)
            if size > limit[0]:
                result = x * (limit[0] / size)
        elif wp.static(facets):  # noqa: SIM102
            if k != 0:
                result = x
                e, distance, half = facet(x, k)
                if wp.dot(x, e) > distance * limit[0]:
                    across = vec2(-e[1], e[0])
                    result = limit[0] * distance * e + wp.clamp(wp.dot(x, across), -half * limit[0], half * limit[0]) * across
        return result

    @wp.func
    def admissible(x: vec3, mu: vec2, bound: vec2, k: int) -> vec3:
        """pi(x)."""
        normal = wp.max(x[0], real(0.0))
        p_t = project_friction(vec2(x[1], x[2]), mu * normal + bound, k)
        result = vec3(normal, p_t[0], p_t[1])
        if wp.static(joints):  # noqa: SIM102
            if k == HELD:
                result = x
        return result

    @wp.func
    def slope(x: vec3, mu: vec2, bound: vec2, k: int) -> mat33:
        """An element of the generalised derivative of pi at x."""
        d = mat33()
        normal = real(0.0)
        grows = real(0.0)  # does the normal impulse follow x_n?
        if x[0] > real(0.0):
            normal = x[0]
            grows = real(1.0)
        d[0, 0] = grows
        limit = mu * normal + bound
        if k == 2:
            for axis in range(2):
                if wp.abs(x[1 + axis]) <= limit[axis]:
                    if limit[axis] > real(0.0):
                        d[1 + axis, 1 + axis] = real(1.0)
                else:
                    d[1 + axis, 0] = grows * mu[axis] * wp.sign(x[1 + axis])
        elif k == DISC:
            y = vec2(x[1], x[2])
            size = wp.length(y)
            if size > limit[0]:
                y = y / size
                f = limit[0] / size
                d[1, 0] = grows * mu[0] * y[0]
                d[2, 0] = grows * mu[0] * y[1]
                d[1, 1] = f * y[1] * y[1]
                d[1, 2] = -f * y[0] * y[1]
                d[2, 1] = d[1, 2]
                d[2, 2] = f * y[0] * y[0]
            elif limit[0] > real(0.0):
                d[1, 1] = real(1.0)
                d[2, 2] = real(1.0)
        elif wp.static(facets):  # noqa: SIM102
            if k != 0:
                y = vec2(x[1], x[2])
                e, distance, half = facet(y, k)
                across = vec2(-e[1], e[0])
                if wp.dot(y, e) <= distance * limit[0]:
                    if limit[0] > real(0.0):
                        d[1, 1] = real(1.0)
                        d[2, 2] = real(1.0)
                else:
                    corner = distance * e
                    along = wp.dot(y, across)
                    if wp.abs(along) <= half * limit[0]:
                        d[1, 1] = across[0] * across[0]
                        d[1, 2] = across[0] * across[1]
                        d[2, 1] = d[1, 2]
                        d[2, 2] = across[1] * across[1]
                    else:
                        corner += wp.sign(along) * half * across
                    d[1, 0] = grows * mu[0] * corner[0]
                    d[2, 0] = grows * mu[0] * corner[1]
        if wp.static(joints):  # noqa: SIM102
            if k == HELD:
                d = wp.identity(n=3, dtype=real)
        return d

    @wp.func
    def weigh(w: vec3, k: int) -> vec3:
        """1 / rho of a contact from the diagonal of its block of W; only the rectangle may have two masses for its tangents."""
        result = w
        tied = k != 2
        if wp.static(joints):
            tied = tied and k != HELD
        if tied:
            result[1] = real(0.5) * (w[1] + w[2])
            result[2] = result[1]
        for i in range(3):
            if not result[i] > real(0.0):
                result[i] = real(1.0)  # a direction in which nothing moves
        return result

    @wp.func
    def law_error(u: vec3, p: vec3, w: vec3, mu: vec2, bound: vec2, k: int) -> vec3:
        """Violation of the law by one contact [m/s] along n, t1, t2; w = 1 / rho from `weigh`.

        Normal min(u_n, p_n w_n), tangential (p_t - P(p_t - rho_t u_t)) w_t, both relaxed where u is.
        """
        y = vec2(p[1] * w[1], p[2] * w[2])
        limit = mu * wp.max(p[0], real(0.0)) + bound
        target = project_friction(y - vec2(u[1], u[2]), vec2(limit[0] * w[1], limit[1] * w[2]), k)
        result = vec3(wp.min(u[0], p[0] * w[0]), y[0] - target[0], y[1] - target[1])
        if wp.static(joints):  # noqa: SIM102
            if k == HELD:
                result = u
        return result

    return SimpleNamespace(project_friction=project_friction, admissible=admissible, slope=slope, weigh=weigh, law_error=law_error)
