# SPDX-License-Identifier: Apache-2.0
"""ModelBuilder: author a Model in Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np

from . import hulls
from .errors import ModelError, positive_number
from .forest import IDENTITY, NO_DRIVE, NO_LIMIT, Arrangement, Body
from .joints import AXES, Joint, compose
from .model import CONTACT_POINTS, JOINT_AXES, Combine, Drive, Hull, JointType, Material, Mesh, Model, Report, ShapeType

CONTACT_FIELDS = ("normal_stiffness", "normal_damping", "tangent_stiffness", "tangent_damping", "slip_threshold")

COMBINE_FIELDS = ("friction_combine", "restitution_combine")


def rotation_matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix [3, 3] of a unit quaternion (x y z w)."""
    x, y, z, w = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@dataclass
class _Shape:
    name: str
    type: ShapeType
    body: int
    pose: np.ndarray
    size: np.ndarray
    material: Material
    density: float
    surface_velocity: np.ndarray
    hull: Hull | Mesh | None


def solid(kind: ShapeType, size: np.ndarray, hull: Hull | Mesh | None = None) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centre of mass [3] and inertia [3, 3] per unit mass about it, in the frame of a shape of this type and size [3]."""
    centre, (r, h) = np.zeros(3), size[:2]
    if isinstance(hull, Hull):
        return hulls.solid(hull)
    if kind is ShapeType.BOX:
        s = size**2
        return 8.0 * float(np.prod(size)), centre, np.diag([s[1] + s[2], s[0] + s[2], s[0] + s[1]]) / 3.0
    if kind is ShapeType.SPHERE:
        return 4.0 / 3.0 * np.pi * r**3, centre, np.eye(3) * 0.4 * r**2
    if kind is ShapeType.ELLIPSOID:
        s = size**2
        return 4.0 / 3.0 * np.pi * float(np.prod(size)), centre, np.diag([s[1] + s[2], s[0] + s[2], s[0] + s[1]]) / 5.0
    if kind is ShapeType.CAPSULE:
        volume, along, across = capsule_solid(r, h)
    elif kind is ShapeType.CYLINDER:
        volume, along, across = 2.0 * np.pi * r**2 * h, r**2 / 2.0, r**2 / 4.0 + h**2 / 3.0
    else:
        volume, along, across = 2.0 / 3.0 * np.pi * r**2 * h, 0.3 * r**2, 0.15 * (r**2 + h**2)
        centre = np.array([0.0, 0.0, -0.5 * h])
    return volume, centre, np.diag([across, across, along])


def capsule_solid(r: float, h: float) -> tuple[float, float, float]:
    """Volume, and inertia per unit mass along and across the axis, of a capsule with radius r and straight part of 2 h."""
    rod, ball = 2.0 * np.pi * r**2 * h, 4.0 / 3.0 * np.pi * r**3
    along = 0.5 * rod + 0.4 * ball
    across = rod * (0.25 * r**2 + h**2 / 3.0) + ball * (0.4 * r**2 + h**2 + 0.75 * h * r)
    return rod + ball, along * r**2 / (rod + ball), across / (rod + ball)


def compose_mass(parts: Sequence[tuple[float, np.ndarray, np.ndarray]]) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia about it of several rigid parts (mass, centre [3], inertia about it [3, 3]).

    All in one frame, by the parallel-axis theorem.
    """
    mass = sum(m for m, _, _ in parts)
    com = np.sum([m * c for m, c, _ in parts], axis=0) / mass
    inertia = [i + m * ((c - com) @ (c - com) * np.eye(3) - np.outer(c - com, c - com)) for m, c, i in parts]
    return mass, com, np.sum(inertia, axis=0)


