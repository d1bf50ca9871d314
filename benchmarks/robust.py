# SPDX-License-Identifier: Apache-2.0
"""Thousands of randomised environments of every shipped scene: not a number anywhere? which steps are certified? how well?

Start positions, headings, velocities, masses and friction differ in every environment; nothing is left out of the counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from tqdm import tqdm

import warp_lcp as wl

DT = 5e-3
#: Bins of the residuals, a tenth of a decade each.
EDGES = np.concatenate([[0.0], 10.0 ** np.arange(-18.0, 6.05, 0.1), [np.inf]])


def scenes() -> list[str]:
    """Names of the shipped scenes."""
    import warp_lcp.scenes

    return sorted(path.stem for root in warp_lcp.scenes.__path__ for path in Path(root).glob("*.usda"))


def randomise(sim: wl.Simulator, seed: int = 0, wrench: np.ndarray | None = None) -> None:
    """Another start, mass and friction for every environment; constant wrenches [B, 6] are the same.

    Bodies are drawn apart upwards by 0.2 % of their height and 2 mm, so that few overlap by more than what 2 mm and 4 mrad of
    noise make of it.
    """
    rng, m, envs = np.random.default_rng(seed), sim.model, sim.num_envs
    gravity = np.asarray(m.gravity, dtype=float)
    up = -gravity / max(np.linalg.norm(gravity), 1e-9)
    q, v = sim.q0.numpy().astype(float), sim.v0.numpy().astype(float)
    for joint, i, j in zip(m.joint_type, m.q_start, m.v_start, strict=True):
        if joint != wl.JointType.FREE:
            continue
        x = q[:, i : i + 3]
        noise = 0.002 * rng.normal(size=x.shape)
        x += noise - (noise @ up)[:, None] * up + (0.002 * np.abs(x @ up) + rng.uniform(0.0, 0.002, envs))[:, None] * up
        turn = np.column_stack([0.002 * rng.normal(size=(envs, 3)), np.ones(envs)])
        q[:, i + 3 : i + 7] = product(turn / np.linalg.norm(turn, axis=1)[:, None], q[:, i + 3 : i + 7])
        v[:, j : j + 6] += 0.05 * rng.normal(size=(envs, 6))
    sim.q0.assign(q)
    sim.v0.assign(v)
    sim.set_parameters(
        mass=m.mass * rng.uniform(0.8, 1.25, (envs, 1)), friction=np.tile(m.friction, (envs, 1, 1)) * rng.uniform(0.8, 1.25, (envs, 1, 1))
    )
    sim.reset()
    if wrench is not None:
        sim.wrench.assign(np.tile(wrench, (envs, 1, 1)))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternions a b, [E, 4] x y z w."""
    w, u = a[:, 3:], a[:, :3]
    return np.column_stack([w * b[:, :3] + b[:, 3:] * u + np.cross(u, b[:, :3]), w[:, 0] * b[:, 3] - (u * b[:, :3]).sum(axis=1)])


def one(name: str, envs: int, seconds: float, device: wp.Device, **options: Any) -> dict[str, Any]:
    """Counts over every environment and step of one shipped scene."""
    return count(name, wl.Simulator(wl.load_usd(name), envs, DT, device=device, **options), round(seconds / DT), randomise) | options


def count(name: str, sim: wl.Simulator, steps: int, start: Callable[[wl.Simulator], None]) -> dict[str, Any]:
    """Counts over every environment and step, from where `start` puts them."""
    sim.step(0)
    start(sim)
    envs = sim.num_envs
    counts, bits, worst = np.zeros(len(EDGES) - 1, dtype=np.int64), dict.fromkeys((s.name for s in wl.Status if s), 0), 0.0
    spoilt, begin = np.zeros(envs, dtype=bool), time.perf_counter()
    for _ in tqdm(range(steps), desc=name, disable=None, leave=False):
        sim.step()
        status, residual = sim.status.numpy(), np.where(np.isnan(sim.residual.numpy()), np.inf, sim.residual.numpy())
        for bit in wl.Status:
            if bit:
                bits[bit.name] += int(np.count_nonzero(status & bit))
        counts += np.histogram(residual, EDGES)[0]
        worst = max(worst, float(residual.max()))
        spoilt |= (status & (wl.Status.UNCERTIFIED | wl.Status.NOT_A_NUMBER)) != 0
    total = envs * steps
    within = np.cumsum(counts) / total
    return {
        "scene": name,
        "envs": envs,
        "steps": steps,
        "dt": sim.dt,
        "bodies": sim.model.num_bodies,
        "seconds_per_env_step": (time.perf_counter() - begin) / total,
        "certified": 1.0 - (bits["UNCERTIFIED"] + bits["NOT_A_NUMBER"]) / total,
        "spoilt_envs": int(spoilt.sum()),
        "not_finite": int(np.count_nonzero(~np.isfinite(sim.q.numpy()).all(axis=1))),
        "status": bits,
        "residual_p99": float(EDGES[1:][np.argmax(within >= 0.99)]),
        "residual_p9999": float(EDGES[1:][np.argmax(within >= 0.9999)]),
        "residual_worst": worst,
    }


def markdown(rows: list[dict[str, Any]]) -> str:
    """One line a scene."""
    heads = ["scene", "formulation", "env-steps", "certified", "not certified", "NaN", "environments with one of these"]
    heads += ["residual p99", "p99.99", "worst [m/s]", "us an env-step"]
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    for r in rows:
        status, residuals = r["status"], " | ".join(f"{r[name]:.1e}" for name in ("residual_p99", "residual_p9999", "residual_worst"))
        lines.append(
            f"| {r['scene']} | {r.get('formulation', 'default')} | {r['envs'] * r['steps']:,} | {100 * r['certified']:.5f} % "
            f"| {status['UNCERTIFIED']} | {status['NOT_A_NUMBER']} | {r['spoilt_envs']} of {r['envs']} | {residuals} "
            f"| {1e6 * r['seconds_per_env_step']:.2f} |"
        )
    return "\n".join(lines)


def measure(device: wp.Device, names: list[str], formulations: list[str], envs: int, seconds: float) -> list[dict[str, Any]]:
    """Every scene under every formulation."""
    return [one(name, envs, seconds, device, formulation=f) for f in formulations for name in names]
