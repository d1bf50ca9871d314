# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can mend: each says what is wrong, where, and how to put it right."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np


class WarpLcpError(ValueError):
    """Base of every error raised for bad input; the command line prints it as one line and exits with status 2."""


class ModelError(WarpLcpError):
    """A body, shape, material or parameter that cannot be simulated."""


class SceneError(WarpLcpError):
    """A USD stage that cannot be read or means something that is not supported; names the file and the prim."""


class SimulationError(RuntimeError):
    """An environment is not OK after a step; raised only by a Simulator with ``strict=True``."""


class MissingExtra(WarpLcpError, ImportError):
    """An optional dependency is absent; names the extra that installs it."""

    def __init__(self, purpose: str, extra: str, cause: ImportError):
        super().__init__(f"{purpose} needs the extra '{extra}': python -m pip install 'warp_lcp[{extra}]' ({cause})")


def whole_number(what: str, value: Any, least: int) -> int:
    """A count that a user gives, as an int: 2, 2.0 and numpy's kinds of 2 are whole numbers, True and "2" are none.

    Raises:
        WarpLcpError: for anything else, NaN and infinity included, and for less than `least`.
    """
    with suppress(TypeError, ValueError, OverflowError):
        number = int(value)
        if number == value and number >= least and not isinstance(value, (bool, np.bool_)):
            return number
    raise WarpLcpError(f"{what} is {value!r}; give a whole number of at least {least}")


def positive_number(what: str, value: Any, unit: str = "", error: type[WarpLcpError] = WarpLcpError) -> float:
    """A quantity that a user gives, as a float: finite and greater than zero; text is none.

    Raises:
        error: for anything else.
    """
    with suppress(TypeError, ValueError):
        if not isinstance(value, (str, bool, np.bool_)) and np.isfinite(value) and value > 0.0:
            return float(value)
    shown = f"{value!r}" if isinstance(value, str) else f"{value} {unit}".strip()
    raise error(f"{what} is {shown}; it must be finite and greater than zero")
