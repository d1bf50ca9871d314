# SPDX-License-Identifier: Apache-2.0
"""Masked reset: the state returns to q0, v0 and nothing that a step left behind survives."""

import warp as wp

from .declare import factory, kernel
from .types import scalar_types


@factory
def make(real):
    """Kernel ``reset``; launch with dim (E)."""
    t = scalar_types(real)
    Bodies, Contacts, Slots = t.Bodies, t.Contacts, t.Slots
    spatial = t.spatial

    @kernel()
    def reset(
        mask: wp.array(dtype=wp.bool),
        q0: wp.array2d(dtype=real),
        v0: wp.array2d(dtype=real),
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        wrench: wp.array2d(dtype=spatial),
        bodies: Bodies,
        contacts: Contacts,
        slots: Slots,
        residual: wp.array(dtype=real),
        residual_energy: wp.array(dtype=real),
        iterations: wp.array(dtype=int),
        status: wp.array(dtype=int),
    ):
        env = wp.tid()
        if not mask[env]:
            return
        for i in range(q.shape[1]):
            q[env, i] = q0[env, i]
        for i in range(v.shape[1]):
            v[env, i] = v0[env, i]
        for b in range(wrench.shape[1]):
            wrench[env, b] = spatial()
        if bodies.alert.shape[0] > 0:
            bodies.alert[env] = real(-1.0)
        for slot in range(slots.last_feature.shape[1]):
            slots.last_feature[env, slot] = -1
        contacts.count[env] = 0
        residual[env] = real(0.0)
        residual_energy[env] = real(0.0)
        iterations[env] = 0
        status[env] = 0

    return reset
