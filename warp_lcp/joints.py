# SPDX-License-Identifier: Apache-2.0
"""Joints between two bodies: what they leave free, coordinates to poses and back, and how velocities move what they carry.

A joint is a sequence of ways and turns, each along or about an axis as moved by those before it. Those of D6 joints lie along the axes of
the frame, ways first; where ``Joint.directions`` says so they lie anywhere, in any order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .errors import ModelError
from .model import DofKind, JointType, Loop

AXES = ("tx", "ty", "tz", "rx", "ry", "rz")
SEARCH_ROUNDS = 100  # of coordinates nearest to a pose


@dataclass
class Joint:
    """A joint between two bodies, -1 = the world; ``axes`` are free. Frames (x y z qx qy qz qw) in the bodies' own frames.

    ``directions`` [n, 3]: where the axes lie in the frame; ``axes`` are then "t" and "r". None: where their names say.
    ``start``, ``start_velocity``: coordinates at the start and their velocities; None or NaN: those nearest to what the bodies do.
    ``acceleration`` [n]: which drives have gains for each kg or kg m^2 that the joint sees. ``names`` [n]: of the axes, None: the joint's.
    """

    name: str
    type: JointType
    parent: int
    child: int
    parent_frame: np.ndarray
    child_frame: np.ndarray
    axes: tuple[str, ...]
    armature: np.ndarray
    damping: np.ndarray
    friction: np.ndarray
    limit: np.ndarray
    drive: np.ndarray
    distance: tuple[float, float] | None = None
    collide: bool = False
    loop: bool = False
    directions: np.ndarray | None = None
    start: np.ndarray | None = None
    start_velocity: np.ndarray | None = None
    acceleration: np.ndarray | None = None
    names: tuple[str, ...] | None = None


#: Components of a cross product: x y z of one factor meet these of the other, and these z x y.
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b of vectors [..., 3], to the last bit np.cross, which takes five times as long for a single one."""
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of quaternions (x y z w), [..., 4] as all below."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    return np.concatenate([aw * bv + bw * av + cross(av, bv), aw * bw - (av * bv).sum(axis=-1, keepdims=True)], axis=-1)


def conjugate(a: np.ndarray) -> np.ndarray:
    return a * np.array([-1.0, -1.0, -1.0, 1.0])


def rotate(a: np.ndarray, x: np.ndarray) -> np.ndarray:
    return x + 2.0 * cross(a[..., :3], cross(a[..., :3], x) + a[..., 3:] * x)


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pose b in the frame of pose a, [..., 7]."""
    turn = multiply(a[..., 3:], b[..., 3:])
    place = a[..., :3] + rotate(a[..., 3:], b[..., :3])
    return np.concatenate([place, turn / np.linalg.norm(turn, axis=-1, keepdims=True)], axis=-1)


def inverse(a: np.ndarray) -> np.ndarray:
    back = conjugate(a[..., 3:])
    return np.concatenate([-rotate(back, a[..., :3]), back], axis=-1)


def about(axis: int | np.ndarray, angle: float) -> np.ndarray:
    direction = np.eye(3)[axis] if isinstance(axis, int) else axis
    return np.r_[np.sin(0.5 * angle) * direction, np.cos(0.5 * angle)]


def directions(joint: Joint) -> np.ndarray:
    """[n, 3] of the joint's axes in its frame."""
    if joint.directions is not None:
        return joint.directions
    return np.array([np.eye(3)["xyz".index(axis[1])] for axis in joint.axes]).reshape(-1, 3)


def kinds(joint: Joint) -> list[DofKind]:
    """Of the joint's velocities."""
    if joint.type is JointType.SPHERICAL:
        return [DofKind.BALL, DofKind.BALL_ON, DofKind.BALL_ON]
    return [DofKind.LINEAR if axis[0] == "t" else DofKind.ANGULAR for axis in joint.axes]


def coordinates(joint: Joint, pose: np.ndarray) -> np.ndarray:
    """q nearest to a pose of the frame on the child in that on the parent."""
    if joint.directions is not None:
        return _searched(joint, pose)
    q = [pose["xyz".index(axis[1])] for axis in joint.axes if axis[0] == "t"]
    turn = pose[3:] if pose[6] >= 0.0 else -pose[3:]
    if joint.type is JointType.SPHERICAL:
        return np.r_[q, turn]
    return np.r_[q, _angles(["xyz".index(axis[1]) for axis in joint.axes if axis[0] == "r"], turn)]


