# SPDX-License-Identifier: Apache-2.0
"""Read UsdPhysics stages made elsewhere into a Model, and say what was understood.

Everything is converted to SI units (metersPerUnit, kilogramsPerUnit, degrees); the stage's axes are kept. What a stage
holds beyond what is simulated is never dropped in silence: it stands in :class:`warp_lcp.Report`, as *ignored* where
the rest stays right without it, as *unsupported* where it does not.

Decisions where USD leaves room:

- ``physics:velocity`` is the velocity of the CENTRE OF MASS, along the body prim's own axes (the parser's
  documentation; PhysX and Newton do the same), and ``physics:angularVelocity`` is along them too, in degrees/s. A
  kinematic body keeps moving with its authored velocity.
- ``physics:mass``, ``density`` or ``diagonalInertia`` of zero mean "not authored", as the schema says. A free body to
  which neither a mass, a density nor an enabled collider gives mass is refused.
- metersPerUnit is 0.01 where it is not authored (USD's fallback), which is noted.
- On top of UsdPhysics, contact parameters are read from the physics material (``warpLcp:normalStiffness``,
  ``normalDamping``, ``tangentStiffness``, ``tangentDamping`` in mass/time^2 and mass/time, ``slipThreshold`` in
  distance/time) and the velocity of a belt from the collider (``warpLcp:surfaceVelocity``, distance/time along the
  collider prim's axes), all in stage units.
- So are ``physxMaterial:frictionCombineMode`` and ``restitutionCombineMode`` (average, min, multiply, max; of two that
  differ the later one rules), and ``newton:selfCollisionEnabled`` or ``physxArticulation:enabledSelfCollisions`` = false
  of an articulation root, whose bodies then pass through each other.
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement, product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from .builder import ModelBuilder
from .errors import MissingExtra, ModelError, SceneError
from .model import Combine, Ignored, JointType, Material, Model, Report
from .usd_attributes import COMBINE_ATTRIBUTES, CONTACT_ATTRIBUTES, SELF_COLLISION, SURFACE_VELOCITY, decimals, unread, written
from .usd_joints import JointReader, some
from .usd_mass import MassReader, Unusable
from .usd_shapes import COLLIDERS, UNIFORM, Solid, solids

_SHAPES = "Plane, Cube, Sphere, Capsule, Cylinder, Cone or Mesh"
_LISTED = 100  # unsupported prims that an error lists by path; the report always has all


@dataclass(frozen=True)
class SceneReading:
    """What a stage holds, supported or not. SI units; paths are prim paths in stage order.

    Attributes:
        source: the file, or the identifier of the stage's root layer.
        builder: the scene as far as it is supported; complete only where ``report.unsupported`` is empty.
        report: notes, ignored and unsupported content.
        bodies: enabled rigid bodies, free and kinematic.
        shapes: enabled colliders, of any type.
        joints: enabled joints.
        mass: of all free bodies together [kg]; None where a body's mass follows from a shape that is not supported.
        gravity: [m/s^2].
        up_axis: 'Y' or 'Z'.
        meters_per_unit, kilograms_per_unit: stage units.
    """

    source: str
    builder: ModelBuilder
    report: Report
    bodies: tuple[str, ...]
    shapes: tuple[str, ...]
    joints: tuple[str, ...]
    mass: float | None
    gravity: tuple[float, float, float]
    up_axis: str
    meters_per_unit: float
    kilograms_per_unit: float


def load_usd(scene: Any, *, meters_per_unit: float | None = None) -> Model:
    """Read a UsdPhysics scene into a Model.

    Args:
        scene: path of a USD file, the name of a shipped scene (``warp_lcp.scenes.names()``), or a ``Usd.Stage``.
        meters_per_unit: overrides the stage's metersPerUnit.

    Raises:
        SceneError: the file is missing or broken, holds no physics, or holds something that cannot be simulated; the
            message names the file, the prims and the remedy.
        MissingExtra: no ``pxr`` is installed.
    """
    reading = read_usd(scene, meters_per_unit=meters_per_unit)
    if not (reading.bodies or reading.shapes or reading.joints):
        raise SceneError(
            f"{reading.source}: no physics in this stage: no prim has PhysicsRigidBodyAPI or PhysicsCollisionAPI; "
            "apply them to what shall move and touch"
        )
    if reading.report.unsupported:
        raise SceneError(_refusal(reading))
    if not reading.bodies:
        raise SceneError(
            f"{reading.source}: nothing can move: {len(reading.shapes)} static collider(s) ({reading.shapes[0]} ...) but no enabled "
            "rigid body; apply PhysicsRigidBodyAPI to what shall move"
        )
    try:
        return reading.builder.finalize(reading.report)
    except ModelError as error:
        raise SceneError(f"{reading.source}: {error}") from error


def read_usd(scene: Any, *, meters_per_unit: float | None = None) -> SceneReading:
    """Read a stage and list what is in it, unsupported content included; arguments as for :func:`load_usd`.

    Raises:
        SceneError: the file is missing or broken.
        MissingExtra: no ``pxr`` is installed.
    """
    px = _import_pxr()
    if meters_per_unit is not None and not (math.isfinite(meters_per_unit) and meters_per_unit > 0.0):
        raise SceneError(f"meters_per_unit is {meters_per_unit}; it must be finite and greater than zero")
    delegate = px.UsdUtils.CoalescingDiagnosticDelegate()  # collects warnings that would go to stderr
    stage, source = _open(px, scene)
    with _units(px, stage, meters_per_unit):
        return _Reader(px, stage, source, meters_per_unit).read(delegate)


def _import_pxr() -> SimpleNamespace:
    try:
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils
    except ImportError as error:
        raise MissingExtra("reading USD scenes", "usd", error) from error
    parse = getattr(UsdPhysics, "UsdPhysicsLoadStageFromPrimRange", None) or getattr(UsdPhysics, "LoadUsdPhysicsFromRange", None)
    if parse is None:
        raise MissingExtra("reading USD scenes", "usd", ImportError("the installed pxr has no UsdPhysics parser, it is too old"))
    return SimpleNamespace(
        Gf=Gf, Sdf=Sdf, Tf=Tf, Usd=Usd, UsdGeom=UsdGeom, UsdPhysics=UsdPhysics, UsdShade=UsdShade, UsdUtils=UsdUtils, parse=parse
    )


def _open(px: SimpleNamespace, scene: Any) -> tuple[Any, str]:
    """The stage and the name under which messages speak of it."""
    if isinstance(scene, px.Usd.Stage):
        layer = scene.GetRootLayer()
        return scene, layer.realPath or layer.identifier
    if not isinstance(scene, (str, os.PathLike)):
        raise SceneError(f"a scene is a path, the name of a shipped scene or a Usd.Stage, not {type(scene).__name__}")
    path = _find(os.fspath(scene))
    try:
        return px.Usd.Stage.Open(str(path)), str(path)
    except px.Tf.ErrorException as error:
        first = re.search(r" : '(.*?)'\s*(?=\n\s*Error in|\Z)", str(error), re.DOTALL)
        cause = " ".join((first.group(1) if first else str(error)).split())
        raise SceneError(f"{path}: not a readable USD file: {cause}; mend it there or export it again") from error


def _find(text: str) -> Path:
    """File behind a path or the name of a shipped scene."""
    from . import scenes  # late: a clone finds it by the search path that warp_lcp extends

    path = Path(text)
    if path.is_file():
        return path
    names = scenes.names()
    if text in names:
        return scenes.path(text)
    near = difflib.get_close_matches(path.stem, names, n=1)
    hint = f"; did you mean the shipped scene '{near[0]}'?" if near else ""
    if path.name == text and not path.suffix:
        raise SceneError(f"{text}: no file and no shipped scene of this name{hint or '; give a path'} (shipped: {', '.join(names)})")
    if path.is_dir():
        raise SceneError(f"{text}: is a folder; give the USD file in it")
    raise SceneError(f"{text}: no such file{hint or '; check the path'}")


@contextmanager
def _units(px: SimpleNamespace, stage: Any, meters_per_unit: float | None) -> Iterator[None]:
    """Give the stage another metersPerUnit while it is read: USD's default density follows from it."""
    if meters_per_unit is None:
        yield
        return
    session = stage.GetSessionLayer()
    if session is None:
        raise SceneError("meters_per_unit cannot override a stage without a session layer; author metersPerUnit on the stage")
    root, key = session.pseudoRoot, "metersPerUnit"
    before = root.GetInfo(key) if root.HasInfo(key) else None
    root.SetInfo(key, float(meters_per_unit))
    try:
        yield
    finally:
        if before is None:
            root.ClearInfo(key)
        else:
            root.SetInfo(key, before)


