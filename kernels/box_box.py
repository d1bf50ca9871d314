# SPDX-License-Identifier: Apache-2.0
"""Contact manifold of two boxes: separating axes, then a clipped face (up to 8 points) or one edge-edge point."""

import functools
from types import SimpleNamespace

import warp as wp

from .collide import NO_POINT, pair_functions
from .contacts import ELASTIC_RANGE
from .declare import factory, kernel
from .types import scalar_types

# Boxes that overlap along an axis by no more count as touching there. What rests does, so deep as its load presses it in. What
# grazes an edge does not, but is not told from it, and ends so deep in its side: least and most of the smallest half extent.
TOUCHING = wp.constant(0.03)
SUNK = wp.constant(0.1)


@functools.cache
def axes(real) -> SimpleNamespace:
    """Separating-axis tests of box b in the frame of box a: d = centre of b, R = axes of b as columns."""
    t = scalar_types(real)
    vec3, mat33 = t.vec3, t.mat33
    Bodies, Topology = t.Bodies, t.Topology

    @wp.func
    def inverse_mass(topology: Topology, bodies: Bodies, env: int, shape: int) -> real:
        body = topology.shape_body[shape]
        result = real(0.0)
        if body >= 0:
            result = bodies.inv_mass[env, body]
        return result

    @wp.func
    def touching_depth(gravity: vec3, inverse_a: real, inverse_b: real, stiffness: real) -> vec3:
        """How deep shapes may overlap that count as touching: what their load presses them in, m, no less than the first and no more
        than the last of these parts of the smallest half extent."""
        load = wp.length(gravity) / wp.max(wp.max(inverse_a, inverse_b), real(1.0e-30))
        return vec3(real(TOUCHING), real(ELASTIC_RANGE) * load / stiffness, real(SUNK))

    @wp.func
    def face_separation(d: vec3, rotation: mat33, ha: vec3, hb: vec3, axis: int) -> real:
        """Separation along face normal `axis` of the box that owns the frame."""
        extent = ha[axis]
        for k in range(3):
            extent += wp.abs(rotation[axis, k]) * hb[k]
        return wp.abs(d[axis]) - extent

    @wp.func
    def column(m: mat33, j: int) -> vec3:
        return vec3(m[0, j], m[1, j], m[2, j])

    @wp.func
    def edge_axis(rotation: mat33, i: int, j: int) -> vec3:
        """Unit normal to edge i of a and edge j of b; zero where the edges are parallel."""
        e = vec3()
        e[i] = real(1.0)
        n = wp.cross(e, column(rotation, j))
        length = wp.length(n)
        if length < real(1.0e-3):
            return vec3()
        return n / length

    @wp.func
    def edge_separation(d: vec3, rotation: mat33, ha: vec3, hb: vec3, n: vec3) -> real:
        extent = real(0.0)
        for k in range(3):
            extent += wp.abs(n[k]) * ha[k] + wp.abs(wp.dot(n, column(rotation, k))) * hb[k]
        return wp.abs(wp.dot(d, n)) - extent

    @wp.func
    def rank(now: real, ahead: real, touching: real, far: real) -> real:
        """Separation ahead, by which axes are compared; axes that part the boxes now come before all that do not.

        For what boxes meet is a side that is between them now: ahead, one that lands near an edge, or has passed through,
        may overlap less along another axis, or be clear of it.
        """
        if now < -touching:
            return ahead - far
        return ahead

    return SimpleNamespace(
        face_separation=face_separation,
        edge_axis=edge_axis,
        edge_separation=edge_separation,
        column=column,
        rank=rank,
        inverse_mass=inverse_mass,
        touching_depth=touching_depth,
    )


