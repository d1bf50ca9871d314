# SPDX-License-Identifier: Apache-2.0
"""ModelBuilder: author a Model in Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial

import numpy as np

from .errors import ModelError, positive_number
from .model import CONTACT_POINTS, JointType, Material, Model, Report, ShapeType

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
CONTACT_FIELDS = ("normal_stiffness", "normal_damping", "tangent_stiffness", "tangent_damping", "slip_threshold")


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
class _Body:
    name: str
    joint: JointType
    pose: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    mass: float | None
    com: np.ndarray | None
    inertia: np.ndarray | None


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

    def volume(self) -> float:
        if self.type is ShapeType.BOX:
            return 8.0 * float(np.prod(self.size))
        if self.type is ShapeType.CAPSULE:
            return capsule_solid(*self.size[:2])[0]
        return 4.0 / 3.0 * np.pi * float(self.size[0]) ** 3

    def unit_inertia(self) -> np.ndarray:
        """Inertia [3, 3] per unit mass about the shape's own centre, in the shape's axes."""
        if self.type is ShapeType.BOX:
            s = self.size**2
            return np.diag([s[1] + s[2], s[0] + s[2], s[0] + s[1]]) / 3.0
        if self.type is ShapeType.CAPSULE:
            _, along, across = capsule_solid(*self.size[:2])
            return np.diag([across, across, along])
        return np.eye(3) * 0.4 * self.size[0] ** 2


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
        self._bodies: list[_Body] = []
        self._shapes: list[_Shape] = []
        self._filtered: set[tuple[int, int]] = set()

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
            mass: [kg]; omitted: from the densities of the body's shapes.
            com: centre of mass in the body frame; omitted: from the shapes (the frame's origin without shapes).
            inertia: [3, 3] about the centre of mass, body axes; omitted: from the shapes, scaled to ``mass``.

        Raises:
            ModelError: for a non-finite number, a mass that is not positive or an inertia no body can have.
        """
        name = f"body{len(self._bodies)}" if name is None else name
        if any(b.name == name for b in self._bodies):
            raise ModelError(f"{name}: a body of this name exists already; give each body its own name")
        self._bodies.append(
            _Body(
                name,
                JointType(joint),
                _pose(name, pose),
                _vector(f"{name}: velocity", velocity, 3),
                _vector(f"{name}: angular velocity", angular_velocity, 3),
                None if mass is None else _positive(f"{name}: mass", mass, "kg"),
                None if com is None else _vector(f"{name}: centre of mass", com, 3),
                None if inertia is None else _inertia(name, inertia),
            )
        )
        return len(self._bodies) - 1

    def add_plane(self, body: int = -1, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add an infinite plane with normal along the shape's +z to the world (-1), a fixed or a kinematic body.

        ``options`` as for :meth:`add_box`, except density. Returns the shape's index.
        """
        return self._add_shape(ShapeType.PLANE, body, pose, np.zeros(3), **options)

    def add_sphere(self, body: int, radius: float, *, pose: Sequence[float] = IDENTITY, **options) -> int:
        """Add a sphere of the given radius [m]; ``options`` as for :meth:`add_box`. Returns the shape's index."""
        radius = _positive("sphere: radius", radius, "m")
        return self._add_shape(ShapeType.SPHERE, body, pose, np.array([radius, 0.0, 0.0]), **options)

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
    ) -> int:
        name = f"shape{len(self._shapes)}" if name is None else name
        if not -1 <= body < len(self._bodies):
            raise ModelError(f"{name}: body {body} does not exist; add_body returns the index to give here")
        if kind is ShapeType.PLANE and body >= 0 and self._bodies[body].joint is JointType.FREE:
            raise ModelError(f"{name}: a plane is infinite and cannot move freely; put it on the world, a fixed or a kinematic body")
        material = Material() if material is None else material
        _check_material(name, material)
        _positive(f"{name}: density", density, "kg/m^3")
        velocity = _vector(f"{name}: surface velocity", surface_velocity, 3)
        self._shapes.append(_Shape(name, kind, body, _pose(name, pose), size, material, float(density), velocity))
        return len(self._shapes) - 1

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
        joint = np.array([b.joint for b in self._bodies], dtype=np.int32)
        moves = joint != JointType.FIXED
        shapes = self._shapes
        return Model(
            body_names=tuple(b.name for b in self._bodies),
            body_parent=np.full(len(joint), -1, dtype=np.int32),
            joint_type=joint,
            joint_pose=np.array([IDENTITY if m else b.pose for b, m in zip(self._bodies, moves, strict=True)], dtype=float),
            q_start=(np.cumsum(7 * moves) - 7 * moves).astype(np.int32),
            v_start=(np.cumsum(6 * moves) - 6 * moves).astype(np.int32),
            q0=np.concatenate([b.pose for b, m in zip(self._bodies, moves, strict=True) if m]),
            v0=np.concatenate([np.r_[b.velocity, b.angular_velocity] for b, m in zip(self._bodies, moves, strict=True) if m]),
            mass=mass,
            com=com,
            inertia=inertia,
            shape_names=tuple(s.name for s in shapes),
            shape_type=np.array([s.type for s in shapes], dtype=np.int32),
            shape_body=np.array([s.body for s in shapes], dtype=np.int32),
            shape_pose=np.array([s.pose for s in shapes], dtype=float).reshape(-1, 7),
            shape_size=np.array([s.size for s in shapes], dtype=float).reshape(-1, 3),
            shape_surface_velocity=np.array([s.surface_velocity for s in shapes], dtype=float).reshape(-1, 3),
            friction=np.array([(s.material.static_friction, s.material.dynamic_friction) for s in shapes], dtype=float).reshape(-1, 2),
            contact=np.array([[getattr(s.material, f) for f in CONTACT_FIELDS] for s in shapes], dtype=float).reshape(-1, 5),
            restitution=np.array([s.material.restitution for s in shapes], dtype=float),
            pairs=self._pairs(),
            gravity=self.gravity.copy(),
            up_axis=self.up_axis,
            report=Report() if report is None else report,
        )

    def _mass_properties(self, index: int) -> tuple[float, np.ndarray, np.ndarray]:
        body = self._bodies[index]
        parts = []
        for s in self._shapes:
            if s.body == index and s.type is not ShapeType.PLANE:
                m, rot = s.density * s.volume(), rotation_matrix(s.pose[3:])
                parts.append((m, s.pose[:3], m * rot @ s.unit_inertia() @ rot.T))
        if parts:
            mass, com, inertia = compose_mass(parts)
        elif body.joint is JointType.FREE:
            if body.mass is None or body.inertia is None:
                raise ModelError(f"{body.name}: mass is unknown, the body has no shape; give it mass and inertia, or a shape")
            mass, com, inertia = body.mass, np.zeros(3), body.inertia
        else:
            mass, com, inertia = 1.0, np.zeros(3), np.eye(3)  # never used: such a body does not answer to forces
        if body.com is not None:
            shift = com - body.com
            inertia = inertia + mass * (shift @ shift * np.eye(3) - np.outer(shift, shift))
            com = body.com
        if body.mass is not None:
            mass, inertia = body.mass, inertia * (body.mass / mass)
        return mass, com, inertia if body.inertia is None else body.inertia

    def _pairs(self) -> np.ndarray:
        def movable(s: _Shape) -> bool:
            return s.body >= 0 and self._bodies[s.body].joint is JointType.FREE

        pairs = []
        for j, b in enumerate(self._shapes):
            for i, a in enumerate(self._shapes[:j]):
                if a.body == b.body or not (movable(a) or movable(b)) or (i, j) in self._filtered:
                    continue
                first, second = (i, j) if a.type <= b.type else (j, i)
                kind = (self._shapes[first].type, self._shapes[second].type)
                if kind in CONTACT_POINTS:
                    pairs.append((*kind, first, second))
        return np.array([p[2:] for p in sorted(pairs)], dtype=np.int32).reshape(-1, 2)


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