def _refusal(reading: SceneReading) -> str:
    """One line that names every unsupported prim, grouped by what it is."""
    groups: dict[tuple[str, str], list[str]] = {}
    for item in reading.report.unsupported[:_LISTED]:
        groups.setdefault((item.what, item.why), []).append(item.path)
    left = len(reading.report.unsupported) - _LISTED
    more = f"; and {left} more (warp-lcp info lists them)" if left > 0 else ""
    return f"{reading.source}: cannot be simulated: " + "; ".join(f"{w} {', '.join(p)}: {why}" for (w, why), p in groups.items()) + more


@dataclass(frozen=True)
class _Frame:
    """Where a prim is in the world: rotation @ stretch + position, stage units. ``linear`` is the whole 3 x 3 part.

    ``rotation`` is proper; in a mirrored frame all three axes are turned round (``sign`` = -1), as USD factors it.
    """

    position: np.ndarray
    linear: np.ndarray
    rotation: np.ndarray
    sign: float

    @property
    def scale(self) -> np.ndarray:
        return np.linalg.norm(self.linear, axis=0)

    @property
    def stretch(self) -> np.ndarray:
        """Principal scales."""
        return np.linalg.svd(self.linear, compute_uv=False)

    @property
    def sheared(self) -> bool:
        axes = self.linear / np.maximum(self.scale, 1e-300)
        return bool(np.abs(np.triu(axes.T @ axes, 1)).max() > UNIFORM)


