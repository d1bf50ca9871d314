# SPDX-License-Identifier: Apache-2.0
"""Arrays of the kinematic trees of a Model (kernels/tree.py)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from .joints import inverse
from .kernels import tree
from .kernels.types import scalar_types
from .model import DofKind, Model


def paths(model: Model) -> SimpleNamespace:
    """How the velocities hang on each other: before, depth [nv], first, end, last, root [B]."""
    before, nv = model.dof_before, model.nv
    depth = np.zeros(nv, dtype=np.int32)
    for i in range(nv):
        depth[i] = depth[before[i]] + 1 if before[i] >= 0 else 0
    count = np.bincount(model.dof_body, minlength=model.num_bodies)
    last, root = np.full(model.num_bodies + 1, -1, dtype=np.int32), np.arange(model.num_bodies + 1, dtype=np.int32)
    for b in model.order:
        own = [i for i in np.flatnonzero(model.dof_body == b) if model.dof_kind[i] != DofKind.PRESCRIBED]
        last[b] = own[-1] if own else last[model.body_parent[b]]
        if model.body_parent[b] >= 0:
            root[b] = root[model.body_parent[b]]
    return SimpleNamespace(before=before, depth=depth, first=model.v_start, end=model.v_start + count, last=last[:-1], root=root[:-1])


def arrays(sim: Any, Trees: Any) -> Any:
    """``Trees`` of a simulator (kernels/tree.py), which shares what the simulator has of its bodies."""
    model, t, real, bodies = sim.model, sim._types, sim.real, sim.bodies
    where = paths(model)
    trees = Trees()
    for name in ("before", "depth", "first", "end", "last", "root"):
        setattr(trees, name, sim.ints(getattr(where, name)))
    trees.order, trees.parent, trees.kind = sim.ints(model.order), sim.ints(model.body_parent), sim.ints(model.dof_kind)
    on_path = path_table(where)
    trees.path = sim.ints(on_path)
    trees.shared = sim.ints([[np.cumprod((a == b) & (a >= 0)).sum() for b in on_path] for a in on_path])
    trees.axis = sim._constant(model.dof_axis, t.vec3)
    trees.child_pose = sim._constant(np.array([inverse(pose) for pose in model.joint_child_pose]), t.transform)
    trees.armature, trees.damping = sim._constant(model.armature[None], real), sim._constant(model.damping[None], real)
    trees.com, trees.inv_mass, trees.free_velocity = bodies.com, bodies.inv_mass, bodies.free_velocity
    trees.longest = int(where.depth.max()) + 1
    drive = model.drive
    unbounded = np.isinf(drive[:, 2])
    trees.stiffness = sim._constant(np.where(unbounded, drive[:, 0], 0.0)[None], real)
    trees.rate = sim._constant(np.where(unbounded, drive[:, 1], 0.0)[None], real)
    trees.coordinate = sim.ints(coordinates(model))
    table = rows(model)
    for name in ("kind", "velocity", "held"):
        values = np.array([getattr(row, name) for row in table], dtype=np.int32)
        setattr(
            trees, f"row_{name}", sim.ints(values) if name != "held" else wp.array(values.reshape(-1, 3), dtype=wp.vec3i, device=sim.device)
        )
    for name in ("body", "top"):
        ends = np.array([row.bodies if name == "body" else tops(model, row.bodies) for row in table], dtype=np.int32).reshape(-1, 2)
        setattr(trees, f"row_{name}", wp.array(ends, dtype=wp.vec2i, device=sim.device))
    trees.row_pose = sim._constant(np.array([row.frames for row in table]).reshape(-1, 2, 7), t.transform)
    trees.row_limit = sim._constant(np.array([row.limit for row in table]), real)
    trees.row_length = sim._constant(np.array([row.length for row in table]), real)
    trees.row_drive = sim._constant(np.array([row.drive for row in table]).reshape(1, -1, 3), t.vec3)
    trees.row_friction = sim._constant(np.array([row.friction for row in table])[None], real)
    trees.touching, trees.lands = (wp.zeros(sim.num_envs, dtype=int, device=sim.device) for _ in range(2))
    for name, number, dtype in layout(model, real):
        setattr(trees, name, sim._array(number, dtype))
    trees.target.assign(np.tile(drive[:, 3], (sim.num_envs, 1)))
    trees.target_rate.assign(np.tile(drive[:, 4], (sim.num_envs, 1)))
    return trees


def layout(model: Model, real: Any) -> list[tuple[str, int, Any]]:
    """Arrays of ``Trees`` that an environment has of its own: name, length, type."""
    t, where, extra = scalar_types(real), paths(model), len(rows(model))
    n, b, longest = model.nv, model.num_bodies, int(where.depth.max()) + 1
    table = (
        ("origin moment pull largest", b, t.vec3),
        ("worth", b, t.vec2),
        ("landing", b, int),
        ("twist gained carried push bent momentum", b, t.spatial),
        ("own inertia virial", b, t.mat33),
        ("articulated", b, wp.types.matrix(shape=(6, 6), dtype=real)),
        ("mass allowed", b, real),
        ("screw taken", n, t.spatial),
        ("pivot scale given calming free change left expected target target_rate force", n, real),
        ("row_scale", extra, t.vec3),
        ("half", 2 * (model.max_contacts + extra) * longest, t.vec3),
    )
    return [(name, number, dtype) for names, number, dtype in table for name in names.split()]


@dataclass(frozen=True)
class Row:
    """Up to three rows of a joint beside those of contacts (kernels/joint_rows.py)."""

    kind: int
    velocity: int = -1
    bodies: tuple[int, int] = (-1, -1)
    frames: np.ndarray = field(default_factory=lambda: np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1)))
    held: tuple[bool, bool, bool] = (False, False, False)
    limit: float = 0.0
    length: float = 1.0
    drive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    friction: float = 0.0


def rows(model: Model) -> list[Row]:
    """Rows that joints may put beside those of the contacts."""
    table = []
    for i in range(model.nv):
        (low, high), drive, friction = model.limit[i], model.drive[i], float(model.joint_friction[i])
        is_row = bool(np.isfinite(drive[2]) and drive[:2].any())
        bounded = (float(drive[0]), float(drive[1]), float(drive[2])) if is_row else (0.0, 0.0, 0.0)
        bodies = (-1, int(model.dof_body[i]))
        if np.isfinite(low) or any(bounded) or friction > 0.0:
            table.append(Row(int(tree.LIMIT_LOW), i, bodies, limit=low, drive=bounded, friction=friction))
        if np.isfinite(high):
            table.append(Row(int(tree.LIMIT_HIGH), i, bodies, limit=high))
    for loop in model.loops:
        if not model.movable[list(loop.bodies)].any():
            continue  # nothing that forces move
        base = Row(int(tree.LOOP_WAY), bodies=loop.bodies, frames=loop.frames)
        if loop.distance is not None:
            if loop.distance[0] > 0.0:
                table.append(replace(base, kind=int(tree.CLOSER), limit=loop.distance[0]))
            if np.isfinite(loop.distance[1]):
                table.append(replace(base, kind=int(tree.FURTHER), limit=loop.distance[1]))
            continue
        if any(loop.ways):
            table.append(replace(base, held=loop.ways))
        if any(loop.turns):
            solid = [b for b in loop.bodies if b >= 0 and model.movable[b] and model.mass[b] > 0.0]  # what is welded may have no mass
            gyration = [float(np.sqrt(np.trace(model.inertia[b]) / (2.0 * model.mass[b]))) for b in solid]
            table.append(replace(base, kind=int(tree.LOOP_TURN), held=loop.turns, length=min(gyration, default=1.0)))
    return table


def tops(model: Model, bodies: tuple[int, int]) -> tuple[int, int]:
    """Of two bodies, -1 = world: the uppermost body on the path to each that is not on that to the other; -1 where forces move none."""
    paths: list[list[int]] = [[], []]
    for path, b in zip(paths, bodies, strict=True):
        while b >= 0:
            path.insert(0, b)
            b = int(model.body_parent[b])
    shared = sum(a == b for a, b in zip(*paths, strict=False))
    first = [next((b for b in path[shared:] if model.movable[b]), -1) for path in paths]
    return first[0], first[1]


def coordinates(model: Model) -> np.ndarray:
    """[nv] coordinate in q of each velocity that has one of its own, -1."""
    result = np.full(model.nv, -1, dtype=np.int32)
    for b in range(model.num_bodies):
        at = model.q_start[b]
        for i in np.flatnonzero(model.dof_body == b):
            if model.dof_kind[i] in (DofKind.LINEAR, DofKind.ANGULAR):
                result[i] = at
                at += 1
    return result


def path_table(where: SimpleNamespace) -> np.ndarray:
    """[B, D] velocities on the path to each body from the root, -1 behind the last."""
    table = np.full((len(where.last), int(where.depth.max()) + 1), -1, dtype=np.int32)
    for b, i in enumerate(where.last):
        while i >= 0:
            table[b, where.depth[i]] = i
            i = where.before[i]
    return table


def nodes(where: SimpleNamespace) -> tuple[np.ndarray, np.ndarray]:
    """Velocities in groups of up to six of one tree: [n, 6] velocities of a node, -1 where there is none, and [B, m] nodes of each path."""
    table = path_table(where)
    tree_of = np.array([i if where.before[i] < 0 else -1 for i in range(len(where.before))])
    for i in range(len(tree_of)):
        if where.before[i] >= 0:
            tree_of[i] = tree_of[where.before[i]]
    moved = sorted(set(table[table >= 0].tolist()), key=lambda i: (tree_of[i], i))
    groups: list[list[int]] = []
    for i in moved:
        if not groups or len(groups[-1]) == 6 or tree_of[groups[-1][0]] != tree_of[i]:
            groups.append([])
        groups[-1].append(i)
    velocity = np.array([g + [-1] * (6 - len(g)) for g in groups], dtype=np.int32).reshape(-1, 6)
    node_of = {i: n for n, g in enumerate(groups) for i in g}
    lists = [sorted({node_of[i] for i in row if i >= 0}) for row in table.tolist()]
    most = max(1, *(len(x) for x in lists))
    return velocity, np.array([x + [-1] * (most - len(x)) for x in lists], dtype=np.int32)
