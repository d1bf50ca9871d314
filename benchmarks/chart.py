# SPDX-License-Identifier: Apache-2.0
"""Speed against accuracy: ours and every installed engine on the same scenes, steps and start states, one core for all.

A point is an engine's setting at a step size. Its error is that of the case's first metric over a run from beginning to end. Its
time is the wall time per environment and simulated time, in us per ms: at a step of 1 ms that is the time per step. (Time per
step alone would make the smallest step the best deal of every engine.) Timed is a batch over the first part of the motion, all
engines in turns; the energy by which steps of that part miss the laws (energy_error.py) stands beside.
"""

from __future__ import annotations

import math
import re
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from tqdm import tqdm

import warp_lcp as wl

from . import energy_error, motion, stability
from .cases import CASES, Case
from .motion import Motion
from .peers import PEERS, Peer, compare
from .peers.session import PeerError, Refused, Session, Task, session
from .scenes import Scene

CHARTED = [name for name, case in CASES.items() if case.charted]
STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4)
QUICK_STEPS = (1e-2, 2e-3)
ENVS = 64  # that are timed together
TIMED, LEAST_STEPS, MOST_STEPS = 0.2, 20, 400  # s of simulated time that are timed, within these numbers of steps
TURNS, LEAST_TURN = 3, 0.05  # s: a turn repeats a short run for so long and keeps its median
PATIENCE = 20.0  # s that a run from beginning to end may be expected to take
TURN = 2.0  # s that a timed turn is expected to take at most: slow engines get fewer environments, but no fewer than LEAST_ENVS
LEAST_ENVS = 4
#: Errors under this are round-off, and no better than it.
ROUND_OFF = 1e-12


@dataclass(frozen=True)
class Ours:
    """One curve of ours: options that stay, and a knob: the step size, or directions at one step."""

    name: str
    options: dict[str, Any]
    directions: tuple[int, ...] = ()


OURS = (
    Ours("default", {}),
    Ours("midpoint", {"integrator": "midpoint"}),
    Ours("coulomb", {"formulation": "coulomb"}),
    Ours("float32", {"precision": "float32"}),
    Ours("lemke", {"method": "lemke"}),
    Ours("pgs", {"method": "pgs"}),
    Ours("AP, k = 2 to 16", {"formulation": "anitescu_potra"}, (2, 4, 8, 16)),
)
KNOB_STEP = 1e-3  # s, where the knob is another one


def point(case: Case, moved: Motion, engine: str, setting: str, knob: str, h: float) -> dict[str, Any]:
    """What is told of one run from beginning to end."""
    errors = {metric.name: metric.error(moved) for metric in case.metrics}
    finite = moved.finite
    return {
        "case": case.name,
        "engine": engine,
        "setting": setting,
        "knob": knob,
        "h": h,
        "error": errors[case.metrics[0].name],
        "unit": case.metrics[0].unit,
        "errors": errors,
        "finite": finite,
        "contacts": moved.contacts,
        "energy_rise": case.energy_rise(moved),
        "certified": moved.certified if len(moved.status) else None,
        "residual": float(moved.residual.max()) if moved.residual.size else None,
        "path": path(moved) if (case.name, h) == ("box", KNOB_STEP) else None,
    }


def path(moved: Motion) -> dict[str, list[float]]:
    """Time [s] and the first body's way [m] in the first environment, for a picture."""
    numbers = [moved.time, *moved.pose[:, 0, 0, :3].T]
    return {name: [round(float(x), 6) for x in values] for name, values in zip(("time", "x", "y", "z"), numbers, strict=True)}


@cache
def settled(name: str) -> dict[str, Any]:
    """Fields of a Scene that say where the timed part of a case starts, for everyone: of our own motion at 1 ms."""
    case = CASES[name]
    if not case.timed_from:
        return {}
    scene = case.scene(1e-3)
    sim = scene.simulator(device="cpu")
    sim.step(round(case.timed_from / 1e-3))
    pose, velocity = (array.numpy().astype(float) for array in (sim.body_pose, sim.body_velocity))
    if scene.made is None:
        return {"pose": pose, "velocity": velocity}
    made = replace(scene.made, q0=sim.q.numpy()[0].astype(float), v0=sim.v.numpy()[0].astype(float))
    return {"pose": pose, "velocity": velocity, "made": made}


