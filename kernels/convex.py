# SPDX-License-Identifier: Apache-2.0
"""Gap functions of cylinders, cones and convex hulls with each other, with boxes and with planes.

Where two of them meet, the axis that parts them is that of ``shapes.part``; points come from the face that has it for a normal, and what
the other shape turns to it, clipped by the sides of that face. The side of a cylinder or cone turns a line to it, a cap a polygon. Slots
of a pair:

====================  =======================================================================================
sharp - sharp         0 - 7: corners of the clipped face; two lines side by side: both ends; edges that cross: 0
plane - cylinder      0 - 5, 6 - 11: corners of the lower and the upper cap
plane - cone          0 - 5: corners of the base, 6: the tip
plane - hull          one for each point of the hull
====================  =======================================================================================
"""

import functools
from types import SimpleNamespace

import warp as wp

from .box_box import axes
from .collide import NO_POINT, pair_functions
from .declare import factory, kernel
from .shapes import CONE, PIECE, ROUND, functions
from .types import scalar_types

# Points of a pair of sharp shapes; corners of one cap on a plane; room for the corners of a face while it is clipped.
POINTS = 8
RING = 6
CLIPPED = 32
# Sine of the angle between lines that lie side by side.
BESIDE = wp.constant(1.0e-3)
# Of the size: a corner this close to the side of a face is on it.
SLACK = wp.constant(1.0e-5)


@functools.cache
def clipping(real) -> SimpleNamespace:
    """Sutherland and Hodgman's clipping of polygons in local arrays, and what is left of them."""
    vec3 = scalar_types(real).vec3

    @wp.func
    def clip(
        points: wp.array(dtype=vec3),
        edges: wp.array(dtype=int),
        spare: wp.array(dtype=vec3),
        spare_edges: wp.array(dtype=int),
        count: int,
        m: vec3,
        c: real,
        slack: real,
        name: int,
    ) -> int:
        """Keep what has m . x <= c; two points are a line. Returns the new count.

        edges: which line leads from a corner to the next; of the ends of a line, what ends it.
        """
        most = real(0.0)
        for k in range(count):
            most = wp.max(most, wp.dot(m, points[k]) - c)
        if most <= slack:  # a corner that lies on the side keeps its identity, whatever the last bits say
            return count
        kept = int(0)
        for k in range(count):
            p = points[k]
            q = points[(k + 1) % count]
            here = wp.dot(m, p) - c
            there = wp.dot(m, q) - c
            if here <= slack:
                spare[kept] = p
                spare_edges[kept] = edges[k]
                kept += 1
            if (here <= slack) != (there <= slack) and kept < CLIPPED and not (count == 2 and k == 1):
                spare[kept] = p + wp.clamp(here / (here - there), real(0.0), real(1.0)) * (q - p)
                spare_edges[kept] = edges[k]
                if here <= slack or count == 2:
                    spare_edges[kept] = name
                kept += 1
            if kept == CLIPPED:
                break
        for k in range(kept):
            points[k] = spare[k]
            edges[k] = spare_edges[k]
        return kept

    @wp.func
    def unseamed(points: wp.array(dtype=vec3), edges: wp.array(dtype=int), count: int, own: int, others: int) -> int:
        """Leave out corners at seams, beyond which the surface goes on. own, others: bits of sides, named from ROUND and from 0."""
        kept = int(0)
        last = int(0)
        if count > 0:
            last = edges[count - 1]
        for k in range(count):
            seam = bool(False)
            for m in range(2):
                edge = edges[k]
                if m == 1 and count > 2:
                    edge = last
                if edge >= ROUND and edge < ROUND + 3:
                    seam = seam or (own & (1 << (edge - ROUND))) != 0
                elif edge < 3:
                    seam = seam or (others & (1 << edge)) != 0
            last = edges[k]
            if not seam:
                points[kept] = points[k]
                edges[kept] = edges[k]
                kept += 1
        return kept

    @wp.func
    def spread(points: wp.array(dtype=vec3), edges: wp.array(dtype=int), count: int, n: vec3) -> int:
        """Of more corners than there are slots, those furthest out in as many directions across n. Returns the new count."""
        if count <= POINTS:
            return count
        i = int(0)
        for m in range(1, 3):
            if wp.abs(n[m]) < wp.abs(n[i]):
                i = m
        e = vec3()
        e[i] = real(1.0)
        e_1 = wp.normalize(wp.cross(n, e))
        e_2 = wp.cross(n, e_1)
        chosen = int(0)
        for k in range(POINTS):
            angle = real(wp.static(6.283185307179586 / POINTS)) * real(k)
            way = wp.cos(angle) * e_1 + wp.sin(angle) * e_2
            best = int(0)
            for m in range(1, count):
                if wp.dot(way, points[m]) > wp.dot(way, points[best]):
                    best = m
            chosen = chosen | (1 << best)
        kept = int(0)
        for k in range(count):
            if (chosen & (1 << k)) != 0:
                points[kept] = points[k]
                edges[kept] = edges[k]
                kept += 1
        return kept

    return SimpleNamespace(clip=clip, spread=spread, unseamed=unseamed)


