# SPDX-License-Identifier: Apache-2.0
"""Robots read from USD files, described for other engines by the arrays of our Model and by states in its coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

import warp_lcp as wl
from warp_lcp import joints
from warp_lcp.model import DofKind, JointType
from warp_lcp.usd import read_usd

from .report import ROOT
from .scenes import Scene

USD = ROOT.parent / "shared" / "usd"  # robots made by others; the README there says by whom
#: What adapters read of a Model under its own names (adapters/protocol.py, Tree).
TREE = ["body_parent", "joint_type", "joint_pose", "joint_child_pose", "q_start", "v_start", "dof_body", "dof_kind", "dof_axis"]
TREE += ["armature", "damping", "joint_friction", "limit", "drive", "com", "pairs"]
#: What they read of its loops, and the shape of one loop's.
LOOPS = {"bodies": (2,), "frames": (2, 7), "ways": (3,), "turns": (3,)}


@dataclass(frozen=True)
class Robot:
    """E environments of one model with joints, for the same steps in every engine.

    Attributes:
        name: for tables.
        model: the robot and the ground.
        dt: step [s]. steps: number of steps.
        q, v: [E, nq], [E, nv] start.
        wrench: [B, 6] constant force [N] at the centre of mass and torque [N m], world axes; None: none.
    """

    name: str
    model: wl.Model
    dt: float
    steps: int
    q: np.ndarray
    v: np.ndarray
    restitution: float = 0.0
    wrench: np.ndarray | None = None

    @property
    def envs(self) -> int:
        """Number of environments."""
        return len(self.q)

    @property
    def friction(self) -> float:
        """Coefficient of every contact, static and dynamic.

        Raises:
            ValueError: where contacts differ: engines combine two materials in different ways.
        """
        values = {float(mu) for mu in self.model.friction.ravel()} or {0.0}
        if len(values) != 1:
            raise ValueError(f"{self.name}: friction coefficients {sorted(values)}; engines combine unequal ones in different ways")
        return values.pop()

    def simulator(self, **options) -> wl.Simulator:
        """A Simulator, every environment at its start."""
        sim = wl.Simulator(self.model, self.envs, self.dt, **options)
        sim.q0.assign(self.q)
        sim.v0.assign(self.v)
        sim.reset()
        return sim

    @cached_property
    def pose(self) -> np.ndarray:
        """[E, B, 7] start of the body frames, x y z qx qy qz qw."""
        return self.simulator(device="cpu").body_pose.numpy().copy()

    @cached_property
    def velocity(self) -> np.ndarray:
        """[E, B, 6] start, of the centre of mass, then angular, world axes."""
        return self.simulator(device="cpu").body_velocity.numpy().copy()

    def save(self, path: Path) -> None:
        """What an adapter reads: as Scene.save, with full inertias [B, 3, 3], and what TREE names, loop_ and what LOOPS names, q and v.

        Raises:
            ValueError: for distances that are held.
        """
        model, sim = self.model, self.simulator(device="cpu")
        if held := [loop.name for loop in model.loops if loop.distance is not None]:
            raise ValueError(f"{self.name}: adapters know no distances, and {held[0]} is one")
        np.savez(
            path,
            shape_kind=np.array([wl.ShapeType(kind).name.lower() for kind in model.shape_type]),
            **{name: getattr(model, name) for name in ("shape_body", "shape_size", "shape_pose", "mass", "inertia", "gravity", *TREE)},
            pose=sim.body_pose.numpy(),
            **{f"loop_{name}": np.array([getattr(x, name) for x in model.loops]).reshape(-1, *size) for name, size in LOOPS.items()},
            velocity=sim.body_velocity.numpy(),
            wrench=np.zeros((model.num_bodies, 6)) if self.wrench is None else self.wrench,
            q=self.q,
            v=self.v,
        )


def of_scene(scene: Scene) -> Robot:
    """A scene that carries its own model, as other engines are told of robots.

    Raises:
        ValueError: for what adapters are not told: kinematic bodies and belts.
    """
    model = scene.made
    assert model is not None
    if (model.dof_kind == DofKind.PRESCRIBED).any() or model.shape_surface_velocity.any():
        raise ValueError(f"{scene.name}: adapters know no bodies and surfaces that move by themselves")
    q, v = (np.tile(x, (scene.envs, 1)) for x in (model.q0, model.v0))
    robot = Robot(scene.name, model, scene.dt, scene.steps, q, v, scene.restitution, scene.wrench)
    _ = robot.friction  # one coefficient
    return robot


def load(path: Path) -> wl.Model:
    """The model of a USD file, on the ground z = 0, of its own friction, where it has none.

    Raises:
        wl.SceneError: where the file cannot be simulated.
    """
    reading = read_usd(path)
    model = reading.builder.finalize(reading.report)
    if wl.ShapeType.PLANE in model.shape_type:
        return model
    reading.builder.add_plane(name="ground", material=wl.Material(*model.friction.max(axis=0).tolist()))
    return reading.builder.finalize(reading.report)


def random_states(model: wl.Model, envs: int, seed: int, spread: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
    """q [E, nq], v [E, nv]: angles and ways at random within their limits (anywhere, where these leave one value), or within
    `spread` of the model's start; v of order one.

    Free bodies are turned at random, by about `spread` where that is finite, and stand within a metre of where the model has them.
    """
    rng = np.random.default_rng(seed)
    q, v = np.tile(model.q0, (envs, 1)), rng.normal(size=(envs, model.nv))
    for b in range(model.num_bodies):
        at, kind = model.q_start[b], JointType(model.joint_type[b])
        if kind in (JointType.FREE, JointType.SPHERICAL):
            turn = at + 3 if kind is JointType.FREE else at
            if kind is JointType.FREE:
                q[:, at : at + 3] += rng.uniform(-1.0, 1.0, (envs, 3))
            away = rng.normal(size=(envs, 4)) * [*(min(0.5 * spread, 1.0),) * 3, 1.0 if np.isinf(spread) else 0.0]
            away[:, 3] += 0.0 if np.isinf(spread) else 1.0
            away /= np.linalg.norm(away, axis=1)[:, None]
            q[:, turn : turn + 4] = [joints.multiply(x, model.q0[turn : turn + 4]) for x in away]
            continue
        for k, i in enumerate(np.flatnonzero(model.dof_body == b)):
            low, high = np.clip(model.limit[i], -np.pi, np.pi)
            if low == high and np.isinf(spread):  # held where it is, which M and c do not ask
                low, high = -np.pi, np.pi
            start = np.clip(model.q0[at + k], low, high)
            q[:, at + k] = rng.uniform(max(low, start - spread), min(high, start + spread), envs)
    assert not (model.dof_kind == DofKind.PRESCRIBED).any(), "robots have no kinematic bodies"
    return q, v


def lowest(model: wl.Model, pose: np.ndarray) -> np.ndarray:
    """[...] height of the lowest point of any body's shape at poses [..., B, 7] of the bodies, exact for every shape."""
    heights = []
    for kind, body, place, size in zip(model.shape_type, model.shape_body, model.shape_pose, model.shape_size, strict=True):
        if body < 0:
            continue
        where, turn = pose[..., body, :3], pose[..., body, 3:]
        centre = where + rotate(turn, place[:3])
        up = np.stack([rotate(turn, joints.rotate(place[3:], axis))[..., 2] for axis in np.eye(3)], axis=-1)  # of the shape's axes
        name = wl.ShapeType(kind).name
        if name == "BOX":
            reach = (np.abs(up) * size).sum(axis=-1)
        elif name == "CYLINDER":
            reach = np.abs(up[..., 2]) * size[1] + np.sqrt(np.maximum(1.0 - up[..., 2] ** 2, 0.0)) * size[0]
        elif name not in ("SPHERE", "CAPSULE"):
            raise ValueError(f"how low a {name} reaches is not known here")
        else:  # a sphere has no straight part
            reach = np.abs(up[..., 2]) * size[1] + size[0]
        heights.append(centre[..., 2] - reach)
    return np.min(heights, axis=0)


