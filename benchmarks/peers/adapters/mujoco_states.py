# SPDX-License-Identifier: Apache-2.0
"""States of a job in MuJoCo's coordinates, and back; shared by the adapters of MuJoCo and MuJoCo Warp."""

from __future__ import annotations

import mjcf
import mujoco
import numpy as np
from protocol import Job, State


def start(job: Job) -> State:
    """qpos [E, nq] and qvel [E, nv] of a job's start."""
    if job.tree is None:
        return mjcf.to_mujoco(job.pose, job.velocity)
    jacobian, _ = mjcf.velocity_map(job.tree, job.tree.q, job.tree.v)
    return mjcf.coordinates(job.tree, job.tree.q), np.einsum("eij,ej->ei", jacobian, job.tree.v)


def bodies(job: Job, model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> State:
    """Pose [..., B, 7] and velocity [..., B, 6] of all bodies, those of a tree by MuJoCo's own kinematics."""
    if job.tree is None:
        return mjcf.from_mujoco(qpos, qvel)
    data, number = mujoco.MjData(model), len(job.mass)
    pose, velocity = np.empty((*qpos.shape[:-1], number, 7)), np.empty((*qpos.shape[:-1], number, 6))
    ids = [model.body(f"b{body}").id for body in range(number)]
    twist = np.empty(6)
    for at in np.ndindex(qpos.shape[:-1]):
        data.qpos[:], data.qvel[:] = qpos[at], qvel[at]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        pose[at] = np.concatenate([data.xpos[ids], np.roll(data.xquat[ids], -1, axis=1)], axis=1)
        for body, index in enumerate(ids):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, index, twist, 0)  # of the centre of mass
            velocity[(*at, body)] = np.roll(twist, 3)
    return pose, velocity
