# SPDX-License-Identifier: Apache-2.0
"""Ours and the peers on the same scenes: speed side by side, and how far each is from what should have come out.

One core for everyone. After a warm-up the engines take turns, one repetition each, so that a busy minute of the machine meets
all of them; the ratio is taken turn by turn. Ours is Simulator's default: method auto, float64. A peer counts only if it
started from the scene's own state, stayed finite and in its memory, and moved in the timed run as in the recorded one; that
its motion differs from ours is said in the last column and is part of the result.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from .. import motion, scenes
from ..motion import Motion
from ..robots import Robot
from ..scenes import Scene
from . import Peer
from .session import Session, Task, session

OURS = "warp_lcp, auto float64"
STILL = ("rest", "stack10")  # scenes that should stay as they start
FINE_STEP = 1e-4  # s, of the run that 'slide' is compared with


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this process and those it starts on one core: the last of those it may use, where the system can do that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def reference(scene: Scene) -> np.ndarray | None:
    """The pose that should have come out, [1 or E, B, 7], where there is one: nothing else than chance says where boxes tumble."""
    if scene.name in STILL:
        return scene.pose
    if scene.name != "slide":
        return None
    one = scene.copies(1)  # its environments are alike
    return motion.simulate(replace(one, dt=FINE_STEP, steps=round(scene.steps * scene.dt / FINE_STEP)), device="cpu").pose[-1]


def errors(scene: Scene, moved: Motion, expected: np.ndarray | None) -> dict[str, float | None]:
    """Largest distance [m] and turn [rad] from the expected pose, lift over the start [m] where nothing should rise, overlap [m]."""
    found: dict[str, float | None] = {"distance": None, "angle": None, "lift": None}
    if expected is not None:
        final = moved.pose[-1]
        found["distance"] = float(np.linalg.norm(final[..., :3] - expected[..., :3], axis=-1).max())
        cosine = np.abs(np.sum(final[..., 3:] * expected[..., 3:], axis=-1)) / np.linalg.norm(final[..., 3:], axis=-1)
        found["angle"] = float(2.0 * np.arccos(np.minimum(cosine, 1.0)).max())
        found["lift"] = max(0.0, float((moved.pose[..., 2] - scene.pose[..., 2]).max()))
    return found | {"penetration": motion.penetration(scene, moved.pose[-1])}


def problems(scene: Scene | Robot, done: Task) -> list[str]:
    """Why a peer's run does not count: it did not simulate this scene, or not the same every time."""
    found = []
    for name, start, ours_start in (("pose", done.pose[0], scene.pose), ("velocity", done.velocity[0], scene.velocity)):
        if start.shape != ours_start.shape or not np.allclose(start, ours_start, rtol=0.0, atol=1e-5):
            found.append(f"another start {name}")
    if not (np.isfinite(done.pose).all() and np.isfinite(done.velocity).all()):
        found.append("state not finite")
    elif not done.same:
        found.append("timed and recorded runs differ")
    if done.info["overflow"]:
        stopped = done.info.get("stopped_envs")
        found.append("it stopped by itself: bad numbers, or no room" if stopped else "contacts or rows overflowed")
    return found


def remarks(scene: Scene, theirs: Motion, mine: Motion) -> list[str]:
    """How a peer's motion differs from ours so far that its speed is that of another task."""
    found = []
    if theirs.contacts < 0.5 * mine.contacts:
        found.append(f"touches {theirs.contacts / mine.contacts:.0%} as often as ours")
    moved, expected = (np.linalg.norm((m.pose[-1] - scene.pose)[..., :2], axis=-1).mean() for m in (theirs, mine))
    if scene.name == "slide" and abs(moved / expected - 1.0) > 0.1:
        found.append(f"moved {moved:.3f} m, ours {expected:.3f} m")
    if theirs.pose[-1, ..., 2].min() < 0.5 * min(min(shape.size) for shape in scene.shapes if shape.body >= 0):
        found.append("a box is in the floor")
    return found


