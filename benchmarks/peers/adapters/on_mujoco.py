# SPDX-License-Identifier: Apache-2.0
"""MuJoCo in C: mujoco.rollout on the calling thread, which loops over environments and steps without Python."""

from __future__ import annotations

from typing import Any

import mjcf
import mujoco
import mujoco_states
import numpy as np
import protocol
from mujoco import rollout

COUNTED = 4000  # states of the trajectories in which contacts are counted
FULL, APPLIED = mujoco.mjtState.mjSTATE_FULLPHYSICS, mujoco.mjtState.mjSTATE_XFRC_APPLIED


class MuJoCo(protocol.Engine):
    """One MjModel and MjData; the environments go through it one after another."""

    def __init__(self, job: protocol.Job):
        self.job = job
        self.model = mujoco.MjModel.from_xml_string(mjcf.model(job))
        self.data = mujoco.MjData(self.model)
        size = mujoco.mj_stateSize(self.model, FULL)
        assert size == 1 + self.model.nq + self.model.nv, "a state is time, qpos, qvel"
        self.start = np.concatenate([np.zeros((job.envs, 1)), *mujoco_states.start(job)], axis=1)
        self.pool = rollout.Rollout(nthread=0)
        self.control: dict[str, Any] = {}
        if job.wrench.any():
            applied = np.concatenate([np.zeros(6), job.wrench.ravel()])  # the world first
            self.control = {"control": np.tile(applied, (1, job.steps, 1)), "control_spec": int(APPLIED)}
        self.reset()

    def reset(self) -> None:
        """A rollout starts from self.start and clears the warm start itself."""
        self.last = self.start

    def run(self, steps: int) -> None:
        """All steps of all environments in one call."""
        assert steps == self.job.steps, "a rollout forgets the warm start of the one before"
        self.states, _ = self.pool.rollout(self.model, [self.data], self.start, nstep=steps, **self.control)
        self.last = self.states[:, -1]

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """The last state of the trajectories."""
        return self.unpacked(self.last)

    def unpacked(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of states [..., 1 + nq + nv]."""
        return mujoco_states.bodies(self.job, self.model, states[..., 1 : 1 + self.model.nq], states[..., 1 + self.model.nq :])

    def contacts(self) -> float:
        """Counted in some of the states of the trajectories."""
        flat, found = self.states.reshape(-1, self.states.shape[-1]), []
        for state in flat[:: max(1, len(flat) // COUNTED)]:
            mujoco.mj_setState(self.model, self.data, state, FULL)
            mujoco.mj_fwdPosition(self.model, self.data)
            found.append(self.data.ncon)
        return float(np.mean(found))

    def record(self) -> dict[str, Any]:
        """The trajectories hold every step."""
        self.run(self.job.steps)
        every, path = self.job.every, np.concatenate([self.start[:, None], self.states], axis=1)
        samples = [self.unpacked(path[:, i]) for i in range(0, self.job.steps + 1, every)]
        before = [self.unpacked(path[:, i - 1]) for i in range(every, self.job.steps + 1, every)]
        return self.result(samples, before, self.contacts())

    def info(self) -> dict[str, Any]:
        """Overflow: a rollout stops an environment's clock at any of MuJoCo's warnings (memory full, bad numbers)."""
        stopped = ~np.isclose(self.states[:, -1, 0], self.job.steps * self.model.opt.timestep)
        return {"overflow": bool(stopped.any()), "stopped_envs": int(np.count_nonzero(stopped))}


if __name__ == "__main__":
    protocol.serve(MuJoCo, ("mujoco",))
