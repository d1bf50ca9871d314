# SPDX-License-Identifier: Apache-2.0
"""MuJoCo Warp on the CPU: one step captured in a CPU graph, launched once a step."""

from __future__ import annotations

from typing import Any

import mjcf
import mujoco
import mujoco_states
import mujoco_warp as mjw
import numpy as np
import protocol
import warp as wp

GENEROUS = 16  # contacts for each body in the run that finds how many are needed
BENIGN = mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS  # limits of the solver, not of the memory


class MuJoCoWarp(protocol.Engine):
    """Steps with just the contacts and rows that the scene takes; they are counted in an untimed run first."""

    def __init__(self, job: protocol.Job):
        wp.set_device("cpu")
        self.job, self.spec = job, mujoco.MjModel.from_xml_string(mjcf.model(job))
        self.model = mjw.put_model(self.spec)
        self.qpos, self.qvel = mujoco_states.start(job)
        self.applied = np.zeros((job.envs, len(job.mass) + 1, 6))  # the world first
        self.applied[:, 1:] = job.wrench
        bodies = len(job.mass)
        self.candidates = self.rows = 0
        self.allocate(job.envs * bodies * GENEROUS, 4 * bodies * GENEROUS)

    def allocate(self, contacts: int, rows: int) -> None:
        """Data with room for this many contacts in all environments together and rows in each, and the graph of its step."""
        self.capacity = {"naconmax": contacts, "njmax": rows}
        self.data = mjw.make_data(self.spec, self.job.envs, **self.capacity)
        self.reset()
        mjw.step(self.model, self.data)  # loads the kernels, which a capture cannot
        with wp.ScopedCapture(device="cpu") as capture:
            mjw.step(self.model, self.data)
        self.graph = capture.graph
        self.reset()

    def reset(self) -> None:
        """reset_data clears the warm start too, but not the velocities of the last step, which the rows of loops look at."""
        mjw.reset_data(self.model, self.data)
        self.data.cvel.zero_()
        self.data.cdof_dot.zero_()
        self.data.qpos.assign(self.qpos)
        self.data.qvel.assign(self.qvel)
        self.data.xfrc_applied.assign(self.applied)

    def run(self, steps: int) -> None:
        """The CPU's launches are synchronous."""
        for _ in range(steps):
            wp.capture_launch(self.graph)

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Read back."""
        return mujoco_states.bodies(self.job, self.spec, self.data.qpos.numpy().astype(float), self.data.qvel.numpy().astype(float))

    def contacts(self) -> float:
        """Counts candidates and rows as well: pairs to look at share the contacts' memory."""
        contacts = int(self.data.nacon.numpy()[0])
        self.candidates = max(self.candidates, contacts, int(self.data.ncollision.numpy()[0]))
        self.rows = max(self.rows, int(self.data.nefc.numpy().max()))
        return contacts / self.job.envs

    def settle(self) -> None:
        """Just what was needed at most."""
        if self.info()["overflow"]:
            raise RuntimeError(f"{self.capacity} are too few for {self.job.scene}: raise GENEROUS")
        self.allocate(max(self.candidates, 1), max(self.rows, 1))

    def info(self) -> dict[str, Any]:
        """Overflow of memory in any environment since the reset, and how many ran into the solver's limits."""
        flags = self.data.overflow.numpy()
        limits = int(np.count_nonzero(flags & int(BENIGN)))
        return self.capacity | {"overflow": bool(np.any(flags & ~int(BENIGN))), "envs_at_solver_limit": limits}


if __name__ == "__main__":
    protocol.serve(MuJoCoWarp, ("mujoco-warp", "mujoco", "warp-lang"))
