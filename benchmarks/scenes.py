# SPDX-License-Identifier: Apache-2.0
"""Scenes of the benchmarks, described once for warp_lcp and for other engines alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import warp_lcp as wl
from warp_lcp.builder import CONTACT_FIELDS

DT = 1e-3
GRAVITY = 9.81
STATES = ("rest", "slide", "tumble")
STEPS = {"rest": 50, "slide": 50, "tumble": 250, "pile5": 600, "stack10": 200}
ENVS = {"rest": 1024, "slide": 1024, "tumble": 1024, "pile5": 64, "stack10": 16}
KINDS = ("plane", "box", "sphere", "capsule")
WORLD = -1
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Shape:
    """A collider.

    Attributes:
        kind: one of KINDS.
        body: index of the body it belongs to, or WORLD.
        size: [m] half extents of a box; (radius, 0, 0) of a sphere; (radius, half length of the straight part, 0) of a
            capsule, whose axis is z; unused for a plane, whose normal is z.
        pose: in its body, x y z qx qy qz qw.
    """

    kind: str
    body: int
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pose: tuple[float, ...] = IDENTITY


GROUND = Shape("plane", WORLD)


@dataclass(frozen=True)
class Scene:
    """E environments of the same B free bodies and of colliders that belong to them or to the world.

    Attributes:
        name: for tables.
        dt: step [s]. steps: number of steps.
        friction: coefficient of every contact, static and dynamic. restitution: Newton's, of every contact.
        shapes: the colliders.
        mass: [B] kg. inertia: [B, 3] kg m^2, principal, about the centre of mass, which is the body's origin, in its axes.
        pose: [E, B, 7] start, x y z qx qy qz qw. velocity: [E, B, 6] start, linear then angular, world axes.
        gravity: [3] m/s^2.
        wrench: [B, 6] constant force [N] at the centre of mass and torque [N m], world axes; None: none.
        made: the scene's Model where the above cannot say it (joints, belts, two coefficients of friction); shapes, friction, inertia and
            starts are then not looked at. All environments are alike, and other engines have no part in it.
        passive: nothing but gravity, constant forces, friction and impacts changes the energy. It is not where drives or belts do work, nor
            where joints carry a swing, of which Euler's rule gives and takes a part of first order in the step.
    """

    name: str
    dt: float
    steps: int
    friction: float
    shapes: tuple[Shape, ...]
    mass: np.ndarray
    inertia: np.ndarray
    pose: np.ndarray
    velocity: np.ndarray
    gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY)
    wrench: np.ndarray | None = None
    restitution: float = 0.0
    made: wl.Model | None = None
    passive: bool = True

    @property
    def envs(self) -> int:
        """Number of environments."""
        return len(self.pose)

    def copies(self, envs: int) -> Scene:
        """The scene with so many environments: those there are, over and over."""
        index = np.arange(envs) % self.envs
        return replace(self, pose=self.pose[index], velocity=self.velocity[index])

    def model(self, **material: Any) -> wl.Model:
        """The scene as environment 0 has it; `material` are further arguments of every contact's wl.Material."""
        if self.made is not None:
            contact = self.made.contact.copy()
            for name, value in material.items():
                contact[:, CONTACT_FIELDS.index(name)] = value
            return replace(self.made, contact=contact)
        builder = wl.ModelBuilder(gravity=self.gravity)
        surface = wl.Material(self.friction, self.friction, restitution=self.restitution, **material)
        for mass, inertia, pose, velocity in zip(self.mass, self.inertia, self.pose[0], self.velocity[0], strict=True):
            builder.add_body(
                pose=pose, velocity=velocity[:3], angular_velocity=velocity[3:], mass=mass, inertia=np.diag(inertia), com=(0.0, 0.0, 0.0)
            )
        for shape in self.shapes:
            where = {"body": shape.body, "pose": shape.pose, "material": surface}
            if shape.kind == "plane":
                builder.add_plane(**where)
            elif shape.kind == "box":
                builder.add_box(half_extents=shape.size, **where)
            elif shape.kind == "sphere":
                builder.add_sphere(radius=shape.size[0], **where)
            else:
                builder.add_capsule(radius=shape.size[0], half_length=shape.size[1], **where)
        return builder.finalize()

    def simulator(self, dt: float | None = None, material: dict[str, Any] | None = None, **options: Any) -> wl.Simulator:
        """A Simulator of the scene, every environment at its start; dt of the scene unless given."""
        sim = wl.Simulator(self.model(**material or {}), self.envs, self.dt if dt is None else dt, **options)
        if self.made is None:
            sim.q0.assign(self.pose.reshape(self.envs, -1))
            sim.v0.assign(self.velocity.reshape(self.envs, -1))
        self.restart(sim)
        return sim

    def restart(self, sim: wl.Simulator) -> None:
        """Put a simulator of the scene back to the start, constant forces applied: a reset clears them."""
        sim.reset()
        if self.wrench is not None:
            sim.wrench.assign(np.tile(self.wrench, (self.envs, 1, 1)))

    def save(self, path: Path) -> None:
        """What an adapter reads: the arrays of this class, and the colliders as shape_kind, shape_body, shape_size, shape_pose."""
        np.savez(
            path,
            shape_kind=np.array([shape.kind for shape in self.shapes]),
            shape_body=np.array([shape.body for shape in self.shapes]),
            shape_size=np.array([shape.size for shape in self.shapes]),
            shape_pose=np.array([shape.pose for shape in self.shapes]),
            mass=self.mass,
            inertia=self.inertia,
            pose=self.pose,
            velocity=self.velocity,
            gravity=np.array(self.gravity),
            wrench=np.zeros((len(self.mass), 6)) if self.wrench is None else self.wrench,
        )