def _searched(joint: Joint, pose: np.ndarray) -> np.ndarray:
    """The same where the axes lie anywhere: Gauss and Newton's method from zero, m beside rad."""
    q = np.zeros(len(joint.axes))
    for _ in range(SEARCH_ROUNDS):
        here = pose_of(joint, q)
        turn = multiply(pose[3:], conjugate(here[3:]))
        error = np.r_[pose[:3] - here[:3], 2.0 * (turn[:3] if turn[3] >= 0.0 else -turn[:3])]
        rates = columns(joint, np.r_[np.zeros(6), 1.0], q)
        rates[:3] += cross(rates[3:].T, here[:3]).T  # of the frame on the child
        change = np.linalg.lstsq(rates, error, rcond=1e-6)[0]
        q += change
        if np.abs(change).max(initial=0.0) < 1e-14:
            break
    return q


def _angles(axes: list[int], turn: np.ndarray) -> np.ndarray:
    """Angles about one, two or three axes in ascending order, each as turned by those before it, nearest to a rotation."""
    if not axes:
        return np.zeros(0)
    if len(axes) == 1:
        return np.array([2.0 * np.arctan2(turn[axes[0]], turn[3])])
    matrix = np.array([rotate(turn, e) for e in np.eye(3)]).T
    if len(axes) == 3:  # R_x R_y R_z
        return np.array(
            [np.arctan2(-matrix[1, 2], matrix[2, 2]), np.arcsin(np.clip(matrix[0, 2], -1.0, 1.0)), np.arctan2(-matrix[0, 1], matrix[0, 0])]
        )
    # R_a R_b = R: the second axis is where R_a has carried it, R e_b = R_a e_b; the first is fixed in the child but for R_b.
    a, b = axes
    c = 3 - a - b
    sign = 1.0 if (b - a) % 3 == 1 else -1.0  # e_a x e_b = sign e_c
    first = np.arctan2(sign * matrix[c, b], matrix[b, b])
    rest = multiply(about(a, -first), turn)
    return np.array([first, 2.0 * np.arctan2(rest[b], rest[3])])


def pose_of(joint: Joint, q: np.ndarray) -> np.ndarray:
    """Pose of the frame on the child in that on the parent."""
    pose = np.r_[np.zeros(6), 1.0]
    if joint.type is JointType.SPHERICAL:
        pose[3:] = q / np.linalg.norm(q)
        return pose
    for axis, direction, value in zip(joint.axes, directions(joint), q, strict=True):
        if axis[0] == "t":
            pose[:3] += value * rotate(pose[3:], direction)
        else:
            pose[3:] = multiply(pose[3:], about(direction, value))
    return pose


def columns(joint: Joint, frame: np.ndarray, q: np.ndarray) -> np.ndarray:
    """[6, n] twist of the child relative to the parent (velocity at the world's origin, angular) by each coordinate's velocity."""
    x, turn, result = frame[:3].copy(), frame[3:], []
    spherical = joint.type is JointType.SPHERICAL
    if spherical:
        turn = multiply(turn, q / np.linalg.norm(q))
    for axis, own, value in zip(joint.axes, directions(joint), q, strict=False):
        direction = rotate(turn, own)
        if axis[0] == "t":
            x += value * direction
            result.append(np.r_[direction, np.zeros(3)])
        else:
            result.append(np.r_[cross(x, direction), direction])
            if not spherical:
                turn = multiply(turn, about(own, value))
    return np.array(result).reshape(-1, 6).T


def mass_matrix(
    parents: np.ndarray,
    order: list[int],
    owner: np.ndarray,
    axes: np.ndarray,
    poses: np.ndarray,
    mass: np.ndarray,
    com: np.ndarray,
    inertia: np.ndarray,
) -> np.ndarray:
    """[nv, nv] M without armature; ``axes`` [6, nv] twists at the world's origin, zero where they are prescribed: M_ii is 1 there.

    For once, at the start: a simulator has its own (kernels/tree.py).
    """
    matrix, paths = np.zeros((axes.shape[1],) * 2), {-1: np.zeros(0, dtype=int)}
    for b in order:
        path = paths[b] = np.r_[paths[int(parents[b])], np.flatnonzero(owner == b)]
        centre = poses[b, :3] + rotate(poses[b, 3:], com[b])
        turn = np.array([rotate(poses[b, 3:], e) for e in np.eye(3)])
        velocity, spin = axes[:3, path] + cross(axes[3:, path].T, centre).T, turn @ axes[3:, path]
        matrix[np.ix_(path, path)] += mass[b] * velocity.T @ velocity + spin.T @ inertia[b] @ spin
    still = ~axes.any(axis=0)
    matrix[still, still] = 1.0
    return matrix


