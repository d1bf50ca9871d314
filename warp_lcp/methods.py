# SPDX-License-Identifier: Apache-2.0
"""Solution methods of the contact problem. A method sees one problem, the rows of every environment, and leaves impulses.

A new method is a :class:`Method`, entered in METHODS.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from . import articulation
from .errors import WarpLcpError
from .kernels import contact_problem, lcp, pgs, pivoting, problem, proximal, single, sparse
from .kernels.types import LANES, scalar_types
from .laws import Law
from .model import JointType, Model

if TYPE_CHECKING:
    from .simulator import Simulator

#: Blocks that work on environments at one time on a GPU, each in its own workspace: enough to fill the largest...
GPU_WORKSPACES = 2048
#: ... but no more than this many bytes in all.
GPU_WORKSPACE_BYTES = 2**28
#: Largest LCP that is assembled: its matrix grows with the square. Larger problems are left to other methods.
LCP_UNKNOWNS = 2000


def lcp_workspace(real: Any, slots: int, n: int, device: Any) -> Any:
    """Workspace of `slots` plain LCPs of at most n unknowns; bounds other than 0 <= z are the kernel's to write."""
    ws = problem.functions(real).LcpWorkspace()
    ws.M = wp.empty((slots, n, n), dtype=real, device=device)
    ws.system = wp.empty((slots, n, n + 2), dtype=real, device=device)
    for name in ("q", "z", "x", "w", "row_scale", "column_scale"):
        setattr(ws, name, wp.empty((slots, n), dtype=real, device=device))
    for name in ("state", "basic", "wrong", "seen"):
        setattr(ws, name, wp.empty((slots, n), dtype=int, device=device))
    for name in ("member", "nonbasic"):
        setattr(ws, name, wp.empty((slots, n + 1), dtype=int, device=device))
    ws.lower = wp.zeros((slots, n), dtype=real, device=device)
    ws.upper = wp.full((slots, n), np.inf, dtype=real, device=device)
    ws.error = wp.empty((slots, n), dtype=wp.float64, device=device)
    return ws


