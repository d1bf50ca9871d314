# SPDX-License-Identifier: Apache-2.0
"""The paper's LCP (eqs. 35-39) of one environment: assembly from the contact rows, and the impulses from its solution.

Unknowns of contact i, one after the other: h lambda_n, w_up (k), w_lo (k); their complements: u_n, h sigma_lo,
h sigma_up. v and h lambda_t are eliminated: with W = J M^-1 J^T + epsilon, b = J v_free + d and A = W_tt,

    h lambda_t = A^-1 (E (w_up - w_lo) - W_tn h lambda_n - b_t).

Contacts without friction have the one unknown h lambda_n and no rows in A. Joints that close loops have no unknown: all three of their rows
are bilateral (eq. 14) and are eliminated with the tangents, t above being all eliminated rows. Frozen limits
(box and hybrid laws) are numbers in q instead of entries mu.

Anitescu and Potra (ref. 6) have generators instead: h lambda_t = D beta with the 2 k directions +-e_j, and

                   p_n            beta       gamma
    u_n        [  W_nn           W_nt D        0  ]     b_n
    D^T u_t + gamma [  D^T W_tn   D^T W_tt D   1  ]     D^T b_t          0 <= (p_n, beta, gamma) compl. w >= 0.
    slack      [  mu              -1           0  ]     0
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import linear, problem, rigid, tree
from .declare import BLOCK_OPTIONS, factory, kernel
from .solve_batch import solver
from .types import HELD, ITERATION_LIMIT, scalar_types, sync


@functools.cache
def functions(real, trees: bool = False) -> SimpleNamespace:
    """Workspace and the functions ``assemble`` and ``impulses``."""
    t = scalar_types(real)
    vec2, vec3, mat33 = t.vec2, t.vec3, t.mat33
    Bodies, Contacts = t.Bodies, t.Contacts
    LcpWorkspace = problem.functions(real).LcpWorkspace
    invert = linear.functions(real).invert
    delassus = rigid.functions(real).delassus
    forest = tree.functions(real)
    product, Mechanics = forest.product, forest.Trees if trees else Bodies

    @wp.struct
    class ContactWorkspace:
        W: wp.array3d(dtype=real)  # [P, 3 R, 3 R] J M^-1 J^T + epsilon, order n t1 t2 within a contact
        A_inv: wp.array3d(dtype=real)  # [P, 3 R, 3 R] inverse of W_tt, of the eliminated rows (without loops [P, 2 R, 2 R])
        G: wp.array3d(dtype=real)  # [P, 3 R, R + 1] A^-1 W_tn; last column A^-1 b_t
        friction: wp.array2d(dtype=int)  # [P, R + 1] first row of the contact within A, -1 = none; last: how many rows there are
        start: wp.array2d(dtype=int)  # [P, R + 1] first unknown of each contact; last: number of unknowns

    @wp.func
    def block_of(bodies: Mechanics, contacts: Contacts, env: int, i: int, j: int) -> mat33:
        """Block (i, j) of J M^-1 J^T, rows and columns n t1 t2."""
        block = mat33()
        if wp.static(trees):
            block = product(bodies.shared, bodies.half, contacts.body, bodies.longest, env, i, j)
            block = contacts.frame[env, i] * block * wp.transpose(contacts.frame[env, j])
        else:
            block = delassus(contacts.body, contacts.point, contacts.frame, bodies.com, bodies.inv_mass, bodies.inv_inertia, env, i, j)
        return block

    @wp.func
    def direction(k: int, m: int) -> vec2:
        """e_m, column m of E: angle m pi / k from t1."""
        angle = real(m) * real(wp.pi) / real(k)
        e = vec2(wp.cos(angle), wp.sin(angle))
        if k == 2:
            e = vec2(real(1 - m), real(m))
        return e

    @wp.func
    def eliminated(k: int) -> int:
        """Rows of a contact with k directions that are eliminated: both tangents, none without friction, all three of a loop's."""
        rows = int(2)
        if k == 0:
            rows = 0
        elif k == HELD:
            rows = 3
        return rows

    @wp.func
    def number_unknowns(ws: ContactWorkspace, contacts: Contacts, env: int, slot: int, r: int, lane: int):
        if lane == 0:
            unknowns = int(0)
            frictional = int(0)
            for i in range(r):
                k = contacts.directions[env, i]
                ws.start[slot, i] = unknowns
                ws.friction[slot, i] = -1
                if k != HELD:
                    unknowns += 1 + 2 * k
                if k != 0:
                    ws.friction[slot, i] = frictional
                    frictional += eliminated(k)
            ws.start[slot, r] = unknowns
            ws.friction[slot, r] = frictional
        sync()

    @wp.func
    def eliminate(ws: ContactWorkspace, bodies: Mechanics, contacts: Contacts, env: int, slot: int, r: int, lane: int):
        """W, A^-1 and G."""
        for ij in range(lane, r * r, wp.block_dim()):
            i = ij // r
            j = ij % r
            block = block_of(bodies, contacts, env, i, j)
            for a in range(3):
                if i == j:
                    block[a, a] += contacts.relaxation[env, i][a]
                for b in range(3):
                    ws.W[slot, 3 * i + a, 3 * j + b] = block[a, b]
            fi = ws.friction[slot, i]
            fj = ws.friction[slot, j]
            if fi >= 0 and fj >= 0:
                # Tangents are the last two of three rows; a loop's are all three.
                rows_i = eliminated(contacts.directions[env, i])
                rows_j = eliminated(contacts.directions[env, j])
                for a in range(rows_i):
                    for b in range(rows_j):
                        ws.A_inv[slot, fi + a, fj + b] = block[3 - rows_i + a, 3 - rows_j + b]
        sync()
        frictional = ws.friction[slot, r]
        invert(ws.A_inv, slot, frictional, lane)
        for row in range(lane, frictional, wp.block_dim()):
            for j in range(r + 1):
                total = real(0.0)
                for i in range(r):
                    fi = ws.friction[slot, i]
                    if fi >= 0:
                        rows = eliminated(contacts.directions[env, i])
                        for a in range(rows):
                            right = contacts.free[env, i][3 - rows + a]
                            if j < r:
                                right = ws.W[slot, 3 * i + 3 - rows + a, 3 * j]
                            total += ws.A_inv[slot, row, fi + a] * right
                ws.G[slot, row, j] = total
        sync()

    @wp.func
    def assemble(
        lcp: LcpWorkspace, ws: ContactWorkspace, bodies: Mechanics, contacts: Contacts, env: int, slot: int, rho_scale: real, lane: int
    ) -> int:
        """Lead matrix and vector of eq. 35 after elimination, in lcp.M and lcp.q; returns the number of unknowns."""
        r = contacts.count[env]
        number_unknowns(ws, contacts, env, slot, r, lane)
        eliminate(ws, bodies, contacts, env, slot, r, lane)
        for ij in range(lane, r * r, wp.block_dim()):
            i = ij // r
            j = ij % r
            si = ws.start[slot, i]
            sj = ws.start[slot, j]
            fi = ws.friction[slot, i]
            fj = ws.friction[slot, j]
            ki = contacts.directions[env, i]
            kj = contacts.directions[env, j]
            if ki == HELD or kj == HELD:
                continue
            # u_n = (W_nn - W_nt A^-1 W_tn) h lambda_n + W_nt A^-1 E (w_up - w_lo) + b_n - W_nt A^-1 b_t
            nn = ws.W[slot, 3 * i, 3 * j]
            for c in range(r):
                fc = ws.friction[slot, c]
                if fc >= 0:
                    rows = eliminated(contacts.directions[env, c])
                    for a in range(rows):
                        nn -= ws.W[slot, 3 * i, 3 * c + 3 - rows + a] * ws.G[slot, fc + a, j]
            lcp.M[slot, si, sj] = nn
            for m in range(kj):
                e = direction(kj, m)
                g = ws.G[slot, fj, i] * e[0] + ws.G[slot, fj + 1, i] * e[1]
                lcp.M[slot, si, sj + 1 + m] = g
                lcp.M[slot, si, sj + 1 + kj + m] = -g
            # h sigma_lo,up = mu h lambda_n +- E^T h lambda_t + rho w_lo,up   (eqs. 29 and 30)
            for m in range(ki):
                e = direction(ki, m)
                g = ws.G[slot, fi, j] * e[0] + ws.G[slot, fi + 1, j] * e[1]
                mu = real(0.0)
                if i == j:
                    mu = contacts.mu[env, i][wp.min(m, 1)]
                lcp.M[slot, si + 1 + m, sj] = mu - g
                lcp.M[slot, si + 1 + ki + m, sj] = mu + g
                for c in range(kj):
                    f = direction(kj, c)
                    k_ml = real(0.0)
                    for a in range(2):
                        for b in range(2):
                            k_ml += e[a] * ws.A_inv[slot, fi + a, fj + b] * f[b]
                    rho = real(0.0)
                    if i == j and c == m:
                        rho = rho_scale * k_ml
                    lcp.M[slot, si + 1 + m, sj + 1 + c] = k_ml
                    lcp.M[slot, si + 1 + m, sj + 1 + kj + c] = rho - k_ml
                    lcp.M[slot, si + 1 + ki + m, sj + 1 + c] = rho - k_ml
                    lcp.M[slot, si + 1 + ki + m, sj + 1 + kj + c] = k_ml
        for i in range(lane, r, wp.block_dim()):
            si = ws.start[slot, i]
            fi = ws.friction[slot, i]
            ki = contacts.directions[env, i]
            if ki == HELD:
                continue
            b_n = contacts.free[env, i][0]
            for c in range(r):
                fc = ws.friction[slot, c]
                if fc >= 0:
                    rows = eliminated(contacts.directions[env, c])
                    for a in range(rows):
                        b_n -= ws.W[slot, 3 * i, 3 * c + 3 - rows + a] * ws.G[slot, fc + a, r]
            lcp.q[slot, si] = b_n
            for m in range(ki):
                e = direction(ki, m)
                g = ws.G[slot, fi, r] * e[0] + ws.G[slot, fi + 1, r] * e[1]
                bound = contacts.bound[env, i][wp.min(m, 1)]
                lcp.q[slot, si + 1 + m] = bound - g
                lcp.q[slot, si + 1 + ki + m] = bound + g
        sync()
        return ws.start[slot, r]

    @wp.func
    def impulses(lcp: LcpWorkspace, ws: ContactWorkspace, contacts: Contacts, env: int, slot: int, lane: int):
        """h lambda of every contact from the solution in lcp.z."""
        r = contacts.count[env]
        for i in range(lane, r, wp.block_dim()):
            p = vec3()
            if contacts.directions[env, i] != HELD:
                p[0] = lcp.z[slot, ws.start[slot, i]]
            fi = ws.friction[slot, i]
            if fi >= 0:
                rows = eliminated(contacts.directions[env, i])
                for a in range(rows):
                    total = -ws.G[slot, fi + a, r]
                    for j in range(r):
                        kj = contacts.directions[env, j]
                        if kj != HELD:
                            sj = ws.start[slot, j]
                            total -= ws.G[slot, fi + a, j] * lcp.z[slot, sj]
                            fj = ws.friction[slot, j]
                            for m in range(kj):
                                e = direction(kj, m)
                                w = lcp.z[slot, sj + 1 + m] - lcp.z[slot, sj + 1 + kj + m]
                                total += (ws.A_inv[slot, fi + a, fj] * e[0] + ws.A_inv[slot, fi + a, fj + 1] * e[1]) * w
                    p[3 - rows + a] = total
            contacts.impulse[env, i] = p
        sync()

    @wp.func
    def generator(k: int, column: int) -> vec3:
        """Impulse (n, t1, t2) of one unknown of a contact: p_n, beta_0, ..., beta_{2k-1}, gamma (none)."""
        g = vec3()
        if column == 0:
            g[0] = real(1.0)
        elif column <= 2 * k:
            e = direction(k, (column - 1) % k)
            sign = real(1.0)
            if column > k:
                sign = real(-1.0)
            g = vec3(real(0.0), sign * e[0], sign * e[1])
        return g

    @wp.func
    def assemble_generators(
        lcp: LcpWorkspace, ws: ContactWorkspace, bodies: Mechanics, contacts: Contacts, env: int, slot: int, lane: int
    ) -> int:
        """The LCP of Anitescu and Potra in lcp.M and lcp.q; returns the number of unknowns."""
        r = contacts.count[env]
        if lane == 0:
            unknowns = int(0)
            for i in range(r):
                ws.start[slot, i] = unknowns
                unknowns += 1
                if contacts.directions[env, i] < 0:
                    unknowns += 1 - 2 * contacts.directions[env, i]
            ws.start[slot, r] = unknowns
        sync()
        for ij in range(lane, r * r, wp.block_dim()):
            i = ij // r
            j = ij % r
            si = ws.start[slot, i]
            sj = ws.start[slot, j]
            ki = -contacts.directions[env, i]
            kj = -contacts.directions[env, j]
            block = block_of(bodies, contacts, env, i, j)
            if i == j:
                block += wp.diag(contacts.relaxation[env, i])
            for a in range(ws.start[slot, i + 1] - si):
                left = generator(ki, a)
                for b in range(ws.start[slot, j + 1] - sj):
                    x = wp.dot(left, block * generator(kj, b))
                    if i == j:
                        if b == 2 * kj + 1 and a >= 1 and a <= 2 * ki:
                            x = real(1.0)
                        elif a == 2 * ki + 1 and b == 0:
                            x = contacts.mu[env, i][0]
                        elif a == 2 * ki + 1 and b <= 2 * kj:
                            x = real(-1.0)
                    lcp.M[slot, si + a, sj + b] = x
        for i in range(lane, r, wp.block_dim()):
            si = ws.start[slot, i]
            for a in range(ws.start[slot, i + 1] - si):
                lcp.q[slot, si + a] = wp.dot(generator(-contacts.directions[env, i], a), contacts.free[env, i])
        sync()
        return ws.start[slot, r]

    @wp.func
    def generated_impulses(lcp: LcpWorkspace, ws: ContactWorkspace, contacts: Contacts, env: int, slot: int, lane: int):
        """h lambda of every contact from the generators' coefficients in lcp.z."""
        for i in range(lane, contacts.count[env], wp.block_dim()):
            p = vec3()
            for a in range(ws.start[slot, i + 1] - ws.start[slot, i]):
                p += lcp.z[slot, ws.start[slot, i] + a] * generator(-contacts.directions[env, i], a)
            contacts.impulse[env, i] = p
        sync()

    return SimpleNamespace(
        ContactWorkspace=ContactWorkspace,
        assemble=assemble,
        impulses=impulses,
        assemble_generators=assemble_generators,
        generated_impulses=generated_impulses,
    )


