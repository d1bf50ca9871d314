# SPDX-License-Identifier: Apache-2.0
"""Scenes of which it is known what comes out, by closed forms and converged solutions that are not ours."""

from __future__ import annotations

import argparse

from . import impacts, jointed, resting, rolling, sliding
from .case import Case, Metric

CASES: dict[str, Case] = {case.name: case for room in (sliding, rolling, resting, impacts, jointed) for case in room.CASES}


def case_names(text: str) -> list[str]:
    """'all' or names with commas between them."""
    names = list(CASES) if text == "all" else text.split(",")
    for name in names:
        if name not in CASES:
            raise argparse.ArgumentTypeError(f"no case {name!r}; choose from {', '.join(CASES)}, or all")
    return names


__all__ = ["CASES", "Case", "Metric", "case_names"]
