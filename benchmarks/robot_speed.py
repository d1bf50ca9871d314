# SPDX-License-Identifier: Apache-2.0
"""Ours and the peers on robots: speed side by side while they fall on the ground and when they lie or stand on it.

The machinery of peers/compare.py (one core, turns, ratios turn by turn); here it is told besides how high the base ends, how far
anything is in the ground and how far joints are torn, for the engines solve different problems: MuJoCo's contacts are springs,
XPBD's joints come apart, and its drives and joints have no armature. All start from the same state; "at rest" from
where our own simulation lies after some seconds.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import warp_lcp as wl

from . import robots
from .peers import Peer, compare
from .peers.session import Refused, Session, Task, session
from .robots import Robot

DT = 2e-3
ENVS, REST = 16, 5.0  # s
FALL = 0.1  # m; it takes 0.14 s
STEPS = {"falls": 150, "at rest": 100}
FILES = {
    "ant": "newton/ex_ant.usda",
    "humanoid": "newton/ex_humanoid.usda",
    "go1": "converted/go1/go1.usda",
}
#: Variants of each peer: contacts as they come, round cones, and the stiffest that it allows; XPBD from its default upwards.
VARIANTS = {
    "mujoco": ("pyramidal", "elliptic", "elliptic, stiff"),
    "mujoco_warp": ("pyramidal", "elliptic", "elliptic, stiff"),
    "newton_xpbd": ("2 iterations", "10 iterations", "20 iterations"),
    "newton_steel": ("12 sweeps",),
}
#: From here on it is said: overlap with the ground and torn joints [m], and how far the base ends from ours [m].
DEEP, TORN, ELSEWHERE = 2e-3, 1e-3, 0.05


@dataclass(frozen=True)
class End:
    """How a run ended: pose [E, B, 7] and velocity [E, B, 6] of the bodies, and the mean number of contacts."""

    pose: np.ndarray
    velocity: np.ndarray
    contacts: float

    def told(self, robot: Robot) -> dict[str, Any]:
        """Mean height of the base and of its way from the start [m], largest overlap with the ground and of torn joints [m]."""
        base = self.pose[:, 0, :3]
        return {
            "contacts": self.contacts,
            "base": float(base[:, 2].mean()),
            "base_moved": float(np.linalg.norm(base - robot.pose[:, 0, :3], axis=-1).mean()),
            "penetration": float(np.maximum(0.0, -robots.lowest(robot.model, self.pose).min())),
            "torn": robots.torn(robot.model, self.pose),
        }


def record(sim: wl.Simulator, robot: Robot) -> tuple[End, dict[str, Any]]:
    """Our own run, not timed, and what its answers are worth: residuals [m/s] and the share that is certified."""
    sim.reset()
    status, residual, contacts = [], [], []
    for _ in range(robot.steps):
        sim.step()
        status.append(sim.status.numpy().copy())
        residual.append(sim.residual.numpy().copy())
        contacts.append(sim.contacts.count.numpy().mean())
    bad = np.array(status) & int(wl.Status.UNCERTIFIED | wl.Status.NOT_A_NUMBER | wl.Status.OVERFLOW)
    worth = {"residual_median": float(np.median(residual)), "residual_max": float(np.max(residual)), "certified": float((bad == 0).mean())}
    return End(sim.body_pose.numpy().copy(), sim.body_velocity.numpy().copy(), float(np.mean(contacts))), worth


def remarks(mine: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """How a peer's run differs from ours so far that its speed is that of another task."""
    found = []
    if other["penetration"] > DEEP + mine["penetration"]:
        found.append(f"{1e3 * other['penetration']:.0f} mm in the ground")
    if other["torn"] > TORN:
        found.append(f"joints torn by {1e3 * other['torn']:.0f} mm")
    if abs(other["base"] - mine["base"]) > ELSEWHERE:
        found.append(f"base at {other['base']:.2f} m, ours {mine['base']:.2f} m")
    return found