@functools.cache
def polygon(real) -> SimpleNamespace:
    """Sutherland-Hodgman clipping of a convex polygon of at most 8 vertices, held in registers."""
    vec8 = wp.types.vector(length=8, dtype=real)
    vec8i = wp.types.vector(length=8, dtype=int)

    @wp.struct
    class Polygon:
        count: int
        x: vec8  # in the plane of the reference face, m
        y: vec8
        z: vec8  # height above it, m
        edge: vec8i  # which line leads from this vertex to the next: 0-3 incident face, 4-7 clipping planes

    @wp.func
    def beyond(p: Polygon, k: int, plane: int, half: real) -> real:
        """How far vertex k lies beyond a side of the reference face; plane = 0..3 for x <= half, -x <= half, y.., -y.."""
        along = p.x[k]
        if plane >= 2:
            along = p.y[k]
        if plane % 2 == 1:
            along = -along
        return along - half

    @wp.func
    def clip(p: Polygon, plane: int, half: real):
        """Keep the part within one side of the reference face."""
        # A corner that lies on the side keeps its identity, whatever the last bits say.
        slack = half * real(1.0e-4)
        most = real(0.0)
        for k in range(p.count):
            most = wp.max(most, beyond(p, k, plane, half))
        if most <= slack:
            return p
        result = Polygon()
        count = int(0)
        for k in range(p.count):
            m = k + 1
            if m == p.count:
                m = 0
            here = beyond(p, k, plane, half)
            there = beyond(p, m, plane, half)
            keep_here = here <= slack
            keep_there = there <= slack
            if keep_here and count < 8:
                result.x[count] = p.x[k]
                result.y[count] = p.y[k]
                result.z[count] = p.z[k]
                result.edge[count] = p.edge[k]
                count += 1
            if keep_here != keep_there and count < 8:
                s = wp.clamp(here / (here - there), real(0.0), real(1.0))
                result.x[count] = p.x[k] + s * (p.x[m] - p.x[k])
                result.y[count] = p.y[k] + s * (p.y[m] - p.y[k])
                result.z[count] = p.z[k] + s * (p.z[m] - p.z[k])
                result.edge[count] = p.edge[k]
                if keep_here:
                    result.edge[count] = 4 + plane
                count += 1
        result.count = count
        return result

    return SimpleNamespace(Polygon=Polygon, clip=clip)


