# SPDX-License-Identifier: Apache-2.0
"""Performance profiles of the methods for LCPs on recorded problems, a panel a precision.

A problem's time is that of its file's batch over the number of problems in it, so problems of a file differ by whether they are solved.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from . import lcp
from .pictures import pyplot, save
from .profiles import Style, panel, profile

STYLES: tuple[Style, ...] = (
    ("-", "o", 2.0, "black"),
    ("-", "s", 1.4, "0.3"),
    ("--", "D", 1.4, "0.3"),
    ("-.", "^", 1.4, "0.3"),
    (":", "v", 1.6, "0.3"),
    ((0, (5, 1, 1, 1, 1, 1)), "x", 1.4, "0.3"),
)


def draw(rows: list[dict[str, Any]], path: Path) -> list[Path]:
    """Write path.png and path.svg. Needs the extra 'bench'."""
    plt = pyplot()
    figure, axes = plt.subplots(1, len(lcp.TOLERANCE), figsize=(10.0, 4.2), sharey=True, layout="constrained")
    styles = dict(zip(lcp.METHODS, STYLES, strict=False))
    for axis, (precision, tolerance) in zip(axes, lcp.TOLERANCE.items(), strict=True):
        table = lcp.times(rows, precision)
        profiles, number = profile(table), len(next(iter(table.values())))
        panel(axis, profiles, number, 3.0 * max((ratios[-1] for ratios in profiles.values() if ratios), default=1.0), styles)
        axis.set_title(f"{precision}, residual up to {tolerance:g}")
        axis.set_xlabel("time / time of the fastest solver")
    axes[0].set_ylabel(f"share of {number} problems solved")
    axes[-1].legend(loc="center left", bbox_to_anchor=(1.02, 0.5), frameon=False, handlelength=4.5)
    path.parent.mkdir(parents=True, exist_ok=True)
    files = save(figure, path)
    plt.close(figure)
    return files