def torn(model: wl.Model, pose: np.ndarray) -> float:
    """Largest distance [m] of the two sides of a joint that lets nothing slide, at poses [..., B, 7]; zero in coordinates of joints."""
    worst = 0.0
    for b in range(model.num_bodies):
        kinds = model.dof_kind[model.dof_body == b]
        if model.joint_type[b] in (JointType.FREE, JointType.KINEMATIC) or DofKind.LINEAR in kinds:
            continue
        anchor = np.broadcast_to(model.joint_pose[b, :3], pose[..., b, :3].shape)
        if (parent := model.body_parent[b]) >= 0:
            anchor = pose[..., parent, :3] + rotate(pose[..., parent, 3:], anchor)
        own = pose[..., b, :3] + rotate(pose[..., b, 3:], model.joint_child_pose[b, :3])
        worst = float(np.maximum(worst, np.linalg.norm(anchor - own, axis=-1).max()))  # NaN stays one
    return worst


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors turned by quaternions [..., 4] (x y z w)."""
    axis, w = quaternion[..., :3], quaternion[..., 3:]
    return vector + 2.0 * np.cross(axis, np.cross(axis, vector) + w * vector)


def dropped(name: str, path: Path, envs: int, dt: float, steps: int, height: float = 0.1) -> Robot:
    """A robot in slightly different poses that moves a little, the lowest point of each so high above the ground [m].

    Poses in which bodies overlap are drawn anew: engines part them in ways of their own.

    Raises:
        ValueError: if nearly all poses overlap.
    """
    model = load(path)
    q, v = random_states(model, 8 * envs, seed=0, spread=0.2)
    robot = Robot(name, model, dt, steps, q, 0.2 * v)
    roots = [b for b in range(model.num_bodies) if model.joint_type[b] == JointType.FREE]
    q[:, model.q_start[roots] + 2] += (height - lowest(model, robot.pose))[:, None]
    sim = replace(robot, v=np.zeros_like(v)).simulator(device="cpu")
    sim.step(0)  # nothing of ours is left to compile beside others
    sim.step()
    apart = np.flatnonzero(sim.contacts.count.numpy() == 0)[:envs]
    if len(apart) < envs:
        raise ValueError(f"{name}: only {len(apart)} of {8 * envs} poses have no contact")
    return replace(robot, q=q[apart], v=robot.v[apart])


def settled(robot: Robot, name: str, seconds: float) -> Robot:
    """The same after so much time, as we simulate it."""
    sim = robot.simulator(device="cpu")
    sim.step(round(seconds / robot.dt))
    return replace(robot, name=name, q=sim.q.numpy().copy(), v=sim.v.numpy().copy())
