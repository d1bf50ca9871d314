# SPDX-License-Identifier: Apache-2.0
"""What an engine, ours or another, made of a scene: samples of poses and velocities, and what follows from them alone."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import warp_lcp as wl

from .scenes import Scene


@dataclass(frozen=True)
class Motion:
    """T samples of E environments of B bodies, the first of them the start.

    Attributes:
        scene: what was simulated.
        time: [T] s.
        pose: [T, E, B, 7], x y z qx qy qz qw. velocity: [T, E, B, 6], linear then angular, world axes.
        contacts: mean number in an environment and a step.
        before: pose and velocity one step before each sample but the first.
        status: [steps, E], of ours alone: Status bits of every step. residual: [steps, E] m/s. iterations: [steps, E].
    """

    scene: Scene
    time: np.ndarray
    pose: np.ndarray
    velocity: np.ndarray
    contacts: float
    before: tuple[np.ndarray, np.ndarray] | None = None
    status: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int32))
    residual: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    iterations: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int32))

    @classmethod
    def of(cls, scene: Scene, pose: np.ndarray, velocity: np.ndarray, contacts: float, **more: Any) -> Motion:
        """Of samples that lie equally far apart over the scene's steps."""
        return cls(scene, np.linspace(0.0, scene.steps * scene.dt, len(pose)), pose, velocity, contacts, **more)

    @property
    def certified(self) -> float:
        """Share of our env-steps whose answer was certified."""
        return float(np.mean((self.status & (wl.Status.UNCERTIFIED | wl.Status.NOT_A_NUMBER)) == 0))

    @property
    def finite(self) -> bool:
        """Is every number one?"""
        return bool(np.isfinite(self.pose).all() and np.isfinite(self.velocity).all())

    def energy(self) -> np.ndarray:
        """[T, E] J: kinetic and of gravity, less the work of the scene's constant forces; friction and impacts may only lower it."""
        mass, x, v = self.scene.mass, self.pose[..., :3], self.velocity
        spin = rotate(self.pose[..., 3:] * [-1, -1, -1, 1], v[..., 3:])
        turning = (self.scene.inertia * spin**2).sum(axis=-1)
        if self.scene.made is not None:
            turning = np.einsum("...i,...ij,...j", spin, self.scene.made.inertia, spin)
            x = x + rotate(self.pose[..., 3:], self.scene.made.com)
        kinetic = 0.5 * (mass * (v[..., :3] ** 2).sum(axis=-1) + turning)
        force = mass[:, None] * np.array(self.scene.gravity)
        if self.scene.wrench is not None:
            force = force + self.scene.wrench[:, :3]
        return (kinetic - (force * x).sum(axis=-1)).sum(axis=-1)


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] turned by unit quaternions [..., 4] (x y z w)."""
    axis, w = quaternion[..., :3], quaternion[..., 3:]
    return vector + 2.0 * np.cross(axis, np.cross(axis, vector) + w * vector)


class TooSlow(RuntimeError):
    """A run that was given up; the message says how far it came."""


def record(sim: wl.Simulator, scene: Scene, every: int = 1, limit: float = math.inf) -> Motion:
    """Our own motion from the scene's start, a sample after every so many steps; the simulator is one of the scene's.

    Raises:
        TooSlow: when it has not come to its end after `limit` seconds, compilation not counted.
    """
    scene.restart(sim)
    if limit < math.inf:
        sim.step(0)  # every kernel is there
    begin = time.perf_counter()
    state = ("q", "v") if scene.made is None else ("body_pose", "body_velocity")
    samples, before, watched, contacts = [tuple(getattr(sim, name).numpy().copy() for name in state)], [], [], []
    for i in range(scene.steps // every):
        if (elapsed := time.perf_counter() - begin) > limit:
            raise TooSlow(f"{i * every} of {scene.steps} steps after {elapsed:.0f} s, {1e3 * elapsed / max(i * every, 1):.2g} ms each")
        run = sim.rollout(every, record=(*state, "status", "residual", "iterations"))
        q, v = (getattr(run, name).numpy() for name in state)
        before.append((q[-2], v[-2]) if every > 1 else samples[-1])
        samples.append((q[-1], v[-1]))
        watched.append((run.status.numpy(), run.residual.numpy(), run.iterations.numpy()))
        contacts.append(sim.contacts.count.numpy().mean())
    shape = (-1, scene.envs, len(scene.mass))

    def stacked(states: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
        q, v = (np.stack(arrays).astype(float) for arrays in zip(*states, strict=True))
        return q.reshape(*shape, 7), v.reshape(*shape, 6)

    status, residual, iterations = (np.concatenate(arrays) for arrays in zip(*watched, strict=True))
    pose, velocity = stacked(samples)
    times = sim.dt * every * np.arange(len(pose))
    return Motion(scene, times, pose, velocity, float(np.mean(contacts)), stacked(before), status, residual, iterations)


def simulate(scene: Scene, every: int = 1, material: dict[str, Any] | None = None, limit: float = math.inf, **options: Any) -> Motion:
    """Our own motion, with a Simulator of these options."""
    return record(scene.simulator(material=material, **options), scene, every, limit)


def penetration(scene: Scene, poses: np.ndarray) -> float:
    """Deepest overlap [m] of anybody's poses [..., B, 7], measured by our collision detection; NaN if they are not finite.

    Of scenes that are not a Model of their own.
    """
    if not np.isfinite(poses).all():
        return float("nan")
    flat = poses.reshape(-1, *poses.shape[-2:])
    still = replace(scene, pose=flat, velocity=np.zeros((len(flat), flat.shape[1], 6)))
    sim = still.simulator(device="cpu")
    sim.step()
    gap, count = sim.contacts.gap.numpy(), sim.contacts.count.numpy()
    return max(0.0, -float(np.min(gap, where=np.arange(gap.shape[1]) < count[:, None], initial=0.0)))
