# SPDX-License-Identifier: Apache-2.0
"""J and M^-1 J^T of one rigid body at one point: what every stage that touches contacts is made of."""

import functools
from types import SimpleNamespace

import warp as wp

from .types import scalar_types


@functools.cache
def functions(real) -> SimpleNamespace:
    """``point_velocity``, ``impulse_response`` and ``mobility``; arm: from the centre of mass to the point, world axes."""
    t = scalar_types(real)
    vec3, mat33, spatial = t.vec3, t.mat33, t.spatial

    @wp.func
    def point_velocity(twist: spatial, arm: vec3) -> vec3:
        """J v: velocity of the material point at `arm`."""
        return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), arm)

    @wp.func
    def impulse_response(inv_mass: real, inv_inertia: mat33, arm: vec3, impulse: vec3) -> spatial:
        """M^-1 J^T p: change of velocity by an impulse at `arm`."""
        dv = inv_mass * impulse
        dw = inv_inertia * wp.cross(arm, impulse)
        return spatial(dv[0], dv[1], dv[2], dw[0], dw[1], dw[2])

    @wp.func
    def mobility(inv_mass: real, inv_inertia: mat33, arm: vec3, other: vec3) -> mat33:
        """J M^-1 J^T between two points of a body: velocity at `arm` for an impulse at `other`, 1/m E - [arm] I^-1 [other]."""
        return wp.diag(vec3(inv_mass)) - wp.skew(arm) * inv_inertia * wp.skew(other)

    return SimpleNamespace(point_velocity=point_velocity, impulse_response=impulse_response, mobility=mobility)