def part(case: Case, h: float, env_step: float = 0.0) -> Scene:
    """The batch that is timed, if a step of an environment takes about so many seconds."""
    scene = replace(case.scene(h), **settled(case.name))
    number = min(max(LEAST_STEPS, round(TIMED / h)), MOST_STEPS)
    most = TURN / (env_step * number) if env_step else math.inf
    return replace(scene.copies(int(min(ENVS, max(LEAST_ENVS, most)))), steps=number)


def energy_errors(moved: Motion) -> dict[str, float | None]:
    """What the timed part's steps miss of the laws [J], of a motion that is sampled at every step; None where it is not defined."""
    return {"E_uc": energy_error.largest(moved) if energy_error.defined(moved.scene) else None}


def spread(seconds: list[float], scene: Scene) -> dict[str, float]:
    """Time per environment and step [s], median of the turns, their range over it, and of what it was taken."""
    each = [s / (scene.envs * scene.steps) for s in seconds]
    median = statistics.median(each)
    per_ms = 1e6 * median / (1e3 * scene.dt)
    return {"step_s": median, "spread": (max(each) - min(each)) / median, "per_ms_us": per_ms, "envs": scene.envs, "steps": scene.steps}


Clock = Callable[[], float]


def turn(clock: Clock) -> float:
    """One turn of a run: its median time [s]. A machine that is shared stops for longer than a short run takes."""
    seconds = [clock()]
    while sum(seconds) < LEAST_TURN:
        seconds.append(clock())
    return statistics.median(seconds)


def clock_of(case: Case, h: float, device: Any, options: dict[str, Any]) -> tuple[Clock, Scene]:
    """What times a batch of ours once, and the batch: fewer environments where a turn would take too long, as for other engines."""

    def of(scene: Scene) -> Clock:
        sim = scene.simulator(device=device, **options)
        sim.step(0)

        def clock() -> float:
            scene.restart(sim)
            begin = time.perf_counter()
            sim.step(scene.steps)
            wp.synchronize_device(sim.device)
            return time.perf_counter() - begin

        clock()  # warm
        return clock

    few = part(case, h).copies(LEAST_ENVS)
    scene = part(case, h, of(few)() / (few.envs * few.steps))
    return of(scene), scene


def ours_at(case: Case, h: float, device: Any) -> tuple[list[dict[str, Any]], list[tuple[Clock, Scene]]]:
    """Our points at a step, and what times each of them once."""
    points, clocks = [], []
    for curve in OURS:
        if curve.directions and h != KNOB_STEP:
            continue
        for k in curve.directions or (None,):
            options = curve.options | ({} if k is None else {"directions": k})
            knob = f"{1e3 * h:g} ms" if k is None else f"k = {k}"
            try:
                moved = case.simulate(h, device=device, limit=PATIENCE, **options)
            except (motion.TooSlow, wl.WarpLcpError) as why:  # what an option does not know yet is left out as in other engines
                points.append({"case": case.name, "engine": "warp_lcp", "setting": curve.name, "knob": knob, "h": h, "left_out": str(why)})
                continue
            points.append(point(case, moved, "warp_lcp", curve.name, knob, h))
            points[-1] |= energy_errors(motion.simulate(part(case, h).copies(1), device=device, **options))
            clocks.append(clock_of(case, h, device, options))
    return points, clocks


def theirs_at(
    case: Case, h: float, sessions: list[Session], known: dict[tuple[str, str], float]
) -> tuple[list[dict[str, Any]], list[tuple[Task, Scene] | None]]:
    """The other engines' points at a step, and what is timed (None where there is nothing).

    known: seconds of a step of a run from beginning to end, by engine and setting; at larger steps before, at this one after.
    """
    points, tasks = [], []
    for each in sessions:
        for variant in each.peer.variants:
            name, scene = each.peer.name, case.scene(h)
            row: dict[str, Any] = {"case": case.name, "engine": name, "setting": variant, "knob": f"{1e3 * h:g} ms", "h": h}
            expected = known.get((name, variant), 0.0) * scene.steps * scene.envs
            try:
                if expected > PATIENCE:
                    raise Refused(f"a run would take {expected:.0f} s")
                whole = each.make(variant, scene, case.every(h), timed=False)
                known[name, variant] = whole.recorded_s / (scene.steps * scene.envs)
                problems = compare.problems(scene, whole)
                whole.drop()
                short = part(case, h, known[name, variant])
                timed = each.make(variant, short, 1 if energy_error.defined(short) else short.steps)
            except (Refused, PeerError) as why:
                if each.process.poll() is not None:
                    raise
                points.append(row | {"left_out": str(why).strip().splitlines()[-1]})
                tasks.append(None)
                continue
            row = point(case, Motion.of(scene, whole.pose, whole.velocity, whole.contacts), name, variant, row["knob"], h)
            before = (timed.before_pose, timed.before_velocity)
            row |= energy_errors(Motion.of(short, timed.pose, timed.velocity, timed.contacts, before=before))
            points.append(row | {"problems": problems, "versions": each.versions})
            tasks.append((timed, short))
    return points, tasks


