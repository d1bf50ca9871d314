# SPDX-License-Identifier: Apache-2.0
"""Gap functions phi (eq. 3) of the shape pairs: plane, sphere and box; box against box is in ``box_box``.

Every pair owns a fixed range of contact slots. A slot gets a point half-way across the gap, the unit normal from
shape a to shape b, the gap (negative = penetration) and a feature number that stays the same while the same corner,
edge or face touches. A slot without a point gets the gap NO_POINT.

Kernels of pairs walk over those that their bounds do not tell apart. They stand in `listed` [E, K + 1 + P], of P pairs of K kinds: first
where those of each kind start in the row and where the last ends, then the pairs, in order. Kinds with planes, before all others, are there
as a whole.
"""

from types import SimpleNamespace

import warp as wp

from .declare import factory, kernel
from .types import scalar_types

NO_POINT = wp.constant(1.0e30)
# Cosine: directions from faces of a box that are square to each other, rotated to world axes, agree by less than this.
SQUARE = wp.constant(1.0e-6)
# Of the distance: shapes that overlap by less ahead do not meet, as what rests on both and sinks in does not.
HAIR = wp.constant(1.0e-2)
# How many times what they overlap by beyond that is taken from what is bent, which so fades out.
FADING = wp.constant(4.0)


@factory
def pair_functions(real) -> SimpleNamespace:
    """Functions that every pair kernel uses."""
    t = scalar_types(real)
    vec3, vec4, quat, transform, spatial = t.vec3, t.vec4, t.quat, t.transform, t.spatial
    Bodies, Slots, Topology = t.Bodies, t.Slots, t.Topology

    @wp.func
    def shape_pose(topology: Topology, bodies: Bodies, env: int, shape: int) -> transform:
        """Pose of a shape in the world."""
        body = topology.shape_body[shape]
        pose = topology.shape_pose[shape]
        if body >= 0:
            pose = wp.transform_multiply(bodies.pose[env, body], pose)
        return pose

    @wp.func
    def reach(topology: Topology, bodies: Bodies, env: int, shape: int, centre: vec3, radius: real, h: real) -> real:
        """How far a point within `radius` of `centre` travels with a shape in 2 h, hit or not, and a hundredth of the radius."""
        travel = real(0.01) * radius + real(2.0) * h * wp.length(topology.surface_velocity[shape])
        body = topology.shape_body[shape]
        if body >= 0:
            twist = bodies.free_velocity[env, body]
            lever = radius + wp.length(centre - bodies.com[env, body])
            travel += real(2.0) * h * (wp.length(wp.spatial_top(twist)) + wp.length(wp.spatial_bottom(twist)) * lever)
            if bodies.alert.shape[0] > 0:
                travel += real(2.0) * h * bodies.alert[env]
        return travel

    @wp.func
    def sum_norm(x: vec3) -> real:
        return wp.abs(x[0]) + wp.abs(x[1]) + wp.abs(x[2])

    @wp.func
    def far_apart(a: spatial, b: spatial) -> bool:
        """Are two shapes further apart along an axis of the world than ``reach`` allows for, by their bounds?"""
        return wp.abs(a[0] - b[0]) >= a[3] + b[3] or wp.abs(a[1] - b[1]) >= a[4] + b[4] or wp.abs(a[2] - b[2]) >= a[5] + b[5]

    @wp.func
    def greatest_speed(bodies: Bodies, twist: spatial, env: int, body: int, centre: vec3, radius: real) -> real:
        """At least that of any point within `radius` of `centre`, without a root."""
        lever = radius + sum_norm(centre - bodies.com[env, body])
        return sum_norm(wp.spatial_top(twist)) + sum_norm(wp.spatial_bottom(twist)) * lever

    @wp.func
    def fastest(topology: Topology, extent: wp.array(dtype=vec4), bodies: Bodies, env: int) -> real:
        """Twice the speed that no point of a shape exceeds: faster no two approach each other."""
        result = real(0.0)
        for shape in range(topology.shape_body.shape[0]):
            body = topology.shape_body[shape]
            if body >= 0:
                half = extent[shape]
                centre = wp.transform_point(bodies.pose[env, body], wp.transform_get_translation(topology.shape_pose[shape]))
                radius = sum_norm(vec3(half[0], half[1], half[2])) + half[3]
                result = wp.max(result, greatest_speed(bodies, bodies.velocity[env, body], env, body, centre, radius))
        return real(2.0) * result

    @kernel()
    def bounds(topology: Topology, extent: wp.array(dtype=vec4), bodies: Bodies, h: real, lanes: int, stride: int):
        """Centre of every shape, and how far it extends along the axes of the world, with at least its ``reach``; of the world's once.

        extent: Model.shape_extent. Where no step has said how fast something hits something, the fastest that moves might.
        """
        start, lane = wp.tid()
        for env in range(start, bodies.bounds.shape[0], stride):
            alert = real(0.0)
            if bodies.alert.shape[0] > 0:
                alert = bodies.alert[env]
                if alert < real(0.0):
                    alert = fastest(topology, extent, bodies, env)
                    bodies.alert[env] = alert  # lanes that come later find what they would have written
            for shape in range(lane, bodies.bounds.shape[1], lanes):
                body = topology.shape_body[shape]
                if body < 0 and bodies.bounds[env, shape][3] > real(0.0):
                    continue
                half = extent[shape]
                radius = sum_norm(vec3(half[0], half[1], half[2])) + half[3]
                pose = topology.shape_pose[shape]
                far = real(0.02) * radius + half[3] + real(2.0) * h * sum_norm(topology.surface_velocity[shape])
                if body >= 0:
                    pose = wp.transform_multiply(bodies.pose[env, body], pose)
                    centre = wp.transform_get_translation(pose)
                    speed = greatest_speed(bodies, bodies.free_velocity[env, body], env, body, centre, radius)
                    far += real(2.0) * h * (speed + alert)
                centre = wp.transform_get_translation(pose)
                R = wp.quat_to_matrix(wp.transform_get_rotation(pose))
                x = wp.abs(R[0, 0]) * half[0] + wp.abs(R[0, 1]) * half[1] + wp.abs(R[0, 2]) * half[2]
                y = wp.abs(R[1, 0]) * half[0] + wp.abs(R[1, 1]) * half[1] + wp.abs(R[1, 2]) * half[2]
                z = wp.abs(R[2, 0]) * half[0] + wp.abs(R[2, 1]) * half[1] + wp.abs(R[2, 2]) * half[2]
                bodies.bounds[env, shape] = spatial(centre[0], centre[1], centre[2], x + far, y + far, z + far)

    @kernel()
    def list_pairs(
        pairs: wp.array2d(dtype=int),
        pair_slots: wp.array(dtype=int),
        kind_pairs: wp.array(dtype=int),
        first: int,
        bounds: wp.array2d(dtype=spatial),
        gap: wp.array2d(dtype=real),
        last_feature: wp.array2d(dtype=int),
        listed: wp.array2d(dtype=int),
        stride: int,
    ):
        """Pairs that are not far apart, of the kinds from `first` on; pairs kind_pairs[k] ... kind_pairs[k + 1] - 1 are of kind k.

        A pair that leaves the list loses its points and its history then; as long as it stays away nothing but its bounds is looked at.
        """
        start, _ = wp.tid()
        kinds = kind_pairs.shape[0] - 1
        for env in range(start, listed.shape[0], stride):
            end = listed[env, first]
            for index in range(end, listed[env, kinds]):
                pair = listed[env, index]
                if far_apart(bounds[env, pairs[pair, 0]], bounds[env, pairs[pair, 1]]):
                    for slot in range(pair_slots[pair], pair_slots[pair + 1]):
                        gap[env, slot] = real(NO_POINT)
                        last_feature[env, slot] = -1
            for kind in range(first, kinds):
                listed[env, kind] = end
                for pair in range(kind_pairs[kind], kind_pairs[kind + 1]):
                    if not far_apart(bounds[env, pairs[pair, 0]], bounds[env, pairs[pair, 1]]):
                        listed[env, end] = pair
                        end += 1
            listed[env, kinds] = end

    @wp.func
    def shape_velocity(
        topology: Topology, bodies: Bodies, velocity: wp.array2d(dtype=t.spatial), env: int, shape: int, point: vec3
    ) -> vec3:
        """Velocity of a point of a shape for given velocities of the bodies, world axes."""
        u = vec3()
        body = topology.shape_body[shape]
        if body >= 0:
            twist = velocity[env, body]
            u = wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), point - bodies.com[env, body])
        return u

    @wp.func
    def shape_turn(topology: Topology, bodies: Bodies, env: int, shape: int, h: real) -> vec3:
        """How far a shape turns in h at its present velocity, rad, world axes."""
        turn = vec3()
        body = topology.shape_body[shape]
        if body >= 0:
            turn = h * wp.spatial_bottom(bodies.velocity[env, body])
        return turn

    @wp.func
    def shape_motion(topology: Topology, bodies: Bodies, env: int, shape: int):
        """Centre of mass and velocity of the body that a shape is on, zero for the world's."""
        com = vec3()
        twist = spatial()
        body = topology.shape_body[shape]
        if body >= 0:
            com = bodies.com[env, body]
            twist = bodies.velocity[env, body]
        return com, twist

    @wp.func
    def rotation(turn: vec3) -> quat:
        """By this vector, but for its third power / 12; exactly none by zero."""
        half = real(0.5) * turn
        return wp.normalize(quat(half[0], half[1], half[2], real(1.0)))

    @wp.func
    def shift(topology: Topology, bodies: Bodies, env: int, shape: int, p: vec3, h: real) -> vec3:
        """How far a point p is carried with a shape in h at its present velocity, world axes."""
        result = vec3()
        body = topology.shape_body[shape]
        if body >= 0:
            arm = p - bodies.com[env, body]
            turned = wp.quat_rotate(rotation(shape_turn(topology, bodies, env, shape, h)), arm)
            result = h * wp.spatial_top(bodies.velocity[env, body]) + (turned - arm)
        return result

    @wp.func
    def outside_box(p: vec3, size: vec3) -> vec3:
        """From the nearest point of a box to p, in the frame of the box; zero inside."""
        return p - vec3(wp.clamp(p[0], -size[0], size[0]), wp.clamp(p[1], -size[1], size[1]), wp.clamp(p[2], -size[2], size[2]))

    @wp.func
    def bend(gap: real, distance: real, n: vec3, closing: vec3, distance_ahead: real, n_ahead: vec3) -> real:
        """How much more gap is left after a motion than gap + n . closing, the tangent plane's.

        Of a point or segment from another shape; n and n_ahead point from the one to the other, n_ahead is of length distance_ahead.
        What is left between the two as a whole counts, wherever it is. Less than the plane's is left only where shapes turn.

        Nothing where they pass through each other: space behind an obstacle is not free. Where they meet, what is bent until
        then, as the motion goes on otherwise: a part that falls with the square of the time. (With all of it a capsule that falls
        on an edge at 8 m/s and sticks enters a box by 27 mm at 10 ms.) By a hair, as what rolls on to the next tile meets it, and
        its edge on the way, they do not meet.

        Shapes ahead are moved and turned by themselves: carried along its velocity in the axes of a turning shape, what stays
        beside it would leave it on a tangent.

        The motion is that of present velocities, not of free ones: what supports a rolling sphere takes the fall that free
        motion adds, and an edge ahead must not take it too.
        """
        result = real(0.0)
        if distance_ahead > real(0.0) and wp.dot(n, n_ahead) > real(SQUARE) * distance_ahead:
            change = wp.dot(n, closing)
            result = distance_ahead - distance - change
            after = gap + (distance_ahead - distance) + real(HAIR) * distance
            if gap > real(0.0) and after < real(0.0) and result > real(0.0):
                # gap + change t + result t^2 = 0
                t = real(2.0) * gap / (wp.sqrt(wp.max(change * change - real(4.0) * result * gap, real(0.0))) - change)
                result = wp.max(result * t * t, result + real(FADING) * after)
        return result

    @wp.func
    def write_bent(slots: Slots, env: int, slot: int, point: vec3, normal: vec3, gap: real, bend: real, feature: int):
        slots.point[env, slot] = point
        slots.normal[env, slot] = normal
        slots.gap[env, slot] = gap
        slots.bend[env, slot] = bend
        slots.feature[env, slot] = feature

    @wp.func
    def write(slots: Slots, env: int, slot: int, point: vec3, normal: vec3, gap: real, feature: int):
        """A point between flat features: its gap changes by h u_n."""
        write_bent(slots, env, slot, point, normal, gap, real(0.0), feature)

    return SimpleNamespace(
        shape_pose=shape_pose,
        reach=reach,
        bounds=bounds,
        list_pairs=list_pairs,
        shape_velocity=shape_velocity,
        shape_turn=shape_turn,
        shape_motion=shape_motion,
        rotation=rotation,
        shift=shift,
        outside_box=outside_box,
        bend=bend,
        write=write,
        write_bent=write_bent,
    )


