# SPDX-License-Identifier: Apache-2.0
"""The Simulator: many environments of one Model, advanced together."""

from __future__ import annotations

import enum
import gc
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from . import articulation, hulls, joints, parameters
from .arrays import check_finite, read
from .errors import SimulationError, WarpLcpError, positive_number, whole_number
from .kernels import (
    articulated,
    contacts,
    projection,
    restitution,
    tree,
)
from .kernels.types import scalar_types
from .laws import Law
from .loading import Loading
from .methods import METHODS, chosen
from .model import Model, ShapeType
from .rollout import CONTROLS, Recorder, Rollout
from .stages import PRECISIONS, stage_kernels

INTEGRATORS = ("euler", "midpoint")
#: Largest residual [m/s] of an answer that counts as solved.
TOLERANCE = 1e-6


class Status(enum.IntFlag):
    """Bits of an environment's status word; OK is zero."""

    OK = 0
    ITERATION_LIMIT = 1  #: the method stopped before it was done
    RAY = 2  #: Lemke's method ended on a ray
    NOT_A_NUMBER = 4  #: the state holds a NaN or an infinity
    OVERFLOW = 8  #: more contacts than Model.max_contacts; those that came last were dropped
    UNCERTIFIED = 16  #: the answer's residual exceeds 1e-6 m/s; it was applied all the same
    RESTITUTION_REDUCED = 32  #: nothing failed: an impact gave back less than e, for all of it would have raised the energy


#: Status bits that say something about an answer and nothing against it.
INFORMATIVE = Status.RESTITUTION_REDUCED


@dataclass(frozen=True)
class Contacts:
    """Contacts of the last step, at its start position (with joints and integrator 'midpoint' half a step later).

    E environments, R = Model.max_contacts, and room for the rows of joints.

    Entries from ``count`` on are stale, or rows of joints.

    Attributes:
        count: [E] contacts in each environment.
        bodies: [E, R] vec2i, bodies a and b; -1 = the world.
        slot: [E, R] which point of which pair; its shapes are ``Model.slot_shapes[slot]``. (Of rows of joints it is negative.)
        point: [E, R] vec3, world, half-way across the gap, m.
        gap: [E, R] phi, m.
        frame: [E, R] mat33, rows n (from a to b), t1, t2 in world axes.
        impulse: [E, R] vec3 on b, along n, t1, t2, N s.
        velocity: [E, R] vec3 of b relative to a at the end of the step, along n, t1, t2, m/s.
        state: [E, R] 0 open, 1 stick, 2 slide.
    """

    count: wp.array
    bodies: wp.array
    point: wp.array
    gap: wp.array
    frame: wp.array
    impulse: wp.array
    velocity: wp.array
    state: wp.array
    slot: wp.array


@dataclass(frozen=True)
class Control:
    """What drives the joints, writable on the device; stays until changed. E environments, by velocity, as ``v``.

    Arrays of Warp, whose ``assign`` fills them from their beginning with as many numbers as it is given, whatever their shape;
    :meth:`Simulator.set_control` checks shapes and numbers.

    Attributes:
        position: [E, nv] m or rad, target of each drive; not looked at where a velocity has no drive.
        velocity: [E, nv] m/s or rad/s, its target velocity.
        force: [E, nv] N or N m, applied to each joint, on top of what drives do.
    """

    position: wp.array
    velocity: wp.array
    force: wp.array


