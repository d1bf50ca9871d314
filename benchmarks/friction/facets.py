# SPDX-License-Identifier: Apache-2.0
"""How fast laws with 2k facets approach the cone: velocities and dissipated work of the recorded problems."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from tqdm import tqdm

import warp_lcp as wl

from .recorded import Problem

FORMULATIONS = ("phantom_inertia", "anitescu_potra")
DIRECTIONS = (2, 4, 8, 16, 32)
ROUND_OFF = 1e-9  # a problem is left out where any of its errors is less
MEASURES = ("velocity", "work")


def errors(problem: Problem, formulation: str, device: wp.Device) -> dict[str, Any]:
    """|u_k - u| / |q| and |D_k - D| / (|p| |q|), D = -sum p_t . u_t the dissipated work, for every k."""
    cone = wl.solve_contact(problem.W, problem.q, problem.mu, device=device)

    def answer(s: wl.ContactSolution) -> tuple[np.ndarray, np.ndarray]:
        return s.impulse.numpy()[0].reshape(-1, 3), s.velocity.numpy()[0].reshape(-1, 3)

    p, u = answer(cone)
    size = np.linalg.norm(problem.q)
    row: dict[str, Any] = {"problem": problem.name, "formulation": formulation, "full_rank": problem.rank == 3 * problem.contacts}
    row |= {"velocity": [], "work": [], "unsolved": int(cone.status.numpy()[0] != 0)}
    for k in DIRECTIONS:
        s = wl.solve_contact(problem.W, problem.q, problem.mu, formulation, directions=k, device=device)
        p_k, u_k = answer(s)
        row["velocity"].append(float(np.linalg.norm(u_k - u) / size))
        work = abs(np.vdot(p_k[:, 1:], u_k[:, 1:]) - np.vdot(p[:, 1:], u[:, 1:]))
        row["work"].append(float(work / max(np.linalg.norm(p) * size, 1e-300)))
        row["unsolved"] += int(s.status.numpy()[0] != 0)
    return row


def measure(problems: Sequence[Problem], device: wp.Device) -> list[dict[str, Any]]:
    """Every formulation and problem."""
    cases = [(p, f) for f in FORMULATIONS for p in problems]
    return [errors(p, f, device) for p, f in tqdm(cases, desc="facets", disable=None)]


def means(rows: Sequence[dict[str, Any]], formulation: str, full_rank: bool, measure: str) -> tuple[int, np.ndarray]:
    """Number of problems above round-off with every k, and the geometric mean of their errors for each k."""
    found = [r[measure] for r in rows if r["formulation"] == formulation and r["full_rank"] == full_rank]
    kept = np.array([e for e in found if min(e) > ROUND_OFF])
    return len(kept), np.exp(np.log(kept).mean(axis=0)) if len(kept) else np.full(len(DIRECTIONS), np.nan)


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Geometric means, and the factor by which each doubling of k divides them."""
    lines = ["| error of | formulation | rank | problems | " + " | ".join(f"k = {k}" for k in DIRECTIONS) + " | factor each doubling |"]
    lines.append("|" + " --- |" * (lines[0].count("|") - 1))
    for measure in MEASURES:
        for formulation in FORMULATIONS:
            for full in (True, False):
                number, mean = means(rows, formulation, full, measure)
                cells = [measure, formulation, "full" if full else "deficient", str(number), *(f"{x:.1e}" for x in mean)]
                cells.append(", ".join(f"{x:.2f}" for x in mean[:-1] / mean[1:]))
                lines.append("| " + " | ".join(cells) + " |")
    unsolved = sum(r["unsolved"] for r in rows)
    lines += ["", f"Answers that are not certified: {unsolved} of {len(rows) * (1 + len(DIRECTIONS))}."]
    return "\n".join(lines)
