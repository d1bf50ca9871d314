# SPDX-License-Identifier: Apache-2.0
"""Pictures of the chart's data: error over time, energy error over time, and the paper's box seen from the side and from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .cases import CASES
from .cases.sliding import box_reference
from .chart import ROUND_OFF, beaten, counts, front
from .pictures import pyplot, save

STYLE = {"font_size": 11, "axes_linewidth": 0.7, "svg_fonttype": "none"}

LEAST_ENERGY = 1e-18  # J: energies under it are drawn there
#: Colour, line, marker, size and label of our curves and of other engines; each differs in more than colour.
OURS = {
    "default": ("#000000", "-", "o", 6.5, "warp_lcp"),
    "midpoint": ("#000000", "-", "s", 6.0, "warp_lcp, midpoint"),
    "coulomb": ("#000000", ":", "*", 8.0, "warp_lcp, coulomb"),
    "float32": ("#555555", ":", "1", 7.0, "warp_lcp, float32"),
    "lemke": ("#555555", ":", "x", 5.0, "warp_lcp, Lemke"),
    "pgs": ("#555555", ":", "+", 6.0, "warp_lcp, PGS"),
    "AP, k = 2 to 16": ("#555555", ":", "|", 7.0, "warp_lcp, AP (k = 2 to 16)"),
}
THEIRS = {
    "mujoco": ("#d55e00", "-", "^", "MuJoCo"),
    "mujoco_warp": ("#e69f00", "--", "v", "MuJoCo Warp"),
    "newton_xpbd": ("#0072b2", "-", "D", "Newton XPBD"),
    "newton_padmm": ("#56b4e9", "--", "p", "Newton Kamino PADMM"),
    "newton_lox": ("#56b4e9", ":", "h", "Newton Kamino LOX"),
    "newton_steel": ("#009e73", "-.", "P", "Newton Steel"),
    "drake": ("#cc79a7", "-", "<", "Drake"),
}
PEER_SIZE = 5.0
#: Settings of each engine whose motion of the paper's box is shown.
SHOWN = {
    "mujoco": ("pyramidal", "elliptic, stiff"),
    "mujoco_warp": ("elliptic, stiff",),
    "drake": ("sap", "lagged"),
    "newton_steel": ("12 sweeps",),
    "newton_padmm": ("200 iterations",),
    "newton_lox": ("16 iterations",),
    "newton_xpbd": ("10 iterations",),
    "warp_lcp": ("default",),
}


def title(row: dict[str, Any]) -> str:
    """What a point says when a pointer is over it."""
    own = f", residual {row['residual']:.0e} m/s" if row.get("residual") is not None else ""
    energy = f", E_uc {row['E_uc']:.1e} J" if row.get("E_uc") is not None else ""
    return (
        f"{row['engine']}, {row['setting']}, {row['knob']}: {row['error']:.2e} {row['unit']}, "
        f"{row['per_ms_us']:.3g} us/ms, {1e6 * row['step_s']:.3g} us a step (spread {100 * row['spread']:.0f} %){energy}{own}"
    )


def curves(rows: list[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Rows of each engine and setting, in the order in which their knobs were turned."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["engine"], row["setting"]), []).append(row)
    return found


def panel(axis: Any, rows: list[dict[str, Any]], key: str, least: float, titles: dict[str, str]) -> None:
    """One case: every engine's curves, and the front of them all."""
    kept = [row | {"error": max(row[key], least), "told": title(row)} for row in rows if row.get(key) is not None]
    best = front(kept)
    if best:
        x = np.repeat([row["per_ms_us"] for row in best], 2)[1:]
        y = np.repeat([row["error"] for row in best], 2)[:-1]
        highest = max(row["error"] for row in kept)
        widest = max(row["per_ms_us"] for row in kept)
        axis.plot(np.r_[x[0], x, widest], np.r_[highest, y, y[-1]], color="0.85", linewidth=7, zorder=0, solid_joinstyle="round")
    for (engine, setting), points in curves(kept).items():
        if engine == "warp_lcp":
            colour, line, marker, size, _ = OURS[setting]
            order, face = 5, "none" if marker == "s" else colour
        else:
            colour, line, marker, _ = THEIRS[engine]
            size, order, face = PEER_SIZE, 3, "white"
        x, y = ([row[name] for row in points] for name in ("per_ms_us", "error"))
        axis.plot(x, y, line, color=colour, linewidth=1.0, zorder=order)
        for row, a, b in zip(points, x, y, strict=True):
            name = f"point{len(titles)}"
            titles[name] = row["told"]
            axis.plot(a, b, marker, color=colour, markersize=size, markerfacecolor=face, markeredgewidth=1.2, zorder=order + 1, gid=name)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.tick_params(direction="in", which="both", top=True, right=True, labelsize=10)


