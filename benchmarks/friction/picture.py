# SPDX-License-Identifier: Apache-2.0
"""Performance profiles as a picture that can be read in black and white."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from . import summary

#: Line style, width and shade of the curves whose names begin so, and the markers that tell one from the next.
STYLES = {
    "warp_lcp": ("-", 2.2, "black", "osD"),
    "Siconos": ("-", 1.0, "0.5", "^v<>x"),
    "Pinocchio": ((0, (4, 1.5)), 1.6, "0.2", "Ph*"),
}


def style(place: int, solvers: Sequence[str]) -> dict[str, Any]:
    """How a curve is drawn, by the first word of its name and how many before it share that."""
    first = solvers[place].replace(",", "").split()[0]
    line, width, shade, markers = STYLES[first]
    own = sum(solver.startswith(first) for solver in solvers[:place])
    marker = markers[own % len(markers)]
    filled = shade if own % 2 == 0 or marker == "x" else "white"
    return {"linestyle": line, "linewidth": width, "color": shade, "marker": marker, "markerfacecolor": filled}


def draw(rows: Sequence[dict[str, Any]], folder: Path) -> list[Path]:
    """Write friction_profile.png and .svg into a folder; one panel for each tolerance. Needs the extra 'bench'."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams["svg.hashsalt"] = "warp_lcp"
    figure, axes = plt.subplots(1, len(summary.TOLERANCES), figsize=(11.0, 5.2), sharey=True, layout="constrained")
    profiles = [summary.profile(summary.times(rows, tolerance)) for tolerance in summary.TOLERANCES]
    limit = 3.0 * max(ratios[-1] for found in profiles for ratios in found.values() if ratios)
    for axis, tolerance, found in zip(axes, summary.TOLERANCES, profiles, strict=True):
        for place, (solver, ratios) in enumerate(found.items()):
            shares = [(i + 1) / len(rows) for i in range(len(ratios))]
            x, y = [1.0, *ratios, limit], [0.0, *shares, shares[-1] if shares else 0.0]
            axis.step(
                x,
                y,
                where="post",
                **style(place, list(found)),
                markersize=6,
                markevery=(1 + place % 4, 4),
                label=solver,
            )
        axis.set(xscale="log", xlim=(1.0, limit), ylim=(0.0, 1.03), xlabel="time / time of the fastest solver")
        axis.set_title(f"natural map $\\leq$ $10^{{{round(math.log10(tolerance))}}}$")
        axis.grid(True, which="major", color="0.88", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel(f"share of {len(rows)} problems solved")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, handlelength=4.5)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"friction_profile.{kind}" for kind in ("png", "svg")]
    figure.savefig(paths[0], dpi=150, metadata={"Software": None})
    figure.savefig(paths[1], metadata={"Date": None})
    plt.close(figure)
    return paths
