# SPDX-License-Identifier: Apache-2.0
"""What every adapter shares: one JSON job in, one JSON result out. Runs in the peer's interpreter, so it needs numpy alone.

The job is the first line of stdin: scene, envs, dt, steps (even), friction, gravity, state (.npz: half [B, 3] m, mass [B] kg,
pose [E, B, 7] x y z qx qy qz qw, velocity [E, B, 6] linear then angular in world axes), settings, repetitions, result (the
.npz to write). Before each timed repetition, and before the result, the adapter says "ready" on stdout and waits for a line,
so that the caller can take turns between several adapters and itself and none works, or ends, while another is timed; at the
end of stdin nothing is waited for. The last line of stdout is {seconds: one a repetition, median, result, versions, info}.
The engine's own prints go to stderr.

The .npz holds start_pose and start_velocity as the engine gives them back, pose and velocity after the last timed
repetition, and of an untimed run of the same steps: recorded_pose at its end, top [E, B], the largest height of each
body's centre after any step, and contacts, their mean number in an environment and a step.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Protocol

import numpy as np


@dataclass(frozen=True)
class Job:
    """One scene to simulate, see above."""

    scene: str
    envs: int
    dt: float
    steps: int
    friction: float
    gravity: float
    settings: dict[str, Any]
    half: np.ndarray
    mass: np.ndarray
    pose: np.ndarray
    velocity: np.ndarray


class Engine(Protocol):
    """What an adapter implements. A state is (pose [E, B, 7], velocity [E, B, 6]) as in the job."""

    def reset(self) -> None:
        """Back to the start, hidden state included."""

    def run(self) -> None:
        """The job's steps: what is timed."""

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """The present state."""

    def record(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Run from the start, not timed: (last pose, largest height of each body [E, B], mean contacts in an environment and a step)."""

    def info(self) -> dict[str, Any]:
        """What was allocated and what went wrong; key 'overflow' must be false for the timings to count."""


def serve(make: Callable[[Job], Engine], packages: tuple[str, ...]) -> None:
    """Do the job on stdin with the engine that `make` builds; `packages` are those whose versions are reported."""
    replies = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # engines print, some from C; stdout carries replies only
    order = json.loads(sys.stdin.readline())
    with np.load(order["state"]) as state:
        arrays = {name: state[name] for name in ("half", "mass", "pose", "velocity")}
    known = ("scene", "envs", "dt", "steps", "friction", "gravity", "settings")
    engine = make(Job(**{key: order[key] for key in known}, **arrays))
    result: dict[str, Any] = dict(zip(("recorded_pose", "top", "contacts"), engine.record(), strict=True))
    engine.reset()
    result["start_pose"], result["start_velocity"] = engine.state()
    engine.run()  # warm up

    def wait() -> None:
        print("ready", file=replies)
        sys.stdin.readline()

    seconds = []
    for _ in range(order["repetitions"]):
        wait()
        engine.reset()
        begin = time.perf_counter()
        engine.run()
        seconds.append(time.perf_counter() - begin)
    wait()
    result["pose"], result["velocity"] = engine.state()
    np.savez(order["result"], **result)
    answer = {
        "seconds": seconds,
        "median": statistics.median(seconds),
        "result": order["result"],
        "versions": {name: version(name) for name in packages},
        "info": engine.info(),
    }
    print(json.dumps(answer), file=replies)
