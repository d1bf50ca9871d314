# SPDX-License-Identifier: Apache-2.0
"""Gap functions of balls and capsules with cylinders, cones and convex hulls.

A ball or capsule is a point or a segment (its core) with a radius, so what counts is the nearest point of the other shape to the core:
the distance algorithm of Gilbert, Johnson and Keerthi (1988), as the core is a radius away from what it touches. A core inside the
other shape leaves by ``shapes.part``. Slots of a pair, which are those of ``capsule``:

====================  =======================================================================================
sphere - convex       0: the nearest point
capsule - convex      0, 1: both ends of what of the core lies over a face or side (all of it where it lies over none);
                      2: the nearest point, where it is nearer than both
====================  =======================================================================================
"""

import functools
from types import SimpleNamespace

import warp as wp

from .capsule import covered_within
from .collide import NO_POINT, pair_functions
from .declare import factory, kernel
from .shapes import PIECE, functions
from .types import scalar_types

# Of the size: a core closer than this to the other shape has no direction of its own to it.
MEETS = wp.constant(1.0e-7)
# Cosine: a core lies over a face that is square to the shortest way to within this.
OVER = wp.constant(0.99)
# Part of the square of the distance that the distance algorithm leaves.
NEAREST = {wp.float64: 1.0e-14, wp.float32: 1.0e-6}
ROUNDS = 48


