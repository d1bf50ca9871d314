# SPDX-License-Identifier: Apache-2.0
"""Batches of frictional contact problems given as arrays (W, q, mu)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .errors import WarpLcpError
from .kernels import problems
from .kernels.types import LANES
from .methods import contact_workspace, workspaces

FORMULATIONS = ("coulomb", "phantom_inertia", "anitescu_potra")
#: Sweeps of block Gauss-Seidel and factorisations of Newton's method, at most.
METHODS = {"auto": (20, 400), "proximal_newton": (20, 400), "pgs": (10_000, 0)}


@dataclass(frozen=True)
class ContactSolution:
    """Answers to B problems of r contacts, as Warp arrays. Everything but the impulses is computed from them and the problem.

    Attributes:
        impulse: [B, 3r] p, order (n, t1, t2) in each contact, N s.
        velocity: [B, 3r] u = W p + q, m/s.
        residual: [B] m/s, largest violation of the law that was solved (docs/theory.md, the certificate).
        natural_map: [B] |p - P_K(p - u - mu |u_t| n)| / |q|, how far the answer is from the exact Coulomb cone, whatever law was solved.
        cone_energy: [B] J, unit-consistent energy error E_uc, likewise against the exact cone.
        asymmetry: [B] max |W - W^T| / max |W|; W is used as it was given.
        iterations: [B] sweeps and factorisations.
        status: [B] :class:`warp_lcp.Status` bits; OK only where residual <= tolerance max |q|, or the round-off of W p where that is more.
    """

    impulse: wp.array
    velocity: wp.array
    residual: wp.array
    natural_map: wp.array
    cone_energy: wp.array
    asymmetry: wp.array
    iterations: wp.array
    status: wp.array


def solve_contact(
    W: Any,
    q: Any,
    mu: Any,
    formulation: str = "coulomb",
    method: str = "auto",
    *,
    directions: int = 2,
    tolerance: float | None = None,
    device: Any = None,
) -> ContactSolution:
    """Solve B problems  u = W p + q  with unilateral contact and friction at r points.

    p_n >= 0 and u_n >= 0 are complementary in each contact, p_t lies in mu p_n S, and the slip -u_t is a normal of that set at
    p_t: S is the unit disc ('coulomb': -u_t along p_t where it slides), or a polygon of 2k sides around it
    ('phantom_inertia', eqs. 29, 30) or within it ('anitescu_potra').

    Args:
        W: [B, 3r, 3r] or [3r, 3r], 1/kg, order (n, t1, t2) in each contact; numpy, Warp, or anything with DLPack. May be singular
            and slightly unsymmetric. float32 is solved in float32 where q is float32 too, everything else in float64.
        q: [B, 3r] or [3r], free relative velocity, m/s.
        mu: [B, r], [r] or one number, friction coefficients.
        formulation: 'coulomb', 'phantom_inertia' or 'anitescu_potra'.
        method: 'auto' (the proximal Newton method), 'proximal_newton' or 'pgs' (block Gauss-Seidel).
        directions: k of the polygons, at angles j pi / k from t1.
        tolerance: largest residual of an answer that counts as solved, in parts of max |q|; None = 1e-10, in float32 1e-4.
        device: Warp device; None = Warp's default.

    Raises:
        WarpLcpError: for arguments that do not fit together or numbers that are not finite.
    """
    solution, command = prepare(W, q, mu, formulation, method, directions, tolerance, device)
    if command is not None:
        command.launch()
    return solution


def prepare(
    W: Any, q: Any, mu: Any, formulation: str, method: str, directions: int, tolerance: float | None, device: Any
) -> tuple[ContactSolution, wp.Launch | None]:
    """Everything that :func:`solve_contact` does but the launch, which fills the solution and may be repeated; None: nothing to solve.

    On the CPU the launch reads W, q and mu where they are, so they may not change before it.
    """
    if formulation not in FORMULATIONS:
        raise WarpLcpError(
            f"solve_contact: formulation is {formulation!r}; choose one of {', '.join(FORMULATIONS)} (box and hybrid need the impulses "
            "of a step before: they are for the Simulator)"
        )
    if method not in METHODS:
        raise WarpLcpError(
            f"solve_contact: method is {method!r}; choose one of {', '.join(METHODS)} (methods for LCPs are behind solve_lcp)"
        )
    if int(directions) != directions or directions < 2:
        raise WarpLcpError(f"solve_contact: directions is {directions}; give a whole number of at least 2")
    W, q, mu = (x.numpy() if isinstance(x, wp.array) else np.asarray(x) for x in (W, q, mu))
    kind = np.float32 if W.dtype == q.dtype == np.float32 else np.float64
    W, q, mu = np.ascontiguousarray(W, dtype=kind), np.ascontiguousarray(q, dtype=kind), np.asarray(mu, dtype=kind)
    W, q = (W[None] if W.ndim == 2 else W), (q[None] if q.ndim == 1 else q)
    if W.ndim != 3 or q.ndim != 2 or W.shape != (*q.shape, q.shape[1]) or q.shape[1] % 3:
        raise WarpLcpError(f"solve_contact: W has shape {W.shape} and q {q.shape}; give [B, 3r, 3r] and [B, 3r]")
    batch, contacts = q.shape[0], q.shape[1] // 3
    if mu.shape not in ((), (contacts,), (batch, contacts)):
        raise WarpLcpError(f"solve_contact: mu has shape {mu.shape}; give {(batch, contacts)}, {(contacts,)} or one number")
    mu = np.ascontiguousarray(np.broadcast_to(mu, (batch, contacts)))
    for name, array in (("W", W), ("q", q), ("mu", mu)):
        good = np.isfinite(array) if name != "mu" else np.isfinite(array) & (array >= 0.0)
        if not good.all():
            where = tuple(int(i) for i in np.argwhere(~good)[0])
            what = "finite" if name != "mu" else "finite and not negative"
            raise WarpLcpError(f"solve_contact: {name}{list(where)} is {array[where]}; it must be {what}")
    device, real = wp.get_device(device), wp.float64 if kind is np.float64 else wp.float32
    if tolerance is None:
        tolerance = 1e-10 if kind is np.float64 else 1e-4
    code = {"coulomb": 1, "phantom_inertia": directions, "anitescu_potra": -directions}[formulation]
    blocks = contacts * (contacts - 1)
    slots = workspaces(batch, 20 * blocks, device)
    solution = ContactSolution(
        *(wp.empty((batch, 3 * contacts), dtype=real, device=device) for _ in range(2)),
        *(wp.zeros(batch, dtype=real, device=device) for _ in range(4)),
        *(wp.zeros(batch, dtype=int, device=device) for _ in range(2)),
    )
    if batch == 0 or contacts == 0:
        return solution, None
    sweeps, limit = METHODS[method]
    # The kernel only reads them: no copy on the CPU.
    inputs = [*(wp.array(x, dtype=real, device=device, copy=False) for x in (W, q, mu)), int(code), limit, sweeps, tolerance]
    inputs += contact_workspace(real, slots, contacts, blocks, blocks // 2, device)
    sizes = wp.zeros((batch, 2), dtype=real, device=device)
    s = solution
    outputs = [s.impulse, s.velocity, s.residual, s.natural_map, s.cone_energy, sizes, s.asymmetry, s.iterations, s.status]
    command = wp.launch_tiled(problems.make(real), dim=[slots], inputs=inputs + outputs, block_dim=LANES, device=device, record_cmd=True)
    return solution, command
