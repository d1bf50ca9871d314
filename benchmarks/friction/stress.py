# SPDX-License-Identifier: Apache-2.0
"""Random contact problems that have a solution, made from a seed: redundant, degenerate, with mass ratios up to 1e6 and mu up to 10.

q = J v is in the range of J, so v+ = 0 obeys every constraint, and with W = J M^-1 J^T a solution exists (Acary, Cadoux,
Lemarechal and Malick 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from tqdm import tqdm

import warp_lcp as wl

from .recorded import natural_map

COUNT = 2000
QUICK_COUNT = 200
#: The seeds of the 2000 with the largest natural map; every run has them.
WORST = (49, 1695, 349)
NEARLY = 1e-8  # a residual like this, in parts of |q|, is short of the tolerance but not astray
LAYOUTS = ("random", "parallel", "face", "repeated", "static")
FRICTIONS = ("none", "small", "common", "large", "ten", "mixed")


def frame(rng: np.random.Generator, normal: np.ndarray) -> np.ndarray:
    """Rows n, t1, t2, the tangents turned by a random angle."""
    normal = normal / np.linalg.norm(normal)
    tangent = np.cross(normal, rng.normal(size=3))
    tangent /= np.linalg.norm(tangent)
    return np.array([normal, tangent, np.cross(normal, tangent)])


def friction(rng: np.random.Generator, kind: str, contacts: int) -> np.ndarray:
    """Friction coefficients of one kind."""
    ranges = {"none": (0.0, 0.0), "small": (1e-3, 0.1), "common": (0.1, 1.0), "large": (1.0, 10.0), "ten": (10.0, 10.0)}
    if kind in ranges:
        return rng.uniform(*ranges[kind], contacts)
    return np.where(rng.random(contacts) < 0.2, 0.0, 10.0 ** rng.uniform(-3.0, 1.0, contacts))


def generate(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
    """W, q, mu and what they were made of."""
    rng = np.random.default_rng([seed, 20_000])
    bodies, contacts = int(rng.integers(1, 9)), int(rng.integers(4, 61))
    layout, kind = str(rng.choice(LAYOUTS)), str(rng.choice(FRICTIONS))
    decades = rng.uniform(0.0, 6.0)
    mass = 10.0 ** (decades * rng.permutation(np.linspace(0.0, 1.0, bodies)))
    inverse = np.zeros((6 * bodies, 6 * bodies))
    for b in range(bodies):
        inverse[6 * b : 6 * b + 3, 6 * b : 6 * b + 3] = np.eye(3) / mass[b]
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        inverse[6 * b + 3 : 6 * b + 6, 6 * b + 3 : 6 * b + 6] = axes @ np.diag(1.0 / (mass[b] * rng.uniform(0.02, 0.5, 3))) @ axes.T
    J, common = np.zeros((3 * contacts, 6 * bodies)), frame(rng, rng.normal(size=3))
    for i in range(contacts):
        first = int(rng.integers(bodies))
        second = int(rng.integers(-1, bodies))  # -1: the ground
        basis = common if layout in ("parallel", "face") else frame(rng, rng.normal(size=3))
        arms = rng.uniform(-0.5, 0.5, (2, 3))
        if layout == "face":  # all points of a body in one plane: rows of J are dependent
            arms[:, :] = arms @ (np.eye(3) - np.outer(common[0], common[0])) + 0.5 * np.outer([1.0, -1.0], common[0])
        if layout == "repeated" and i % 2:
            J[3 * i : 3 * i + 3] = J[3 * i - 3 : 3 * i]
            continue
        if layout == "static" and rng.random() < 0.3:
            continue  # between two things that cannot move: its rows and columns of W are zero
        for body, sign, arm in ((first, 1.0, arms[0]), (second, -1.0, arms[1])):
            if body >= 0 and first != second:
                skew = np.array([[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]])
                J[3 * i : 3 * i + 3, 6 * body : 6 * body + 6] += sign * basis @ np.hstack([np.eye(3), -skew])
    W = J @ inverse @ J.T
    velocity = 10.0 ** rng.uniform(-3.0, 1.0) * rng.normal(size=6 * bodies)
    if rng.random() < 0.3:  # everything falls alike, as in a heap at rest
        velocity = np.tile([0.0, 0.0, -9.81e-3, 0.0, 0.0, 0.0], bodies)
    rank = int(np.linalg.matrix_rank(J))
    about = {"seed": seed, "bodies": bodies, "contacts": contacts, "layout": layout, "friction": kind, "mass_ratio": 10.0**decades}
    return W, J @ velocity, friction(rng, kind, contacts), about | {"rank": rank, "zero_blocks": int((W.diagonal() == 0.0).sum() // 3)}


def measure(device: wp.Device, count: int) -> list[dict[str, Any]]:
    """Solve seeds 0 ... count - 1 and the worst ones, problems with equal numbers of contacts together."""
    made = [generate(seed) for seed in sorted({*range(count), *WORST})]
    groups: dict[int, list[Any]] = {}
    for problem in made:
        groups.setdefault(problem[3]["contacts"], []).append(problem)
    rows = []
    for group in tqdm(groups.values(), desc="stress", disable=None):
        W, q, mu = (np.array([p[x] for p in group]) for x in range(3))
        s = wl.solve_contact(W, q, mu, device=device)
        columns = (s.impulse, s.status, s.iterations, s.residual)
        for problem, impulse, status, iterations, residual in zip(group, *(x.numpy() for x in columns), strict=True):
            row = dict(problem[3])
            row |= {
                "status": int(status),
                "iterations": int(iterations),
                "residual": float(residual / np.abs(problem[1]).max(initial=1e-300)),
            }
            row["natural_map"] = natural_map(*problem[:3], impulse) if np.any(problem[1]) else float(np.linalg.norm(impulse))
            rows.append(row)
    return sorted(rows, key=lambda row: row["seed"])


def describe(row: dict[str, Any]) -> str:
    """One line with what a problem was made of and how it ended."""
    return (
        f"seed {row['seed']}: {row['bodies']} bodies, {row['contacts']} contacts, {row['layout']}, friction {row['friction']}, "
        f"mass ratio {row['mass_ratio']:.0e}, rank {row['rank']}/{3 * row['contacts']}, status {row['status']}, "
        f"{row['iterations']} iterations, natural map {row['natural_map']:.1e}, residual / |q| {row['residual']:.1e}"
    )


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Share certified, worst natural map, iterations, failures by what the problems were made of and one by one, the three worst."""
    good = [row for row in rows if row["status"] == 0]
    iterations = np.array([row["iterations"] for row in rows])
    failures = [row for row in rows if row["status"]]
    return {
        "problems": len(rows),
        "certified": len(good),
        "nearly": sum(row["residual"] <= NEARLY for row in failures),
        "worst_certified_natural_map": max(row["natural_map"] for row in good),
        "worst_natural_map": max(row["natural_map"] for row in rows),
        "iterations": {f"p{p}": float(np.percentile(iterations, p)) for p in (50, 99, 100)},
        "failed": {
            key: {kind: [sum(r[key] == kind for r in failures), sum(r[key] == kind for r in rows)] for kind in kinds}
            for key, kinds in (("layout", LAYOUTS), ("friction", FRICTIONS))
        },
        "failures": [describe(row) for row in failures],
        "worst": [describe(row) for row in sorted(rows, key=lambda row: -row["natural_map"])[:3]],
    }


def markdown(found: dict[str, Any]) -> str:
    """The summary without the list of failures (the JSON file has it)."""
    steps = found["iterations"]
    lines = [
        f"{found['certified']} of {found['problems']} random problems certified; of the others {found['nearly']} to {NEARLY:g}",
        f"natural map: {found['worst_certified_natural_map']:.1e} at most where certified, {found['worst_natural_map']:.1e} of all",
        f"iterations: p50 {steps['p50']:.0f}, p99 {steps['p99']:.0f}, max {steps['p100']:.0f}",
    ]
    for key, kinds in found["failed"].items():
        lines.append(f"not certified by {key}: " + ", ".join(f"{kind} {failed}/{number}" for kind, (failed, number) in kinds.items()))
    return "\n".join([*lines, *(f"worst: {line}" for line in found["worst"])])
