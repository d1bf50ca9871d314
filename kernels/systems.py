# SPDX-License-Identifier: Apache-2.0
"""The linear system that velocity pivoting solves, M + sum of J^T K J, block by block: of free bodies, or of kinematic trees.

A node has six unknowns. Of free bodies each is a node, its unknowns are changes of its velocity, and J is an arm. Of trees the
unknowns are z = D^1/2 L x (kernels/tree.py), in which M is the identity and J what `Trees.half` holds of each contact: an entry for
each velocity on the paths to its bodies. Six of them that follow each other in a tree are a node; what is left of it when the tree ends has
ones on the diagonal.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import rigid, sparse, tree
from .types import scalar_types, sync


@functools.cache
def shared(real, of_trees: bool = False) -> SimpleNamespace:
    """Bundle ``Workspace`` and what both systems do with it."""
    t = scalar_types(real)
    vec3, mat33 = t.vec3, t.mat33
    vec6 = wp.types.vector(length=6, dtype=real)
    mat66 = wp.types.matrix(shape=(6, 6), dtype=real)
    mat63 = wp.types.matrix(shape=(6, 3), dtype=real)
    s = sparse.functions(real, 6)
    Graph, clear, connect, analyse = s.Graph, s.clear, s.connect, s.analyse

    @wp.struct
    class Workspace:
        """Systems of n nodes of P environments, R contacts."""

        nodes: wp.array2d(dtype=int)  # [B, m] nodes that a body's motion is made of, -1 behind the last one
        body: wp.array(dtype=int)  # [n] of free bodies: whose node it is
        velocity: wp.array2d(dtype=int)  # [n, 6] of trees: which velocities are in a node, -1 where there is none
        node: wp.array2d(dtype=int)  # [P, 2 m R] of trees: the nodes of each contact, each once, -1 where there is none...
        arm: wp.array2d(dtype=mat63)  # ... and J^T of the contact in their unknowns, world axes
        begin: wp.array2d(dtype=int)  # [P, n + 1] first contact of each node in `contact`
        contact: wp.array2d(dtype=int)  # [P, 2 m R]
        matrix: wp.array2d(dtype=mat33)  # [P, R] K
        shift: wp.array2d(dtype=vec3)  # [P, R] g
        change: wp.array2d(dtype=vec6)  # [P, n] what x becomes; while Newton's method runs dx
        scratch: wp.array2d(dtype=vec6)  # [P, n]
        flips: wp.array(dtype=int)  # [P]
        # Of Newton's method with a line search:
        present: wp.array2d(dtype=vec6)  # [P, n] x where the step starts
        relaxed: wp.array2d(dtype=vec3)  # [P, R] f + J x there
        stiffness: wp.array2d(dtype=vec3)  # [P, R] 1 / eps
        ahead: wp.array2d(dtype=vec3)  # [P, R] J dx
        expected: wp.array2d(dtype=vec3)  # [P, R] impulse after the step, if no contact changes state
        part: wp.array2d(dtype=vec3)  # [P, R] what a contact adds to the numbers of the line search

    @wp.func
    def touched(nodes: wp.array2d(dtype=int), pair: wp.vec2i, k: int) -> int:
        """The nodes of a contact for k = 0 ... 2 m - 1, each once; -1: none."""
        most = nodes.shape[1]
        body = pair[0]
        if k >= most:
            body = pair[1]
        result = int(-1)
        if body >= 0:
            result = nodes[body, k % most]
        if k >= most and pair[0] >= 0 and result >= 0:
            for j in range(most):
                if nodes[pair[0], j] == result:
                    result = -1
        return result

    @wp.func
    def node_of(ws: Workspace, body: wp.array2d(dtype=wp.vec2i), env: int, slot: int, i: int, k: int) -> int:
        """The same of contact i; of trees it has been written down."""
        if wp.static(of_trees):
            return ws.node[slot, 2 * ws.nodes.shape[1] * i + k]
        return touched(ws.nodes, body[env, i], k)

    @wp.func
    def list_contacts(ws: Workspace, body: wp.array2d(dtype=wp.vec2i), env: int, slot: int, r: int, lane: int):
        """Contacts of each node, in order."""
        if lane == 0:
            n = ws.body.shape[0]
            sides = 2 * ws.nodes.shape[1]
            for b in range(n + 1):
                ws.begin[slot, b] = 0
            for i in range(r):
                for k in range(sides):
                    b = node_of(ws, body, env, slot, i, k)
                    if b >= 0:
                        ws.begin[slot, b + 1] = ws.begin[slot, b + 1] + 1
            for b in range(n):
                ws.begin[slot, b + 1] = ws.begin[slot, b + 1] + ws.begin[slot, b]
            for i in range(r):
                for k in range(sides):
                    b = node_of(ws, body, env, slot, i, k)
                    if b >= 0:
                        e = ws.begin[slot, b]
                        ws.contact[slot, e] = i
                        ws.begin[slot, b] = e + 1
            # Now begin[b] is where node b ends, which is where the next one begins.
            for bb in range(n):
                ws.begin[slot, n - bb] = ws.begin[slot, n - bb - 1]
            ws.begin[slot, 0] = 0
        sync()

    @wp.func
    def couple(g: Graph, ws: Workspace, body: wp.array2d(dtype=wp.vec2i), env: int, slot: int, lane: int) -> bool:
        """Nodes that share a contact are neighbours; False where there is no room for them."""
        n = ws.body.shape[0]
        for b in range(lane, n, wp.block_dim()):
            clear(g, slot, n, b)
            for e in range(ws.begin[slot, b], ws.begin[slot, b + 1]):
                i = ws.contact[slot, e]
                for k in range(2 * ws.nodes.shape[1]):
                    other = node_of(ws, body, env, slot, i, k)
                    if other >= 0 and other != b:
                        connect(g, slot, b, other)
        sync()
        return analyse(g, slot, n, lane)

    @wp.func
    def add_block(g: Graph, slot: int, row: int, column: int, a: mat66):
        """Add to a block off the diagonal where the factors hold it."""
        e = g.row[slot, row]
        while g.column[slot, e] != column:
            e += 1
        target = g.target[slot, e]
        if target >= 0:
            g.upper[slot, target] = g.upper[slot, target] + a
        else:
            g.lower[slot, -1 - target] = g.lower[slot, -1 - target] + a

    return SimpleNamespace(
        vec6=vec6,
        mat66=mat66,
        Graph=Graph,
        Workspace=Workspace,
        touched=touched,
        list_contacts=list_contacts,
        couple=couple,
        add_block=add_block,
    )


@functools.cache
def bodies(real) -> SimpleNamespace:
    """Of free bodies."""
    t = scalar_types(real)
    vec2, vec3, mat33, Bodies = t.vec2, t.vec3, t.mat33, t.Bodies
    s = shared(real)
    vec6, mat66, Graph, Workspace, add_block = s.vec6, s.mat66, s.Graph, s.Workspace, s.add_block
    times_skew, skew_times = rigid.functions(real).times_skew, rigid.functions(real).skew_times

    @wp.func
    def blocks(vv: mat33, vw: mat33, wv: mat33, ww: mat33) -> mat66:
        a = mat66()
        for i in range(3):
            for j in range(3):
                a[i, j] = vv[i, j]
                a[i, 3 + j] = vw[i, j]
                a[3 + i, j] = wv[i, j]
                a[3 + i, 3 + j] = ww[i, j]
        return a

    @wp.func
    def node(nodes: wp.array2d(dtype=int), body: int) -> int:
        result = int(-1)
        if body >= 0:
            result = nodes[body, 0]
        return result

    @wp.func
    def assemble_row(
        g: Graph,
        ws: Workspace,
        m: Bodies,
        body: wp.array2d(dtype=wp.vec2i),
        point: wp.array2d(dtype=vec3),
        env: int,
        slot: int,
        b: int,
    ):
        """The six rows of one body: its mass and what its contacts add, in the factors' memory."""
        index = ws.body[b]
        vv = wp.diag(vec3(real(1.0) / m.inv_mass[env, index]))
        vw = mat33()
        wv = mat33()
        ww = wp.inverse(m.inv_inertia[env, index])
        x = ws.present[slot, b]
        bv = -(vv * vec3(x[0], x[1], x[2]))
        bw = -(ww * vec3(x[3], x[4], x[5]))
        for e in range(ws.begin[slot, b], ws.begin[slot, b + 1]):
            i = ws.contact[slot, e]
            pair = body[env, i]
            matrix = ws.matrix[slot, i]
            shift = ws.shift[slot, i]
            other = pair[0]
            if other == index:
                shift = -shift
                other = pair[1]
            arm = point[env, i] - m.com[env, index]
            right = times_skew(matrix, arm)
            left = skew_times(arm, matrix)
            vv += matrix
            vw -= right
            wv += left
            ww -= skew_times(arm, right)
            bv -= shift
            bw -= wp.cross(arm, shift)
            column = node(ws.nodes, other)
            if column >= 0:
                far = point[env, i] - m.com[env, other]
                add_block(g, slot, b, column, blocks(-matrix, times_skew(matrix, far), -left, times_skew(left, far)))
        g.pivot[slot, g.step[slot, b]] = blocks(vv, vw, wv, ww)
        ws.change[slot, b] = vec6(bv[0], bv[1], bv[2], bw[0], bw[1], bw[2])

    @wp.func
    def body_change(ws: Workspace, com: wp.array2d(dtype=vec3), env: int, slot: int, body: int, point: vec3) -> vec3:
        """J x of one body at a point."""
        u = vec3()
        b = node(ws.nodes, body)
        if b >= 0:
            x = ws.change[slot, b]
            u = vec3(x[0], x[1], x[2]) + wp.cross(vec3(x[3], x[4], x[5]), point - com[env, body])
        return u

    @wp.func
    def change_at(
        ws: Workspace, m: Bodies, body: wp.array2d(dtype=wp.vec2i), point: wp.array2d(dtype=vec3), env: int, slot: int, i: int
    ) -> vec3:
        """J x of contact i, world axes."""
        pair = body[env, i]
        x = point[env, i]
        return body_change(ws, m.com, env, slot, pair[1], x) - body_change(ws, m.com, env, slot, pair[0], x)

    @wp.func
    def energies(ws: Workspace, m: Bodies, env: int, slot: int, b: int) -> vec2:
        """dx . M x and dx . M dx of a node."""
        index = ws.body[b]
        x = ws.present[slot, b]
        d = ws.change[slot, b]
        dv = vec3(d[0], d[1], d[2]) / m.inv_mass[env, index]
        dw = wp.inverse(m.inv_inertia[env, index]) * vec3(d[3], d[4], d[5])
        momentum = vec6(dv[0], dv[1], dv[2], dw[0], dw[1], dw[2])
        return vec2(wp.dot(momentum, x), wp.dot(momentum, d))

    return SimpleNamespace(
        Mechanics=Bodies,
        Workspace=Workspace,
        list_contacts=s.list_contacts,
        couple=s.couple,
        assemble_row=assemble_row,
        change_at=change_at,
        energies=energies,
    )


