# SPDX-License-Identifier: Apache-2.0
"""Two goals beside speed: a heavy box on a light one stays where it is, and environments that fail the first method cost little.

Mass ratio: two cubes of 0.2 m, the lower one of 8 kg, the upper one heavier by the ratio, at rest on the ground for 2 s at 5 ms, one
environment on the CPU. Errors are the largest over both boxes and all steps; part of the vertical one is what the compliance of
Table 1 gives under that weight. Fallback: 1 % of the environments get contacts too stiff for velocity pivoting (1e25 N/m), so
that the next method solves them; timed in turns with the same batch without them.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl

from .scenes import GRAVITY, STATES, STEPS, Scene, boxes, scene

RATIOS = (1e3, 1e6)
MASS, HALF, DT, STEPS_HEAVY = 8.0, 0.1, 5e-3, 400
#: Of a ratio of 1000: heights, sideways [m], seconds a step.
GOAL = (0.02e-3, 0.1e-3, 0.1e-3)

ENVS, SHARE = 1024, 0.01
STIFF = (1e25, 1e22)  # N/m, N s/m
#: Time with those environments over time without.
FALLBACK_GOAL = 1.5


def heavy_on_light(ratio: float) -> Scene:
    """The stack at rest."""
    pose = np.zeros((1, 2, 7))
    pose[..., 2], pose[..., 6] = HALF * np.array([1.0, 3.0]), 1.0
    mass = [MASS, MASS * ratio]
    return boxes("heavy_on_light", np.full((2, 3), HALF), mass, pose, np.zeros((1, 2, 6)), 0.5, dt=DT, steps=STEPS_HEAVY)


def mass_ratio(quick: bool) -> list[dict[str, Any]]:
    """Errors and time of a step for every ratio."""
    return [stack(ratio, 5 if quick else 15) for ratio in RATIOS]


def stack(ratio: float, repetitions: int) -> dict[str, Any]:
    """One ratio: a run that is looked at in every step, then timed ones."""
    what = heavy_on_light(ratio)
    sim = what.simulator(device="cpu")
    away, marked = np.zeros((2, 3)), 0
    for _ in range(what.steps):
        sim.step()
        away = np.maximum(away, np.abs(sim.q.numpy().reshape(2, 7)[:, :3] - what.pose[0, :, :3]))
        marked += int(sim.status.numpy()[0] != 0)
    sim.step(0)
    seconds = [clock(sim, what.steps) / what.steps for _ in range(repetitions)]
    stiffness = 1e10 * MASS  # Table 1 for the lighter of two bodies; four points carry each layer
    return {
        "ratio": ratio,
        "z_error": float(away[:, 2].max()),
        "z_compliance": (2 * ratio + 1) * MASS * GRAVITY / (4 * stiffness),
        "lateral_error": float(np.hypot(away[:, 0], away[:, 1]).max()),
        "marked_steps": marked,
        "step_s": statistics.median(seconds),
        "step_best_s": min(seconds),
    }


def clock(sim: wl.Simulator, steps: int) -> float:
    """Seconds of so many steps from the start."""
    sim.reset()
    wp.synchronize_device(sim.device)
    begin = time.perf_counter()
    sim.step(steps)
    wp.synchronize_device(sim.device)
    return time.perf_counter() - begin


def fallback(device: wp.Device, quick: bool) -> list[dict[str, Any]]:
    """What environments that fail the first method cost, for every state."""
    return [failing(device, state, 5 if quick else 15) for state in STATES]


def failing(device: wp.Device, state: str, repetitions: int) -> dict[str, Any]:
    """One state: the same batch with and without them, in turns."""
    plain, spoilt = (scene(state, ENVS).simulator(device=device) for _ in range(2))
    plain.step(0)
    contact = np.tile(spoilt.model.contact, (ENVS, 1, 1))
    number = round(SHARE * ENVS)
    contact[np.arange(number) * (ENVS // number), :, :2] = STIFF
    spoilt.set_parameters(contact=contact)
    handed_on, marked = 0, np.zeros(ENVS, dtype=bool)
    spoilt.reset()
    for _ in range(STEPS[state]):
        spoilt.step()
        handed_on = max(handed_on, int(spoilt.queued.numpy()[0]))
        marked |= spoilt.status.numpy() != 0
    pairs = [(clock(plain, STEPS[state]), clock(spoilt, STEPS[state])) for _ in range(repetitions + 1)][1:]  # the first one warms up
    ratios = [b / a for a, b in pairs]
    return {
        "state": state,
        "envs": ENVS,
        "failing_envs": number,
        "most_handed_on": handed_on,
        "marked_envs": int(marked.sum()),
        "ratio": statistics.median(ratios),
        "ratio_range": [min(ratios), max(ratios)],
    }


def said(reached: bool) -> str:
    """Of a goal."""
    return "reached" if reached else "MISSED"


def markdown(stacks: list[dict[str, Any]], failures: list[dict[str, Any]]) -> str:
    """Both tables."""
    lines = [
        "| mass ratio | z error mm (of it compliance) | lateral error mm | us a step (best) | marked steps | goal |",
        "|" + " --- |" * 6,
    ]
    for r in stacks:
        reached = all(value < goal for value, goal in zip((r["z_error"], r["lateral_error"], r["step_s"]), GOAL, strict=True))
        goal = f"{1e3 * GOAL[0]:g} mm, {1e3 * GOAL[1]:g} mm, {1e6 * GOAL[2]:g} us: {said(reached)}" if r["ratio"] == RATIOS[0] else "-"
        lines.append(
            f"| {r['ratio']:g} | {1e3 * r['z_error']:.3g} ({1e3 * r['z_compliance']:.3g}) | {1e3 * r['lateral_error']:.1g} "
            f"| {1e6 * r['step_s']:.1f} ({1e6 * r['step_best_s']:.1f}) | {r['marked_steps']} | {goal} |"
        )
    lines += [
        "",
        "| state | environments that fail the first method | handed on | marked | time with / without them | goal |",
        "|" + " --- |" * 6,
    ]
    for r in failures:
        low, high = r["ratio_range"]
        lines.append(
            f"| {r['state']} | {r['failing_envs']} of {r['envs']} | {r['most_handed_on']} | {r['marked_envs']} "
            f"| {r['ratio']:.2f} ({low:.2f} to {high:.2f}) | {FALLBACK_GOAL}: {said(r['ratio'] < FALLBACK_GOAL)} |"
        )
    return "\n".join(lines)
