# SPDX-License-Identifier: Apache-2.0
"""Environment steps per second of the paper's box.

Three states, one movable body: at rest, sliding (the paper's example while it slides) and dropped tumbling, with a random
state for each environment: it lands within 0.1 s of the 0.25 s that are timed. On the CPU everything runs on one core.
Each figure is the median of several repetitions from the same start; the spread is (max - min) / median.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
import warp as wp
from tqdm import tqdm

from . import scenes
from .scenes import STATES, STEPS

SIZES = (1, 64, 1024, 8192)
COMBINATIONS = (
    ("auto", "float64"),
    ("velocity_pivoting", "float64"),
    ("lemke", "float64"),
    ("pgs", "float64"),
    ("lemke", "float32"),
    ("pgs", "float32"),
)
SECONDS = 2.0  # after this long a combination is not repeated again


def one(device: wp.Device, state: str, envs: int, method: str, precision: str, repetitions: int) -> dict[str, Any]:
    """Measure one combination."""
    sim = scenes.scene(state, envs).simulator(method=method, precision=precision, device=device)
    steps = STEPS[state]
    runs = max(1, 200 // envs)  # of a few environments, timed together
    sim.step(0)
    sim.step(2)
    rates, status, residual = [], np.zeros(envs, dtype=np.int32), 0.0
    finish = time.perf_counter() + SECONDS
    while len(rates) < repetitions and (not rates or time.perf_counter() < finish):
        elapsed = 0.0
        for _ in range(runs):
            sim.reset()
            wp.synchronize_device(device)
            begin = time.perf_counter()
            sim.step(steps)
            wp.synchronize_device(device)
            elapsed += time.perf_counter() - begin
        rates.append(runs * envs * steps / elapsed)
        status |= sim.status.numpy()
        residual = max(residual, float(sim.residual.numpy().max()))
    median = statistics.median(rates)
    return {
        "state": state,
        "envs": envs,
        "method": method,
        "precision": precision,
        "env_steps_per_s": median,
        "spread": (max(rates) - min(rates)) / median,
        "repetitions": len(rates),
        "iterations": float(sim.iterations.numpy().mean()) / steps,
        "marked_envs": int(np.count_nonzero(status)),
        "last_residual": residual,
        "steps": steps,
    }


def measure(device: wp.Device, quick: bool) -> list[dict[str, Any]]:
    """Every state, batch size, method and precision."""
    cases = [(s, e, m, p) for m, p in COMBINATIONS for s in STATES for e in SIZES]
    return [one(device, *case, 3 if quick else 15) for case in tqdm(cases, desc="speed", disable=None)]


def markdown(rows: list[dict[str, Any]]) -> str:
    """Env-steps/s by method and batch size."""
    sizes = sorted({row["envs"] for row in rows})
    lines = ["| method | precision | state | " + " | ".join(f"{n} envs" for n in sizes) + " | iterations | marked envs |"]
    lines += ["|" + " --- |" * (5 + len(sizes))]
    for method, precision in COMBINATIONS:
        for state in STATES:
            found = [r for r in rows if (r["method"], r["precision"], r["state"]) == (method, precision, state)]
            rates = " | ".join(f"{r['env_steps_per_s']:,.0f} ± {50 * r['spread']:.0f} %" for r in sorted(found, key=lambda r: r["envs"]))
            last = max(found, key=lambda r: r["envs"])
            lines.append(f"| {method} | {precision} | {state} | {rates} | {last['iterations']:.1f} | {last['marked_envs']} |")
    return "\n".join(lines)
