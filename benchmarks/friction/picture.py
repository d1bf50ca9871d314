# SPDX-License-Identifier: Apache-2.0
"""Performance profiles as a picture that can be read in black and white."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..pictures import pyplot, save
from ..profiles import panel, profile
from . import summary

#: Line style, marker, width, shade of each curve in order: of ours, and of a rival's.
OURS = (("-", "o", 2.0, "black"), ("-", "s", 2.0, "black"), ("--", "D", 1.4, "0.25"))
THEIRS = (
    ("-", "^", 1.2, "0.4"),
    ("--", "v", 1.2, "0.4"),
    ("-.", "<", 1.2, "0.4"),
    (":", ">", 1.3, "0.35"),
    ((0, (5, 1, 1, 1, 1, 1)), "x", 1.2, "0.35"),
)


def draw(rows: Sequence[dict[str, Any]], folder: Path) -> list[Path]:
    """Write friction_profile.png and .svg into a folder; a row of panels for each rival beside ours, a column for each tolerance.

    The fastest solver is the fastest of all rows. Needs the extra 'bench'.
    """
    plt = pyplot()
    names = summary.rivals(rows)
    size = (len(names), len(summary.TOLERANCES))
    figure, axes = plt.subplots(*size, figsize=(10.0, 4.2 * len(names)), sharex=True, sharey=True, squeeze=False, layout="constrained")
    profiles = [profile(summary.times(rows, tolerance)) for tolerance in summary.TOLERANCES]
    limit = 3.0 * max(ratios[-1] for found in profiles for ratios in found.values() if ratios)
    for line, name in zip(axes, names, strict=True):
        for axis, found in zip(line, profiles, strict=True):
            shown = {solver: ratios for solver, ratios in found.items() if solver.startswith(("warp_lcp", name))}
            mine = [solver for solver in shown if solver.startswith("warp_lcp")]
            styles = dict(zip(mine, OURS, strict=True)) | dict(zip([s for s in shown if s not in mine], THEIRS, strict=False))
            panel(axis, shown, len(rows), limit, styles)
        line[0].set_ylabel(f"share of {len(rows)} problems solved")
        line[-1].legend(loc="center left", bbox_to_anchor=(1.02, 0.5), frameon=False, handlelength=4.5)
    for axis, tolerance in zip(axes[0], summary.TOLERANCES, strict=True):
        axis.set_title(f"natural map $\\leq$ $10^{{{round(math.log10(tolerance))}}}$")
    for axis in axes[-1]:
        axis.set_xlabel("time / time of the fastest solver")
    folder.mkdir(parents=True, exist_ok=True)
    paths = save(figure, folder / "friction_profile")
    plt.close(figure)
    return paths