@factory
def make(real, method: str, generators: bool = False, trees: bool = False):
    """Kernel ``assembled_lcp`` for 'lemke', 'murty' or 'judice_pires', of eq. 39 or of Anitescu and Potra.

    Launch tiled with dim (P): workspace p serves the environments todo[p], todo[p + P], ... of todo[:number].
    """
    t = scalar_types(real)
    Bodies, Contacts = t.Bodies, t.Contacts
    f = functions(real, trees)
    Mechanics = tree.functions(real).Trees if trees else Bodies
    ContactWorkspace, assemble, impulses = f.ContactWorkspace, f.assemble, f.impulses
    assemble_generators, generated_impulses = f.assemble_generators, f.generated_impulses
    LcpWorkspace = problem.functions(real).LcpWorkspace
    solve = solver(real, method)

    @kernel(BLOCK_OPTIONS)
    def assembled_lcp(
        bodies: Mechanics,
        contacts: Contacts,
        todo: wp.array(dtype=int),
        number: wp.array(dtype=int),
        rho_scale: real,
        lcp: LcpWorkspace,
        ws: ContactWorkspace,
        iterations: wp.array(dtype=int),
        reason: wp.array(dtype=int),
    ):
        slot, lane = wp.tid()
        for index in range(slot, number[0], lcp.q.shape[0]):
            env = todo[index]
            if contacts.count[env] > ws.friction.shape[1] - 1:  # more contacts than the workspace was made for
                if lane == 0:
                    reason[env] = reason[env] | ITERATION_LIMIT
            elif contacts.count[env] > 0:
                n = int(0)
                if wp.static(generators):
                    n = assemble_generators(lcp, ws, bodies, contacts, env, slot, lane)
                else:
                    n = assemble(lcp, ws, bodies, contacts, env, slot, rho_scale, lane)
                result = wp.vec2i(0, 0)
                if n > 0:
                    result = solve(lcp, slot, n, 10 * n + 100, lane)
                if wp.static(generators):
                    generated_impulses(lcp, ws, contacts, env, slot, lane)
                else:
                    impulses(lcp, ws, contacts, env, slot, lane)
                if lane == 0:
                    iterations[env] = iterations[env] + result[1]
                    reason[env] = reason[env] | result[0]
                sync()

    return assembled_lcp