def one(scene: Scene, sessions: list[Session], repetitions: int) -> list[dict[str, Any]]:
    """Ours and every variant of every peer on one scene."""
    sim = scene.simulator(device="cpu")
    mine = motion.record(sim, scene)
    tasks = [each.make(variant, scene) for each in sessions for variant in each.peer.variants]
    seconds: list[float] = []
    for _ in range(repetitions):
        scene.restart(sim)
        begin = time.perf_counter()
        sim.step(scene.steps)
        seconds.append(time.perf_counter() - begin)
        for task in tasks:
            task.repeat()
    expected = reference(scene)
    rows = [row(scene, OURS, seconds, seconds) | errors(scene, mine, expected)]
    rows[0] |= {"contacts": mine.contacts, "marked_envs": int(np.count_nonzero(mine.status.any(axis=0))), "problems": [], "remarks": []}
    for task in tasks:
        theirs = Motion.of(scene, task.pose, task.velocity, task.contacts)
        line = row(scene, task.name, task.seconds, seconds) | errors(scene, theirs, expected)
        line |= {"contacts": task.contacts, "problems": problems(scene, task), "remarks": remarks(scene, theirs, mine)}
        line |= {"settings": task.session.peer.variants[task.variant], "info": task.info, "versions": task.session.versions}
        rows.append(line)
        task.drop()
    return rows


def row(scene: Scene | Robot, engine: str, seconds: list[float], ours: list[float]) -> dict[str, Any]:
    """Speed of an engine, and of ours over it, turn by turn."""
    work, ratios = scene.envs * scene.steps, [theirs / mine for theirs, mine in zip(seconds, ours, strict=True)]
    rates = [work / s for s in seconds]
    return {
        "scene": scene.name,
        "envs": scene.envs,
        "steps": scene.steps,
        "dt": scene.dt,
        "engine": engine,
        "seconds": seconds,
        "env_steps_per_s": statistics.median(rates),
        "spread": (max(rates) - min(rates)) / statistics.median(rates),
        "ours_over_peer": statistics.median(ratios),
        "ours_over_peer_range": [min(ratios), max(ratios)],
    }


def measure(peers: list[Peer], quick: bool, folder: Path) -> list[dict[str, Any]]:
    """Every scene with every peer."""
    with one_core(), ExitStack() as stack:
        sessions = [stack.enter_context(session(peer, folder)) for peer in peers]
        names = tqdm(scenes.STEPS, desc="peers", disable=None)
        return [r for name in names for r in one(scenes.scene(name), sessions, 5 if quick else 7)]


def markdown(rows: list[dict[str, Any]]) -> str:
    """One line for each engine and scene; lengths in mm, angles in mrad."""

    def thousandths(value: float | None) -> str:
        return "-" if value is None else f"{1e3 * value:.2g}" if abs(value) < 0.1 else f"{1e3 * value:.0f}"

    lines = [
        "| scene | engine | env-steps/s | ours / it (least to most) | contacts | error mm | error mrad | lift mm | overlap mm | remarks |",
        "|" + " --- |" * 10,
    ]
    for r in rows:
        low, high = r["ours_over_peer_range"]
        ratio = "-" if r["problems"] or r["engine"] == OURS else f"{r['ours_over_peer']:.2f} ({low:.2f} to {high:.2f})"
        errors = " | ".join(thousandths(r[key]) for key in ("distance", "angle", "lift", "penetration"))
        said = "; ".join([f"NOT COMPARED: {p}" for p in r["problems"]] + r["remarks"])
        lines.append(
            f"| {r['scene']}, {r['envs']} envs | {r['engine']} | {r['env_steps_per_s']:,.0f} ± {50 * r['spread']:.0f} % "
            f"| {ratio} | {r['contacts']:.1f} | {errors} | {said} |"
        )
    return "\n".join(lines)
