# SPDX-License-Identifier: Apache-2.0
"""The paper's Fig. 4, redone: path of the centre of mass under every formulation, with two closer looks at where it ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .pictures import pyplot, save

#: Grey, dashes, marker of the end: told apart without colour. Laws that lie on each other differ in marker size as well.
STYLES: dict[str, tuple[str, Any, str, float]] = {
    "coulomb": ("0.0", (0, (4, 4)), "+", 10),
    "regularized": ("0.0", "-", "o", 9),
    "aligned": ("0.0", (0, (2, 1)), "^", 7),
    "hybrid": ("0.0", (0, (1, 1)), "P", 8),
    "AP, k = 2": ("0.0", (0, (6, 2)), "s", 6),
    "AP, k = 4": ("0.0", (0, (6, 2, 1, 2)), "D", 5.5),
    "AP, k = 8": ("0.0", (0, (6, 2, 1, 2, 1, 2)), "p", 7),
    "box": ("0.45", (0, (3, 1.5)), "X", 7),
    "facets, k = 2": ("0.45", (0, (1, 1.5)), "v", 7),
    "facets, k = 4": ("0.45", (0, (4, 1.5, 1, 1.5)), "<", 7),
    "facets, k = 8": ("0.45", (0, (8, 2)), ">", 7),
}
LABELS = {
    "AP, k = 2": "Anitescu-Potra, k = 2",
    "AP, k = 4": "Anitescu-Potra, k = 4",
    "AP, k = 8": "Anitescu-Potra, k = 8",
    "hybrid": "hybrid",
    "facets, k = 2": "phantom inertia, fixed facets, k = 2",
    "facets, k = 4": "phantom inertia, fixed facets, k = 4",
    "facets, k = 8": "phantom inertia, fixed facets, k = 8",
    "aligned": "phantom inertia, aligned (eq. 34)",
    "regularized": "phantom inertia, regularized (34, 43)",
    "coulomb": "exact cone",
}
#: Named where they end as well: offset of the name in points, and its side.
FAR = {"AP, k = 2": ((-6, 5), "right"), "box": ((7, -9), "left"), "facets, k = 2": ((0, 9), "center")}
#: Half widths of the closer looks [m], one row each.
ZOOMS = (0.12, 0.012)


def draw(data: dict[str, Any], path: Path) -> None:
    """Write path.png and path.svg.

    Raises:
        MissingExtra: without matplotlib.
    """
    plt = pyplot(font_size=9, axes_linewidth=0.6)
    figure, axes = plt.subplots(3, 2, figsize=(8.2, 12.2))
    reference = np.array(data["reference"])
    end = reference[-1, :2]
    for column, h in enumerate((1e-2, 1e-3)):
        rows = {row["case"]: np.array(row["trajectory"]) for row in data["formulations"] if row["h"] == h}
        exact = rows["coulomb"][-1, :2]
        for level, axis in enumerate(axes[:, column]):
            axis.plot(*reference[:, :2].T, color="0.82", linewidth=7 if level == 0 else 9, solid_capstyle="round", zorder=0)
            axis.plot(*end, marker="*", color="0.82", markeredgecolor="0.3", markeredgewidth=0.6, markersize=17, zorder=1)
            for name, (grey, dashes, marker, size) in STYLES.items():
                line = rows[name]
                axis.plot(*line[:, :2].T, color=grey, linestyle=dashes, linewidth=1.1, zorder=2)
                face = "none" if marker not in "+" else grey
                axis.plot(*line[-1, :2], marker, color=grey, markerfacecolor=face, markersize=size, markeredgewidth=1.2, zorder=4)
            axis.set_aspect("equal", adjustable="box")
            axis.tick_params(direction="in", top=True, right=True, length=3)
            axis.set_xlabel("x [m]")
            axis.set_ylabel("y [m]" if column == 0 else "")
        axes[0, column].set_title(f"h = {1e3 * h:g} ms")
        axes[0, column].set_xlim(-0.45, 1.55)
        axes[0, column].set_ylim(-0.1, 1.9)
        for name, (place, side) in FAR.items():
            axes[0, column].annotate(name, rows[name][-1, :2], place, textcoords="offset points", fontsize=8, ha=side)
        for level, half in enumerate(ZOOMS, 1):
            # The closest look follows the end at this step size, 27 mm from the continuous one at 10 ms.
            centre = (exact if level == 2 else end) - 0.25 * half  # the paths come from below and the left
            axis = axes[level, column]
            axis.set_xlim(centre[0] - half, centre[0] + half)
            axis.set_ylim(centre[1] - half, centre[1] + half)
            axis.locator_params(nbins=5)
            axis.ticklabel_format(useOffset=False)
            before = axes[level - 1, column]
            corners = centre[0] + half * np.array([-1, 1, 1, -1, -1]), centre[1] + half * np.array([-1, -1, 1, 1, -1])
            before.plot(*corners, color="0.2", linewidth=0.6, zorder=5)
            before.annotate("next row", (centre[0] + half, centre[1] + half), (3, 1), textcoords="offset points", fontsize=7)
    star = {"marker": "*", "markeredgecolor": "0.3", "markersize": 12}
    handles = [plt.Line2D([], [], color="0.82", linewidth=7, label="continuous motion", **star)]
    for name, (grey, dashes, marker, size) in STYLES.items():
        face = "none" if marker not in "+" else grey
        label = LABELS.get(name, name)
        options = {"marker": marker, "markersize": 0.8 * size, "markerfacecolor": face, "label": label}
        handles.append(plt.Line2D([], [], color=grey, linestyle=dashes, linewidth=1.1, **options))
    figure.legend(handles=handles, loc="lower center", ncols=3, frameon=False, handlelength=4.5, fontsize=8)
    figure.tight_layout(rect=(0, 0.07, 1, 1))
    save(figure, path)
    plt.close(figure)