def one(robot: Robot, sessions: list[Session], repetitions: int) -> Iterator[dict[str, Any]]:
    """Ours and every variant of every peer with one robot; a line with 'refused' for each that cannot have it."""
    sim = robot.simulator(device="cpu")
    sim.step(0)
    end, worth = record(sim, robot)
    tasks: list[Task] = []
    for each in sessions:
        for variant in VARIANTS[each.peer.name]:
            try:
                tasks.append(each.make(variant, robot, robot.steps))
            except Refused as why:
                yield {"scene": robot.name, "engine": f"{each.peer.name}, {variant}", "refused": str(why)}
    seconds: list[float] = []
    for _ in range(repetitions):
        sim.reset()
        begin = time.perf_counter()
        sim.step(robot.steps)
        seconds.append(time.perf_counter() - begin)
        for task in tasks:
            task.repeat()
    mine = end.told(robot)
    yield compare.row(robot, compare.OURS, seconds, seconds) | mine | worth | {"problems": [], "remarks": []}
    for task in tasks:
        theirs = End(task.pose[-1], task.velocity[-1], task.contacts).told(robot)
        line = compare.row(robot, task.name, task.seconds, seconds) | theirs
        line |= {"problems": compare.problems(robot, task), "remarks": remarks(mine, theirs)}
        line |= {"settings": task.session.peer.variants[task.variant], "info": task.info, "versions": task.session.versions}
        yield line
        task.drop()


def measure(names: list[str], others: list[Peer], quick: bool, folder: Path, usd: Path = robots.USD) -> dict[str, Any]:
    """Every robot that loads, falling and at rest, and why the others do not.

    Raises:
        FileNotFoundError: without the files.
    """
    if not usd.is_dir():
        raise FileNotFoundError(f"no robots: {usd} does not exist")
    rows: list[dict[str, Any]] = []
    absent: dict[str, str] = {}
    envs, repetitions = (4, 2) if quick else (ENVS, 7)
    with compare.one_core(), ExitStack() as stack:
        sessions = [stack.enter_context(session(peer, folder)) for peer in others]
        for name in tqdm(names, desc="robots", disable=None):
            try:
                falling = robots.dropped(f"{name} falls", usd / FILES[name], envs, DT, STEPS["falls"] // (10 if quick else 1), FALL)
            except wl.SceneError as error:
                absent[name] = str(error).replace(str(usd / FILES[name]), FILES[name])
                continue
            resting = replace(robots.settled(falling, f"{name} at rest", REST), steps=STEPS["at rest"] // (10 if quick else 1))
            for robot in (falling, resting):
                rows += one(robot, sessions, repetitions)
    refused = [row for row in rows if "refused" in row]
    return {"peers": [row for row in rows if "refused" not in row], "refused": refused, "absent": absent}


def markdown(data: dict[str, Any]) -> str:
    """One line for each engine and robot; lengths in mm."""
    lines = [
        "| robot | engine | env-steps/s | ours / it (least to most) | contacts | base mm | moved mm | in ground mm | torn mm | remarks |",
        "|" + " --- |" * 10,
    ]
    for r in data["peers"]:
        low, high = r["ours_over_peer_range"]
        ratio = "-" if r["problems"] or r["engine"] == compare.OURS else f"{r['ours_over_peer']:.2f} ({low:.2f} to {high:.2f})"
        lengths = " | ".join(f"{1e3 * r[key]:.3g}" for key in ("base", "base_moved", "penetration", "torn"))
        said = [f"NOT COMPARED: {p}" for p in r["problems"]] + r["remarks"]
        if "certified" in r:
            said.append(f"residual {r['residual_median']:.0e} m/s, at most {r['residual_max']:.0e}; {r['certified']:.2%} certified")
        lines.append(
            f"| {r['scene']}, {r['envs']} envs | {r['engine']} | {r['env_steps_per_s']:,.0f} ± {50 * r['spread']:.0f} % "
            f"| {ratio} | {r['contacts']:.1f} | {lengths} | {'; '.join(said)} |"
        )
    lines += [f"\n{r['scene']}: refused by {r['refused']}" for r in data["refused"]]
    return "\n".join(lines + [f"\nleft out: {why[:200]}" for why in data["absent"].values()])