@functools.cache
def trees(real) -> SimpleNamespace:
    """Of kinematic trees."""
    t = scalar_types(real)
    vec2, vec3 = t.vec2, t.vec3
    s = shared(real, True)
    Graph, Workspace, add_block, touched = s.Graph, s.Workspace, s.add_block, s.touched
    mat63 = wp.types.matrix(shape=(6, 3), dtype=real)
    Trees = tree.functions(real).Trees

    @wp.func
    def prepare(ws: Workspace, m: Trees, body: wp.array2d(dtype=wp.vec2i), env: int, slot: int, r: int, lane: int):
        """The nodes of each contact and its J^T in their unknowns."""
        sides = 2 * ws.nodes.shape[1]
        two = int(2)  # as a variable: Warp would write out the loop
        for i in range(lane, r, wp.block_dim()):
            pair = body[env, i]
            for k in range(sides):
                b = touched(ws.nodes, pair, k)
                ws.node[slot, i * sides + k] = b
                if b >= 0:
                    arm = mat63()
                    for side in range(two):
                        if pair[side] >= 0:
                            for c in range(ws.velocity.shape[1]):
                                v = ws.velocity[b, c]
                                if v >= 0:  # noqa: SIM102
                                    if m.path[pair[side], m.depth[v]] == v:
                                        arm[c] = arm[c] + real(2 * side - 1) * m.half[env, (2 * i + side) * m.longest + m.depth[v]]
                    ws.arm[slot, i * sides + k] = arm
        sync()

    @wp.func
    def assemble_row(
        g: Graph,
        ws: Workspace,
        m: Trees,
        body: wp.array2d(dtype=wp.vec2i),
        point: wp.array2d(dtype=vec3),
        env: int,
        slot: int,
        b: int,
    ):
        """The six rows of one node, in the factors' memory."""
        sides = 2 * ws.nodes.shape[1]
        diagonal = wp.identity(n=6, dtype=real)
        right = -ws.present[slot, b]
        for e in range(ws.begin[slot, b], ws.begin[slot, b + 1]):
            i = ws.contact[slot, e]
            first = i * sides
            at = int(first)
            while ws.node[slot, at] != b:
                at += 1
            own = ws.arm[slot, at]
            matrix = ws.matrix[slot, i]
            diagonal += own * (matrix * wp.transpose(own))
            right -= own * ws.shift[slot, i]
            for k in range(first, first + sides):
                other = ws.node[slot, k]
                if other >= 0 and k != at:
                    add_block(g, slot, b, other, own * (matrix * wp.transpose(ws.arm[slot, k])))
        g.pivot[slot, g.step[slot, b]] = diagonal
        ws.change[slot, b] = right

    @wp.func
    def change_at(
        ws: Workspace, m: Trees, body: wp.array2d(dtype=wp.vec2i), point: wp.array2d(dtype=vec3), env: int, slot: int, i: int
    ) -> vec3:
        """J x of contact i, world axes."""
        sides = 2 * ws.nodes.shape[1]
        u = vec3()
        for k in range(i * sides, (i + 1) * sides):
            b = ws.node[slot, k]
            if b >= 0:
                u += wp.transpose(ws.arm[slot, k]) * ws.change[slot, b]
        return u

    @wp.func
    def energies(ws: Workspace, m: Trees, env: int, slot: int, b: int) -> vec2:
        """dz . z and dz . dz of a node: M is the identity."""
        d = ws.change[slot, b]
        return vec2(wp.dot(d, ws.present[slot, b]), wp.dot(d, d))

    return SimpleNamespace(
        Mechanics=Trees,
        Workspace=Workspace,
        prepare=prepare,
        list_contacts=s.list_contacts,
        couple=s.couple,
        assemble_row=assemble_row,
        change_at=change_at,
        energies=energies,
    )
