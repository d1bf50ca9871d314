# SPDX-License-Identifier: Apache-2.0
"""Up to which step size every variant survives every case, as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .pictures import pyplot, save


def survived_to(rows: list[dict[str, Any]]) -> dict[tuple[str, str], float | None]:
    """Largest step [s] by (variant, case) at which, and at all smaller ones, it survives; 0 where at none; None where it is refused."""
    found: dict[tuple[str, str], float | None] = {}
    over: set[tuple[str, str]] = set()
    for row in sorted(rows, key=lambda row: row["h"]):
        key = (row["variant"], row["case"])
        if row["verdict"] == "refused":
            found[key] = None
        elif row["verdict"] == "survived" and key not in over:
            found[key] = row["h"]
        else:
            over.add(key)
            found.setdefault(key, 0.0)
    return found


def draw(rows: list[dict[str, Any]], path: Path) -> list[Path]:
    """A line for each variant, a column for each case; darker is worse, numbers are steps in ms."""
    plt = pyplot(svg_fonttype="none")
    variants, cases = (list(dict.fromkeys(row[name] for row in rows)) for name in ("variant", "case"))
    steps = [0.0, *sorted({row["h"] for row in rows})]
    limits = survived_to(rows)
    shade = np.full((len(variants), len(cases)), np.nan)
    for i, variant in enumerate(variants):
        for j, case in enumerate(cases):
            limit = limits.get((variant, case))
            if limit is not None:
                shade[i, j] = steps.index(limit) / (len(steps) - 1)
    figure, axis = plt.subplots(figsize=(0.36 * len(cases) + 3.2, 0.29 * len(variants) + 2.6))
    colours = plt.get_cmap("Greys_r").with_extremes(bad="#f2d8b8")
    axis.imshow(np.ma.masked_invalid(shade), cmap=colours, vmin=-0.25, vmax=1.0, aspect="auto")
    for i in range(len(variants)):
        for j in range(len(cases)):
            bad = np.isnan(shade[i, j])
            text = "–" if bad else f"{1e3 * steps[round(shade[i, j] * (len(steps) - 1))]:g}"
            axis.text(j, i, text, ha="center", va="center", fontsize=8, color="white" if not bad and shade[i, j] < 0.4 else "black")
    axis.set_xticks(range(len(cases)), cases, rotation=90, fontsize=9)
    axis.set_yticks(range(len(variants)), variants, fontsize=9)
    axis.tick_params(length=0)
    axis.set_title("largest step [ms] up to which it survives (0: none of them; –: refused)", fontsize=11)
    figure.tight_layout()
    files = save(figure, path, 130)
    plt.close(figure)
    return files
