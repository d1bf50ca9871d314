# SPDX-License-Identifier: Apache-2.0
"""Performance profiles: the share of problems that a solver solves within a multiple of the fastest one's time."""

from __future__ import annotations

import math
from typing import Any

#: Line style, marker, width, shade of a curve, as can be told apart in black and white.
Style = tuple[Any, str, float, str]


def profile(table: dict[str, list[float]]) -> dict[str, list[float]]:
    """Ratios to the fastest solver of each problem, ascending, only those of problems solved (Dolan and More 2002).

    A problem that nobody solves counts for nobody: the share of solved problems is len(ratios) / number of problems.
    """
    fastest = [min(column) for column in zip(*table.values(), strict=True)]
    return {
        solver: sorted(own / least for own, least in zip(column, fastest, strict=True) if math.isfinite(own))
        for solver, column in table.items()
    }


def panel(axis: Any, profiles: dict[str, list[float]], number: int, limit: float, styles: dict[str, Style]) -> None:
    """Curves of some solvers with the styles of all; number: of problems; limit: the largest ratio that is shown."""
    for place, (solver, ratios) in enumerate(profiles.items()):
        line, marker, width, shade = styles[solver]
        shares = [(i + 1) / number for i in range(len(ratios))]
        axis.step(
            [1.0, *ratios, limit],
            [0.0, *shares, shares[-1] if shares else 0.0],
            where="post",
            linestyle=line,
            linewidth=width,
            color=shade,
            marker=marker,
            markersize=6,
            markerfacecolor="white" if place % 2 else shade,
            markevery=(1 + place % 3, max(4, number // 8)),
            label=solver,
        )
    axis.set(xscale="log", xlim=(1.0, limit), ylim=(0.0, 1.03))
    axis.grid(True, which="major", color="0.88", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
