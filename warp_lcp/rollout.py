# SPDX-License-Identifier: Apache-2.0
"""Many steps in one go, with their states recorded on the device."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .errors import WarpLcpError, whole_number
from .kernels import record as recording

if TYPE_CHECKING:
    from .simulator import Simulator

#: What may drive the joints in each step, names of Control's fields.
CONTROLS = ("position", "velocity", "force")
#: What a rollout can record.
FIELDS = ("q", "v", "body_pose", "body_velocity", "status", "iterations", "residual", "residual_energy")


@dataclass(frozen=True)
class Rollout:
    """What Simulator.rollout recorded: T rows, E environments, B bodies; None is what was not asked for.

    Row i is the state after step (i + 1) * every; the state that the rollout started from has no row. The arrays are
    contiguous, on the simulator's device, and belong to whoever called: no later rollout writes into them. Work on them in
    the same CUDA stream, or synchronise first; DLPack (torch.from_dlpack, np.from_dlpack, jax) takes them without a copy.

    Attributes:
        time: [T] numpy, simulated seconds.
        q, v: [T, E, nq], [T, E, nv].
        body_pose: [T, E, B] transform (x y z qx qy qz qw) of the body frames, world.
        body_velocity: [T, E, B] spatial vector (velocity of the centre of mass [m/s], angular velocity [rad/s]), world axes.
        status: [T, E] Status bits, or-ed over the steps since the row before.
        iterations: [T, E] solves, pivots or sweeps, summed over the steps since the row before.
        residual: [T, E] m/s, of the row's step.
        residual_energy: [T, E] J, of the row's step.
    """

    time: np.ndarray
    q: wp.array | None = None
    v: wp.array | None = None
    body_pose: wp.array | None = None
    body_velocity: wp.array | None = None
    status: wp.array | None = None
    iterations: wp.array | None = None
    residual: wp.array | None = None
    residual_energy: wp.array | None = None


class Recorder:
    """What the rollouts of one Simulator share: kernels, the step counters and the tape that its captured step looks at."""

    def __init__(self, sim: Simulator):
        self.sim = sim
        self.kernels = k = recording.make(sim.real)
        self.add_seen = recording.make_sum()
        # Threads that share a row; on the CPU, where a row is contiguous, one walks over it.
        self.columns = 1 if sim.device.is_cpu else max(sim.model.nq, sim.model.nv, sim.model.num_bodies)
        self.step = wp.zeros((sim.num_envs, self.columns), dtype=int, device=sim.device)
        self.tape = wp.zeros(1, dtype=k.Tape, device=sim.device)
        self.seen_status, self.seen_iterations = (wp.zeros(sim.num_envs, dtype=int, device=sim.device) for _ in range(2))
        sim._load([k.apply_wrench, k.record_row, self.add_seen, *([k.apply_control] if sim.model.articulated else [])])

    def run(self, steps: int, wrench: Any, record: Any, every: int, control: Mapping[str, Any] | None) -> Rollout:
        """See Simulator.rollout."""
        sim, k = self.sim, self.kernels
        steps, every = whole_number("rollout: steps", steps, 1), whole_number("rollout: every", every, 1)
        if every > steps:
            raise WarpLcpError(f"rollout: every is {every}, more than the {steps} steps: no row would be recorded")
        if not isinstance(record, Iterable):
            raise WarpLcpError(f"rollout: record is {record!r}; give names out of {', '.join(FIELDS)}")
        names = (record,) if isinstance(record, str) else tuple(record)
        for name in names:
            if name not in FIELDS:
                raise WarpLcpError(f"rollout: record holds {name!r}; choose from {', '.join(FIELDS)}")
        sources = {} if wrench is None else {"wrench": self._source("wrench", wrench, steps, sim.model.num_bodies, sim._types.spatial)}
        sources |= self._controls(control, steps)

        rows = steps // every
        arrays = {name: self._empty(name, rows) for name in dict.fromkeys(names)}
        tape = k.Tape()
        tape.every = every
        for name, array in arrays.items():
            setattr(tape, name, array)
        for name, array in sources.items():
            setattr(tape, name, array)
        self.tape.assign(wp.array([tape], dtype=k.Tape, device="cpu"))
        for zeroed in (self.step, self.seen_status, self.seen_iterations, sim.status, sim.iterations):
            zeroed.zero_()

        before: list[Callable[[], None]] = [self._push] if wrench is not None else []
        before += [self._drive] if control else []
        after: list[Callable[[], None]] = [sim._refresh_bodies] if {"body_pose", "body_velocity"} & set(names) else []
        graph = sim._captured(" ".join(["rollout", *(f.__name__ for f in (*before, *after))]), lambda: self._step(before, after))
        for _ in range(steps):
            wp.capture_launch(graph)
        sim._refresh_bodies()
        sim._launch(self.add_seen, sim.num_envs, [self.seen_status, self.seen_iterations, sim.status, sim.iterations])
        time = sim.time + sim.dt * every * np.arange(1, rows + 1)
        sim._finish(steps)
        return Rollout(time, **arrays)

    def _push(self) -> None:
        self.sim.launch(self.kernels.apply_wrench, [self.tape, self.step, self.sim.wrench], self.sim.model.num_bodies)

    def _drive(self) -> None:
        control: Any = self.sim.control
        inputs = [self.tape, self.step, control.position, control.velocity, control.force]
        self.sim.launch(self.kernels.apply_control, inputs, self.sim.model.nv)

    def _step(self, before: list[Callable[[], None]], after: list[Callable[[], None]]) -> None:
        sim = self.sim
        for launch in before:
            launch()
        sim._step_kernels()
        for launch in after:
            launch()
        state = [sim.q, sim.v, sim.bodies, sim.status, sim.iterations, sim.residual, sim.residual_energy]
        seen = [self.seen_status, self.seen_iterations]
        sim.launch(self.kernels.record_row, [self.tape, self.step, *state, *seen, self.columns], self.columns)

    def _empty(self, name: str, rows: int) -> wp.array:
        sim, t = self.sim, self.sim._types
        widths = {"q": sim.model.nq, "v": sim.model.nv, "body_pose": sim.model.num_bodies, "body_velocity": sim.model.num_bodies}
        kinds = {"body_pose": t.transform, "body_velocity": t.spatial, "status": int, "iterations": int}
        shape = (rows, sim.num_envs, widths[name]) if name in widths else (rows, sim.num_envs)
        return wp.empty(shape, dtype=kinds.get(name, sim.real), device=sim.device)

    def _controls(self, control: Mapping[str, Any] | None, steps: int) -> dict[str, wp.array]:
        """Targets and forces of all steps on the device, by Control's fields."""
        if not control:
            return {}
        given = list(control) if isinstance(control, Mapping) else [f"no dict but a {type(control).__name__}"]
        unknown = [str(name) for name in given if name not in CONTROLS]
        if unknown:
            raise WarpLcpError(f"rollout: control has {', '.join(unknown)}; give a dict with some of {', '.join(CONTROLS)}")
        if self.sim.control is None:
            raise WarpLcpError("rollout: control drives joints, and the model has none; give wrench")
        return {name: self._source(name, value, steps, self.sim.model.nv, self.sim.real) for name, value in control.items()}

    def _source(self, name: str, value: Any, steps: int, width: int, dtype: Any) -> wp.array:
        """What is applied in all steps, on the device: [steps, 1|E, width]."""
        sim, inner = self.sim, (6,) if name == "wrench" else ()
        allowed = [(steps, sim.num_envs, width), (steps, 1, width)]
        if isinstance(value, wp.array):
            if value.dtype is not dtype or value.shape not in allowed or value.device != sim.device:
                raise WarpLcpError(
                    f"rollout: {name} is {value.shape} of {value.dtype.__name__} on {value.device}; "
                    f"give {allowed[0]} or {allowed[1]} of {dtype.__name__} on {sim.device}"
                )
            return value
        try:
            values = np.asarray(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise WarpLcpError(f"rollout: {name} is no array of numbers: {error}") from error
        if values.shape not in [(*shape, *inner) for shape in allowed]:
            raise WarpLcpError(f"rollout: {name} has shape {values.shape}; give {(*allowed[0], *inner)} or {(*allowed[1], *inner)}")
        return sim._constant(values, dtype)
