# SPDX-License-Identifier: Apache-2.0
"""The paper's own comparison, redone: its box (Table 1) under every formulation, step size and method, and its lead matrices.

Errors are split: a *model* error, against the exact cone (`coulomb`) at the same step, and a *discretisation* error, that of
the exact cone against the continuous motion. The exact cone itself is held against an independent solver at the same step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from tqdm import tqdm

import warp_lcp as wl
from warp_lcp.laws import Law
from warp_lcp.methods import LCP_METHODS

from . import lead_matrix as lead
from .scenes import GRAVITY, scene

DURATION = 0.8  # s; the continuous motion rests at 0.661 s
STIFFNESS = 1e10  # N/m, k_n
MU, INERTIA, HALF, SPEED, SPIN = 1.0, 1.0 / 6.0, 0.5, 5.0, 2.0 * np.pi  # of the box, m = 1 kg
METHODS = ("auto", "lemke", "judice_pires", "murty", "velocity_pivoting", "proximal_newton", "pgs")
HEADINGS = np.linspace(0.0, np.pi / 2, 16, endpoint=False)
#: Rest pose (x, y [m], yaw [rad]) of an exact-cone stepper that is not ours (Siconos, normals relaxed as here) less the continuous
#: one, published to three digits: what `coulomb` is held against.
SICONOS = {1e-2: (-2.74e-3, -27.0e-3, -28.7e-3), 1e-3: (-0.28e-3, -2.72e-3, -2.84e-3)}


@dataclass(frozen=True)
class Case:
    """One formulation with its options, and the LCP that its authors write for it (None: it is not an LCP)."""

    name: str
    formulation: str
    sliding: str = "regularized"
    directions: int = 2
    problem: Callable[[lead.Rows], lead.Problem] | None = None

    def simulator(self, h: float, device: Any, envs: int = 1, method: str = "auto", rho_scale: float = 1.0) -> wl.Simulator:
        options = {"sliding": self.sliding, "directions": self.directions, "rho_scale": rho_scale}
        return wl.Simulator(scene("slide", 1).model(), envs, h, self.formulation, method, device=device, **options)

    def takes(self, method: str) -> bool:
        """Is the method made for this law?"""
        law = Law(self.formulation, self.sliding, self.directions)
        return law.has_axes if method == "velocity_pivoting" else not (law.is_cone and method in LCP_METHODS)


def _ap(k: int) -> Case:
    return Case(f"AP, k = {k}", "anitescu_potra", directions=k, problem=lead.anitescu_potra)


def _facets(k: int) -> Case:
    return Case(f"facets, k = {k}", "phantom_inertia", "facets", k, lead.phantom_inertia)


ALIGNED = Case("aligned", "phantom_inertia", "aligned", problem=lead.phantom_inertia)
REGULARIZED = Case("regularized", "phantom_inertia", problem=lead.phantom_inertia)
BOX = Case("box", "box", problem=lead.box)
CASES = (
    *(_ap(k) for k in (2, 4, 8)),
    BOX,
    Case("hybrid", "hybrid", problem=lead.box),
    *(_facets(k) for k in (2, 4, 8)),
    ALIGNED,
    REGULARIZED,
    Case("coulomb", "coulomb"),
)
#: With k = 3 and more directions where a contact sticks: only for the lead matrices.
PIVOTED = (
    *(_facets(k) for k in (2, 3, 4, 8)),
    ALIGNED,
    *(Case(f"regularized, k = {k}", "phantom_inertia", directions=k, problem=lead.phantom_inertia) for k in (2, 3, 4, 8)),
    *(_ap(k) for k in (2, 3, 4, 8)),
    BOX,
)
SCANNED = (_facets(2), ALIGNED, REGULARIZED, _facets(4), _facets(8))


# ------------------------------------------------------------------------------------------------------- continuous motion


def _normal_forces(arms: np.ndarray, friction: np.ndarray) -> np.ndarray:
    """Forces of four equally compliant corners that carry the weight and the moment of friction, without tension.

    friction: its direction at each corner times mu. The deflection is a plane, so the forces are a + b x + c y where positive.
    """
    plane = np.column_stack([np.ones(4), arms])
    # Rows: weight, moments about the centre of mass, which is HALF above the ground.
    balance = np.vstack([np.ones(4), (arms + HALF * friction).T])
    for count in (4, 3):
        for loaded in combinations(range(4), count):
            chosen = list(loaded)
            forces = plane @ np.linalg.solve(balance[:, chosen] @ plane[chosen], [GRAVITY, 0.0, 0.0])
            others = np.setdiff1d(np.arange(4), chosen)
            if (forces[chosen] >= 0.0).all() and (forces[others] <= 0.0).all():
                return np.maximum(forces, 0.0)
    raise ArithmeticError("no distribution of the weight on three or four corners: the box tips")


def reference(times: np.ndarray) -> np.ndarray:
    """Continuous motion of the box under exact isotropic friction: [T, 3] of x, y [m], yaw [rad].

    The box stays flat, so it is a planar problem; normal forces are those of equally compliant corners (the paper's relaxation,
    infinitely stiff), without which they would not be unique.
    """
    from scipy.integrate import solve_ivp

    corners = HALF * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        turn = np.array([[np.cos(state[2]), -np.sin(state[2])], [np.sin(state[2]), np.cos(state[2])]])
        arms = corners @ turn.T
        slip = state[3:5] + state[5] * np.column_stack([-arms[:, 1], arms[:, 0]])
        direction = -MU * slip / np.linalg.norm(slip, axis=1)[:, None]
        force = _normal_forces(arms, direction)[:, None] * direction
        torque = arms[:, 0] @ force[:, 1] - arms[:, 1] @ force[:, 0]
        return np.r_[state[3:], force.sum(axis=0), torque / INERTIA]

    def stopped(_: float, state: np.ndarray) -> float:
        return float(np.linalg.norm(state[3:]) - 1e-5)  # what is left to go from there is 1e-11 m

    stopped.terminal = True  # type: ignore[attr-defined]
    start = [0.0, 0.0, 0.0, 0.0, SPEED, SPIN]
    motion = solve_ivp(rate, (0.0, 10.0), start, "DOP853", dense_output=True, events=stopped, rtol=1e-10, atol=1e-10)
    if motion.status != 1:
        raise ArithmeticError(f"the box did not stop: {motion.message}")
    return motion.sol(np.minimum(times, motion.t[-1]))[:3].T


# ------------------------------------------------------------------------------------------------------------ formulations


def poses(q: np.ndarray) -> np.ndarray:
    """x, y [m] and heading of the body's x axis [rad] of poses [T, 7]; steps turn by less than pi."""
    x, y, z, w = q[:, 3:].T
    return np.column_stack([q[:, :2], np.unwrap(np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z)))])


