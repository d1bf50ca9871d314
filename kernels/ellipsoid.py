# SPDX-License-Identifier: Apache-2.0
"""Gap functions of ellipsoids with every other shape; each pair has one point, for an ellipsoid is strictly convex.

In the frame of the ellipsoid, with its semi-axes in A, its support along a unit normal m is h(m) = |A m|, at q = A^2 m / h. What counts
is the m that maximises the separation

    s(m) = min over the other shape of m . x - h(m)

which is their distance, or minus the depth along the axis of least overlap. m is found as such, from roots in which no gap is divided by,
so it is as exact where they touch as anywhere. While they overlap by less than the least radius of curvature, s has one maximum; the
deeper ones give a local one, of faces the best.

The nearest point of an ellipsoid to a point is the root of one equation (Eberly 2013); that to a line is the same one dimension lower, in
the shadow of the ellipsoid along the line; that to a plane has a formula. So what has corners is looked at corner by corner as in GJK, but
with exact subproblems, and ends after as many rounds as it takes corners. Rims, round sides of cones and other ellipsoids are left
to Newton's method on the sphere of normals, with the curvatures of both as its matrix.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .collide import NO_POINT, pair_functions
from .declare import factory, kernel
from .shapes import CAPSULE, CONE, CYLINDER, SPHERE, functions
from .types import scalar_types

# Of the size: a corner that is this much nearer along the normal changes nothing.
NEARER = {wp.float64: 1.0e-14, wp.float32: 1.0e-6}
# Of the smallest semi-axis: a point this near the plane in which the nearest point jumps counts as being on one side of it.
BESIDE = {wp.float64: 1.0e-60, wp.float32: 1.0e-15}
# Of the size: what Newton's step still gains is lost in round-off.
GAIN = {wp.float64: 1.0e-14, wp.float32: 1.0e-6}
# Angle of Newton's last step, and how many more there are at most once separations show nothing.
TURNED = {wp.float64: 1.0e-12, wp.float32: 1.0e-5}
LAST = wp.constant(6)
ROUNDS = 32


@functools.cache
def touching(real) -> SimpleNamespace:
    """Functions ``faceted``, ``turned`` and ``rounded``: where an ellipsoid is nearest to a shape, by the kind of that."""
    t = scalar_types(real)
    vec3, mat33 = t.vec3, t.mat33
    s = functions(real)
    Hulls, support, sides, side_plane = s.Hulls, s.support, s.sides, s.side_plane

    @wp.struct
    class Touch:
        """In the frame of the ellipsoid."""

        normal: vec3  # outward, towards the other shape
        gap: real
        face: int  # of the other shape that has this normal, -1: none

    @wp.func
    def height(sq: vec3, m: vec3) -> real:
        """Support |A m|; sq: squares of the semi-axes."""
        return wp.sqrt(wp.dot(m, wp.cw_mul(sq, m)))

    @wp.func
    def top(sq: vec3, m: vec3) -> vec3:
        """The point with the outward normal m."""
        return wp.cw_mul(sq, m) / height(sq, m)

    @wp.func
    def sharpest(sq: vec3) -> real:
        """Least radius of curvature: what overlaps by less overlaps least along one normal only."""
        return wp.min(sq) / wp.sqrt(wp.max(sq))

    @wp.func
    def foot(sq: vec3, v: vec3) -> vec3:
        """Outward unit normal where the ellipsoid is nearest to the point v, which may be inside.

        Of x_k = sq_k v_k / (sq_k + t) that on the surface: |A v / (sq + t)| = 1. Its reciprocal is concave in t, so that Newton's method
        for it rises from below to the root. t is counted from minus the least square, where differences lose nothing.
        """
        i = int(0)
        for k in range(1, 3):
            if sq[k] < sq[i]:
                i = k
        least = real(wp.static(BESIDE[real])) * wp.sqrt(sq[i])
        x = v
        if wp.abs(x[i]) < least:
            x[i] = least
        more = sq - vec3(sq[i], sq[i], sq[i])
        y = vec3(wp.sqrt(sq[0]) * x[0], wp.sqrt(sq[1]) * x[1], wp.sqrt(sq[2]) * x[2])
        root = real(0.0)
        for k in range(3):
            root = wp.max(root, wp.abs(y[k]) - more[k])
        going = bool(True)
        rounds = int(0)
        while going:
            total = real(0.0)
            slope = real(0.0)
            for k in range(3):
                part = y[k] / (more[k] + root)
                total += part * part
                slope += part * part / (more[k] + root)
            step = (wp.sqrt(total) - real(1.0)) * total / slope
            rounds += 1
            going = step > real(wp.static(1.0e-16 if real is wp.float64 else 1.0e-8)) * root and rounds < ROUNDS
            if going:
                root += step
        return wp.normalize(vec3(x[0] / (more[0] + root), x[1] / (more[1] + root), x[2] / (more[2] + root)))

    @wp.func
    def longest(sq: vec3) -> vec3:
        """The axis of the longest semi-axis."""
        i = int(0)
        for k in range(1, 3):
            if sq[k] > sq[i]:
                i = k
        result = vec3()
        result[i] = real(1.0)
        return result

    @wp.func
    def across(e: vec3) -> vec3:
        """A unit vector square to e."""
        i = int(0)
        for k in range(1, 3):
            if wp.abs(e[k]) < wp.abs(e[i]):
                i = k
        other = vec3()
        other[i] = real(1.0)
        return wp.normalize(wp.cross(e, other))

    @wp.func
    def foot_beside(sq: vec3, p: vec3, e: vec3) -> vec3:
        """Outward unit normal where the ellipsoid is nearest to the line through p along the unit vector e: that of its shadow along e."""
        one = across(e)
        two = wp.cross(e, one)
        xx = wp.dot(one, wp.cw_mul(sq, one))
        xy = wp.dot(one, wp.cw_mul(sq, two))
        yy = wp.dot(two, wp.cw_mul(sq, two))
        angle = real(0.5) * wp.atan2(real(2.0) * xy, xx - yy)
        f_1 = wp.cos(angle) * one + wp.sin(angle) * two
        f_2 = wp.cross(e, f_1)
        xx = wp.dot(f_1, wp.cw_mul(sq, f_1))
        yy = wp.dot(f_2, wp.cw_mul(sq, f_2))
        m = foot(vec3(xx, yy, xx + yy), vec3(wp.dot(p, f_1), wp.dot(p, f_2), real(0.0)))
        return m[0] * f_1 + m[1] * f_2

    @wp.func
    def faceted(hulls: Hulls, shape: int, size: vec3, sq: vec3, d: vec3, turn: mat33) -> Touch:
        """Of a box, hull or triangle, or of the core of a ball or capsule, whose radius is for the caller to subtract.

        d, turn: centre and axes of the shape in the frame of the ellipsoid.
        """
        scale = wp.length(d) + wp.length(size)
        slack = real(wp.static(NEARER[real])) * scale
        best = Touch()
        best.gap = real(-1.0e30)
        best.face = -1
        for k in range(hulls.first_face[shape], hulls.first_face[shape + 1]):
            n = turn * hulls.normal[k]
            gap = -wp.dot(n, d + turn * hulls.point[hulls.corner[hulls.first_corner[k]]]) - height(sq, n)
            if gap > best.gap:
                best.gap = gap
                best.normal = -n
                best.face = k
        going = bool(True)
        if best.face >= 0 and best.gap > -sharpest(sq):
            x = wp.transpose(turn) * (top(sq, best.normal) - d)
            going = bool(False)
            for k in range(sides(hulls, shape, best.face)):
                plane = side_plane(hulls, shape, size, best.face, k)
                if plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] > plane[3] + slack:
                    going = True
        # Corners between which the nearest point lies; each round adds the one that is nearest along the normal, and leaves out what
        # the nearest point does not need. What it needs has the new corner.
        w = wp.zeros(shape=(3,), dtype=vec3)
        count = int(0)
        rounds = int(0)
        new = d + turn * support(hulls, shape, size, -(wp.transpose(turn) * d))
        while going:
            # A plane or line that the ellipsoid crosses tells nothing of what lies beside that: then one of less dimension has it.
            deepest = -sharpest(sq)
            least = real(1.0e30)
            kept = int(0)
            crossed = bool(False)
            m = vec3()
            for i in range(3):
                if count == 3 or (count == 2 and i == 2):
                    one = w[(i + 1) % 3] - new
                    two = w[(i + 2) % 3] - new
                    c = wp.cross(one, two)
                    area = wp.dot(c, c)
                    if area > real(0.0):
                        n = c / wp.sqrt(area)
                        if wp.dot(n, new) < real(0.0):
                            n = -n
                        r = top(sq, n) - new
                        u = wp.dot(wp.cross(r, two), c) / area
                        v = wp.dot(wp.cross(one, r), c) / area
                        there = wp.dot(n, new) - height(sq, n)
                        if u > real(0.0) and v > real(0.0) and u + v < real(1.0) and there < least and there > deepest:
                            least = there
                            m = n
                            kept = (1 << ((i + 1) % 3)) | (1 << ((i + 2) % 3))
            for i in range(3):
                if i < count:
                    e = w[i] - new
                    n = foot_beside(sq, new, wp.normalize(e))
                    along = wp.dot(top(sq, n) - new, e) / wp.dot(e, e)
                    there = wp.dot(n, new) - height(sq, n)
                    if there <= deepest:
                        crossed = True
                    elif along > real(0.0) and along < real(1.0) and there < least:
                        least = there
                        m = n
                        kept = 1 << i
            if kept == 0 or crossed:
                n = foot(sq, new)
                if wp.dot(n, new) - height(sq, n) < least:
                    m = n
                    kept = 0
            others = int(0)
            for i in range(3):
                if i < count and (kept & (1 << i)) != 0:
                    w[others] = w[i]
                    others += 1
            w[others] = new
            count = others + 1
            nearer = d + turn * support(hulls, shape, size, -(wp.transpose(turn) * m))
            gap = wp.dot(m, nearer) - height(sq, m)
            if gap > best.gap:
                best.gap = gap
                best.normal = m
                best.face = -1
            rounds += 1
            going = wp.dot(m, new) - wp.dot(m, nearer) > slack and rounds < ROUNDS
            for i in range(3):
                if i < count and w[i] == nearer:
                    going = False
            new = nearer
        return best

    @wp.func
    def facing(rim: bool, of: vec3, d: vec3, turn: mat33, m: vec3) -> vec3:
        """Point that is nearest along m, of a circle about z of radius of[0], or of an ellipsoid whose semi-axes have the squares `of`."""
        n = -(wp.transpose(turn) * m)
        p = vec3()
        if rim:
            length = wp.sqrt(n[0] * n[0] + n[1] * n[1])
            if length > real(0.0):
                p = vec3(of[0] * n[0] / length, of[0] * n[1] / length, real(0.0))
        else:
            p = top(of, n)
        return d + turn * p

    @wp.func
    def climb(rim: bool, of: vec3, sq: vec3, d: vec3, turn: mat33, start: vec3) -> vec3:
        """Normal of the largest separation from a circle or an ellipsoid, see ``facing``: Newton's method uphill from a start.

        Its matrix are the radii of curvature of both and the separation. Where it is not positive, deep inside, it is made so.
        """
        m = start
        p = facing(rim, of, d, turn, m)
        here = wp.dot(m, p) - height(sq, m)
        last = int(0)
        rounds = int(0)
        while rounds < 2 * ROUNDS:
            rounds += 1
            h = height(sq, m)
            q = wp.cw_mul(sq, m) / h
            one = across(m)
            two = wp.cross(m, one)
            g_1 = wp.dot(p - q, one)
            g_2 = wp.dot(p - q, two)
            xx = (wp.dot(one, wp.cw_mul(sq, one)) - wp.dot(q, one) * wp.dot(q, one)) / h
            xy = (wp.dot(one, wp.cw_mul(sq, two)) - wp.dot(q, one) * wp.dot(q, two)) / h
            yy = (wp.dot(two, wp.cw_mul(sq, two)) - wp.dot(q, two) * wp.dot(q, two)) / h
            n = wp.transpose(turn) * m
            a = wp.transpose(turn) * one
            b = wp.transpose(turn) * two
            if rim:
                length = wp.sqrt(n[0] * n[0] + n[1] * n[1])
                if length > real(0.0):
                    along = vec3(-n[1], n[0], real(0.0)) / length
                    xx += of[0] / length * wp.dot(along, a) * wp.dot(along, a)
                    xy += of[0] / length * wp.dot(along, a) * wp.dot(along, b)
                    yy += of[0] / length * wp.dot(along, b) * wp.dot(along, b)
            else:
                h_other = height(of, n)
                r = wp.cw_mul(of, n) / h_other
                xx += (wp.dot(a, wp.cw_mul(of, a)) - wp.dot(r, a) * wp.dot(r, a)) / h_other
                xy += (wp.dot(a, wp.cw_mul(of, b)) - wp.dot(r, a) * wp.dot(r, b)) / h_other
                yy += (wp.dot(b, wp.cw_mul(of, b)) - wp.dot(r, b) * wp.dot(r, b)) / h_other
            mean = real(0.5) * (xx + yy)
            apart = wp.sqrt(real(0.25) * (xx - yy) * (xx - yy) + xy * xy)
            # Eigenvalues mean +- apart, each of them plus the separation.
            more = here + wp.max(real(0.0), real(1.0e-6) * (mean + apart) - (mean - apart + here))
            det = (xx + more) * (yy + more) - xy * xy
            y_1 = ((yy + more) * g_1 - xy * g_2) / det
            y_2 = ((xx + more) * g_2 - xy * g_1) / det
            step = y_1 * one + y_2 * two
            far = wp.length(step)
            if far > real(1.0):
                step = step / far
            if g_1 * y_1 + g_2 * y_2 < real(wp.static(GAIN[real])) * (h + wp.length(p)) and far < real(1.0e-2):
                # The rest converges as fast as that without a look at separations, in which it does not show.
                m = wp.normalize(m + step)
                p = facing(rim, of, d, turn, m)
                here = wp.dot(m, p) - height(sq, m)
                last += 1
                if last == LAST or far < real(wp.static(TURNED[real])):
                    break
            else:
                factor = real(1.0)
                better = bool(False)
                while not better and factor > real(1.0e-9):
                    n = wp.normalize(m + factor * step)
                    q = facing(rim, of, d, turn, n)
                    there = wp.dot(n, q) - height(sq, n)
                    if there > here:
                        better = True
                        m = n
                        p = q
                        here = there
                    factor *= real(0.5)
                if not better:
                    break
        return m

    @wp.func
    def rounded(hulls: Hulls, shape: int, size: vec3, sq: vec3, d: vec3, turn: mat33) -> Touch:
        """Of another ellipsoid, from normals towards its surface from the centre, back from its own, between both, and square to long axes.

        From the first on the way to the only maximum, unless they overlap by too much for that: then the best counts.
        """
        of = wp.cw_mul(size, size)
        best = Touch()
        best.gap = real(-1.0e30)
        best.face = -1
        k = int(0)
        while k < 4:
            m = foot(sq, d)
            if k == 1:
                m = -(turn * foot(of, -(wp.transpose(turn) * d)))
            elif k == 2 and wp.length_sq(d) > real(0.0):
                m = wp.normalize(d)
            elif k == 3:
                m = wp.cross(longest(sq), turn * longest(of))
                if wp.length_sq(m) == real(0.0):
                    m = across(longest(sq))
                m = wp.normalize(m)
                if wp.dot(m, d) < real(0.0):
                    m = -m
            m = climb(False, of, sq, d, turn, m)
            gap = wp.dot(m, facing(False, of, d, turn, m)) - height(sq, m)
            if gap > best.gap:
                best.gap = gap
                best.normal = m
            k += 1
            if gap > -sharpest(sq) - sharpest(of):
                k = 4
        return best

    @wp.func
    def better(hulls: Hulls, shape: int, size: vec3, sq: vec3, d: vec3, turn: mat33, best: Touch, m: vec3) -> Touch:
        """Of two normals the one of the larger separation from the whole shape."""
        result = best
        gap = wp.dot(m, d + turn * support(hulls, shape, size, -(wp.transpose(turn) * m))) - height(sq, m)
        if gap > result.gap:
            result.gap = gap
            result.normal = m
        return result

    @wp.func
    def round_rim(sq: vec3, radius: real, d: vec3, turn: mat33, cap: vec3, hint: vec3) -> vec3:
        """Normal of the largest separation from a disc whose middle d and axes `turn` are given; that of its cap is `cap`.

        It starts from the best of a hint, the point of the rim on the side to which the ellipsoid is, and less and less leaning normals.
        """
        of = vec3(radius, real(0.0), real(0.0))
        here = wp.dot(cap, d) - height(sq, cap)
        out = top(sq, cap) - d
        out -= cap * wp.dot(cap, out)
        start = cap
        leans = bool(False)
        if wp.length_sq(out) > real(0.0):
            out = wp.normalize(out)
            by_side = foot(sq, d + radius * out)
            m = hint
            if wp.length_sq(hint - cap) < real(1.0e-9):  # round-off would choose which point of the rim it means
                m = by_side
            factor = real(4.0)
            while factor > real(1.0e-12):
                there = wp.dot(m, facing(True, of, d, turn, m)) - height(sq, m)
                if there > here:
                    here = there
                    start = m
                    leans = True
                elif leans and factor < real(2.0):
                    factor = real(0.0)
                m = wp.normalize(cap - factor * out)
                if factor == real(4.0):
                    m = by_side
                factor *= real(0.5)
        if leans:
            start = climb(True, of, sq, d, turn, start)
        return start

    @wp.func
    def slanted(sq: vec3, size: vec3, tip: vec3, turn: mat33, angle: real) -> vec3:
        """Normal of the largest separation among those of a cone's round side, about the axis from an angle: Newton's method uphill."""
        slant = wp.sqrt(real(4.0) * size[1] * size[1] + size[0] * size[0])
        c = real(2.0) * size[1] / slant
        z = turn * vec3(real(0.0), real(0.0), size[0] / slant)
        x = turn * vec3(c, real(0.0), real(0.0))
        y = turn * vec3(real(0.0), c, real(0.0))
        turned_by = angle
        m = -(wp.cos(turned_by) * x + wp.sin(turned_by) * y + z)
        here = wp.dot(m, tip) - height(sq, m)
        last = int(0)
        rounds = int(0)
        while rounds < ROUNDS:
            rounds += 1
            d_1 = wp.sin(turned_by) * x - wp.cos(turned_by) * y
            d_2 = wp.cos(turned_by) * x + wp.sin(turned_by) * y
            h = height(sq, m)
            q = wp.cw_mul(sq, m) / h
            slope = wp.dot(tip - q, d_1)
            bending = (wp.dot(d_1, wp.cw_mul(sq, d_1)) - wp.dot(q, d_1) * wp.dot(q, d_1)) / h - wp.dot(tip - q, d_2)
            bending = wp.max(bending, real(1.0e-3) * h * c * c)
            step = wp.clamp(slope / bending, real(-1.0), real(1.0))
            if slope * step < real(wp.static(GAIN[real])) * (h + wp.length(tip)) and wp.abs(step) < real(1.0e-2):
                turned_by += step
                m = -(wp.cos(turned_by) * x + wp.sin(turned_by) * y + z)
                here = wp.dot(m, tip) - height(sq, m)
                last += 1
                if last == LAST or wp.abs(step) < real(wp.static(TURNED[real])):
                    break
            else:
                factor = real(1.0)
                found = bool(False)
                while not found and factor > real(1.0e-9):
                    there = turned_by + factor * step
                    n = -(wp.cos(there) * x + wp.sin(there) * y + z)
                    gap = wp.dot(n, tip) - height(sq, n)
                    if gap > here:
                        found = True
                        turned_by = there
                        m = n
                        here = gap
                    factor *= real(0.5)
                if not found:
                    break
        return m

    @wp.func
    def turned(hulls: Hulls, shape: int, size: vec3, sq: vec3, d: vec3, turn: mat33) -> Touch:
        """Of a cylinder or cone: its caps, its round side, its rims and its tip."""
        kind = hulls.kind[shape]
        z = turn * vec3(real(0.0), real(0.0), real(1.0))
        tip = d + size[1] * z
        best = Touch()
        best.gap = real(-1.0e30)
        best.face = -1
        settled = bool(False)
        for k in range(2):
            side = real(2 * k - 1)
            if k == 0 or kind == CYLINDER:
                m = -side * z
                best = better(hulls, shape, size, sq, d, turn, best, m)
                off = top(sq, m) - d
                if best.normal == m:
                    settled = wp.length(off - z * wp.dot(z, off)) <= size[0]
        # Of the rims that one beyond which the ellipsoid is.
        end = real(-1.0)
        if kind == CYLINDER:
            m = foot_beside(sq, d, z)
            where = wp.dot(top(sq, m) - d, z)
            if where >= real(0.0):
                end = real(1.0)
            gap = best.gap
            best = better(hulls, shape, size, sq, d, turn, best, m)
            if best.gap > gap:
                settled = wp.abs(where) <= size[1]
        settled = settled and best.gap > -sharpest(sq)
        rounds = int(0)
        while rounds < 2 and not settled:
            rounds += 1
            rim = round_rim(sq, size[0], d + end * size[1] * z, turn, -end * z, best.normal)
            best = better(hulls, shape, size, sq, d, turn, best, rim)
            if kind == CONE:
                best = better(hulls, shape, size, sq, d, turn, best, foot(sq, tip))
                out = -(wp.transpose(turn) * best.normal)
                if out[0] * out[0] + out[1] * out[1] < real(1.0e-12):
                    out = -(wp.transpose(turn) * d)
                m = slanted(sq, size, tip, turn, wp.atan2(out[1], out[0]))
                best = better(hulls, shape, size, sq, d, turn, best, m)
            # Where the shapes are nearest the gap leads from one surface to the other; else these are better starts than the last.
            x = wp.transpose(turn) * (top(sq, best.normal) + best.gap * best.normal - d)
            reach = size[0]
            if kind == CONE:
                reach = size[0] * (size[1] - x[2]) / (real(2.0) * size[1])
            slack = real(1.0e-6) * (size[0] + size[1])
            settled = wp.sqrt(x[0] * x[0] + x[1] * x[1]) < reach + slack and wp.abs(x[2]) < size[1] + slack
        return best

    return SimpleNamespace(Touch=Touch, height=height, top=top, foot=foot, faceted=faceted, turned=turned, rounded=rounded)


@functools.cache
def meeting(real, kind: str):
    """Function ``meet``: the contact of an ellipsoid with a shape of a kind, 'faceted', 'turned' or 'rounded'."""
    t = scalar_types(real)
    vec3, transform, spatial = t.vec3, t.transform, t.spatial
    f, e = pair_functions(real), touching(real)
    bend, rotation, Hulls, top = f.bend, f.rotation, functions(real).Hulls, e.top
    touch = getattr(e, kind)

    @wp.struct
    class Met:
        """World axes."""

        point: vec3
        normal: vec3  # towards the ellipsoid
        gap: real
        bend: real
        face: int

    @wp.func
    def moved(pose: transform, com: vec3, twist: spatial, h: real) -> transform:
        """A pose after h at the velocity of its body."""
        by = rotation(h * wp.spatial_bottom(twist))
        at = com + h * wp.spatial_top(twist) + wp.quat_rotate(by, wp.transform_get_translation(pose) - com)
        return transform(at, wp.mul(by, wp.transform_get_rotation(pose)))

    @wp.func
    def meet(
        hulls: Hulls,
        a: int,
        size_a: vec3,
        size_b: vec3,
        xa: transform,
        xb: transform,
        com_a: vec3,
        com_b: vec3,
        twist_a: spatial,
        twist_b: spatial,
        radius: real,
        core: real,
        near: real,
        h: real,
    ) -> Met:
        """Of shape a with an ellipsoid b.

        radius: of a ball or capsule a. core: of the balls that stand for both where ``bend`` compares what they overlap by with a
        distance. near: how far apart there is no contact, m.
        """
        sq = wp.cw_mul(size_b, size_b)
        result = Met()
        result.gap = real(NO_POINT)
        pose_a = xa
        pose_b = xb
        closing = vec3()
        rounds = int(0)
        while rounds < 2:
            axes = wp.quat_to_matrix(wp.transform_get_rotation(pose_b))
            middle = wp.transform_get_translation(pose_b)
            d = wp.transpose(axes) * (wp.transform_get_translation(pose_a) - middle)
            turn = wp.transpose(axes) * wp.quat_to_matrix(wp.transform_get_rotation(pose_a))
            found = touch(hulls, a, size_a, sq, d, turn)
            gap = found.gap - radius
            normal = -(axes * found.normal)
            if rounds == 0:
                if gap < near:
                    result.normal = normal
                    result.gap = gap
                    result.face = found.face
                    result.point = middle + axes * top(sq, found.normal) - normal * (real(0.5) * gap)
                    arm_a = result.point - com_a
                    arm_b = result.point - com_b
                    closing = wp.spatial_top(twist_b) + wp.cross(wp.spatial_bottom(twist_b), arm_b)
                    closing = h * (closing - wp.spatial_top(twist_a) - wp.cross(wp.spatial_bottom(twist_a), arm_a))
                    pose_a = moved(xa, com_a, twist_a, h)
                    pose_b = moved(xb, com_b, twist_b, h)
                else:
                    rounds = 2
            else:
                ahead = core + gap
                result.bend = bend(result.gap, core + result.gap, result.normal, closing, ahead, normal * ahead)
            rounds += 1
        return result

    return SimpleNamespace(meet=meet, moved=moved)


@factory
def make(real) -> dict:
    """Kernels by the lower shape type; launch with dim (E, lanes). Those of a mesh are in ``mesh``."""
    t = scalar_types(real)
    vec3 = t.vec3
    Bodies, Parameters, Slots, Topology = t.Bodies, t.Parameters, t.Slots, t.Topology
    f, e, Hulls = pair_functions(real), touching(real), functions(real).Hulls
    shape_pose, shape_motion, reach, bend = f.shape_pose, f.shape_motion, f.reach, f.bend
    write_bent = f.write_bent
    height, moved = e.height, meeting(real, "faceted").moved

    @kernel()
    def plane_ellipsoid(
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
                plane = shape_pose(topology, bodies, env, sa)
                pose = shape_pose(topology, bodies, env, sb)
                size = topology.shape_size[sb]
                sq = wp.cw_mul(size, size)
                com_a, twist_a = shape_motion(topology, bodies, env, sa)
                com_b, twist_b = shape_motion(topology, bodies, env, sb)
                normal = wp.transform_vector(plane, vec3(real(0.0), real(0.0), real(1.0)))
                m = wp.quat_rotate_inv(wp.transform_get_rotation(pose), normal)
                centre = wp.transform_get_translation(pose)
                over = height(sq, m)
                gap = wp.dot(normal, centre - wp.transform_get_translation(plane)) - over
                point = centre - wp.transform_vector(pose, wp.cw_mul(sq, m) / over) - normal * (real(0.5) * gap)
                # It rises and falls as it rolls.
                closing = wp.spatial_top(twist_b) + wp.cross(wp.spatial_bottom(twist_b), point - com_b)
                closing = h * (closing - wp.spatial_top(twist_a) - wp.cross(wp.spatial_bottom(twist_a), point - com_a))
                plane = moved(plane, com_a, twist_a, h)
                pose = moved(pose, com_b, twist_b, h)
                n = wp.transform_vector(plane, vec3(real(0.0), real(0.0), real(1.0)))
                over = height(sq, wp.quat_rotate_inv(wp.transform_get_rotation(pose), n))
                core = wp.min(size)
                ahead = core + wp.dot(n, wp.transform_get_translation(pose) - wp.transform_get_translation(plane)) - over
                left = bend(gap, core + gap, normal, closing, ahead, n * ahead)
                write_bent(slots, env, topology.pair_slots[pair], point, normal, gap, left, 0)

    def contact(kind: str):
        """Function that writes the contact of a pair of a kind, see ``meeting``."""
        meet = meeting(real, kind).meet
        other_is_ellipsoid = kind == "rounded"

        @wp.func
        def write_contact(topology: Topology, bodies: Bodies, env: int, pair: int, h: real, slots: Slots, hulls: Hulls):
            sa = topology.pairs[pair, 0]
            sb = topology.pairs[pair, 1]
            size_a = topology.shape_size[sa]
            size_b = topology.shape_size[sb]
            radius = real(0.0)
            core = wp.min(size_b)
            if wp.static(other_is_ellipsoid):
                core += wp.min(size_a)
            elif hulls.kind[sa] == SPHERE or hulls.kind[sa] == CAPSULE:
                radius = size_a[0]
                core += radius
            xa = shape_pose(topology, bodies, env, sa)
            xb = shape_pose(topology, bodies, env, sb)
            near = reach(topology, bodies, env, sa, wp.transform_get_translation(xa), wp.length(size_a), h)
            near += reach(topology, bodies, env, sb, wp.transform_get_translation(xb), wp.max(size_b), h)
            com_a, twist_a = shape_motion(topology, bodies, env, sa)
            com_b, twist_b = shape_motion(topology, bodies, env, sb)
            met = meet(hulls, sa, size_a, size_b, xa, xb, com_a, com_b, twist_a, twist_b, radius, core, near, h)
            write_bent(slots, env, topology.pair_slots[pair], met.point, met.normal, met.gap, met.bend, 0)

        return write_contact

    write_faceted, write_turned, write_rounded = (contact(kind) for kind in ("faceted", "turned", "rounded"))

    @kernel()
    def faceted_ellipsoid(
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
                write_faceted(topology, bodies, env, listed[env, index], h, slots, hulls)

    @kernel()
    def turned_ellipsoid(
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
                write_turned(topology, bodies, env, listed[env, index], h, slots, hulls)

    @kernel()
    def ellipsoid_ellipsoid(
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
                write_rounded(topology, bodies, env, listed[env, index], h, slots, hulls)

    return {
        "PLANE": plane_ellipsoid,
        **dict.fromkeys(("SPHERE", "BOX", "CAPSULE", "HULL"), faceted_ellipsoid),
        **dict.fromkeys(("CYLINDER", "CONE"), turned_ellipsoid),
        "ELLIPSOID": ellipsoid_ellipsoid,
    }