class Simulator:
    """N environments of one Model.

    Args:
        model: the scene.
        num_envs: number of environments E.
        dt: step size h [s].
        formulation: contact law, see docs/theory.md: 'phantom_inertia', 'anitescu_potra', 'box', 'hybrid' or 'coulomb' (the exact cone).
        method: how the contact problem is solved: 'velocity_pivoting', 'proximal_newton', 'pgs', 'lemke', 'murty', 'judice_pires', or
            'auto': velocity pivoting where the law has axes (not in float32), then the proximal Newton method, then pgs (not where both
            come before it and the model has joints), each for the environments that are not solved by then.
        sliding: how 'phantom_inertia' slides: 'regularized' (eqs. 34 and 43), 'aligned' (eq. 34) or 'facets' (fixed axes
            throughout). The other laws do not ask: 'hybrid' is regularized, 'anitescu_potra' and 'box' have facets, 'coulomb' the cone.
        directions: k, friction directions of a sticking contact (with facets, of a sliding one too), at least 2; 'coulomb' has none.
        rho_scale: alpha of the phantom inertia rho_j = alpha (E^T A^-1 E)_jj; any positive number gives the same motion.
        precision: 'float64' or 'float32', of state and solution.
        integrator: 'euler', q+ = q + h Gamma v+ (eq. 23), or 'midpoint', q+ = q + h Gamma (v + v+) / 2 but for bodies that
            this would drive into others, with joints half before the forces of the step and half after: second order away from
            impacts, where neither damping nor drives act. A v that is set may then close a gap by h v / 2 once.
        device: Warp device; None = Warp's default.
        project_loops: bring joints that close loops back together after each step (not with 'midpoint'). Without it they are apart by
            what a step opens them, of second order in dt, which does not grow.
        strict: raise after a step in which an environment's status is not OK (reads the status back every time);
            RESTITUTION_REDUCED alone does not count.

    Attributes:
        q, v: [E, nq], [E, nv] state, writable in place.
        q0, v0: the state that :meth:`reset` copies back, writable.
        wrench: [E, B] spatial vector, force [N] and torque [N m] at the centre of mass, world axes; stays until changed.
        control: :class:`Control` of the joints; None in a model without.
        status: [E] :class:`Status` bits of the last step() or rollout() call, or-ed over its steps.
        residual: [E] m/s, largest violation of the law that was solved, of the last step.
        residual_energy: [E] J, unit-consistent energy error of the last step.
        iterations: [E] solves, pivots or sweeps of the last step() or rollout() call, summed over its steps.
        time: simulated seconds. last_count: steps of the last step() or rollout() call.

    Raises:
        WarpLcpError: for an argument outside its range.
    """

    def __init__(
        self,
        model: Model,
        num_envs: int = 1,
        dt: float = 1e-3,
        formulation: str = "phantom_inertia",
        method: str = "auto",
        *,
        sliding: str = "regularized",
        directions: int = 2,
        rho_scale: float = 1.0,
        precision: str = "float64",
        integrator: str = "euler",
        device: Any = None,
        strict: bool = False,
        project_loops: bool = False,
    ):
        self.law = Law(formulation, sliding, directions)
        _choice("method", method, tuple(METHODS))
        _choice("precision", precision, tuple(PRECISIONS))
        _choice("integrator", integrator, INTEGRATORS)
        self.model, self.num_envs, self.dt = model, whole_number("num_envs", num_envs, 1), positive_number("dt", dt, "s")
        self.formulation, self.method, self.sliding, self.precision = formulation, method, sliding, precision
        self.integrator = integrator
        self._averages = integrator == "midpoint" and not model.articulated  # with joints it is Euler's rule between half-way poses
        self.project_loops = bool(project_loops) and any(loop.distance is None for loop in model.loops)
        if self.project_loops and integrator == "midpoint":
            raise WarpLcpError("project_loops is for integrator 'euler': with joints 'midpoint' closes loops half a step ahead")
        self.directions, self.rho_scale, self.strict = self.law.directions, positive_number("rho_scale", rho_scale), bool(strict)
        self.device = wp.get_device(device)
        self.real, self._numpy_real = PRECISIONS[precision]
        self.tolerance = TOLERANCE
        self.sign_tolerance = 1e-12 if self.real is wp.float64 else 1e-6
        self.rounding = 2.0**-50 if self.real is wp.float64 else 2.0**-21  # what a gap is known to, as a part of a coordinate
        self._types = scalar_types(self.real)
        self.trees: Any = None  # of a model without joints only once somebody asks for M or c
        self._allocate()
        self._load_kernels()
        self._graphs: dict[str, Any] = {}
        self._combine_pairs()
        self.bounces: Any = None
        self._set_restitution(model.restitution[None])
        self._recorder: Recorder | None = None
        self.time = 0.0
        self.last_count = 0

    # ---------------------------------------------------------------------------------------------------- stepping

    def step(self, count: int = 1) -> None:
        """Advance every environment by ``count`` steps (0 only prepares, and waits until every kernel is compiled).

        On the CPU the first steps wait for the kernels that they need alone, while others still compile. (Interrupted there, or where a
        kernel does not compile, a step is left half done: reset.)
        """
        count = whole_number("step: count", count, 0)
        self.status.zero_()
        self.iterations.zero_()
        left = count
        while left and self._loading and self.device.is_cpu and not self.device.is_capturing:
            left -= 1
            (self._step_kernels if left else self._last_step)()
            self._loading.forget_loaded()
        if left > 1 or not count:
            graph = self._captured("step", self._step_kernels)
            for _ in range(left - 1):
                wp.capture_launch(graph)
        if left or not count:
            graph = self._captured("last step", self._last_step)
            if left:
                wp.capture_launch(graph)
        self._finish(count)

    def rollout(
        self,
        steps: int,
        wrench: Any = None,
        record: Sequence[str] = ("q", "v", "status"),
        every: int = 1,
        control: Mapping[str, Any] | None = None,
    ) -> Rollout:
        """Advance every environment by ``steps`` steps and record them on the device, without waiting for it.

        The same bits as as many step() calls, each after writing its wrench into :attr:`wrench` and its controls into :attr:`control`,
        where the last ones stay. The step is captured once for all rollouts, once more for those that record bodies; arrays are new each
        time. Status and iterations of the simulator are afterwards those of all steps, as after step(steps).

        Args:
            steps: number of steps, at least 1.
            wrench: None: what :attr:`wrench` holds, throughout. Or one for each step, [steps, num_envs, B] or [steps, 1, B]
                (the same for all environments): a Warp array of spatial vectors of the simulator's precision on its
                device, or numbers [..., 6]; force [N] and torque [N m] at the centre of mass, world axes.
            record: what to record, names of :class:`Rollout`'s fields (or one name alone).
            every: steps to a row, at least 1; steps // every rows. What is left over is stepped, not recorded.
            control: None: what :attr:`control` holds, throughout. Or a dict with some of "position", "velocity" and "force", each for
                every step, [steps, num_envs, nv] or [steps, 1, nv], an array as for ``wrench``; what is not in it stays.

        Raises:
            WarpLcpError: for an argument outside its range.
            SimulationError: if strict, after a rollout in which an environment's status was not OK.
        """
        if self._recorder is None:
            self._recorder = Recorder(self)
        return self._recorder.run(steps, wrench, record, every, control)

    def _finish(self, count: int) -> None:
        self.time += count * self.dt
        self.last_count = count
        if self.strict:
            self._raise_for_status()

    def reset(self, mask: Any = None) -> None:
        """Copy q0, v0 back and clear every hidden buffer (contact history, applied wrenches, status); drives have the model's targets.

        Args:
            mask: [E] bool, environments to reset, numpy or Warp; None = all.
        """
        if mask is None:
            mask = np.ones(self.num_envs, dtype=bool)
        if not isinstance(mask, wp.array):
            mask = np.asarray(mask, dtype=bool)
            if mask.shape != (self.num_envs,):
                raise WarpLcpError(f"reset: mask has shape {mask.shape}; give ({self.num_envs},), one bool an environment")
            mask = wp.array(mask, dtype=wp.bool, device=self.device)
        elif mask.shape != (self.num_envs,) or mask.dtype is not wp.bool:
            raise WarpLcpError(f"reset: mask is {mask.shape} of {mask.dtype.__name__}; give ({self.num_envs},) of wp.bool")
        inputs = [mask, self.q0, self.v0, self.q, self.v, self.wrench, self.bodies, self.rows, self.slots]
        inputs += [self.residual, self.residual_energy, self.iterations, self.status]
        self._launch(self._kernels.reset, self.num_envs, inputs)
        if self.model.articulated:
            self._launch(self._kernels.reset_control, self.num_envs, [mask, *self._targets, self.mechanics])

    # ------------------------------------------------------------------------------------------- parameters and views

    def set_parameters(self, **values: Any) -> None:
        """Change physical parameters, for all environments alike or one by one; nothing is recompiled.

        Each value has the shape of the Model's field, or that with num_envs in front: ``mass`` [B], ``inertia``
        [B, 3, 3] about the centre of mass in body axes, ``com`` [B, 3], ``friction`` [S, 2] (static, dynamic),
        ``contact`` [S, 5] (k_n, b_n, k_t, b_t, v_s; NaN = Table 1 scaled with the mass), ``restitution`` [S], ``gravity``
        [3]; of joints ``armature`` [nv], ``damping`` [nv], ``joint_friction`` [nv] and ``gains`` [nv, 3] (stiffness, damping and greatest
        force of the drives). SI units.

        What follows from a parameter follows at once: inverse masses, the scaling of Table 1, the coefficients of a
        pair. ``mass`` without ``inertia`` is a body of the same shape and another density: its inertia scales along. What is a part of a
        body (``Model.part_of``) has a mass, centre and inertia of its own: the body has the sum.
        Where no pair of the model bounces, the first that does loads the kernels that it needs.

        Raises:
            WarpLcpError: for an unknown name, a wrong shape, or a number that no body or contact can have.
        """
        checked = {name: parameters.checked(self.model, self.num_envs, name, value) for name, value in values.items()}
        if "mass" in checked and "inertia" not in checked:
            inertia, mass = self.parameters.inertia.numpy(), self.parameters.mass.numpy()
            checked["inertia"] = inertia * (checked["mass"] / np.where(mass > 0.0, mass, 1.0))[..., None, None]
        if "restitution" in checked:
            self._set_restitution(checked.pop("restitution"))
        for name, value in checked.items():
            if name in parameters.OF_JOINTS:
                for field, numbers in parameters.of_joints(self.model, name, value):
                    self._set_constant(self.mechanics, field, numbers)
            else:
                self._set_constant(self.parameters, name, value)
        self._combine_pairs()

    def set_control(self, **values: Any) -> None:
        """Write ``position``, ``velocity`` or ``force`` of :attr:`control` for all environments.

        Each is [nv], the same for all, or [num_envs, nv], by velocity (:meth:`Model.velocities` says where a joint's are); a number stands
        for all of them. SI units. Without a copy over the host: write the arrays of :attr:`control`.

        Raises:
            WarpLcpError: for an unknown name, a wrong shape, a number that is not finite, or a model without joints.
        """
        if self.control is None:
            raise WarpLcpError("set_control: drives are on joints, and the model has none; write wrench")
        shape = (self.num_envs, self.model.nv)
        checked = {}
        for name, value in values.items():
            if name not in CONTROLS:
                raise WarpLcpError(f"set_control: {name!r} is nothing of it; choose from {', '.join(CONTROLS)}")
            numbers = read("set_control", name, value)
            numbers = np.asarray(numbers.numpy() if isinstance(numbers, wp.array) else numbers, dtype=self._numpy_real)
            if numbers.shape not in ((), shape[1:], (1, *shape[1:]), shape):
                raise WarpLcpError(f"set_control: {name} has shape {numbers.shape}; give {shape[1:]} or {shape}")
            check_finite("set_control", name, numbers)
            checked[name] = np.broadcast_to(numbers, shape)
        for name, numbers in checked.items():
            getattr(self.control, name).assign(numbers)

    def _combine_pairs(self) -> None:
        """Friction and contact parameters of the pairs, from those of their shapes and bodies."""
        p, t, pairs = self.parameters, self._types, len(self.model.pairs)
        rows = {"pair_friction": p.friction.shape[0], "pair_contact": max(p.mass.shape[0], p.contact.shape[0])}
        for name, dtype in (("pair_friction", t.vec2), ("pair_contact", t.vec5)):
            present = getattr(p, name)
            if present is None or present.shape != (rows[name], pairs):
                setattr(p, name, wp.empty((rows[name], pairs), dtype=dtype, device=self.device))
                self._graphs.clear()
        inputs = [self.topology, p, self.ints(parameters.combine(self.model, 0))]
        self._launch(self._kernels.combine_pairs, (max(rows.values()), pairs), inputs)

    def _set_constant(self, bundle: Any, name: str, value: np.ndarray) -> None:
        present = getattr(bundle, name)
        if present.shape[0] == value.shape[0]:
            present.assign(value.astype(self._numpy_real))
        else:
            setattr(bundle, name, self._constant(value, present.dtype))
            self._graphs.clear()  # they hold the address of the old array

    def _set_restitution(self, value: np.ndarray) -> None:
        """[1|E, S] e of the shapes. While no pair has any, and never had, nothing of restitution exists."""
        if self.bounces is not None:
            self._set_constant(self.bounces, "coefficient", value)
        elif value[:, self.model.pairs].any():
            k = restitution.make(self.real)
            self._kernels.bounce, self._kernels.judge, self._kernels.settle = k.bounce, k.judge, k.settle
            bounces = self.bounces = k.Bounces()
            bounces.coefficient, bounces.combine = self._constant(value, self.real), self.ints(parameters.combine(self.model, 1))
            bounces.kick, bounces.before = (
                self._array(self.model.max_contacts, self.real),
                self._array(self.model.max_contacts, self._types.vec3),
            )
            layout = {self.real: ("theta", "slack", "allowed"), self._types.vec2: ("low", "high"), int: ("stage", "status", "todo")}
            for dtype, names in layout.items():
                for name in names:
                    setattr(bounces, name, wp.zeros(self.num_envs, dtype=dtype, device=self.device))
            bounces.again = wp.zeros(1, dtype=int, device=self.device)
            self._methods[0].take_rows()
            self._kernels.contact_rows = contacts.make(self.real, self.model.articulated).contact_rows
            self._load([k.bounce, k.judge, k.settle, self._kernels.contact_rows, self._methods[0].kernel])
            self._graphs.clear()

    @property
    def body_pose(self) -> wp.array:
        """[E, B] transform (x y z qx qy qz qw) of each body frame in the world, up to date with q when read."""
        self._refresh_bodies()
        return self.bodies.pose

    @property
    def body_velocity(self) -> wp.array:
        """[E, B] spatial vector (velocity of the centre of mass [m/s], angular velocity [rad/s]), world axes."""
        self._refresh_bodies()
        return self.bodies.velocity

    def loop_gaps(self) -> np.ndarray:
        """[E, L, 2] m and rad, how far the present q leaves each of ``Model.loops`` from closed; of a distance how far out of its range.

        Read back from the device. By some h^2 of what they do in motion; loops that cannot close stay open, whatever pulls at them.
        """
        poses = self.body_pose.numpy().astype(float)
        return np.stack([joints.apart(loop, poses) for loop in self.model.loops], axis=1) if self.model.loops else poses[:, :0, :2]

    def mass_matrix(self) -> wp.array:
        """[E, nv, nv] M(q) of the present q, with armature: M dv/dt + c = f (eq. 13), symmetric; velocities as in :class:`Model`.

        kg, kg m or kg m^2. Those of kinematic bodies are prescribed: their rows and columns are those of the identity.
        """
        return self._dynamics()[0]

    def bias(self) -> wp.array:
        """[E, nv] c(q, v) of the present state, N or N m: forces of Coriolis and of gyroscopes, less those of gravity.

        What joints would have to give for no velocity to change, without contacts, wrenches, damping and drives. Zero
        where velocities are prescribed.
        """
        return self._dynamics()[1]

    def _dynamics(self) -> tuple[wp.array, wp.array]:
        """M and c, by the functions of a step of trees, as which free bodies are looked at as well."""
        k, n = articulated.make(self.real), self.model.nv
        if self.trees is None:
            self.trees = articulation.arrays(self, tree.functions(self.real).Trees)
        self._load([k.kinematics, k.dynamics])
        scene = [self.topology, self.parameters, self.trees]
        mass, bias = wp.zeros((self.num_envs, n, n), dtype=self.real, device=self.device), self._array(n, self.real)
        self.launch(k.kinematics, [self.q, self.v, *scene, self.bodies, self._all])
        nothing = self._array(self.model.num_bodies, self._types.spatial)
        self.launch(k.dynamics, [*scene, nothing, self.v, self.bodies, mass, bias])
        return mass, bias

    def _refresh_bodies(self, some: wp.array | None = None) -> None:
        """Poses and velocities of bodies, from q and v; of environments with joints some [E], those of which it is not zero."""
        if self.model.articulated:
            state, some = [self.q, self.v, self.topology, self.parameters, self.mechanics, self.bodies], self._all if some is None else some
            self.launch(self._kernels.kinematics, [*state, some])
        else:
            self.launch(self._kernels.kinematics, [self.q, self.v, self.topology, self.bodies], self.model.num_bodies)

    @property
    def contacts(self) -> Contacts:
        """Contacts of the last step (views of the device arrays)."""
        r = self.rows
        touching = self.mechanics.touching if self.model.articulated and len(self.mechanics.row_kind) else r.count
        return Contacts(touching, r.body, r.point, r.gap, r.frame, r.impulse, r.velocity, r.state, r.slot)

    def _raise_for_status(self) -> None:
        status = self.status.numpy() & ~INFORMATIVE
        bad = np.flatnonzero(status)
        if len(bad):
            what = " | ".join(bit.name or "" for bit in Status if bit and status[bad[0]] & bit)
            raise SimulationError(
                f"{len(bad)} of {self.num_envs} environments are not OK at t = {self.time:.6g} s; first: environment {bad[0]}, "
                f"{what}, residual {self.residual.numpy()[bad[0]]:.3g} m/s"
            )

    def _step_kernels(self) -> None:
        """One step: kinematics, contacts, rows, solve, certify, integrate. Records no host read-back; there is one while kernels load.

        Behind it bodies are not where q and v are: _refresh_bodies.
        """
        k, h, b, scene = self._kernels, self.dt, self.model.num_bodies, [self.topology, self.parameters]
        halves = self.integrator == "midpoint" and not self._averages
        self._refresh_bodies()
        if halves:
            self.launch(k.drift, [self.topology, self.mechanics, self.bodies, 0.5 * h, self.q, self.v], b)
            self._refresh_bodies()
        if self.model.articulated:
            self.launch(k.free_motion, [*scene, self.mechanics, self.wrench, self.q, self.v, h, self.bodies])
        else:
            self.launch(k.free_motion, [*scene, self.wrench, h, self.bodies], b)
        if self.model.bounded:
            lanes = self.lanes(len(self.model.shape_body))
            self.launch(k.bounds, [self.topology, self._extent, self.bodies, h, lanes], lanes)
            pairs = [self.topology.pairs, self.topology.pair_slots, self._kind_pairs, self._plane_kinds]
            self.launch(k.list_pairs, [*pairs, self.bodies.bounds, self.slots.gap, self.slots.last_feature, self.listed])
        if self._loading:
            self._loading.finish([kernel for kind, (kernel, *_) in enumerate(self._pair_kernels) if self._near(kind)])
        for kind, (kernel, number, with_hulls) in enumerate(self._pair_kernels):
            if kernel in self._loading:
                continue  # none of its pairs is near
            more, lanes = [self.hulls] if with_hulls else [], self.lanes(number)
            self.launch(kernel, [*scene, self.bodies, self.listed, kind, h, self.slots, *more, lanes], lanes)
        self.reason.zero_()
        self.launch(k.select_contacts, [*scene, self.bodies, self.listed, self.slots, h, self.rows, self.status])
        if not self._methods[0].makes_rows and not self._idle(k.contact_rows, self.rows.count):
            lanes = self.lanes(self.model.max_contacts)
            self.launch(k.contact_rows, [*scene, self.mechanics, self.slots, h, *self.law.row_arguments, self.rows, lanes], lanes)
            if self.model.articulated and self.model.bodies_meet:
                self.launch(k.calm_overlaps, [self.mechanics, self.rows, lanes], lanes)
        if self.model.articulated and len(self.mechanics.row_kind):
            self.launch(k.joint_rows, [self.mechanics, self.bodies, self.q, self.v, h, self.rows])
        if self.bounces is not None:
            self.launch(k.bounce, [*scene, h, self.tolerance, int(self._averages), self.rows, self.bounces], self.model.max_contacts)
        self._solve_kernels(self.everyone, self.num_everyone, self.status)
        if self.bounces is not None:
            self._judge_kernels()
        if self.model.articulated:
            moving = [*scene, self.mechanics, self.bodies, self.next_velocity]
            self.launch(k.integrate, [*moving, h, 0.5 if halves else 1.0, self.q, self.v])
        elif self._averages:
            self.launch(k.guard, [self.parameters, self.bodies, self.rows, self.next_velocity, h, self.tolerance, self.rounding])
            self.launch(k.integrate_midpoint, [*scene, self.bodies, self.next_velocity, self.wrench, h, self.q, self.v], b)
        else:
            self.launch(k.integrate, [self.topology, self.bodies, self.next_velocity, h, self.q, self.v], b)
        if self.project_loops:
            self._refresh_bodies()
            loops = [*scene, self.mechanics, self.bodies, self.rows, *self._loop_system, self.q, self.v, h]
            for again in range(projection.ROUNDS + 1):
                self.launch(k.project, [*loops, again, self._apart])
                self._refresh_bodies()
        if self.model.articulated and not halves and not self._idle(k.judge_landing, self.mechanics.lands):
            if not self.project_loops:
                self._refresh_bodies(self.mechanics.lands)
            self.launch(k.judge_landing, [self.parameters, self.mechanics, self.bodies])
            if not self._idle(k.land, self.mechanics.lands):
                self.launch(k.land, [self.parameters, self.mechanics, self.bodies, h, self.v])

    def _last_step(self) -> None:
        """One step, and bodies where it has brought them."""
        self._step_kernels()
        self._refresh_bodies()

    def _solve_kernels(self, todo: wp.array, number: wp.array, status: wp.array) -> None:
        """The environments todo[:number] by the first method, those left by the next, and so on; each answer certified."""
        self.queued.zero_()
        self._solve_with(0, todo, number, status)

    def _solve_with(self, i: int, todo: wp.array, number: wp.array, status: wp.array) -> None:
        if self._methods[i].judges:
            self.num_doubtful.zero_()
        self._loading.finish([self._methods[i].kernel])
        self._methods[i].launch(self, todo, number)
        if self._methods[i].judges:
            self._where(self.num_doubtful, lambda: self._certify(i, self.doubtful, self.num_doubtful, status))
        else:
            self._certify(i, todo, number, status)

    def _certify(self, i: int, todo: wp.array, number: wp.array, status: wp.array) -> None:
        last = i + 1 == len(self._methods)
        left, number_left = (todo, number) if last else (self.queues[i], self.queued[i : i + 1])
        lists = [todo, number, left, number_left]
        answer = [*lists, self.unsolved, self.reason, self.best_residual, self.residual, self.residual_energy, status]
        problem = [self.mechanics, self.dt, self.tolerance, i, int(last), self.next_velocity, self.rows, self.slots]
        self.launch(self._kernels.certify, [*problem, *answer])
        if not last:
            self._where(number_left, lambda: self._solve_with(i + 1, left, number_left, status))

    def _where(self, number: wp.array, launches: Callable[[], None]) -> None:
        """Launches that are skipped on the device while number is zero; where a device cannot, each finds nothing to do."""
        if self.device.is_cpu or wp.is_conditional_graph_supported():
            wp.capture_if(number, launches)
        else:
            launches()

    def _judge_kernels(self) -> None:
        """Where a rebound would raise the energy, the environment again with less restitution (kernels/restitution.py)."""
        k, bounces = self._kernels, self.bounces
        step = [self.dt, self.tolerance, int(self._averages)]
        answer = [*step, self.rows, bounces, self.unsolved, self.reason]

        def solve_again() -> None:
            for attempt in range(1, restitution.EXTRA_SOLVES + 1):
                self._solve_kernels(bounces.todo, bounces.again, bounces.status)
                bounces.again.zero_()
                self.launch(k.judge, [attempt, *answer])

        bounces.again.zero_()
        self.launch(k.judge, [0, *answer])
        self._where(bounces.again, solve_again)
        self.launch(k.settle, [self.rows, bounces, self.status])

    def launch(self, kernel: wp.Kernel, inputs: list[Any], width: int = 1) -> None:
        """Launch a kernel whose threads stride over the environments, ``width`` of them side by side in each.

        On a GPU every environment has its own threads. The CPU has one core for all: its threads walk over every
        environment, because starting one costs 40 ns, for the arguments are copied.
        """
        threads = 1 if self.device.is_cpu else self.num_envs
        self._launch(kernel, (threads, width), [*inputs, threads])

    def _launch(self, kernel: wp.Kernel, dim: Any, inputs: list[Any]) -> None:
        self._loading.finish([kernel])
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)

    def _idle(self, kernel: wp.Kernel, work: wp.array) -> bool:
        """Whether a kernel that may not be loaded yet has nothing to do, for `work` is zero everywhere; read back from the device."""
        return kernel in self._loading and not work.numpy().any()

    def _near(self, kind: int) -> bool:
        """Whether pairs of one kind are listed in any environment (kernels/collide.py); read back from the device."""
        begin_end = self.listed.numpy()[:, kind : kind + 2]
        return bool((begin_end[:, 1] > begin_end[:, 0]).any())

    def lanes(self, number: int) -> int:
        """Threads that share `number` things of an environment: on a GPU one for each, on the CPU one for all."""
        return 1 if self.device.is_cpu else number

    def _captured(self, name: str, launches: Callable[[], None]) -> Any:
        """The graph of some launches, captured when first asked for."""
        if name not in self._graphs:
            self._loading.finish()  # modules cannot be loaded within a capture
            with wp.ScopedCapture(device=self.device) as capture:
                launches()
            self._graphs[name] = capture.graph
        return self._graphs[name]

    # --------------------------------------------------------------------------------------------------- allocation

    def _array(self, n: int, dtype: Any) -> wp.array:
        """Zeroed array [E, n]: rows together on the CPU, environments together on a GPU (coalesced)."""
        if self.device.is_cpu:
            return wp.zeros((self.num_envs, n), dtype=dtype, device=self.device)
        return wp.zeros((n, self.num_envs), dtype=dtype, device=self.device).transpose()

    def ints(self, values: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=int, device=self.device)

    def _constant(self, values: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=self._numpy_real), dtype=dtype, device=self.device)

    def _allocate(self) -> None:
        t, m, e = self._types, self.model, self.num_envs
        b, c, r = m.num_bodies, m.num_slots, m.max_contacts

        ints = self.ints
        topology = self.topology = t.Topology()
        topology.joint_type, topology.q_start, topology.v_start = ints(m.joint_type), ints(m.q_start), ints(m.v_start)
        topology.movable = ints(m.movable[:-1])
        topology.joint_pose = self._constant(m.joint_pose, t.transform)
        topology.shape_body = ints(m.shape_body)
        topology.shape_pose = self._constant(m.shape_pose, t.transform)
        topology.shape_size = self._constant(m.shape_size, t.vec3)
        topology.surface_velocity = self._constant(m.shape_surface_velocity, t.vec3)
        topology.pairs, topology.pair_slots = ints(m.pairs), ints(m.pair_slots)
        pair_body = np.where(m.pairs >= 0, m.shape_body[m.pairs], -1) if len(m.pairs) else np.zeros((0, 2))
        topology.pair_body = wp.array(pair_body.astype(np.int32), dtype=wp.vec2i, device=self.device)
        topology.slot_pair = ints(np.repeat(np.arange(len(m.pairs)), np.diff(m.pair_slots)))

        parameters = self.parameters = t.Parameters()
        parameters.mass = self._constant(m.mass[None], self.real)
        parameters.inertia = self._constant(m.inertia[None], t.mat33)
        parameters.com = self._constant(m.com[None], t.vec3)
        parameters.friction = self._constant(m.friction[None], t.vec2)
        parameters.contact = self._constant(m.contact[None], self.real)
        parameters.gravity = self._constant(m.gravity[None], t.vec3)

        bundle = self.bodies = t.Bodies()
        bundle.pose, bundle.velocity = self._array(b, t.transform), self._array(b, t.spatial)
        bundle.com, bundle.inv_mass, bundle.inv_inertia = self._array(b, t.vec3), self._array(b, self.real), self._array(b, t.mat33)
        bundle.free_velocity = self._array(b, t.spatial)
        bundle.bounds = self._array(len(m.shape_body) if m.bounded else 0, t.spatial)
        self._extent = self._constant(m.shape_extent, t.vec4)
        bundle.hit = self._array(b if m.bodies_meet else 0, self.real)
        bundle.alert = wp.full(e if m.bodies_meet else 0, -1.0, dtype=self.real, device=self.device)
        self.next_velocity = self._array(b, t.spatial)
        #: What solvers know of the bodies: the bodies themselves, or the trees they hang in.
        self.mechanics: Any = bundle
        self.control: Control | None = None
        if m.articulated:
            trees = self.mechanics = self.trees = articulation.arrays(self, tree.functions(self.real).Trees)
            self.control = Control(trees.target, trees.target_rate, trees.force)
            self._targets = [self._constant(m.drive[:, k], self.real) for k in (3, 4)]

        slots = self.slots = t.Slots()
        slots.point, slots.normal = self._array(c, t.vec3), self._array(c, t.vec3)
        slots.gap, slots.bend, slots.feature = self._array(c, self.real), self._array(c, self.real), self._array(c, int)
        slots.last_feature, slots.last_impulse = self._array(c, int), self._array(c, self.real)
        slots.last_bristle = self._array(c, t.vec3)
        slots.last_feature.fill_(-1)
        #: [E, K + 1 + P] pairs that are not far apart (kernels/collide.py): all, until the first step has looked.
        everything = np.concatenate([m.kind_pairs + len(m.kind_pairs), np.arange(len(m.pairs))]).astype(np.int32)
        self.listed = self._array(len(everything), int)
        self.listed.assign(np.tile(everything, (e, 1)))
        self._kind_pairs = ints(m.kind_pairs)
        self._plane_kinds = int((m.shape_type[m.pairs[m.kind_pairs[:-1], 0]] == ShapeType.PLANE).sum())

        rows = self.rows = t.Contacts()
        rows.room = r
        if m.articulated:
            r += len(self.mechanics.row_kind)
        rows.count = wp.zeros(e, dtype=int, device=self.device)
        rows.body = self._array(r, wp.vec2i)
        rows.slot, rows.closed, rows.state, rows.directions = (self._array(r, int) for _ in range(4))
        rows.point, rows.inv_mass, rows.relaxation, rows.shift, rows.free, rows.impulse, rows.velocity, rows.best_impulse = (
            self._array(r, t.vec3) for _ in range(8)
        )
        rows.slip = self._array(r if self.law.is_cone else 0, t.vec3)
        rows.gap, rows.damping = self._array(r, self.real), self._array(r, self.real)
        rows.frame, rows.mu, rows.bound = self._array(r, t.mat33), self._array(r, t.vec2), self._array(r, t.vec2)

        self.q, self.q0 = self._array(m.nq, self.real), self._array(m.nq, self.real)
        self.v, self.v0 = self._array(m.nv, self.real), self._array(m.nv, self.real)
        for array, values in ((self.q, m.q0), (self.q0, m.q0), (self.v, m.v0), (self.v0, m.v0)):
            array.assign(np.tile(values.astype(self._numpy_real), (e, 1)))
        self.wrench = self._array(b, t.spatial)
        self.everyone: wp.array = wp.array(np.arange(e, dtype=np.int32), dtype=int, device=self.device)
        self.num_everyone: wp.array = wp.array([e], dtype=int, device=self.device)
        self._all: wp.array = wp.empty(0, dtype=int, device=self.device)  # of kinematics, in place of a choice of environments
        self.status, self.iterations, self.unsolved, self.reason = (wp.zeros(e, dtype=int, device=self.device) for _ in range(4))
        self.residual, self.residual_energy, self.best_residual = (wp.zeros(e, dtype=self.real, device=self.device) for _ in range(3))

    def _load_kernels(self) -> None:
        if self.project_loops:
            n = 3 * sum(row.kind in (tree.LOOP_WAY, tree.LOOP_TURN) for row in articulation.rows(self.model))
            self._loop_system = (wp.zeros((self.num_envs, n, n), dtype=self.real, device=self.device), self._array(n, self.real))
            self._apart: wp.array = wp.zeros(self.num_envs, dtype=self.real, device=self.device)
        self.kernels: list[Any] = []
        self._loading = Loading(self.device)
        self._load(self._make_kernels())
        for method in self._methods:
            method.prepare(self)
        # Environments that each method but the last leaves to the next, and those whose answer a method could not certify itself.
        left, doubtful = len(self._methods) - 1, self.num_envs if any(method.judges for method in self._methods) else 0
        self.queues: wp.array = wp.empty((left, self.num_envs), dtype=int, device=self.device)
        self.queued: wp.array = wp.zeros(left, dtype=int, device=self.device)
        self.doubtful: wp.array = wp.empty(doubtful, dtype=int, device=self.device)
        self.num_doubtful: wp.array = wp.zeros(1, dtype=int, device=self.device)
        if any(with_hulls for *_, with_hulls in self._pair_kernels):
            self.hulls, self._meshes = hulls.arrays(self.model, self)  # the latter so that they live as long

    def _make_kernels(self) -> Iterator[Any]:
        """In the order of need: those that say which pairs are near, what every step needs, then what few steps need or none."""
        first, *others = chosen(self.method, self.precision, self.law, self.model.articulated)
        self._methods = [first(self.model, self.real, self.law)]
        self._kernels, self._pair_kernels = stage_kernels(self.model, self.real, self.integrator, self._methods[0].makes_rows)
        if self.project_loops:
            self._kernels.project = projection.make(self.real)
        stages = dict(vars(self._kernels))
        resets = [stages.pop(name) for name in ("reset", "reset_control") if name in stages]
        # With the first one Warp compiles headers of its own, which takes as long as to make the others.
        yield from (stages.pop(name) for name in ("kinematics", "bounds", "list_pairs") if name in stages)
        yield self._methods[0].kernel
        yield from stages.values()
        for other in others:
            method = other(self.model, self.real, self.law)
            method.take_rows()
            self._methods.append(method)
            yield method.kernel
        yield from (kernel for kernel, *_ in self._pair_kernels)  # a step that finds some of their pairs near asks for them earlier
        yield from resets

    def _load(self, kernels: Iterable[Any]) -> None:
        """Begin to compile kernels that are not there yet, while the next are made, and to put them on the device.

        On the CPU a launch waits for its kernel. A GPU captures steps before it takes the first, with every kernel there.
        """
        collects = gc.isenabled()
        gc.disable()  # syntax trees of all functions live on; to look for garbage among them takes as long as to read a scene
        try:
            for kernel in kernels:
                if kernel not in self.kernels:
                    self.kernels.append(kernel)
                    self._loading.begin(kernel)
        finally:
            if collects:
                gc.enable()
        if not self.device.is_cpu:
            self._loading.finish()


def _choice(what: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise WarpLcpError(f"{what} is {value!r}; choose one of {', '.join(choices)}")
