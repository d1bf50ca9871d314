# SPDX-License-Identifier: Apache-2.0
"""How far every case is from what is known of it, over step sizes; errors of the law and of the step told apart.

The *model* error is against the exact cone (`coulomb`, certified) with the same integrator and step; the *discretisation* error
is that of the exact cone against the reference; the *total*, against the reference, is what a user gets.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from tqdm import tqdm

from .cases import CASES, Case

STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4)
QUICK_STEPS = (1e-2, 1e-3)
EXACT = {"formulation": "coulomb"}
LAWS: dict[str, dict[str, Any]] = {"default": {}, "coulomb": EXACT, "midpoint": {"integrator": "midpoint"}}
#: Errors that are under this size at the largest step are round-off or compliance and have no order.
LEAST = 1e-7


def order(steps: list[float], errors: list[float]) -> float | None:
    """Slope of log error over log step, by least squares; None where the error does not come from the step."""
    e, h = np.array(errors), np.array(steps)
    rising = np.flatnonzero(~(e[1:] < 0.9 * e[:-1]))  # steps from large to small; from there on something else is the error
    kept = slice(0, rising[0] + 1 if len(rising) else len(e))
    if not np.isfinite(e).all() or e[0] < LEAST or len(e[kept]) < min(3, len(e)):
        return None
    return float(np.polyfit(np.log(h[kept]), np.log(np.maximum(e[kept], 1e-16)), 1)[0])


def one(case: Case, steps: tuple[float, ...], device: Any) -> list[dict[str, Any]]:
    """Every metric of a case under every law."""
    found: dict[str, list[dict[str, Any]]] = {law: [] for law in LAWS}
    for h in steps:
        runs = {law: case.simulate(h, device=device, **options) for law, options in LAWS.items()}
        exact = dict.fromkeys(LAWS, runs["coulomb"])
        exact["midpoint"] = case.simulate(h, device=device, **LAWS["midpoint"], **EXACT)
        for law, moved in runs.items():
            for metric in case.metrics:
                expected, seen, ideal = metric.expected(moved.scene.envs), metric.seen(moved), metric.seen(exact[law])
                found[law].append(
                    {
                        "metric": metric.name,
                        "unit": metric.unit,
                        "h": h,
                        "total": metric.distance(seen, expected),
                        "model": metric.distance(seen, ideal),
                        "discretisation": metric.distance(ideal, expected),
                        "within": metric.distance(seen, expected) <= metric.bar(h)
                        and (metric.law_bar is None or metric.distance(seen, ideal) <= metric.law_bar(h)),
                        "certified": moved.certified,
                        "energy_rise": case.energy_rise(moved),
                    }
                )
    rows = []
    for law, lines in found.items():
        for metric in case.metrics:
            mine = [line for line in lines if line["metric"] == metric.name]
            row: dict[str, Any] = {"case": case.name, "law": law, "metric": metric.name, "unit": metric.unit}
            for key in ("h", "total", "model", "discretisation", "within", "certified", "energy_rise"):
                row[key] = [line[key] for line in mine]
            row["order"] = order(row["h"], row["total"])
            rows.append(row)
    return rows


def measure(device: Any, names: list[str], quick: bool) -> list[dict[str, Any]]:
    """Every case."""
    steps = QUICK_STEPS if quick else STEPS
    bar = tqdm(names, desc="accuracy", disable=None)
    return [row for name in bar for row in one(CASES[name], steps, device)]


def markdown(rows: list[dict[str, Any]]) -> str:
    """Errors at every step of each case, metric and law, their order, the two parts at the first and last step; what the cases are."""
    steps = rows[0]["h"]
    heads = ["case", "metric", "law", *(f"{1e3 * h:g} ms" for h in steps), "order", "of the law", "of the step"]
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    for row in rows:
        cells = [f"{e:.1e}" if ok else f"**{e:.1e}**" for e, ok in zip(row["total"], row["within"], strict=True)]
        size = "-" if row["order"] is None else f"{row['order']:.2f}"
        parts = (f"{row[part][0]:.0e} … {row[part][-1]:.0e}" for part in ("model", "discretisation"))
        lines.append("| " + " | ".join([row["case"], f"{row['metric']} [{row['unit']}]", row["law"], *cells, size, *parts]) + " |")
    low = np.min([row["certified"] for row in rows])
    rise = np.max([row["energy_rise"] for row in rows])
    outside = sum(not ok for row in rows for ok in row["within"])
    total = sum(len(row["within"]) for row in rows)
    lines.append(
        f"\nBold: over the bar ({outside} of {total}). Certified: at least {100 * low:.2f} % of the env-steps of every run. "
        f"Energy: never above its start by more than {rise:.0e} of it."
    )
    lines += ["", "| case | what happens | what is known of it | known to fail |", "| --- | --- | --- | --- |"]
    shown = (CASES[name] for name in dict.fromkeys(row["case"] for row in rows))
    lines += [f"| {case.name} | {case.title} | {case.source} | {case.fails} |" for case in shown]
    return "\n".join(lines)
