# SPDX-License-Identifier: Apache-2.0
"""Solution methods of the contact problem. A method sees one problem, the rows of every environment, and leaves impulses.

A new method is a class with ``kernel`` (chosen for a model), ``prepare`` (allocate, once) and ``launch`` (record, no host
read-back), entered in METHODS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .errors import WarpLcpError
from .kernels import lcp, lemke, pgs, pivoting, problems, proximal
from .kernels.types import LANES, scalar_types
from .model import JointType, Model

if TYPE_CHECKING:
    from .simulator import Simulator

#: Blocks that work on environments at one time on a GPU, each in its own workspace: enough to fill the largest...
GPU_WORKSPACES = 2048
#: ... but no more than this many bytes in all.
GPU_WORKSPACE_BYTES = 2**28
#: Largest LCP that Lemke's method takes: its tableau grows with the square. Larger problems are left to other methods.
LCP_UNKNOWNS = 2000


def lcp_workspace(real: Any, slots: int, n: int, device: Any) -> Any:
    """Workspace of `slots` problems of at most n unknowns for the Lemke kernels."""
    ws = lemke.functions(real).LcpWorkspace()
    ws.M = wp.empty((slots, n, n), dtype=real, device=device)
    ws.q = wp.empty((slots, n), dtype=real, device=device)
    ws.z = wp.empty((slots, n), dtype=real, device=device)
    ws.tableau = wp.empty((slots, n, n + 2), dtype=real, device=device)
    ws.scale = wp.empty((slots, n), dtype=real, device=device)
    ws.basic = wp.empty((slots, n), dtype=int, device=device)
    ws.nonbasic = wp.empty((slots, n + 1), dtype=int, device=device)
    return ws


def contact_workspace(real: Any, slots: int, n: int, blocks: int, fill: int, device: Any) -> tuple[Any, Any]:
    """Graph and ContactProblem of `slots` problems of at most n contacts, for the proximal kernels.

    blocks: room for pairs of contacts that share a body, each counted twice; fill: room for blocks of a triangular factor.
    """
    t, f = scalar_types(real), proximal.functions(real)
    graph, problem = f.Graph(), f.ContactProblem()

    def empty(n: int, dtype: Any) -> wp.array:
        return wp.empty((slots, max(n, 1)), dtype=dtype, device=device)

    graph.adjacent = wp.empty((slots, n, (n + 31) // 32), dtype=wp.uint32, device=device)
    graph.degree, graph.order, graph.step = (empty(n, int) for _ in range(3))
    graph.row, graph.fill = empty(n + 1, int), empty(n + 1, int)
    graph.column, graph.target, graph.later = empty(blocks, int), empty(blocks, int), empty(fill, int)
    graph.diagonal, graph.pivot = empty(n, t.mat33), empty(n, t.mat33)
    graph.block, graph.lower, graph.upper = empty(blocks, t.mat33), empty(fill, t.mat33), empty(fill, t.mat33)
    problem.free, problem.rho, problem.impulse, problem.velocity = (empty(n, t.vec3) for _ in range(4))
    problem.centre, problem.best, problem.step, problem.change = (empty(n, t.vec3) for _ in range(4))
    problem.mu, problem.bound = empty(n, t.vec2), empty(n, t.vec2)
    problem.directions, problem.error = empty(n, int), empty(n, real)
    return graph, problem


def workspaces(num_envs: int, scalars: int, device: wp.Device) -> int:
    """Problems of so many scalars worked on at one time: one on the CPU, where it stays in the cache."""
    return 1 if device.is_cpu else max(1, min(num_envs, GPU_WORKSPACES, GPU_WORKSPACE_BYTES // (8 * max(scalars, 1))))


class Lemke:
    """Lemke's method on the assembled LCP of eq. 39, no fallback."""

    def __init__(self, model: Model, real: Any):
        self.kernel = lcp.make(real)

    def prepare(self, sim: Simulator) -> None:
        real = sim.real
        r = min(sim.model.max_contacts, LCP_UNKNOWNS // (1 + 2 * sim.directions))
        n = r * (1 + 2 * sim.directions)
        slots = workspaces(sim.num_envs, 2 * n * n + 15 * r * r, sim.device)
        self.lcp = lcp_workspace(real, slots, n, sim.device)
        ws = lcp.functions(real).ContactWorkspace()
        ws.W = wp.empty((slots, 3 * r, 3 * r), dtype=real, device=sim.device)
        ws.A_inv = wp.empty((slots, 2 * r, 2 * r), dtype=real, device=sim.device)
        ws.G = wp.empty((slots, 2 * r, r + 1), dtype=real, device=sim.device)
        ws.friction = wp.empty((slots, r + 1), dtype=int, device=sim.device)
        ws.start = wp.empty((slots, r + 1), dtype=int, device=sim.device)
        self.contacts = ws
        self.slots = slots

    def launch(self, sim: Simulator) -> None:
        inputs = [sim.bodies, sim.rows, sim.unsolved, sim.rho_scale, self.lcp, self.contacts, sim.iterations, sim.reason]
        wp.launch_tiled(self.kernel, dim=[self.slots], inputs=inputs, block_dim=LANES, device=sim.device)


class ProximalNewton:
    """Proximal semismooth Newton on the contacts, any law."""

    SWEEPS = 20
    LIMIT = 200
    #: Room for coupled contacts and for blocks of a factor, per contact.
    NEIGHBOURS, FILL = 128, 256

    def __init__(self, model: Model, real: Any):
        self.kernel = problems.make_contacts(real)

    def prepare(self, sim: Simulator) -> None:
        n = sim.model.max_contacts
        blocks, fill = min(n * (n - 1), self.NEIGHBOURS * n), min(n * (n - 1) // 2, self.FILL * n)
        self.slots = workspaces(sim.num_envs, 10 * blocks + 20 * fill, sim.device)
        self.workspace = contact_workspace(sim.real, self.slots, n, blocks, fill, sim.device)

    def launch(self, sim: Simulator) -> None:
        accuracy = (1e-12, 1e-6) if sim.real is wp.float64 else (1e-6, 1e-2)  # of velocities, of impulses; relative
        inputs = [sim.bodies, sim.rows, sim.unsolved, self.SWEEPS, self.LIMIT, *accuracy, *self.workspace, sim.iterations, sim.reason]
        wp.launch_tiled(self.kernel, dim=[self.slots], inputs=inputs, block_dim=LANES, device=sim.device)


class VelocityPivoting:
    """Principal pivoting on contact states in the velocities; contacts with more than two directions are not for it."""

    LIMIT = 12

    def __init__(self, model: Model, real: Any):
        self.movable = np.flatnonzero(model.joint_type == JointType.FREE)
        self.single = len(self.movable) == 1
        self.kernel = pivoting.make_single(real) if self.single else pivoting.make(real).pivot

    def prepare(self, sim: Simulator) -> None:
        if self.single:
            return
        n = sim.model.dofs
        self.slots = workspaces(sim.num_envs, n * n, sim.device)
        ws = self.workspace = pivoting.make(sim.real).Workspace()
        ws.system = wp.empty((self.slots, n, n + 1), dtype=sim.real, device=sim.device)
        start = np.full(sim.model.num_bodies, -1, dtype=np.int32)
        start[self.movable] = 6 * np.arange(len(self.movable))
        ws.start = wp.array(start, dtype=int, device=sim.device)
        ws.flips = wp.zeros(self.slots, dtype=int, device=sim.device)

    def launch(self, sim: Simulator) -> None:
        tail = [self.LIMIT, sim.sign_tolerance, sim.iterations]
        if self.single:
            sim.launch(self.kernel, [sim.bodies, int(self.movable[0]), sim.rows, *tail])
        else:
            inputs = [sim.bodies, sim.rows, self.workspace, *tail]
            wp.launch_tiled(self.kernel, dim=[self.slots], inputs=inputs, block_dim=LANES, device=sim.device)


class BlockPGS:
    """Block projected Gauss-Seidel: a fixed number of cold sweeps, fewer where it converges."""

    SWEEPS = 50

    def __init__(self, model: Model, real: Any):
        self.kernel = pgs.make(real)

    def prepare(self, sim: Simulator) -> None:
        """Nothing to allocate: the velocities are the simulator's."""

    def launch(self, sim: Simulator) -> None:
        # Sweeps end where no impulse changes a velocity by more than a hundredth of what certifies an answer.
        sim.launch(
            self.kernel,
            [sim.bodies, sim.rows, sim.unsolved, self.SWEEPS, 0.01 * sim.tolerance, sim.next_velocity, sim.iterations, sim.reason],
        )


#: Methods by the name that users give; each is tried on the environments that those before it left unsolved. Where none
#: certifies its answer, the best is applied.
METHODS: dict[str, tuple[type, ...]] = {
    "auto": (VelocityPivoting, ProximalNewton, BlockPGS),
    "lemke": (Lemke,),
    "velocity_pivoting": (VelocityPivoting,),
    "proximal_newton": (ProximalNewton,),
    "pgs": (BlockPGS,),
}

#: Those that assemble the LCP of eq. 39, which no other formulation than 'phantom_inertia' has.
ASSEMBLING = ("lemke",)


def chosen(name: str, precision: str) -> tuple[type, ...]:
    """The methods behind a name.

    float32 does not resolve the stiffness of Table 1: a velocity of 5 m/s is known to 5e-7 m/s, and over eps_n that is
    more than the impulse itself. Block PGS does not divide by eps, so it is what 'auto' means there.

    Raises:
        WarpLcpError: for velocity pivoting in float32.
    """
    if precision == "float32" and name == "auto":
        return (BlockPGS,)
    if precision == "float32" and name == "velocity_pivoting":
        raise WarpLcpError("method 'velocity_pivoting' needs precision 'float64': float32 does not resolve contact stiffness; choose 'pgs'")
    return METHODS[name]
