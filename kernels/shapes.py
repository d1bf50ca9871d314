# SPDX-License-Identifier: Apache-2.0
"""What convex shapes are to others: cylinders, cones and hulls, and boxes, balls and capsules where these meet them.

Sizes: cylinder (radius, half length along z), cone (radius of its base at z = -half, half height; the tip is at z = half), hull and
box: half extents of their bounds. Boxes are hulls here; balls and capsules are points and lines, without their radius.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .types import scalar_types

# ShapeType, as warp_lcp.model numbers them; others are hulls here.
SPHERE = wp.constant(1)
CAPSULE = wp.constant(3)
CYLINDER = wp.constant(4)
CONE = wp.constant(5)
PIECE = wp.constant(9)  # a triangle of a mesh: a hull without thickness
# Sides of the polygon inside a round cap to which faces are clipped, and corners of that which lands on a face.
ROUND = 16
CORNERS = 8
# Room for the points and faces of the growing polytope.
VERTICES = 32
FACES = 2 * VERTICES
# Of the largest size: what a polytope may still grow by.
FLAT = {wp.float64: 1.0e-11, wp.float32: 1.0e-6}
# Sine: a cap that leans by less has corners of its own, one that leans further touches with its lowest point first.
UPRIGHT = wp.constant(1.0e-4)


@functools.cache
def functions(real) -> SimpleNamespace:
    """What a convex shape is to others, and the axis that parts two of them."""
    t = scalar_types(real)
    vec3, vec4, mat33 = t.vec3, t.vec4, t.mat33

    @wp.struct
    class Hulls:
        """S shapes, of which those that are hulls (boxes too) have points and faces, each in the shape's frame."""

        kind: wp.array(dtype=int)  # [S] ShapeType
        first_point: wp.array(dtype=int)  # [S + 1]
        point: wp.array(dtype=vec3)
        first_face: wp.array(dtype=int)  # [S + 1]
        normal: wp.array(dtype=vec3)  # [F] outward
        first_corner: wp.array(dtype=int)  # [F + 1]
        corner: wp.array(dtype=int)  # into point, counterclockwise from outside
        seam: wp.array(dtype=int)  # [F] bit k: side k of a triangle goes on in another one, in the same plane
        # Triangles of meshes: each is a hull too, numbered from S on, in a frame about its own centre.
        mesh: wp.array(dtype=wp.uint64)  # [S] where to look for the triangles near a point, zero for other shapes
        first_piece: wp.array(dtype=int)  # [S + 1]
        centre: wp.array(dtype=vec3)  # [T] of a triangle, in the frame of the mesh
        radius: wp.array(dtype=real)  # [T] of the ball around its centre that holds it

    @wp.struct
    class Axis:
        """A direction from a to b, in the frame of a, and where along it they are nearest."""

        normal: vec3
        separation: real  # now
        point: vec3  # of a

    @wp.func
    def turned(kind: int) -> bool:
        """Is it round about its z axis, with a cap?"""
        result = kind == CYLINDER
        if kind == CONE:
            result = True
        return result

    @wp.func
    def support(hulls: Hulls, shape: int, size: vec3, d: vec3) -> vec3:
        """Point furthest along d, in the frame of the shape; of balls and capsules without their radius."""
        kind = hulls.kind[shape]
        p = vec3()
        if turned(kind):
            across = wp.sqrt(d[0] * d[0] + d[1] * d[1])
            p[2] = -size[1]
            if across > real(0.0):
                p[0] = size[0] * d[0] / across
                p[1] = size[0] * d[1] / across
            if kind == CYLINDER:
                if d[2] >= real(0.0):
                    p[2] = size[1]
            elif d[2] * real(2.0) * size[1] > size[0] * across:
                p = vec3(real(0.0), real(0.0), size[1])
        elif kind == CAPSULE:
            p[2] = size[1]
            if d[2] < real(0.0):
                p[2] = -size[1]
        elif kind != SPHERE:
            best = int(hulls.first_point[shape])
            most = wp.dot(hulls.point[best], d)
            for k in range(best + 1, hulls.first_point[shape + 1]):
                along = wp.dot(hulls.point[k], d)
                if along > most:
                    most = along
                    best = k
            p = hulls.point[best]
        return p

    @wp.struct
    class Facet:
        """A triangle of the growing polytope. Its normal is zero, and its offset huge, where it has no area: it is never nearest."""

        corner: wp.vec3i
        beside: wp.vec3i  # the facet across the side from corner m to the next
        normal: vec3
        offset: real

    @wp.func
    def facet(w: wp.array(dtype=vec3), corner: wp.vec3i, beside: wp.vec3i, least: real) -> Facet:
        result = Facet()
        result.corner = corner
        result.beside = beside
        origin = w[corner[0]]
        n = wp.cross(w[corner[1]] - origin, w[corner[2]] - origin)
        length = wp.length(n)
        result.offset = real(1.0e30)
        if length > least:
            result.normal = n / length
            result.offset = wp.dot(result.normal, origin)
        return result

    @wp.func
    def side_to(f: Facet, other: int) -> int:
        """Which side of a facet is another one's."""
        result = int(0)
        for m in range(1, 3):
            if f.beside[m] == other:
                result = m
        return result

    @wp.func
    def part(hulls: Hulls, a: int, b: int, size_a: vec3, size_b: vec3, d: vec3, turn: mat33, move: vec3, scale: real) -> Axis:
        """The axis along which a and b overlap least, or are furthest apart, once b has moved by `move`; all in the frame of a.

        It is the facet of their Minkowski difference A - B that is nearest to the origin, found by growing a polytope inside it from its
        furthest points (the expanding polytope algorithm, van den Bergen 2001). The polytope need not hold the origin: where
        the shapes are apart, the facet furthest on the near side is the widest gap between faces or edges. Its normal is a product of
        edges, as exact while they touch as while they do not.

        d: centre of b. turn: axes of b as columns. scale: length that both are smaller than.
        """
        w = wp.zeros(shape=(VERTICES,), dtype=vec3)  # points of A - B
        on_a = wp.zeros(shape=(VERTICES,), dtype=vec3)
        facets = wp.zeros(shape=(FACES,), dtype=Facet)
        state = wp.zeros(shape=(FACES,), dtype=int)  # 0 none, 1 of the polytope, 2 seen from the new point
        rim = wp.zeros(shape=(VERTICES,), dtype=wp.vec2i)  # facets around what is seen, and which side of theirs is to it
        ahead = wp.zeros(shape=(FACES,), dtype=wp.vec2i)
        places = wp.zeros(shape=(VERTICES,), dtype=int)
        flat = real(wp.static(FLAT[real])) * scale
        least = real(wp.static(1.0e-14 if real is wp.float64 else 1.0e-7)) * scale * scale
        # Four points that span a volume: both ends of an axis, what is furthest from it, what is furthest from all three.
        n = d
        if wp.dot(d, d) == real(0.0):
            n = vec3(real(0.0), real(0.0), real(1.0))
        count = int(0)
        for k in range(6):
            sign = real(1.0)
            if k % 2 == 1:
                sign = real(-1.0)
            if k == 2:
                axis = w[1] - w[0]
                i = int(0)
                for m in range(1, 3):
                    if wp.abs(axis[m]) < wp.abs(axis[i]):
                        i = m
                other = vec3()
                other[i] = real(1.0)
                n = wp.cross(axis, other)
            elif k == 4:
                n = wp.cross(w[1] - w[0], w[2] - w[0])
            p = support(hulls, a, size_a, sign * n)
            q = p - d - turn * support(hulls, b, size_b, wp.transpose(turn) * (-sign * n))
            better = bool(True)
            if k == 3 or k == 5:
                better = wp.abs(wp.dot(q - w[0], n)) > wp.abs(wp.dot(w[count - 1] - w[0], n))
                if better:
                    count -= 1
            if better:
                w[count] = q
                on_a[count] = p
                count += 1
        for k in range(4):
            i = (k + 1) % 4
            j = (k + 2) % 4
            m = (k + 3) % 4
            if wp.dot(wp.cross(w[j] - w[i], w[m] - w[i]), w[k] - w[i]) > real(0.0):
                i = j
                j = (k + 1) % 4
            # Across a side is the facet without the corner that is not on it, which has that corner's number.
            facets[k] = facet(w, wp.vec3i(i, j, m), wp.vec3i(m, i, j), least)
            state[k] = 1
        used = int(4)  # facets are numbered below this
        nearest = int(0)
        growing = bool(True)
        while growing:
            nearness = real(1.0e30)
            for k in range(used):
                if state[k] == 1:
                    along = facets[k].offset - wp.dot(facets[k].normal, move)
                    if along < nearness:
                        nearness = along
                        nearest = k
            n = facets[nearest].normal
            p = support(hulls, a, size_a, n)
            q = p - d - turn * support(hulls, b, size_b, wp.transpose(turn) * (-n))
            growing = wp.dot(n, q) - facets[nearest].offset > flat and count < VERTICES
            if growing:
                # What the new point sees, from the nearest facet on, and the rim of that in order.
                edges = int(0)
                waiting = int(0)
                state[nearest] = 2
                for m in range(3):
                    beside = facets[nearest].beside[2 - m]
                    ahead[waiting] = wp.vec2i(beside, side_to(facets[beside], nearest))
                    waiting += 1
                while waiting > 0:
                    waiting -= 1
                    k = ahead[waiting][0]
                    side = ahead[waiting][1]
                    if state[k] == 1:
                        if wp.dot(facets[k].normal, q) - facets[k].offset > real(0.1) * flat:
                            state[k] = 2
                            for m in range(2):
                                beside = facets[k].beside[(side + 2 - m) % 3]
                                if waiting < FACES:
                                    ahead[waiting] = wp.vec2i(beside, side_to(facets[beside], k))
                                    waiting += 1
                        elif edges < VERTICES:
                            rim[edges] = wp.vec2i(k, side)
                            edges += 1
                # Each side of the rim gets a facet with the new point: in place of what is seen, then behind the others.
                closed = edges >= 3 and edges < VERTICES
                free = int(0)
                for i in range(edges):
                    here = facets[rim[i][0]].corner[rim[i][1]]
                    next_rim = rim[(i + 1) % edges]
                    there = facets[next_rim[0]].corner[(next_rim[1] + 1) % 3]
                    closed = closed and here == there
                    while free < used and state[free] == 1:
                        free += 1
                    places[i] = free
                    free += 1
                    used = wp.max(used, wp.min(free, FACES))
                    closed = closed and free <= FACES
                growing = closed  # rounding has spoilt the polytope, or it is as large as it may be: its last axis is good enough
                if growing:
                    for k in range(used):
                        if state[k] == 2:
                            state[k] = 0
                    w[count] = q
                    on_a[count] = p
                    for i in range(edges):
                        k = rim[i][0]
                        side = rim[i][1]
                        corner = wp.vec3i(facets[k].corner[(side + 1) % 3], facets[k].corner[side], count)
                        outer = facets[k]
                        outer.beside[side] = places[i]
                        facets[k] = outer
                        before = places[(i + edges - 1) % edges]
                        facets[places[i]] = facet(w, corner, wp.vec3i(k, places[(i + 1) % edges], before), least)
                        state[places[i]] = 1
                    count += 1
        result = Axis()
        result.normal = n
        result.separation = -wp.dot(n, q)
        # Where the origin lies over the facet; the other half of a facet of four corners counts on.
        c = facets[nearest].corner
        e_1 = w[c[1]] - w[c[0]]
        e_2 = w[c[2]] - w[c[0]]
        r = n * facets[nearest].offset - w[c[0]]
        area = wp.dot(n, wp.cross(e_1, e_2))
        s_1 = real(0.0)
        s_2 = real(0.0)
        if area > least:
            s_1 = wp.clamp(wp.dot(n, wp.cross(r, e_2)) / area, real(-1.0), real(2.0))
            s_2 = wp.clamp(wp.dot(n, wp.cross(e_1, r)) / area, real(-1.0), real(2.0))
        result.point = on_a[c[0]] + s_1 * (on_a[c[1]] - on_a[c[0]]) + s_2 * (on_a[c[2]] - on_a[c[0]])
        return result

    @wp.func
    def face_towards(hulls: Hulls, shape: int, d: vec3) -> int:
        """The face whose normal is nearest to d: of a cylinder 0 at +z, 1 at -z, of a cone its base."""
        kind = hulls.kind[shape]
        best = int(1)
        if kind == CYLINDER:
            if d[2] >= real(0.0):
                best = 0
        elif kind != CONE:
            best = hulls.first_face[shape]
            for k in range(best + 1, hulls.first_face[shape + 1]):
                if wp.dot(hulls.normal[k], d) > wp.dot(hulls.normal[best], d) + real(1.0e-6):
                    best = k
        return best

    @wp.func
    def face_normal(hulls: Hulls, shape: int, face: int) -> vec3:
        kind = hulls.kind[shape]
        n = vec3(real(0.0), real(0.0), real(1.0))
        if turned(kind):
            if face == 1:
                n = -n
        else:
            n = hulls.normal[face]
        return n

    @wp.func
    def ring_point(radius: real, z: real, d: vec3, k: int, of: int) -> vec3:
        """Corner k of a round cap: the first is the one furthest along d where the cap leans that way."""
        across = wp.sqrt(d[0] * d[0] + d[1] * d[1])
        c = real(1.0)
        s = real(0.0)
        if across > real(UPRIGHT) * wp.length(d):
            c = d[0] / across
            s = d[1] / across
        angle = real(wp.static(6.283185307179586)) * real(k) / real(of)
        return vec3(
            radius * (c * wp.cos(angle) - s * wp.sin(angle)),
            radius * (s * wp.cos(angle) + c * wp.sin(angle)),
            z,
        )

    @wp.func
    def turned_to(hulls: Hulls, shape: int, size: vec3, d: vec3, points: wp.array(dtype=vec3)) -> int:
        """Corners of the face that a shape turns to d, or the two ends of its line; in the frame of the shape. Returns their number."""
        kind = hulls.kind[shape]
        count = int(0)
        across = wp.sqrt(d[0] * d[0] + d[1] * d[1])
        if turned(kind):
            side = wp.abs(d[2]) < across
            z = -size[1]
            if kind == CYLINDER:
                if d[2] >= real(0.0):
                    z = size[1]
            else:
                slant = wp.sqrt(real(4.0) * size[1] * size[1] + size[0] * size[0])
                side = (real(2.0) * size[1] * across + size[0] * d[2]) > -d[2] * slant
            if side:
                x = size[0] * d[0] / across
                y = size[0] * d[1] / across
                points[0] = vec3(x, y, -size[1])
                points[1] = vec3(x, y, size[1])
                if kind == CONE:
                    points[1] = vec3(real(0.0), real(0.0), size[1])
                count = 2
            else:
                for k in range(CORNERS):
                    m = k
                    if z < real(0.0):
                        m = CORNERS - k
                    points[k] = ring_point(size[0], z, d, m, CORNERS)
                count = CORNERS
        else:
            face = face_towards(hulls, shape, d)
            first = hulls.first_corner[face]
            number = hulls.first_corner[face + 1] - first
            count = wp.min(number, ROUND)
            for k in range(count):
                points[k] = hulls.point[hulls.corner[first + (k * number) // count]]
        return count

    @wp.func
    def sides(hulls: Hulls, shape: int, face: int) -> int:
        """How many sides a face has."""
        kind = hulls.kind[shape]
        count = int(ROUND)
        if not turned(kind):
            count = hulls.first_corner[face + 1] - hulls.first_corner[face]
        return count

    @wp.func
    def side_plane(hulls: Hulls, shape: int, size: vec3, face: int, k: int) -> vec4:
        """(m, c): what is inside of side k of a face has m . x <= c, in the frame of the shape."""
        kind = hulls.kind[shape]
        m = vec3()
        c = real(0.0)
        if turned(kind):
            angle = real(wp.static(6.283185307179586)) * (real(k) + real(0.5)) / real(ROUND)
            m = vec3(wp.cos(angle), wp.sin(angle), real(0.0))
            c = size[0] * wp.cos(real(wp.static(3.141592653589793)) / real(ROUND))
        else:
            first = hulls.first_corner[face]
            number = hulls.first_corner[face + 1] - first
            p = hulls.point[hulls.corner[first + k]]
            q = hulls.point[hulls.corner[first + (k + 1) % number]]
            m = wp.normalize(wp.cross(q - p, hulls.normal[face]))
            c = wp.dot(m, p)
        return vec4(m[0], m[1], m[2], c)

    return SimpleNamespace(
        Hulls=Hulls,
        Axis=Axis,
        turned=turned,
        support=support,
        part=part,
        face_towards=face_towards,
        face_normal=face_normal,
        ring_point=ring_point,
        turned_to=turned_to,
        sides=sides,
        side_plane=side_plane,
    )
