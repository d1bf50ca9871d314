# SPDX-License-Identifier: Apache-2.0
"""Block projected Gauss-Seidel on contact blocks (p_n, p_t), in velocities: neither W nor the LCP is formed.

Sweep after sweep each contact corrects its own impulse for the present v, normal first, then the friction projected on
what the new normal impulse admits, and v takes the change at once. Cold started: a warm start makes the answer depend
on history where contacts are redundant.
"""

import warp as wp

from . import friction, rigid, tree
from .declare import factory, kernel
from .types import HELD, ITERATION_LIMIT, scalar_types


@factory
def make(real, trees: bool = False):
    """Kernel ``pgs``; launch with dim (E). trees: for scenes with joints, whose v are those of Trees.half."""
    t = scalar_types(real)
    vec2, vec3, spatial = t.vec2, t.vec3, t.spatial
    Bodies, Contacts = t.Bodies, t.Contacts
    law = friction.functions(real, trees)
    project_friction, weigh = law.project_friction, law.weigh
    f = rigid.functions(real)
    point_velocity, wrench, response = f.point_velocity, f.wrench, f.response
    forest = tree.functions(real)
    gather, scatter, Mechanics = forest.gather, forest.scatter, forest.Trees if trees else Bodies

    @wp.func
    def relative(
        velocity: wp.array2d(dtype=spatial),
        free: wp.array2d(dtype=spatial),
        com: wp.array2d(dtype=vec3),
        env: int,
        body: wp.vec2i,
        point: vec3,
    ) -> vec3:
        """J (v - v_free) at a contact, world axes."""
        u = vec3()
        for side in range(2):
            b = body[side]
            if b >= 0:
                u += real(2 * side - 1) * point_velocity(velocity[env, b] - free[env, b], point - com[env, b])
        return u

    @kernel()
    def pgs(
        bodies: Mechanics,
        contacts: Contacts,
        todo: wp.array(dtype=int),
        number: wp.array(dtype=int),
        sweeps: int,
        tolerance: real,
        velocity: wp.array2d(dtype=spatial),
        iterations: wp.array(dtype=int),
        reason: wp.array(dtype=int),
        stride: int,
    ):
        start, _ = wp.tid()
        for index in range(start, number[0], stride):
            env = todo[index]
            r = contacts.count[env]
            if wp.static(trees):
                for k in range(bodies.change.shape[1]):
                    bodies.change[env, k] = real(0.0)
            else:
                for b in range(velocity.shape[1]):
                    velocity[env, b] = bodies.free_velocity[env, b]
            for i in range(r):
                contacts.impulse[env, i] = vec3()
            change = real(0.0)
            sweep = int(0)
            searching = r > 0
            while searching:
                change = real(0.0)
                for i in range(r):
                    body = contacts.body[env, i]
                    point = contacts.point[env, i]
                    frame = contacts.frame[env, i]
                    eps = contacts.relaxation[env, i]
                    k = contacts.directions[env, i]
                    diagonal = weigh(contacts.inv_mass[env, i] + eps, k)
                    free = contacts.free[env, i]
                    p = contacts.impulse[env, i]
                    old = p

                    u = vec3()
                    if wp.static(trees):
                        u = gather(bodies, bodies.change, env, i, body)
                    else:
                        u = relative(velocity, bodies.free_velocity, bodies.com, env, body, point)
                    relaxed = free + frame * u + wp.cw_mul(eps, p)
                    held = bool(False)
                    if wp.static(trees):
                        held = k == HELD
                    p[0] = p[0] - relaxed[0] / diagonal[0]
                    if not held:
                        p[0] = wp.max(p[0], real(0.0))
                    push = frame[0] * (p[0] - old[0])
                    if wp.static(trees):
                        scatter(bodies, bodies.change, env, i, body, push)
                    else:
                        for side in range(2):
                            b = body[side]
                            if b >= 0:
                                arm = point - bodies.com[env, b]
                                sign = real(2 * side - 1)
                                velocity[env, b] += response(bodies.inv_mass[env, b], bodies.inv_inertia[env, b], wrench(arm, sign * push))
                    if k != 0:
                        if wp.static(trees):
                            u = gather(bodies, bodies.change, env, i, body)
                        else:
                            u = relative(velocity, bodies.free_velocity, bodies.com, env, body, point)
                        relaxed = free + frame * u + wp.cw_mul(eps, p)
                        x = vec2(p[1] - relaxed[1] / diagonal[1], p[2] - relaxed[2] / diagonal[2])
                        if not held:
                            x = project_friction(x, contacts.mu[env, i] * p[0] + contacts.bound[env, i], k)
                        p = vec3(p[0], x[0], x[1])
                        push = frame[1] * (p[1] - old[1]) + frame[2] * (p[2] - old[2])
                        if wp.static(trees):
                            scatter(bodies, bodies.change, env, i, body, push)
                        else:
                            for side in range(2):
                                b = body[side]
                                if b >= 0:
                                    arm = point - bodies.com[env, b]
                                    sign = real(2 * side - 1)
                                    velocity[env, b] += response(
                                        bodies.inv_mass[env, b], bodies.inv_inertia[env, b], wrench(arm, sign * push)
                                    )
                    contacts.impulse[env, i] = p
                    change = wp.max(change, wp.max(wp.abs(wp.cw_mul(diagonal, p - old))))
                sweep += 1
                searching = change > tolerance and sweep < sweeps
            iterations[env] = iterations[env] + sweep
            if change > tolerance:
                reason[env] = reason[env] | ITERATION_LIMIT

    return pgs