def run(case: Case, h: float, device: Any, method: str = "auto", rho_scale: float = 1.0) -> dict[str, Any]:
    """The box from its start to DURATION: trajectory, and what happened on the way."""
    sim = case.simulator(h, device, method=method, rho_scale=rho_scale)
    q0 = sim.q.numpy()[0].copy()
    steps = sim.rollout(round(DURATION / h), record=("q", "v", "residual", "iterations"))
    q, v, residual, iterations = (getattr(steps, name).numpy()[:, 0] for name in ("q", "v", "residual", "iterations"))
    return {
        "poses": poses(np.vstack([q0, q])),
        "lift": max(0.0, float(q[:, 2].max() - q0[2])),
        "rest_speed": float(np.abs(v[-1]).max()),
        "certified": float(np.mean(residual <= lead.SOLVED)),
        "iterations_mean": float(iterations.mean()),
        "iterations_max": int(iterations.max()),
    }


def thinned(path: np.ndarray) -> list[list[float]]:
    """A trajectory short enough to keep, to the micrometre."""
    kept = np.unique(np.r_[np.arange(0, len(path), max(1, len(path) // 200)), len(path) - 1])
    return [[round(float(x), 6) for x in row] for row in path[kept]]


def measure_formulations(steps: Iterable[float], device: Any) -> list[dict[str, Any]]:
    """Errors of every formulation at every step size."""
    result = []
    for h in steps:
        truth = reference(h * np.arange(round(DURATION / h) + 1))
        runs = {case.name: run(case, h, device) for case in tqdm(CASES, desc=f"formulations, {h:g} s", disable=None)}
        exact = runs["coulomb"]["poses"][-1]
        for case in CASES:
            found = runs[case.name]
            path = found.pop("poses")
            error = np.abs(path - truth).max(axis=0)
            result.append(
                {
                    "case": case.name,
                    "h": h,
                    "rest": path[-1].tolist(),
                    "model_error": (path[-1] - exact).tolist(),
                    "discretisation_error": (exact - truth[-1]).tolist(),
                    "largest_distance": float(np.linalg.norm((path - truth)[:, :2], axis=1).max()),
                    "largest_turn": float(error[2]),
                    **found,
                    "solved": {m: run(case, h, device, m)["certified"] for m in METHODS if case.takes(m)},
                    "trajectory": thinned(path) if h >= 1e-3 else None,
                }
            )
    return result


def measure_headings(h: float, device: Any) -> list[dict[str, Any]]:
    """The same box launched in other directions over the same facets: where it rests, turned back, against the exact cone.

    It starts at its static deflection: laid on the ground exactly, round-off decides which of its turned corners are a
    hair's breadth open, and that alone moves the isotropic laws by 0.07 mm.
    """

    def rest(case: Case) -> np.ndarray:
        sim = case.simulator(h, device, envs=len(HEADINGS))
        q, v = sim.q0.numpy().copy(), sim.v0.numpy().copy()
        q[:, 5], q[:, 6] = np.sin(HEADINGS / 2), np.cos(HEADINGS / 2)
        q[:, 2] -= GRAVITY / (4 * STIFFNESS)
        v[:, 0], v[:, 1] = -SPEED * np.sin(HEADINGS), SPEED * np.cos(HEADINGS)
        sim.q0.assign(q)
        sim.v0.assign(v)
        sim.reset()
        path = sim.rollout(round(DURATION / h), record=("q",)).q.numpy()
        ends = np.array([poses(np.vstack([q[e], path[:, e]]))[-1] for e in range(len(HEADINGS))])
        c, s = np.cos(HEADINGS), np.sin(HEADINGS)
        return np.column_stack([c * ends[:, 0] + s * ends[:, 1], c * ends[:, 1] - s * ends[:, 0], ends[:, 2] - HEADINGS])

    exact = rest(CASES[-1])
    result = []
    for case in CASES:
        error = rest(case) - exact[0]
        distance, turn = np.linalg.norm(error[:, :2], axis=1), np.abs(error[:, 2])
        result.append({"case": case.name, "h": h, "distance": [distance.min(), distance.max()], "turn": [turn.min(), turn.max()]})
    return result


# ----------------------------------------------------------------------------------------------------------- lead matrices


def recorded(case: Case, h: float, device: Any, every: int = 1) -> list[lead.Rows]:
    """Contact rows of the steps of a run."""
    sim = case.simulator(h, device)
    found = []
    for i in range(round(DURATION / h)):
        sim.step()
        rows = lead.rows(sim) if i % every == 0 else None
        if rows is not None:
            found.append(rows)
    return found


def spread(values: Iterable[float]) -> list[float]:
    """Median and worst (largest)."""
    array = np.array(list(values), dtype=float)
    return [float(np.median(array)), float(array.max())]


def judged(rows: list[lead.Rows], problems: list[lead.Problem], answers: list[np.ndarray]) -> tuple[list[bool], list[float]]:
    """Which answers obey the law, and how far [m/s, rad/s] the velocity after the step is from the simulator's."""
    solved, moved = [], []
    for r, problem, z in zip(rows, problems, answers, strict=True):
        p = problem.P @ z + problem.p_0
        solved.append(bool(lead.residual(r, p) <= lead.SOLVED))
        moved.append(float(np.abs(r.response @ (p - r.applied)).max()))
    return solved, moved


def measure_matrices(device: Any, quick: bool) -> list[dict[str, Any]]:
    """Rank, condition, and what block pivoting and Lemke's method make of the LCP of every law, over the steps of its run."""
    result = []
    for case in tqdm(PIVOTED, desc="lead matrices", disable=None):
        for h in (1e-2, 1e-3):
            rows = recorded(case, h, device, every=1 if h == 1e-2 else 20 if quick else 4)
            problems = [case.problem(r) for r in rows]
            raw, even = [lead.rank(p.M) for p in problems], [lead.rank(lead.equilibrated(p.M)) for p in problems]
            blocks = [lead.block_pivoting(p) for p in problems]
            result.append(
                {
                    "case": case.name,
                    "h": h,
                    "steps": len(rows),
                    "unknowns": spread(len(p.q) for p in problems),
                    "deficiency": spread(len(p.q) - x for p, (x, _) in zip(problems, raw, strict=True)),
                    "deficiency_equilibrated": spread(len(p.q) - x for p, (x, _) in zip(problems, even, strict=True)),
                    "condition": spread(c for _, c in raw),
                    "condition_equilibrated": spread(c for _, c in even),
                    "block_pivoting": float(np.mean(judged(rows, problems, [z for z, _ in blocks])[0])),
                    "singular_blocks": float(np.mean([singular for _, singular in blocks])),
                    **{m: float(np.mean(judged(rows, problems, lead.solve(problems, m))[0])) for m in LCP_METHODS},
                }
            )
    return result


def measure_rho(device: Any, quick: bool) -> list[dict[str, Any]]:
    """The phantom inertia over sixteen decades: scaled with the problem, and in kilograms as the paper gives it."""
    result = []
    sizes = 10.0 ** np.arange(-12, 5, 4 if quick else 1)
    for case in tqdm(SCANNED, desc="phantom inertia", disable=None):
        for h in (1e-2, 1e-3):
            rows = recorded(case, h, device, every=1 if h == 1e-2 else 50 if quick else 10)
            rest = run(case, h, device)["poses"][-1]
            for unit in ("alpha", "kg"):
                for size in sizes:
                    alpha, kilograms = (float(size), 0.0) if unit == "alpha" else (None, float(size))
                    problems = [lead.phantom_inertia(r, alpha, kilograms) for r in rows]
                    even = [lead.rank(lead.equilibrated(p.M)) for p in problems]
                    solved, moved = judged(rows, problems, lead.solve(problems, "lemke"))
                    row = {"case": case.name, "h": h, "unit": unit, "rho": float(size), "steps": len(rows)}
                    row["full"] = _full(problems, [lead.rank(p.M) for p in problems])
                    row["full_default"] = _full(problems, [lead.rank(p.M, lead.default_tolerance(p.M)) for p in problems])
                    row["full_equilibrated"] = _full(problems, even)
                    row["condition"], row["condition_equilibrated"] = (
                        spread(lead.rank(p.M)[1] for p in problems),
                        spread(c for _, c in even),
                    )
                    row["lemke"] = float(np.mean(solved))
                    row["judice_pires"] = float(np.mean(judged(rows, problems, lead.solve(problems, "judice_pires"))[0]))
                    row["block_pivoting"] = float(np.mean(judged(rows, problems, [lead.block_pivoting(p)[0] for p in problems])[0]))
                    row["velocity_change"] = max((m for m, ok in zip(moved, solved, strict=True) if ok), default=None)
                    if unit == "alpha":
                        whole = run(case, h, device, "lemke", rho_scale=float(size))
                        row["run_certified"] = whole["certified"]
                        row["rest_change"] = float(np.abs(whole["poses"][-1] - rest).max())
                    result.append(row)
    return result


def _full(problems: list[lead.Problem], ranks: list[tuple[int, float]]) -> float:
    """Share of full rank."""
    return float(np.mean([rank == len(problem.q) for problem, (rank, _) in zip(problems, ranks, strict=True)]))


# ------------------------------------------------------------------------------------------------------------------ report


def measure(device: Any, quick: bool) -> dict[str, Any]:
    """Everything, ready for JSON."""
    steps = (1e-2, 1e-3) if quick else (1e-2, 1e-3, 1e-4)
    return {
        "continuous": reference(np.array([DURATION]))[0].tolist(),
        "reference": thinned(reference(1e-3 * np.arange(round(DURATION / 1e-3) + 1))),
        "formulations": measure_formulations(steps, device),
        "headings": measure_headings(1e-2 if quick else 1e-3, device),
        "matrices": measure_matrices(device, quick),
        "rho": measure_rho(device, quick),
    }


def _table(head: str, rows: Iterable[str]) -> list[str]:
    return [f"| {head} |", "|" + " --- |" * (head.count("|") + 1), *(f"| {row} |" for row in rows), ""]


def _share(x: float | None) -> str:
    """A share in percent; 100 only where it is all of them."""
    return "-" if x is None else "100" if x == 1.0 else f"{min(100 * x, 99.9):.1f}"


def _number(x: float) -> str:
    """A condition number; beyond round-off there is nothing to tell."""
    return f"{x:.0e}" if x < 1e16 else "> 1e16"


def _length(x: float) -> str:
    """Millimetres or milliradians."""
    return f"{1e3 * x:+.3f}" if abs(x) < 0.01 else f"{1e3 * x:+.1f}"


def markdown(data: dict[str, Any]) -> str:
    """All tables."""
    formulations = data["formulations"]
    steps = sorted({row["h"] for row in formulations}, reverse=True)
    lines = ["### The exact cone", ""]
    exact = [row for row in formulations if row["case"] == "coulomb"]
    head = "h | x, y [mm], yaw [mrad] against the continuous motion | an independent solver of the exact cone"
    head += " | largest distance [mm] on the way"
    rows = []
    for row in exact:
        other = SICONOS.get(row["h"])
        text = " / ".join(f"{1e3 * x:+.2f}" for x in row["discretisation_error"])
        known = "-" if other is None else " / ".join(f"{1e3 * x:+.2f}" for x in other)
        rows.append(f"{1e3 * row['h']:g} ms | {text} | {known} | {1e3 * row['largest_distance']:.2f}")
    lines += _table(head, rows)
    for h in steps:
        lines += [f"### Formulations at h = {1e3 * h:g} ms", ""]
        head = "formulation | model error: x | y [mm] | yaw [mrad] | largest error on the way [mm] | [mrad] | lift [mm] | speed at 0.8 s"
        head += " | certified [%] | iterations, mean / max"
        lines += _table(
            head,
            (
                f"{row['case']} | {' | '.join(_length(x) for x in row['model_error'])} | {1e3 * row['largest_distance']:.2f} | "
                f"{1e3 * row['largest_turn']:.2f} | {1e3 * row['lift']:.2g} | {row['rest_speed']:.0e} | {_share(row['certified'])} | "
                f"{row['iterations_mean']:.1f} / {row['iterations_max']}"
                for row in formulations
                if row["h"] == h
            ),
        )
    lines += ["### Steps solved by each method alone [%]", ""]
    lines += _table(
        "formulation | " + " | ".join(METHODS),
        (
            f"{case.name} | "
            + " | ".join(
                " / ".join(_share(row["solved"].get(method)) for row in formulations if row["case"] == case.name)
                if case.takes(method)
                else "-"
                for method in METHODS
            )
            for case in CASES
        ),
    )
    lines += [f"One number for each step size: {', '.join(f'{1e3 * h:g}' for h in steps)} ms; - : not made for this law.", ""]
    h = data["headings"][0]["h"]
    lines += [f"### Launched in {len(HEADINGS)} directions from 0 to 90° over the same facets, h = {1e3 * h:g} ms", ""]
    lines += _table(
        "formulation | model error, least to largest [mm] | yaw [mrad]",
        (
            f"{row['case']} | {1e3 * row['distance'][0]:.3g} to {1e3 * row['distance'][1]:.3g} | "
            f"{1e3 * row['turn'][0]:.3g} to {1e3 * row['turn'][1]:.3g}"
            for row in data["headings"]
        ),
    )
    lines += ["### Lead matrices over the steps of a run, median / worst", ""]
    head = "LCP | h [ms] | unknowns | rank missing | condition | equilibrated: rank missing | condition"
    lines += _table(
        head + " | Lemke solves [%] | block pivoting solves [%] | with a singular block [%] | Júdice-Pires [%] | Murty [%]",
        (
            f"{row['case']} | {1e3 * row['h']:g} | {row['unknowns'][0]:.0f} / {row['unknowns'][1]:.0f} | "
            f"{row['deficiency'][0]:.0f} / {row['deficiency'][1]:.0f} | {_number(row['condition'][0])} / {_number(row['condition'][1])} | "
            f"{row['deficiency_equilibrated'][0]:.0f} / {row['deficiency_equilibrated'][1]:.0f} | "
            f"{_number(row['condition_equilibrated'][0])} / {_number(row['condition_equilibrated'][1])} | "
            f"{_share(row['lemke'])} | {_share(row['block_pivoting'])} | {_share(row['singular_blocks'])} | "
            f"{_share(row['judice_pires'])} | {_share(row['murty'])}"
            for row in data["matrices"]
        ),
    )
    for unit, name in (("alpha", "scaled, rho_j = alpha (E^T A^-1 E)_jj"), ("kg", "the same for every direction, in kg")):
        lines += [f"### Phantom inertia {name}: 10 ms / 1 ms", ""]
        head = "LCP | rho | full rank [% of steps] | numpy's own tolerance | equilibrated | condition, median | equilibrated"
        head += " | Lemke solves [%]"
        head += " | block pivoting solves [%] | Júdice-Pires solves [%]"
        head += " | rest pose moves [um, urad]" if unit == "alpha" else " | velocity moves, at most [m/s]"
        lines += _table(head, _rho_rows([row for row in data["rho"] if row["unit"] == unit]))
    return "\n".join(lines)


def _rho_rows(rows: list[dict[str, Any]]) -> Iterable[str]:
    for case in dict.fromkeys(row["case"] for row in rows):
        sizes = list(dict.fromkeys(row["rho"] for row in rows))
        # Every decade of kilograms for the two laws that the paper itself runs, fewer elsewhere; all are in the JSON file.
        main = case in (SCANNED[0].name, REGULARIZED.name)
        stride = (1 if rows[0]["unit"] == "kg" else 2) if main else 4
        for rho in sizes[:: stride if len(sizes) > 5 else 1]:
            pair = [row for row in rows if (row["case"], row["rho"]) == (case, rho)]
            columns = [" / ".join(_share(row[key]) for row in pair) for key in ("full", "full_default", "full_equilibrated")]
            columns += [" / ".join(_number(row[key][0]) for row in pair) for key in ("condition", "condition_equilibrated")]
            solved = "run_certified" if pair[0]["unit"] == "alpha" else "lemke"
            columns += [" / ".join(_share(row[key]) for row in pair) for key in (solved, "block_pivoting", "judice_pires")]
            if pair[0]["unit"] == "alpha":
                columns += [" / ".join(f"{1e6 * row['rest_change']:.2g}" for row in pair)]
            else:
                columns += [" / ".join("-" if row["velocity_change"] is None else f"{row['velocity_change']:.0e}" for row in pair)]
            yield f"{case} | {rho:.0e} | " + " | ".join(columns)
