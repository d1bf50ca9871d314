# SPDX-License-Identifier: Apache-2.0
"""Newton's Steel on the CPU. Settings: arguments of its solver that differ from the defaults. It keeps the displacement of its
friction patches from step to step, which its reset forgets."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import protocol
from newton_engine import GENEROUS, NewtonEngine

ROWS = 5  # for a contact: its normal and, where it stands alone, two friction anchors of two directions


class NewtonSteel(NewtonEngine):
    """Reduced coordinates: a free joint's are the pose of its body and the velocity of the centre of mass."""

    knows = frozenset({"force", "damping"})  # and dry friction on CUDA alone

    def __init__(self, job: protocol.Job):
        self.rows = 0  # of an environment; 0: not known yet
        super().__init__(job)

    def register(self, builder: newton.ModelBuilder) -> None:
        """Attributes of bodies, for their damping."""
        newton.solvers.SolverSteel.register_custom_attributes(builder)

    def add(self, world: newton.ModelBuilder, **body: Any) -> None:
        """No damping: by default a body loses 5 % of its angular velocity in a second, which no scene asks for."""
        world.add_body(custom_attributes={"steel:rigid_body_angular_damping": 0.0}, **body)

    def link(self, world: newton.ModelBuilder, **body: Any) -> None:
        """Likewise."""
        world.add_link(custom_attributes={"steel:rigid_body_angular_damping": 0.0}, **body)

    def solver(self) -> newton.solvers.SolverBase:
        """With room for rows: plenty in the untimed run, which counts them, then what that one needed."""
        rows = self.rows or ROWS * GENEROUS * max(len(self.job.mass), 1)
        options = {"free_body_constraint_max": rows}
        if self.job.tree is not None:
            options |= {"articulation_constraint_max": rows, "enable_joint_limits": True}
            if (self.job.tree.drive[:, 0:2].any(axis=1) & np.isfinite(self.job.tree.drive[:, 2])).any():
                options["drive_mode"] = "rows"  # by default, a part of a drive's force is not limited
        return newton.solvers.SolverSteel(self.model, row_watermark=self.rows == 0, **options, **self.job.settings)

    def reset(self) -> None:
        """The joints' coordinates too."""
        super().reset()
        if self.job.tree is None:
            self.states[0].joint_q.assign(self.job.pose.reshape(-1))
            self.states[0].joint_qd.assign(self.job.velocity.reshape(-1))
        self.engine.reset(self.states[0])

    def settle(self) -> None:
        """As many rows as the fullest environment had."""
        found = self.engine.constraint_row_watermarks()
        self.rows = max(1, *(found[f"{family}_raw_high_water"] for family in ("free_body", "articulation")))
        super().settle()

    def info(self) -> dict[str, Any]:
        """The solver's own flags say whether it dropped rows since the reset."""
        info = super().info()
        return info | {"rows": self.rows, "overflow": info["overflow"] or bool(self.engine.constraint_overflow.numpy().any())}


if __name__ == "__main__":
    protocol.serve(NewtonSteel, ("newton", "warp-lang"))
