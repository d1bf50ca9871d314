# SPDX-License-Identifier: Apache-2.0
"""Gap functions of capsules: spheres of radius r swept along a segment, |t| <= half on the shape's z axis; size = (r, half, 0).

A capsule touches where its segment is nearest to the other shape. Where the segment runs along that shape (a face, an edge,
the side of another capsule) the nearest point is any of a stretch, or jumps from one end of it to the other with the last
bits; so both ends of the stretch get a point each, which is what a capsule rests on without rocking. Slots of a pair:

====================  =======================================================================================
plane - capsule       0, 1: the ends at t = -half and half
sphere - capsule      0: the nearest point
box - capsule,        0, 1: the lower and the upper end of the stretch; feature: what ends it, the capsule (0) or a side
capsule - capsule     of the other shape; 2: the nearest point, where it is nearer than both ends (covered_within)
====================  =======================================================================================
"""

import functools
from types import SimpleNamespace

import warp as wp

from .collide import NO_POINT, pair_functions
from .declare import factory, kernel
from .types import scalar_types

# Of the radius: a segment that strays from a side by less than this runs along it. The distance it misses is the square
# of it over twice the radius, less than what "covered" allows.
ALONG = wp.constant(1.0e-4)
# Of the radius: a segment closer than this to the other shape has no direction of its own to it.
MEETS = wp.constant(1.0e-4)


def covered_within(real) -> float:
    """Of the radius: an end of a stretch this close to the least distance stands for the nearest point.

    What it misses grows with the square of the tilt: above the static deflections of a capsule at rest, which must not change
    its points, and above round-off; below a tilt of 0.14 mrad in float64, 4 mrad in float32.
    """
    return 1.0e-8 if real is wp.float64 else 1.0e-5


@functools.cache
def segment_functions(real) -> SimpleNamespace:
    """Points of a segment c + t e, |t| <= half, e a unit vector, that are nearest to other shapes."""
    t = scalar_types(real)
    vec3 = t.vec3
    outside_box = pair_functions(real).outside_box

    @wp.struct
    class Stretch:
        """Part of a segment that runs along another shape."""

        low: real  # parameters of its ends, m from the middle of the segment; low > high: there is none
        high: real
        low_end: int  # what ends it: 0 = the segment itself, 1 + 2 m = the lower side of direction m, 2 + 2 m = its upper side
        high_end: int

    @wp.func
    def whole(half: real) -> Stretch:
        s = Stretch()
        s.low = -half
        s.high = half
        return s

    @wp.func
    def cut(s: Stretch, c: real, e: real, half: real, wide: real, m: int, slack: real) -> Stretch:
        """Keep what lies between the sides -wide and wide of direction m, in which the segment is at c + t e."""
        if wp.abs(e) * half <= slack:
            if wp.abs(c) > wide + slack:
                s.high = s.low - real(1.0)
        else:
            first = (-wide - c) / e
            last = (wide - c) / e
            first_end = 1 + 2 * m
            last_end = 2 + 2 * m
            if e < real(0.0):
                first = (wide - c) / e
                last = (-wide - c) / e
                first_end = 2 + 2 * m
                last_end = 1 + 2 * m
            # An end that lies on the side keeps its identity, whatever the last bits say.
            if first > s.low + real(1.0e-4) * half:
                s.low = first
                s.low_end = first_end
            if last < s.high - real(1.0e-4) * half:
                s.high = last
                s.high_end = last_end
        return s

    @wp.func
    def nearest_to_box(c: vec3, e: vec3, half: real, size: vec3) -> real:
        """Parameter of the point nearest to a box, in the frame of the box.

        The slope of half the squared distance, e . outside(t), never falls and is straight between the planes of the sides:
        bisect over these planes, then interpolate.
        """
        low = -half
        high = half
        slope_low = wp.dot(e, outside_box(c - half * e, size))
        slope_high = wp.dot(e, outside_box(c + half * e, size))
        result = low
        if slope_low < real(0.0):
            result = high
            if slope_high > real(0.0):
                for k in range(6):
                    m = k // 2
                    if e[m] != real(0.0):
                        at = (real(2 * (k % 2) - 1) * size[m] - c[m]) / e[m]
                        if at > low and at < high:
                            slope = wp.dot(e, outside_box(c + at * e, size))
                            if slope < real(0.0):
                                low = at
                                slope_low = slope
                            else:
                                high = at
                                slope_high = slope
                result = low + (high - low) * slope_low / (slope_low - slope_high)
        return result

    @wp.func
    def outside_segment(p: vec3, e: vec3, half: real) -> vec3:
        """From the nearest point of a segment about the origin to p."""
        return p - e * wp.clamp(wp.dot(p, e), -half, half)

    @wp.func
    def nearest_to_segment(c: vec3, e: vec3, half: real, axis: vec3, other: real) -> real:
        """Parameter of the point nearest to the segment s axis, |s| <= other, about the origin."""
        across = wp.cross(axis, e)
        sine = wp.length_sq(across)
        s = real(0.0)
        if sine > real(0.0):
            s = wp.clamp(wp.dot(c, wp.cross(e, across)) / sine, -other, other)
        at = wp.clamp(wp.dot(axis * s - c, e), -half, half)
        s = wp.clamp(wp.dot(c + at * e, axis), -other, other)
        return wp.clamp(wp.dot(axis * s - c, e), -half, half)

    @wp.func
    def perpendicular(e: vec3) -> vec3:
        """Some unit vector across e."""
        k = int(0)
        for m in range(1, 3):
            if wp.abs(e[m]) < wp.abs(e[k]):
                k = m
        other = vec3()
        other[k] = real(1.0)
        return wp.normalize(wp.cross(e, other))

    @wp.func
    def direction(out: vec3, distance: real, least: real, otherwise: vec3) -> vec3:
        n = otherwise
        if distance > least:
            n = out / distance
        return n

    return SimpleNamespace(
        Stretch=Stretch,
        whole=whole,
        cut=cut,
        nearest_to_box=nearest_to_box,
        outside_segment=outside_segment,
        nearest_to_segment=nearest_to_segment,
        perpendicular=perpendicular,
        direction=direction,
    )


