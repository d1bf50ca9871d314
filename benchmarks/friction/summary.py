# SPDX-License-Identifier: Apache-2.0
"""What the timings of recorded problems say: the best of each rival, counts, performance profiles, tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

TOLERANCES = (1e-6, 1e-10)
#: How our times are taken: a key of the row, and its name in tables and pictures.
TIMINGS = {
    "call_median_s": "one call",
    "kernel_median_s": "prepared, one launch",
    "batch_call_median_s": "one call for a batch",
    "batch_kernel_median_s": "prepared, batch",
}
ANY = "all rivals"


def seconds(entry: dict[str, Any], key: str, tolerance: float) -> float:
    """Time of an entry that solved its problem, else infinity (a nan has not solved anything)."""
    return entry[key] if entry.get("natural_map", math.inf) <= tolerance else math.inf


def best(entries: Sequence[dict[str, Any]], tolerance: float, solver: str | None = None) -> dict[str, Any] | None:
    """Fastest entry of a rival that solved the problem, of one solver or of all, whatever the storage; None where none did."""
    fit = [e for e in entries if (solver is None or e["solver"] == solver) and math.isfinite(seconds(e, "median_s", tolerance))]
    return min(fit, key=lambda e: e["median_s"], default=None)


def entries_of(row: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Entries of one rival, or of all where its name is ANY."""
    return [e for rival, entries in row["rivals"].items() if name in (rival, ANY) for e in entries]


def rivals(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Those that have entries, in the order in which they appear."""
    return list(dict.fromkeys(name for row in rows for name, entries in row["rivals"].items() if entries))


def solvers(rows: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Rivals with their solvers."""
    return list(dict.fromkeys((name, e["solver"]) for name in rivals(rows) for row in rows for e in entries_of(row, name)))


def relevant(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of every solver the fastest entries at the tolerances, or the closest where it solved nothing, or how it ended."""
    kept = []
    for solver in dict.fromkeys(e["solver"] for e in entries):
        own = [e for e in entries if e["solver"] == solver]
        closest = min(own, key=lambda e: e.get("natural_map", math.inf))
        found = [best(own, tolerance) or closest for tolerance in TOLERANCES]
        kept += found[:1] if found[0] is found[1] else found
    return kept


def counts(rows: Sequence[dict[str, Any]], tolerance: float) -> dict[str, Any]:
    """How many problems each solver solved, and on how many `auto` did and took less time than a rival's fastest (which may be none).

    "recorded": how many of those that take W to be symmetric solved as they were recorded.
    """
    result: dict[str, Any] = {"tolerance": tolerance, "problems": len(rows), "solved": {}, "recorded": {}, "faster": {}}
    for method in rows[0]["ours"]:
        result["solved"][method] = sum(row["ours"][method]["natural_map"] <= tolerance for row in rows)
    for name, solver in solvers(rows):
        own = [[e for e in entries_of(row, name) if e["solver"] == solver] for row in rows]
        result["solved"][f"{name} {solver}"] = sum(best(entries, tolerance) is not None for entries in own)
        if any("natural_map_recorded" in e for entries in own for e in entries):
            solved = [any(e.get("natural_map_recorded", math.inf) <= tolerance for e in entries) for entries in own]
            result["recorded"][f"{name} {solver}"] = sum(solved)
    names = rivals(rows)
    for name in [*names, ANY] if len(names) > 1 else names:
        found = [best(entries_of(row, name), tolerance) for row in rows]
        result["solved"][f"{name}, any"] = sum(entry is not None for entry in found)
        result["faster"][name] = {
            key: sum(
                seconds(row["ours"]["auto"], key, tolerance) < (entry["median_s"] if entry else math.inf)
                for row, entry in zip(rows, found, strict=True)
            )
            for key in TIMINGS
        }
    return result


def times(rows: Sequence[dict[str, Any]], tolerance: float) -> dict[str, list[float]]:
    """Seconds of every solver on every problem, one problem at a time; infinity where it did not solve it."""
    table = {
        "warp_lcp, one call": [seconds(row["ours"]["auto"], "call_median_s", tolerance) for row in rows],
        "warp_lcp, prepared": [seconds(row["ours"]["auto"], "kernel_median_s", tolerance) for row in rows],
        "warp_lcp pgs, prepared": [seconds(row["ours"]["pgs"], "kernel_median_s", tolerance) for row in rows],
    }
    for name, solver in solvers(rows):
        found = [best(entries_of(row, name), tolerance, solver) for row in rows]
        table[f"{name} {solver}"] = [entry["median_s"] if entry else math.inf for entry in found]
    return table


def unit(value: float) -> str:
    """Time in us or ms with three digits."""
    return f"{1e6 * value:.3g} us" if value < 1e-3 else f"{1e3 * value:.3g} ms"


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Table of the problems, then the counts."""
    names = rivals(rows)
    lines = [
        "| problem | contacts | rank / 3r | natural map | iterations | " + " | ".join(TIMINGS.values()) + " | pgs: natural map, prepared |"
    ]
    lines[0] += "".join(f" best of {name} at 1e-6 | at 1e-10 |" for name in names)
    lines.append("|" + " --- |" * (lines[0].count("|") - 1))
    for row in rows:
        auto, pgs = row["ours"]["auto"], row["ours"]["pgs"]
        cells = [row["problem"], str(row["contacts"]), f"{row['rank']}/{3 * row['contacts']}", f"{auto['natural_map']:.0e}"]
        cells += [
            str(auto["iterations"]),
            *(unit(auto[key]) for key in TIMINGS),
            f"{pgs['natural_map']:.0e}, {unit(pgs['kernel_median_s'])}",
        ]
        for name in names:
            for tolerance in TOLERANCES:
                entry = best(entries_of(row, name), tolerance)
                cells.append(f"{unit(entry['median_s'])} {entry['solver']} {entry['storage']}" if entry else "none")
        lines.append("| " + " | ".join(cells) + " |")
    for tolerance in TOLERANCES:
        found = counts(rows, tolerance)
        lines += ["", f"Of {found['problems']} problems, natural map <= {tolerance:g}:"]
        lines.append("solved: " + ", ".join(f"{name} {number}" for name, number in found["solved"].items()))
        if found["recorded"]:
            lines.append(
                "solved with W as recorded, not its symmetric part: " + ", ".join(f"{k} {n}" for k, n in found["recorded"].items())
            )
        for name, faster in found["faster"].items():
            lines.append(f"auto faster than the best of {name}: " + ", ".join(f"{TIMINGS[key]} {n}" for key, n in faster.items()))
    return "\n".join(lines)
