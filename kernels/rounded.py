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
from .shapes import functions
from .types import OPTIONS, scalar_types

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
def make(real):
    """Kernel ``rounded``; launch with dim (E, pairs of a kind)."""
    t = scalar_types(real)
    vec3 = t.vec3
    Bodies, Parameters, Slots, Topology = t.Bodies, t.Parameters, t.Slots, t.Topology
    f, s = pair_functions(real), functions(real)
    shape_pose, reach, shape_velocity, write_bent = f.shape_pose, f.reach, f.shape_velocity, f.write_bent
    far_apart, set_apart, bend, shape_turn, rotation, shift = f.far_apart, f.set_apart, f.bend, f.shape_turn, f.rotation, f.shift
    Hulls, part, face_towards, face_normal = s.Hulls, s.part, s.face_towards, s.face_normal
    sides, side_plane, turned = s.sides, s.side_plane, s.turned
    nearest = distance(real).nearest

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def rounded(topology: Topology, parameters: Parameters, bodies: Bodies, first: int, h: real, slots: Slots, hulls: Hulls, stride: int):
        start, index = wp.tid()
        for env in range(start, slots.gap.shape[0], stride):
            pair = first + index
            sa = topology.pairs[pair, 0]
            sb = topology.pairs[pair, 1]
            if far_apart(bodies, env, sa, sb):
                set_apart(topology, slots, env, pair)
                continue
            slot = topology.pair_slots[pair]
            number = topology.pair_slots[pair + 1] - slot
            for k in range(number):
                slots.gap[env, slot + k] = real(NO_POINT)
            size = topology.shape_size[sb]
            radius = topology.shape_size[sa][0]
            half = real(0.0)
            if number > 1:
                half = topology.shape_size[sa][1]
            xa = shape_pose(topology, bodies, env, sa)
            xb = shape_pose(topology, bodies, env, sb)
            turn = wp.transform_get_rotation(xb)
            inverse = wp.transform_inverse(xb)
            c = wp.transform_point(inverse, wp.transform_get_translation(xa))
            e = wp.transform_vector(inverse, wp.transform_vector(xa, vec3(real(0.0), real(0.0), real(1.0))))
            further = rotation(wp.quat_rotate_inv(turn, shape_turn(topology, bodies, env, sb, h)))
            carried = shift(topology, bodies, env, sb, wp.transform_get_translation(xb), h)
            near = radius + reach(topology, bodies, env, sa, wp.transform_get_translation(xa), radius + half, h)
            near += reach(topology, bodies, env, sb, wp.transform_get_translation(xb), wp.length(size), h)

            # The nearest point of all comes first, then both ends, as balls.
            low = -half
            high = half
            low_end = int(0)
            high_end = int(0)
            least = real(1.0e30)
            looking = bool(True)
            for k in range(number):
                x = real(0.0)
                length = half
                feature = int(0)
                to = slot
                if number > 1:
                    to = slot + (k + 2) % 3
                if k == 1:
                    x = low
                    feature = low_end
                    length = real(0.0)
                elif k == 2:
                    x = high
                    feature = high_end
                    length = real(0.0)
                found = nearest(hulls, sb, size, c + x * e, e, length)
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
                    u = shape_velocity(topology, bodies, bodies.velocity, env, sa, core)
                    closing = h * (u - shape_velocity(topology, bodies, bodies.velocity, env, sb, core))
                    move = shift(topology, bodies, env, sa, core, h) - carried
                    ahead = wp.quat_rotate_inv(further, c + x * e + wp.quat_rotate_inv(turn, move))
                    then = nearest(hulls, sb, size, ahead, e, real(0.0))
                    way_ahead = -wp.quat_rotate(turn, wp.quat_rotate(further, then.way))
                    left = bend(gap, away, -normal, closing, wp.length(then.way), way_ahead)
                    point = wp.transform_point(xb, found.point) - normal * (real(0.5) * gap)
                    write_bent(slots, env, to, point, normal, gap, left, feature)
                    if k == 0 and number > 1:
                        least = gap
                        # What of the core lies over a face, or along a round side.
                        kind = hulls.kind[sb]
                        face = face_towards(hulls, sb, -way)
                        if -wp.dot(way, face_normal(hulls, sb, face)) > real(OVER):
                            for m in range(sides(hulls, sb, face)):
                                plane = side_plane(hulls, sb, size, face, m)
                                n = vec3(plane[0], plane[1], plane[2])
                                slope = wp.dot(n, e)
                                over = wp.dot(n, c) - plane[3]
                                if slope * half > real(1.0e-6) * half and -over / slope < high and -over / slope > low:
                                    high = -over / slope
                                    high_end = 1 + m
                                elif slope * half < real(-1.0e-6) * half and -over / slope > low and -over / slope < high:
                                    low = -over / slope
                                    low_end = 1 + m
                        elif turned(kind) and wp.abs(e[2]) > real(OVER):
                            one = (-size[1] - c[2]) / e[2]
                            two = (size[1] - c[2]) / e[2]
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
                    # The core is inside.
                    looking = False
                    into = wp.transform_inverse(xa)
                    d = wp.transform_point(into, wp.transform_get_translation(xb))
                    axes_b = wp.transpose(wp.quat_to_matrix(wp.transform_get_rotation(xa))) * wp.quat_to_matrix(turn)
                    size_a = topology.shape_size[sa]
                    out = part(hulls, sa, sb, size_a, size, d, axes_b, vec3(), wp.length(size_a) + wp.length(size))
                    normal = wp.transform_vector(xa, out.normal)
                    gap = out.separation - radius
                    point = wp.transform_point(xa, out.point) + normal * (radius + real(0.5) * gap)
                    write_bent(slots, env, to, point, normal, gap, real(0.0), 1)
            if number > 1 and looking:
                ends = wp.min(slots.gap[env, slot], slots.gap[env, slot + 1])
                if least > ends - real(wp.static(covered_within(real))) * radius:
                    slots.gap[env, slot + 2] = real(NO_POINT)

    return rounded