def at(case: Case, h: float, sessions: list[Session], known: dict[tuple[str, str], float], device: Any) -> list[dict[str, Any]]:
    """All points of a case at a step, timed in turns."""
    mine, clocks = ours_at(case, h, device)
    theirs, tasks = theirs_at(case, h, sessions, known)
    seconds: list[list[float]] = [[] for _ in clocks]
    for _ in range(TURNS):
        for (clock, _), into in zip(clocks, seconds, strict=True):
            into.append(turn(clock))
        for i, (row, task) in enumerate(zip(theirs, tasks, strict=True)):
            if task is not None:
                try:
                    row.setdefault("turns", []).append(turn(task[0].repeat))
                except PeerError as why:
                    if task[0].session.process.poll() is not None:
                        raise
                    row["left_out"], tasks[i] = str(why).strip().splitlines()[-1], None
    measured = zip(seconds, clocks, strict=True)
    for row in mine:
        if "left_out" not in row:
            each, (_, scene) = next(measured)
            row |= spread(each, scene)
    for row, task in zip(theirs, tasks, strict=True):
        if task is not None:
            done, short = task
            row |= spread(row.pop("turns"), short)
            row["problems"] += [problem for problem in compare.problems(short, done) if problem not in row["problems"]]
            done.drop()
    return mine + theirs


def measure(names: list[str], peers: list[Peer], folder: Path, device: Any, quick: bool) -> Iterator[list[dict[str, Any]]]:
    """Every case at every step; yields all rows that there are whenever a case is done."""
    rows: list[dict[str, Any]] = []
    with compare.one_core(), ExitStack() as stack:
        sessions = [stack.enter_context(session(peer, folder)) for peer in peers]
        steps = QUICK_STEPS if quick else STEPS
        progress = tqdm(total=len(names) * len(steps), desc="chart", disable=None)
        for name in names:
            known: dict[tuple[str, str], float] = {}
            for h in steps:
                rows += at(CASES[name], h, sessions, known, device)
                progress.update()
            yield rows
        progress.close()


# ------------------------------------------------------------------------------------------------------------------- reports


def complete(rows: list[dict[str, Any]]) -> bool:
    """Is every charted case there, at every step and with every setting of every engine?"""
    settings = [("warp_lcp", curve.name) for curve in OURS if not curve.directions]
    settings += [(name, variant) for name, peer in PEERS.items() for variant in peer.variants]
    seen = {(row["case"], row["engine"], row["setting"], row["h"]) for row in rows}
    return seen >= {(case, *setting, h) for case in CHARTED for setting in settings for h in STEPS}


def counts(row: dict[str, Any]) -> bool:
    """Is the row a point of the chart?"""
    return not against(row)


def against(row: dict[str, Any]) -> str:
    """Why a row is no point of the chart; '' if it is one."""
    if "left_out" in row:
        return row["left_out"]
    found = list(row.get("problems", []))
    if not row["finite"] or not np.isfinite(row["error"]):
        found.append("not a number")
    elif not row["energy_rise"] <= stability.BLOWN:
        found.append(f"blew up: energy rises by {row['energy_rise']:.1g} of its scale")
    if row["certified"] is not None and not row["certified"] >= stability.CERTIFIED:
        found.append(f"{100 * row['certified']:.3g} % certified")
    return "; ".join(found)


def error(row: dict[str, Any]) -> float:
    """Of a row; none is less than round-off."""
    return max(row["error"], ROUND_OFF)


