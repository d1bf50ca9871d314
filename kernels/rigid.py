# SPDX-License-Identifier: Apache-2.0
"""J and M^-1 J^T of one rigid body at one point: what every stage that touches contacts is made of."""

import functools
from types import SimpleNamespace

import warp as wp

from .types import scalar_types


@functools.cache
def functions(real) -> SimpleNamespace:
    """What a body does at a point; arm: from the centre of mass to the point, world axes."""
    t = scalar_types(real)
    vec3, mat33, quat, transform, spatial = t.vec3, t.mat33, t.quat, t.transform, t.spatial

    @wp.func
    def point_velocity(twist: spatial, arm: vec3) -> vec3:
        """J v: velocity of the material point at `arm`."""
        return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), arm)

    @wp.func
    def wrench(arm: vec3, impulse: vec3) -> spatial:
        """J^T p: an impulse at `arm` about the centre of mass."""
        moment = wp.cross(arm, impulse)
        return spatial(impulse[0], impulse[1], impulse[2], moment[0], moment[1], moment[2])

    @wp.func
    def response(inv_mass: real, inv_inertia: mat33, total: spatial) -> spatial:
        """M^-1 of a wrench [N s, N m s]: change of velocity."""
        dv = inv_mass * wp.spatial_top(total)
        dw = inv_inertia * wp.spatial_bottom(total)
        return spatial(dv[0], dv[1], dv[2], dw[0], dw[1], dw[2])

    @wp.func
    def times_skew(m: mat33, r: vec3) -> mat33:
        """M [r], without the products with its zeros."""
        return wp.matrix_from_rows(wp.cross(m[0], r), wp.cross(m[1], r), wp.cross(m[2], r))

    @wp.func
    def skew_times(r: vec3, m: mat33) -> mat33:
        """[r] M, likewise."""
        x = wp.cross(r, vec3(m[0, 0], m[1, 0], m[2, 0]))
        y = wp.cross(r, vec3(m[0, 1], m[1, 1], m[2, 1]))
        z = wp.cross(r, vec3(m[0, 2], m[1, 2], m[2, 2]))
        return wp.matrix_from_cols(x, y, z)

    @wp.func
    def mobility(inv_mass: real, inv_inertia: mat33, arm: vec3, other: vec3) -> mat33:
        """J M^-1 J^T between two points of a body: velocity at `arm` for an impulse at `other`, 1/m E - [arm] I^-1 [other]."""
        return wp.diag(vec3(inv_mass)) - skew_times(arm, times_skew(inv_inertia, other))

    @wp.func
    def direction_mobility(inv_mass: real, inv_inertia: mat33, arm: vec3, direction: vec3) -> real:
        """The same at one point along one unit direction: 1/m + (arm x d) . I^-1 (arm x d)."""
        moment = wp.cross(arm, direction)
        return inv_mass + wp.dot(moment, inv_inertia * moment)

    @wp.func
    def delassus(
        body: wp.array2d(dtype=wp.vec2i),
        point: wp.array2d(dtype=vec3),
        frame: wp.array2d(dtype=mat33),
        com: wp.array2d(dtype=vec3),
        inv_mass: wp.array2d(dtype=real),
        inv_inertia: wp.array2d(dtype=mat33),
        env: int,
        i: int,
        j: int,
    ) -> mat33:
        """Block (i, j) of J M^-1 J^T of the contacts of an environment, rows and columns n t1 t2."""
        total = mat33()
        for x in range(2):
            b = body[env, i][x]
            if b >= 0:
                for y in range(2):
                    if body[env, j][y] == b:
                        block = mobility(inv_mass[env, b], inv_inertia[env, b], point[env, i] - com[env, b], point[env, j] - com[env, b])
                        if x == y:
                            total += block
                        else:
                            total -= block
        return frame[env, i] * total * wp.transpose(frame[env, j])

    @wp.func
    def rotation_by(w: vec3, h: real) -> quat:
        """exp(h w)."""
        angle = h * wp.length(w)
        turn = wp.quat_identity(dtype=real)
        if angle > real(0.0):
            turn = wp.quat_from_axis_angle(wp.normalize(w), angle)
        return turn

    @wp.func
    def moved(pose: transform, com: vec3, velocity: vec3, turn: quat, h: real) -> transform:
        """Pose of the body frame: the centre of mass moves straight, the body turns about it."""
        offset = wp.quat_rotate(turn, wp.transform_get_translation(pose) - com)
        return transform(com + h * velocity + offset, wp.normalize(turn * wp.transform_get_rotation(pose)))

    return SimpleNamespace(
        rotation_by=rotation_by,
        moved=moved,
        point_velocity=point_velocity,
        wrench=wrench,
        response=response,
        times_skew=times_skew,
        skew_times=skew_times,
        mobility=mobility,
        delassus=delassus,
        direction_mobility=direction_mobility,
    )
