# SPDX-License-Identifier: Apache-2.0
"""Other solvers on a recorded problem, each in the interpreter that has it."""

from __future__ import annotations

import json
import math
import os
import statistics
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .recorded import Problem, natural_map


@dataclass(frozen=True)
class Rival:
    """Solvers of one library.

    Attributes:
        name: in tables.
        worker: the script that its interpreter runs.
        needs: modules of its interpreter.
        advice: how to get them.
        solvers: limits of iterations and storages of W, by the solver's name.
        tolerances: where it may stop, the loosest first. A library stops where its own measure is under the tolerance, which may
            leave ours over it, so it may choose among these; the loosest is what a natural map of 1e-6 takes. We always solve to 1e-10.
        symmetric: it takes W to be symmetric; it is given the symmetric part, and judged by it.
    """

    name: str
    worker: Path
    needs: tuple[str, ...]
    advice: str
    solvers: dict[str, tuple[int, tuple[str, ...]]]
    tolerances: tuple[float, ...]
    symmetric: bool

    def absent(self, python: Path) -> str:
        """Why it cannot be run by this interpreter, in one line; '' where it can."""
        advice = f"{self.name} is skipped ({self.advice})"
        if not python.exists():
            return f"{python} does not exist: {advice}"
        code = f"import importlib.util as u; print([n for n in {self.needs} if u.find_spec(n) is None])"
        missing = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
        return "" if missing == "[]" else f"{python} lacks {missing}: {advice}"

    def measure(self, problem: Problem, python: Path, quick: bool) -> list[dict[str, Any]]:
        """Every solver with every storage and tolerance: seconds in its call alone (median and best), natural map computed here."""
        job = {
            "path": str(problem.path.resolve()),
            "cases": [(name, limit, kind) for name, (limit, storages) in self.solvers.items() for kind in storages[: 2 if quick else None]],
            "tolerances": self.tolerances[1:2] if quick else self.tolerances,
            "limit_s": 1.0 if quick else 3.0,
            "budget_s": 0.1 if quick else 0.5,
            "repetitions": 4 if quick else 16,
        }
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        command = [python, self.worker]
        done = subprocess.run(command, input=json.dumps(job), stdout=subprocess.PIPE, text=True, check=True, env=environment)
        return [self.judge(problem, json.loads(line)) for line in done.stdout.splitlines()]

    def judge(self, problem: Problem, answer: dict[str, Any]) -> dict[str, Any]:
        """What counts of one line of the worker; no natural map where impulses are not finite."""
        row = {key: answer[key] for key in ("solver", "storage", "tolerance", "outcome")}
        if answer["outcome"] != "done":
            return row
        row |= {
            "best_s": min(answer["seconds"]),
            "median_s": statistics.median(answer["seconds"]),
            "prepare_s": statistics.median(answer["prepare_s"]),
            "repetitions": len(answer["seconds"]),
            "iterations": answer["iterations"],
        }
        impulse, recorded = np.array(answer["impulse"]), problem.W
        errors = {"natural_map": natural_map(recorded, problem.q, problem.mu, impulse)}
        if self.symmetric:
            errors["natural_map_recorded"] = errors["natural_map"]
            errors["natural_map"] = natural_map(0.5 * (recorded + recorded.T), problem.q, problem.mu, impulse)
        return row | {key: error for key, error in errors.items() if math.isfinite(error)}


STORAGES = ("dense", "sbm", "csc")
#: Debian's own Python has it; it is not on PyPI.
SICONOS = Rival(
    name="Siconos",
    worker=Path(__file__).with_name("siconos_worker.py"),
    needs=("siconos", "scipy"),
    advice="Debian: apt install --no-install-recommends python3-siconos python3-scipy",
    solvers={
        "NSGS": (10_000, STORAGES),
        "NSN_AC": (500, STORAGES),
        "PROX": (200, STORAGES),
        "ADMM": (20_000, STORAGES),
        "VI_EG": (20_000, STORAGES),
    },
    tolerances=(1e-7, 1e-10, 1e-12),
    symmetric=False,
)
PINOCCHIO = Rival(
    name="Pinocchio",
    worker=Path(__file__).with_name("pinocchio_worker.py"),
    needs=("pinocchio", "scipy"),
    advice="python -m benchmarks peers install pin",
    solvers={
        "ADMM": (20_000, ("sparse", "dense")),  # its default rule for rho, OSQP's
        "ADMM spectral": (20_000, ("sparse", "dense")),
        "PGS": (10_000, ("dense",)),
    },
    tolerances=(1e-7, 1e-11, 1e-12),  # 1e-10 of its own measure is two or three of ours
    symmetric=True,
)
RIVALS = {rival.name: rival for rival in (SICONOS, PINOCCHIO)}