def front(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those that no other of them beats in both, from fast to slow."""
    best, kept = np.inf, []
    for row in sorted(rows, key=lambda row: (row["per_ms_us"], error(row))):
        if error(row) < best:
            best = error(row)
            kept.append(row)
    return kept


def beaten(row: dict[str, Any], mine: list[dict[str, Any]]) -> bool:
    """Is one of ours both faster and more accurate?"""
    return any(own["per_ms_us"] < row["per_ms_us"] and error(own) < error(row) for own in mine)


def lead(theirs: list[dict[str, Any]], mine: list[dict[str, Any]]) -> str:
    """The smallest error of an engine, and how many times as fast ours is that errs no more; with the spread of both times."""
    best = min(theirs, key=lambda row: (error(row), row["per_ms_us"]))
    own = min((own for own in mine if error(own) <= error(best)), key=lambda own: own["per_ms_us"], default=None)
    if own is None:
        return f"{best['error']:.1e}: none"
    ratio = best["per_ms_us"] / own["per_ms_us"]
    return f"{best['error']:.1e}: {ratio:.3g} ± {50 * (best['spread'] + own['spread']):.0f} %"


def markdown(rows: list[dict[str, Any]]) -> str:
    """Who is on the front of each case, and which points of others none of ours beats in both."""
    lines = []
    cases = list(dict.fromkeys(row["case"] for row in rows))
    engines = [engine for engine in dict.fromkeys(row["engine"] for row in rows) if engine != "warp_lcp"]
    lines += ["| case | error | front: setting, knob (us/ms, error) |", "| --- | --- | --- |"]
    good = [row for row in rows if counts(row)]
    for name in cases:
        of_case = [row for row in good if row["case"] == name]
        on = "; ".join(
            f"{row['engine']} {row['setting']} {row['knob']} ({row['per_ms_us']:.3g}, {row['error']:.1e})" for row in front(of_case)
        )
        metric = CASES[name].metrics[0]
        lines.append(f"| {name} | {metric.name} [{metric.unit}] | {on} |")
    if engines:
        lines += ["", "Points of others of which one of ours is both faster and more accurate:", ""]
        lines += ["| case | " + " | ".join(engines) + " |", "|" + " --- |" * (len(engines) + 1)]
        for name in cases:
            mine = [row for row in good if row["case"] == name and row["engine"] == "warp_lcp"]
            cells = []
            for engine in engines:
                theirs = [row for row in good if row["case"] == name and row["engine"] == engine]
                cells.append(f"{sum(beaten(row, mine) for row in theirs)} of {len(theirs)}" if theirs else "-")
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines += ["", "Smallest error of each, and how many times as fast the fastest of ours is that errs no more:", ""]
        lines += ["| case | " + " | ".join(engines) + " |", "|" + " --- |" * (len(engines) + 1)]
        for name in cases:
            of_case = {
                engine: [row for row in good if row["case"] == name and row["engine"] == engine] for engine in ("warp_lcp", *engines)
            }
            cells = [lead(of_case[engine], of_case["warp_lcp"]) if of_case[engine] else "-" for engine in engines]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines += ["", "Not beaten:", ""]
        for name in cases:
            mine = [row for row in good if row["case"] == name and row["engine"] == "warp_lcp"]
            for row in good:
                if row["case"] == name and row["engine"] != "warp_lcp" and not beaten(row, mine):
                    near = min(mine, key=lambda own: own["error"] if own["per_ms_us"] < row["per_ms_us"] else np.inf, default=None)
                    faster = near is not None and near["per_ms_us"] < row["per_ms_us"]
                    beside = f"our best that is faster: {near['error']:.1e}" if faster else "none of ours is faster"
                    lines.append(
                        f"- {name}: {row['engine']} {row['setting']}, {row['knob']}: {row['per_ms_us']:.3g} us/ms, "
                        f"{row['error']:.1e} {row['unit']}; {beside}"
                    )
    out = [row for row in rows if not counts(row)]
    if out:
        lines += ["", "Not in the chart:", ""]
        alike: dict[tuple[str, str, str], list[dict[str, Any]]] = {}  # reasons that differ in numbers alone are told once
        for row in out:
            alike.setdefault((row["case"], row["engine"], re.sub(r"(?<![\w.])\d[\w.+-]*", "...", against(row))), []).append(row)
        for (name, engine, blanked), found in alike.items():
            why = against(found[0]) if len({against(row) for row in found}) == 1 else blanked
            knobs: dict[str, list[str]] = {}
            for row in found:
                knobs.setdefault(row["setting"], []).append(row["knob"])
            where = "; ".join(f"{setting}: {', '.join(at)}" for setting, at in knobs.items())
            lines.append(f"- {name}, {engine}: {why} ({where})")
    return "\n".join(lines)
