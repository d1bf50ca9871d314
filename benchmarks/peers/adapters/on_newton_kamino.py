# SPDX-License-Identifier: Apache-2.0
"""Newton's Kamino on the CPU. Settings: backend ("padmm" or "lox") and the fields of its configuration that differ from the
defaults. It starts from the impulses of the last step, which its reset forgets."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import protocol
from newton_engine import ANGULAR, GENEROUS, LINEAR, NewtonEngine

Kamino = newton.solvers.SolverKamino
COLOURS = 4  # default of LOX, which gives fewer, and other results, where it has less room for contacts


class NewtonKamino(NewtonEngine):
    """Maximal coordinates; the free joint of a body constrains nothing."""

    knows = frozenset({"force", "friction", "damping"})

    def __init__(self, job: protocol.Job):
        self.fullest = 0  # contacts of the fullest environment so far
        self.room = max(len(job.mass), 1) * GENEROUS
        super().__init__(job)

    def joints(self, world: newton.ModelBuilder, tree: protocol.Tree) -> None:
        """It has some of the joints that a D6 can be, and none of two ways, or of a way and more than one angle."""
        for body in range(len(tree.body_parent)):
            ways = int(np.count_nonzero((tree.dof_body == body) & (tree.dof_kind == LINEAR)))
            angles = int(np.count_nonzero((tree.dof_body == body) & (tree.dof_kind == ANGULAR)))
            if ways and (ways, angles) not in ((1, 0), (1, 1), (3, 0)):
                raise protocol.Refused(f"Kamino has no joint of {ways} ways and {angles} angles")
        super().joints(world, tree)

    def register(self, builder: newton.ModelBuilder) -> None:
        """Attributes of its states."""
        Kamino.register_custom_attributes(builder)

    def solver(self) -> newton.solvers.SolverBase:
        """Every environment gets the same room, which is the size of its dense matrices whatever it has at present."""
        options = dict(self.job.settings)
        config = Kamino.Config(dynamics_solver=options.pop("backend"))
        for name, value in options.items():
            setattr(getattr(config, config.dynamics_solver), name, value)
        self.model.rigid_contact_max = self.room * self.job.envs
        return Kamino(self.model, config)

    def reset(self) -> None:
        """The solver derives the joints' coordinates from the bodies and forgets its last impulses."""
        super().reset()
        self.engine.reset(self.states[0], config=Kamino.ResetConfig.preserve())

    def contacts(self) -> float:
        """Those of the pipeline; the solver needs room for those it keeps, which are with PADMM the touching ones."""
        self.fullest = max(self.fullest, int(self.engine._contacts_kamino.world_active_contacts.numpy().max()))
        return super().contacts()

    def settle(self) -> None:
        """As much room as the fullest environment needed."""
        if self.fullest == self.room:  # it counts no further
            raise RuntimeError(f"{self.room} contacts an environment are too few for {self.job.scene}: raise GENEROUS")
        self.room = max(self.fullest, COLOURS if self.job.settings["backend"] == "lox" else 1)
        super().settle()

    def info(self) -> dict[str, Any]:
        """LOX stops simulating an environment whose solution is not finite, which would count as fast."""
        info, status = super().info(), self.engine.status.numpy()
        failed = int(status["failed"].sum()) if "failed" in status.dtype.names else 0
        return info | {"contacts_per_env": self.room, "failed": failed, "overflow": info["overflow"] or failed > 0}


if __name__ == "__main__":
    protocol.serve(NewtonKamino, ("newton", "warp-lang"))
