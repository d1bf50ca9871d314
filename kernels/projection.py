# SPDX-License-Identifier: Apache-2.0
"""Joints that close loops, brought back together after a step, as far as the masses resist least.

With phi(q) what loops are apart by, a Newton step is delta = -M^-1 J^T (J M^-1 J^T)^-1 phi, the shortest way in the metric of M (projection
in the mass norm; Bayo and Ledesma 1996). J and M are those of the step before it, so a round leaves a part of the order h of phi. The
velocities change by delta / h: moved there in the step, as by SHAKE (Ryckaert et al. 1977); positions alone would take five times
the energy that Euler's rule takes. Rows that repeat others, and poses in which loops lock, are no harm: a thousandth of its diagonal
makes their matrix definite. Where a loop is about to lock or unlock, J is quite another at the next pose: a round that leaves the loops
of an environment further apart is taken back, and is the last of the step. (A flat ring of hinges along its sides turned them by 5 rad
to close 0.2 mm.)
"""

import warp as wp

from . import joint_rows, tree
from .declare import factory, kernel
from .tree import LOOP_TURN, LOOP_WAY
from .types import scalar_types

# Rounds in a step, and another that only looks at what the last one did.
ROUNDS = wp.constant(5)
# Of the diagonal.
REGULAR = wp.constant(1.0e-3)


@factory
def make(real):
    """Kernel ``project``; launch with dim (E), after kinematics, and kinematics after it."""
    t = scalar_types(real)
    vec3 = t.vec3
    Bodies, Contacts, Parameters, Topology = t.Bodies, t.Contacts, t.Parameters, t.Topology
    f = tree.functions(real)
    Trees, product, scatter, descend = f.Trees, f.product, f.scatter, f.descend
    moved_by, pair = f.moved_by, f.pair
    advance = tree.motion(real)
    error = joint_rows.functions(real).loop_error

    @kernel()
    def project(
        topology: Topology,
        parameters: Parameters,
        trees: Trees,
        bodies: Bodies,
        contacts: Contacts,
        system: wp.array3d(dtype=real),
        right: wp.array2d(dtype=real),
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        h: real,
        again: int,
        apart: wp.array(dtype=real),
        stride: int,
    ):
        start, _ = wp.tid()
        for env in range(start, q.shape[0], stride):
            if again > 0 and apart[env] < real(0.0):
                continue  # the round before was no good
            first = trees.touching[env]
            last = contacts.count[env]
            size = int(0)
            total = real(0.0)
            for i in range(first, last):
                k = -1 - contacts.slot[env, i]
                kind = trees.row_kind[k]
                if kind == LOOP_WAY or kind == LOOP_TURN:  # noqa: SIM109 (Warp has no `in`)
                    ends = trees.row_body[k]
                    pose_a = trees.row_pose[k, 0]
                    pose_b = trees.row_pose[k, 1]
                    if ends[0] >= 0:
                        pose_a = bodies.pose[env, ends[0]] * pose_a
                    if ends[1] >= 0:
                        pose_b = bodies.pose[env, ends[1]] * pose_b
                    _axes, phi = error(kind, pose_a, pose_b, trees.row_held[k], trees.row_length[k])
                    total += wp.dot(phi, phi)  # rows in which nothing moved too: that they open says more than what J does
                    column = int(0)
                    for j in range(first, i + 1):
                        other = trees.row_kind[-1 - contacts.slot[env, j]]
                        if other == LOOP_WAY or other == LOOP_TURN:  # noqa: SIM109
                            block = product(trees.shared, trees.half, contacts.body, trees.longest, env, i, j)
                            block = contacts.frame[env, i] * block * wp.transpose(contacts.frame[env, j])
                            for r in range(3):
                                for c in range(3):
                                    system[env, size + r, column + c] = block[r, c]
                            column += 3
                    for r in range(3):
                        right[env, size + r] = real(0.0)
                        if contacts.inv_mass[env, i][r] > real(0.0):
                            right[env, size + r] = -phi[r]
                    size += 3
            n = trees.before.shape[0]
            if again > 0 and total > apart[env]:
                apart[env] = real(-1.0)  # taken back
                for k in range(n):
                    trees.change[env, k] = -trees.change[env, k]
                for b in range(trees.order.shape[0]):
                    trees.push[env, b] = -trees.push[env, b]
            elif again == ROUNDS:
                continue
            else:
                apart[env] = total
                # Cholesky's factors in place, and both substitutions.
                for i in range(size):
                    diagonal = system[env, i, i] * (real(1.0) + real(REGULAR))
                    for k in range(i):
                        diagonal -= system[env, i, k] * system[env, i, k]
                    # What repeats other rows leaves round-off: it takes nothing more.
                    root = real(0.0)
                    if diagonal > real(REGULAR) * system[env, i, i] * real(0.5):
                        root = real(1.0) / wp.sqrt(diagonal)
                    for j in range(i + 1, size):
                        below = system[env, j, i]
                        for k in range(i):
                            below -= system[env, j, k] * system[env, i, k]
                        system[env, j, i] = below * root
                    y = right[env, i]
                    for k in range(i):
                        y -= system[env, i, k] * right[env, k]
                    right[env, i] = y * root
                    system[env, i, i] = root
                for ii in range(size):
                    i = size - 1 - ii
                    y = right[env, i]
                    for k in range(i + 1, size):
                        y -= system[env, k, i] * right[env, k]
                    right[env, i] = y * system[env, i, i]
                # z = D^1/2 L delta, then delta.
                for k in range(n):
                    trees.change[env, k] = real(0.0)
                row = int(0)
                for i in range(first, last):
                    kind = trees.row_kind[-1 - contacts.slot[env, i]]
                    if kind == LOOP_WAY or kind == LOOP_TURN:  # noqa: SIM109
                        push = vec3(right[env, row], right[env, row + 1], right[env, row + 2])
                        scatter(trees, trees.change, env, i, contacts.body[env, i], wp.transpose(contacts.frame[env, i]) * push)
                        row += 3
                for k in range(n):
                    trees.change[env, k] = wp.sqrt(trees.pivot[env, k]) * trees.change[env, k]
                descend(trees, trees.gained, env)
                for b in range(trees.order.shape[0]):
                    gained = trees.gained[env, b]
                    m = parameters.mass[env % parameters.mass.shape[0], b]
                    push = m * moved_by(gained, bodies.com[env, b] - trees.origin[env, trees.root[b]])
                    trees.push[env, b] = pair(push, trees.own[env, b] * wp.spatial_bottom(gained))
            for k in range(n):
                faster = trees.change[env, k] / h
                v[env, k] = v[env, k] + faster
                trees.left[env, k] = v[env, k]
                trees.free[env, k] = trees.free[env, k] + faster  # no row did it, none will again
            for b in range(trees.order.shape[0]):
                trees.momentum[env, b] += trees.push[env, b] / h
                advance(topology, trees, bodies, trees.change, real(1.0), q, env, b)

    return project
