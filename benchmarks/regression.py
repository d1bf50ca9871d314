# SPDX-License-Identifier: Apache-2.0
"""What got worse since the results that were kept last.

Errors and verdicts are the same on every machine, so they are compared as they are; times only as ratios to what was timed in
the same run: of ours to another engine, or of one of our settings to the default.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

#: An error is worse if it grew by this factor, and by more than rounding.
ERROR, ROUNDING = 1.05, 1e-9
#: A ratio of times is worse if it fell by this factor and its range lies below the old one.
RATIO = 1.2
VERDICTS = ("survived", "drifted", "wrong", "blew up")


def accuracy(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Errors that grew."""
    before = {
        (row["case"], row["law"], row["metric"], h): error for row in old["rows"] for h, error in zip(row["h"], row["total"], strict=True)
    }
    found = []
    for row in new["rows"]:
        for h, error in zip(row["h"], row["total"], strict=True):
            was = before.get((row["case"], row["law"], row["metric"], h))
            if was is not None and not error <= ERROR * was + ROUNDING:
                found.append(f"{row['case']}, {row['law']}, {row['metric']} at {1e3 * h:g} ms: {error:.2e} {row['unit']}, was {was:.2e}")
    return found


def stability(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Verdicts that are worse, and randomised copies that lost more."""
    before = {(row["case"], row["variant"], row["h"]): row["verdict"] for row in old["rows"]}
    found = []
    for row in new["rows"]:
        was, now = before.get((row["case"], row["variant"], row["h"])), row["verdict"]
        if was in VERDICTS and (now not in VERDICTS or VERDICTS.index(now) > VERDICTS.index(was)):
            found.append(f"{row['case']}, {row['variant']} at {1e3 * row['h']:g} ms: {now}, was {was}: {row['reason']}")
    lost = {row["scene"]: row["status"] for row in old.get("crowds", [])}
    for row in new.get("crowds", []):
        for bit in ("UNCERTIFIED", "NOT_A_NUMBER"):
            if row["scene"] in lost and row["status"][bit] > lost[row["scene"]][bit]:
                found.append(f"{row['scene']}, randomised: {row['status'][bit]} {bit}, was {lost[row['scene']][bit]}")
    return found


def chart(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Errors of ours that grew; ratios of the others' times to our default's that fell."""

    def keyed(data: dict[str, Any]) -> dict[tuple[str, ...], dict[str, Any]]:
        return {tuple(row[name] for name in ("case", "engine", "setting", "knob")): row for row in data["rows"] if "per_ms_us" in row}

    def ratio(rows: dict[tuple[str, ...], dict[str, Any]], key: tuple[str, ...]) -> tuple[float, float]:
        own = rows.get((key[0], "warp_lcp", "default", key[3]))
        return (rows[key]["step_s"] / own["step_s"], rows[key]["spread"] + own["spread"]) if own else (1.0, 0.0)

    before, after, found = keyed(old), keyed(new), []
    for key, row in after.items():
        if key not in before:
            continue
        was = before[key]
        if key[1] == "warp_lcp" and not row["error"] <= ERROR * was["error"] + ROUNDING:
            found.append(f"{', '.join(key)}: error {row['error']:.2e} {row['unit']}, was {was['error']:.2e}")
        (then, noise), (now, noise_now) = ratio(before, key), ratio(after, key)
        change = then / now if key[1] != "warp_lcp" else now / then
        if change > RATIO + 0.5 * (noise + noise_now):
            found.append(f"{', '.join(key)}: time over that of our default {now:.2f}, was {then:.2f}")
    return found


def peers(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Ratios to other engines that fell out of their old range."""
    before = {(row["scene"], row["engine"]): row for row in old.get("peers", [])}
    found = []
    for row in new.get("peers", []):
        was = before.get((row["scene"], row["engine"]))
        if (
            was
            and row["ours_over_peer"] * RATIO < was["ours_over_peer"]
            and row["ours_over_peer_range"][1] < was["ours_over_peer_range"][0]
        ):
            found.append(f"{row['scene']}, {row['engine']}: {row['ours_over_peer']:.2f} times as fast, was {was['ours_over_peer']:.2f}")
    return found


KINDS: dict[str, Callable[[dict[str, Any], dict[str, Any]], list[str]]] = {
    "accuracy": accuracy,
    "stability": stability,
    "chart": chart,
    "peers": peers,
    "speed": peers,
}


def last(path: Path, folder: Path) -> Path | None:
    """The kept result of the same command and kind of device before this one; None if there is none."""
    kind = path.name.split("-", 3)[3]
    kept = [other for other in sorted(folder.glob(f"*-{kind}")) if other.resolve() != path.resolve()]
    return kept[-1] if kept else None


def read(path: Path) -> dict[str, Any]:
    """A result.

    Raises:
        ValueError: if it is none that can be compared.
    """
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if not isinstance(data, dict) or data.get("what") not in KINDS:
        raise ValueError(f"{path} is no result of {', '.join(KINDS)}")
    return data


def worse(old: Path, new: Path) -> list[str]:
    """A line for everything that got worse.

    Raises:
        ValueError: where the two cannot be compared.
    """
    before, after = read(old), read(new)
    if before["what"] != after["what"]:
        raise ValueError(f"{old} is of '{before['what']}', {new} of '{after['what']}': compare the same")
    return KINDS[after["what"]](before, after)