def of_model(name: str, model: wl.Model, dt: float, steps: int, **options: Any) -> Scene:
    """A scene of one environment that is this Model."""
    sim = wl.Simulator(model, device="cpu")
    pose, velocity = sim.body_pose.numpy().astype(float), sim.body_velocity.numpy().astype(float)
    gravity = (float(model.gravity[0]), float(model.gravity[1]), float(model.gravity[2]))
    inertia = np.linalg.eigvalsh(model.inertia)
    return Scene(name, dt, steps, 0.0, (), model.mass, inertia, pose, velocity, gravity=gravity, made=model, **options)


# ------------------------------------------------------------------------------------------------------------- solid bodies


def box_inertia(half: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Of solid boxes [B, 3] with half extents [B, 3] and masses [B]."""
    square = np.asarray(half) ** 2
    return np.asarray(mass)[:, None] * (square.sum(axis=1)[:, None] - square) / 3.0


def ball_inertia(radius: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Of solid spheres [B, 3] with radii [B] and masses [B]."""
    return np.repeat((0.4 * np.asarray(mass) * np.asarray(radius) ** 2)[:, None], 3, axis=1)


def boxes(
    name: str,
    half: Sequence[Sequence[float]],
    mass: Sequence[float],
    pose: np.ndarray,
    velocity: np.ndarray,
    friction: float,
    dt: float = DT,
    steps: int = 0,
    statics: tuple[Shape, ...] = (GROUND,),
    **options: Any,
) -> Scene:
    """Solid boxes, one a body, and colliders of the world."""
    sizes = [(float(x), float(y), float(z)) for x, y, z in half]
    shapes = statics + tuple(Shape("box", i, size) for i, size in enumerate(sizes))
    masses = np.asarray(mass, dtype=float)
    return Scene(name, dt, steps, friction, shapes, masses, box_inertia(np.asarray(half), masses), pose, velocity, **options)


# ------------------------------------------------------------------------------------------------------- scenes of `speed`


def scene(name: str, envs: int | None = None) -> Scene:
    """A scene of the speed benchmark by its name, with its usual number of environments unless given."""
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
    return boxes(name, half, mass, pose, velocity, friction, steps=STEPS[name])


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
