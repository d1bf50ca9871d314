# SPDX-License-Identifier: Apache-2.0
"""Kinematics, M and c of a robot by MuJoCo: mujoco_dynamics.py JOB RESULT.

JOB is what benchmarks.robots.Robot.save writes. RESULT gets pose [E, B, 7] and velocity [E, B, 6] of all bodies, mass [E, nv, nv]
and bias [E, nv] in warp_lcp's coordinates (mjcf.py says how), and MuJoCo's total mass and version.
"""

from __future__ import annotations

import sys
from importlib.metadata import version

import mjcf
import mujoco
import mujoco_states
import numpy as np
import protocol


def dynamics(job: protocol.Job) -> dict[str, np.ndarray]:
    """As RESULT has it."""
    assert job.tree is not None
    model = mujoco.MjModel.from_xml_string(mjcf.model(job))
    data, (qpos, qvel) = mujoco.MjData(model), mujoco_states.start(job)
    pose, velocity = mujoco_states.bodies(job, model, qpos, qvel)
    mass, bias, own = np.empty((job.envs, model.nv, model.nv)), np.empty((job.envs, model.nv)), np.empty((model.nv, model.nv))
    maps, rates = mjcf.velocity_map(job.tree, job.tree.q, job.tree.v)
    for env in range(job.envs):
        data.qpos[:], data.qvel[:] = qpos[env], qvel[env]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, own)
        mass[env] = maps[env].T @ own @ maps[env]
        bias[env] = maps[env].T @ (data.qfrc_bias + own @ rates[env])
    total = np.array(mujoco.mj_getTotalmass(model))
    return {"pose": pose, "velocity": velocity, "mass": mass, "bias": bias, "total_mass": total, "version": np.array(version("mujoco"))}


if __name__ == "__main__":
    blank = {"scene": "", "dt": 1e-3, "steps": 0, "every": 1, "friction": 1.0, "restitution": 0.0, "settings": {}}
    np.savez(sys.argv[2], **dynamics(protocol.read({"job": blank | {"state": sys.argv[1]}})))
