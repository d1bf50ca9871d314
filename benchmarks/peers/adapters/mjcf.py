# SPDX-License-Identifier: Apache-2.0
"""The scene as MJCF, and states as MuJoCo's qpos and qvel; shared by the adapters of MuJoCo and MuJoCo Warp."""

from __future__ import annotations

import numpy as np
from protocol import Job, Refused

#: Settings that are attributes of <option>.
OPTIONS = ("cone", "impratio", "iterations", "tolerance", "noslip_iterations", "noslip_tolerance", "solver")


def numbers(values: np.ndarray) -> str:
    """For an XML attribute, without loss."""
    return " ".join(repr(float(value)) for value in values)


def model(job: Job) -> str:
    """MJCF of one environment.

    Settings: those of OPTIONS, and time_constant_steps, the time constant of every contact in steps (absent: 20 ms).
    """
    if job.restitution:
        raise Refused("MuJoCo has no coefficient of restitution")
    surface = f'condim="3" friction="{job.friction} 0.005 0.0001"' + (
        f' solref="{s * job.dt} 1"' if (s := job.settings.get("time_constant_steps")) else ""
    )
    geoms: dict[int, str] = dict.fromkeys(range(-1, len(job.mass)), "")
    for kind, body, size, pose in zip(job.shape_kind, job.shape_body, job.shape_size, job.shape_pose, strict=True):
        extent = {"plane": "0 0 1", "box": numbers(size), "sphere": numbers(size[:1]), "capsule": numbers(size[:2])}[kind]
        place = f'pos="{numbers(pose[:3])}" quat="{numbers(np.roll(pose[3:], 1))}"'
        geoms[body] += f'<geom type="{kind}" size="{extent}" {place} {surface}/>'
    bodies = "".join(
        f'<body><freejoint/><inertial pos="0 0 0" mass="{mass!r}" diaginertia="{numbers(inertia)}"/>{geoms[body]}</body>'
        for body, (mass, inertia) in enumerate(zip(job.mass.tolist(), job.inertia, strict=True))
    )
    options = " ".join(f'{key}="{job.settings[key]}"' for key in OPTIONS if key in job.settings)
    return (
        f'<mujoco><option timestep="{job.dt}" gravity="{numbers(job.gravity)}" {options}/>'
        f"<worldbody>{geoms[-1]}{bodies}</worldbody></mujoco>"
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
    """Pose [..., B, 7] and velocity [..., B, 6] of arrays like to_mujoco's, [..., 7 B] and [..., 6 B]."""
    qpos, qvel = qpos.reshape(*qpos.shape[:-1], -1, 7), qvel.reshape(*qvel.shape[:-1], -1, 6)
    pose = np.concatenate([qpos[..., :3], qpos[..., 4:], qpos[..., 3:4]], axis=-1)
    return pose, np.concatenate([qvel[..., :3], rotate(pose[..., 3:], qvel[..., 3:])], axis=-1)