@functools.cache
def distance(real) -> SimpleNamespace:
    """The nearest point of a convex shape to a segment."""
    t = scalar_types(real)
    vec3 = t.vec3
    s = functions(real)
    Hulls, support = s.Hulls, s.support

    @wp.struct
    class Near:
        """In the frame of the convex shape."""

        way: vec3  # from the core to the shape; zero where they meet
        at: real  # of the core's point, m from its middle
        point: vec3  # of the shape

    @wp.func
    def on_line(p: vec3, q: vec3) -> real:
        """Parameter of the point of p q that is nearest to the origin."""
        e = q - p
        length = wp.dot(e, e)
        result = real(0.0)
        if length > real(0.0):
            result = wp.clamp(-wp.dot(p, e) / length, real(0.0), real(1.0))
        return result

    @wp.func
    def on_triangle(a: vec3, b: vec3, c: vec3) -> vec3:
        """Weights of the corners for the point that is nearest to the origin (Ericson 2005, 5.1.5)."""
        ab = b - a
        ac = c - a
        n = wp.cross(ab, ac)
        inside = bool(False)
        result = vec3()
        area = wp.dot(n, n)
        if area > real(0.0):
            wa = wp.dot(wp.cross(b, c), n) / area
            wb = wp.dot(wp.cross(c, a), n) / area
            wc = wp.dot(wp.cross(a, b), n) / area
            if wa >= real(0.0) and wb >= real(0.0) and wc >= real(0.0):
                inside = True
                result = vec3(wa, wb, wc)
        if not inside:
            s_ab = on_line(a, b)
            s_bc = on_line(b, c)
            s_ca = on_line(c, a)
            d_ab = wp.length_sq(a + s_ab * ab)
            d_bc = wp.length_sq(b + s_bc * (c - b))
            d_ca = wp.length_sq(c + s_ca * (a - c))
            if d_ab <= d_bc and d_ab <= d_ca:
                result = vec3(real(1.0) - s_ab, s_ab, real(0.0))
            elif d_bc <= d_ca:
                result = vec3(real(0.0), real(1.0) - s_bc, s_bc)
            else:
                result = vec3(s_ca, real(0.0), real(1.0) - s_ca)
        return result

    @wp.func
    def nearest(hulls: Hulls, shape: int, size: vec3, c: vec3, e: vec3, half: real) -> Near:
        """Of the shape to the core c + t e, |t| <= half, in the frame of the shape."""
        w = wp.zeros(shape=(4,), dtype=vec3)  # of shape less core
        on_shape = wp.zeros(shape=(4,), dtype=vec3)
        at = wp.zeros(shape=(4,), dtype=real)
        weight = wp.zeros(shape=(4,), dtype=real)
        small = real(MEETS) * (wp.length(size) + half)
        v = -c
        if wp.dot(v, v) == real(0.0):
            v = vec3(real(0.0), real(0.0), real(1.0))
        count = int(0)
        meets = bool(False)
        going = bool(True)
        rounds = int(0)
        while going:
            p = support(hulls, shape, size, -v)
            x = half
            if wp.dot(v, e) < real(0.0):
                x = -half
            q = p - c - x * e
            going = rounds < ROUNDS
            if count > 0 and wp.dot(v, v) - wp.dot(v, q) <= real(wp.static(NEAREST[real])) * wp.dot(v, v):
                going = False
            for k in range(count):
                if w[k] == q:
                    going = False
            if going:
                rounds += 1
                w[count] = q
                on_shape[count] = p
                at[count] = x
                count += 1
                for k in range(4):
                    weight[k] = real(0.0)
                if count == 1:
                    weight[0] = real(1.0)
                elif count == 2:
                    weight[1] = on_line(w[0], w[1])
                    weight[0] = real(1.0) - weight[1]
                elif count == 3:
                    b = on_triangle(w[0], w[1], w[2])
                    for k in range(3):
                        weight[k] = b[k]
                else:
                    # Of the four faces, one that the origin is beyond.
                    least = real(1.0e30)
                    meets = True
                    for k in range(4):
                        i = (k + 1) % 4
                        j = (k + 2) % 4
                        m = (k + 3) % 4
                        n = wp.cross(w[j] - w[i], w[m] - w[i])
                        if wp.dot(n, w[k] - w[i]) * wp.dot(n, w[i]) >= real(0.0):
                            b = on_triangle(w[i], w[j], w[m])
                            there = wp.length_sq(b[0] * w[i] + b[1] * w[j] + b[2] * w[m])
                            meets = False
                            if there < least:
                                least = there
                                weight[k] = real(0.0)
                                weight[i] = b[0]
                                weight[j] = b[1]
                                weight[m] = b[2]
                if meets:
                    going = False
                else:
                    v = vec3()
                    for k in range(count):
                        v += weight[k] * w[k]
                    kept = int(0)
                    for k in range(count):
                        if weight[k] > real(0.0):
                            w[kept] = w[k]
                            on_shape[kept] = on_shape[k]
                            at[kept] = at[k]
                            weight[kept] = weight[k]
                            kept += 1
                    count = kept
                    if wp.length_sq(v) <= small * small:
                        meets = True
                        going = False
        result = Near()
        if not meets:
            result.way = v
            for k in range(count):
                result.at += weight[k] * at[k]
                result.point += weight[k] * on_shape[k]
        return result

    return SimpleNamespace(Near=Near, nearest=nearest)