@functools.cache
def meeting(real):
    """Function ``meet``: where two sharp shapes touch or could."""
    t = scalar_types(real)
    vec3, mat33, transform = t.vec3, t.mat33, t.transform
    a, s, c = axes(real), functions(real), clipping(real)
    rank, Hulls, Axis, support, part, face_towards, face_normal = (
        a.rank,
        s.Hulls,
        s.Axis,
        s.support,
        s.part,
        s.face_towards,
        s.face_normal,
    )
    turned, turned_to, sides, side_plane, clip, spread = s.turned, s.turned_to, s.sides, s.side_plane, c.clip, c.spread
    unseamed = c.unseamed

    @wp.func
    def smallest_size(hulls: Hulls, shape: int, size: vec3) -> real:
        """Half extent; what is flat has none."""
        least = wp.min(size[0], size[1])
        if not turned(hulls.kind[shape]):
            least = wp.min(least, size[2])
        if least <= real(0.0):
            least = real(1.0e30)
        return least

    @wp.func
    def separation(hulls: Hulls, a: int, b: int, size_a: vec3, size_b: vec3, d: vec3, turn: mat33, n: vec3) -> real:
        """Of b from a along n, in the frame of a."""
        p = support(hulls, a, size_a, n)
        return wp.dot(n, d + turn * support(hulls, b, size_b, wp.transpose(turn) * (-n)) - p)

    @wp.func
    def meet(
        hulls: Hulls,
        a: int,
        b: int,
        size_a: vec3,
        size_b: vec3,
        xa: transform,
        xb: transform,
        motion: vec3,
        deep: vec3,
        share: real,
        normal: wp.array(dtype=vec3),
        at: wp.array(dtype=vec3),
        gaps: wp.array(dtype=real),
        features: wp.array(dtype=int),
    ) -> int:
        """Fills normal[0] from a to b, and points, gaps and features of up to POINTS contacts, world axes; returns their number.

        xa, xb: poses. motion: of b relative to a over the step, world axes. deep: least depth, load over stiffness and most, the first
        and last as parts of the smallest half extent: what overlaps by less counts as touching. share: how near to b's the
        point is while they are apart and come from the side, 0 to 1.
        """
        axes_a = wp.quat_to_matrix(wp.transform_get_rotation(xa))
        turn = wp.transpose(axes_a) * wp.quat_to_matrix(wp.transform_get_rotation(xb))
        d = wp.transpose(axes_a) * (wp.transform_get_translation(xb) - wp.transform_get_translation(xa))
        move = wp.transpose(axes_a) * motion
        scale = wp.length(size_a) + wp.length(size_b)
        smallest = wp.min(smallest_size(hulls, a, size_a), smallest_size(hulls, b, size_b))
        touching = wp.clamp(deep[1], deep[0] * smallest, deep[2] * smallest)
        # As of two boxes: axes are compared where the shapes would be after the step, but first those that part them now.
        best = Axis()
        rounds = int(0)  # one call in a loop: a second copy of it is half the kernel
        while rounds < 2:
            if rounds == 1:
                move = vec3()
            best = part(hulls, a, b, size_a, size_b, d, turn, move, scale)
            rounds += 1
            if best.separation >= -touching:
                rounds = 2
        move = wp.transpose(axes_a) * motion
        n = best.normal
        far = real(4.0) * (scale + wp.length(move))
        ranked = rank(best.separation, best.separation + wp.dot(n, move), touching, far) - real(1.0e-3) * smallest
        # Faces are preferred to edges, and those of a, so that equal separations do not flip from step to step.
        face = face_towards(hulls, a, n)
        n_a = face_normal(hulls, a, face)
        now = separation(hulls, a, b, size_a, size_b, d, turn, n_a)
        owner = int(0)
        if rank(now, now + wp.dot(n_a, move), touching, far) >= ranked:
            owner = 1
        else:
            face = face_towards(hulls, b, wp.transpose(turn) * (-n))
            n_b = turn * face_normal(hulls, b, face)
            now = separation(hulls, a, b, size_a, size_b, d, turn, -n_b)
            if rank(now, now - wp.dot(n_b, move), touching, far) >= ranked:
                owner = 2

        points = wp.zeros(shape=(CLIPPED,), dtype=vec3)
        edges = wp.zeros(shape=(CLIPPED,), dtype=int)
        spare = wp.zeros(shape=(CLIPPED,), dtype=vec3)
        spare_edges = wp.zeros(shape=(CLIPPED,), dtype=int)
        count = int(0)
        bare = bool(True)  # is nothing over the face?
        if owner > 0:
            # In the frame of the face's owner; the other shape is where they meet, if it comes from the side.
            one = a
            other = b
            size_one = size_a
            size_other = size_b
            pose = xa
            to = d
            other_turn = turn
            way = move
            part_way = share
            if owner == 2:
                one = b
                other = a
                size_one = size_b
                size_other = size_a
                pose = xb
                other_turn = wp.transpose(turn)
                to = -(other_turn * d)
                way = -(other_turn * move)
                part_way = real(1.0) - share
            out = face_normal(hulls, one, face)
            along = vec3()
            closing = -wp.dot(out, way)
            if now > real(0.0) and closing > now:
                along = way * (now / closing)
                along -= out * wp.dot(out, along)
            number = turned_to(hulls, other, size_other, wp.transpose(other_turn) * (-out), points)
            count = number
            for k in range(count):
                points[k] = to + along + other_turn * points[k]
                edges[k] = k
            for k in range(sides(hulls, one, face)):
                plane = side_plane(hulls, one, size_one, face, k)
                m = vec3(plane[0], plane[1], plane[2])
                if count > 0:
                    count = clip(points, edges, spare, spare_edges, count, m, plane[3], real(SLACK) * scale, ROUND + k)
            bare = count == 0
            if hulls.kind[one] == PIECE:
                count = unseamed(points, edges, count, hulls.seam[face], 0)
            elif hulls.kind[other] == PIECE:
                turned_face = face_towards(hulls, other, wp.transpose(other_turn) * (-out))
                count = unseamed(points, edges, count, 0, hulls.seam[turned_face])
            count = spread(points, edges, count, out)
            level = wp.dot(out, support(hulls, one, size_one, out))
            normal[0] = wp.transform_vector(pose, out)
            if owner == 2:
                normal[0] = -normal[0]
            for k in range(count):
                gap = wp.dot(out, points[k]) - level
                before = edges[(k + count - 1) % count]
                at[k] = wp.transform_point(pose, points[k] - real(0.5) * gap * out - part_way * along)
                gaps[k] = gap
                features[k] = (((owner * 4099 + face) * 67 + before) * 67 + edges[k]) & 0x3FFFFFFF
        if bare:
            # Edges cross, lines lie side by side, or nothing is over the face: one that is only as good as the best axis is not it.
            normal[0] = wp.transform_vector(xa, n)
            line_a = int(0)
            line_b = int(0)
            if turned(hulls.kind[a]):
                line_a = turned_to(hulls, a, size_a, n, points)
            if turned(hulls.kind[b]):
                line_b = turned_to(hulls, b, size_b, wp.transpose(turn) * (-n), spare)
            if line_a == 2 and line_b == 2:
                # Two lines side by side rest on both ends of what they share.
                e = points[1] - points[0]
                length = wp.length(e)
                e = e / length
                p = d + turn * spare[0] - points[0]
                q = d + turn * spare[1] - points[0]
                low = wp.max(wp.min(wp.dot(p, e), wp.dot(q, e)), real(0.0))
                high = wp.min(wp.max(wp.dot(p, e), wp.dot(q, e)), length)
                if wp.length(wp.cross(e, q - p)) < real(BESIDE) * wp.length(q - p) and high > low:
                    for k in range(2):
                        x = low
                        if k == 1:
                            x = high
                        on_b = p + (q - p) * ((x - wp.dot(p, e)) / wp.dot(q - p, e))
                        gaps[k] = wp.dot(n, on_b - x * e)
                        at[k] = wp.transform_point(xa, points[0] + x * e + real(0.5) * gaps[k] * n)
                        features[k] = k
                    count = 2
            if count == 0:
                at[0] = wp.transform_point(xa, best.point + real(0.5) * best.separation * n)
                gaps[0] = best.separation
                features[0] = 0
                count = 1
        return count

    return meet


