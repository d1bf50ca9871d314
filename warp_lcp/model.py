# SPDX-License-Identifier: Apache-2.0
"""The Model: what a scene is. Immutable, SI units, numpy arrays that cannot be written.

Generalised coordinates follow the paper (eq. 13): configuration q [nq], velocity v [nv], dq/dt = Gamma(q) v and
M(q) dv/dt + c = f. The bodies form a forest of kinematic trees, one joint above each body:

========== ==== ==== ==========================================================================================
joint      nq   nv   coordinates
========== ==== ==== ==========================================================================================
FREE       7    6    q: pose of the body frame in the world (x y z qx qy qz qw); v: velocity of the centre of
                     mass, then angular velocity, both in world axes [m/s, rad/s]. Gamma carries the offset
                     between body frame and centre of mass.
KINEMATIC  7    6    the same coordinates, prescribed: the body moves with v whatever touches it
FIXED      0    0    rigidly attached to its parent
========== ==== ==== ==========================================================================================
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np


class JointType(enum.IntEnum):
    """How a body hangs on its parent."""

    FREE = 0
    KINEMATIC = 1
    FIXED = 2


class ShapeType(enum.IntEnum):
    """Collision shapes. Pairs are stored with the lower type first."""

    PLANE = 0
    SPHERE = 1
    BOX = 2
    CAPSULE = 3


#: Contact points that a pair of shapes can make, by (lower type, higher type); pairs not listed never touch.
CONTACT_POINTS: dict[tuple[ShapeType, ShapeType], int] = {
    (ShapeType.PLANE, ShapeType.SPHERE): 1,
    (ShapeType.PLANE, ShapeType.BOX): 8,
    (ShapeType.SPHERE, ShapeType.SPHERE): 1,
    (ShapeType.SPHERE, ShapeType.BOX): 1,
    (ShapeType.BOX, ShapeType.BOX): 8,
    (ShapeType.PLANE, ShapeType.CAPSULE): 2,
    (ShapeType.SPHERE, ShapeType.CAPSULE): 1,
    (ShapeType.BOX, ShapeType.CAPSULE): 3,
    (ShapeType.CAPSULE, ShapeType.CAPSULE): 3,
}

#: Contact parameters of Table 1 for a body of 1 kg; an unauthored parameter is this times the mass of the lighter
#: movable body in kg, except the slip threshold, which is a velocity and does not scale.
TABLE_1 = {
    "normal_stiffness": 1e10,  # k_n [N/m]
    "normal_damping": 1e8,  # b_n [N s/m]
    "tangent_stiffness": 1e8,  # k_t [N/m]
    "tangent_damping": 1e5,  # b_t [N s/m]
    "slip_threshold": 1e-3,  # v_s [m/s]
}


@dataclass(frozen=True)
class Material:
    """Contact material of a shape. The coefficients of a pair are the average of its two materials.

    Args:
        static_friction: mu_s, limit of the friction force while sticking.
        dynamic_friction: mu_k, friction force over normal force while sliding.
        normal_stiffness: k_n [N/m]; None takes Table 1 scaled with the mass of the lighter movable body.
        normal_damping: b_n [N s/m]; None as above.
        tangent_stiffness: k_t [N/m] of the bristles; None as above.
        tangent_damping: b_t [N s/m] of the bristles; None as above.
        slip_threshold: v_s [m/s], the speed from which a contact counts as sliding; None takes Table 1.
        restitution: e, normal speed after an impact over that before it (Newton), 0 to 1; averaged like friction.
    """

    static_friction: float = 0.5
    dynamic_friction: float = 0.5
    normal_stiffness: float | None = None
    normal_damping: float | None = None
    tangent_stiffness: float | None = None
    tangent_damping: float | None = None
    slip_threshold: float | None = None
    restitution: float = 0.0


@dataclass(frozen=True)
class Ignored:
    """Something in a scene file that is not simulated: where, what, and why that is so."""

    path: str
    what: str
    why: str


@dataclass(frozen=True)
class Report:
    """What a loader read and what it left out.

    Attributes:
        source: file or object that was read.
        notes: assumptions made where the file is silent, as sentences.
        ignored: what is in the file and is not simulated, where the rest stays right without it.
        unsupported: what is in the file and without which the simulation would be wrong; a Model never has any,
            loading raises instead.
    """

    source: str = "ModelBuilder"
    notes: tuple[str, ...] = ()
    ignored: tuple[Ignored, ...] = ()
    unsupported: tuple[Ignored, ...] = ()


@dataclass(frozen=True)
class Model:
    """One environment's scene. Build it with :class:`warp_lcp.ModelBuilder` or :func:`warp_lcp.load_usd`.

    B bodies, S shapes, P pairs. Poses are (x y z qx qy qz qw) in metres.

    Attributes:
        body_names: name or prim path of each body.
        body_parent: [B] index of the parent body, -1 = world.
        joint_type: [B] :class:`JointType` of the joint above each body.
        joint_pose: [B, 7] frame of that joint in the parent's frame (identity under a FREE or KINEMATIC joint).
        q_start, v_start: [B] first coordinate of each body in q and v.
        q0: [nq] initial configuration. v0: [nv] initial velocity.
        mass: [B] kg. com: [B, 3] centre of mass in the body frame, m.
        inertia: [B, 3, 3] about the centre of mass, body axes, kg m^2.
        shape_names, shape_type, shape_body: [S] name, :class:`ShapeType` and owner (-1 = world).
        shape_pose: [S, 7] pose in the owner's frame.
        shape_size: [S, 3] metres; box: half extents, sphere: radius in [0], capsule: radius in [0], half the length of its
            straight part, which lies along local z, in [1]; plane: unused (normal = local +z).
        shape_surface_velocity: [S, 3] m/s in the shape's frame, velocity of the surface relative to the body (belts).
        friction: [S, 2] static and dynamic coefficient.
        contact: [S, 5] k_n, b_n, k_t, b_t, v_s; NaN where the defaults of Table 1 apply.
        restitution: [S] Newton's e of each material; a pair has the average.
        pairs: [P, 2] shapes that may touch, grouped by kind, the lower ShapeType first.
        gravity: [3] m/s^2.
        up_axis: 'Y' or 'Z', for viewers.
        report: what was read, assumed and ignored.
    """

    body_names: tuple[str, ...]
    body_parent: np.ndarray
    joint_type: np.ndarray
    joint_pose: np.ndarray
    q_start: np.ndarray
    v_start: np.ndarray
    q0: np.ndarray
    v0: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    shape_names: tuple[str, ...]
    shape_type: np.ndarray
    shape_body: np.ndarray
    shape_pose: np.ndarray
    shape_size: np.ndarray
    shape_surface_velocity: np.ndarray
    friction: np.ndarray
    contact: np.ndarray
    restitution: np.ndarray
    pairs: np.ndarray
    gravity: np.ndarray
    up_axis: str = "Z"
    report: Report = field(default_factory=Report)

    def __post_init__(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    @property
    def num_bodies(self) -> int:
        return len(self.body_names)

    @property
    def num_shapes(self) -> int:
        return len(self.shape_names)

    @property
    def nq(self) -> int:
        """Length of q."""
        return len(self.q0)

    @property
    def nv(self) -> int:
        """Length of v."""
        return len(self.v0)

    @property
    def dofs(self) -> int:
        """Degrees of freedom: velocities that forces can change (those of kinematic bodies are prescribed)."""
        return 6 * int(np.count_nonzero(self.joint_type == JointType.FREE))

    @property
    def pair_slots(self) -> np.ndarray:
        """[P + 1] offsets: pair p owns the contact slots pair_slots[p] ... pair_slots[p + 1] - 1."""
        points = [CONTACT_POINTS[ShapeType(self.shape_type[a]), ShapeType(self.shape_type[b])] for a, b in self.pairs]
        return np.concatenate([[0], np.cumsum(points, dtype=np.int64)]).astype(np.int32)

    @property
    def num_slots(self) -> int:
        """Contact points that all pairs together can make."""
        return int(self.pair_slots[-1])

    @property
    def bounces(self) -> bool:
        """Does a pair of materials give back anything of an impact?"""
        return bool(self.restitution[self.pairs].any())

    @property
    def bounded(self) -> bool:
        """Can two shapes touch that both have an end? Before such pairs are looked at they are told apart by their bounds."""
        return bool((self.shape_type[self.pairs] != ShapeType.PLANE).all(axis=-1).any())

    @property
    def bodies_meet(self) -> bool:
        """Can two free bodies touch?"""
        free = np.r_[self.joint_type == JointType.FREE, False]  # the last one is the world, -1
        return bool(free[self.shape_body[self.pairs]].all(axis=-1).any())

    @property
    def max_contacts(self) -> int:
        """Contacts that may act at one time in one environment.

        All slots while there are at most 64, else 24 per movable body if that is more: slots grow with the square of the
        bodies, points that touch at one time do not. What does not fit is dropped and flagged.
        """
        return min(self.num_slots, max(64, 24 * (self.dofs // 6)))