def draw(rows: list[dict[str, Any]], path: Path, key: str = "error") -> list[Path]:
    """The chart: a panel for each case that has the key, 'error' or 'E_uc', and a summary."""
    plt = pyplot(**STYLE)
    good = [row for row in rows if counts(row) and row.get(key) is not None]
    cases = [name for name in dict.fromkeys(row["case"] for row in rows) if key == "error" or name in {row["case"] for row in good}]
    columns = 3 if len(cases) < 9 else 4
    lines = -(-(len(cases) + 1) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(4.3 * columns, 4.2 * lines + 1.2), squeeze=False)
    titles: dict[str, str] = {}
    for axis, name in zip(axes.flat, cases, strict=False):
        panel(axis, [row for row in good if row["case"] == name], key, ROUND_OFF if key == "error" else LEAST_ENERGY, titles)
        metric = CASES[name].metrics[0]
        axis.set_title(CASES[name].label or name, fontsize=12)
        axis.set_ylabel(f"{metric.name} off by [{metric.unit}]" if key == "error" else "$E_{uc}$, worst step [J]")
        axis.set_xlabel("time per environment and simulated ms [µs]")
    summary(axes.flat[len(cases)], good, cases, key)
    for axis in list(axes.flat)[len(cases) + 1 :]:
        axis.set_visible(False)
    handles = [plt.Line2D([], [], color="0.85", linewidth=7, label="front: nobody is faster and better")]
    seen = {(row["engine"], row["setting"]) for row in good}
    for setting, (colour, line, marker, size, label) in OURS.items():
        if ("warp_lcp", setting) in seen:
            face = "none" if marker == "s" else colour
            handles.append(
                plt.Line2D([], [], color=colour, linestyle=line, marker=marker, markersize=size, markerfacecolor=face, label=label)
            )
    for engine, (colour, line, marker, label) in THEIRS.items():
        if engine in {name for name, _ in seen}:
            handles.append(plt.Line2D([], [], color=colour, linestyle=line, marker=marker, markerfacecolor="white", label=label))
    height, room = figure.get_size_inches()[1], 0.25 * -(-len(handles) // 4) + 0.2  # inches of the legend
    figure.legend(handles=handles, loc="lower center", ncols=4, frameon=False, fontsize=11)
    figure.tight_layout(rect=(0, room / height, 1, 1), h_pad=1.5)
    files = save(figure, path, 130, titles)
    plt.close(figure)
    return files


def summary(axis: Any, good: list[dict[str, Any]], cases: list[str], key: str) -> None:
    """Of each engine's points: the share of which one of ours is both faster and more accurate."""
    engines = [engine for engine in THEIRS if any(row["engine"] == engine for row in good)]
    shares = []
    for engine in engines:
        both = theirs = 0
        for name in cases:
            mine = [row | {"error": row[key]} for row in good if row["case"] == name and row["engine"] == "warp_lcp"]
            points = [row | {"error": row[key]} for row in good if row["case"] == name and row["engine"] == engine]
            both += sum(beaten(row, mine) for row in points)
            theirs += len(points)
        shares.append((both, theirs))
    place = np.arange(len(engines))[::-1]
    axis.barh(place, [both / theirs for both, theirs in shares], color="0.25", height=0.6)
    axis.barh(
        place, [1 - both / theirs for both, theirs in shares], left=[both / theirs for both, theirs in shares], color="0.85", height=0.6
    )
    for y, engine, (both, theirs) in zip(place, engines, shares, strict=True):
        axis.text(0.02, y + 0.36, f"{THEIRS[engine][3]}: {both} of {theirs}", fontsize=10, va="bottom")
    axis.set_yticks([])
    axis.set_xticks([0, 0.5, 1], ["0", "half", "all"])
    axis.set_xlim(0, 1)
    axis.set_ylim(-0.6, len(engines) - 0.1 if engines else 1)
    axis.set_title("points that one of ours beats in both", fontsize=12)


def draw_box(rows: list[dict[str, Any]], path: Path) -> list[Path]:
    """The paper's box at a step of 1 ms: its height over time, and its way seen from above, of every engine."""
    plt = pyplot(**STYLE)
    known = {(row["engine"], row["setting"]): row | row["path"] for row in rows if row.get("path")}
    paths = [known[key] for key in ((engine, setting) for engine, settings in SHOWN.items() for setting in settings) if key in known]
    figure, (side, above) = plt.subplots(1, 2, figsize=(11.0, 5.4), width_ratios=(1.6, 1.0))
    titles: dict[str, str] = {}
    for row in paths:
        ours = row["engine"] == "warp_lcp"
        colour, line, label = ("#000000", "-", "warp_lcp") if ours else (*THEIRS[row["engine"]][:2], THEIRS[row["engine"]][3])
        t, x, y, z = (np.array(row[name]) for name in ("time", "x", "y", "z"))
        style = {"color": colour, "linestyle": line, "linewidth": 2.4 if ours else 1.3, "zorder": 5 if ours else 3}
        name = f"path{len(titles)}"
        titles[name] = f"{label}, {row['setting']}: highest {z.max() - z[0]:.2g} m"
        side.plot(t, z - z[0], gid=name, label=f"{label}, {row['setting']}: {max(0.0, z.max() - z[0]):.2g} m", **style)
        above.plot(x, y, **style)
        above.plot(x[-1], y[-1], "o", color=colour, markersize=4)
    side.set_xlabel("time [s]")
    side.set_ylabel("height above the ground [m]")
    figure.legend(loc="lower center", ncols=3, frameon=False, fontsize=9)
    above.plot(*box_reference()[:2], "*", color="0.75", markersize=16, markeredgecolor="0.3", zorder=1)
    above.set_aspect("equal", adjustable="box")
    above.set_xlabel("x [m]")
    above.set_ylabel("y [m]")
    above.set_title("from above; star: continuous motion", fontsize=10)
    side.set_title("the paper's box, h = 1 ms; in the legend the largest height", fontsize=10)
    figure.tight_layout(rect=(0, 0.16, 1, 1))
    files = save(figure, path, 130, titles)
    plt.close(figure)
    return files
