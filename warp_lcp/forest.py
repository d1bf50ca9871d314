# SPDX-License-Identifier: Apache-2.0
"""From bodies and the joints between them to kinematic trees: which joint carries which body, where it stands, what closes loops."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .errors import ModelError
from .joints import AXES, Joint, acts, columns, compose, coordinates, directions, inverse, kinds, mass_matrix, pose_of, rotate, turned
from .model import DofKind, JointType, Loop, parents_first

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
NO_LIMIT, NO_DRIVE = (-np.inf, np.inf), (0.0, 0.0, np.inf, 0.0, 0.0)
MOVED = 1e-5  # from here on it is told that a joint moves a body [m]


@dataclass
class Body:
    """A body as it was asked for; ``part_of``: the one of the scene that it is a part of, where it is none itself."""

    name: str
    joint: JointType
    pose: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    mass: float | None
    com: np.ndarray | None
    inertia: np.ndarray | None
    part_of: int | None = None


def spanning(types: list[JointType], joints: list[Joint]) -> tuple[list[Joint | None], list[Joint]]:
    """Joint that carries each body (None: free, kinematic or fixed), and joints that close loops.

    Bodies that are joined to the world, or to a body that forces do not move, hang there; of others the first one is free and carries
    the rest. Joints along which something acts carry before those that only hold, so that loops are cut at the latter where they have
    some; among alike breadth first, so that they are cut far from the root.
    """
    neighbours: dict[int, list[tuple[Joint, int]]] = {b: [] for b in range(-1, len(types))}
    for joint in (joint for joint in joints if not joint.loop):
        neighbours[joint.parent].append((joint, joint.child))
        neighbours[joint.child].append((joint, joint.parent))
    carried: dict[int, Joint | None] = {-1: None}
    used: set[int] = set()
    ahead: tuple[list[tuple[Joint, int]], ...] = ([], [])  # joints along which something acts, and others, with where they lead

    def reach(b: int) -> None:
        for joint, other in neighbours[b]:
            ahead[not acts(joint)].append((joint, other))

    def spread(roots: list[int]) -> None:
        for b in roots:
            reach(b)
        while any(ahead):
            joint, other = (ahead[0] or ahead[1]).pop(0)
            if other not in carried:
                carried[other] = joint if joint.child == other else turned(joint)
                used.add(id(joint))
                reach(other)

    still = [b for b, kind in enumerate(types) if kind is not JointType.FREE]
    for b in still:
        carried[b] = None
    spread([-1, *still])
    for b in range(len(types)):
        if b not in carried:
            carried[b] = None
            spread([b])
    return [carried[b] for b in range(len(types))], [joint for joint in joints if id(joint) not in used]


def cut(bodies: list[Body], joints: list[Joint], mass: np.ndarray) -> tuple[list[Body], list[Joint]]:
    """Bodies and joints in which whatever acts along a joint acts along a coordinate, also where the joint closes a loop.

    A constraint has no coordinate that could be limited, driven or damped. Such a joint carries a half of its child instead (of its
    parent, where the child is not free or has no ``mass``), and the half is welded to the whole, which closes the loop. So do joints of
    stacked axes. The halves stand behind all other bodies.
    """
    bodies, joints = list(bodies), list(joints)
    for joint in spanning([b.joint for b in bodies], joints)[1]:
        solid = [b for b in (joint.child, joint.parent) if b >= 0 and bodies[b].joint is JointType.FREE and mass[b] > 0.0]
        if joint.distance is not None or not solid or not (acts(joint) or joint.directions is not None):
            continue
        whole, half = solid[0], len(bodies)
        bodies.append(replace(bodies[whole], name=f"{joint.name}:carried", part_of=whole))
        at = next(k for k, other in enumerate(joints) if other is joint)
        parent, child = (joint.parent, half) if whole == joint.child else (half, joint.child)
        joints[at] = replace(joint, loop=False, parent=parent, child=child)
        still, nothing = np.array(IDENTITY), np.zeros(0)
        along = (nothing, nothing, nothing, np.zeros((0, 2)), np.zeros((0, 5)))
        joints.append(Joint(f"{joint.name}:weld", JointType.FIXED, whole, half, still, still, (), *along, loop=True))
    return bodies, joints


def loop_of(joint: Joint) -> Loop:
    """The same joint as a constraint."""
    if joint.directions is not None:
        raise ModelError(f"{joint.name}: a joint of stacked axes cannot close a loop between bodies without mass; give one of them some")
    x, y, z, rx, ry, rz = (axis not in joint.axes for axis in AXES)
    frames = np.array([joint.parent_frame, joint.child_frame])
    return Loop(joint.name, (joint.parent, joint.child), frames, (x, y, z), (rx, ry, rz), joint.distance)


def arrange(
    bodies: list[Body], joints: list[Joint], shaped: Collection[int], mass: np.ndarray, com: np.ndarray, inertia: np.ndarray
) -> tuple[dict[str, Any], list[str]]:
    """Model's fields of bodies, joints and coordinates, which are in the order of the trees, parents first; what is to be told of it.

    Args:
        shaped: bodies that have shapes. mass, com, inertia: [B], [B, 3], [B, 3, 3] of the bodies.

    Raises:
        ModelError: for a body without mass that needs some.
    """
    given = len(bodies)
    bodies, joints = cut(bodies, joints, mass)
    count, notes = len(bodies), list[str]()
    carried, loops = spanning([b.joint for b in bodies], joints)
    order = parents_first([-1 if joint is None else joint.parent for joint in carried])
    carries = {joint.parent for joint in carried if joint is not None}
    for b, body in enumerate(bodies):
        if body.mass == 0.0 and (carried[b] is None or b not in carries or b in shaped):
            raise ModelError(f"{body.name}: mass is 0 kg; only what hangs on a joint, carries another body and has no shape may have none")
    whole = np.array([b if b < given else body.part_of for b, body in enumerate(bodies)])
    share = 1.0 / np.bincount(whole)[whole]
    com, entire = com[whole], (mass[whole], inertia[whole])
    mass, inertia = share * entire[0], share[:, None, None] * entire[1]
    for b in range(given, count):
        of = f"a part of {bodies[whole[b]].name} that is welded to the rest"
        notes.append(f"{bodies[b].name.removesuffix(':carried')}: closes a loop and has limits, drives or the like: it carries {of}")
    lost = [joint.name for joint in loops if joint.distance is None and acts(joint)]
    notes += [f"{name}: closes a loop between bodies without mass: its limits, drives and the like are left out" for name in lost]
    types, parents = [b.joint for b in bodies], np.full(count, -1, dtype=np.int32)
    frames, child_frames = np.tile(IDENTITY, (count, 1)), np.tile(IDENTITY, (count, 1))
    poses = np.array([b.pose for b in bodies])
    starts: dict[str, np.ndarray] = {"q_start": np.zeros(count, dtype=np.int32), "v_start": np.zeros(count, dtype=np.int32)}
    q0: list[np.ndarray] = []
    v0: list[np.ndarray] = []
    dofs: list[tuple[Any, ...]] = []
    joint_names, dof_names = [""] * count, list[str]()
    axes: list[np.ndarray] = []  # [6, n] of each body's velocities, at the world's origin
    by_inertia: list[int] = []  # drives that ask for accelerations
    moved: list[tuple[float, str]] = []
    carriers: dict[int, np.ndarray] = {}  # by which displacement a body is carried from where it was said to stand
    twists = np.zeros((count + 1, 6))  # velocity at the world's origin, angular velocity; the world's own is the last
    for b in order:
        body, joint = bodies[b], carried[b]
        starts["q_start"][b], starts["v_start"][b] = sum(map(len, q0)), len(dofs)
        if joint is None:
            if body.joint is JointType.FIXED:
                frames[b] = body.pose
                continue
            kind = DofKind.FREE if body.joint is JointType.FREE else DofKind.PRESCRIBED
            q0.append(body.pose)
            v0.append(np.r_[body.velocity, body.angular_velocity])
            dof_names += [body.name] * 6
            dofs += [(b, kind, np.eye(3)[k % 3], 0.0, 0.0, 0.0, NO_LIMIT, NO_DRIVE) for k in range(6)]
            centre = body.pose[:3] + rotate(body.pose[3:], com[b])
            turns = np.r_[np.cross(centre, np.eye(3)).T, np.eye(3)]
            axes.append(np.c_[np.eye(6, 3), turns] if kind is DofKind.FREE else np.zeros((6, 6)))
            twists[b] = np.r_[body.velocity + np.cross(centre, body.angular_velocity), body.angular_velocity]
            continue
        types[b], parents[b], frames[b], child_frames[b] = joint.type, joint.parent, joint.parent_frame, joint.child_frame
        if joint.type is JointType.FIXED:  # one frame is enough
            frames[b], child_frames[b] = compose(joint.parent_frame, inverse(joint.child_frame)), np.array(IDENTITY)
        frame = joint.parent_frame if joint.parent < 0 else compose(poses[joint.parent], joint.parent_frame)
        # What a joint with a given coordinate carries stands as if carried there.
        carried_by = carriers.get(joint.parent)
        asked_pose = body.pose if carried_by is None else compose(carried_by, body.pose)
        if b >= given:
            asked_pose = poses[whole[b]]  # where the rest of it is
        q = coordinates(joint, compose(inverse(frame), compose(asked_pose, joint.child_frame)))
        if joint.start is not None:
            q = np.where(np.isnan(joint.start), q, joint.start)
        placed = compose(frame, pose_of(joint, q))
        poses[b] = compose(placed, inverse(joint.child_frame))
        if joint.start is None:  # the child's frame is the joint's: what turns there does not count as moved
            away = float(np.linalg.norm(placed[:3] - compose(asked_pose, joint.child_frame)[:3]))
            if away > MOVED:
                moved.append((away, body.name))
        if joint.start is not None:
            carried_by = compose(poses[b], inverse(body.pose))
        if carried_by is not None:
            carriers[b] = carried_by
        moves = columns(joint, frame, q)
        centre = poses[b][:3] + rotate(poses[b][3:], com[b])
        asked = np.r_[body.velocity + np.cross(centre, body.angular_velocity), body.angular_velocity]
        if b >= given:
            asked = twists[whole[b]]
        v = np.linalg.lstsq(moves, asked - twists[joint.parent], rcond=None)[0] if any(asked) else np.zeros(moves.shape[1])
        if joint.start_velocity is not None:
            v = np.where(np.isnan(joint.start_velocity), v, joint.start_velocity)
        twists[b] = twists[joint.parent] + moves @ v
        q0.append(q)
        v0.append(v)
        axis = directions(joint)
        axes.append(moves)
        if joint.acceleration is not None:
            by_inertia += (len(dofs) + np.flatnonzero(joint.acceleration)).tolist()
        joint_names[b], dof_names = joint.name, [*dof_names, *(joint.names or [joint.name] * len(axis))]
        numbers = (joint.armature, joint.damping, joint.friction, joint.limit, joint.drive)
        dofs += list(zip([b] * len(axis), kinds(joint), axis, *numbers, strict=True))
    columns_of = list(zip(*dofs, strict=True))
    drive = np.array(columns_of[7], dtype=float).reshape(-1, 5)
    if by_inertia:
        owner, armature = np.array(columns_of[0]), np.array(columns_of[3], dtype=float)
        # What carries a part of a body sees all of it.
        matrix = mass_matrix(parents, order, owner, np.concatenate(axes, axis=1), poses, entire[0], com, entire[1])
        matrix[np.diag_indices(len(owner))] += armature
        drive[by_inertia, :2] /= np.linalg.inv(matrix)[by_inertia, by_inertia, None]
    if moved:
        far, worst = max(moved)
        what = f"{len(moved)} bodies do" if len(moved) > 1 else f"{worst} does"
        which = f", {worst} by {far:.3g} m" if len(moved) > 1 else f" by {far:.3g} m"
        notes.insert(0, f"{what} not stand where joints let them: moved there{which}")
    return {
        "body_names": tuple(b.name for b in bodies),
        "part_of": np.array([b if body.part_of is None else body.part_of for b, body in enumerate(bodies)], dtype=np.int32),
        "mass": mass,
        "com": com,
        "inertia": inertia,
        "body_parent": parents,
        "joint_names": tuple(joint_names),
        "dof_names": tuple(dof_names),
        "joint_type": np.array(types, dtype=np.int32),
        "joint_pose": frames,
        "joint_child_pose": child_frames,
        **starts,
        "q0": np.concatenate(q0),
        "v0": np.concatenate(v0),
        "dof_body": np.array(columns_of[0], dtype=np.int32),
        "dof_kind": np.array(columns_of[1], dtype=np.int32),
        "dof_axis": np.array(columns_of[2], dtype=float),
        "armature": np.array(columns_of[3], dtype=float),
        "damping": np.array(columns_of[4], dtype=float),
        "joint_friction": np.array(columns_of[5], dtype=float),
        "limit": np.array(columns_of[6], dtype=float).reshape(-1, 2),
        "drive": drive,
        "loops": tuple(loop_of(joint) for joint in loops),
    }, notes