@factory
def make(real):
    """Kernel ``box_box``; launch with dim (E, lanes)."""
    t = scalar_types(real)
    vec3, mat33, transform = t.vec3, t.mat33, t.transform
    Bodies, Parameters, Slots, Topology = t.Bodies, t.Parameters, t.Slots, t.Topology
    f, a, p = pair_functions(real), axes(real), polygon(real)
    shape_pose, reach, shape_velocity, write = f.shape_pose, f.reach, f.shape_velocity, f.write
    face_separation, edge_axis, edge_separation, column, rank = a.face_separation, a.edge_axis, a.edge_separation, a.column, a.rank
    inverse_mass, touching_depth = a.inverse_mass, a.touching_depth
    Polygon, clip = p.Polygon, p.clip

    @wp.func
    def face_contacts(
        slots: Slots,
        env: int,
        slot: int,
        ref: transform,
        hr: vec3,
        inc: transform,
        hi: vec3,
        axis: int,
        flip: bool,
        motion: vec3,
        share: real,
    ) -> int:
        """Clip the incident face of one box against face `axis` of the reference box; returns the number of points.

        motion: of the incident box relative to the reference box over the step, world axes. Open faces are clipped where they
        are when they meet, or boxes that come from the side would meet nothing. Until then a point of the one is beside its
        point of the other; share: how near the contact point is to the incident box's, 0 to 1.
        """
        rotation = wp.transpose(wp.quat_to_matrix(wp.transform_get_rotation(ref))) * wp.quat_to_matrix(wp.transform_get_rotation(inc))
        d = wp.transform_point(wp.transform_inverse(ref), wp.transform_get_translation(inc))
        side = real(1.0)
        face = 2 * axis
        if d[axis] < real(0.0):
            side = real(-1.0)
            face += 1
        along = vec3()
        open = face_separation(d, rotation, hr, hi, axis)
        move = wp.quat_rotate_inv(wp.transform_get_rotation(ref), motion)
        closing = -side * move[axis]
        if open > real(0.0) and closing > open:
            along = move * (open / closing)
            along[axis] = real(0.0)
        d += along
        # Incident face: the one whose outward normal points most against the reference normal.
        j = int(0)
        for k in range(1, 3):
            if wp.abs(rotation[axis, k]) > wp.abs(rotation[axis, j]) + real(1.0e-6):
                j = k
        top = real(-1.0)
        incident = 2 * j
        if side * rotation[axis, j] < real(0.0):
            top = real(1.0)
            incident += 1
        x_axis = (axis + 1) % 3
        y_axis = (axis + 2) % 3
        j1 = (j + 1) % 3
        j2 = (j + 2) % 3
        corners = Polygon()
        for k in range(4):
            s1 = real(1.0)
            s2 = real(1.0)
            if k == 1 or k == 2:
                s1 = real(-1.0)
            if k >= 2:
                s2 = real(-1.0)
            v = d + column(rotation, j) * (top * hi[j]) + column(rotation, j1) * (s1 * hi[j1]) + column(rotation, j2) * (s2 * hi[j2])
            corners.x[k] = v[x_axis]
            corners.y[k] = v[y_axis]
            corners.z[k] = side * v[axis] - hr[axis]
            corners.edge[k] = k
        corners.count = 4
        corners = clip(corners, 0, hr[x_axis])
        corners = clip(corners, 1, hr[x_axis])
        corners = clip(corners, 2, hr[y_axis])
        corners = clip(corners, 3, hr[y_axis])

        outward = vec3()
        outward[axis] = side
        normal = wp.transform_vector(ref, outward)
        if flip:
            normal = -normal
            face += 6
        for k in range(corners.count):
            local = vec3()
            local[x_axis] = corners.x[k]
            local[y_axis] = corners.y[k]
            local[axis] = side * (hr[axis] + real(0.5) * corners.z[k])
            before = corners.edge[(k + corners.count - 1) % corners.count]
            feature = ((face * 6 + incident) * 8 + before) * 8 + corners.edge[k]
            write(slots, env, slot + k, wp.transform_point(ref, local - share * along), normal, corners.z[k], feature)
        return corners.count

    @wp.struct
    class Crossing:
        """Where an edge of a and an edge of b pass each other, in the frame of a."""

        point: vec3
        normal: vec3  # from a to b
        gap: real
        feature: int
        i: int  # axis of the edge of a, and its middle
        edge_a: vec3
        j: int
        edge_b: vec3

    @wp.func
    def edge_crossing(d: vec3, rotation: mat33, ha: vec3, hb: vec3, i: int, j: int, axis: vec3) -> Crossing:
        """The edges along i and j that lie furthest towards the other box, `axis` is their common normal."""
        n = axis
        if wp.dot(n, d) < real(0.0):
            n = -n
        feature = 12 * 6 * 64 + (i * 3 + j) * 64
        pa = vec3()
        pb = d
        for k in range(3):
            if k != i:
                if n[k] >= real(0.0):
                    pa[k] = ha[k]
                    feature += 1 << k
                else:
                    pa[k] = -ha[k]
            if k != j:
                b_k = column(rotation, k)
                if wp.dot(n, b_k) <= real(0.0):
                    pb += b_k * hb[k]
                    feature += 8 << k
                else:
                    pb -= b_k * hb[k]
        ea = vec3()
        ea[i] = real(1.0)
        eb = column(rotation, j)
        c = wp.dot(ea, eb)
        offset = pb - pa
        s = (wp.dot(offset, ea) - c * wp.dot(offset, eb)) / (real(1.0) - c * c)
        r = (c * wp.dot(offset, ea) - wp.dot(offset, eb)) / (real(1.0) - c * c)
        result = Crossing()
        qa = pa + ea * wp.clamp(s, -ha[i], ha[i])
        qb = pb + eb * wp.clamp(r, -hb[j], hb[j])
        result.point = real(0.5) * (qa + qb)
        result.normal = n
        result.gap = wp.dot(n, offset)
        result.feature = feature
        result.i = i
        result.edge_a = pa
        result.j = j
        result.edge_b = pb
        return result

    @wp.func
    def edge_over_face(
        slots: Slots,
        env: int,
        slot: int,
        face: transform,
        h: vec3,
        c: vec3,
        e: vec3,
        half: real,
        n: vec3,
        near: vec3,
        sign: real,
        gap: real,
    ) -> int:
        """Where an edge that touches one side of a face leaves it again: an edge nearly parallel to a face lands on both.

        In the frame of the box that owns the face: c + t e, |t| <= half, is the edge, n points to its owner, near is where
        it crosses the side of the face. sign turns n into the normal from a to b. Returns the number of points, 0 or 1.
        """
        k = int(0)
        for m in range(1, 3):
            if wp.abs(n[m]) > wp.abs(n[k]):
                k = m
        side = wp.sign(n[k])
        low = -half
        high = half
        for m in range(3):
            if m != k and wp.abs(e[m]) > real(1.0e-9):
                low = wp.max(low, wp.min((-h[m] - c[m]) / e[m], (h[m] - c[m]) / e[m]))
                high = wp.min(high, wp.max((-h[m] - c[m]) / e[m], (h[m] - c[m]) / e[m]))
        crossed = wp.dot(near - c, e)
        t = high
        if wp.abs(low - crossed) > wp.abs(high - crossed):
            t = low
        p = c + t * e
        z = side * p[k] - h[k]
        if low >= high or wp.abs(t - crossed) < real(0.01) * half or z < gap:
            return 0
        outward = vec3()
        outward[k] = side
        p[k] = side * (h[k] + real(0.5) * z)
        feature = 13 * 6 * 64 + k * 2 + int(side > real(0.0))
        write(slots, env, slot, wp.transform_point(face, p), sign * wp.transform_vector(face, outward), z, feature)
        return 1

    @kernel()
    def box_box(
        topology: Topology,
        parameters: Parameters,
        bodies: Bodies,
        listed: wp.array2d(dtype=int),
        kind: int,
        h: real,
        slots: Slots,
        lanes: int,
        stride: int,
    ):
        start, lane = wp.tid()
        for env in range(start, slots.gap.shape[0], stride):
            for index in range(listed[env, kind] + lane, listed[env, kind + 1], lanes):
                pair = listed[env, index]
                sa = topology.pairs[pair, 0]
                sb = topology.pairs[pair, 1]
                ha = topology.shape_size[sa]
                hb = topology.shape_size[sb]
                xa = shape_pose(topology, bodies, env, sa)
                xb = shape_pose(topology, bodies, env, sb)
                ca = wp.transform_get_translation(xa)
                cb = wp.transform_get_translation(xb)
                slot = topology.pair_slots[pair]
                count = int(0)

                ra = wp.length(ha)
                rb = wp.length(hb)
                apart = ra + reach(topology, bodies, env, sa, ca, ra, h) + rb + reach(topology, bodies, env, sb, cb, rb, h)
                if wp.length(cb - ca) < apart:
                    rotation = wp.transpose(wp.quat_to_matrix(wp.transform_get_rotation(xa))) * wp.quat_to_matrix(
                        wp.transform_get_rotation(xb)
                    )
                    d = wp.transform_point(wp.transform_inverse(xa), cb)
                    # Axes are compared where the present velocities lead in a step. Now, a box that slides from one tile to the
                    # next is separated from the next by its side, and would trip over it; then, it overlaps the side by
                    # millimetres and the top by nothing.
                    u = shape_velocity(topology, bodies, bodies.velocity, env, sb, cb) - shape_velocity(
                        topology, bodies, bodies.velocity, env, sa, ca
                    )
                    ahead = d + h * wp.quat_rotate_inv(wp.transform_get_rotation(xa), u)
                    back = wp.transpose(rotation)
                    d_b = back * d
                    ahead_b = back * ahead
                    # Prefer faces over edges and a over b, so that equal separations do not flip from step to step.
                    smallest = wp.min(wp.min(ha), wp.min(hb))
                    bias = real(1.0e-3) * smallest
                    inverse_a = inverse_mass(topology, bodies, env, sa)
                    inverse_b = inverse_mass(topology, bodies, env, sb)
                    gravity = parameters.gravity[env % parameters.gravity.shape[0]]
                    stiffness = parameters.pair_contact[env % parameters.pair_contact.shape[0], pair][0]
                    depth = touching_depth(gravity, inverse_a, inverse_b, stiffness)
                    touching = wp.clamp(depth[1], depth[0] * smallest, depth[2] * smallest)
                    far = real(2.0) * apart
                    best = real(-2.0) * far
                    axis = int(0)
                    for k in range(3):
                        s = rank(face_separation(d, rotation, ha, hb, k), face_separation(ahead, rotation, ha, hb, k), touching, far)
                        if s > best:
                            best = s
                            axis = k
                    best_b = best + bias
                    for k in range(3):
                        s = rank(face_separation(d_b, back, hb, ha, k), face_separation(ahead_b, back, hb, ha, k), touching, far)
                        if s > best_b:
                            best_b = s
                            best = s
                            axis = 3 + k
                    best_edge = best + bias
                    for ij in range(9):
                        n = edge_axis(rotation, ij // 3, ij % 3)
                        if wp.dot(n, n) > real(0.0):
                            s = rank(edge_separation(d, rotation, ha, hb, n), edge_separation(ahead, rotation, ha, hb, n), touching, far)
                            if s > best_edge:
                                best_edge = s
                                axis = 6 + ij
                    # Levers are those of the lighter box, which turns more easily.
                    share = real(0.5)
                    if inverse_a + inverse_b > real(0.0):
                        share = inverse_b / (inverse_a + inverse_b)
                    if axis < 3:
                        count = face_contacts(slots, env, slot, xa, ha, xb, hb, axis, False, h * u, share)
                    elif axis < 6:
                        count = face_contacts(slots, env, slot, xb, hb, xa, ha, axis - 3, True, -h * u, real(1.0) - share)
                    else:
                        i = (axis - 6) // 3
                        j = (axis - 6) % 3
                        crossing = edge_crossing(d, rotation, ha, hb, i, j, edge_axis(rotation, i, j))
                        normal = wp.transform_vector(xa, crossing.normal)
                        write(slots, env, slot, wp.transform_point(xa, crossing.point), normal, crossing.gap, crossing.feature)
                        count = 1
                        # The edge of b over a face of a, and that of a over a face of b.
                        n = crossing.normal
                        near = crossing.point
                        count += edge_over_face(
                            slots,
                            env,
                            slot + count,
                            xa,
                            ha,
                            crossing.edge_b,
                            column(rotation, crossing.j),
                            hb[crossing.j],
                            n,
                            near,
                            real(1.0),
                            crossing.gap,
                        )
                        c = back * (crossing.edge_a - d)
                        count += edge_over_face(
                            slots,
                            env,
                            slot + count,
                            xb,
                            hb,
                            c,
                            column(back, crossing.i),
                            ha[crossing.i],
                            -(back * n),
                            back * (near - d),
                            real(-1.0),
                            crossing.gap,
                        )
                for k in range(count, 8):
                    slots.gap[env, slot + k] = real(NO_POINT)

    return box_box