@factory
def make(real) -> dict:
    """Kernels by the names of the two shape types; launch with dim (E, lanes), as those of ``collide``."""
    t = scalar_types(real)
    vec3, transform = t.vec3, t.transform
    Bodies, Parameters, Slots, Topology = t.Bodies, t.Parameters, t.Slots, t.Topology
    f, g = pair_functions(real), segment_functions(real)
    shape_pose, reach, shape_velocity = f.shape_pose, f.reach, f.shape_velocity
    shape_turn, rotation, shift = f.shape_turn, f.rotation, f.shift
    write, write_bent = f.write, f.write_bent
    outside_box, bend, whole, cut, direction, perpendicular = f.outside_box, f.bend, g.whole, g.cut, g.direction, g.perpendicular
    outside_segment, nearest_to_box, nearest_to_segment = g.outside_segment, g.nearest_to_box, g.nearest_to_segment
    covered_part = wp.constant(covered_within(real))

    @wp.struct
    class Motion:
        """Motion of a capsule b and another shape a over a step at present velocities, world axes, and where it leads."""

        com_a: vec3
        com_b: vec3
        shift: vec3  # of com_b relative to com_a, m
        turn_a: vec3  # rad
        turn_b: vec3
        distance: real  # of the segment from the other shape, then
        normal: vec3  # to the segment, then; of that length
        near: real  # what is further away than this gets no row

    @wp.func
    def z_axis(pose: transform) -> vec3:
        return wp.transform_vector(pose, vec3(real(0.0), real(0.0), real(1.0)))

    @wp.func
    def relative_motion(topology: Topology, bodies: Bodies, env: int, a: int, b: int, h: real) -> Motion:
        """Where it leads is left open."""
        motion = Motion()
        motion.turn_a = shape_turn(topology, bodies, env, a, h)
        motion.turn_b = shape_turn(topology, bodies, env, b, h)
        body_a = topology.shape_body[a]
        body_b = topology.shape_body[b]
        if body_a >= 0:
            motion.com_a = bodies.com[env, body_a]
            motion.shift -= h * wp.spatial_top(bodies.velocity[env, body_a])
        if body_b >= 0:
            motion.com_b = bodies.com[env, body_b]
            motion.shift += h * wp.spatial_top(bodies.velocity[env, body_b])
        return motion

    @wp.func
    def write_near(
        slots: Slots, env: int, slot: int, motion: Motion, p: vec3, n: vec3, distance: real, radii: real, radius: real, feature: int
    ):
        """A point of the segment, p in the world, at a distance along n from the other shape; radii: of both together."""
        gap = distance - radii
        if gap < motion.near:
            carried = wp.cross(motion.turn_b, p - motion.com_b)
            along = motion.shift + carried  # of p relative to com_a
            around = wp.cross(motion.turn_a, p - motion.com_a)
            left = bend(gap, distance, n, along - around, motion.distance, motion.normal)
            # Another point of the segment may come nearer than this one; only what turning takes from this one counts here.
            curl = wp.cross(motion.turn_b, carried) - real(2.0) * wp.cross(motion.turn_a, along) + wp.cross(motion.turn_a, around)
            left = wp.max(left, wp.min(real(0.5) * wp.dot(n, curl), real(0.0)))
            write_bent(slots, env, slot, p - n * (radius + real(0.5) * gap), n, gap, left, feature)

    @kernel()
    def plane_capsule(
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
                plane = shape_pose(topology, bodies, env, topology.pairs[pair, 0])
                capsule = shape_pose(topology, bodies, env, topology.pairs[pair, 1])
                size = topology.shape_size[topology.pairs[pair, 1]]
                normal = z_axis(plane)
                for k in range(2):
                    centre = wp.transform_point(capsule, vec3(real(0.0), real(0.0), real(2 * k - 1) * size[1]))
                    gap = wp.dot(normal, centre - wp.transform_get_translation(plane)) - size[0]
                    point = centre - normal * (size[0] + real(0.5) * gap)
                    write(slots, env, topology.pair_slots[pair] + k, point, normal, gap, 0)

    @kernel()
    def sphere_capsule(
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
                ra = topology.shape_size[sa][0]
                rb = topology.shape_size[sb][0]
                half = topology.shape_size[sb][1]
                centre = wp.transform_get_translation(shape_pose(topology, bodies, env, sa))
                capsule = shape_pose(topology, bodies, env, sb)
                axis = z_axis(capsule)
                p = centre - wp.transform_get_translation(capsule)
                out = outside_segment(p, axis, half)
                distance = wp.length(out)
                n = direction(out, distance, real(MEETS) * rb, perpendicular(axis))  # from the capsule to the sphere
                gap = distance - ra - rb
                u = shape_velocity(topology, bodies, bodies.velocity, env, sa, centre)
                closing = h * (u - shape_velocity(topology, bodies, bodies.velocity, env, sb, centre))
                move = shift(topology, bodies, env, sa, centre, h) - shift(topology, bodies, env, sb, centre - p, h)
                ahead = outside_segment(p + move, wp.quat_rotate(rotation(shape_turn(topology, bodies, env, sb, h)), axis), half)
                b = bend(gap, distance, n, closing, wp.length(ahead), ahead)
                write_bent(slots, env, topology.pair_slots[pair], centre - n * (ra + real(0.5) * gap), -n, gap, b, 0)

    @wp.func
    def beside_box(slots: Slots, env: int, slot: int, box: transform, size: vec3, c: vec3, e: vec3, half: real, r: real, motion: Motion):
        """Points of a segment that does not meet the box: the ends of its stretch along the box, and the nearest one."""
        nearest = c + e * nearest_to_box(c, e, half, size)
        out = outside_box(nearest, size)
        distance = wp.length(out)
        k = int(0)
        for m in range(1, 3):
            if wp.abs(out[m]) > wp.abs(out[k]):
                k = m
        slack = real(ALONG) * r
        # Over the face that is nearest; beside all faces, along the edge to which it is nearest.
        s = whole(half)
        for m in range(3):
            if m != k:
                s = cut(s, c[m], e[m], half, size[m], m, slack)
        if s.low > s.high:
            s = whole(half)
            for m in range(3):
                if wp.abs(nearest[m]) <= size[m] + slack:
                    s = cut(s, c[m], e[m], half, size[m], m, slack)
        low = wp.length(outside_box(c + s.low * e, size))
        high = wp.length(outside_box(c + s.high * e, size))
        covered = s.low <= s.high and wp.min(low, high) <= distance + real(covered_part) * r
        if not covered:
            write_near(
                slots, env, slot + 2, motion, wp.transform_point(box, nearest), wp.transform_vector(box, out) / distance, distance, r, r, 0
            )
        if s.low <= s.high:
            for j in range(2):
                at = s.low
                end = s.low_end
                if j == 1:
                    at = s.high
                    end = s.high_end
                # Where the nearest point lies on the edge that ends the stretch it stands for that end.
                twice = bool(False)
                if end > 0 and not covered:
                    m = (end - 1) // 2
                    twice = real(2 * ((end - 1) % 2) - 1) * nearest[m] >= size[m]
                if not twice:
                    p = c + at * e
                    apart = outside_box(p, size)
                    n = wp.transform_vector(box, apart) / wp.length(apart)
                    write_near(slots, env, slot + j, motion, wp.transform_point(box, p), n, wp.length(apart), r, r, end)

    @wp.func
    def in_face(slots: Slots, env: int, slot: int, box: transform, size: vec3, c: vec3, e: vec3, half: real, r: real, near: real, k: int):
        """Points of a segment that leaves a box through face k: the ends of its stretch between the other sides."""
        side = real(1.0)
        if c[k] < real(0.0):
            side = real(-1.0)
        outward = vec3()
        outward[k] = side
        normal = wp.transform_vector(box, outward)
        s = whole(half)
        for m in range(3):
            if m != k:
                s = cut(s, c[m], e[m], half, size[m], m, real(ALONG) * r)
        for j in range(2):
            at = s.low
            end = s.low_end
            if j == 1:
                at = s.high
                end = s.high_end
            p = c + at * e
            gap = side * p[k] - size[k] - r
            if gap < near:
                write(slots, env, slot + j, wp.transform_point(box, p) - normal * (r + real(0.5) * gap), normal, gap, end)

    @wp.func
    def in_edge(slots: Slots, env: int, slot: int, box: transform, size: vec3, c: vec3, e: vec3, half: real, r: real, n: vec3, m: int):
        """The point of a segment that leaves a box over an edge along direction m; n is normal to both."""
        corner = vec3()
        for k in range(3):
            if k != m:
                corner[k] = size[k]
                if n[k] < real(0.0):
                    corner[k] = -size[k]
        along = vec3()
        along[m] = real(1.0)
        p = c + e * nearest_to_segment(c - corner, e, half, along, size[m])
        gap = wp.dot(n, c - corner) - r
        normal = wp.transform_vector(box, n)
        write(slots, env, slot + 2, wp.transform_point(box, p) - normal * (r + real(0.5) * gap), normal, gap, 0)

    @wp.func
    def inside_box(slots: Slots, env: int, slot: int, box: transform, size: vec3, c: vec3, e: vec3, half: real, r: real, near: real):
        """Points of a segment that meets the box: it leaves along the separating axis of least overlap."""
        axis = int(0)
        best = wp.abs(c[0]) - wp.abs(e[0]) * half - size[0]
        for k in range(1, 3):
            s = wp.abs(c[k]) - wp.abs(e[k]) * half - size[k]
            if s > best:
                best = s
                axis = k
        # Prefer faces over edges, so that equal overlaps do not flip from step to step.
        best += real(1.0e-3) * wp.min(size)
        normal = vec3()
        for m in range(3):
            along = vec3()
            along[m] = real(1.0)
            n = wp.cross(e, along)
            sine = wp.length(n)
            if sine > real(1.0e-3):
                n = n / sine
                if wp.dot(n, c) < real(0.0):
                    n = -n
                s = wp.dot(n, c) - wp.abs(n[0]) * size[0] - wp.abs(n[1]) * size[1] - wp.abs(n[2]) * size[2]
                if s > best:
                    best = s
                    axis = 3 + m
                    normal = n
        if axis < 3:
            in_face(slots, env, slot, box, size, c, e, half, r, near, axis)
        else:
            in_edge(slots, env, slot, box, size, c, e, half, r, normal, axis - 3)

    @kernel()
    def box_capsule(
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
                box = shape_pose(topology, bodies, env, sa)
                capsule = shape_pose(topology, bodies, env, sb)
                size = topology.shape_size[sa]
                r = topology.shape_size[sb][0]
                half = topology.shape_size[sb][1]
                slot = topology.pair_slots[pair]
                centre = wp.transform_get_translation(box)
                middle = wp.transform_get_translation(capsule)
                near = reach(topology, bodies, env, sa, centre, wp.length(size), h) + reach(topology, bodies, env, sb, middle, half + r, h)
                for k in range(3):
                    slots.gap[env, slot + k] = real(NO_POINT)
                turn = wp.transform_get_rotation(box)
                c = wp.transform_point(wp.transform_inverse(box), middle)
                if wp.length(outside_box(c, size)) < half + r + near:
                    axis = z_axis(capsule)
                    e = wp.quat_rotate_inv(turn, axis)
                    distance = wp.length(outside_box(c + e * nearest_to_box(c, e, half, size), size))
                    if distance <= real(MEETS) * r:
                        inside_box(slots, env, slot, box, size, c, e, half, r, near)
                    elif distance - r < near:
                        motion = relative_motion(topology, bodies, env, sa, sb, h)
                        motion.near = near
                        move = shift(topology, bodies, env, sb, middle, h) - shift(topology, bodies, env, sa, centre, h)
                        further = rotation(wp.quat_rotate_inv(turn, shape_turn(topology, bodies, env, sa, h)))
                        ahead = wp.quat_rotate_inv(further, c + wp.quat_rotate_inv(turn, move))
                        e_ahead = wp.quat_rotate(rotation(shape_turn(topology, bodies, env, sb, h)), axis)
                        e_ahead = wp.quat_rotate_inv(further, wp.quat_rotate_inv(turn, e_ahead))
                        out = outside_box(ahead + e_ahead * nearest_to_box(ahead, e_ahead, half, size), size)
                        motion.distance = wp.length(out)
                        motion.normal = wp.quat_rotate(turn, wp.quat_rotate(further, out))
                        beside_box(slots, env, slot, box, size, c, e, half, r, motion)

    @kernel()
    def capsule_capsule(
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
                a = shape_pose(topology, bodies, env, sa)
                b = shape_pose(topology, bodies, env, sb)
                ra = topology.shape_size[sa][0]
                la = topology.shape_size[sa][1]
                rb = topology.shape_size[sb][0]
                lb = topology.shape_size[sb][1]
                slot = topology.pair_slots[pair]
                origin = wp.transform_get_translation(a)
                middle = wp.transform_get_translation(b)
                d = middle - origin
                near = reach(topology, bodies, env, sa, origin, la + ra, h) + reach(topology, bodies, env, sb, middle, lb + rb, h)
                for k in range(3):
                    slots.gap[env, slot + k] = real(NO_POINT)
                ea = z_axis(a)
                eb = z_axis(b)
                nearest = d + eb * nearest_to_segment(d, eb, lb, ea, la)
                out = outside_segment(nearest, ea, la)
                distance = wp.length(out)
                if distance - (ra + rb) < near:
                    motion = relative_motion(topology, bodies, env, sa, sb, h)
                    motion.near = near
                    ahead = d + shift(topology, bodies, env, sb, middle, h) - shift(topology, bodies, env, sa, origin, h)
                    ea_ahead = wp.quat_rotate(rotation(shape_turn(topology, bodies, env, sa, h)), ea)
                    eb_ahead = wp.quat_rotate(rotation(shape_turn(topology, bodies, env, sb, h)), eb)
                    nearest_ahead = ahead + eb_ahead * nearest_to_segment(ahead, eb_ahead, lb, ea_ahead, la)
                    motion.normal = outside_segment(nearest_ahead, ea_ahead, la)
                    motion.distance = wp.length(motion.normal)

                    # Segments that meet part across both, or where they are parallel, across one.
                    least = real(MEETS) * rb
                    across = perpendicular(ea)
                    if wp.length(wp.cross(ea, eb)) > real(1.0e-3):
                        across = wp.normalize(wp.cross(ea, eb))
                    if wp.dot(across, d) < real(0.0):
                        across = -across
                    s = cut(whole(lb), wp.dot(d, ea), wp.dot(eb, ea), lb, la, 0, real(ALONG) * rb)
                    if s.low > s.high:
                        s = whole(lb)
                    low = wp.length(outside_segment(d + s.low * eb, ea, la))
                    high = wp.length(outside_segment(d + s.high * eb, ea, la))
                    covered = wp.min(low, high) <= distance + real(covered_part) * rb
                    if not covered:
                        n = direction(out, distance, least, across)
                        write_near(slots, env, slot + 2, motion, origin + nearest, n, distance, ra + rb, rb, 0)
                    for j in range(2):
                        at = s.low
                        end = s.low_end
                        if j == 1:
                            at = s.high
                            end = s.high_end
                        # Where the nearest point lies at the end of a that ends the stretch it stands for that end.
                        twice = end > 0 and not covered and real(2 * end - 3) * wp.dot(nearest, ea) >= la
                        if not twice:
                            p = d + at * eb
                            apart = outside_segment(p, ea, la)
                            n = direction(apart, wp.length(apart), least, across)
                            write_near(slots, env, slot + j, motion, origin + p, n, wp.length(apart), ra + rb, rb, end)

    return {
        ("PLANE", "CAPSULE"): plane_capsule,
        ("SPHERE", "CAPSULE"): sphere_capsule,
        ("BOX", "CAPSULE"): box_capsule,
        ("CAPSULE", "CAPSULE"): capsule_capsule,
    }
