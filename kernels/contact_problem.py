# SPDX-License-Identifier: Apache-2.0
"""Contact problems for the proximal method: given as arrays (W, q, mu), or the contact rows of an environment."""

import warp as wp

from . import friction, proximal, rigid, tree
from .declare import BLOCK_OPTIONS, factory, kernel
from .types import DISC, ITERATION_LIMIT, NOT_A_NUMBER, UNCERTIFIED, scalar_types, sync


@factory
def make(real):
    """Kernel ``solve_contacts`` for B problems of n contacts given as arrays; launch tiled with dim (P), P <= B workspaces."""
    t = scalar_types(real)
    vec2, vec3, mat33 = t.vec2, t.vec3, t.mat33
    f = proximal.functions(real)
    Graph, ContactProblem = f.Graph, f.ContactProblem
    clear, connect, complete, analyse, proximal_newton = f.clear, f.connect, f.complete, f.analyse, f.proximal_newton
    law = friction.functions(real)
    weigh, law_error = law.weigh, law.law_error
    round_off = real(1.0e-15) if real is wp.float64 else real(1.0e-6)

    @wp.func
    def block_of(W: wp.array3d(dtype=real), problem: int, i: int, j: int) -> mat33:
        b = mat33()
        for x in range(3):
            for y in range(3):
                b[x, y] = W[problem, 3 * i + x, 3 * j + y]
        return b

    @wp.func
    def couple(g: Graph, slot: int, n: int, W: wp.array3d(dtype=real), problem: int, lane: int) -> vec2:
        """Neighbours from the blocks that are not zero; returns max |W| and max |W - W^T| over the rows of this lane."""
        size = vec3()
        difference = vec3()
        for i in range(lane, n, wp.block_dim()):
            clear(g, slot, n, i)
            for j in range(i, n):
                a = block_of(W, problem, i, j)
                b = wp.transpose(block_of(W, problem, j, i))
                # Three chains of maxima and no more: their latency is what this loop costs.
                largest = wp.max(wp.max(wp.abs(a[0]), wp.abs(a[1])), wp.abs(a[2]))
                largest = wp.max(largest, wp.max(wp.max(wp.abs(b[0]), wp.abs(b[1])), wp.abs(b[2])))
                size = wp.max(size, largest)
                difference = wp.max(difference, wp.max(wp.max(wp.abs(a[0] - b[0]), wp.abs(a[1] - b[1])), wp.abs(a[2] - b[2])))
                if wp.max(largest) > real(0.0) and j != i:
                    connect(g, slot, i, j)
        sync()
        complete(g, slot, n, lane)
        return vec2(wp.max(size), wp.max(difference))

    @wp.func
    def load(
        g: Graph,
        c: ContactProblem,
        slot: int,
        n: int,
        W: wp.array3d(dtype=real),
        q: wp.array2d(dtype=real),
        mu: wp.array2d(dtype=real),
        directions: int,
        problem: int,
        lane: int,
    ):
        """Numbers of one problem, cold start."""
        for i in range(lane, n, wp.block_dim()):
            k = directions
            if mu[problem, i] == real(0.0):
                k = 0
            w = block_of(W, problem, i, i)
            g.diagonal[slot, i] = w
            for e in range(g.row[slot, i], g.row[slot, i + 1]):
                g.block[slot, e] = block_of(W, problem, i, g.column[slot, e])
            c.free[slot, i] = vec3(q[problem, 3 * i], q[problem, 3 * i + 1], q[problem, 3 * i + 2])
            c.mu[slot, i] = vec2(mu[problem, i], mu[problem, i])
            c.bound[slot, i] = vec2()
            c.directions[slot, i] = k
            inverse = weigh(wp.get_diag(w), k)
            c.rho[slot, i] = vec3(real(1.0) / inverse[0], real(1.0) / inverse[1], real(1.0) / inverse[2])
            c.impulse[slot, i] = vec3()
        sync()

    @wp.func
    def natural_map(p: vec3, u: vec3, mu: real) -> vec3:
        """p - P_K(p - u^), u^ = u + mu |u_t| n, K the cone |p_t| <= mu p_n (Acary, Bremond and Huber 2018)."""
        x = p - u - vec3(mu * wp.sqrt(u[1] * u[1] + u[2] * u[2]), real(0.0), real(0.0))
        size = wp.sqrt(x[1] * x[1] + x[2] * x[2])
        projected = x
        if size > mu * x[0] or x[0] < real(0.0):
            projected = vec3()
            if mu * size > -x[0]:
                normal = (x[0] + mu * size) / (real(1.0) + mu * mu)
                projected = vec3(normal, mu * normal * x[1] / size, mu * normal * x[2] / size)
        return p - projected

    @kernel(BLOCK_OPTIONS)
    def solve_contacts(
        W: wp.array3d(dtype=real),
        q: wp.array2d(dtype=real),
        mu: wp.array2d(dtype=real),
        directions: int,
        newton_limit: int,
        sweeps: int,
        tolerance: real,
        g: Graph,
        c: ContactProblem,
        impulse: wp.array2d(dtype=real),
        velocity: wp.array2d(dtype=real),
        residual: wp.array(dtype=real),
        natural: wp.array(dtype=real),
        cone_energy: wp.array(dtype=real),
        sizes: wp.array2d(dtype=real),
        asymmetry: wp.array(dtype=real),
        iterations: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        """newton_limit = 0: nothing but `sweeps` of block Gauss-Seidel. sizes [B, 2], zero before: max |W|, max |W - W^T|."""
        slot, lane = wp.tid()
        n = mu.shape[1]
        for problem in range(slot, mu.shape[0], c.free.shape[0]):
            largest = couple(g, slot, n, W, problem, lane)
            wp.atomic_max(sizes, problem, 0, largest[0])
            wp.atomic_max(sizes, problem, 1, largest[1])
            analyse(g, slot, n, lane)  # there is room: the workspace is made for n
            load(g, c, slot, n, W, q, mu, directions, problem, lane)
            result = proximal_newton(g, c, slot, n, real(0.01) * tolerance, real(wp.inf), sweeps, newton_limit, lane)
            # Everything below from W, q, mu and p alone, with W as it was given.
            for i in range(lane, n, wp.block_dim()):
                u = c.free[slot, i]
                terms = vec3()
                for e in range(g.row[slot, i] - 1, g.row[slot, i + 1]):
                    j = int(i)
                    if e >= g.row[slot, i]:
                        j = g.column[slot, e]
                    block = block_of(W, problem, i, j)
                    for x in range(3):
                        term = c.impulse[slot, j][x] * wp.transpose(block)[x]
                        u += term
                        terms += wp.abs(term)
                c.velocity[slot, i] = u
                c.error[slot, i] = wp.max(terms)
            sync()
            if lane == 0:
                worst = real(0.0)
                size = real(0.0)
                largest_sum = real(0.0)
                distance = real(0.0)
                square = real(0.0)
                energy = real(0.0)
                sound = bool(True)  # a maximum passes over what is not a number
                for i in range(n):
                    p = c.impulse[slot, i]
                    free = c.free[slot, i]
                    u = c.velocity[slot, i]
                    sound = sound and wp.isfinite(u) and wp.isfinite(p) and c.mu[slot, i][0] >= real(0.0)
                    largest_sum = wp.max(largest_sum, c.error[slot, i])
                    k = c.directions[slot, i]
                    diagonal = wp.get_diag(g.diagonal[slot, i])
                    m = c.mu[slot, i]
                    worst = wp.max(worst, wp.max(wp.abs(law_error(u, p, weigh(diagonal, k), m, vec2(), k))))
                    size = wp.max(size, wp.max(wp.abs(free)))
                    w = weigh(diagonal, DISC)
                    cone = law_error(u, p, w, m, vec2(), DISC)
                    energy += real(0.5) * wp.dot(wp.cw_div(cone, w), cone)
                    map = natural_map(p, u, m[0])
                    distance += wp.dot(map, map)
                    square += wp.dot(free, free)
                    for x in range(3):
                        impulse[problem, 3 * i + x] = p[x]
                        velocity[problem, 3 * i + x] = u[x]
                residual[problem] = worst
                natural[problem] = real(0.0)
                if square > real(0.0):
                    natural[problem] = wp.sqrt(distance / square)
                cone_energy[problem] = energy
                asymmetry[problem] = real(0.0)
                if sizes[problem, 0] > real(0.0):
                    asymmetry[problem] = sizes[problem, 1] / sizes[problem, 0]
                iterations[problem] = result[1]
                status[problem] = 0
                # No residual is known better than the round-off of W p.
                if not sound:
                    status[problem] = NOT_A_NUMBER | UNCERTIFIED
                elif not worst <= tolerance * size + round_off * largest_sum:
                    status[problem] = result[0] | UNCERTIFIED
            sync()

    return solve_contacts


@factory
def make_contacts(real, trees: bool = False):
    """Kernel ``proximal_contacts`` for the rows of environments; launch tiled with dim (P). trees: for scenes with joints."""
    t = scalar_types(real)
    vec3, mat33 = t.vec3, t.mat33
    Bodies, Contacts = t.Bodies, t.Contacts
    f = proximal.functions(real, trees)
    Graph, ContactProblem = f.Graph, f.ContactProblem
    clear, connect, analyse, proximal_newton = f.clear, f.connect, f.analyse, f.proximal_newton
    weigh = friction.functions(real, trees).weigh
    delassus = rigid.functions(real).delassus
    forest = tree.functions(real)
    product, Mechanics = forest.product, forest.Trees if trees else Bodies

    @wp.func
    def couple_trees(g: Graph, slot: int, n: int, body: wp.array2d(dtype=wp.vec2i), shared: wp.array2d(dtype=int), env: int, lane: int):
        """Contacts whose bodies have velocities in common are neighbours."""
        for i in range(lane, n, wp.block_dim()):
            clear(g, slot, n, i)
            for j in range(n):
                if j != i:
                    for x in range(2):
                        for y in range(2):
                            a = body[env, i][x]
                            b = body[env, j][y]
                            if a >= 0 and b >= 0:  # noqa: SIM102
                                if shared[a, b] > 0:
                                    connect(g, slot, i, j)
        sync()

    @wp.func
    def couple(g: Graph, slot: int, n: int, body: wp.array2d(dtype=wp.vec2i), inv_mass: wp.array2d(dtype=real), env: int, lane: int):
        """Contacts that share a movable body are neighbours."""
        for i in range(lane, n, wp.block_dim()):
            clear(g, slot, n, i)
            for j in range(n):
                if j != i:
                    for x in range(2):
                        b = body[env, i][x]
                        if b >= 0:  # noqa: SIM102
                            if inv_mass[env, b] > real(0.0) and (body[env, j][0] == b or body[env, j][1] == b):
                                connect(g, slot, i, j)
        sync()

    @kernel(BLOCK_OPTIONS)
    def proximal_contacts(
        bodies: Mechanics,
        contacts: Contacts,
        todo: wp.array(dtype=int),
        number: wp.array(dtype=int),
        sweeps: int,
        limit: int,
        target: real,
        rest: real,
        g: Graph,
        c: ContactProblem,
        iterations: wp.array(dtype=int),
        reason: wp.array(dtype=int),
    ):
        slot, lane = wp.tid()
        for index in range(slot, number[0], c.free.shape[0]):
            env = todo[index]
            n = contacts.count[env]
            if n == 0:
                continue
            if wp.static(trees):
                couple_trees(g, slot, n, contacts.body, bodies.shared, env, lane)
            else:
                couple(g, slot, n, contacts.body, bodies.inv_mass, env, lane)
            if analyse(g, slot, n, lane):
                for i in range(lane, n, wp.block_dim()):
                    # Row i of W, its own block last.
                    for e in range(g.row[slot, i], g.row[slot, i + 1] + 1):
                        j = int(i)
                        if e < g.row[slot, i + 1]:
                            j = g.column[slot, e]
                        block = mat33()
                        if wp.static(trees):
                            block = product(bodies.shared, bodies.half, contacts.body, bodies.longest, env, i, j)
                            block = contacts.frame[env, i] * block * wp.transpose(contacts.frame[env, j])
                        else:
                            block = delassus(
                                contacts.body, contacts.point, contacts.frame, bodies.com, bodies.inv_mass, bodies.inv_inertia, env, i, j
                            )
                        if e < g.row[slot, i + 1]:
                            g.block[slot, e] = block
                        else:
                            g.diagonal[slot, i] = block + wp.diag(contacts.relaxation[env, i])
                    k = contacts.directions[env, i]
                    inverse = weigh(wp.get_diag(g.diagonal[slot, i]), k)
                    c.rho[slot, i] = vec3(real(1.0) / inverse[0], real(1.0) / inverse[1], real(1.0) / inverse[2])
                    c.free[slot, i] = contacts.free[env, i]
                    c.mu[slot, i] = contacts.mu[env, i]
                    c.bound[slot, i] = contacts.bound[env, i]
                    c.directions[slot, i] = k
                    c.impulse[slot, i] = vec3()
                sync()
                result = proximal_newton(g, c, slot, n, target, rest, sweeps, limit, lane)
                for i in range(lane, n, wp.block_dim()):
                    contacts.impulse[env, i] = c.impulse[slot, i]
                if lane == 0:
                    iterations[env] = iterations[env] + result[1]
                    reason[env] = reason[env] | result[0]
            elif lane == 0:
                reason[env] = reason[env] | ITERATION_LIMIT  # more coupled contacts than the workspace has room for
            sync()

    return proximal_contacts