def graph_workspace(real: Any, size: int, slots: int, n: int, blocks: int, fill: int, device: Any) -> Any:
    """Graph of `slots` block-sparse systems of at most n nodes, blocks of size x size (kernels/sparse.py).

    blocks: room for pairs of neighbours, each counted twice; fill: room for blocks of a triangular factor. Graph.diagonal and
    Graph.block are left to callers who keep the matrix as well as its factors.
    """
    graph = sparse.functions(real, size).Graph()
    matrix = graph._cls.vars["pivot"].type.dtype

    def empty(n: int, dtype: Any) -> wp.array:
        return wp.empty((slots, max(n, 1)), dtype=dtype, device=device)

    graph.adjacent = wp.empty((slots, max(n, 1), (n + 31) // 32), dtype=wp.uint32, device=device)
    graph.degree, graph.order, graph.step = (empty(n, int) for _ in range(3))
    graph.row, graph.fill = empty(n + 1, int), empty(n + 1, int)
    graph.column, graph.target, graph.later = empty(blocks, int), empty(blocks, int), empty(fill, int)
    graph.pivot, graph.lower, graph.upper = empty(n, matrix), empty(fill, matrix), empty(fill, matrix)
    return graph


def contact_workspace(real: Any, slots: int, n: int, blocks: int, fill: int, device: Any, joints: bool = False) -> tuple[Any, Any]:
    """Graph and ContactProblem of `slots` problems of at most n contacts, for the proximal kernels."""
    t, problem = scalar_types(real), proximal.functions(real, joints).ContactProblem()
    graph = graph_workspace(real, 3, slots, n, blocks, fill, device)

    def empty(dtype: Any) -> wp.array:
        return wp.empty((slots, max(n, 1)), dtype=dtype, device=device)

    graph.diagonal, graph.block = empty(t.mat33), wp.empty((slots, max(blocks, 1)), dtype=t.mat33, device=device)  # W

    problem.free, problem.rho, problem.impulse, problem.velocity = (empty(t.vec3) for _ in range(4))
    problem.centre, problem.best, problem.first, problem.step, problem.change = (empty(t.vec3) for _ in range(5))
    problem.mu, problem.bound, problem.directions, problem.error = empty(t.vec2), empty(t.vec2), empty(int), empty(real)
    return graph, problem


def workspaces(num_envs: int, scalars: int, device: wp.Device) -> int:
    """Problems of so many scalars worked on at one time: one on the CPU, where it stays in the cache."""
    return 1 if device.is_cpu else max(1, min(num_envs, GPU_WORKSPACES, GPU_WORKSPACE_BYTES // (8 * max(scalars, 1))))


class Method(ABC):
    """``kernel`` (chosen for a model), ``prepare`` (allocate, once) and ``launch`` (record, no host read-back).

    Attributes:
        makes_rows: the kernel makes the contact rows as well, until :meth:`take_rows`.
        judges: the kernel certifies its answers, and lists those that it cannot in sim.doubtful[:sim.num_doubtful].
    """

    kernel: Any
    makes_rows = False
    judges = False

    def take_rows(self) -> None:
        """From now on the kernel solves rows that are there: others made them, changed them (kernels/restitution.py) or tried them."""
        self.makes_rows = False

    @abstractmethod
    def prepare(self, sim: Simulator) -> None:
        """Allocate what the kernel needs."""

    @abstractmethod
    def launch(self, sim: Simulator, todo: wp.array, number: wp.array) -> None:
        """The environments todo[:number] that are listed on the device."""


class AssembledLCP(Method):
    """A method for dense LCPs ('lemke', 'murty' or 'judice_pires') on the assembled LCP of eq. 39, no fallback."""

    def __init__(self, solver: str, model: Model, real: Any, law: Law):
        if law.has_generators and model.articulated and articulation.rows(model):
            raise WarpLcpError(
                f"method {solver!r} takes no limits and drives with {law.formulation!r}; choose auto, proximal_newton or pgs"
            )
        self.kernel = lcp.make(real, solver, law.has_generators, model.articulated)

    def prepare(self, sim: Simulator) -> None:
        real = sim.real
        r = min(sim.rows.slot.shape[1], LCP_UNKNOWNS // sim.law.unknowns)
        n, rows = r * sim.law.unknowns, (3 if sim.model.loops else 2) * r  # rows that are eliminated, at most
        slots = workspaces(sim.num_envs, 2 * n * n + 9 * r * r + rows * (rows + r), sim.device)
        self.lcp = lcp_workspace(real, slots, n, sim.device)
        ws = lcp.functions(real).ContactWorkspace()
        ws.W = wp.empty((slots, 3 * r, 3 * r), dtype=real, device=sim.device)
        ws.A_inv = wp.empty((slots, rows, rows), dtype=real, device=sim.device)
        ws.G = wp.empty((slots, rows, r + 1), dtype=real, device=sim.device)
        ws.friction = wp.empty((slots, r + 1), dtype=int, device=sim.device)
        ws.start = wp.empty((slots, r + 1), dtype=int, device=sim.device)
        self.contacts = ws
        self.slots = slots

    def launch(self, sim: Simulator, todo: wp.array, number: wp.array) -> None:
        inputs = [sim.mechanics, sim.rows, todo, number, sim.rho_scale, self.lcp, self.contacts, sim.iterations, sim.reason]
        wp.launch_tiled(self.kernel, dim=[self.slots], inputs=inputs, block_dim=LANES, device=sim.device)


class ProximalNewton(Method):
    """Proximal semismooth Newton on the contacts, any law."""

    SWEEPS = 20
    LIMIT = 200
    #: Room for coupled contacts and for blocks of a factor, per contact.
    NEIGHBOURS, FILL = 128, 256

    def __init__(self, model: Model, real: Any, law: Law):
        self.kernel = contact_problem.make_contacts(real, model.articulated)

    def prepare(self, sim: Simulator) -> None:
        n = sim.rows.slot.shape[1]
        blocks, fill = min(n * (n - 1), self.NEIGHBOURS * n), min(n * (n - 1) // 2, self.FILL * n)
        self.slots = workspaces(sim.num_envs, 53 * n + 10 * blocks + 19 * fill, sim.device)
        self.workspace = contact_workspace(sim.real, self.slots, n, blocks, fill, sim.device, sim.model.articulated)

    def launch(self, sim: Simulator, todo: wp.array, number: wp.array) -> None:
        accuracy = (1e-12, 1e-6) if sim.real is wp.float64 else (1e-6, 1e-2)  # of velocities, of impulses; relative
        inputs = [sim.mechanics, sim.rows, todo, number, self.SWEEPS, self.LIMIT, *accuracy, *self.workspace, sim.iterations, sim.reason]
        wp.launch_tiled(self.kernel, dim=[self.slots], inputs=inputs, block_dim=LANES, device=sim.device)


class VelocityPivoting(Method):
    """Principal pivoting on contact states in the velocities, for laws with two friction axes or a disc."""

    LIMIT = 12
    #: Solves of the first attempt with a line search, where several bodies move, and of the careful one.
    NEWTON_LIMITS = (50, 300)
    #: Room for neighbours and for blocks of a triangular factor, per body.
    NEIGHBOURS, FILL = 32, 64

    def __init__(self, model: Model, real: Any, law: Law):
        self.movable = np.flatnonzero(model.joint_type == JointType.FREE)
        # Drives and dry friction of joints have limits that no normal impulse changes, as frozen laws do.
        self.kind = (real, law.is_cone, law.has_frozen_limits or bool(model.articulated and articulation.rows(model)))
        self.parts = None
        if len(self.movable) == 1 and not model.articulated:
            self.judges = self.makes_rows = True
            self.kernel = single.make(*self.kind, self.makes_rows)
        else:
            self.parts = pivoting.make(*self.kind, model.articulated)
            self.kernel = self.parts.pivot
        if model.bounces:
            self.take_rows()

    def take_rows(self) -> None:
        super().take_rows()
        if self.parts is None:
            self.kernel = single.make(*self.kind, self.makes_rows)

    def prepare(self, sim: Simulator) -> None:
        if self.parts is None:
            return
        contacts = sim.rows.slot.shape[1]
        if sim.model.articulated:
            velocity, nodes = articulation.nodes(articulation.paths(sim.model))
            body = np.zeros(len(velocity), dtype=np.intp)
        else:
            velocity, body, nodes = np.zeros((0, 6)), self.movable, np.full((sim.model.num_bodies, 1), -1, dtype=np.int32)
            nodes[self.movable, 0] = np.arange(len(body))
        n, most = len(body), nodes.shape[1]
        blocks, fill = min(n * (n - 1), self.NEIGHBOURS * n), min(n * (n - 1) // 2, self.FILL * n)
        arms = 2 * most * contacts if sim.model.articulated else 0
        self.slots = workspaces(sim.num_envs, 60 * n + blocks + 73 * fill + 28 * contacts + 19 * arms, sim.device)
        self.graph = graph_workspace(sim.real, 6, self.slots, n, blocks, fill, sim.device)
        ws = self.workspace = self.parts.Workspace()
        ws.nodes, ws.body, ws.velocity = sim.ints(nodes), sim.ints(body), sim.ints(velocity)
        t, vec6 = scalar_types(sim.real), wp.types.vector(length=6, dtype=sim.real)
        for name, width, dtype in (
            ("begin", n + 1, int),
            ("contact", 2 * most * contacts, int),
            ("node", arms, int),
            ("arm", arms, wp.types.matrix(shape=(6, 3), dtype=sim.real)),
            ("matrix", contacts, t.mat33),
            ("shift", contacts, t.vec3),
            ("change", n, vec6),
            ("scratch", n, vec6),
            ("present", n, vec6),
            ("relaxed", contacts, t.vec3),
            ("stiffness", contacts, t.vec3),
            ("ahead", contacts, t.vec3),
            ("expected", contacts, t.vec3),
            ("part", contacts, t.vec3),
        ):
            setattr(ws, name, wp.empty((self.slots, max(width, 1)), dtype=dtype, device=sim.device))
        ws.flips = wp.zeros(self.slots, dtype=int, device=sim.device)

    def launch(self, sim: Simulator, todo: wp.array, number: wp.array) -> None:
        if self.parts is None:
            scene = [sim.topology, sim.parameters, sim.bodies, sim.slots, sim.rows, int(self.movable[0])]
            lists = [todo, number, sim.doubtful, sim.num_doubtful, sim.unsolved]
            answer = [sim.residual, sim.residual_energy, sim.iterations, sim.reason]
            limits = [self.LIMIT, sim.sign_tolerance, sim.tolerance]
            sim.launch(self.kernel, [*scene, sim.dt, *sim.law.row_arguments, *limits, sim.next_velocity, *lists, *answer])
        else:
            tail = [wp.vec3i(self.LIMIT, *self.NEWTON_LIMITS), sim.sign_tolerance, sim.iterations, sim.reason]
            inputs = [sim.mechanics, sim.rows, todo, number, self.graph, self.workspace, *tail]
            wp.launch_tiled(self.kernel, dim=[self.slots], inputs=inputs, block_dim=LANES, device=sim.device)


class BlockPGS(Method):
    """Block projected Gauss-Seidel: a fixed number of cold sweeps, fewer where it converges."""

    SWEEPS = 50

    def __init__(self, model: Model, real: Any, law: Law):
        self.kernel = pgs.make(real, model.articulated)

    def prepare(self, sim: Simulator) -> None:
        """Nothing to allocate: the velocities are the simulator's."""

    def launch(self, sim: Simulator, todo: wp.array, number: wp.array) -> None:
        # Sweeps end where no impulse changes a velocity by more than a hundredth of what certifies an answer.
        sim.launch(
            self.kernel,
            [sim.mechanics, sim.rows, todo, number, self.SWEEPS, 0.01 * sim.tolerance, sim.next_velocity, sim.iterations, sim.reason],
        )


#: Methods that want the law as an LCP.
LCP_METHODS = ("lemke", "murty", "judice_pires")

#: Methods by the name that users give; each is tried on the environments that those before it left unsolved. Where none
#: certifies its answer, the best is applied.
METHODS: dict[str, tuple[Callable[[Model, Any, Law], Any], ...]] = {
    "auto": (VelocityPivoting, ProximalNewton, BlockPGS),
    "velocity_pivoting": (VelocityPivoting,),
    "proximal_newton": (ProximalNewton,),
    "pgs": (BlockPGS,),
    **{name: (partial(AssembledLCP, name),) for name in LCP_METHODS},
}


def chosen(name: str, precision: str, law: Law, articulated: bool) -> tuple[Callable[[Model, Any, Law], Any], ...]:
    """The methods behind a name, for a precision, a law, and a model with joints or without.

    float32 does not resolve the stiffness of Table 1: a velocity of 5 m/s is known to 5e-7 m/s, and over eps_n that is
    more than the impulse itself. The proximal method and block PGS do not divide by eps, so they are what 'auto' means there.

    Raises:
        WarpLcpError: where the method does not take the law, or not in this precision.
    """
    if name == "auto":
        if law.has_axes and precision == "float64":
            # With joints block PGS had nothing left to solve (docs/design.md), and takes an eighth of the time to compile.
            return METHODS["auto"][:2] if articulated else METHODS["auto"]
        return METHODS["auto"][1:]
    if name == "velocity_pivoting":
        if precision == "float32":
            raise WarpLcpError(f"method {name!r} needs precision 'float64': float32 does not resolve contact stiffness; choose 'auto'")
        if not law.has_axes:
            what = law.formulation if law.has_generators else f"directions = {law.directions}"
            raise WarpLcpError(
                f"method {name!r} takes two friction axes or Coulomb's cone, not {what}; choose auto, proximal_newton or lemke"
            )
    if law.is_cone and name in LCP_METHODS:
        raise WarpLcpError(f"method {name!r} solves LCPs, and the cone of 'coulomb' is none; choose auto, proximal_newton or pgs")
    return METHODS[name]
