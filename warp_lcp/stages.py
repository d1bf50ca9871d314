# SPDX-License-Identifier: Apache-2.0
"""Which kernels a step of a Model takes: those of its joints, pairs and restitution, and no others."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from . import articulation
from .kernels import (
    articulated,
    bodies,
    box_box,
    capsule,
    certify,
    collide,
    contacts,
    convex,
    ellipsoid,
    integrate,
    joint_rows,
    landing,
    mesh,
    reset,
    restitution,
    rounded,
)
from .laws import Law
from .methods import chosen
from .model import CONVEX, Model, ShapeType

PRECISIONS = {"float64": (wp.float64, np.float64), "float32": (wp.float32, np.float32)}


def stage_kernels(model: Model, real: Any, integrator: str, without_rows: bool) -> tuple[SimpleNamespace, list[tuple[Any, int, bool]]]:
    """Kernels of the stages by name, and (kernel, number of pairs, does it take hulls?) for each kind of pair in the model."""
    selected, rows = contacts.selection(real), contacts.make(real, model.articulated)
    body = articulated.make(real) if model.articulated else bodies.make(real)
    # In the order in which they are compiled: what every step needs, long ones first, then what contacts need, then the others.
    stages = SimpleNamespace(kinematics=body.kinematics)
    if model.bounded:
        far = collide.pair_functions(real)
        stages.bounds, stages.list_pairs = far.bounds, far.list_pairs
    stages.free_motion = body.free_motion
    if model.articulated and articulation.rows(model):
        stages.joint_rows = joint_rows.make(real)
    ends = landing.make(real) if model.articulated else integrate.make(real)
    stages.certify = certify.make(real, model.articulated)
    if integrator == "midpoint" and not model.articulated:
        stages.guard, stages.integrate_midpoint = ends.guard, ends.integrate_midpoint
    else:
        stages.integrate = ends.integrate
    if integrator == "midpoint" and model.articulated:
        stages.drift = ends.drift
    stages.select_contacts, stages.combine_pairs = selected.select_contacts, selected.combine_pairs
    if model.bounces:
        rebound = restitution.make(real)
        stages.bounce, stages.judge, stages.settle = rebound.bounce, rebound.judge, rebound.settle
    if not without_rows:
        stages.contact_rows = rows.contact_rows
        if model.articulated and model.bodies_meet:
            stages.calm_overlaps = rows.calm_overlaps
    if integrator != "midpoint" and model.articulated:
        stages.judge_landing, stages.land = ends.judge_landing, ends.land
    stages.reset = reset.make(real)
    if model.articulated:
        stages.reset_control = body.reset_control
    pairs = []
    for first, end in pairwise(model.kind_pairs):
        kind = tuple(ShapeType(model.shape_type[s]).name for s in model.pairs[first])
        with_hulls = ShapeType[kind[1]] in (*CONVEX, ShapeType.MESH) or (kind[1] == "ELLIPSOID" and kind[0] != "PLANE")
        if kind[1] == "ELLIPSOID":
            kernel = mesh.make(real).ellipsoid_on_mesh if kind[0] == "MESH" else ellipsoid.make(real)[kind[0]]
        elif kind[1] == "MESH":
            kernel = mesh.make(real).round_on_mesh if kind[0] in ("SPHERE", "CAPSULE") else mesh.make(real).sharp_on_mesh
        elif with_hulls and kind[0] in ("SPHERE", "CAPSULE"):
            kernel = rounded.make(real)
        elif with_hulls:
            kernel = convex.make(real).on_plane if kind[0] == "PLANE" else convex.make(real).sharp
        elif kind == ("BOX", "BOX"):
            kernel = box_box.make(real)
        else:
            kernel = (capsule.make(real) if "CAPSULE" in kind else collide.make(real))[kind]
        pairs.append((kernel, int(end - first), with_hulls))
    return stages, pairs


def kernel_names(
    model: Model, method: str = "auto", precision: str = "float64", law: Law | None = None, integrator: str = "euler"
) -> list[str]:
    """Names of the kernels that a Simulator of the model compiles."""
    real, law = PRECISIONS[precision][0], law or Law()
    methods = [kind(model, real, law) for kind in chosen(method, precision, law, model.articulated)]
    stages, pairs = stage_kernels(model, real, integrator, methods[0].makes_rows)
    solvers = [kind.kernel for kind in methods]
    return [kernel.key.rpartition("__")[2] for kernel in (*vars(stages).values(), *dict.fromkeys(k for k, *_ in pairs), *solvers)]