@dataclass
class _Body:
    path: Any
    frame: _Frame
    index: int


@dataclass
class _Shape:
    path: Any
    desc: Any
    body: Any  # path of the owner, empty = world
    index: int


class _Reader:
    """Reads one stage. Lengths stay in stage units until they are handed to the builder."""

    def __init__(self, px: SimpleNamespace, stage: Any, source: str, override: float | None):
        self.px, self.stage, self.source = px, stage, source
        self.notes: list[str] = []
        self.ignored: list[Ignored] = []
        self.unsupported: list[Ignored] = []
        self.repeated: dict[tuple[str, str], list[str]] = {}
        self.length = override if override is not None else px.UsdGeom.GetStageMetersPerUnit(stage)
        self.mass_unit = px.UsdPhysics.GetStageKilogramsPerUnit(stage)
        if override is None and not px.UsdGeom.StageHasAuthoredMetersPerUnit(stage):
            self.notes.append(f"metersPerUnit is not authored: {self.length:g}, as USD prescribes; meters_per_unit overrides it")
        self.xforms = px.UsdGeom.XformCache(px.Usd.TimeCode.EarliestTime())
        self.prims = list(px.Usd.PrimRange.Stage(stage, px.Usd.TraverseInstanceProxies()))
        self.order = {p.GetPath(): i for i, p in enumerate(self.prims)}
        self.parsed = px.parse(stage, [px.Sdf.Path.absoluteRootPath], excludePaths=[p.GetPath() for p in stage.GetPrototypes()])
        self.read_attributes: set[Any] = set()
        self.materials: dict[Any, Material] = {}
        self.bodies: dict[Any, _Body] = {}
        self.shapes: list[_Shape] = []
        self.masses: list[float | None] = []
        self.massless: list[Any] = []
        self.unbound: list[str] = []
        self.solids: dict[Any, tuple[Solid, ...]] = {}
        self.all_joints: set[Any] = set()

    # -- the whole --------------------------------------------------------------------------------------------------

    def read(self, delegate: Any) -> SceneReading:
        up = str(self.px.UsdGeom.GetStageUpAxis(self.stage))
        if not self.stage.HasAuthoredMetadata("upAxis"):
            self.notes.append("upAxis is not authored: Y, as USD prescribes")
        self.scenes = [(p, d) for p, d in self._descs("Scene")]
        self.builder = ModelBuilder(self._gravity(up).tolist(), up)
        self._composition_errors()
        body_descs = self._owned([(p, d) for p, d in self._descs("RigidBody") if self._enabled(p, d)])
        shape_descs = [(p, d) for kind in self._kinds("Shape") for p, d in self._descs(kind)]
        self.colliders: dict[Any, Any] = dict(sorted(shape_descs, key=lambda x: self.order.get(x[0], 0)))
        self.body_descs = dict(body_descs)
        active = self._owned([(p, d) for p, d in self.colliders.items() if d.collisionEnabled], self.body_descs)
        for path, desc in body_descs:
            self._body(path, desc)
        for path, desc in active:
            self._shape(path, desc)
        joints = JointReader(self).read()
        self._massless()
        self._filter()
        self._other_prims()
        if self.unbound:
            self.notes.append(f"no physics material on {some(self.unbound)}: friction 0.5 / 0.5, no restitution")
        self._diagnostics(delegate)
        gx, gy, gz = self.builder.gravity.tolist()
        return SceneReading(
            source=self.source,
            builder=self.builder,
            report=Report(self.source, tuple(self.notes), tuple(self._all_ignored()), tuple(self._sorted(self.unsupported))),
            bodies=tuple(str(p) for p, _ in body_descs),
            shapes=tuple(str(p) for p, _ in active),
            joints=tuple(str(p) for p in joints),
            mass=None if None in self.masses else float(sum(self.masses)),  # type: ignore[arg-type]
            gravity=(gx, gy, gz),
            up_axis=up,
            meters_per_unit=self.length,
            kilograms_per_unit=self.mass_unit,
        )

    def _kinds(self, ending: str) -> list[str]:
        return [str(k).rpartition(".")[2] for k in self.parsed if str(k).endswith(ending)]

    def _descs(self, kind: str) -> list[tuple[Any, Any]]:
        """(path, description) of one kind in stage order."""
        found = self.parsed.get(getattr(self.px.UsdPhysics.ObjectType, kind), ((), ()))
        return sorted(zip(*found, strict=True), key=lambda x: self.order.get(x[0], 0))

    def _enabled(self, path: Any, desc: Any) -> bool:
        if not desc.rigidBodyEnabled:
            self.notes.append(f"{path}: physics:rigidBodyEnabled = false: its colliders are static, or part of the body above it")
        return desc.rigidBodyEnabled

    def _owned(self, descs: list[tuple[Any, Any]], bodies: dict[Any, Any] | None = None) -> list[tuple[Any, Any]]:
        """What the first Scene simulates; a body's owner rules over that of its colliders."""
        scenes = [p for p, _ in self.scenes]
        kept = []
        for path, desc in descs:
            owner = desc.rigidBody if bodies is not None else None
            if owner and owner not in bodies:  # type: ignore[operator]
                continue  # the body is simulated elsewhere and reported there
            owners = [] if owner else [o for o in desc.simulationOwners if o in scenes]
            if owners and scenes[0] not in owners:
                self._repeat(path, f"physics:simulationOwner = {owners[0]}", f"only the first Scene, {scenes[0]}, is simulated")
            else:
                kept.append((path, desc))
        return kept

    def _gravity(self, up: str) -> np.ndarray:
        """[3] m/s^2 of the first Scene."""
        if not self.scenes:
            self.notes.append(f"no PhysicsScene prim: gravity 9.81 m/s^2 along -{up}")
            return -9.81 * np.eye(3)["XYZ".index(up)] + 0.0
        path, desc = self.scenes[0]
        for other, _ in self.scenes[1:]:
            self.notes.append(f"{other}: a second PhysicsScene; gravity is that of {path}")
        direction = np.array(desc.gravityDirection, dtype=float)
        magnitude = self.px.UsdPhysics.Scene(self.stage.GetPrimAtPath(path)).GetGravityMagnitudeAttr().Get()
        earth = magnitude is None or not math.isfinite(magnitude) or magnitude < 0.0
        return (9.81 if earth else self.length * written(magnitude)) * direction / np.linalg.norm(direction) + 0.0  # no -0

    def _composition_errors(self) -> None:
        for error in self.stage.GetCompositionErrors():
            path = getattr(error.rootSite, "path", None) or "/"
            self.unsupported.append(Ignored(str(path), "broken reference", " ".join(str(error).split())))

    def _diagnostics(self, delegate: Any) -> None:
        reported = ("CollisionAPI applied to an unknown", "possibly invalid inertia tensor", "(instantiating stage", "(recomposing stage")
        texts = (" ".join(d.commentary.split()) for d in delegate.TakeUncoalescedDiagnostics())
        self.notes.extend(f"USD: {t}" for t in dict.fromkeys(texts) if not any(r in t for r in reported))

    # -- bodies -----------------------------------------------------------------------------------------------------

    def _frame(self, path: Any) -> _Frame:
        matrix = np.array(self.xforms.GetLocalToWorldTransform(self.stage.GetPrimAtPath(path)))  # row vectors
        linear = matrix[:3, :3].T
        u, _, vt = np.linalg.svd(linear)
        rotation = u @ vt
        sign = 1.0 if np.linalg.det(rotation) > 0.0 else -1.0
        return _Frame(matrix[3, :3], linear, sign * rotation, sign)

    def _pose(self, frame: _Frame, owner: _Frame | None = None, rotation: np.ndarray | None = None) -> list[float]:
        """(x y z qx qy qz qw) in metres, in the owner's frame or the world."""
        turn, position = frame.rotation if rotation is None else rotation, frame.position
        if owner is not None:
            turn, position = owner.rotation.T @ turn, owner.rotation.T @ (position - owner.position)
        return [*(self.length * position).tolist(), *self._quaternion(turn)]

    def _quaternion(self, rotation: np.ndarray) -> list[float]:
        """(x y z w) with w >= 0."""
        quat = self.px.Gf.Matrix3d(*rotation.T.ravel().tolist()).ExtractRotation().GetQuat().GetNormalized()
        xyzw = [*quat.GetImaginary(), quat.GetReal()]
        return [-c for c in xyzw] if xyzw[3] < 0.0 else xyzw

    def _body(self, path: Any, desc: Any) -> None:
        frame = self._frame(path)
        if desc.startsAsleep:
            self._repeat(path, "physics:startsAsleep", "bodies never sleep here")
        if desc.kinematicBody and self._animated(path):
            self.ignored.append(Ignored(str(path), "animated pose", "a kinematic body keeps its authored velocities"))
        velocity = self.length * frame.sign * frame.rotation @ decimals(desc.linearVelocity)
        angular = np.radians(frame.rotation @ decimals(desc.angularVelocity))
        options = {"pose": self._pose(frame), "velocity": velocity, "angular_velocity": angular}
        try:
            if desc.kinematicBody:
                options["joint"] = JointType.KINEMATIC
            else:
                mass = MassReader(self).of(path, frame)
                self.masses.append(0.0 if path in self.massless else mass["mass"])
                options.update(mass)
            index = self.builder.add_body(str(path), **options)
        except (Unusable, ModelError) as error:
            self.unsupported.append(Ignored(str(path), "rigid body", str(error).removeprefix(f"{path}: ")))
            self.masses.append(None)
        else:
            self.bodies[path] = _Body(path, frame, index)

    def _massless(self) -> None:
        """Bodies without mass: only what a fixed joint holds needs none."""
        for path in self.massless:
            if path in self.bodies and self.bodies[path].index not in self.builder.welded:
                why = "its mass is zero: neither physics:mass nor an enabled collider gives it any; author one of them"
                self.unsupported.append(Ignored(str(path), "rigid body", why))
            elif path in self.bodies:
                self.notes.append(f"{path}: no mass: neither physics:mass nor an enabled collider gives it any; a fixed joint holds it")

    def _animated(self, path: Any) -> bool:
        prim = self.stage.GetPrimAtPath(path)
        while prim and not prim.IsPseudoRoot():
            if self.px.UsdGeom.Xformable(prim) and self.px.UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
                return True
            prim = prim.GetParent()
        return False

    # -- shapes -----------------------------------------------------------------------------------------------------

    def _shape(self, path: Any, desc: Any) -> None:
        prim, frame, owner = self.stage.GetPrimAtPath(path), self._frame(path), desc.rigidBody
        problem = self._shape_problem(prim, desc, frame)
        if problem is not None:
            self.unsupported.append(Ignored(str(path), *problem))
            return
        if owner and owner not in self.bodies:
            return  # refused with its body
        body = self.bodies[owner] if owner else None
        try:
            found = self.solids_of(prim, desc, frame)
            for i, solid in enumerate(found):
                rotation = frame.rotation @ solid.turn
                place = replace(frame, position=frame.position + frame.rotation @ solid.centre)
                options = {
                    "pose": self._pose(place, None if body is None else body.frame, rotation),
                    "name": f"{path}[{i}]" if len(found) > 1 else str(path),
                    "material": self._material(prim),
                    "surface_velocity": self._surface_velocity(prim, frame, rotation),
                }
                self.shapes.append(
                    _Shape(path, desc, owner, solid.add(self.builder, -1 if body is None else body.index, self.length, options))
                )
                self.notes.extend(solid.notes)
        except ModelError as error:
            self.unsupported.append(Ignored(str(path), f"{prim.GetTypeName()} collider", str(error).removeprefix(f"{path}: ")))

    def solids_of(self, prim: Any, desc: Any, frame: _Frame) -> tuple[Solid, ...]:
        """Of a collider that is supported, found once."""
        path = prim.GetPath()
        if path not in self.solids:
            owner = self.body_descs.get(desc.rigidBody) if desc.rigidBody else None
            self.solids[path] = solids(self.px, prim, desc, frame, owner is not None and not owner.kinematicBody)
        return self.solids[path]

    def _shape_problem(self, prim: Any, desc: Any, frame: _Frame) -> tuple[str, str] | None:
        """(what, why) where a collider cannot be simulated."""
        name, kind = f"{prim.GetTypeName()} collider", str(desc.type).rpartition(".")[2]
        if kind not in COLLIDERS:
            return name, f"this shape is not supported; use {_SHAPES}, or set physics:collisionEnabled = false"
        owner = self.body_descs.get(desc.rigidBody) if desc.rigidBody else None
        if kind == "PlaneShape" and owner is not None and not owner.kinematicBody:
            return name, "a plane is infinite and cannot move freely; make it static or its body kinematic"
        stretch = frame.stretch
        if kind == "CapsuleShape" and stretch[0] - stretch[2] > UNIFORM * stretch[0]:
            return "Capsule collider with ends scaled to ellipsoids", "this shape is not supported yet; scale all axes alike"
        if kind in ("CylinderShape", "ConeShape"):
            axis = "XYZ".index(str(desc.axis).rpartition(".")[2])
            one, other = frame.scale[(axis + 1) % 3], frame.scale[(axis + 2) % 3]
            if abs(one - other) > UNIFORM * max(one, other):
                return (
                    f"{name} scaled to an ellipse",
                    "this shape is not supported; scale both axes across it alike, or use a Mesh",
                )
        if kind in ("CubeShape", "CylinderShape", "ConeShape") and frame.sheared:
            what = name.removesuffix(" collider")
            return f"sheared {name}", f"a rotation under a non-uniform scale slants it; put the scale on the {what} itself"
        return None

    def _surface_velocity(self, prim: Any, frame: _Frame, rotation: np.ndarray) -> np.ndarray:
        """[3] m/s in the shape's frame."""
        attribute = prim.GetAttribute(SURFACE_VELOCITY)
        value = attribute.Get() if attribute else None
        if value is None:
            return np.zeros(3)
        self.read_attributes.add(attribute.GetPath())
        return self.length * frame.sign * rotation.T @ frame.rotation @ decimals(value)

    def _material(self, prim: Any) -> Material:
        """Of the physics binding, which the prims above may hold; the parser itself sees only bindings on the collider."""
        bound = self.px.UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
        if not bound or not bound.HasAPI(self.px.UsdPhysics.MaterialAPI):
            self.unbound.append(str(prim.GetPath()))
            return Material()
        path = bound.GetPath()
        if path not in self.materials:
            self.materials[path] = self._read_material(path)
        return self.materials[path]

    def _read_material(self, path: Any) -> Material:
        prim = self.stage.GetPrimAtPath(path)
        api = self.px.UsdPhysics.MaterialAPI(prim)
        static, dynamic = written(api.GetStaticFrictionAttr().Get()), written(api.GetDynamicFrictionAttr().Get())
        if dynamic > static:
            self.notes.append(f"{path}: dynamicFriction {dynamic:g} exceeds staticFriction {static:g}: {dynamic:g} is taken for both")
        bounce = written(api.GetRestitutionAttr().Get())
        material = Material(static_friction=max(static, dynamic), dynamic_friction=dynamic, restitution=bounce)
        values: dict[str, Any] = {}
        for name, field in COMBINE_ATTRIBUTES.items():
            attribute = prim.GetAttribute(name)
            mode = str(attribute.Get()) if attribute and attribute.HasAuthoredValue() else "average"
            if mode.upper() in Combine.__members__:
                values[field] = Combine[mode.upper()]
            else:
                why = f"{mode} is none of average, min, multiply, max: average is taken"
                self._repeat(path, name, why)
        for name, field in CONTACT_ATTRIBUTES.items():
            attribute = prim.GetAttribute(name)
            if attribute and attribute.Get() is not None:
                self.read_attributes.add(attribute.GetPath())
                unit = self.length if field == "slip_threshold" else self.mass_unit
                values[field] = unit * written(attribute.Get())
        return replace(material, **values)

    # -- pairs ------------------------------------------------------------------------------------------------------

    def _filter(self) -> None:
        """Pairs that groups or FilteredPairsAPI let pass through each other."""
        by_groups: dict[tuple[Any, ...], list[int]] = {}
        for shape in self.shapes:
            by_groups.setdefault(tuple(shape.desc.collisionGroups), []).append(shape.index)
        apart = self._groups_apart()
        for (groups_a, a), (groups_b, b) in combinations_with_replacement(by_groups.items(), 2):
            if any(frozenset(pair) in apart for pair in product(groups_a, groups_b)):
                self._filter_all(a, b)
        kinds = ("RigidBody", "Articulation", *self._kinds("Shape"))
        for path, desc in (x for kind in kinds for x in self._descs(kind)):
            for target in desc.filteredCollisions:
                self._filter_all(self._shapes_of(path), self._shapes_of(target))

        for path, desc in self._descs("Articulation"):
            if not self._touches_itself(path):
                own = [s.index for s in self.shapes if s.body and s.body in set(desc.articulatedBodies)]
                self._filter_all(own, own)

    def _touches_itself(self, root: Any) -> bool:
        """Whether the bodies of an articulation touch each other; the first attribute that is authored rules."""
        prim, answer = self.stage.GetPrimAtPath(root), True
        for name in reversed(SELF_COLLISION):
            attribute = prim.GetAttribute(name)
            if attribute and attribute.HasAuthoredValue():
                self.read_attributes.add(attribute.GetPath())
                answer = bool(attribute.Get())
        return answer

    def _groups_apart(self) -> set[frozenset[Any]]:
        """Pairs of collision groups that do not collide (one group: its members among themselves).

        USD's own CollisionGroupTable is not used: it takes a filteredGroups target that does not exist for the first group.
        """
        schema = self.px.UsdPhysics.CollisionGroup
        groups = [schema(p) for p in self.prims if p.IsA(schema)]
        merged: dict[Any, list[Any]] = {}  # merge key -> members
        key = {}
        for group in groups:
            name, path = group.GetMergeGroupNameAttr(), group.GetPath()
            key[path] = f"merge {name.Get()}" if name.HasAuthoredValue() else path
            merged.setdefault(key[path], []).append(path)
        apart: set[frozenset[Any]] = set()
        for group in groups:
            path, targets = group.GetPath(), group.GetFilteredGroupsRel().GetTargets()
            for missing in (t for t in targets if t not in key):
                self.notes.append(f"{path}: physics:filteredGroups names {missing}, which is no collision group")
            others = {key[t] for t in targets if t in key}
            if group.GetInvertFilteredGroupsAttr().HasAuthoredValue() and group.GetInvertFilteredGroupsAttr().Get():
                others = set(merged) - others
            apart.update(frozenset(pair) for other in others for pair in product(merged[key[path]], merged[other]))
        return apart

    def _filter_all(self, a: list[int], b: list[int]) -> None:
        for i, j in product(a, b):
            if i != j:
                self.builder.filter_pair(i, j)

    def _shapes_of(self, path: Any) -> list[int]:
        """Shapes of a body, one collider, or everything below another prim (an articulation)."""
        if path in self.body_descs:
            return [s.index for s in self.shapes if path in (s.body, s.path)]
        return [s.index for s in self.shapes if s.path.HasPrefix(path)]

    # -- what is not simulated --------------------------------------------------------------------------------------

    def _repeat(self, path: Any, what: str, why: str) -> None:
        """An ignored entry that many prims may share."""
        self.repeated.setdefault((what, why), []).append(str(path))

    def _all_ignored(self) -> list[Ignored]:
        entries = list(self.ignored)
        for (what, why), paths in self.repeated.items():
            if len(paths) <= 3:
                entries.extend(Ignored(p, what, why) for p in paths)
            else:
                entries.append(Ignored(paths[0], f"{what} (and on {len(paths) - 1} more prims)", why))
        return self._sorted(entries)

    def _sorted(self, entries: list[Ignored]) -> list[Ignored]:
        place = {str(p): i for p, i in self.order.items()}
        return sorted(entries, key=lambda e: place.get(e.path, -1))

    def _other_prims(self) -> None:
        skip = None  # subtree of a point instancer
        for prim in self.prims:
            path = prim.GetPath()
            if skip is not None and path.HasPrefix(skip):
                continue
            type_name = str(prim.GetTypeName())
            if prim.IsA(self.px.UsdGeom.PointInstancer):
                skip = path
                self._instancer(prim)
            elif path in self.all_joints:
                for what, why in unread(prim, self.read_attributes):
                    self._repeat(path, what, why)
            elif type_name.endswith("Joint"):
                self._repeat(path, type_name, "not a joint type of UsdPhysics: what it connects is not connected")
            elif type_name.startswith(("Mjc", "Newton", "Physx")) and not type_name.endswith("Scene"):
                self._repeat(path, type_name, "warp_lcp reads plain UsdPhysics")
            else:
                self._collider_type(prim, path, type_name)
                for what, why in unread(prim, self.read_attributes):
                    self._repeat(path, what, why)

    def _instancer(self, prim: Any) -> None:
        targets = [self.stage.GetPrimAtPath(p) for p in self.px.UsdGeom.PointInstancer(prim).GetPrototypesRel().GetTargets()]
        for root in [prim, *(t for t in targets if t)]:
            for inner in self.px.Usd.PrimRange(root, self.px.Usd.TraverseInstanceProxies()):
                if self._physical(inner):
                    why = f"instances with physics ({inner.GetPath()}) are not supported yet; use instanceable references instead"
                    self.unsupported.append(Ignored(str(prim.GetPath()), "PointInstancer", why))
                    return

    def _physical(self, prim: Any) -> bool:
        return prim.HasAPI(self.px.UsdPhysics.RigidBodyAPI) or prim.HasAPI(self.px.UsdPhysics.CollisionAPI)

    def _collider_type(self, prim: Any, path: Any, type_name: str) -> None:
        """A collider that the parser leaves out."""
        api = self.px.UsdPhysics.CollisionAPI
        if path in self.colliders or not prim.HasAPI(api) or not api(prim).GetCollisionEnabledAttr().Get():
            return
        if prim.IsA(self.px.UsdGeom.Gprim):
            why = f"UsdPhysics has no collider of this type; use {_SHAPES}"
            self.unsupported.append(Ignored(str(path), f"{type_name} collider", why))
        else:
            what = f"PhysicsCollisionAPI on {type_name or 'an untyped prim'}"
            self._repeat(path, what, "it is no geometry: apply it to the shapes below")
