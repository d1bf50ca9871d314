# SPDX-License-Identifier: Apache-2.0
"""Physical parameters of a Model that may differ between environments: which there are, what their numbers may be, what becomes of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from .articulation import rows
from .errors import WarpLcpError
from .kernels import tree
from .model import Model

#: Each, and what its numbers must be.
PARAMETERS = {
    "mass": "it must be finite and greater than zero",
    "inertia": "it must be symmetric and positive definite, and no moment may exceed the sum of the others",
    "com": "it must be finite",
    "friction": "it must be finite and not negative, and mu_k no larger than mu_s",
    "contact": "it must be finite and not negative (damping and slip threshold greater than zero), or NaN for Table 1",
    "restitution": "it must be at least 0 and at most 1",
    "gravity": "it must be finite",
    "armature": "it must be finite and not negative",
    "damping": "it must be finite and not negative",
    "joint_friction": "it must be finite and not negative, and zero where the model has neither dry friction, a lower limit nor a drive",
    "gains": "they must be finite and not negative, the greatest force infinite just where the model's is, and zero without a drive",
}
#: Those of joints: a model without has none.
OF_JOINTS = ("armature", "damping", "joint_friction", "gains")


def checked(model: Model, num_envs: int, name: str, value: Any) -> np.ndarray:
    """[1, ...] or [num_envs, ...] numbers of a parameter, of the shape that the Model's field has behind the environments.

    Raises:
        WarpLcpError: for an unknown name, a wrong shape, or a number that no body, joint or contact can have.
    """
    if name not in PARAMETERS:
        raise WarpLcpError(f"set_parameters: {name!r} is not a parameter; choose from {', '.join(PARAMETERS)}")
    if name in OF_JOINTS and not model.articulated:
        raise WarpLcpError(f"set_parameters: {name!r} is of joints, and the model has none")
    array = np.asarray(value.numpy() if isinstance(value, wp.array) else value, dtype=float)
    shape = getattr(model, name).shape
    if array.shape == shape:
        array = array[None]
    if array.shape not in ((1, *shape), (num_envs, *shape)):
        raise WarpLcpError(f"set_parameters: {name} has shape {array.shape}; give {shape} or {(num_envs, *shape)}")
    allowed = _possible(model, name, array)
    if not allowed.all():
        where = tuple(int(i) for i in np.argwhere(~allowed)[0])
        of = f" ({model.dof_names[where[1]]})" if name in OF_JOINTS else ""
        raise WarpLcpError(f"set_parameters: {name}{list(where)}{of} is {array[where]}; {PARAMETERS[name]}")
    return array


def _possible(model: Model, name: str, value: np.ndarray) -> np.ndarray:
    """[N, ...] which numbers a parameter may have."""
    welded = model.mass == 0.0  # to other bodies, whose masses theirs are a part of
    allowed: np.ndarray = np.isfinite(value)
    if name == "mass":
        allowed &= (value > 0.0) | ((value == 0.0) & welded)
    elif name == "inertia" and allowed.all():
        moments = np.linalg.eigvalsh(value)
        possible = (moments[..., 0] > 0.0) & (moments[..., 2] <= (moments[..., 0] + moments[..., 1]) * (1 + 1e-6))
        possible &= np.isclose(value, np.swapaxes(value, -1, -2), rtol=1e-6, atol=0.0).all(axis=(-1, -2))
        allowed &= (possible | welded)[..., None, None]
    elif name == "friction":
        allowed[..., 1] &= value[..., 1] <= value[..., 0]
        allowed &= value >= 0.0
    elif name == "contact":
        allowed[np.isnan(value)] = True
        allowed[..., [1, 3, 4]] &= value[..., [1, 3, 4]] != 0.0
        allowed &= ~(value < 0.0)
    elif name == "restitution":
        allowed &= (value >= 0.0) & (value <= 1.0)
    elif name in ("armature", "damping"):
        allowed &= value >= 0.0
    elif name == "joint_friction":
        has_row = np.isin(np.arange(model.nv), _limits(model)[1])
        allowed &= (value >= 0.0) & (has_row | (value == 0.0))
    elif name == "gains":  # with the model it is settled which drives are rows of their own and which a part of M
        driven = (model.gains[:, :2] > 0.0).any(axis=1, keepdims=True)
        allowed[..., :2] &= driven | (value[..., :2] == 0.0)
        allowed[..., 2] = np.isfinite(value[..., 2]) == np.isfinite(model.gains[:, 2])
        allowed &= value >= 0.0
    return allowed


def of_joints(model: Model, name: str, value: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Fields of ``Trees`` that hold a joint's parameter [N, nv] or [N, nv, 3], with what they become."""
    if name in ("armature", "damping"):
        return [(name, value)]
    of_row, velocity = _limits(model)
    if name == "joint_friction":
        friction = np.zeros((len(value), len(rows(model))))
        friction[:, of_row] = value[:, velocity]
        return [("row_friction", friction)]
    unbounded = np.isinf(model.gains[:, 2])
    bounded = np.zeros((len(value), len(rows(model)), 3))
    bounded[:, of_row] = np.where(unbounded[velocity][:, None], 0.0, value[:, velocity])
    held = [("stiffness", np.where(unbounded, value[..., 0], 0.0)), ("rate", np.where(unbounded, value[..., 1], 0.0))]
    return [*held, ("row_drive", bounded)]


def _limits(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Rows that limit a velocity, drive it or rub on it, and which velocity that is."""
    low = [(k, row.velocity) for k, row in enumerate(rows(model)) if row.kind == int(tree.LIMIT_LOW)]
    k, velocity = np.array(low, dtype=int).reshape(-1, 2).T
    return k, velocity


def combine(model: Model, which: int) -> np.ndarray:
    """[P] how the friction (0) or restitution (1) of a pair's two materials becomes one; none where all take the mean."""
    modes: np.ndarray = model.combine[model.pairs, which].max(axis=1, initial=0)
    return modes if modes.any() else modes[:0]
