# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can mend: each says what is wrong, where, and how to put it right."""


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
