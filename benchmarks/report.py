# SPDX-License-Identifier: Apache-2.0
"""Results with what they were taken on: versions, device, load."""

from __future__ import annotations

import datetime
import json
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

ROOT = Path(__file__).parents[1]
DOCS, RESULTS = ROOT / "docs", ROOT / "benchmarks" / "results"
PARTIAL = ROOT / "build" / "benchmarks"  # of runs that leave something out
STAMP = datetime.date.today().isoformat()  # one for a run, however late it ends
END = "<!-- end of the tables -->\n"


def processor() -> str:
    """Model name of the processor."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def plain(value: Any) -> Any:
    """A numpy scalar as Python's own."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no place in a result")


def path_of(folder: Path, what: str, device: wp.Device) -> Path:
    """folder/<date>-<what>-<device>.json"""
    return folder / f"{STAMP}-{what}-{'cuda' if device.is_cuda else 'cpu'}.json"


def write(folder: Path, what: str, device: wp.Device, data: dict[str, Any]) -> Path:
    """Write data with its circumstances; returns the path."""
    header = {
        "what": what,
        "date": STAMP,
        "device": device.name if device.is_cuda else processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "numpy": np.__version__,
        "warp": wp.config.version,
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = path_of(folder, what, device)
    path.write_text(json.dumps(header | data, indent=1, default=plain) + "\n")
    return path


def begin(what: str) -> str:
    """The mark before the tables of a command."""
    return f"<!-- tables of `python -m benchmarks {what}` -->\n"


def document(what: str, text: str, path: Path) -> None:
    """Put the tables of a command between their marks in a document; where there is none, they are one.

    Raises:
        ValueError: if it has no marks.
    """
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{begin(what)}\n{END}\n")
    before, mark, rest = path.read_text().partition(begin(what))
    _, end, after = rest.partition(END)
    if not (mark and end):
        raise ValueError(f"{path}: the marks of the tables of '{what}' are missing")
    path.write_text(f"{before}{mark}\n{text}\n{end}{after}")


def tables(what: str, path: Path) -> str:
    """What stands there now."""
    return path.read_text().partition(begin(what))[2].partition(END)[0][1:-1]