@functools.cache
def meeting(real):
    """Function ``meet``: where a ball or capsule touches a convex shape, or could."""
    t = scalar_types(real)
    vec3, transform, spatial = t.vec3, t.transform, t.spatial
    f, s = pair_functions(real), functions(real)
    bend, rotation, Hulls, part, face_towards, face_normal = f.bend, f.rotation, s.Hulls, s.part, s.face_towards, s.face_normal
    sides, side_plane, turned = s.sides, s.side_plane, s.turned
    nearest = distance(real).nearest

    @wp.func
    def velocity(twist: spatial, arm: vec3) -> vec3:
        return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), arm)

    @wp.func
    def carried(twist: spatial, arm: vec3, h: real) -> vec3:
        """How far a point is carried in h, world axes."""
        return h * wp.spatial_top(twist) + (wp.quat_rotate(rotation(h * wp.spatial_bottom(twist)), arm) - arm)

    @wp.func
    def meet(
        hulls: Hulls,
        a: int,
        b: int,
        size_a: vec3,
        size_b: vec3,
        xa: transform,
        xb: transform,
        com_a: vec3,
        com_b: vec3,
        twist_a: spatial,
        twist_b: spatial,
        half: real,
        near: real,
        h: real,
        normals: wp.array(dtype=vec3),
        at: wp.array(dtype=vec3),
        gaps: wp.array(dtype=real),
        bends: wp.array(dtype=real),
        features: wp.array(dtype=int),
    ):
        """Fills three contacts, those of a capsule's ends and its nearest point, or the first alone where half, of its core, is zero.

        World axes; the gap is NO_POINT where there is none. near: how far from each other the core and b still matter, m.
        """
        number = int(1)
        if half > real(0.0):
            number = 3
        for k in range(number):
            gaps[k] = real(NO_POINT)
        radius = size_a[0]
        turn = wp.transform_get_rotation(xb)
        inverse = wp.transform_inverse(xb)
        c = wp.transform_point(inverse, wp.transform_get_translation(xa))
        e = wp.transform_vector(inverse, wp.transform_vector(xa, vec3(real(0.0), real(0.0), real(1.0))))
        further = rotation(wp.quat_rotate_inv(turn, h * wp.spatial_bottom(twist_b)))
        frame_move = carried(twist_b, wp.transform_get_translation(xb) - com_b, h)
        # The nearest point of all comes first, then both ends, as balls.
        low = -half
        high = half
        low_end = int(0)
        high_end = int(0)
        seams = int(0)
        least = real(1.0e30)
        looking = bool(True)
        for k in range(number):
            x = real(0.0)
            length = half
            feature = int(0)
            to = int(0)
            if number > 1:
                to = (k + 2) % 3
            if k == 1:
                x = low
                feature = low_end
                length = real(0.0)
            elif k == 2:
                x = high
                feature = high_end
                length = real(0.0)
            found = nearest(hulls, b, size_b, c + x * e, e, length)
            away = wp.length(found.way)
            if away > near:
                if k == 0:
                    looking = False
            elif away > real(0.0) and looking:
                way = found.way / away
                x += found.at
                normal = wp.transform_vector(xb, way)
                gap = away - radius
                core = wp.transform_point(xb, c + x * e)
                closing = h * (velocity(twist_a, core - com_a) - velocity(twist_b, core - com_b))
                move = carried(twist_a, core - com_a, h) - frame_move
                ahead = wp.quat_rotate_inv(further, c + x * e + wp.quat_rotate_inv(turn, move))
                then = nearest(hulls, b, size_b, ahead, e, real(0.0))
                way_ahead = -wp.quat_rotate(turn, wp.quat_rotate(further, then.way))
                normals[to] = normal
                at[to] = wp.transform_point(xb, found.point) - normal * (real(0.5) * gap)
                gaps[to] = gap
                bends[to] = bend(gap, away, -normal, closing, wp.length(then.way), way_ahead)
                features[to] = feature
                if k == 0 and number > 1:
                    least = gap
                    # What of the core lies over a face, or along a round side.
                    face = face_towards(hulls, b, -way)
                    if -wp.dot(way, face_normal(hulls, b, face)) > real(OVER):
                        if hulls.kind[b] == PIECE:
                            seams = hulls.seam[face]
                        for m in range(sides(hulls, b, face)):
                            plane = side_plane(hulls, b, size_b, face, m)
                            n = vec3(plane[0], plane[1], plane[2])
                            slope = wp.dot(n, e)
                            over = wp.dot(n, c) - plane[3]
                            if slope > real(1.0e-6) and -over / slope < high and -over / slope > low:
                                high = -over / slope
                                high_end = 1 + m
                            elif slope < real(-1.0e-6) and -over / slope > low and -over / slope < high:
                                low = -over / slope
                                low_end = 1 + m
                    elif turned(hulls.kind[b]) and wp.abs(e[2]) > real(OVER):
                        one = (-size_b[1] - c[2]) / e[2]
                        two = (size_b[1] - c[2]) / e[2]
                        if one > two:
                            x = one
                            one = two
                            two = x
                        if one > low and one < high:
                            low = one
                            low_end = 1
                        if two < high and two > low:
                            high = two
                            high_end = 2
            elif k == 0:
                # The core is inside, or in the plane of a triangle, which it leaves on that one's outside.
                looking = False
                if hulls.kind[b] == PIECE:
                    normals[to] = -wp.transform_vector(xb, hulls.normal[hulls.first_face[b]])
                    at[to] = wp.transform_point(xb, c)
                    gaps[to] = -radius
                else:
                    d = wp.transform_point(wp.transform_inverse(xa), wp.transform_get_translation(xb))
                    axes_b = wp.transpose(wp.quat_to_matrix(wp.transform_get_rotation(xa))) * wp.quat_to_matrix(turn)
                    out = part(hulls, a, b, size_a, size_b, d, axes_b, vec3(), wp.length(size_a) + wp.length(size_b))
                    gaps[to] = out.separation - radius
                    normals[to] = wp.transform_vector(xa, out.normal)
                    at[to] = wp.transform_point(xa, out.point) + normals[to] * (radius + real(0.5) * gaps[to])
                bends[to] = real(0.0)
                features[to] = 1
        if number > 1 and looking and least > wp.min(gaps[0], gaps[1]) - real(wp.static(covered_within(real))) * radius:
            gaps[2] = real(NO_POINT)
        # Where the surface goes on nothing ends.
        if low_end > 0 and (seams & (1 << (low_end - 1))) != 0:
            gaps[0] = real(NO_POINT)
        if high_end > 0 and (seams & (1 << (high_end - 1))) != 0:
            gaps[1] = real(NO_POINT)

    return meet