@factory
def make(real) -> SimpleNamespace:
    """Kernels ``sharp`` (cylinders, cones, hulls and boxes with each other) and ``on_plane``; launch with dim (E, lanes)."""
    t = scalar_types(real)
    vec3 = t.vec3
    Bodies, Parameters, Slots, Topology = t.Bodies, t.Parameters, t.Slots, t.Topology
    f, a, s, meet = pair_functions(real), axes(real), functions(real), meeting(real)
    shape_pose, reach, shape_velocity, write = f.shape_pose, f.reach, f.shape_velocity, f.write
    inverse_mass, touching_depth, Hulls, ring_point, turned = a.inverse_mass, a.touching_depth, s.Hulls, s.ring_point, s.turned

    @kernel()
    def sharp(
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
                xa = shape_pose(topology, bodies, env, sa)
                xb = shape_pose(topology, bodies, env, sb)
                u = shape_velocity(topology, bodies, bodies.velocity, env, sb, wp.transform_get_translation(xb))
                u -= shape_velocity(topology, bodies, bodies.velocity, env, sa, wp.transform_get_translation(xa))
                inverse_a = inverse_mass(topology, bodies, env, sa)
                inverse_b = inverse_mass(topology, bodies, env, sb)
                gravity = parameters.gravity[env % parameters.gravity.shape[0]]
                stiffness = parameters.pair_contact[env % parameters.pair_contact.shape[0], pair][0]
                # Levers are those of the lighter shape, which turns more easily.
                share = real(0.5)
                if inverse_a + inverse_b > real(0.0):
                    share = inverse_b / (inverse_a + inverse_b)
                normal = wp.zeros(shape=(1,), dtype=vec3)
                at = wp.zeros(shape=(POINTS,), dtype=vec3)
                gaps = wp.zeros(shape=(POINTS,), dtype=real)
                features = wp.zeros(shape=(POINTS,), dtype=int)
                count = meet(
                    hulls,
                    sa,
                    sb,
                    topology.shape_size[sa],
                    topology.shape_size[sb],
                    xa,
                    xb,
                    h * u,
                    touching_depth(gravity, inverse_a, inverse_b, stiffness),
                    share,
                    normal,
                    at,
                    gaps,
                    features,
                )
                slot = topology.pair_slots[pair]
                for k in range(count):
                    write(slots, env, slot + k, at[k], normal[0], gaps[k], features[k])
                for k in range(count, POINTS):
                    slots.gap[env, slot + k] = real(NO_POINT)

    @kernel()
    def on_plane(
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
                shape = topology.pairs[pair, 1]
                plane = shape_pose(topology, bodies, env, topology.pairs[pair, 0])
                pose = shape_pose(topology, bodies, env, shape)
                size = topology.shape_size[shape]
                normal = wp.transform_vector(plane, vec3(real(0.0), real(0.0), real(1.0)))
                origin = wp.transform_get_translation(plane)
                centre = wp.transform_get_translation(pose)
                radius = wp.length(size)
                near = reach(topology, bodies, env, topology.pairs[pair, 0], centre, radius, h)
                near += reach(topology, bodies, env, shape, centre, radius, h)
                turn = wp.quat_to_matrix(wp.transform_get_rotation(pose))
                down = -(wp.transpose(turn) * normal)
                above = wp.dot(normal, centre - origin)
                slot = topology.pair_slots[pair]
                sort = hulls.kind[shape]
                number = topology.pair_slots[pair + 1] - slot
                for k in range(number):
                    p = vec3()
                    if turned(sort):
                        z = -size[1]
                        if k >= RING:
                            z = size[1]
                        p = ring_point(size[0], z, down, k % RING, RING)
                        if sort == CONE and k == RING:
                            p = vec3(real(0.0), real(0.0), z)
                    else:
                        p = hulls.point[hulls.first_point[shape] + k]
                    gap = above - wp.dot(down, p)
                    if gap < near:
                        write(slots, env, slot + k, centre + turn * p - normal * (real(0.5) * gap), normal, gap, k)
                    else:
                        slots.gap[env, slot + k] = real(NO_POINT)

    return SimpleNamespace(sharp=sharp, on_plane=on_plane)
