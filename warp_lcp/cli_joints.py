# SPDX-License-Identifier: Apache-2.0
"""What ``warp-lcp info`` says of joints: what they join, what they leave free, and what acts along that."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import articulation, joints
from .kernels import tree
from .model import DofKind, JointType, Loop, Model

#: What the rows of a joint are for, by kind (kernels/joint_rows.py).
ROWS = {int(tree.LIMIT_LOW): "limits", int(tree.LIMIT_HIGH): "limits", int(tree.LOOP_WAY): "loops", int(tree.LOOP_TURN): "loops"}
ROWS |= {int(tree.CLOSER): "distances", int(tree.FURTHER): "distances"}
HEADER = ("joint", "type", "from", "to", "axis", "range", "start", "drive", "armature", "damping", "friction")


def describe(model: Model) -> list[dict[str, Any]]:
    """Joints in the order of the model's bodies, then those that close loops, ready for JSON; SI units.

    What carries a part of a body is said to carry the body, and to close a loop where that part is welded to the rest.
    """
    welded = {loop.bodies[1] for loop in model.loops if _within(model, loop)}
    found = []
    for b, name in enumerate(model.joint_names):
        if name:
            ends = {"from": _body(model, _carrier(model, b)), "to": _body(model, b), "loop": b in welded}
            kind = JointType(model.joint_type[b]).name.lower()
            found.append({"name": name, "type": kind, **ends, "held": None, "distance": None, "axes": _axes(model, b)})
    return found + [_loop(model, loop) for loop in model.loops if not _within(model, loop)]


def _within(model: Model, loop: Loop) -> bool:
    """Does it hold parts of one body together?"""
    a, b = loop.bodies
    return min(a, b) >= 0 and bool(model.part_of[a] == model.part_of[b])


def _carrier(model: Model, body: int) -> int:
    """The first body above this one that is no part of the same."""
    above = int(model.body_parent[body])
    while above >= 0 and model.part_of[above] == model.part_of[body]:
        above = int(model.body_parent[above])
    return above


def _body(model: Model, body: int) -> str | None:
    return None if body < 0 else model.body_names[model.part_of[body]]


def _axes(model: Model, body: int) -> list[dict[str, Any]]:
    """One entry a coordinate: its axis in the frame of the parent where all coordinates are zero, None for a ball's."""
    entries, at = [], int(model.q_start[body])
    where = articulation.coordinates(model)
    for i in np.flatnonzero(model.dof_body == body):
        kind = DofKind(model.dof_kind[i])
        axis = None if kind in (DofKind.BALL, DofKind.BALL_ON) else joints.rotate(model.joint_pose[body, 3:], model.dof_axis[i]).tolist()
        stiffness, damping, force, target, velocity = (float(x) for x in model.drive[i])
        drive = None
        if stiffness or damping:
            drive = {"stiffness": stiffness, "damping": damping, "max_force": _finite(force), "target": target, "target_velocity": velocity}
        entry = {"name": model.dof_names[i], "kind": "way" if kind is DofKind.LINEAR else "angle", "axis": axis}
        entry |= {"limit": [_finite(x) for x in model.limit[i]] if np.isfinite(model.limit[i]).any() else None}
        entry |= {"start": float(model.q0[where[i]]) if where[i] >= 0 else model.q0[at : at + 4].tolist() if kind is DofKind.BALL else None}
        entry |= {"drive": drive, "armature": float(model.armature[i]), "damping": float(model.damping[i])}
        entries.append(entry | {"friction": float(model.joint_friction[i])})
    return entries


def _loop(model: Model, loop: Loop) -> dict[str, Any]:
    held = [axis for axis, is_held in zip(joints.AXES, (*loop.ways, *loop.turns), strict=True) if is_held]
    distance = None if loop.distance is None else [_finite(x) for x in loop.distance]
    kind = "distance" if distance else "loop"
    ends = {"from": _body(model, loop.bodies[0]), "to": _body(model, loop.bodies[1])}
    return {"name": loop.name, "type": kind, **ends, "loop": True, "held": held, "distance": distance, "axes": []}


def row_kinds(model: Model) -> dict[str, int]:
    """How many rows joints may add to the contact problem, beside those of contacts, and what for."""
    table = articulation.rows(model) if model.articulated else []
    counts = dict.fromkeys(("limits", "drives", "friction", "loops", "distances"), 0)
    for row in table:
        if row.velocity < 0:
            counts[ROWS[row.kind]] += sum(row.held) if any(row.held) else 1
        else:
            counts["limits"] += int(np.isfinite(row.limit))
            counts["drives"] += int(any(row.drive))
            counts["friction"] += int(row.friction > 0.0)
    return counts


def cells(facts: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Rows of a table with :data:`HEADER`: one for each coordinate, bodies by the last part of their paths where that is unique."""
    name_of = _short({joint["name"] for joint in facts})
    short = _short({joint[end] for joint in facts for end in ("from", "to") if joint.get(end)})
    rows = []
    for joint in facts:
        if joint["type"] is None:
            rows.append((joint["name"], "?", "?", "?", *("",) * (len(HEADER) - 4)))
            continue
        first = (name_of[joint["name"]], joint["type"], short.get(joint["from"], "world"), short.get(joint["to"], "world"))
        if joint["distance"]:
            rows.append((*first, "", _range(joint["distance"], "m"), *("",) * 5))
        elif not joint["axes"]:
            held = f"holds {' '.join(joint['held'])}" if joint["loop"] else ""
            rows.append((*first, held, *("",) * 6))
        for k, axis in enumerate(joint["axes"]):
            lead = first if k == 0 else (axis["name"].rpartition("/")[2] if axis["name"] != joint["name"] else "", "", "", "")
            rows.append((*lead, *_cells(axis)))
    return rows


def _cells(axis: dict[str, Any]) -> tuple[str, ...]:
    angle = axis["kind"] == "angle"
    unit = "rad" if angle else "m"
    where = "ball" if axis["axis"] is None else f"{axis['kind']} {' '.join(f'{x + 0.0:.3g}' for x in np.round(axis['axis'], 9))}"
    start = axis["start"]
    shown = "" if start is None else f"{round(start, 7) + 0.0:.4g}" if isinstance(start, float) else " ".join(f"{x:.3g}" for x in start)
    drive = ""
    if axis["drive"]:
        d = axis["drive"]
        drive = f"k {d['stiffness']:.4g}, b {d['damping']:.4g} to {d['target']:.4g} {unit}"
        drive += f", {d['target_velocity']:.4g} {unit}/s" if d["target_velocity"] else ""
        drive += f", at most {d['max_force']:.4g} {'N m' if angle else 'N'}" if d["max_force"] is not None else ""
    rest = (f"{axis[name]:.4g}" if axis[name] else "" for name in ("armature", "damping", "friction"))
    return (where, _range(axis["limit"], unit), shown, drive, *rest)


def _range(limit: list[float | None] | None, unit: str) -> str:
    if limit is None:
        return "free"
    low, high = ("" if x is None else f"{x:.4g}" for x in limit)
    return f"{low} .. {high} {unit}"


def _short(names: set[str]) -> dict[str | None, str]:
    ends = [name.rpartition("/")[2] for name in names]
    return {name: end if ends.count(end) == 1 else name for name, end in zip(names, ends, strict=True)}


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return float(value) if np.isfinite(value) else None
