# SPDX-License-Identifier: Apache-2.0
"""Siconos on a recorded problem, in the interpreter that has it (Debian's own; it is not on PyPI)."""

from __future__ import annotations

import json
import math
import os
import statistics
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from .recorded import Problem, natural_map

#: Solvers by the name in Siconos, and their limits of iterations.
SOLVERS = {"NSGS": 10_000, "NSN_AC": 500, "PROX": 200, "ADMM": 20_000, "VI_EG": 20_000}
STORAGES = ("dense", "sbm", "csc")
#: Siconos stops where its own measure is under the tolerance, which may leave ours over it: it may choose among these, the
#: loosest being what a natural map of 1e-6 takes. We always solve to 1e-10.
TOLERANCES = (1e-7, 1e-10, 1e-12)
WORKER = Path(__file__).with_name("siconos_worker.py")


def absent(python: Path) -> str:
    """Why Siconos cannot be run by this interpreter, in one line; '' where it can."""
    advice = "Siconos is skipped (Debian: apt install --no-install-recommends python3-siconos python3-scipy)"
    if not python.exists():
        return f"{python} does not exist: {advice}"
    code = "import importlib.util as u; print([n for n in ('siconos', 'scipy') if u.find_spec(n) is None])"
    missing = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    return "" if missing == "[]" else f"{python} lacks {missing}: {advice}"


def measure(problem: Problem, python: Path, quick: bool) -> list[dict[str, Any]]:
    """Every solver with every storage of W and tolerance: seconds in the driver alone (median and best), natural map computed here."""
    job = {
        "path": str(problem.path.resolve()),
        "solvers": SOLVERS,
        "storages": STORAGES[:2] if quick else STORAGES,
        "tolerances": TOLERANCES[1:2] if quick else TOLERANCES,
        "limit_s": 1.0 if quick else 3.0,
        "budget_s": 0.1 if quick else 0.5,
        "repetitions": 4 if quick else 16,
    }
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([python, WORKER], input=json.dumps(job), stdout=subprocess.PIPE, text=True, check=True, env=environment)
    rows = []
    for line in done.stdout.splitlines():
        answer = json.loads(line)
        row = {key: answer[key] for key in ("solver", "storage", "tolerance", "outcome")}
        if answer["outcome"] == "done":
            error = natural_map(problem.W, problem.q, problem.mu, np.array(answer["impulse"]))
            row |= {
                "best_s": min(answer["seconds"]),
                "median_s": statistics.median(answer["seconds"]),
                "prepare_s": statistics.median(answer["prepare_s"]),
                "repetitions": len(answer["seconds"]),
                "iterations": answer["iterations"],
            }
            if math.isfinite(error):
                row["natural_map"] = error
        rows.append(row)
    return rows
