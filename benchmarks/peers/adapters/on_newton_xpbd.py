# SPDX-License-Identifier: Apache-2.0
"""Newton's XPBD on the CPU. Setting: iterations. It keeps nothing from step to step but the state."""

from __future__ import annotations

from typing import Any

import newton
import protocol
from newton_engine import NewtonEngine


class NewtonXPBD(NewtonEngine):
    """Position-based."""

    def solver(self) -> newton.solvers.SolverBase:
        """Its default are 2 iterations."""
        return newton.solvers.SolverXPBD(self.model, iterations=self.job.settings["iterations"])

    def add(self, world: newton.ModelBuilder, **body: Any) -> None:
        """A free joint is none for it."""
        world.add_link(**body)


if __name__ == "__main__":
    protocol.serve(NewtonXPBD, ("newton", "warp-lang"))