class ModelBuilder:
    """Author a Model: add bodies, hang shapes on them, then :meth:`finalize`.

    Every quantity is in SI units. Poses are (x y z qx qy qz qw), of a body in the world, of a shape in its body.

    Args:
        gravity: [3] m/s^2.
        up_axis: 'Y' or 'Z', only for viewers.
    """

    def __init__(self, gravity: Sequence[float] = (0.0, 0.0, -9.81), up_axis: str = "Z"):
        self.gravity = _vector("gravity", gravity, 3)
        self.up_axis = up_axis
        self._bodies: list[Body] = []
        self._shapes: list[_Shape] = []
        self._filtered: set[tuple[int, int]] = set()
        self._joints: list[Joint] = []

    def add_body(
        self,
        name: str | None = None,
        *,
        pose: Sequence[float] = IDENTITY,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
        joint: JointType = JointType.FREE,
        mass: float | None = None,
        com: Sequence[float] | None = None,
        inertia: Sequence[Sequence[float]] | None = None,
    ) -> int:
        """Add a rigid body and return its index.

        Args:
            name: unique name; 'body<i>' if omitted.
            pose: body frame in the world.
            velocity: of the centre of mass, world axes [m/s].
            angular_velocity: world axes [rad/s].
            joint: FREE moves under forces, KINEMATIC moves with its velocity whatever touches it, FIXED does not move.
            mass: [kg]; omitted: from the densities of the body's shapes. Zero: it hangs on a joint, carries others and has no shape.
            com: centre of mass in the body frame; omitted: from the shapes (the frame's origin without shapes).
            inertia: [3, 3] about the centre of mass, body axes; omitted: from the shapes, scaled to ``mass``.

        Raises:
            ModelError: for a non-finite number, a mass that is not positive or an inertia no body can have.
        """
        name = f"body{len(self._bodies)}" if name is None else name
        if any(b.name == name for b in self._bodies):
            raise ModelError(f"{name}: a body of this name exists already; give each body its own name")
        self._bodies.append(
            Body(
                name,
                JointType(joint),
                _pose(name, pose),
                _vector(f"{name}: velocity", velocity, 3),
                _vector(f"{name}: angular velocity", angular_velocity, 3),
                mass if mass is None or mass == 0.0 else _positive(f"{name}: mass", mass, "kg"),
                None if com is None else _vector(f"{name}: centre of mass", com, 3),
                None if inertia is None else _inertia(name, inertia),
            )
        )
        return len(self._bodies) - 1

    def add_carrier(self, name: str, of: int) -> int:
        """Add a body without mass between joints that move `of` one after the other, a part of it (`Model.part_of`); returns its index."""
        body = self.add_body(name, pose=self.pose(of), mass=0.0)
        self._bodies[body].part_of = of
        return body

    def add_joint(
        self,
        type: JointType,
        parent: int,
        child: int,
        *,
        parent_frame: Sequence[float] = IDENTITY,
        child_frame: Sequence[float] = IDENTITY,
        axes: Sequence[str | tuple[str, Sequence[float]]] | None = None,
        armature: float | Sequence[float] = 0.0,
        damping: float | Sequence[float] = 0.0,
        friction: float | Sequence[float] = 0.0,
        limit: Sequence[Any] | None = None,
        drive: Drive | Sequence[Drive | None] | None = None,
        start: float | Sequence[float] | None = None,
        start_velocity: float | Sequence[float] | None = None,
        loop: bool = False,
        collide: bool = False,
        name: str | None = None,
        axis_names: Sequence[str] | None = None,
    ) -> int:
        """Join two bodies and return the joint's index.

        Args:
            type: what moves, see :class:`Model`.
            parent, child: bodies; -1 = world.
            parent_frame, child_frame: the joint's frame in the frame of either body; they coincide where the joint's coordinates are zero.
                Where the bodies stand tells the coordinates at the start; a child that does not stand where the joint lets it is moved.
            axes: what a D6 joint leaves free, of "tx", "ty", "tz", "rx", "ry", "rz". Or pairs ("t" or "r", direction in the frame), in any
                order: ways and turns, each as moved by those before it.
            armature: added to the inertia of each coordinate, kg or kg m^2.
            damping: force against the velocity of each coordinate, N s/m or N m s.
            friction: dry friction of each coordinate, N or N m.
            limit: least and greatest coordinate (a pair for each, where there are several); infinite or None: no limit.
            drive: what pulls each coordinate.
            start: coordinates at the start, as in q; omitted or NaN: those nearest to where the bodies stand. What hangs on the child is
                carried along.
            start_velocity: of each coordinate; omitted or NaN: what the velocities of the bodies leave for it.
            loop: do not carry the child by this joint, hold both bodies where they are. What has limits, a drive or the like carries a
                part of the child that is welded to the rest (`Model.part_of`).
            collide: let the shapes of the two bodies touch, and those of what hangs rigidly on them.
            name: 'joint<i>' if omitted. axis_names: of each coordinate; the joint's if omitted.

        Raises:
            ModelError: for a joint that is none, or a number that is not finite or negative.
        """
        taken = {joint.name for joint in self._joints}
        if name is None:
            name = next(x for k in range(len(taken), 2 * len(taken) + 1) if (x := f"joint{k}") not in taken)
        if name in taken:
            raise ModelError(f"{name}: a joint of this name exists already; give each joint its own name")
        for body in (parent, child):
            if not isinstance(body, (int, np.integer)) or not -1 <= body < len(self._bodies):
                raise ModelError(f"{name}: body {body!r} does not exist; add_body returns the index to give here")
        if parent == child:
            raise ModelError(f"{name}: it joins {'the world' if parent < 0 else self._bodies[parent].name} to itself; give two bodies")
        if type in (JointType.FREE, JointType.KINEMATIC):
            raise ModelError(f"{name}: {JointType(type).name} is no joint between bodies; say so in add_body")
        if type not in tuple(JointType):
            known = ", ".join(f"JointType.{t.name}" for t in JointType if t not in (JointType.FREE, JointType.KINEMATIC))
            raise ModelError(f"{name}: {type!r} is no type of joint; give one of {known}")
        type = JointType(type)
        directions = None
        if type is JointType.D6:
            free, directions = _axes(name, tuple(axes or ()))
        elif axes is not None:
            raise ModelError(f"{name}: axes are for D6 joints, not for {type.name}")
        else:
            free = JOINT_AXES[type]
        n = len(free)
        limits, (drives, by_inertia) = _limits(name, limit, n), _drives(name, drive, n)
        if type is JointType.SPHERICAL and (np.isfinite(limits).any() or drives[:, :2].any()):
            raise ModelError(f"{name}: a SPHERICAL joint has no angles to limit or drive; use D6 with axes rx ry rz")
        self._joints.append(
            Joint(
                name,
                type,
                parent,
                child,
                _pose(name, parent_frame),
                _pose(name, child_frame),
                free,
                _per_axis(f"{name}: armature", armature, n),
                _per_axis(f"{name}: damping", damping, n),
                _per_axis(f"{name}: friction", friction, n),
                limits,
                drives,
                collide=collide,
                loop=loop,
                directions=directions,
                start=None if start is None else _start(f"{name}: start", start, 4 if type is JointType.SPHERICAL else n),
                start_velocity=None if start_velocity is None else _start(f"{name}: start velocity", start_velocity, n),
                acceleration=by_inertia,
                names=None if axis_names is None else tuple(axis_names),
            )
        )
        return len(self._joints) - 1

    def add_distance(
        self,
        parent: int,
        child: int,
        least: float,
        greatest: float,
        *,
        parent_frame: Sequence[float] = IDENTITY,
        child_frame: Sequence[float] = IDENTITY,
        collide: bool = False,
        name: str | None = None,
    ) -> int:
        """Keep two points, the origins of the frames, no closer than ``least`` and no further than ``greatest`` [m]. Returns its index."""
        if not 0.0 <= least <= greatest:
            raise ModelError(f"{name or 'distance'}: from {least} to {greatest} m is no range; give 0 <= least <= greatest")
        index = self.add_joint(
            JointType.D6,
            parent,
            child,
            parent_frame=parent_frame,
            child_frame=child_frame,
            axes=AXES,
            loop=True,
            collide=collide,
            name=name,
        )
        self._joints[index] = replace(self._joints[index], distance=(float(least), float(greatest)))
        return index

    def add_plane(self, body: int = -1, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add an infinite plane with normal along the shape's +z to the world (-1), a fixed or a kinematic body.

        ``options`` as for :meth:`add_box`, except density. Returns the shape's index.
        """
        return self._add_shape(ShapeType.PLANE, body, pose, np.zeros(3), **options)

    def add_sphere(self, body: int, radius: float, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add a sphere of the given radius [m]; ``options`` as for :meth:`add_box`. Returns the shape's index."""
        radius = _positive("sphere: radius", radius, "m")
        return self._add_shape(ShapeType.SPHERE, body, pose, np.array([radius, 0.0, 0.0]), **options)

    def add_ellipsoid(self, body: int, semi_axes: Sequence[float], *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add an ellipsoid with semi-axes [3] m along the shape's x, y and z; ``options`` as for :meth:`add_box`. Returns its index.

        Raises:
            ModelError: for other than three semi-axes, or one that is not positive and finite.
        """
        size = np.array([_positive("ellipsoid: semi-axis", s, "m") for s in semi_axes])
        if size.shape != (3,):
            raise ModelError(f"ellipsoid: semi_axes has {size.size} numbers; give 3")
        return self._add_shape(ShapeType.ELLIPSOID, body, pose, size, **options)

    def add_capsule(self, body: int, radius: float, half_length: float, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add a capsule along the shape's z axis; ``options`` as for :meth:`add_box`. Returns the shape's index.

        Args:
            body: owner; -1 = world.
            radius: [m].
            half_length: half the length of the straight part [m]; the whole capsule is 2 (half_length + radius) long.
            pose: in the owner's frame.
        """
        size = [_positive("capsule: radius", radius, "m"), _positive("capsule: half length", half_length, "m"), 0.0]
        return self._add_shape(ShapeType.CAPSULE, body, pose, np.array(size), **options)

    def add_cylinder(self, body: int, radius: float, half_length: float, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add a cylinder along the shape's z axis; arguments as for :meth:`add_capsule`, half_length is half of all of it."""
        size = [_positive("cylinder: radius", radius, "m"), _positive("cylinder: half length", half_length, "m"), 0.0]
        return self._add_shape(ShapeType.CYLINDER, body, pose, np.array(size), **options)

    def add_cone(self, body: int, radius: float, half_height: float, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add a cone with its base at z = -half_height and its tip at z = half_height; ``options`` as for :meth:`add_box`."""
        size = [_positive("cone: radius", radius, "m"), _positive("cone: half height", half_height, "m"), 0.0]
        return self._add_shape(ShapeType.CONE, body, pose, np.array(size), **options)

    def add_hull(self, body: int, points: Any, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add the convex hull of points; ``options`` as for :meth:`add_box`. Returns the shape's index.

        Args:
            body: owner; -1 = world.
            points: [N, 3] m, in the frame of ``pose``. A hull has 64 corners at most: of more those that change it most are kept.
            pose: in the owner's frame. The frame of the shape itself is in the middle of the hull's bounds.

        Raises:
            ModelError: for points that span no volume.
            MissingExtra: no scipy is installed (the extra 'mesh').
        """
        hull, _ = hulls.convex_hull(options.get("name") or f"shape{len(self._shapes)}", points)
        return self.place_hull(body, hull, pose=pose, **options)

    def place_hull(self, body: int, hull: Hull, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add a hull that is known already; as :meth:`add_hull`."""
        middle, size = _bounds(hull.points)
        where = compose(_pose("hull", pose), np.r_[middle, IDENTITY[3:]]).tolist()
        return self._add_shape(ShapeType.HULL, body, where, size, hull=Hull(hull.points - middle, hull.faces), **options)

    def add_mesh(self, body: int, points: Any, triangles: Any, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add a mesh of triangles that no force moves, as ground; ``options`` as for :meth:`add_box`, except density.

        What touches a triangle leaves it on the side on which it is; two meshes pass through each other.

        Args:
            body: owner: the world (-1), a fixed or a kinematic body.
            points: [V, 3] m, in the frame of ``pose``.
            triangles: [T, 3] of them.
            pose: in the owner's frame. The frame of the shape itself is in the middle of the mesh's bounds.

        Raises:
            ModelError: for a mesh that could move, or triangles that are none.
        """
        name = options.get("name") or f"shape{len(self._shapes)}"
        mesh = hulls.mesh(name, points, triangles)
        middle, size = _bounds(mesh.points)
        where = compose(_pose("mesh", pose), np.r_[middle, IDENTITY[3:]]).tolist()
        return self._add_shape(ShapeType.MESH, body, where, size, hull=Mesh(mesh.points - middle, mesh.triangles), **options)

    def add_box(
        self,
        body: int,
        half_extents: Sequence[float],
        *,
        pose: Sequence[float] = IDENTITY,
        name: str | None = None,
        material: Material | None = None,
        density: float = 1000.0,
        surface_velocity: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> int:
        """Add a box and return its index.

        Args:
            body: owner; -1 = world (a static shape).
            half_extents: [3] m.
            pose: in the owner's frame.
            name: 'shape<i>' if omitted.
            material: friction, restitution and contact stiffness.
            density: [kg/m^3], used where the body gives no mass.
            surface_velocity: [3] m/s in the shape's frame, of the surface relative to the body: a belt.
        """
        size = np.array([_positive("box: half extent", s, "m") for s in half_extents])
        if size.shape != (3,):
            raise ModelError(f"box: half_extents has {size.size} numbers; give 3")
        return self._add_shape(
            ShapeType.BOX, body, pose, size, name=name, material=material, density=density, surface_velocity=surface_velocity
        )

    def _add_shape(
        self,
        kind: ShapeType,
        body: int,
        pose: Sequence[float],
        size: np.ndarray,
        *,
        name: str | None = None,
        material: Material | None = None,
        density: float = 1000.0,
        surface_velocity: Sequence[float] = (0.0, 0.0, 0.0),
        hull: Hull | Mesh | None = None,
    ) -> int:
        name = f"shape{len(self._shapes)}" if name is None else name
        if not -1 <= body < len(self._bodies):
            raise ModelError(f"{name}: body {body} does not exist; add_body returns the index to give here")
        if kind is ShapeType.PLANE and body >= 0 and self._bodies[body].joint is JointType.FREE:
            raise ModelError(f"{name}: a plane is infinite and cannot move freely; put it on the world, a fixed or a kinematic body")
        if kind is ShapeType.MESH and body >= 0 and self._bodies[body].joint is JointType.FREE:
            raise ModelError(f"{name}: a mesh of triangles cannot move freely; use add_hull, or put it on the world or a kinematic body")
        material = Material() if material is None else material
        _check_material(name, material)
        _positive(f"{name}: density", density, "kg/m^3")
        velocity = _vector(f"{name}: surface velocity", surface_velocity, 3)
        self._shapes.append(_Shape(name, kind, body, _pose(name, pose), size, material, float(density), velocity, hull))
        return len(self._shapes) - 1

    def pose(self, body: int) -> list[float]:
        """Where a body was said to stand (x y z qx qy qz qw)."""
        return self._bodies[body].pose.tolist()

    def filter_pair(self, shape_a: int, shape_b: int) -> None:
        """Let two shapes pass through each other."""
        self._filtered.add((min(shape_a, shape_b), max(shape_a, shape_b)))

    def finalize(self, report: Report | None = None) -> Model:
        """Check the scene and return the immutable Model.

        Raises:
            ModelError: for a free body whose mass is unknown, or a scene in which nothing can move.
        """
        if not any(b.joint is not JointType.FIXED for b in self._bodies):
            raise ModelError("nothing can move: the scene has no free and no kinematic body; add one (in USD: PhysicsRigidBodyAPI)")
        mass, com, inertia = (np.array(x) for x in zip(*(self._mass_properties(i) for i in range(len(self._bodies))), strict=True))
        shapes = self._shapes
        arranged = Arrangement(self._bodies, self._joints, {s.body for s in shapes}, mass, com, inertia)
        report = Report() if report is None else report
        if arranged.notes:
            report = replace(report, notes=(*report.notes, *arranged.notes))
        model = Model(
            **arranged.fields,
            shape_names=tuple(s.name for s in shapes),
            shape_type=np.array([s.type for s in shapes], dtype=np.int32),
            shape_body=np.array([s.body for s in shapes], dtype=np.int32),
            shape_pose=np.array([s.pose for s in shapes], dtype=float).reshape(-1, 7),
            shape_size=np.array([s.size for s in shapes], dtype=float).reshape(-1, 3),
            shape_hull=tuple(s.hull for s in shapes),
            shape_surface_velocity=np.array([s.surface_velocity for s in shapes], dtype=float).reshape(-1, 3),
            friction=np.array([(s.material.static_friction, s.material.dynamic_friction) for s in shapes], dtype=float).reshape(-1, 2),
            contact=np.array([[getattr(s.material, f) for f in CONTACT_FIELDS] for s in shapes], dtype=float).reshape(-1, 5),
            restitution=np.array([s.material.restitution for s in shapes], dtype=float),
            combine=np.array([[getattr(s.material, f) for f in COMBINE_FIELDS] for s in shapes], dtype=np.int32).reshape(-1, 2),
            pairs=np.zeros((0, 2), dtype=np.int32),
            gravity=self.gravity.copy(),
            up_axis=self.up_axis,
            report=report,
        )
        return replace(model, pairs=self._pairs(model))

    @property
    def welded(self) -> set[int]:
        """Bodies that a fixed joint holds."""
        fixed = [joint for joint in self._joints if joint.type is JointType.FIXED and not joint.loop]
        return {body for joint in fixed for body in (joint.parent, joint.child)}

    def _mass_properties(self, index: int) -> tuple[float, np.ndarray, np.ndarray]:
        body = self._bodies[index]
        parts = []
        for s in self._shapes:
            if s.body == index and s.type not in (ShapeType.PLANE, ShapeType.MESH):
                (volume, centre, inertia), rot = solid(s.type, s.size, s.hull), rotation_matrix(s.pose[3:])
                m = s.density * volume
                parts.append((m, s.pose[:3] + rot @ centre, m * rot @ inertia @ rot.T))
        if parts:
            mass, com, inertia = compose_mass(parts)
        elif body.mass == 0.0 or (body.mass is None and index in self.welded):
            mass, com, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
        elif body.joint is JointType.FREE:
            if body.mass is None or body.inertia is None:
                missing = "mass" if body.mass is None else "inertia"
                raise ModelError(f"{body.name}: {missing} is unknown, the body has no shape; give it mass and inertia, or a shape")
            mass, com, inertia = body.mass, np.zeros(3), body.inertia
        else:
            mass, com, inertia = 1.0, np.zeros(3), np.eye(3)  # never used: such a body does not answer to forces
        if body.com is not None:
            shift = com - body.com
            inertia = inertia + mass * (shift @ shift * np.eye(3) - np.outer(shift, shift))
            com = body.com
        if body.mass:
            mass, inertia = body.mass, inertia * (body.mass / mass)
        return mass, com, inertia if body.inertia is None else body.inertia

    def _pairs(self, model: Model) -> np.ndarray:
        moves = model.movable
        welded = np.arange(model.num_bodies + 1)  # first of the bodies that hang rigidly on each other; they do not touch
        for b in model.order:
            if model.joint_type[b] == JointType.FIXED and model.body_parent[b] >= 0:
                welded[b] = welded[model.body_parent[b]]

        def movable(s: _Shape) -> bool:
            return bool(moves[s.body])

        apart = [joint for joint in self._joints if min(joint.parent, joint.child) >= 0 and not joint.collide]
        joined = {frozenset((joint.parent, joint.child)) for joint in apart}
        # What hangs rigidly on either side is as near to the joint; but a link may stand on what is fixed in the world with its base.
        limbs = {frozenset(welded[[joint.parent, joint.child]]) for joint in apart if moves[joint.parent] and moves[joint.child]}
        pairs = []
        for j, b in enumerate(self._shapes):
            for i, a in enumerate(self._shapes[:j]):
                if welded[a.body] == welded[b.body] or not (movable(a) or movable(b)) or (i, j) in self._filtered:
                    continue
                if frozenset((a.body, b.body)) in joined or frozenset((welded[a.body], welded[b.body])) in limbs:
                    continue
                first, second = (i, j) if a.type <= b.type else (j, i)
                kind = (self._shapes[first].type, self._shapes[second].type)
                if kind in CONTACT_POINTS:
                    pairs.append((*kind, first, second))
        return np.array([p[2:] for p in sorted(pairs)], dtype=np.int32).reshape(-1, 2)


def _bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle and half extents [3] of a box around points."""
    low, high = points.min(axis=0), points.max(axis=0)
    return 0.5 * (low + high), 0.5 * (high - low)


def _per_axis(what: str, value: float | Sequence[float], n: int) -> np.ndarray:
    array = np.broadcast_to(np.asarray(value, dtype=float), (n,)) if np.ndim(value) == 0 else _vector(what, value, n)  # type: ignore[arg-type]
    if not (np.isfinite(array).all() and (array >= 0.0).all()):
        raise ModelError(f"{what} is {array.tolist()}; it must be finite and not negative")
    return array.copy()


def _axes(name: str, given: tuple[Any, ...]) -> tuple[tuple[str, ...], np.ndarray | None]:
    """Of a D6 joint: names, and directions where they are not those of the names."""
    if all(isinstance(a, str) for a in given):
        if any(a not in AXES for a in given) or len(set(given)) != len(given):
            raise ModelError(f"{name}: axes are {given}; give some of {', '.join(AXES)}, each once")
        return tuple(a for a in AXES if a in given), None
    if any(isinstance(a, str) or len(a) != 2 or a[0] not in ("t", "r") for a in given):
        raise ModelError(f"{name}: axes are {given}; give names alone, or pairs of 't' or 'r' and a direction alone")
    vectors = np.array([_vector(f"{name}: axis", direction, 3) for _, direction in given])
    length = np.linalg.norm(vectors, axis=1)
    if not length.all() or len(given) > 6:
        raise ModelError(f"{name}: axes are {given}; give six at most, none of no length")
    return tuple(kind for kind, _ in given), vectors / length[:, None]


def _start(what: str, value: float | Sequence[float], n: int) -> np.ndarray:
    """[n], NaN where it is open."""
    given = np.atleast_1d(np.asarray(value, dtype=float))
    if given.shape != (n,) or np.isinf(given).any():
        raise ModelError(f"{what} is {given.tolist()}; give {n} numbers, NaN where the bodies tell")
    return given


def _limits(name: str, value: Sequence[Any] | None, n: int) -> np.ndarray:
    """[n, 2]"""
    pairs = [value] if n == 1 and value is not None and len(value) == 2 and np.ndim(value[0]) == 0 else value
    limits = np.tile(np.array(NO_LIMIT), (n, 1))
    if pairs is None:
        return limits
    if len(pairs) != n:
        raise ModelError(f"{name}: limit has {len(pairs)} pairs; give {n}, one for each coordinate")
    for i, pair in enumerate(pairs):
        if pair is not None:
            limits[i] = pair
            if np.isnan(limits[i]).any() or limits[i][0] > limits[i][1]:
                raise ModelError(f"{name}: limit {tuple(pair)} leaves no room; give the least coordinate first")
    return limits


def _drives(name: str, value: Drive | Sequence[Drive | None] | None, n: int) -> tuple[np.ndarray, np.ndarray]:
    """[n, 5], and [n] which are of type acceleration."""
    drives = [value] * n if value is None or isinstance(value, Drive) else list(value)
    if len(drives) != n:
        raise ModelError(f"{name}: {len(drives)} drives; give {n}, one for each coordinate")
    table = np.array([NO_DRIVE if d is None else (d.stiffness, d.damping, d.max_force, d.target, d.target_velocity) for d in drives])
    table = table.reshape(n, 5)
    allowed = np.isfinite(table) | (table == np.inf) & (np.arange(5) == 2)
    allowed[:, :3] &= table[:, :3] >= 0.0
    for i, k in np.argwhere(~allowed):
        what = ("stiffness", "damping", "max_force", "target", "target_velocity")[k]
        rule = "finite" if k > 2 else "not negative" if k == 2 else "finite and not negative"
        raise ModelError(f"{name}: {what} of its drive is {table[i, k]:g}; it must be {rule}")
    return table, np.array([d is not None and d.acceleration for d in drives], dtype=bool)


_positive = partial(positive_number, error=ModelError)


def _vector(what: str, value: Sequence[float], n: int) -> np.ndarray:
    array = np.asarray(value, dtype=float)
    if array.shape != (n,):
        raise ModelError(f"{what} has shape {array.shape}; give {n} numbers")
    if not np.isfinite(array).all():
        raise ModelError(f"{what} is {array.tolist()}; every number must be finite")
    return array


def _pose(name: str, value: Sequence[float]) -> np.ndarray:
    pose = _vector(f"{name}: pose", value, 7).copy()
    norm = np.linalg.norm(pose[3:])
    if abs(norm - 1.0) > 1e-3:
        raise ModelError(f"{name}: the quaternion {pose[3:].tolist()} has length {norm:.6g}; give a unit quaternion (x y z w)")
    pose[3:] /= norm
    return pose


def _inertia(name: str, value: Sequence[Sequence[float]]) -> np.ndarray:
    inertia = np.asarray(value, dtype=float)
    if inertia.shape != (3, 3) or not np.isfinite(inertia).all() or not np.allclose(inertia, inertia.T, rtol=1e-9, atol=0):
        raise ModelError(f"{name}: inertia {inertia.tolist()} must be a finite symmetric 3 x 3 matrix")
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] <= 0.0:
        raise ModelError(f"{name}: principal moments of inertia {moments.tolist()} kg m^2 must be greater than zero")
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-6):
        raise ModelError(f"{name}: principal moments {moments.tolist()} break the triangle inequality, no rigid body has them")
    return inertia


def _check_material(name: str, material: Material) -> None:
    for f in fields(material):
        value = getattr(material, f.name)
        if f.name in COMBINE_FIELDS and value not in tuple(Combine):
            raise ModelError(f"{name}: {f.name} is {value}; give one of {', '.join(f'Combine.{mode.name}' for mode in Combine)}")
        if value is None:
            continue
        strict = f.name in CONTACT_FIELDS and f.name != "tangent_stiffness" and f.name != "normal_stiffness"
        if not np.isfinite(value) or value < 0.0 or (strict and value == 0.0):
            raise ModelError(f"{name}: {f.name} is {value}; it must be finite and {'greater than' if strict else 'at least'} zero")
    if material.restitution > 1.0:
        raise ModelError(f"{name}: restitution is {material.restitution}; it must be at most 1, more would make energy")
    if material.dynamic_friction > material.static_friction:
        raise ModelError(
            f"{name}: dynamic friction {material.dynamic_friction} exceeds static friction {material.static_friction}; "
            "Coulomb's law needs mu_k <= mu_s"
        )
