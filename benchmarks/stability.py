# SPDX-License-Identifier: Apache-2.0
"""Where every law, method and precision breaks: all cases over step sizes, a verdict each with its reason.

Survived: nothing but numbers, at least 99.9 % of the env-steps certified, the energy never above its start (by more than 1e-6 of
its scale) nor, without restitution, above its lowest so far (1e-3), every metric of the case within its bars. The bars are
stated with the cases; none depends on the method.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from tqdm import tqdm

import warp_lcp as wl

from . import robust
from .cases import CASES, Case
from .cases.case import ENERGY_RISE, REBOUND
from .motion import Motion, TooSlow

STEPS = (1e-3, 5e-3, 1e-2, 2e-2, 5e-2)
QUICK_STEPS = (5e-3,)
CERTIFIED = 0.999
#: Errors up to so many times the bar are a drift, beyond it the result is wrong.
DRIFT = 10.0
#: The energy, or a number, that nothing comes back from.
BLOWN = 0.1
LIMIT_S, QUICK_LIMIT_S = 5.0, 1.0  # of one run
CROWD, QUICK_CROWD = 4096, 64  # randomised copies
VERDICTS = {
    "survived": "S",
    "drifted": "D",
    "wrong": "W",
    "blew up": "B",
    "refused": "R",
    "too slow": "T",
}


@dataclass(frozen=True)
class Variant:
    """One way of solving.

    Attributes:
        name: for tables. options: of the Simulator. material: of every contact.
        cause: why it fails where it does, as known.
    """

    name: str
    options: dict[str, Any] = field(default_factory=dict)
    material: dict[str, float] = field(default_factory=dict)
    cause: str = ""


def _facets(k: int) -> Variant:
    cause = "fixed facets around the cone: friction up to 1 / cos(pi / 2k) too large, not along the slip"
    return Variant(f"facets, k = {k}", {"sliding": "facets", "directions": k}, cause=cause)


def _ap(k: int) -> Variant:
    cause = "fixed facets within the cone: friction down to cos(pi / 2k), not along the slip"
    return Variant(f"AP, k = {k}", {"formulation": "anitescu_potra", "directions": k}, cause=cause)


def _stiff(k: float) -> Variant:
    cause = "soft contacts give under load" if k < 1e9 else "stiff contacts: round-off of k times a gap"
    return Variant(f"k_n = {k:.0e} N/m", material={"normal_stiffness": k, "normal_damping": k / 100}, cause=cause)


def _rho(scale: float) -> Variant:
    cause = "a phantom inertia far from the contact's own spoils the condition of the LCP"
    return Variant(f"lemke, rho x {scale:.0e}", {"method": "lemke", "rho_scale": scale}, cause=cause)


SINGLE = "float32: velocities are certified near their resolution, and Table 1's stiffness is beyond it"
VARIANTS = (
    Variant("default", cause="what a step of that length does not resolve"),
    Variant("coulomb", {"formulation": "coulomb"}, cause="what a step of that length does not resolve"),
    Variant("midpoint", {"integrator": "midpoint"}, cause="positions of second order after an impact depend on when in the step it was"),
    Variant("aligned", {"sliding": "aligned"}, cause="friction keeps the direction that the slip had before the step"),
    *(
        Variant(f"regularized, k = {k}", {"directions": k}, cause="polygons while sticking; their LCPs are nearly singular")
        for k in (4, 8, 16)
    ),
    *(_facets(k) for k in (2, 4, 8, 16)),
    *(_ap(k) for k in (2, 4, 8)),
    Variant("box", {"formulation": "box"}, cause="a square of the last step's normal force: late by a step, and sqrt(2) too large"),
    Variant("hybrid", {"formulation": "hybrid"}, cause="limits from the last step's normal force: late by a step"),
    Variant("velocity_pivoting", {"method": "velocity_pivoting"}, cause="flips of states may go round in circles"),
    Variant("proximal_newton", {"method": "proximal_newton"}, cause="stops at its limit of iterations"),
    Variant("lemke", {"method": "lemke"}, cause="degenerate pivots where contacts are redundant; slow with many contacts"),
    Variant("murty", {"method": "murty"}, cause="one exchange at a time: its limit of pivots"),
    Variant("judice_pires", {"method": "judice_pires"}, cause="singular blocks, exchanges that cycle"),
    Variant("pgs", {"method": "pgs"}, cause="50 sweeps carry no load through stacks and mass ratios"),
    Variant("float32", {"precision": "float32"}, cause=SINGLE),
    Variant("lemke, float32", {"method": "lemke", "precision": "float32"}, cause=SINGLE),
    Variant("pgs, float32", {"method": "pgs", "precision": "float32"}, cause=SINGLE),
    *(_rho(scale) for scale in (1e-12, 1e-6, 1e4)),
    *(_stiff(k) for k in (1e4, 1e6, 1e8, 1e12)),
)


QUICK_VARIANTS = ("default", "coulomb", "AP, k = 4", "box", "lemke", "pgs", "float32")


def judge(case: Case, moved: Motion, h: float, exact: Motion | None) -> tuple[str, str, list[float]]:
    """Verdict, reason and the errors of the metrics.

    Raises:
        ValueError: if a bar is for the error against the exact cone, and its motion is not given.
    """
    judged: list[tuple[str, float, float]] = []  # what, error, bar
    for metric in case.metrics:
        seen = metric.seen(moved)
        judged.append((metric.name, metric.distance(seen, metric.expected(moved.scene.envs)), metric.bar(h)))
        if metric.law_bar:
            if exact is None:
                raise ValueError(f"{case.name}: a bar of {metric.name!r} is against the exact cone, whose motion is missing")
            judged.append((f"{metric.name} (law)", metric.distance(seen, metric.seen(exact)), metric.law_bar(h)))
    errors = [error for _, error, _ in judged]
    rise, certified = case.energy_rise(moved), moved.certified
    reasons = [f"{what} off by {error:.1e}, bar {bar:.0e}" for what, error, bar in judged if not error <= bar]
    over = float(np.max([error / max(bar, 1e-12) for _, error, bar in judged]))
    if not certified >= CERTIFIED:
        reasons.append(f"{100 * certified:.3g} % certified")
    if not rise <= ENERGY_RISE:
        reasons.append(f"energy up by {rise:.1e} of its scale")
    # An impact with e > 0 gives back at the end of a step what it had at its beginning: more by m g h v where it still falls.
    if moved.scene.restitution == 0.0 and not case.rebound(moved) <= REBOUND:
        reasons.append(f"energy comes back: {case.rebound(moved):.1e} of its scale")
    if not moved.finite or not rise < BLOWN:
        return "blew up", "; ".join(reasons) if moved.finite else "not a number", errors
    if not reasons:
        return "survived", "", errors
    return ("drifted" if over <= DRIFT else "wrong"), "; ".join(reasons), errors


def one(case: Case, variant: Variant, h: float, device: Any, exact: Motion | None, limit: float = LIMIT_S) -> dict[str, Any]:
    """One run."""
    row: dict[str, Any] = {"case": case.name, "variant": variant.name, "h": h}
    try:
        moved = case.simulate(h, device=device, material=variant.material, limit=limit, **variant.options)
    except wl.WarpLcpError as why:
        return row | {"verdict": "refused", "reason": str(why)}
    except TooSlow as why:
        return row | {"verdict": "too slow", "reason": str(why)}
    verdict, reason, errors = judge(case, moved, h, exact)
    residual = np.where(np.isnan(moved.residual), np.inf, moved.residual)
    return row | {
        "verdict": verdict,
        "reason": reason,
        "errors": errors,
        "certified": moved.certified,
        "energy_rise": case.energy_rise(moved),
        "residual_p99": float(np.quantile(residual, 0.99, method="higher")),
        "residual_worst": float(residual.max()),
        "iterations": float(moved.iterations.mean()),
    }


def measure(device: Any, names: list[str], variants: list[Variant], quick: bool) -> Iterator[list[dict[str, Any]]]:
    """Every case under every variant at every step; yields all rows that there are whenever a case is done."""
    steps = QUICK_STEPS if quick else STEPS
    rows: list[dict[str, Any]] = []
    progress = tqdm(total=len(names) * len(variants) * len(steps), desc="stability", disable=None)
    for name in names:
        case = CASES[name]
        for h in steps:
            exact: dict[str, Motion] = {}
            for variant in variants:
                integrator = variant.options.get("integrator", "euler")
                if any(metric.law_bar for metric in case.metrics) and integrator not in exact:
                    exact[integrator] = case.simulate(h, device=device, formulation="coulomb", integrator=integrator)
                rows.append(one(case, variant, h, device, exact.get(integrator), QUICK_LIMIT_S if quick else LIMIT_S))
                progress.update()
        yield rows
    progress.close()


def crowd(device: Any, names: list[str], envs: int, h: float = 5e-3) -> Iterator[list[dict[str, Any]]]:
    """Many randomised copies of every case with the default: counts over all of them, the worst environment, never a mean.

    Yields likewise.
    """
    rows: list[dict[str, Any]] = []
    for name in names:
        scene = CASES[name].scene(h, envs)
        sim = scene.simulator(device=device)
        seconds = scene.steps * h
        rows.append(
            robust.count(name, sim, scene.steps, lambda s, scene=scene: robust.randomise(s, wrench=scene.wrench)) | {"seconds": seconds}
        )
        yield rows


# ------------------------------------------------------------------------------------------------------------------- reports


def complete(rows: list[dict[str, Any]], crowds: list[dict[str, Any]]) -> bool:
    """Is every case there under every variant and step, and in thousands of copies?"""
    seen = {(row["case"], row["variant"], row["h"]) for row in rows}
    copies = {row["scene"] for row in crowds if row["envs"] >= CROWD}
    return copies >= set(CASES) and seen >= {(case, variant.name, h) for case in CASES for variant in VARIANTS for h in STEPS}


def letters(rows: list[dict[str, Any]]) -> dict[tuple[str, str], str]:
    """A letter for every step size, the smallest first, by case and variant."""
    found: dict[tuple[str, str], str] = {}
    for row in sorted(rows, key=lambda row: row["h"]):
        key = (row["case"], row["variant"])
        found[key] = found.get(key, "") + VERDICTS[row["verdict"]]
    return found


def markdown(rows: list[dict[str, Any]], crowds: list[dict[str, Any]]) -> str:
    """How often each variant survives; every case of the default; what fails at 5 ms and why; the randomised copies."""
    steps = sorted({row["h"] for row in rows})
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    cases = list(dict.fromkeys(row["case"] for row in rows))
    table = letters(rows)
    legend = ", ".join(f"{letter} {verdict}" for verdict, letter in VERDICTS.items())
    lines = [f"Letters are step sizes {', '.join(f'{1e3 * h:g}' for h in steps)} ms: {legend}.", ""]
    heads = ["variant", *(f"survived at {1e3 * h:g} ms" for h in steps), "not a number"]
    lines += ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    for variant in variants:
        mine = [row for row in rows if row["variant"] == variant]
        counts = []
        for h in steps:
            ran = [row for row in mine if row["h"] == h and row["verdict"] != "refused"]
            counts.append(f"{sum(row['verdict'] == 'survived' for row in ran)} of {len(ran)}" if ran else "refused")
        lost = sum(row["reason"] == "not a number" for row in mine)
        lines.append(f"| {variant} | " + " | ".join(counts) + f" | {lost} |")
    lines += ["", "| case | " + " | ".join(variants) + " |", "|" + " --- |" * (len(variants) + 1)]
    lines += ["| " + " | ".join([case, *(f"`{table[case, variant]}`" for variant in variants)]) + " |" for case in cases]
    lines += ["", "### What fails, at the smallest step at which it does", ""]
    causes = {variant.name: variant.cause for variant in VARIANTS}
    for variant in variants:
        failed: dict[str, dict[str, Any]] = {}
        for row in sorted(rows, key=lambda row: row["h"]):
            if row["variant"] == variant and row["verdict"] not in ("survived", "refused"):
                failed.setdefault(row["case"], row)
        refused = {row["reason"] for row in rows if row["variant"] == variant and row["verdict"] == "refused"}
        if failed or refused:
            lines.append(f"- **{variant}** ({causes.get(variant, '')})")
            lines += [f"  - refused: {reason}" for reason in sorted(refused)]
            lines += [f"  - {name}, {1e3 * row['h']:g} ms: {row['verdict']}: {row['reason']}" for name, row in failed.items()]
    if crowds:
        lines += ["", "### Randomised copies, default, 5 ms", "", robust.markdown(crowds)]
    return "\n".join(lines)


def chosen(text: str) -> list[Variant]:
    """'all', 'some' (QUICK_VARIANTS) or names of variants with semicolons between them (some names have commas)."""
    known = {variant.name: variant for variant in VARIANTS}
    names = list(known) if text == "all" else list(QUICK_VARIANTS) if text == "some" else [name.strip() for name in text.split(";")]
    for name in names:
        if name not in known:
            raise argparse.ArgumentTypeError(f"no variant {name!r}; choose from {'; '.join(known)}, or all, or some")
    return [known[name] for name in names]