@factory
def make(real):
    """Kernel ``rounded``; launch with dim (E, lanes)."""
    t = scalar_types(real)
    vec3 = t.vec3
    Bodies, Parameters, Slots, Topology = t.Bodies, t.Parameters, t.Slots, t.Topology
    f, Hulls, meet = pair_functions(real), functions(real).Hulls, meeting(real)
    shape_pose, shape_motion, reach, write_bent = f.shape_pose, f.shape_motion, f.reach, f.write_bent

    @kernel()
    def rounded(
        topology: Topology,
        parameters: Parameters,
        bodies: Bodies,
        listed: wp.array2d(dtype=int),
        kind: int,
        h: real,
        slots: Slots,
        hulls: Hulls,
        lanes: int,
        stride: int,
    ):
        start, lane = wp.tid()
        for env in range(start, slots.gap.shape[0], stride):
            for index in range(listed[env, kind] + lane, listed[env, kind + 1], lanes):
                pair = listed[env, index]
                sa = topology.pairs[pair, 0]
                sb = topology.pairs[pair, 1]
                slot = topology.pair_slots[pair]
                number = topology.pair_slots[pair + 1] - slot
                size_a = topology.shape_size[sa]
                size_b = topology.shape_size[sb]
                half = real(0.0)
                if number > 1:
                    half = size_a[1]
                xa = shape_pose(topology, bodies, env, sa)
                xb = shape_pose(topology, bodies, env, sb)
                near = size_a[0] + reach(topology, bodies, env, sa, wp.transform_get_translation(xa), size_a[0] + half, h)
                near += reach(topology, bodies, env, sb, wp.transform_get_translation(xb), wp.length(size_b), h)
                com_a, twist_a = shape_motion(topology, bodies, env, sa)
                com_b, twist_b = shape_motion(topology, bodies, env, sb)
                normals = wp.zeros(shape=(3,), dtype=vec3)
                at = wp.zeros(shape=(3,), dtype=vec3)
                gaps = wp.zeros(shape=(3,), dtype=real)
                bends = wp.zeros(shape=(3,), dtype=real)
                features = wp.zeros(shape=(3,), dtype=int)
                meet(
                    hulls, sa, sb, size_a, size_b, xa, xb, com_a, com_b, twist_a, twist_b, half, near, h, normals, at, gaps, bends, features
                )
                for k in range(number):
                    if gaps[k] < real(NO_POINT):
                        write_bent(slots, env, slot + k, at[k], normals[k], gaps[k], bends[k], features[k])
                    else:
                        slots.gap[env, slot + k] = real(NO_POINT)

    return rounded
