# SPDX-License-Identifier: Apache-2.0
"""Kinematics and free motion of the bodies: q, v -> poses, and v_free = v + h M^-1 (f_a - c)  (eq. 24)."""

from types import SimpleNamespace

import warp as wp

from .declare import factory, kernel
from .types import FIXED, FREE, scalar_types

NEWTON_ITERATIONS = wp.constant(8)


@factory
def make(real) -> SimpleNamespace:
    """Kernels ``kinematics`` and ``free_motion`` for the scalar type ``real``; launch with dim (E, B)."""
    t = scalar_types(real)
    vec3, mat33, transform, spatial = t.vec3, t.mat33, t.transform, t.spatial
    Bodies, Parameters, Topology = t.Bodies, t.Parameters, t.Topology

    @wp.func
    def gyroscopic_midpoint(inertia: mat33, w: vec3, torque: vec3, h: real) -> vec3:
        """Angular velocity after h by the implicit midpoint rule on Euler's equations, body axes.

        I (w+ - w) = h (torque - x cross I x) at x = (w + w+) / 2. The rule keeps the quadratic invariants, so a
        torque-free body neither gains nor loses energy. Newton's method on x.
        """
        half = real(0.5) * h
        x = w
        small = real(1.0e-14) * wp.dot(w, w)
        if wp.static(real is wp.float32):
            small = real(1.0e-12) * wp.dot(w, w)
        converged = bool(False)
        for _ in range(NEWTON_ITERATIONS):
            if not converged:
                momentum = inertia * x
                residual = inertia * (x - w) + half * (wp.cross(x, momentum) - torque)
                jacobian = inertia + half * (wp.skew(x) * inertia - wp.skew(momentum))
                dx = wp.inverse(jacobian) * residual
                x = x - dx
                converged = wp.dot(dx, dx) <= small + real(1.0e-30)
        result = real(2.0) * x - w
        if not converged:
            # |h w| is far beyond what a step can resolve: leave the gyroscopic term out, which changes no energy.
            result = w + h * (wp.inverse(inertia) * torque)
        return result

    @kernel()
    def kinematics(q: wp.array2d(dtype=real), v: wp.array2d(dtype=real), topology: Topology, bodies: Bodies, stride: int):
        start, b = wp.tid()
        for env in range(start, q.shape[0], stride):
            if topology.joint_type[b] == FIXED:
                bodies.pose[env, b] = topology.joint_pose[b]
                bodies.velocity[env, b] = spatial()
                continue
            i = topology.q_start[b]
            j = topology.v_start[b]
            pose = transform()
            velocity = spatial()
            for k in range(7):
                pose[k] = q[env, i + k]
            for k in range(6):
                velocity[k] = v[env, j + k]
            # Users write q: a quaternion that is not of unit length would scale the body. Zero gives NaN, which is flagged.
            turn = wp.transform_get_rotation(pose)
            pose = transform(wp.transform_get_translation(pose), turn / wp.length(turn))
            bodies.pose[env, b] = pose
            bodies.velocity[env, b] = velocity

    @kernel()
    def free_motion(
        topology: Topology,
        parameters: Parameters,
        wrench: wp.array2d(dtype=spatial),
        h: real,
        bodies: Bodies,
        stride: int,
    ):
        start, b = wp.tid()
        for env in range(start, wrench.shape[0], stride):
            pose = bodies.pose[env, b]
            velocity = bodies.velocity[env, b]
            bodies.com[env, b] = wp.transform_point(pose, parameters.com[env % parameters.com.shape[0], b])
            if topology.joint_type[b] != FREE:
                bodies.inv_mass[env, b] = real(0.0)
                bodies.inv_inertia[env, b] = mat33()
                bodies.free_velocity[env, b] = velocity
                continue

            inv_mass = real(1.0) / parameters.mass[env % parameters.mass.shape[0], b]
            inertia = parameters.inertia[env % parameters.inertia.shape[0], b]
            gravity = parameters.gravity[env % parameters.gravity.shape[0]]
            force = wp.spatial_top(wrench[env, b])
            torque = wp.spatial_bottom(wrench[env, b])
            rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))

            v = wp.spatial_top(velocity) + h * (gravity + inv_mass * force)
            w = wp.transpose(rotation) * wp.spatial_bottom(velocity)
            w = rotation * gyroscopic_midpoint(inertia, w, wp.transpose(rotation) * torque, h)
            bodies.inv_mass[env, b] = inv_mass
            bodies.inv_inertia[env, b] = rotation * wp.inverse(inertia) * wp.transpose(rotation)
            bodies.free_velocity[env, b] = spatial(v[0], v[1], v[2], w[0], w[1], w[2])

    return SimpleNamespace(kinematics=kinematics, free_motion=free_motion)
