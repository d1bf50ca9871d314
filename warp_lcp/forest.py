# SPDX-License-Identifier: Apache-2.0
"""From bodies and the joints between them to kinematic trees: which joint carries which body, where it stands, what closes loops."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from . import joints as geometry
from .errors import ModelError
from .joints import (
    AXES,
    Joint,
    acts,
    columns,
    compose,
    coordinates,
    cross,
    directions,
    inverse,
    kinds,
    mass_matrix,
    pose_of,
    rotate,
    turned,
)
from .model import DofKind, JointType, Loop, parents_first

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
NO_LIMIT, NO_DRIVE = (-np.inf, np.inf), (0.0, 0.0, np.inf, 0.0, 0.0)
MOVED = 1e-5  # from here on it is told that a joint moves a body, starts beyond a limit or is open [m, rad]


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


def spanning(bodies: list[Body], joints: list[Joint], mass: np.ndarray) -> tuple[list[Joint | None], list[Joint]]:
    """Joint that carries each body (None: free, kinematic or fixed), and joints that close loops.

    Bodies that are joined to the world, or to a body that forces do not move, hang there; of others the first one is free and carries
    the rest. Which joints carry, so that loops are cut at others: first those that let nothing move, then those of bodies that have no
    ``mass`` [B] and must be carried and carry, then those along which something acts. Among alike breadth first, so that loops are cut far
    from the root.
    """
    neighbours: dict[int, list[tuple[Joint, int]]] = {b: [] for b in range(-1, len(bodies))}
    for joint in (joint for joint in joints if not joint.loop):
        neighbours[joint.parent].append((joint, joint.child))
        neighbours[joint.child].append((joint, joint.parent))
    held = {b for joint in joints if joint.type is JointType.FIXED and not joint.loop for b in (joint.parent, joint.child)}
    between = {b for b in range(len(bodies)) if mass[b] == 0.0 and bodies[b].joint is JointType.FREE} - held
    carried: dict[int, Joint | None] = {-1: None}
    used: set[int] = set()
    ahead: list[list[tuple[Joint, int]]] = [[], [], [], []]  # joints with where they lead, by rank

    def rank(joint: Joint) -> int:
        return 0 if joint.type is JointType.FIXED else 1 if {joint.parent, joint.child} & between else 2 if acts(joint) else 3

    def reach(b: int) -> None:
        for joint, other in neighbours[b]:
            ahead[rank(joint)].append((joint, other))

    def spread(roots: list[int]) -> None:
        for b in roots:
            reach(b)
        while queue := next((queue for queue in ahead if queue), None):
            joint, other = queue.pop(0)
            if other not in carried:
                carried[other] = joint if joint.child == other else turned(joint)
                used.add(id(joint))
                reach(other)

    still = [b for b, body in enumerate(bodies) if body.joint is not JointType.FREE]
    for b in still:
        carried[b] = None
    spread([-1, *still])
    for b in range(len(bodies)):
        if b not in carried:
            carried[b] = None
            spread([b])
    return [carried[b] for b in range(len(bodies))], [joint for joint in joints if id(joint) not in used]


def cut(bodies: list[Body], joints: list[Joint], mass: np.ndarray) -> tuple[list[Body], list[Joint]]:
    """Bodies and joints in which whatever acts along a joint acts along a coordinate, also where the joint closes a loop.

    A constraint has no coordinate that could be limited, driven or damped. Such a joint carries a part of its child instead (of its
    parent, where forces do not move the child or it has no ``mass``), and the part is welded to the rest, which closes the loop. So do
    joints of stacked axes. The parts stand behind all other bodies, each with an equal share of the mass.
    """
    carried, loops = spanning(bodies, joints, mass)
    moves = {-1: False}
    for b in parents_first([-1 if joint is None else joint.parent for joint in carried]):
        joint = carried[b]
        moves[b] = bodies[b].joint is JointType.FREE if joint is None else joint.type is not JointType.FIXED or moves[joint.parent]
    bodies, joints = list(bodies), list(joints)
    for joint in loops:
        solid = [b for b in (joint.child, joint.parent) if moves[b] and mass[b] > 0.0]
        if joint.distance is not None or not solid or not (acts(joint) or joint.directions is not None):
            continue
        whole, part = solid[0], len(bodies)
        bodies.append(replace(bodies[whole], name=f"{joint.name}:part", part_of=whole))
        at = next(k for k, other in enumerate(joints) if other is joint)
        parent, child = (joint.parent, part) if whole == joint.child else (part, joint.child)
        joints[at] = replace(joint, loop=False, parent=parent, child=child)
        still, nothing = np.array(IDENTITY), np.zeros(0)
        along = (nothing, nothing, nothing, np.zeros((0, 2)), np.zeros((0, 5)))
        joints.append(Joint(f"{joint.name}:weld", JointType.FIXED, whole, part, still, still, (), *along, loop=True))
    return bodies, joints


def start_of(joint: Joint, q: np.ndarray, free: bool) -> np.ndarray:
    """Coordinates at the start: the joint's own where it has some and is ``free`` to choose them, else q, which its bodies ask for.

    Bodies tell angles but for whole turns: what the joint's own are nearest to or, without any, what its limits allow.
    """
    start = np.full(len(q), np.nan) if joint.start is None else joint.start
    if joint.type is not JointType.SPHERICAL:
        angles = np.array([kind is DofKind.ANGULAR for kind in kinds(joint)], dtype=bool)
        turns = np.where(np.isnan(start), 0.0, np.round((start - q) / (2.0 * np.pi)))
        for k in np.flatnonzero(angles & np.isnan(start)):
            low, high = joint.limit[k]
            turns[k] = next((n for n in (0, 1, -1) if low <= q[k] + 2.0 * np.pi * n <= high), 0)
        q = q + 2.0 * np.pi * angles * turns
    return np.where(np.isnan(start), q, start) if free else q


def loop_of(joint: Joint) -> Loop:
    """The same joint as a constraint."""
    if joint.directions is not None:
        raise ModelError(f"{joint.name}: a joint of stacked axes closes a loop, and no body beside it has mass and is moved by forces")
    x, y, z, rx, ry, rz = (axis not in joint.axes for axis in AXES)
    frames = np.array([joint.parent_frame, joint.child_frame])
    return Loop(joint.name, (joint.parent, joint.child), frames, (x, y, z), (rx, ry, rz), joint.distance)


class Arrangement:
    """Bodies on their joints: gathers Model's fields of bodies, joints and coordinates from the roots on, parents first.

    Args:
        shaped: bodies that have shapes. mass, com, inertia: [B], [B, 3], [B, 3, 3] of the bodies.

    Raises:
        ModelError: for a body without mass that needs some.
    """

    def __init__(
        self, bodies: list[Body], joints: list[Joint], shaped: Collection[int], mass: np.ndarray, com: np.ndarray, inertia: np.ndarray
    ):
        self.given = len(bodies)
        self.bodies, joints = cut(bodies, joints, mass)
        count = len(self.bodies)
        mass = np.r_[mass, [mass[b.part_of] for b in self.bodies[self.given :]]]
        self.carried, self.loops = spanning(self.bodies, joints, mass)
        self.order = parents_first([-1 if joint is None else joint.parent for joint in self.carried])
        self._check_masses(shaped, mass)
        self.whole = np.array([b if b < self.given else body.part_of for b, body in enumerate(self.bodies)])
        self.share = 1.0 / np.bincount(self.whole)[self.whole]
        self.mass, self.com, self.inertia = mass, com[self.whole], inertia[self.whole]  # a part has those of all of it here
        self.types, self.parents = [b.joint for b in self.bodies], np.full(count, -1, dtype=np.int32)
        self.frames, self.child_frames = np.tile(IDENTITY, (count, 1)), np.tile(IDENTITY, (count, 1))
        self.poses = np.array([b.pose for b in self.bodies])
        self.q_start, self.v_start = np.zeros(count, dtype=np.int32), np.zeros(count, dtype=np.int32)
        self.q0: list[np.ndarray] = []
        self.v0: list[np.ndarray] = []
        self.dofs: list[tuple[Any, ...]] = []
        self.joint_names, self.dof_names = [""] * count, list[str]()
        self.axes: list[np.ndarray] = []  # [6, n] of each body's velocities, at the world's origin
        self.by_inertia: list[int] = []  # drives that ask for accelerations
        self.moved: list[tuple[float, str]] = []  # what joints move at the start, by how much [m]
        self.beyond: list[str] = []  # joints that start beyond their limits, and where
        self.carriers: dict[int, np.ndarray] = {}  # by which displacement a body is carried from where it was said to stand
        self.twists = np.zeros((count + 1, 6))  # velocity at the world's origin, angular velocity; the world's own is the last
        for b in self.order:
            joint = self.carried[b]
            self.q_start[b], self.v_start[b] = sum(map(len, self.q0)), len(self.dofs)
            if joint is None:
                self._stand(b)
            else:
                self._hang(b, joint)

    def _check_masses(self, shaped: Collection[int], mass: np.ndarray) -> None:
        carries = {joint.parent for joint in self.carried if joint is not None}
        hanging = mass.copy()  # what hangs on a body, itself included
        for b in self.order[::-1]:
            joint = self.carried[b]
            if joint is not None and joint.parent >= 0:
                hanging[joint.parent] += hanging[b]
        for b, body in enumerate(self.bodies):
            joint = self.carried[b]
            if body.mass == 0.0 and (joint is None or b not in carries or b in shaped):
                why = "only what hangs on a joint, carries another body and has no shape may have none"
                raise ModelError(f"{body.name}: mass is 0 kg; {why}")
            if joint is not None and joint.axes and hanging[b] == 0.0 and not joint.armature.all():
                raise ModelError(f"{joint.name}: nothing that it carries has mass; give {body.name} some, or the joint an armature")

    def _stand(self, b: int) -> None:
        """A body that no joint carries: free, kinematic or fixed."""
        body = self.bodies[b]
        if body.joint is JointType.FIXED:
            self.frames[b] = body.pose
            return
        kind = DofKind.FREE if body.joint is JointType.FREE else DofKind.PRESCRIBED
        self.q0.append(body.pose)
        self.v0.append(np.r_[body.velocity, body.angular_velocity])
        self.dof_names += [body.name] * 6
        self.dofs += [(b, kind, np.eye(3)[k % 3], 0.0, 0.0, 0.0, NO_LIMIT, NO_DRIVE) for k in range(6)]
        centre = body.pose[:3] + rotate(body.pose[3:], self.com[b])
        turns = np.r_[cross(centre, np.eye(3)).T, np.eye(3)]
        self.axes.append(np.c_[np.eye(6, 3), turns] if kind is DofKind.FREE else np.zeros((6, 6)))
        self.twists[b] = self._asked_twist(b, body.pose)

    def _asked_twist(self, b: int, pose: np.ndarray) -> np.ndarray:
        body = self.bodies[b]
        centre = pose[:3] + rotate(pose[3:], self.com[b])
        return np.r_[body.velocity + cross(centre, body.angular_velocity), body.angular_velocity]

    def _hang(self, b: int, joint: Joint) -> None:
        """A body on the joint that carries it, at the coordinates nearest to where it was said to stand unless it has others."""
        body, part = self.bodies[b], b >= self.given
        self.types[b], self.parents[b] = joint.type, joint.parent
        self.frames[b], self.child_frames[b] = joint.parent_frame, joint.child_frame
        if joint.type is JointType.FIXED:  # one frame is enough
            self.frames[b] = compose(joint.parent_frame, inverse(joint.child_frame))
            self.child_frames[b] = IDENTITY
        frame = joint.parent_frame if joint.parent < 0 else compose(self.poses[joint.parent], joint.parent_frame)
        # What a joint with a given coordinate carries stands as if carried there; a part of a body where the rest of it is.
        carrier = self.carriers.get(joint.parent)
        asked = self.poses[self.whole[b]] if part else body.pose if carrier is None else compose(carrier, body.pose)
        q = start_of(joint, coordinates(joint, compose(inverse(frame), compose(asked, joint.child_frame))), not part)
        placed = compose(frame, pose_of(joint, q))
        self.poses[b] = compose(placed, inverse(joint.child_frame))
        if joint.start is None or part:  # the child's frame is the joint's: what turns there does not count as moved
            away = float(np.linalg.norm(placed[:3] - compose(asked, joint.child_frame)[:3]))
            if away > MOVED and not part:  # a part that is away leaves its loop open
                self.moved.append((away, body.name))
        else:
            carrier = compose(self.poses[b], inverse(body.pose))
        if carrier is not None:
            self.carriers[b] = carrier
        if joint.type is not JointType.SPHERICAL:
            for k in np.flatnonzero((q < joint.limit[:, 0] - MOVED) | (q > joint.limit[:, 1] + MOVED)):
                low, high = joint.limit[k]
                self.beyond.append(f"{joint.names[k] if joint.names else joint.name} (at {q[k]:.4g}, limits {low:.4g} .. {high:.4g})")
        moves = columns(joint, frame, q)
        twist = self.twists[self.whole[b]] if part else self._asked_twist(b, self.poses[b])
        v = np.zeros(moves.shape[1])
        if part or body.velocity.any() or body.angular_velocity.any():
            v = np.linalg.lstsq(moves, twist - self.twists[joint.parent], rcond=None)[0]
        if joint.start_velocity is not None and not part:
            v = np.where(np.isnan(joint.start_velocity), v, joint.start_velocity)
        self.twists[b] = self.twists[joint.parent] + moves @ v
        self.q0.append(q)
        self.v0.append(v)
        self.axes.append(moves)
        if joint.acceleration is not None:
            self.by_inertia += (len(self.dofs) + np.flatnonzero(joint.acceleration)).tolist()
        along = directions(joint)
        self.joint_names[b], self.dof_names = joint.name, [*self.dof_names, *(joint.names or [joint.name] * len(along))]
        numbers = (joint.armature, joint.damping, joint.friction, joint.limit, joint.drive)
        self.dofs += list(zip([b] * len(along), kinds(joint), along, *numbers, strict=True))

    @property
    def notes(self) -> list[str]:
        """What is to be told of it."""
        found = []
        if self.moved:
            far, worst = max(self.moved)
            what = f"{len(self.moved)} bodies do" if len(self.moved) > 1 else f"{worst} does"
            which = f", {worst} by {far:.3g} m" if len(self.moved) > 1 else f" by {far:.3g} m"
            found.append(f"{what} not stand where joints let them: moved there{which}")
        for body in self.bodies[self.given :]:
            name, of = body.name.removesuffix(":part"), self.bodies[body.part_of or 0].name
            found.append(f"{name}: closes a loop, and something acts along it: it carries a part of {of} that is welded to the rest")
        if self.beyond:
            rest = f" and {len(self.beyond) - 3} more" if len(self.beyond) > 3 else ""
            found.append(f"{', '.join(self.beyond[:3])}{rest}: starts beyond its limits, which push it back at once")
        for joint in self.loops:
            way, turn = geometry.apart(loop_of(joint), self.poses)
            if max(way, turn) > MOVED:
                what = "a distance out of its range" if joint.distance is not None else "a loop that is open"
                by = " and ".join(f"{x:.3g} {unit}" for x, unit in ((way, "m"), (turn, "rad")) if x > MOVED)
                mend = "it is pulled there, for ever where it cannot get there; mend its frames, or where bodies stand"
                found.append(f"{joint.name.removesuffix(':weld')}: {what} at the start, by {by}: {mend}")
        lost = [joint.name for joint in self.loops if joint.distance is None and acts(joint)]
        why = "closes a loop between bodies that forces do not move, or without mass: its limits, drives and the like are left out"
        return found + [f"{name}: {why}" for name in lost]

    @property
    def fields(self) -> dict[str, Any]:
        """Of :class:`Model`."""
        owner, kind, axis, armature, damping, friction, limit, drive = (list(column) for column in zip(*self.dofs, strict=True))
        return {
            "body_names": tuple(b.name for b in self.bodies),
            "part_of": np.array([b if body.part_of is None else body.part_of for b, body in enumerate(self.bodies)], dtype=np.int32),
            "mass": self.share * self.mass,
            "com": self.com,
            "inertia": self.share[:, None, None] * self.inertia,
            "body_parent": self.parents,
            "joint_names": tuple(self.joint_names),
            "dof_names": tuple(self.dof_names),
            "joint_type": np.array(self.types, dtype=np.int32),
            "joint_pose": self.frames,
            "joint_child_pose": self.child_frames,
            "q_start": self.q_start,
            "v_start": self.v_start,
            "q0": np.concatenate(self.q0),
            "v0": np.concatenate(self.v0),
            "dof_body": np.array(owner, dtype=np.int32),
            "dof_kind": np.array(kind, dtype=np.int32),
            "dof_axis": np.array(axis, dtype=float),
            "armature": np.array(armature, dtype=float),
            "damping": np.array(damping, dtype=float),
            "joint_friction": np.array(friction, dtype=float),
            "limit": np.array(limit, dtype=float).reshape(-1, 2),
            "drive": self._forces(np.array(owner), np.array(armature, dtype=float), np.array(drive, dtype=float).reshape(-1, 5)),
            "loops": tuple(loop_of(joint) for joint in self.loops),
        }

    def _forces(self, owner: np.ndarray, armature: np.ndarray, drive: np.ndarray) -> np.ndarray:
        """Drives [nv, 5] with the gains of those that ask for accelerations times the inertia that their joints see here.

        A body that is parted is whole for each: where it hangs itself, or where its part does.
        """
        axes = np.concatenate(self.axes, axis=1)
        for i in self.by_inertia:
            here = (np.arange(len(self.bodies)) < self.given) | (np.arange(len(self.bodies)) == owner[i])
            masses = (here * self.mass, self.com, here[:, None, None] * self.inertia)
            matrix = mass_matrix(self.parents, self.order, owner, axes, self.poses, *masses)
            matrix[np.diag_indices(len(owner))] += armature + (np.diag(matrix) == 0.0)
            drive[i, :2] /= np.linalg.inv(matrix)[i, i]
        return drive