@factory
def make(real) -> dict:
    """Kernels by the names of the two shape types; launch with dim (E, lanes).

    ``kind`` numbers the kinds of pairs; those that leave out far points look ahead by ``h``.
    """
    t = scalar_types(real)
    vec3 = t.vec3
    Bodies, Parameters, Slots, Topology = t.Bodies, t.Parameters, t.Slots, t.Topology
    f = pair_functions(real)
    shape_pose, reach, shape_velocity, write, write_bent = f.shape_pose, f.reach, f.shape_velocity, f.write, f.write_bent
    outside_box, bend, shape_turn, rotation, shift = f.outside_box, f.bend, f.shape_turn, f.rotation, f.shift

    @kernel()
    def plane_sphere(
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
                centre = wp.transform_get_translation(shape_pose(topology, bodies, env, topology.pairs[pair, 1]))
                radius = topology.shape_size[topology.pairs[pair, 1]][0]
                normal = wp.transform_vector(plane, vec3(real(0.0), real(0.0), real(1.0)))
                gap = wp.dot(normal, centre - wp.transform_get_translation(plane)) - radius
                point = centre - normal * (radius + real(0.5) * gap)
                write(slots, env, topology.pair_slots[pair], point, normal, gap, 0)

    @kernel()
    def plane_box(
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
                box = shape_pose(topology, bodies, env, topology.pairs[pair, 1])
                size = topology.shape_size[topology.pairs[pair, 1]]
                normal = wp.transform_vector(plane, vec3(real(0.0), real(0.0), real(1.0)))
                origin = wp.transform_get_translation(plane)
                centre = wp.transform_get_translation(box)
                radius = wp.length(size)
                # A corner further away than this gets no row; most have none, so they get no point either.
                near = reach(topology, bodies, env, topology.pairs[pair, 0], centre, radius, h)
                near += reach(topology, bodies, env, topology.pairs[pair, 1], centre, radius, h)
                turn = wp.quat_to_matrix(wp.transform_get_rotation(box))
                slot = topology.pair_slots[pair]
                above = wp.dot(normal, centre - origin)
                rise = wp.cw_mul(normal * turn, size)  # of a corner over the centre, along each axis of the box
                for k in range(8):
                    side = vec3(real(-1.0), real(-1.0), real(-1.0))
                    for axis in range(3):
                        if (k & (1 << axis)) != 0:
                            side[axis] = real(1.0)
                    gap = above + side[0] * rise[0] + side[1] * rise[1] + side[2] * rise[2]
                    if gap < near:
                        vertex = centre + turn * wp.cw_mul(side, size)
                        write(slots, env, slot + k, vertex - normal * (real(0.5) * gap), normal, gap, k)
                    else:
                        slots.gap[env, slot + k] = real(NO_POINT)

    @kernel()
    def sphere_sphere(
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
                ra = topology.shape_size[topology.pairs[pair, 0]][0]
                rb = topology.shape_size[topology.pairs[pair, 1]][0]
                a = wp.transform_get_translation(shape_pose(topology, bodies, env, topology.pairs[pair, 0]))
                b = wp.transform_get_translation(shape_pose(topology, bodies, env, topology.pairs[pair, 1]))
                offset = b - a
                distance = wp.length(offset)
                normal = vec3(real(0.0), real(0.0), real(1.0))  # concentric spheres have none: any will part them
                if distance > real(0.0):
                    normal = offset / distance
                gap = distance - ra - rb
                u = shape_velocity(topology, bodies, bodies.velocity, env, topology.pairs[pair, 1], b)
                u -= shape_velocity(topology, bodies, bodies.velocity, env, topology.pairs[pair, 0], a)
                ahead = offset + shift(topology, bodies, env, topology.pairs[pair, 1], b, h)
                ahead -= shift(topology, bodies, env, topology.pairs[pair, 0], a, h)
                left = bend(gap, distance, normal, h * u, wp.length(ahead), ahead)
                write_bent(slots, env, topology.pair_slots[pair], a + normal * (ra + real(0.5) * gap), normal, gap, left, 0)

    @kernel()
    def sphere_box(
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
                radius = topology.shape_size[topology.pairs[pair, 0]][0]
                size = topology.shape_size[topology.pairs[pair, 1]]
                centre = wp.transform_get_translation(shape_pose(topology, bodies, env, topology.pairs[pair, 0]))
                box = shape_pose(topology, bodies, env, topology.pairs[pair, 1])
                local = wp.transform_point(wp.transform_inverse(box), centre)
                inward = -outside_box(local, size)
                nearest = local + inward
                distance = wp.length(inward)
                if distance > real(0.0):
                    inward = inward / distance
                else:
                    # The centre is inside: leave through the nearest face.
                    axis = int(0)
                    depth = size[0] - wp.abs(local[0])
                    for k in range(1, 3):
                        d = size[k] - wp.abs(local[k])
                        if d < depth:
                            depth = d
                            axis = k
                    side = real(1.0)
                    if local[axis] < real(0.0):
                        side = real(-1.0)
                    inward = vec3()
                    inward[axis] = -side
                    nearest[axis] = side * size[axis]
                    distance = -depth
                normal = wp.transform_vector(box, inward)
                gap = distance - radius
                point = wp.transform_point(box, nearest) - normal * (real(0.5) * gap)
                turn = wp.transform_get_rotation(box)
                u = shape_velocity(topology, bodies, bodies.velocity, env, topology.pairs[pair, 0], centre)
                closing = h * (u - shape_velocity(topology, bodies, bodies.velocity, env, topology.pairs[pair, 1], centre))
                # In the axes of the box, which turn as well.
                move = shift(topology, bodies, env, topology.pairs[pair, 0], centre, h)
                move -= shift(topology, bodies, env, topology.pairs[pair, 1], wp.transform_get_translation(box), h)
                further = rotation(wp.quat_rotate_inv(turn, shape_turn(topology, bodies, env, topology.pairs[pair, 1], h)))
                ahead = outside_box(wp.quat_rotate_inv(further, local + wp.quat_rotate_inv(turn, move)), size)
                left = bend(gap, distance, -normal, closing, wp.length(ahead), wp.quat_rotate(turn, wp.quat_rotate(further, ahead)))
                write_bent(slots, env, topology.pair_slots[pair], point, normal, gap, left, 0)

    return {
        ("PLANE", "SPHERE"): plane_sphere,
        ("PLANE", "BOX"): plane_box,
        ("SPHERE", "SPHERE"): sphere_sphere,
        ("SPHERE", "BOX"): sphere_box,
    }
