# SPDX-License-Identifier: Apache-2.0
"""A case: a scene of which it is known, from elsewhere, what comes out, and by how much an answer may miss it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .. import motion
from ..motion import Motion, rotate
from ..scenes import GRAVITY, Scene

SAMPLE = 1e-2  # s from sample to sample, or one step where that is longer
#: What the energy may rise above its start, and above its lowest so far: the springs of contacts give back what they took, which is
#: 1e-4 of the scale where 8000 t rest on them.
ENERGY_RISE, REBOUND = 1e-6, 1e-3


@dataclass(frozen=True)
class Metric:
    """One thing that is known of a case.

    Attributes:
        name, unit: for tables.
        observe: what a motion shows of it, [E, n] or [E].
        reference: what it should be, broadcast to that.
        bar: what the error against the reference may be at a step of h [s].
        law_bar: what of it may be the law's: the error against the exact cone with the same step and integrator; None: anything.
    """

    name: str
    unit: str
    observe: Callable[[Motion], np.ndarray]
    reference: Any
    bar: Callable[[float], float]
    law_bar: Callable[[float], float] | None = None

    def seen(self, moved: Motion) -> np.ndarray:
        """[E, n] in the metric's unit."""
        return np.asarray(self.observe(moved), dtype=float).reshape(moved.scene.envs, -1)

    def expected(self, envs: int) -> np.ndarray:
        """[E, n] or [1, n]."""
        reference = np.asarray(self.reference, dtype=float)
        return reference if reference.ndim == 2 else reference.reshape(1, -1)

    def distance(self, seen: np.ndarray, other: np.ndarray) -> float:
        """Largest over environments and numbers; NaN if one is none."""
        return float(np.max(np.abs(seen - other)))

    def error(self, moved: Motion) -> float:
        """Of a motion, against the reference."""
        return self.distance(self.seen(moved), self.expected(moved.scene.envs))


@dataclass(frozen=True)
class Case:
    """A scene with what is known of it.

    Attributes:
        name: for tables and the command line. title: what happens, in a few words. label: in charts; '': the name.
        build: the scene at a step of h [s], with all its environments.
        metrics: what is known; the first one is what charts show.
        source: where the references come from.
        fails: methods and engines that are known to fail, and why.
        charted: has a panel in the chart.
        timed_from: s; in the chart the time of steps is taken from there on, from our own motion's state for everyone.
    """

    name: str
    title: str
    build: Callable[[float], Scene]
    metrics: tuple[Metric, ...]
    source: str
    fails: str = ""
    charted: bool = False
    label: str = ""
    timed_from: float = 0.0

    def scene(self, h: float, envs: int | None = None) -> Scene:
        """At a step of h [s], as many environments as it has, or so many."""
        built = replace(self.build(h), name=self.name, dt=h)
        return built if envs is None else built.copies(envs)

    def every(self, h: float) -> int:
        """Steps from sample to sample."""
        return max(1, round(SAMPLE / h))

    def simulate(self, h: float, **options: Any) -> Motion:
        """Ours, with a Simulator of these options."""
        return motion.simulate(self.scene(h), self.every(h), **options)

    def energy_scale(self, scene: Scene) -> np.ndarray:
        """What it takes to set the bodies moving and to turn them over, against weight or other forces [J], [E], wherever the origin is."""
        spin = rotate(scene.pose[..., 3:] * [-1, -1, -1, 1], scene.velocity[..., 3:])
        kinetic = 0.5 * (scene.mass * (scene.velocity[..., :3] ** 2).sum(axis=-1) + (scene.inertia * spin**2).sum(axis=-1)).sum(axis=-1)
        gyration = np.sqrt(scene.inertia.sum(axis=1) / (2.0 * scene.mass))
        weight = scene.mass * np.linalg.norm(scene.gravity)
        if scene.wrench is not None:
            weight = np.maximum(weight, np.linalg.norm(scene.wrench[:, :3], axis=1))
        return kinetic + (weight * gyration).sum()

    def energy_rise(self, moved: Motion) -> float:
        """By what share of the scale the energy was ever above its start; NaN where it is no number.

        The work of constant forces is counted; 0 where the scene is not passive.
        """
        if not moved.scene.passive:
            return 0.0
        energy = moved.energy()
        return float(np.max((energy - energy[0]) / self.energy_scale(moved.scene)))

    def rebound(self, moved: Motion) -> float:
        """By what share of the scale the energy ever rose above its lowest so far: what friction has taken does not come back."""
        if not moved.scene.passive:
            return 0.0
        energy = moved.energy()
        return float(np.max((energy - np.minimum.accumulate(energy, axis=0)) / self.energy_scale(moved.scene)))


def steps(duration: float, h: float) -> int:
    """Of a duration [s].

    Raises:
        ValueError: if it is no whole number of steps: references are for the duration itself.
    """
    number = round(duration / h)
    if abs(number * h - duration) > 1e-9 * duration:
        raise ValueError(f"{duration:g} s is no whole number of steps of {h:g} s")
    return number


def constant(value: float) -> Callable[[float], float]:
    """A bar that does not change with the step."""
    return lambda h: value


def linear(slope: float, least: float = 0.0) -> Callable[[float], float]:
    """A bar that grows with the step: slope in units a second."""
    return lambda h: max(least, slope * h)


def tilted(degrees: float, heading: float = 0.0) -> tuple[float, float, float]:
    """Gravity over a slope that falls by `degrees` towards `heading` [degrees from x], in the slope's own axes."""
    slope, turn = np.radians(degrees), np.radians(heading)
    down = GRAVITY * np.sin(slope)
    return (float(down * np.cos(turn)), float(down * np.sin(turn)), float(-GRAVITY * np.cos(slope)))


def about_z(angle: Any) -> np.ndarray:
    """Quaternions [..., 4] of turns about z [rad]."""
    angle = np.asarray(angle, dtype=float)
    zero = np.zeros_like(angle)
    return np.stack([zero, zero, np.sin(angle / 2), np.cos(angle / 2)], axis=-1)


def about_y(angle: Any) -> np.ndarray:
    """Quaternions [..., 4] of turns about y [rad]."""
    angle = np.asarray(angle, dtype=float)
    zero = np.zeros_like(angle)
    return np.stack([zero, np.sin(angle / 2), zero, np.cos(angle / 2)], axis=-1)


# ------------------------------------------------------------------------------------------------------------- observations


def creep(moved: Motion) -> np.ndarray:
    """Mean speed of the fastest-moving body over the last second [m/s], [E]."""
    late = moved.time >= moved.time[-1] - 1.0 - 1e-9
    way = moved.pose[late][-1, ..., :3] - moved.pose[late][0, ..., :3]
    return np.linalg.norm(way, axis=-1).max(axis=-1) / (moved.time[-1] - moved.time[late][0])


def lift(moved: Motion, body: int = 0) -> np.ndarray:
    """Height above the start [m], largest over time, [E]."""
    height = moved.pose[:, :, body, 2]
    return np.maximum(0.0, (height - height[0]).max(axis=0))


def heading(moved: Motion, body: int = 0) -> np.ndarray:
    """Turn of the body's x axis about z since the start [rad], [T, E]; samples turn by less than pi."""
    x, y, z, w = np.moveaxis(moved.pose[:, :, body, 3:], -1, 0)
    angle = np.unwrap(np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z)), axis=0)
    return angle - angle[0]


def moved_by(moved: Motion) -> np.ndarray:
    """Farthest that any body is from its start at any time [m], [E]."""
    return np.linalg.norm((moved.pose - moved.pose[0])[..., :3], axis=-1).max(axis=(0, 2))
