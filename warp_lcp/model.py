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
REVOLUTE   1    1    angle about x of the joint's frame [rad]
PRISMATIC  1    1    way along x [m]
SPHERICAL  4    3    q: quaternion (x y z w) from the frame on the parent to that on the body; v: angular velocity relative to the
                     parent, axes of the frame on the body
UNIVERSAL  2    2    angles about x, then about y as turned by the first
PLANAR     3    3    ways along x and y, angle about z
D6         n    n    any of the ways tx ty tz, then angles about rx ry rz, each as turned by those before it; or ways and angles
                     along any axes in any order, each as moved by those before it
========== ==== ==== ==========================================================================================

The frame of a joint on its parent and that on its body coincide where q is zero.
"""

from __future__ import annotations

import difflib
import enum
import heapq
from dataclasses import dataclass, field

import numpy as np

from .errors import ModelError


class JointType(enum.IntEnum):
    """How a body hangs on its parent."""

    FREE = 0
    KINEMATIC = 1
    FIXED = 2
    REVOLUTE = 3
    PRISMATIC = 4
    SPHERICAL = 5
    UNIVERSAL = 6
    PLANAR = 7
    D6 = 8


#: What each joint leaves free: ways (t) and angles (r) along the axes of its frame on the parent, in the order of its coordinates.
JOINT_AXES: dict[JointType, tuple[str, ...]] = {
    JointType.FIXED: (),
    JointType.REVOLUTE: ("rx",),
    JointType.PRISMATIC: ("tx",),
    JointType.SPHERICAL: ("rx", "ry", "rz"),
    JointType.UNIVERSAL: ("rx", "ry"),
    JointType.PLANAR: ("tx", "ty", "rz"),
}


class DofKind(enum.IntEnum):
    """How a velocity moves what hangs on it (kernels/tree.py)."""

    LINEAR = 0
    ANGULAR = 1
    BALL = 2  #: the first of three
    BALL_ON = 3
    FREE = 4
    PRESCRIBED = 5


class ShapeType(enum.IntEnum):
    """Collision shapes. Pairs are stored with the lower type first."""

    PLANE = 0
    SPHERE = 1
    BOX = 2
    CAPSULE = 3
    CYLINDER = 4
    CONE = 5
    HULL = 6
    MESH = 7
    ELLIPSOID = 8


#: Shapes whose pairs are looked at with ``shapes.Hulls``.
CONVEX = (ShapeType.CYLINDER, ShapeType.CONE, ShapeType.HULL)
#: Contact points that a pair of shapes can make, by (lower type, higher type), a hull on a plane 0: one for each of its points.
#: Pairs not listed never touch.
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
    (ShapeType.PLANE, ShapeType.CYLINDER): 12,
    (ShapeType.PLANE, ShapeType.CONE): 7,
    (ShapeType.PLANE, ShapeType.HULL): 0,
    **{(ShapeType.SPHERE, kind): 1 for kind in CONVEX},
    **{(ShapeType.CAPSULE, kind): 3 for kind in CONVEX},
    **{(a, b): 8 for b in CONVEX for a in (ShapeType.BOX, *CONVEX) if a <= b},
    (ShapeType.SPHERE, ShapeType.MESH): 8,
    (ShapeType.CAPSULE, ShapeType.MESH): 12,
    **{(kind, ShapeType.MESH): 24 for kind in (ShapeType.BOX, *CONVEX)},
    **{(kind, ShapeType.ELLIPSOID): 8 if kind is ShapeType.MESH else 1 for kind in ShapeType},
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


class Combine(enum.IntEnum):
    """How a coefficient of two materials becomes that of their pair. Where they differ, the higher one rules, as in PhysX."""

    AVERAGE = 0
    MIN = 1
    MULTIPLY = 2
    MAX = 3


@dataclass(frozen=True)
class Material:
    """Contact material of a shape. The coefficients of a pair are the average of its two materials, unless one says otherwise.

    Args:
        static_friction: mu_s, limit of the friction force while sticking.
        dynamic_friction: mu_k, friction force over normal force while sliding.
        normal_stiffness: k_n [N/m]; None takes Table 1 scaled with the mass of the lighter movable body.
        normal_damping: b_n [N s/m]; None as above.
        tangent_stiffness: k_t [N/m] of the bristles; None as above.
        tangent_damping: b_t [N s/m] of the bristles; None as above.
        slip_threshold: v_s [m/s], the speed from which a contact counts as sliding; None takes Table 1.
        restitution: e, normal speed after an impact over that before it (Newton), 0 to 1; averaged like friction.
        friction_combine, restitution_combine: how they become those of a pair.
    """

    static_friction: float = 0.5
    dynamic_friction: float = 0.5
    normal_stiffness: float | None = None
    normal_damping: float | None = None
    tangent_stiffness: float | None = None
    tangent_damping: float | None = None
    slip_threshold: float | None = None
    restitution: float = 0.0
    friction_combine: Combine = Combine.AVERAGE
    restitution_combine: Combine = Combine.AVERAGE


@dataclass(frozen=True)
class Drive:
    """What pulls a joint's coordinate: stiffness (target - q) + damping (target_velocity - dq/dt), no more than max_force.

    N, m and s, or N m, rad and s. It is implicit: stiff gains are as stable as soft ones.

    acceleration: gains are for each kg or kg m^2 that the coordinate moves in the initial configuration while forces act on no other,
    1 / (M^-1)_ii; the Model has their products with it, which stay as they are while the scene moves and where masses are set anew.
    """

    stiffness: float = 0.0
    damping: float = 0.0
    max_force: float = np.inf
    target: float = 0.0
    target_velocity: float = 0.0
    acceleration: bool = False


@dataclass(frozen=True)
class Loop:
    """A joint between two bodies of the trees, -1 = the world, as constraints on their motion (eqs. 14, 25).

    Attributes:
        name: of the joint. bodies: a, b. frames: [2, 7] of the joint in their frames, which coincide as far as it holds them.
        ways, turns: which of the axes of frame a are held.
        distance: None, or the least and greatest distance of the frames' origins, which is then all that is held [m].
    """

    name: str
    bodies: tuple[int, int]
    frames: np.ndarray
    ways: tuple[bool, bool, bool]
    turns: tuple[bool, bool, bool]
    distance: tuple[float, float] | None = None


@dataclass(frozen=True)
class Hull:
    """A convex polyhedron in its shape's frame: points [V, 3] m, and faces, the corners of each counterclockwise from outside."""

    points: np.ndarray
    faces: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Mesh:
    """Triangles in their shape's frame: points [V, 3] m, triangles [T, 3] of them."""

    points: np.ndarray
    triangles: np.ndarray


