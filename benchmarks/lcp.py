# SPDX-License-Identifier: Apache-2.0
"""Methods of solve_lcp on recorded problems: how many are solved, how well, how fast, and whether any OK is wrong.

The folder holds .npz files with M [B, n, n], q [B, n], and the best residual known of each problem, res [B]. Whatever a
method says is judged here again with numpy, in extended precision where the machine has it.
"""

from __future__ import annotations

import math
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from tqdm import tqdm

import warp_lcp as wl
from warp_lcp.solve import METHODS

TOLERANCE = {"float64": 1e-8, "float32": 1e-3}
#: Seconds after which a case is not repeated again.
SECONDS = 1.0


def problems(folder: Path) -> list[Path]:
    """The files of a folder.

    Raises:
        FileNotFoundError: there are none.
    """
    found = sorted(folder.glob("*.npz"))
    if not found:
        raise FileNotFoundError(f"{folder}: no .npz files with M and q there; give their folder with --problems")
    return found


def residual(M: np.ndarray, q: np.ndarray, z: np.ndarray) -> np.ndarray:
    """max |min(z, M z + q)| of each problem [B]."""
    M, q, z = (x.astype(np.longdouble) for x in (M, q, z))
    return np.abs(np.minimum(z, np.einsum("bij,bj->bi", M, z) + q)).max(axis=1)


def one(device: wp.Device, path: Path, method: str, precision: str, repetitions: int) -> dict[str, Any]:
    """Measure one method on one file."""
    with np.load(path) as data:
        M, q, known = data["M"].astype(precision), data["q"].astype(precision), data["res"]
    tolerance, seconds = TOLERANCE[precision], []
    on_device = [wp.array(x, device=device) for x in (M, q)]
    finish = time.perf_counter() + SECONDS
    wl.solve_lcp(M[:1], q[:1], method, tolerance=tolerance, device=device)  # compiles
    while len(seconds) < repetitions and (not seconds or time.perf_counter() < finish):
        wp.synchronize_device(device)
        begin = time.perf_counter()
        solution = wl.solve_lcp(*on_device, method, tolerance=tolerance)
        wp.synchronize_device(device)
        seconds.append(time.perf_counter() - begin)
    found, ok, iterations = residual(M, q, solution.z.numpy()), solution.status.numpy() == 0, solution.iterations.numpy()
    return {
        "problem": path.stem,
        "unknowns": q.shape[1],
        "method": method,
        "precision": precision,
        "tolerance": tolerance,
        "problems": len(q),
        "known_to_be_solvable": int(np.count_nonzero(known <= TOLERANCE["float64"])),
        "solved": int(np.count_nonzero(ok)),
        "right": (ok & (found <= tolerance)).tolist(),
        "worst_residual_of_solved": float(found[ok].max(initial=0.0)),
        "wrong_ok": int(np.count_nonzero(ok & ~(found <= tolerance))),
        "missed_ok": int(np.count_nonzero(~ok & (found <= tolerance))),
        "iterations_median": float(np.median(iterations)),
        "iterations_max": int(iterations.max()),
        "seconds_per_problem": statistics.median(seconds) / len(q),
        "repetitions": len(seconds),
    }


def measure(device: wp.Device, folder: Path, quick: bool) -> list[dict[str, Any]]:
    """Every file, method and precision."""
    cases = [(path, m, p) for p in TOLERANCE for path in problems(folder) for m in METHODS]
    return [one(device, *case, 1 if quick else 7) for case in tqdm(cases, desc="lcp", disable=None)]


def times(rows: list[dict[str, Any]], precision: str) -> dict[str, list[float]]:
    """Seconds of every method on every problem: its batch's over their number; infinity where it did not solve it."""
    table: dict[str, list[float]] = {}
    for row in rows:
        if row["precision"] == precision:
            seconds = row["seconds_per_problem"]
            table.setdefault(row["method"], []).extend(seconds if right else math.inf for right in row["right"])
    return table


def markdown(rows: list[dict[str, Any]]) -> str:
    """One table a precision: file x method, then the totals."""
    lines = []
    for precision in TOLERANCE:
        lines += [f"{precision}, solved to {TOLERANCE[precision]:g}", ""]
        lines += ["| problem | n | method | solved | worst residual of these | iterations, median / max | us a problem | wrong OK |"]
        lines += ["|" + " --- |" * 8]
        chosen = [r for r in rows if r["precision"] == precision]
        for r in sorted(chosen, key=lambda r: (r["problem"], list(METHODS).index(r["method"]))):
            solved, worst = f"{r['solved']} / {r['problems']}", f"{r['worst_residual_of_solved']:.1e}"
            iterations, micros = f"{r['iterations_median']:g} / {r['iterations_max']}", f"{1e6 * r['seconds_per_problem']:,.0f}"
            cells = (r["problem"], r["unknowns"], r["method"], solved, worst, iterations, micros, r["wrong_ok"])
            lines.append("| " + " | ".join(map(str, cells)) + " |")
        for method in METHODS:
            mine = [r for r in chosen if r["method"] == method]
            solved, total, wrong = (sum(r[key] for r in mine) for key in ("solved", "problems", "wrong_ok"))
            worst = max(r["worst_residual_of_solved"] for r in mine)
            lines.append(f"| **all** | | **{method}** | **{solved} / {total}** | {worst:.1e} | | | **{wrong}** |")
        lines.append("")
    return "\n".join(lines).rstrip()
