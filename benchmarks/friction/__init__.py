# SPDX-License-Identifier: Apache-2.0
"""solve_contact on recorded problems beside other solvers, facets against the cone, random stress, stages and their floors."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import warp as wp
from tqdm import tqdm

from . import facets, floor, ours, picture, recorded, rival, stress, summary

__all__ = ["PROBLEMS", "measure", "picture", "run"]

PROBLEMS = Path("../shared/problems/friction")
LARGEST = 8  # problems whose stages are measured


def measure(
    problems: list[recorded.Problem], device: wp.Device, pythons: dict[str, Path], quick: bool
) -> tuple[list[dict[str, Any]], list[str]]:
    """A row for each problem, and a line for each rival that is not in it."""
    missing = {name: rival.RIVALS[name].absent(python) for name, python in pythons.items()}
    present, rows = [name for name in pythons if not missing[name]], []
    for problem in tqdm(problems, desc="recorded", disable=None):
        row: dict[str, Any] = {"problem": problem.name, "contacts": problem.contacts, "rank": problem.rank}
        row["ours"] = {method: ours.measure(problem, method, device, quick) for method in ours.METHODS}
        row["rivals"] = {name: summary.relevant(rival.RIVALS[name].measure(problem, pythons[name], quick)) for name in present}
        rows.append(row)
    return rows, [line for line in missing.values() if line]


def run(folder: Path, device: wp.Device, pythons: dict[str, Path], quick: bool) -> tuple[dict[str, Any], str]:
    """Everything but the picture, beside the rivals with these interpreters; returns data and text."""
    data: dict[str, Any] = {}
    text = []
    problems = recorded.find(folder)
    if problems:
        rows, missing = measure(problems, device, pythons, quick)
        near = facets.measure(problems, device)
        rate, stages = floor.rates(), [floor.measure(problem, device) for problem in problems[-LARGEST:]]
        data |= {"recorded": rows, "counts": [summary.counts(rows, t) for t in summary.TOLERANCES], "facets": near}
        data |= {"stages": stages, "rates": rate}
        text += [summary.markdown(rows), facets.markdown(near), floor.markdown(stages, rate)]
        for line in missing:
            print(line, file=sys.stderr)
    else:
        print(f"{folder} holds no recorded problems (*.npz): only the random ones are solved", file=sys.stderr)
    rows = stress.measure(device, stress.QUICK_COUNT if quick else stress.COUNT)
    data["stress"] = stress.summarise(rows)
    return data, "\n\n".join([*text, stress.markdown(data["stress"])])
