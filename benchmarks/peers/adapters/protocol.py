# SPDX-License-Identifier: Apache-2.0
"""What every adapter shares: orders on stdin, replies on stdout, a line of JSON each. Runs in the peer's interpreter, needs numpy alone.

Orders, each with the "id" of a job that the caller chooses:

    {"do": "make", "id", "job": {scene, dt, steps, every, timed, friction, restitution, settings, state, result}}
        Build the engine and run the job once, with everything recorded; `timed` says whether it will be run again. `state` is the
        .npz that benchmarks.scenes.Scene.save or, with joints, benchmarks.robots.Robot.save writes. The reply is {info, seconds: of
        the run}; the .npz `result` holds
        pose [T, E, B, 7] (x y z qx qy qz qw) and velocity [T, E, B, 6] (linear of the centre of mass, then angular; world axes)
        at the start and after every `every` steps, as the engine gives them back, before_pose and before_velocity
        [T - 1, E, B, ..], one step before each of the later samples, and contacts, their mean number in an environment and a step.
    {"do": "run", "id"}
        All steps from the start, timed. The reply is {seconds, same, info}: same says whether it ended where the first run did.
    {"do": "drop", "id"}
        Forget the job.

Several jobs may be there at a time, so that all engines can take turns. A reply {"refused": why} says that the engine cannot
do the job, {"error": traceback} that it failed. The first line of stdout is {versions} of the packages that matter. The
engine's own prints go to stderr.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from importlib.metadata import version
from typing import Any

import numpy as np

State = tuple[np.ndarray, np.ndarray]
KINDS = ("plane", "box", "sphere", "capsule", "cylinder")
SHAPES = ("shape_kind", "shape_body", "shape_size", "shape_pose")
BODIES = ("mass", "inertia", "pose", "velocity", "gravity", "wrench")


class Refused(Exception):
    """The engine has no way of doing the job; the message says what is missing."""


@dataclass(frozen=True)
class Tree:
    """Joints of a robot: fields of warp_lcp's Model under their names, those of its L loops as loop_ and their names (bodies [L, 2],
    frames [L, 2, 7], ways and turns [L, 3]), its start in its coordinates, q [E, nq] and v [E, nv]."""

    body_parent: np.ndarray
    joint_type: np.ndarray
    joint_pose: np.ndarray
    joint_child_pose: np.ndarray
    q_start: np.ndarray
    v_start: np.ndarray
    dof_body: np.ndarray
    dof_kind: np.ndarray
    dof_axis: np.ndarray
    armature: np.ndarray
    damping: np.ndarray
    joint_friction: np.ndarray
    limit: np.ndarray
    drive: np.ndarray
    com: np.ndarray
    pairs: np.ndarray
    loop_bodies: np.ndarray
    loop_frames: np.ndarray
    loop_ways: np.ndarray
    loop_turns: np.ndarray
    q: np.ndarray
    v: np.ndarray


@dataclass(frozen=True)
class Job:
    """One scene to simulate; the arrays are those of benchmarks.scenes.Scene, `every` the steps from sample to sample.

    Where bodies hang on joints, `tree` says how, and inertia is [B, 3, 3], about the centre of mass.
    """

    scene: str
    dt: float
    steps: int
    every: int
    friction: float
    restitution: float
    settings: dict[str, Any]
    shape_kind: list[str]
    shape_body: list[int]
    shape_size: np.ndarray
    shape_pose: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    pose: np.ndarray
    velocity: np.ndarray
    gravity: np.ndarray
    wrench: np.ndarray
    tree: Tree | None = None

    def __post_init__(self) -> None:
        if unknown := set(self.shape_kind) - set(KINDS):
            raise Refused(f"adapters write {', '.join(KINDS)}, and there is a {sorted(unknown)[0]}")

    @property
    def envs(self) -> int:
        """Number of environments."""
        return len(self.pose)


def closure(tree: Tree, loop: int) -> str:
    """What closes a loop: a "ball", a "hinge" about one axis of its frames, or a "weld".

    Raises:
        Refused: for any other joint.
    """
    kinds = {0: "ball", 2: "hinge", 3: "weld"}
    turns = int(tree.loop_turns[loop].sum())
    if not tree.loop_ways[loop].all() or turns not in kinds:
        raise Refused("loops are closed by balls, hinges and welds")
    return kinds[turns]


class Engine(ABC):
    """What an adapter implements for one job. A state is (pose [E, B, 7], velocity [E, B, 6]) as in the job."""

    job: Job

    @abstractmethod
    def reset(self) -> None:
        """Back to the start, hidden state included."""

    @abstractmethod
    def run(self, steps: int) -> None:
        """Advance by so many steps: what is timed."""

    @abstractmethod
    def state(self) -> State:
        """The present state, in float64."""

    @abstractmethod
    def contacts(self) -> float:
        """Number of contacts of the last step, mean over the environments. Called after every step of the untimed run."""

    def settle(self) -> None:  # noqa: B027 (an engine that allocates nothing has nothing to do)
        """After the untimed run: allocate no more than what that one needed."""

    def info(self) -> dict[str, Any]:
        """What was allocated and what went wrong since the reset; key 'overflow' must be false for the timings to count."""
        return {"overflow": False}

    def record(self) -> dict[str, Any]:
        """All steps from the start, not timed: what `result` holds."""
        self.reset()
        samples, before, contacts = [self.state()], [], []
        for i in range(self.job.steps):
            last = (i + 1) % self.job.every == 0
            if last:
                before.append(self.state())
            self.run(1)
            contacts.append(self.contacts())
            if last:
                samples.append(self.state())
        return self.result(samples, before, float(np.mean(contacts)))

    @staticmethod
    def result(samples: list[State], before: list[State], contacts: float) -> dict[str, Any]:
        """As `result` holds it."""
        pose, velocity = (np.stack(arrays) for arrays in zip(*samples, strict=True))
        before_pose, before_velocity = (np.stack(arrays) for arrays in zip(*before, strict=True))
        return {
            "pose": pose,
            "velocity": velocity,
            "before_pose": before_pose,
            "before_velocity": before_velocity,
            "contacts": contacts,
        }


def read(order: dict[str, Any]) -> Job:
    """The job of an order."""
    given = order["job"]
    with np.load(given["state"]) as state:
        arrays = {name: state[name] for name in (*SHAPES, *BODIES)}
        tree = Tree(**{field.name: state[field.name] for field in fields(Tree)}) if "joint_type" in state else None
    arrays |= {name: arrays[name].tolist() for name in ("shape_kind", "shape_body")}
    return Job(**{key: given[key] for key in ("scene", "dt", "steps", "every", "friction", "restitution", "settings")}, **arrays, tree=tree)


def make(order: dict[str, Any], build: Callable[[Job], Engine]) -> tuple[Engine, np.ndarray, dict[str, Any]]:
    """The engine after its untimed run, the last pose of that, and the reply."""
    engine = build(read(order))
    begin = time.perf_counter()
    result = engine.record()
    seconds, info = time.perf_counter() - begin, engine.info()
    if order["job"]["timed"]:
        engine.settle()
    np.savez(order["job"]["result"], **result)
    return engine, result["pose"][-1], {"info": info, "seconds": seconds}


def timed(engine: Engine, last: np.ndarray) -> dict[str, Any]:
    """One repetition."""
    engine.reset()
    begin = time.perf_counter()
    engine.run(engine.job.steps)
    seconds = time.perf_counter() - begin
    return {"seconds": seconds, "same": bool(np.array_equal(engine.state()[0], last, equal_nan=True)), "info": engine.info()}


def serve(build: Callable[[Job], Engine], packages: tuple[str, ...]) -> None:
    """Follow the orders with engines that `build` makes; `packages` are those whose versions are reported."""
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # engines print, some from C; stdout carries replies only
    print(json.dumps({"versions": {name: version(name) for name in packages}}), file=replies)
    jobs: dict[Any, tuple[Engine, np.ndarray]] = {}
    for line in sys.stdin:
        order, reply = json.loads(line), {}
        try:
            if order["do"] == "make":
                *jobs[order["id"]], reply = make(order, build)
            elif order["do"] == "run":
                reply = timed(*jobs[order["id"]])
            else:
                del jobs[order["id"]]
        except Refused as why:
            reply = {"refused": str(why)}
        except Exception:
            reply = {"error": traceback.format_exc()}
        print(json.dumps(reply), file=replies)
