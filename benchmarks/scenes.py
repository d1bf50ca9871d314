# SPDX-License-Identifier: Apache-2.0
"""Scenes of the comparisons: boxes on the plane z = 0, described once for warp_lcp and for the peers alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warp_lcp as wl

DT = 1e-3
GRAVITY = 9.81
STATES = ("rest", "slide", "tumble")
STEPS = {"rest": 50, "slide": 50, "tumble": 250, "pile5": 600, "stack10": 200}
ENVS = {"rest": 1024, "slide": 1024, "tumble": 1024, "pile5": 64, "stack10": 16}


@dataclass(frozen=True)
class Scene:
    """E environments of B boxes on the plane z = 0, the same boxes in each.

    Attributes:
        name: for tables.
        dt: step [s]. steps: number of steps, even.
        friction: coefficient of every contact, static and dynamic.
        half: [B, 3] half extents [m]. mass: [B] kg, uniform density.
        pose: [E, B, 7] start, x y z qx qy qz qw. velocity: [E, B, 6] start, linear then angular, world axes.
    """

    name: str
    dt: float
    steps: int
    friction: float
    half: np.ndarray
    mass: np.ndarray
    pose: np.ndarray
    velocity: np.ndarray

    @property
    def envs(self) -> int:
        """Number of environments."""
        return len(self.pose)

    def model(self) -> wl.Model:
        """The boxes as environment 0 has them."""
        builder, material = wl.ModelBuilder(gravity=(0, 0, -GRAVITY)), wl.Material(self.friction, self.friction)
        builder.add_plane(material=material)
        for half, mass, pose, velocity in zip(self.half, self.mass, self.pose[0], self.velocity[0], strict=True):
            body = builder.add_body(pose=pose, velocity=velocity[:3], angular_velocity=velocity[3:], mass=mass)
            builder.add_box(body, half, material=material)
        return builder.finalize()

    def simulator(self, dt: float | None = None, **options: Any) -> wl.Simulator:
        """A Simulator of the scene, every environment at its start; dt of the scene unless given."""
        sim = wl.Simulator(self.model(), self.envs, self.dt if dt is None else dt, **options)
        sim.q0.assign(self.pose.reshape(self.envs, -1))
        sim.v0.assign(self.velocity.reshape(self.envs, -1))
        sim.reset()
        return sim

    def save(self, path: Path) -> None:
        """What an adapter reads: half extents, masses and the start of every environment."""
        np.savez(path, half=self.half, mass=self.mass, pose=self.pose, velocity=self.velocity)


def scene(name: str, envs: int | None = None) -> Scene:
    """A scene by its name, with its usual number of environments unless given."""
    envs = ENVS[name] if envs is None else envs
    if name in STATES:
        half, mass, friction = np.full((1, 3), 0.5), np.ones(1), 1.0
        pose, velocity = paper_box(name, envs)
    elif name == "pile5":
        half, mass, friction = np.full((5, 3), 0.1), np.full(5, 8.0), 0.5
        pose, velocity = heap(5, envs)
    elif name == "stack10":
        half, mass, friction = np.full((10, 3), 0.5), np.ones(10), 0.5
        pose, velocity = np.zeros((envs, 10, 7)), np.zeros((envs, 10, 6))
        pose[..., 2], pose[..., 6] = 0.5 + np.arange(10), 1.0
    else:
        raise ValueError(f"no scene {name!r}; choose from {', '.join(STEPS)}")
    return Scene(name, DT, STEPS[name], friction, half, mass, pose, velocity)


def paper_box(state: str, envs: int) -> tuple[np.ndarray, np.ndarray]:
    """Pose and velocity of the paper's box (Table 1): at rest, sliding as in its example, or dropped tumbling at random."""
    rng = np.random.default_rng(0)
    q, v = np.tile([0, 0, 0.5, 0, 0, 0, 1.0], (envs, 1)), np.zeros((envs, 6))
    if state == "slide":
        v[:, 1], v[:, 5] = 5.0, 2 * np.pi
    elif state == "tumble":
        turn = rng.normal(size=(envs, 4))
        q[:, 2], q[:, 3:] = rng.uniform(0.87, 1.1, envs), turn / np.linalg.norm(turn, axis=1)[:, None]
        v = rng.normal(size=(envs, 6)) * 2.0
        v[:, 2] = -rng.uniform(1.0, 3.0, envs)
    return q[:, None], v[:, None]


def heap(number: int, envs: int) -> tuple[np.ndarray, np.ndarray]:
    """Boxes of 0.2 m above one another, apart by more than their diagonal, at random poses, thrown down and turning."""
    rng = np.random.default_rng(1)
    pose, velocity = np.empty((envs, number, 7)), rng.normal(size=(envs, number, 6))
    turn = rng.normal(size=(envs, number, 4))
    pose[..., :2] = rng.uniform(-0.08, 0.08, (envs, number, 2))
    pose[..., 2] = 0.2 + 0.36 * np.arange(number)
    pose[..., 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    velocity[..., :2] *= 0.2
    velocity[..., 2] = -3.0
    return pose, velocity
