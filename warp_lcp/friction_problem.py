# SPDX-License-Identifier: Apache-2.0
"""Batches of frictional contact problems given as arrays (W, q, mu)."""

from __future__ import annotations

import functools
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .arrays import check_finite, check_strides, device_of, is_single, on_device, read
from .errors import WarpLcpError, positive_number, whole_number
from .kernels import contact_problem
from .kernels.types import LANES
from .methods import contact_workspace, workspaces

FORMULATIONS = ("coulomb", "phantom_inertia", "anitescu_potra")
#: Contacts of a problem whose workspace is kept for the next one of its size (CPU).
SMALL = 64
#: Sweeps of block Gauss-Seidel and factorisations of Newton's method, at most, in the first attempt (kernels/proximal.py).
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
        W: [B, 3r, 3r] or [3r, 3r], 1/kg, order (n, t1, t2) in each contact; numpy, Warp, anything with ``__dlpack__`` or nested
            lists. May be singular and slightly unsymmetric. Two float32 arrays are solved in float32, everything else in float64.
            Arrays on a device stay there.
        q: [B, 3r] or [3r], free relative velocity, m/s.
        mu: [B, r], [r] or one number, friction coefficients.
        formulation: 'coulomb', 'phantom_inertia' or 'anitescu_potra'.
        method: 'auto' (the proximal Newton method), 'proximal_newton' or 'pgs' (block Gauss-Seidel).
        directions: k of the polygons, at angles j pi / k from t1; 'coulomb' has none.
        tolerance: largest residual of an answer that counts as solved, in parts of max |q|; None = 1e-10, in float32 1e-4.
        device: Warp device; None = that of W and q if they are on one, Warp's default otherwise.

    Raises:
        WarpLcpError: for arguments that do not fit together or numbers that are not finite. Numbers on a GPU are not read back:
            there an answer that is not a number is marked.
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
    directions = whole_number("solve_contact: directions", directions, 2)
    me = "solve_contact"
    W, q, mu = read(me, "W", W), read(me, "q", q), read(me, "mu", mu)
    if W.ndim not in (2, 3) or W.ndim != q.ndim + 1 or W.shape != (*q.shape, q.shape[-1]) or q.shape[-1] % 3:
        raise WarpLcpError(f"{me}: W has shape {tuple(W.shape)} and q {tuple(q.shape)}; give [B, 3r, 3r] and [B, 3r], or [3r, 3r] and [3r]")
    real = wp.float32 if is_single(W) and is_single(q) else wp.float64
    device = device_of(me, device, W=W, q=q)
    check_strides(me, "W", W, real)
    for name, x in (("W", W), ("q", q), ("mu", mu)):
        check_finite(me, name, x)
    W, q = on_device(W, real, device), on_device(q, real, device)
    if q.ndim == 1:
        W, q = W.reshape((1, *W.shape)), q.reshape((1, *q.shape))
    batch, contacts = q.shape[0], q.shape[1] // 3
    mu = _coefficients(mu, batch, contacts, real, device)
    if tolerance is None:
        tolerance = 1e-10 if real is wp.float64 else 1e-4
    tolerance = positive_number(f"{me}: tolerance", tolerance)
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
    inputs = [W, q, mu, code, limit, sweeps, tolerance]
    if device.is_cpu and contacts <= SMALL:
        inputs += _kept_workspace(real, contacts, str(device), threading.get_ident())
    else:
        inputs += contact_workspace(real, slots, contacts, blocks, blocks // 2, device)
    sizes = wp.zeros((batch, 2), dtype=real, device=device)
    s = solution
    outputs = [s.impulse, s.velocity, s.residual, s.natural_map, s.cone_energy, sizes, s.asymmetry, s.iterations, s.status]
    kernel = contact_problem.make(real)
    command = wp.launch_tiled(kernel, dim=[slots], inputs=inputs + outputs, block_dim=LANES, device=device, record_cmd=True)
    return solution, command


def _coefficients(mu: Any, batch: int, contacts: int, real: Any, device: Any) -> wp.array:
    """mu as [B, r] on the device. One number or [r] is read on the host."""
    if isinstance(mu, wp.array) and mu.shape == (batch, contacts) and not wp.get_device(mu.device).is_cpu:
        return on_device(mu, real, device)  # without reading it back
    mu = np.asarray(mu.numpy() if isinstance(mu, wp.array) else mu, dtype=float)
    if mu.shape not in ((), (contacts,), (batch, contacts)):
        raise WarpLcpError(f"solve_contact: mu has shape {mu.shape}; give {(batch, contacts)}, {(contacts,)} or one number")
    check_finite("solve_contact", "mu", mu)
    if (mu < 0.0).any():
        where = [int(i) for i in np.argwhere(mu < 0.0)[0]]
        raise WarpLcpError(f"solve_contact: mu{where or ''} is {mu[tuple(where)]}; it must not be negative")
    return on_device(np.broadcast_to(mu, (batch, contacts)), real, device)


@functools.lru_cache(maxsize=8)
def _kept_workspace(real: Any, contacts: int, device: str, thread: int) -> tuple[Any, Any]:
    """Workspace of one problem on the CPU, where a launch has ended when it returns: making it anew costs more than a small problem."""
    blocks = contacts * (contacts - 1)
    return contact_workspace(real, 1, contacts, blocks, blocks // 2, device)