def parents_first(parent: list[int]) -> list[int]:
    """Bodies in their own order but for children that come before their parents, which wait for them."""
    children: dict[int, list[int]] = {}
    for b, p in enumerate(parent):
        children.setdefault(p, []).append(b)
    ready, order = list(children.get(-1, [])), []
    while ready:
        order.append(heapq.heappop(ready))
        for child in children.get(order[-1], []):
            heapq.heappush(ready, child)
    return order


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
        part_of: [B] the body of the scene that each one is a part of, itself where it is one. Of several axes that do not meet each but
            the last carries a part without mass; a joint that closes a loop and is limited, driven or damped carries a share of a body.
        body_parent: [B] index of the parent body, -1 = world.
        joint_type: [B] :class:`JointType` of the joint above each body. joint_names: [B] its name, empty where it is none of the scene's.
        joint_pose: [B, 7] frame of that joint in the parent's frame (identity under a FREE or KINEMATIC joint).
        joint_child_pose: [B, 7] frame of that joint in the body's own frame (likewise).
        q_start, v_start: [B] first coordinate of each body in q and v.
        q0: [nq] initial configuration. v0: [nv] initial velocity.
        dof_names: [nv] joint of each velocity, of several that were made one its own; body, where no joint of the scene carries it.
        dof_body: [nv] body above which each velocity is. dof_kind: [nv] :class:`DofKind`. dof_axis: [nv, 3] in the joint's frame.
        armature: [nv] kg or kg m^2, added to the mass matrix. damping: [nv] N s/m or N m s, force by joint velocity.
        joint_friction: [nv] N or N m, dry friction. limit: [nv, 2] m or rad, least and greatest coordinate, infinite where there is none.
        drive: [nv, 5] stiffness, damping, greatest force, target and target velocity of a :class:`Drive`.
        loops: joints that close loops, and distances.
        mass: [B] kg. com: [B, 3] centre of mass in the body frame, m.
        inertia: [B, 3, 3] about the centre of mass, body axes, kg m^2.
        shape_names, shape_type, shape_body: [S] name, :class:`ShapeType` and owner (-1 = world).
        shape_pose: [S, 7] pose in the owner's frame.
        shape_size: [S, 3] metres; box: half extents, sphere: radius in [0], capsule: radius in [0], half the length of its
            straight part, which lies along local z, in [1]; cylinder: radius, half length along z; cone: radius of its base at
            z = -half, half height; ellipsoid: semi-axes along x, y and z; hull and mesh: half extents of its bounds, whose
            centre the frame is in; plane: unused (normal = local +z).
        shape_hull: [S] :class:`Hull` of each hull, :class:`Mesh` of each mesh, None for other shapes.
        shape_surface_velocity: [S, 3] m/s in the shape's frame, velocity of the surface relative to the body (belts).
        friction: [S, 2] static and dynamic coefficient.
        contact: [S, 5] k_n, b_n, k_t, b_t, v_s; NaN where the defaults of Table 1 apply.
        restitution: [S] Newton's e of each material; a pair has the average, unless combine says otherwise.
        combine: [S, 2] :class:`Combine` of friction and of restitution.
        pairs: [P, 2] shapes that may touch, grouped by kind, the lower ShapeType first.
        gravity: [3] m/s^2.
        up_axis: 'Y' or 'Z', for viewers.
        report: what was read, assumed and ignored.
    """

    body_names: tuple[str, ...]
    part_of: np.ndarray
    body_parent: np.ndarray
    joint_names: tuple[str, ...]
    joint_type: np.ndarray
    joint_pose: np.ndarray
    joint_child_pose: np.ndarray
    q_start: np.ndarray
    v_start: np.ndarray
    q0: np.ndarray
    v0: np.ndarray
    dof_names: tuple[str, ...]
    dof_body: np.ndarray
    dof_kind: np.ndarray
    dof_axis: np.ndarray
    armature: np.ndarray
    damping: np.ndarray
    joint_friction: np.ndarray
    limit: np.ndarray
    drive: np.ndarray
    loops: tuple[Loop, ...]
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    shape_names: tuple[str, ...]
    shape_type: np.ndarray
    shape_body: np.ndarray
    shape_pose: np.ndarray
    shape_size: np.ndarray
    shape_hull: tuple[Hull | Mesh | None, ...]
    shape_surface_velocity: np.ndarray
    friction: np.ndarray
    contact: np.ndarray
    restitution: np.ndarray
    combine: np.ndarray
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
    def scene_bodies(self) -> np.ndarray:
        """[N] bodies that the scene has, without parts of them that joints needed."""
        return np.flatnonzero(self.part_of == np.arange(self.num_bodies))

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
        return int(np.count_nonzero(self.dof_kind != DofKind.PRESCRIBED))

    @property
    def gains(self) -> np.ndarray:
        """[nv, 3] stiffness, damping and greatest force of the drives."""
        return self.drive[:, :3]

    @property
    def articulated(self) -> bool:
        """Does a body move on another one, or on a joint on the world?"""
        return bool((self.joint_type > JointType.FIXED).any() or (self.body_parent >= 0).any() or self.loops)

    @property
    def movable(self) -> np.ndarray:
        """[B + 1] bodies that forces move, by their own joint or one between them and the root; the last one is the world, -1."""
        moves = np.r_[(self.joint_type != JointType.KINEMATIC) & (self.joint_type != JointType.FIXED), False]
        for b in self.order:
            moves[b] |= moves[self.body_parent[b]]
        return moves

    @property
    def order(self) -> np.ndarray:
        """[B] bodies, each after its parent, otherwise in their own order; coordinates come in the same."""
        return np.array(parents_first(self.body_parent.tolist()), dtype=np.int32)

    @property
    def dof_before(self) -> np.ndarray:
        """[nv] the velocity before each one on its path from the root, -1 = none; those of kinematic bodies are on no path."""
        before = np.full(self.nv, -1, dtype=np.int32)
        last = np.full(self.num_bodies + 1, -1, dtype=np.int32)
        for b in self.order:
            last[b] = last[self.body_parent[b]]
            for i in np.flatnonzero(self.dof_body == b):
                if self.dof_kind[i] != DofKind.PRESCRIBED:
                    before[i], last[b] = last[b], i
        return before

    def velocities(self, name: str) -> slice:
        """Where the velocities of a joint stand in v, and in the columns of ``Simulator.control``; of one axis of several that have names.

        Of a free or kinematic body by its own name. The last part of a prim's path is enough where it is unique.

        Raises:
            ModelError: for a name that none has, or several.
        """
        found = self._named(name)
        return slice(found[0], found[-1] + 1)

    def coordinates(self, name: str) -> slice:
        """Where the coordinates of a joint stand in q: as many as velocities, 4 of a spherical joint, 7 of a free or kinematic body.

        Raises:
            ModelError: as :meth:`velocities` does.
        """
        found = self._named(name)
        b, kind = self.dof_body[found[0]], self.dof_kind[found[0]]
        if kind in (DofKind.BALL, DofKind.BALL_ON):
            start, count = self.q_start[b], 4
        elif kind in (DofKind.FREE, DofKind.PRESCRIBED):
            start, count = self.q_start[b], 7
        else:
            start, count = self.q_start[b] + found[0] - self.v_start[b], len(found)
        return slice(int(start), int(start) + count)

    def _named(self, name: str) -> list[int]:
        """Velocities of a joint, of an axis or of a body that no joint carries."""
        known: dict[tuple[str, int], list[int]] = {}
        for i, (own, b) in enumerate(zip(self.dof_names, self.dof_body, strict=True)):
            known.setdefault((own, int(b)), []).append(i)
        for b, joint in enumerate(self.joint_names):  # of several axes that have names of their own, unless one of them is the joint's
            if joint and (joint, b) not in known and (all_of_it := np.flatnonzero(self.dof_body == b).tolist()):
                known[joint, b] = all_of_it
        fitting = [key for key in known if key[0] == name] or [key for key in known if key[0].rpartition("/")[2] == name]
        if len(fitting) == 1:
            return known[fitting[0]]
        if fitting:
            which = ", ".join(f"{full} of {self.body_names[b]}" for full, b in fitting[:3]) + (" and others" if len(fitting) > 3 else "")
            raise ModelError(f"{name}: there are {which}; give a name that one alone has")
        if name in self.joint_names or name in [loop.name for loop in self.loops]:
            raise ModelError(f"{name}: this joint is fixed or closes a loop; it has no coordinates")
        short = {full.rpartition("/")[2]: full for full, _ in known}
        near = difflib.get_close_matches(name.rpartition("/")[2], short, n=3)
        hint = f"did you mean {', '.join(short[x] for x in near)}?" if near else f"there are {', '.join(list(short.values())[:6])} ..."
        raise ModelError(f"{name}: no joint and no free body has this name; {hint}")

    @property
    def slot_shapes(self) -> np.ndarray:
        """[C, 2] shapes a and b of each contact slot: ``slot_shapes[slot]`` of a contact's. Made anew each time."""
        return np.repeat(self.pairs, np.diff(self.pair_slots), axis=0)

    @property
    def pair_slots(self) -> np.ndarray:
        """[P + 1] offsets: pair p owns the contact slots pair_slots[p] ... pair_slots[p + 1] - 1."""
        points = []
        for a, b in self.pairs:
            hull = self.shape_hull[b]
            most = CONTACT_POINTS[ShapeType(self.shape_type[a]), ShapeType(self.shape_type[b])]
            points.append(most or (len(hull.points) if hull else 0))
        return np.concatenate([[0], np.cumsum(points, dtype=np.int64)]).astype(np.int32)

    @property
    def kind_pairs(self) -> np.ndarray:
        """[K + 1] offsets: pairs kind_pairs[k] ... kind_pairs[k + 1] - 1 are of the same two shape types; kinds with planes come first."""
        types = self.shape_type[self.pairs]
        starts = np.flatnonzero((types[1:] != types[:-1]).any(axis=1)) + 1
        return np.array(sorted({0, *starts.tolist(), len(types)}), dtype=np.int32)

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
    def shape_extent(self) -> np.ndarray:
        """[S, 4] half extents of a box in each shape's frame, and the radius of a ball: carried through the box it holds the shape, m."""
        extent = np.zeros((len(self.shape_type), 4))
        for out, kind, size in zip(extent, self.shape_type, self.shape_size, strict=True):
            if kind == ShapeType.SPHERE:
                out[3] = size[0]
            elif kind == ShapeType.CAPSULE:
                out[2], out[3] = size[1], size[0]
            elif kind in (ShapeType.CYLINDER, ShapeType.CONE):
                out[:3] = size[0], size[0], size[1]
            elif kind != ShapeType.PLANE:
                out[:3] = size
        return extent

    @property
    def bodies_meet(self) -> bool:
        """Can two free bodies touch?"""
        return bool(self.movable[self.shape_body[self.pairs]].all(axis=-1).any())

    @property
    def max_contacts(self) -> int:
        """Contacts that may act at one time in one environment.

        All slots while there are at most 64, else 24 per movable body if that is more: slots grow with the square of the
        bodies, points that touch at one time do not. What does not fit is dropped and flagged.
        """
        return min(self.num_slots, max(64, 24 * int(np.count_nonzero(self.movable))))
