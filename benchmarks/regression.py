# SPDX-License-Identifier: Apache-2.0
"""What got worse since the results that were kept last.

Errors and verdicts are the same on every machine (but for what was too slow), so they are compared as they are; times only as
ratios to what was timed in the same run.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .cases.case import ENERGY_RISE

#: An error is worse if it grew by this factor, and by more than rounding.
ERROR, ROUNDING = 1.05, 1e-9
#: A ratio of times is worse if it fell by this factor and its range lies below the old one.
RATIO = 1.2
VERDICTS = ("survived", "drifted", "wrong", "blew up", "too slow", "refused")


def accuracy(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Errors, of the law too, that grew; bars that are missed now; less that is certified; rows that are gone."""

    def keyed(data: dict[str, Any]) -> dict[tuple[Any, ...], dict[str, Any]]:
        names = ("total", "model", "within", "certified", "energy_rise")
        return {
            (row["case"], row["law"], row["metric"], h): {name: row[name][i] for name in names} | {"unit": row["unit"]}
            for row in data["rows"]
            for i, h in enumerate(row["h"])
        }

    before, after, found = keyed(old), keyed(new), []
    for key, was in before.items():
        where, now = f"{key[0]}, {key[1]}, {key[2]} at {1e3 * key[3]:g} ms", after.get(key)
        if now is None:
            found.append(f"{where}: not measured any more")
            continue
        for name, said in (("total", "off by"), ("model", "the law off by")):
            if not now[name] <= ERROR * was[name] + ROUNDING:
                found.append(f"{where}: {said} {now[name]:.2e} {now['unit']}, was {was[name]:.2e}")
        if was["within"] and not now["within"]:
            found.append(f"{where}: over its bar")
        if not now["certified"] >= was["certified"]:
            found.append(f"{where}: {100 * now['certified']:.4g} % certified, was {100 * was['certified']:.4g} %")
        if not now["energy_rise"] <= max(was["energy_rise"], ENERGY_RISE):
            found.append(f"{where}: energy up by {now['energy_rise']:.1e}, was {was['energy_rise']:.1e}")
    return found


def stability(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Verdicts that are worse, and randomised copies that lost more, where as many ran. What was too slow may be so again elsewhere."""

    def keyed(data: dict[str, Any]) -> dict[tuple[Any, ...], dict[str, Any]]:
        return {(row["case"], row["variant"], row["h"]): row for row in data["rows"]}

    before, after, found = keyed(old), keyed(new), []
    for key, was in before.items():
        where, row = f"{key[0]}, {key[1]} at {1e3 * key[2]:g} ms", after.get(key)
        if row is None:
            found.append(f"{where}: not run any more")
        elif VERDICTS.index(row["verdict"]) > VERDICTS.index(was["verdict"]):
            found.append(f"{where}: {row['verdict']}, was {was['verdict']}: {row['reason']}")
    known = {(row["scene"], row["envs"]): row for row in old.get("crowds", [])}
    for row in new.get("crowds", []):
        if lost := known.get((row["scene"], row["envs"])):
            pairs = {bit: (row["status"][bit], lost["status"][bit]) for bit in ("UNCERTIFIED", "NOT_A_NUMBER")}
            pairs |= {name: (row[name], lost[name]) for name in ("spoilt_envs", "not_finite")}
            found += [f"{row['scene']}, randomised: {now} {name}, was {was}" for name, (now, was) in pairs.items() if now > was]
    return found


def chart(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Errors of ours that grew and points that are lost; ratios to our default, or to its own `coulomb`, that got worse."""

    def keyed(data: dict[str, Any]) -> dict[tuple[str, ...], dict[str, Any]]:
        return {tuple(row[name] for name in ("case", "engine", "setting", "knob")): row for row in data["rows"] if "per_ms_us" in row}

    def ratio(rows: dict[tuple[str, ...], dict[str, Any]], key: tuple[str, ...]) -> tuple[float, float] | None:
        beside = "coulomb" if key[1:3] == ("warp_lcp", "default") else "default"
        own = next((r for k, r in rows.items() if k[:3] == (key[0], "warp_lcp", beside) and r["h"] == rows[key]["h"]), None)
        return (rows[key]["step_s"] / own["step_s"], rows[key]["spread"] + own["spread"]) if own else None

    before, after, found = keyed(old), keyed(new), []
    for key, was in before.items():
        where, row, ours = ", ".join(key), after.get(key), key[1] == "warp_lcp"
        if row is None:
            found.append(f"{where}: no point any more")
            continue
        if ours and not row["error"] <= ERROR * was["error"] + ROUNDING:
            found.append(f"{where}: error {row['error']:.2e} {row['unit']}, was {was['error']:.2e}")
        if ours and not row["certified"] >= was["certified"]:
            found.append(f"{where}: {100 * row['certified']:.4g} % certified, was {100 * was['certified']:.4g} %")
        then, now = ratio(before, key), ratio(after, key)
        if then and now and (now[0] / then[0] if ours else then[0] / now[0]) > RATIO + 0.5 * (then[1] + now[1]):
            found.append(
                f"{where}: time over that of our {'coulomb' if key[2] == 'default' and ours else 'default'} {now[0]:.2f}, was {then[0]:.2f}"
            )
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
    "robots": peers,
}


def last(path: Path, folder: Path) -> Path | None:
    """The kept result of the same command and kind of device that comes before this one, or is it; None if there is none.

    Raises:
        ValueError: if the name is not that of a result.
    """
    parts = path.name.split("-", 3)
    if len(parts) < 4:
        raise ValueError(f"{path} is not called <date>-<command>-<device>.json: name the result to compare with")
    kept = [other for other in sorted(folder.glob(f"*-{parts[3]}")) if other.name <= path.name]
    others = [other for other in kept if other.resolve() != path.resolve()]
    return others[-1] if others else None


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


def worse(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """A line for everything that got worse.

    Raises:
        ValueError: where the two cannot be compared.
    """
    if before["what"] != after["what"]:
        raise ValueError(f"one is a result of '{before['what']}', the other of '{after['what']}': compare the same")
    return KINDS[after["what"]](before, after)
