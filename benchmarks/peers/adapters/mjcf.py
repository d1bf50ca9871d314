# SPDX-License-Identifier: Apache-2.0
"""The scene as MJCF, and states as MuJoCo's qpos and qvel; shared by the adapters of MuJoCo and MuJoCo Warp."""

from __future__ import annotations

import numpy as np
from protocol import Job


def model(job: Job) -> str:
    """MJCF of one environment. Settings: cone, solref (empty: MuJoCo's default)."""
    geom = f'condim="3" friction="{job.friction} 0.005 0.0001"' + (f' solref="{s}"' if (s := job.settings.get("solref")) else "")
    bodies = "".join(
        f'<body><freejoint/><geom type="box" size="{" ".join(map(str, half))}" mass="{mass}" {geom}/></body>'
        for half, mass in zip(job.half.tolist(), job.mass.tolist(), strict=True)
    )
    return (
        f'<mujoco><option timestep="{job.dt}" gravity="0 0 {-job.gravity}" cone="{job.settings["cone"]}"/>'
        f'<worldbody><geom type="plane" size="0 0 1" {geom}/>{bodies}</worldbody></mujoco>'
    )


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors turned by unit quaternions (x y z w)."""
    axis, w = quaternion[..., :3], quaternion[..., 3:]
    return vector + 2.0 * np.cross(axis, np.cross(axis, vector) + w * vector)


def to_mujoco(pose: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """qpos [E, 7 B] with the quaternion's w first, and qvel [E, 6 B] with the angular velocity in the body's own axes."""
    inverse = pose[..., 3:] * [-1, -1, -1, 1]
    qpos = np.concatenate([pose[..., :3], pose[..., 6:], pose[..., 3:6]], axis=-1)
    qvel = np.concatenate([velocity[..., :3], rotate(inverse, velocity[..., 3:])], axis=-1)
    return qpos.reshape(len(pose), -1), qvel.reshape(len(pose), -1)


def from_mujoco(qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose [E, B, 7] and velocity [E, B, 6] of to_mujoco's arguments."""
    qpos, qvel = qpos.reshape(len(qpos), -1, 7), qvel.reshape(len(qvel), -1, 6)
    pose = np.concatenate([qpos[..., :3], qpos[..., 4:], qpos[..., 3:4]], axis=-1)
    return pose, np.concatenate([qvel[..., :3], rotate(pose[..., 3:], qvel[..., 3:])], axis=-1)