def apart(loop: Loop, poses: np.ndarray) -> np.ndarray:
    """How far the frames of a loop are from where it holds them, [..., 2] m and rad, with bodies at poses [..., B, 7].

    A distance: how far it is out of its range.
    """
    ends = zip(loop.bodies, loop.frames, strict=True)
    a, b = (compose(poses[..., body, :], frame) if body >= 0 else np.broadcast_to(frame, poses[..., 0, :].shape) for body, frame in ends)
    if loop.distance is not None:
        distance = np.linalg.norm(b[..., :3] - a[..., :3], axis=-1)
        way = np.maximum(np.maximum(loop.distance[0] - distance, distance - loop.distance[1]), 0.0)
        return np.stack([way, np.zeros_like(way)], axis=-1)
    between = compose(inverse(a), b)
    way = np.linalg.norm(between[..., :3] * loop.ways, axis=-1)
    axes = np.stack([rotate(between[..., 3:], e) for e in np.eye(3)], axis=-1)  # of b in a: [..., i, k] coordinate i of axis k
    free = [k for k in range(3) if not loop.turns[k]]
    turn = np.zeros_like(way)
    if len(free) == 0:
        turn = 2.0 * np.arctan2(np.linalg.norm(between[..., 3:6], axis=-1), np.abs(between[..., 6]))
    elif len(free) == 1:  # the axis that both turn about
        along = axes[..., free[0], free[0]]
        turn = np.arctan2(np.linalg.norm(np.delete(axes[..., free[0]], free[0], axis=-1), axis=-1), along)
    elif len(free) == 2:  # of which the first is carried by a, the second by b: they stay perpendicular
        turn = np.abs(np.arcsin(np.clip(axes[..., free[0], free[1]], -1.0, 1.0)))
    return np.stack([way, turn], axis=-1)


def acts(joint: Joint) -> bool:
    """Does anything act along the joint's coordinates?"""
    along = (np.isfinite(joint.limit), joint.drive[:, :2], joint.armature, joint.damping, joint.friction)
    return any(bool(values.any()) for values in along)


def turned(joint: Joint) -> Joint:
    """The same joint followed back: coordinates keep their signs (a ball's turns the other way), not their order."""
    if (len(joint.axes) > 1 or joint.directions is not None) and joint.type is not JointType.SPHERICAL:
        per_axis = {n: getattr(joint, n)[::-1] for n in ("armature", "damping", "friction", "limit", "drive")}
        per_axis |= {
            n: None if getattr(joint, n) is None else getattr(joint, n)[::-1] for n in ("start", "start_velocity", "acceleration", "names")
        }
        return replace(
            joint,
            type=JointType.D6,
            parent=joint.child,
            child=joint.parent,
            parent_frame=joint.child_frame,
            child_frame=joint.parent_frame,
            axes=tuple(axis[0] for axis in joint.axes[::-1]),
            directions=-directions(joint)[::-1],
            **per_axis,
        )
    half = np.array([0.0, 0.0, 0.0, 1.0])
    if len(joint.axes) == 1:  # about another axis by a half turn: the free axis then points the other way
        half = about(("xyz".index(joint.axes[0][1]) + 1) % 3, np.pi)
    half = np.r_[np.zeros(3), half]
    start, rate = joint.start, joint.start_velocity
    if joint.type is JointType.SPHERICAL:
        if rate is not None:
            if start is None:
                raise ModelError(f"{joint.name}: a velocity at the start needs coordinates there, as its first body hangs on its second")
            rate = -rotate(start, rate)  # from axes of the child to those of the parent
        start = start if start is None else conjugate(start)
    return replace(
        joint,
        parent=joint.child,
        child=joint.parent,
        parent_frame=compose(joint.child_frame, half),
        child_frame=compose(joint.parent_frame, half),
        start=start,
        start_velocity=rate,
    )
