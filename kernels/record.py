# SPDX-License-Identifier: Apache-2.0
"""Recording of a rollout: wrenches and controls of joints in, states out, at the step that counters on the device say.

What changes from one rollout to the next, the addresses of its arrays first of all, stands in a ``Tape`` on the device, so
that the captured step reads it from there and is captured once.
"""

from types import SimpleNamespace

import warp as wp

from .declare import factory, kernel
from .types import scalar_types


@factory
def make(real) -> SimpleNamespace:
    """The struct ``Tape`` and kernels ``apply_wrench``, ``apply_control`` and ``record_row``."""
    t = scalar_types(real)
    transform, spatial, Bodies = t.transform, t.spatial, t.Bodies

    @wp.struct
    class Tape:
        """Arrays of one rollout, T rows for E environments and B bodies; one that is not wanted has no row."""

        every: int  # steps to a row
        wrench: wp.array3d(dtype=spatial)  # [steps, 1|E, B] N, N m at the centre of mass, world axes
        position: wp.array3d(dtype=real)  # [steps, 1|E, nv] targets of drives, m or rad
        velocity: wp.array3d(dtype=real)  # [steps, 1|E, nv] likewise, m/s or rad/s
        force: wp.array3d(dtype=real)  # [steps, 1|E, nv] N or N m along the joints
        q: wp.array3d(dtype=real)  # [T, E, nq]
        v: wp.array3d(dtype=real)  # [T, E, nv]
        body_pose: wp.array3d(dtype=transform)  # [T, E, B]
        body_velocity: wp.array3d(dtype=spatial)  # [T, E, B]
        status: wp.array2d(dtype=int)  # [T, E]
        iterations: wp.array2d(dtype=int)  # [T, E]
        residual: wp.array2d(dtype=real)  # [T, E] m/s
        residual_energy: wp.array2d(dtype=real)  # [T, E] J

    @kernel()
    def apply_wrench(tape: wp.array(dtype=Tape), step: wp.array2d(dtype=int), wrench: wp.array2d(dtype=spatial), stride: int):
        """Wrenches of this step; launch with dim (E, B)."""
        start, b = wp.tid()
        source = tape[0].wrench
        for env in range(start, wrench.shape[0], stride):
            wrench[env, b] = source[step[start, 0], env % source.shape[1], b]

    @kernel()
    def apply_control(
        tape: wp.array(dtype=Tape),
        step: wp.array2d(dtype=int),
        position: wp.array2d(dtype=real),
        velocity: wp.array2d(dtype=real),
        force: wp.array2d(dtype=real),
        stride: int,
    ):
        """Targets and forces of this step, where there are any; launch with dim (E, nv)."""
        start, i = wp.tid()
        source = tape[0]
        row = step[start, 0]
        for env in range(start, position.shape[0], stride):
            if source.position.shape[0] > 0:
                position[env, i] = source.position[row, env % source.position.shape[1], i]
            if source.velocity.shape[0] > 0:
                velocity[env, i] = source.velocity[row, env % source.velocity.shape[1], i]
            if source.force.shape[0] > 0:
                force[env, i] = source.force[row, env % source.force.shape[1], i]

    @kernel()
    def record_row(
        tape: wp.array(dtype=Tape),
        step: wp.array2d(dtype=int),
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        bodies: Bodies,
        status: wp.array(dtype=int),
        iterations: wp.array(dtype=int),
        residual: wp.array(dtype=real),
        residual_energy: wp.array(dtype=real),
        seen_status: wp.array(dtype=int),
        seen_iterations: wp.array(dtype=int),
        columns: int,
        stride: int,
    ):
        """After every `every`-th step, one row; launch with dim (E, columns): threads share the columns of an environment.

        Each thread counts the steps for itself, in step [start, column]: one number for all would have to wait for them all.
        Status and iterations start again from nothing with the next row; what they were goes into the seen ones.
        """
        start, column = wp.tid()
        done = step[start, column] + 1
        step[start, column] = done
        out = tape[0]
        if done % out.every != 0:
            return
        row = done / out.every - 1
        for env in range(start, q.shape[0], stride):
            if out.q.shape[0] > 0:
                for i in range(column, q.shape[1], columns):
                    out.q[row, env, i] = q[env, i]
            if out.v.shape[0] > 0:
                for i in range(column, v.shape[1], columns):
                    out.v[row, env, i] = v[env, i]
            if out.body_pose.shape[0] > 0:
                for b in range(column, bodies.pose.shape[1], columns):
                    out.body_pose[row, env, b] = bodies.pose[env, b]
            if out.body_velocity.shape[0] > 0:
                for b in range(column, bodies.velocity.shape[1], columns):
                    out.body_velocity[row, env, b] = bodies.velocity[env, b]
            if column == 0:
                if out.status.shape[0] > 0:
                    out.status[row, env] = status[env]
                if out.iterations.shape[0] > 0:
                    out.iterations[row, env] = iterations[env]
                if out.residual.shape[0] > 0:
                    out.residual[row, env] = residual[env]
                if out.residual_energy.shape[0] > 0:
                    out.residual_energy[row, env] = residual_energy[env]
                seen_status[env] = seen_status[env] | status[env]
                seen_iterations[env] = seen_iterations[env] + iterations[env]
                status[env] = 0
                iterations[env] = 0

    return SimpleNamespace(Tape=Tape, apply_wrench=apply_wrench, apply_control=apply_control, record_row=record_row)


@factory
def make_sum():
    """Kernel ``add_seen``; launch with dim E."""

    @kernel()
    def add_seen(
        seen_status: wp.array(dtype=int),
        seen_iterations: wp.array(dtype=int),
        status: wp.array(dtype=int),
        iterations: wp.array(dtype=int),
    ):
        """Status and iterations of the whole rollout, from the rows and what came after the last of them."""
        env = wp.tid()
        status[env] = status[env] | seen_status[env]
        iterations[env] = iterations[env] + seen_iterations[env]

    return add_seen
