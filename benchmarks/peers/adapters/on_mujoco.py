# SPDX-License-Identifier: Apache-2.0
"""MuJoCo in C: mujoco.rollout on the calling thread, which loops over environments and steps without Python."""

from __future__ import annotations

from typing import Any

import mjcf
import mujoco
import numpy as np
import protocol
from mujoco import rollout

SAMPLES = 4000  # states of the trajectories in which contacts are counted


class MuJoCo:
    """One MjModel and MjData; the environments go through it one after another."""

    def __init__(self, job: protocol.Job):
        self.job = job
        self.model = mujoco.MjModel.from_xml_string(mjcf.model(job))
        self.data = mujoco.MjData(self.model)
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        assert size == 1 + self.model.nq + self.model.nv, "a state is time, qpos, qvel"
        self.start = np.concatenate([np.zeros((job.envs, 1)), *mjcf.to_mujoco(job.pose, job.velocity)], axis=1)
        self.states = np.zeros((job.envs, job.steps, size))
        self.pool = rollout.Rollout(nthread=0)
        self.reset()

    def reset(self) -> None:
        """A rollout starts from self.start and clears the warm start itself."""
        self.last = self.start

    def run(self) -> None:
        """All steps of all environments in one call."""
        self.pool.rollout(self.model, [self.data], self.start, nstep=self.job.steps, state=self.states)
        self.last = self.states[:, -1]

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """The last state of the trajectories."""
        return mjcf.from_mujoco(self.last[:, 1 : 1 + self.model.nq], self.last[:, 1 + self.model.nq :])

    def record(self) -> tuple[np.ndarray, np.ndarray, float]:
        """The trajectories hold the heights; contacts are counted in some of their states."""
        self.run()
        flat = self.states.reshape(-1, self.states.shape[-1])
        contacts = []
        for state in flat[:: max(1, len(flat) // SAMPLES)]:
            mujoco.mj_setState(self.model, self.data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
            mujoco.mj_fwdPosition(self.model, self.data)
            contacts.append(self.data.ncon)
        return self.state()[0], self.states[:, :, 3 : 1 + self.model.nq : 7].max(axis=1), float(np.mean(contacts))

    def info(self) -> dict[str, Any]:
        """Overflow: a rollout stops an environment's clock at any of MuJoCo's warnings (memory full, bad numbers)."""
        stopped = ~np.isclose(self.states[:, -1, 0], self.job.steps * self.model.opt.timestep)
        return {"overflow": bool(stopped.any()), "stopped_envs": int(np.count_nonzero(stopped))}


if __name__ == "__main__":
    protocol.serve(MuJoCo, ("mujoco",))
