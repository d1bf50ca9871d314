# SPDX-License-Identifier: Apache-2.0
"""Gap functions of convex shapes on meshes of triangles that no force moves.

Each triangle near the shape is a hull without thickness, on whichever side the shape is. Where triangles go on in one plane their sides
make no points, and what touches several at the same point counts once. Of more points than a pair has slots the deepest stay. A point
keeps the slot in which it was one step ago.
"""

from types import SimpleNamespace

import warp as wp

from . import convex, ellipsoid, rounded
from .box_box import axes
from .collide import NO_POINT, pair_functions
from .declare import factory, kernel
from .shapes import functions
from .types import scalar_types

# Slots of a pair, by the type of the shape on the mesh: ball, capsule, sharp, ellipsoid.
SLOTS = {"SPHERE": 8, "CAPSULE": 12, "SHARP": 24, "ELLIPSOID": 8}
MOST = max(SLOTS.values())
# Of the size: points closer than this with normals alike are one.
SAME = wp.constant(1.0e-6)
# Sine: an ellipsoid that touches a seam leans by less than this from the triangles on either side, which need not be quite in one plane.
LEANS = wp.constant(1.0e-4)


@factory
def make(real) -> SimpleNamespace:
    """Kernels ``sharp_on_mesh``, ``round_on_mesh`` and ``ellipsoid_on_mesh``; launch with dim (E, lanes)."""
    t = scalar_types(real)
    vec3, transform = t.vec3, t.transform
    Bodies, Parameters, Slots, Topology = t.Bodies, t.Parameters, t.Slots, t.Topology
    f, a, Hulls = pair_functions(real), axes(real), functions(real).Hulls
    shape_pose, reach, shape_velocity, write_bent = f.shape_pose, f.reach, f.shape_velocity, f.write_bent
    shape_motion = f.shape_motion
    inverse_mass, touching_depth = a.inverse_mass, a.touching_depth
    meet_sharp, meet_round, meet_ellipsoid = convex.meeting(real), rounded.meeting(real), ellipsoid.meeting(real, "faceted").meet
    side_plane = functions(real).side_plane

    @wp.func
    def collect(
        normals: wp.array(dtype=vec3),
        at: wp.array(dtype=vec3),
        gaps: wp.array(dtype=real),
        bends: wp.array(dtype=real),
        features: wp.array(dtype=int),
        count: int,
        most: int,
        same: real,
        normal: vec3,
        point: vec3,
        gap: real,
        bend: real,
        feature: int,
    ) -> int:
        """Add a point to the list, unless it is there; in a full one it takes the place of that with the widest gap, if that is wider."""
        place = count
        widest = int(0)
        known = bool(False)
        for k in range(count):
            if wp.length_sq(at[k] - point) < same * same and wp.dot(normals[k], normal) > real(0.9999):
                known = True
            if gaps[k] > gaps[widest]:
                widest = k
        if count == most:
            place = widest
            if gap >= gaps[widest]:
                known = True
        if not known:
            normals[place] = normal
            at[place] = point
            gaps[place] = gap
            bends[place] = bend
            features[place] = feature
            if count < most:
                count += 1
        return count

    @wp.func
    def settle(
        slots: Slots,
        env: int,
        first: int,
        number: int,
        normals: wp.array(dtype=vec3),
        at: wp.array(dtype=vec3),
        gaps: wp.array(dtype=real),
        bends: wp.array(dtype=real),
        features: wp.array(dtype=int),
        count: int,
    ):
        """Points that were there a step ago go to their slots, others to free ones."""
        taken = int(0)
        placed = int(0)
        for k in range(number):
            slots.gap[env, first + k] = real(NO_POINT)
            before = slots.last_feature[env, first + k]
            for i in range(count):
                if before >= 0 and (placed & (1 << i)) == 0 and features[i] == before and (taken & (1 << k)) == 0:
                    write_bent(slots, env, first + k, at[i], normals[i], gaps[i], bends[i], features[i])
                    placed = placed | (1 << i)
                    taken = taken | (1 << k)
        free = int(0)
        for i in range(count):
            if (placed & (1 << i)) == 0:
                while (taken & (1 << free)) != 0:
                    free += 1
                write_bent(slots, env, first + free, at[i], normals[i], gaps[i], bends[i], features[i])
                taken = taken | (1 << free)

    @wp.func
    def bounds_in(mesh: transform, centre: vec3, radius: real, side: real) -> wp.vec3:
        """Corner of the box around a ball in the frame of the mesh, side -1 or 1, in single precision as the tree of triangles is."""
        c = wp.transform_point(wp.transform_inverse(mesh), centre)
        far = radius + real(1.0e-6) * (wp.length(c) + radius)
        return wp.vec3(
            wp.float32(c[0] + side * far),
            wp.float32(c[1] + side * far),
            wp.float32(c[2] + side * far),
        )

    @wp.func
    def normal_of(hulls: Hulls, mesh: transform, piece: int) -> vec3:
        return wp.transform_vector(mesh, hulls.normal[hulls.first_face[piece]])

    @kernel()
    def sharp_on_mesh(
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
                size = topology.shape_size[sa]
                xa = shape_pose(topology, bodies, env, sa)
                xb = shape_pose(topology, bodies, env, sb)
                centre = wp.transform_get_translation(xa)
                around = wp.length(size)
                near = around + reach(topology, bodies, env, sa, centre, around, h)
                near += reach(topology, bodies, env, sb, centre, around, h)
                inverse_a = inverse_mass(topology, bodies, env, sa)
                gravity = parameters.gravity[env % parameters.gravity.shape[0]]
                stiffness = parameters.pair_contact[env % parameters.pair_contact.shape[0], pair][0]
                deep = touching_depth(gravity, inverse_a, real(0.0), stiffness)
                u = -shape_velocity(topology, bodies, bodies.velocity, env, sa, centre)
                u += shape_velocity(topology, bodies, bodies.velocity, env, sb, centre)
                normals = wp.zeros(shape=(MOST,), dtype=vec3)
                at = wp.zeros(shape=(MOST,), dtype=vec3)
                gaps = wp.zeros(shape=(MOST,), dtype=real)
                bends = wp.zeros(shape=(MOST,), dtype=real)
                features = wp.zeros(shape=(MOST,), dtype=int)
                count = int(0)
                normal = wp.zeros(shape=(1,), dtype=vec3)
                points = wp.zeros(shape=(convex.POINTS,), dtype=vec3)
                depths = wp.zeros(shape=(convex.POINTS,), dtype=real)
                names = wp.zeros(shape=(convex.POINTS,), dtype=int)
                slot = topology.pair_slots[pair]
                number = topology.pair_slots[pair + 1] - slot
                low = bounds_in(xb, centre, near, real(-1.0))
                high = bounds_in(xb, centre, near, real(1.0))
                query = wp.mesh_query_aabb(hulls.mesh[sb], low, high)
                triangle = int(0)
                while wp.mesh_query_aabb_next(query, triangle):
                    k = hulls.first_piece[sb] + triangle
                    piece = topology.shape_size.shape[0] + k
                    place = wp.transform_multiply(xb, transform(hulls.centre[k], wp.quat_identity(dtype=real)))
                    middle = wp.transform_get_translation(place)
                    away = wp.length(middle - centre)
                    if away > near + hulls.radius[k] or wp.abs(wp.dot(normal_of(hulls, xb, piece), middle - centre)) > near:
                        continue
                    flat = vec3(hulls.radius[k], real(0.0), real(0.0))
                    found = meet_sharp(hulls, sa, piece, size, flat, xa, place, h * u, deep, real(0.0), normal, points, depths, names)
                    for m in range(found):
                        if depths[m] < near:
                            name = ((names[m] % 32749) * 32749 + triangle) & 0x3FFFFFFF
                            count = collect(
                                normals,
                                at,
                                gaps,
                                bends,
                                features,
                                count,
                                number,
                                real(SAME) * around,
                                normal[0],
                                points[m],
                                depths[m],
                                real(0.0),
                                name,
                            )
                settle(slots, env, slot, number, normals, at, gaps, bends, features, count)

    @kernel()
    def round_on_mesh(
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
                size = topology.shape_size[sa]
                slot = topology.pair_slots[pair]
                number = topology.pair_slots[pair + 1] - slot
                half = real(0.0)
                if number > wp.static(SLOTS["SPHERE"]):
                    half = size[1]
                xa = shape_pose(topology, bodies, env, sa)
                xb = shape_pose(topology, bodies, env, sb)
                centre = wp.transform_get_translation(xa)
                near = size[0] + reach(topology, bodies, env, sa, centre, size[0] + half, h)
                near += reach(topology, bodies, env, sb, centre, size[0] + half, h)
                com_a, twist_a = shape_motion(topology, bodies, env, sa)
                com_b, twist_b = shape_motion(topology, bodies, env, sb)
                normals = wp.zeros(shape=(MOST,), dtype=vec3)
                at = wp.zeros(shape=(MOST,), dtype=vec3)
                gaps = wp.zeros(shape=(MOST,), dtype=real)
                bends = wp.zeros(shape=(MOST,), dtype=real)
                features = wp.zeros(shape=(MOST,), dtype=int)
                count = int(0)
                outward = wp.zeros(shape=(3,), dtype=vec3)
                points = wp.zeros(shape=(3,), dtype=vec3)
                depths = wp.zeros(shape=(3,), dtype=real)
                curved = wp.zeros(shape=(3,), dtype=real)
                names = wp.zeros(shape=(3,), dtype=int)
                low = bounds_in(xb, centre, near + half, real(-1.0))
                high = bounds_in(xb, centre, near + half, real(1.0))
                query = wp.mesh_query_aabb(hulls.mesh[sb], low, high)
                triangle = int(0)
                while wp.mesh_query_aabb_next(query, triangle):
                    k = hulls.first_piece[sb] + triangle
                    piece = topology.shape_size.shape[0] + k
                    place = wp.transform_multiply(xb, transform(hulls.centre[k], wp.quat_identity(dtype=real)))
                    flat = vec3(hulls.radius[k], real(0.0), real(0.0))
                    meet_round(
                        hulls,
                        sa,
                        piece,
                        size,
                        flat,
                        xa,
                        place,
                        com_a,
                        com_b,
                        twist_a,
                        twist_b,
                        half,
                        near,
                        h,
                        outward,
                        points,
                        depths,
                        curved,
                        names,
                    )
                    for m in range(3):
                        if (m == 0 or half > real(0.0)) and depths[m] < near:
                            name = ((names[m] * 3 + m) * 32749 + triangle) & 0x3FFFFFFF
                            count = collect(
                                normals,
                                at,
                                gaps,
                                bends,
                                features,
                                count,
                                number,
                                real(SAME) * size[0],
                                outward[m],
                                points[m],
                                depths[m],
                                curved[m],
                                name,
                            )
                settle(slots, env, slot, number, normals, at, gaps, bends, features, count)

    @wp.func
    def at_seam(hulls: Hulls, piece: int, place: transform, point: vec3, slack: real) -> bool:
        """Is the nearest point of a triangle on a side beyond which the surface goes on, or on a corner between two such sides?"""
        face = hulls.first_face[piece]
        x = wp.transform_point(wp.transform_inverse(place), point)
        on = int(0)
        seams = int(0)
        for k in range(3):
            plane = side_plane(hulls, piece, vec3(), face, k)
            if plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] > plane[3] - slack:
                on += 1
                if (hulls.seam[face] & (1 << k)) != 0:
                    seams += 1
        return on > 0 and on == seams

    @kernel()
    def ellipsoid_on_mesh(
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
                size = topology.shape_size[sb]
                around = wp.max(size)
                core = wp.min(size)
                xa = shape_pose(topology, bodies, env, sa)
                xb = shape_pose(topology, bodies, env, sb)
                centre = wp.transform_get_translation(xb)
                near = reach(topology, bodies, env, sb, centre, around, h) + reach(topology, bodies, env, sa, centre, around, h)
                com_a, twist_a = shape_motion(topology, bodies, env, sa)
                com_b, twist_b = shape_motion(topology, bodies, env, sb)
                normals = wp.zeros(shape=(MOST,), dtype=vec3)
                at = wp.zeros(shape=(MOST,), dtype=vec3)
                gaps = wp.zeros(shape=(MOST,), dtype=real)
                bends = wp.zeros(shape=(MOST,), dtype=real)
                features = wp.zeros(shape=(MOST,), dtype=int)
                count = int(0)
                slot = topology.pair_slots[pair]
                number = topology.pair_slots[pair + 1] - slot
                low = bounds_in(xa, centre, around + near, real(-1.0))
                high = bounds_in(xa, centre, around + near, real(1.0))
                query = wp.mesh_query_aabb(hulls.mesh[sa], low, high)
                triangle = int(0)
                while wp.mesh_query_aabb_next(query, triangle):
                    k = hulls.first_piece[sa] + triangle
                    piece = topology.shape_size.shape[0] + k
                    place = wp.transform_multiply(xa, transform(hulls.centre[k], wp.quat_identity(dtype=real)))
                    out = normal_of(hulls, xa, piece)
                    if wp.abs(wp.dot(out, wp.transform_get_translation(place) - centre)) > around + near:
                        continue
                    flat = vec3(hulls.radius[k], real(0.0), real(0.0))
                    met = meet_ellipsoid(hulls, piece, flat, size, place, xb, com_a, com_b, twist_a, twist_b, real(0.0), core, near, h)
                    if met.gap < near:
                        # Where the surface goes on nothing ends.
                        ends = met.face < 0 and wp.length(wp.cross(met.normal, out)) > real(LEANS)
                        on_piece = met.point - met.normal * (real(0.5) * met.gap)
                        if not (ends and at_seam(hulls, piece, place, on_piece, real(SAME) * flat[0])):
                            count = collect(
                                normals,
                                at,
                                gaps,
                                bends,
                                features,
                                count,
                                number,
                                real(SAME) * around,
                                met.normal,
                                met.point,
                                met.gap,
                                met.bend,
                                triangle,
                            )
                settle(slots, env, slot, number, normals, at, gaps, bends, features, count)

    return SimpleNamespace(sharp_on_mesh=sharp_on_mesh, round_on_mesh=round_on_mesh, ellipsoid_on_mesh=ellipsoid_on_mesh)
