# SPDX-License-Identifier: Apache-2.0
"""Joints of a UsdPhysics stage: bodies, frames, limits, drives, and the few attributes of other engines that real robots need.

Decisions where USD leaves room:

- A limit whose lower bound is above its upper one locks its axis, as the schema says of D6 joints.
- Bodies that do not stand where a joint lets them are moved there when the scene starts; how far is noted. So are they, and all they
  carry, to where ``state:<axis>:physics:position`` says (PhysicsJointStateAPI; its velocity is read too).
- Joints with physics:excludeFromArticulation close loops. Of others that do, those along which nothing acts, furthest from the root.
- Joints between the same two bodies each take away from what is free, unless ``newton:jointsAddMobility`` on their articulation root
  says that each adds to it, as several joints of one body do in MuJoCo: then they act one after the other in stage order, the first on
  the first body, each as moved by those before it. Where their axes of rotation do not meet in a point, bodies without mass stand between.
- Gains of a drive of type acceleration are multiplied by the inertia that its joint sees where the scene starts (:class:`Drive`); as PhysX
  does, those of an angle are 1/s^2 by degree, and the greatest force is one.
- ``newton:armature``, ``newton:damping``, ``newton:friction`` and ``physxJoint:armature``, ``physxJoint:jointFriction`` are read. Damping
  of an angle is torque by degree/s, as drive gains are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .errors import ModelError
from .joints import compose, cross, inverse, multiply, rotate
from .model import Drive, Ignored, JointType
from .usd_attributes import neutral, written

#: The axes of the parser's degrees of freedom.
DOFS = {"TransX": "tx", "TransY": "ty", "TransZ": "tz", "RotX": "rx", "RotY": "ry", "RotZ": "rz"}
#: Attributes by what they give, first come first served.
ATTRIBUTES = {
    "armature": ("newton:armature", "physxJoint:armature"),
    "damping": ("newton:damping",),
    "friction": ("newton:friction", "physxJoint:jointFriction"),
}
#: x of the joint's frame along the axis that is authored: (x y z w).
ADDS = "newton:jointsAddMobility"
#: How far axes that meet, and poses that agree, may be apart: m and rad, of single precision.
NEAR = 1e-5
ALONG = {"X": (0.0, 0.0, 0.0, 1.0), "Y": (0.5, 0.5, 0.5, 0.5), "Z": (-0.5, -0.5, -0.5, 0.5)}


SEEN = "the inertia that they see where the scene starts"
STATES = "stand and move at the start as state:<axis>:physics:position and velocity say, with what they carry"
DEFAULTS: dict[str, Any] = {"armature": 0.0, "damping": 0.0, "friction": 0.0, "limit": None, "drive": None}
DEFAULTS |= {"start": math.nan, "start_velocity": math.nan}


@dataclass(frozen=True)
class _Axis:
    """One of several joints whose mobilities add.

    Attributes:
        name: its path. letter: t, r or ball. frame: its frame, direction: its axis, on the first body. options: for ``add_joint``.
    """

    name: str
    letter: str
    frame: np.ndarray
    direction: np.ndarray
    options: dict[str, Any]


class JointReader:
    """Adds the joints of a stage to the builder of its reader (usd.py), whose bodies are there already."""

    def __init__(self, reader: Any):
        self.reader = reader
        self.by_inertia: list[str] = []
        self.states: list[str] = []

    def read(self) -> list[Any]:
        """Paths of enabled joints, in stage order."""
        reader = self.reader
        joints = [(path, desc, kind) for kind in reader._kinds("Joint") for path, desc in reader._descs(kind)]
        reader.all_joints = {path for path, _, _ in joints}
        found: dict[Any, tuple[Any, str]] = {}
        for path, desc, kind in sorted(joints, key=lambda x: reader.order.get(x[0], 0)):
            prim = reader.stage.GetPrimAtPath(path)
            if reader.px.UsdPhysics.Joint(prim).GetJointEnabledAttr().Get():
                found[path] = (desc, kind)
            else:
                reader._repeat(path, str(prim.GetTypeName()), "physics:jointEnabled = false")
        stacks = self._stacks(found)
        follow = {path for stack in stacks for path in stack[1:]}
        stack_of = {stack[0]: stack for stack in stacks}
        for path, (desc, kind) in found.items():
            prim = reader.stage.GetPrimAtPath(path)
            self._lost(path, desc, kind, prim)
            try:
                if path in stack_of:
                    self._stack([(p, *found[p]) for p in stack_of[path]])
                elif path not in follow:
                    self._joint(path, desc, kind, prim)
            except ModelError as error:
                what = str(error).removeprefix(f"{path}: ")
                reader.unsupported.append(Ignored(str(path), str(prim.GetTypeName()), what))
        for path, desc in reader._descs("Articulation"):
            if not set(desc.articulatedJoints) & set(found):
                reader.ignored.append(Ignored(str(path), "articulation root", "no enabled joint belongs to it"))
        for what, paths in ((f"gains of drives of type acceleration are multiplied by {SEEN}", self.by_inertia), (STATES, self.states)):
            if paths:
                reader.notes.append(f"{some(paths)}: {what}")
        return list(found)

    def _stacks(self, found: dict[Any, tuple[Any, str]]) -> list[list[Any]]:
        """Joints between the same two bodies whose mobilities add, two and more, in stage order."""
        reader, stacks = self.reader, []
        for root, articulation in reader._descs("Articulation"):
            attribute = reader.stage.GetPrimAtPath(root).GetAttribute(ADDS)
            if not (attribute and attribute.Get()):
                continue
            reader.read_attributes.add(attribute.GetPath())
            between: dict[frozenset[str], list[Any]] = {}
            own = set(articulation.articulatedJoints)
            for path, (desc, kind) in found.items():
                if path in own and kind in ("RevoluteJoint", "PrismaticJoint", "SphericalJoint") and not desc.excludeFromArticulation:
                    between.setdefault(frozenset((str(desc.body0), str(desc.body1))), []).append(path)
            stacks += [stack for stack in between.values() if len(stack) > 1]
        return stacks

    def _sides(self, path: Any, desc: Any, prim: Any) -> tuple[list[int], list[np.ndarray]] | None:
        """Bodies (-1 = world) and frames of a joint that is one."""
        reader = self.reader
        bodies = [self._body(body) for body in (desc.body0, desc.body1)]
        schema = reader.px.UsdPhysics.Joint(prim)
        for relation, found in ((schema.GetBody0Rel(), desc.rel0), (schema.GetBody1Rel(), desc.rel1)):
            missing = [t for t in relation.GetTargets() if not reader.stage.GetPrimAtPath(t)]
            if missing:
                raise ModelError(
                    f"{path}: {relation.GetName()} names {missing[0]}, which does not exist; mend it, or clear it for the world"
                )
            for target in relation.GetTargets():
                named = reader.stage.GetPrimAtPath(target)
                if named.IsA(reader.px.Usd.Typed) and not named.IsA(reader.px.UsdGeom.Imageable):  # of what has no type one cannot know
                    mend = "which stands nowhere; name a body, or clear it for the world"
                    raise ModelError(f"{path}: {relation.GetName()} names {target}, {mend}")
            if len(relation.GetTargets()) > 1:
                reader.notes.append(f"{path}: {relation.GetName()} names several prims: {found} is taken")
        if bodies[0] == bodies[1]:
            where = "the world to the world" if bodies[0] < 0 else f"{desc.body0} to itself"
            reader._repeat(path, str(prim.GetTypeName()), f"it joins {where}: nothing is held")
            return None
        if any(body < -1 for body in bodies):
            return None  # refused with its body
        if min(desc.breakForce, desc.breakTorque) < 1e30:
            reader._repeat(path, "physics:breakForce, physics:breakTorque", "joints do not break here")
        for attribute in (schema.GetLocalRot0Attr(), schema.GetLocalRot1Attr()):
            if attribute.Get().GetLength() == 0.0:
                reader.notes.append(f"{path}: {attribute.GetName()} is zero, which is no rotation; (1, 0, 0, 0) is taken")
        first = self._frame(desc.rel0, desc.body0, schema.GetLocalPos0Attr().Get(), schema.GetLocalRot0Attr().Get())
        return bodies, [first, self._frame(desc.rel1, desc.body1, schema.GetLocalPos1Attr().Get(), schema.GetLocalRot1Attr().Get())]

    def _lost(self, path: Any, desc: Any, kind: str, prim: Any) -> None:
        """Tell of what acts along axes that the joint does not have."""
        locked = {dof for dof, limit in _by_axis(desc.jointLimits) if limit.lower > limit.upper} if kind == "D6Joint" else set()
        names = {dof[0].lower() + dof[1:]: dof for dof in (*DOFS, "Distance")}
        own = {"RevoluteJoint": {"angular"}, "PrismaticJoint": {"linear"}, "D6Joint": set(names)}.get(kind, set())
        metadata = prim.GetMetadata("apiSchemas")  # which has those that USD does not know as well
        applied = dict.fromkeys([*prim.GetAppliedSchemas(), *(metadata.GetAppliedItems() if metadata else ())])
        prefixes = {"PhysicsDriveAPI": "drive", "PhysicsLimitAPI": "limit", "PhysicsJointStateAPI": "state"}
        acting = [a.GetName() for a in prim.GetAuthoredAttributes() if not neutral(a.Get())]
        for base in ("PhysicsDriveAPI", "PhysicsLimitAPI"):
            names_it = [name for name in acting if name.startswith(f"{prefixes[base]}:")]
            without = [name for name in names_it if f"{base}:{name.split(':')[1]}" not in applied]
            if without:
                self.reader._repeat(path, ", ".join(sorted(without)), f"no {base} is applied that has it: not read")
        for schema in applied:
            base, _, instance = schema.partition(":")
            numbers = ("stiffness", "damping", "low", "high", "position", "velocity")
            if base not in prefixes or not {f"{prefixes[base]}:{instance}:physics:{name}" for name in numbers} & set(acting):
                continue
            if instance not in own or (base == "PhysicsLimitAPI" and kind != "D6Joint"):
                instances = f"takes {', '.join(sorted(own))} alone" if own and base != "PhysicsLimitAPI" else "takes none"
                self.reader._repeat(path, schema, f"a {prim.GetTypeName()} {instances}: not read")
            elif base == "PhysicsDriveAPI" and names.get(instance) in locked:
                self.reader._repeat(path, schema, "the axis is locked: it drives nothing")

    def _joint(self, path: Any, desc: Any, kind: str, prim: Any) -> None:
        reader, sides = self.reader, self._sides(path, desc, prim)
        if sides is None:
            return
        bodies, frames = sides
        options: dict[str, Any] = {"name": str(path), "collide": desc.collisionEnabled, "loop": desc.excludeFromArticulation}
        if kind == "DistanceJoint":
            least = reader.length * written(desc.limit.lower) if desc.minEnabled else 0.0
            greatest = reader.length * written(desc.limit.upper) if desc.maxEnabled else math.inf
            options.pop("loop")
            reader.builder.add_distance(*bodies, least, greatest, parent_frame=frames[0], child_frame=frames[1], **options)
            return
        if kind in ("RevoluteJoint", "PrismaticJoint"):
            frames, own = self._single(path, desc, kind, prim, frames)
            type_ = JointType.FIXED if own is None else JointType.REVOLUTE if kind == "RevoluteJoint" else JointType.PRISMATIC
            reader.builder.add_joint(type_, *bodies, parent_frame=frames[0], child_frame=frames[1], **options, **own or {})
        elif kind == "SphericalJoint":
            options |= self._ball(path, desc, prim)
            reader.builder.add_joint(JointType.SPHERICAL, *bodies, parent_frame=frames[0], child_frame=frames[1], **options)
        elif kind == "FixedJoint":
            reader.builder.add_joint(JointType.FIXED, *bodies, parent_frame=frames[0], child_frame=frames[1], **options)
        elif kind == "D6Joint":
            self._general(path, desc, prim, bodies, frames, options)
        else:
            raise ModelError(f"{path}: joints of this type are not supported; use a joint of UsdPhysics")

    def _ball(self, path: Any, desc: Any, prim: Any) -> dict[str, Any]:
        schema = self.reader.px.UsdPhysics.SphericalJoint(prim)
        if max(schema.GetConeAngle0LimitAttr().Get(), schema.GetConeAngle1LimitAttr().Get()) >= 0.0:
            self.reader._repeat(path, "cone limit (physics:coneAngle0Limit, coneAngle1Limit)", "not supported yet: the joint turns freely")
        return self._attributes(prim, "rrr")

    def _stack(self, members: list[tuple[Any, Any, str]]) -> None:
        """Joints whose mobilities add: all axes in the frame of the first body, where the second stands when all coordinates are zero."""
        reader, first = self.reader, members[0][0]
        ends: list[int] = []
        where = np.zeros(0)
        collide = False
        axes: list[_Axis] = []
        for path, desc, kind in members:
            prim = reader.stage.GetPrimAtPath(path)
            sides = self._sides(path, desc, prim)
            if sides is None:
                return
            bodies, frames = sides
            if kind == "SphericalJoint":
                letter, own = "ball", self._ball(path, desc, prim)
            else:
                frames, single = self._single(path, desc, kind, prim, frames)
                letter, own = "r" if kind == "RevoluteJoint" else "t", single or {}
                if single is None:
                    continue
            ends = ends or bodies
            sign = 1.0
            if bodies != ends:  # the same the other way round
                frames, sign = frames[::-1], -1.0
                if kind == "SphericalJoint":
                    raise ModelError(f"{first}: {path} names its bodies the other way round; exchange them")
            pose = compose(frames[0], inverse(frames[1]))
            if where.size and not _agree(pose, where):
                raise ModelError(f"{first}: it and {path} add their mobilities, but disagree about where {desc.body1} stands at zero")
            where = where if where.size else pose
            axes.append(_Axis(str(path), letter, frames[0], sign * rotate(frames[0][3:], np.eye(3)[0]), own))
            collide = collide or desc.collisionEnabled
        if not axes:  # all are locked
            reader.builder.add_joint(JointType.FIXED, *bodies, parent_frame=frames[0], child_frame=frames[1], name=str(first))
            return
        self._check_rank(first, axes)
        reader.notes.append(f"{some([axis.name for axis in axes])}: act one after the other ({ADDS})")
        parts = _parts(axes)
        if len(parts) > 1 and not collide and min(ends) >= 0:  # the builder knows of no joint between the two
            reader._filter_all(*(reader._shapes_of(body) for body in (members[0][1].body0, members[0][1].body1)))
        parent, parent_pose = ends[0], np.r_[np.zeros(6), 1.0]
        for k, (part, centre) in enumerate(parts):
            child = ends[1]
            if k + 1 < len(parts):  # it stands where the second body does, and moves with what comes before it
                child = reader.builder.add_carrier(f"{part[-1].name}:carried", ends[1])
            frame = np.r_[centre, part[0].frame[3:]]
            frames = [compose(inverse(parent_pose), frame), compose(inverse(where), frame)]
            options: dict[str, Any] = {"name": part[0].name, "parent_frame": frames[0], "child_frame": frames[1], "collide": collide}
            if part[0].letter == "ball":
                reader.builder.add_joint(JointType.SPHERICAL, parent, child, **options, **part[0].options)
            else:
                back = inverse(np.r_[np.zeros(3), frame[3:]])[3:]
                options["axis_names"] = [axis.name for axis in part]
                options["axes"] = [(axis.letter, rotate(back, axis.direction)) for axis in part]
                for name in ("armature", "damping", "friction", "limit", "drive", "start", "start_velocity"):
                    options[name] = [axis.options.get(name, DEFAULTS[name]) for axis in part]
                for name in ("armature", "damping", "friction"):
                    options[name] = [float(np.squeeze(value)) for value in options[name]]
                reader.builder.add_joint(JointType.D6, parent, child, **options)
            parent, parent_pose = child, where

    def _check_rank(self, first: Any, axes: list[_Axis]) -> None:
        """Two axes that move the same way have no mass of their own: M would be singular."""
        twists: list[np.ndarray] = []
        for axis in axes:
            ways = np.array([rotate(axis.frame[3:], e) for e in np.eye(3)]) if axis.letter == "ball" else [axis.direction]
            for way in ways:
                twists.append(np.r_[way, np.zeros(3)] if axis.letter == "t" else np.r_[cross(axis.frame[:3], way), way])
        heavy = all(np.all(np.asarray(axis.options.get("armature", 0.0)) > 0.0) for axis in axes)
        if np.linalg.matrix_rank(np.array(twists), tol=1e-6) < len(twists) and not heavy:
            names = some([axis.name for axis in axes])
            raise ModelError(f"{first}: {names} add mobilities that are not independent; leave one out, or give each newton:armature")

    def _single(self, path: Any, desc: Any, kind: str, prim: Any, frames: list[Any]) -> tuple[list[Any], dict[str, Any] | None]:
        """Of a revolute or prismatic joint: frames turned to its axis, which becomes x, and what acts along it; None = it is locked."""
        angular = kind == "RevoluteJoint"
        axis = prim.GetAttribute("physics:axis").Get() or "X"
        if axis not in ALONG:  # which the parser takes for x
            raise ModelError(f"{path}: physics:axis is {axis!r}; give one of {', '.join(ALONG)}")
        turn = np.array(ALONG[axis])
        frames = [np.r_[frame[:3], multiply(frame[3:], turn)] for frame in frames]
        if desc.limit.lower > desc.limit.upper:
            self.reader.notes.append(f"{path}: its lower limit is above its upper one: locked")
            return frames, None
        unit = math.radians(1.0) if angular else self.reader.length
        own: dict[str, Any] = {"drive": self._drive(path, desc.drive, angular)}
        if min(abs(desc.limit.lower), abs(desc.limit.upper)) < math.inf:  # the parser enables no limit of an angle on one side
            own["limit"] = (unit * written(desc.limit.lower), unit * written(desc.limit.upper))
        own |= self._attributes(prim, "r" if angular else "t")
        position, velocity = self._state(prim, "angular" if angular else "linear", angular)
        return frames, own | _given(start=position, start_velocity=velocity)

    def _general(self, path: Any, desc: Any, prim: Any, bodies: list[int], frames: list[Any], options: dict[str, Any]) -> None:
        """A D6 joint: six free axes, less what is locked."""
        free = dict.fromkeys(DOFS.values(), (-math.inf, math.inf))
        for dof, limit in _by_axis(desc.jointLimits):
            if dof not in DOFS:
                self.reader._repeat(path, "limit of the distance", "not supported on a D6 joint; use a distance joint")
            elif limit.lower > limit.upper:
                free.pop(DOFS[dof])
            else:
                unit = math.radians(1.0) if dof.startswith("Rot") else self.reader.length
                free[DOFS[dof]] = (unit * written(limit.lower), unit * written(limit.upper))
        drives: dict[str, Drive | None] = {}
        for dof, drive in _by_axis(desc.jointDrives):
            if dof in DOFS and DOFS[dof] in free:
                drives[DOFS[dof]] = self._drive(path, drive, dof.startswith("Rot"))
        plain = all(limit == (-math.inf, math.inf) for limit in free.values()) and not any(drives.values())
        options |= {"parent_frame": frames[0], "child_frame": frames[1]}
        if len(free) == 6 and plain:
            self.reader._repeat(path, str(prim.GetTypeName()), "all its axes are free and none is driven: nothing is held")
        elif not free:
            self.reader.builder.add_joint(JointType.FIXED, *bodies, **options)
        elif tuple(free) == ("rx", "ry", "rz") and plain:
            self.reader.builder.add_joint(JointType.SPHERICAL, *bodies, **options | self._attributes(prim, "rrr"))
        else:
            options |= self._attributes(prim, "".join(axis[0] for axis in free))
            options |= {"limit": list(free.values()), "drive": [drives.get(axis) for axis in free], "axes": tuple(free)}
            names = {axis: dof[0].lower() + dof[1:] for dof, axis in DOFS.items()}
            states = [self._state(prim, names[axis], axis[0] == "r") for axis in free]
            options |= _given(start=[position for position, _ in states], start_velocity=[velocity for _, velocity in states])
            self.reader.builder.add_joint(JointType.D6, *bodies, **options)

    def _body(self, path: Any) -> int:
        """Index of a body; -1 = world, -2 = one that is not there."""
        if not path or path not in self.reader.body_descs:
            return -1
        return self.reader.bodies[path].index if path in self.reader.bodies else -2

    def _frame(self, prim: Any, body: Any, position: Any, turn: Any) -> np.ndarray:
        """Of one side in its body's frame or the world, from that of the prim that the joint names (x y z qx qy qz qw), m.

        The parser's own is in single precision, and beside the prim where uneven scales above a rotation slant it.
        """
        reader = self.reader
        quat = np.array([*(written(x) for x in turn.GetImaginary()), written(turn.GetReal())])
        pose = np.r_[[written(x) for x in position], quat / np.linalg.norm(quat) if quat.any() else [0.0, 0.0, 0.0, 1.0]]
        if prim:
            named = reader._frame(prim)
            own = reader.bodies[body].frame if body in reader.bodies else None
            if own is not None and prim == body:
                pose[:3] = own.rotation.T @ own.linear @ pose[:3]
            else:
                place = np.r_[named.position, reader._quaternion(named.rotation)]
                pose = np.r_[named.position + named.linear @ pose[:3], multiply(place[3:], pose[3:])]
                if own is not None:
                    pose = compose(inverse(np.r_[own.position, reader._quaternion(own.rotation)]), pose)
        pose[:3] *= reader.length
        return pose

    def _gain(self, angular: bool) -> float:
        """Unit of a drive's stiffness or damping."""
        reader = self.reader
        return reader.mass_unit * (reader.length**2 * 180.0 / math.pi if angular else 1.0)

    def _drive(self, path: Any, drive: Any, angular: bool) -> Drive | None:
        if not drive.enabled or not (drive.stiffness or drive.damping):
            return None
        for name, value in (("stiffness", drive.stiffness), ("damping", drive.damping), ("maxForce", drive.forceLimit)):
            if not value >= 0.0 or (value == math.inf and name != "maxForce"):
                raise ModelError(f"{path}: its drive's physics:{name} is {value:g}; give a finite number, zero or greater")
        reader = self.reader
        unit = math.radians(1.0) if angular else reader.length
        force = reader.mass_unit * reader.length ** (2 if angular else 1)
        limit = force * written(drive.forceLimit) if drive.forceLimit < 1e30 else math.inf
        gain = self._gain(angular)
        if drive.acceleration:
            gain = 180.0 / math.pi if angular else 1.0
            if str(path) not in self.by_inertia:
                self.by_inertia.append(str(path))
        targets = unit * written(drive.targetPosition), unit * written(drive.targetVelocity)
        return Drive(gain * written(drive.stiffness), gain * written(drive.damping), limit, *targets, drive.acceleration)

    def _state(self, prim: Any, instance: str, angular: bool) -> tuple[float, float]:
        """Coordinate and velocity at the start, NaN where they are not authored."""
        unit, found = math.radians(1.0) if angular else self.reader.length, []
        for name in ("position", "velocity"):
            attribute = prim.GetAttribute(f"state:{instance}:physics:{name}")
            value = attribute.Get() if attribute and attribute.HasAuthoredValue() else None
            found.append(math.nan if value is None else unit * written(value))
            if value is not None:
                self.reader.read_attributes.add(attribute.GetPath())
                if str(prim.GetPath()) not in self.states:
                    self.states.append(str(prim.GetPath()))
        return found[0], found[1]

    def _attributes(self, prim: Any, axes: str) -> dict[str, Any]:
        """Armature, damping and dry friction, for each axis ("t" or "r")."""
        reader, found = self.reader, {}
        for what, names in ATTRIBUTES.items():
            for name in names:
                attribute = prim.GetAttribute(name)
                value = attribute.Get() if attribute else None
                if value:
                    reader.read_attributes.add(attribute.GetPath())
                    found[what] = [written(value) * self._unit(what, axis == "r") for axis in axes]
                    break
        return found

    def _unit(self, what: str, angular: bool) -> float:
        reader = self.reader
        if what == "damping":
            return self._gain(angular)
        if what == "armature":
            return reader.mass_unit * (reader.length**2 if angular else 1.0)
        return reader.mass_unit * reader.length ** (2 if angular else 1)


def _by_axis(pairs: Any) -> list[tuple[str, Any]]:
    """(TransX ... Distance, description) of the parser's lists."""
    return [(str(pair.first).rpartition(".")[2], pair.second) for pair in pairs]


def _given(**values: float | list[float]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if not np.isnan(value).all()}


def _agree(a: np.ndarray, b: np.ndarray) -> bool:
    between = compose(inverse(a), b)
    return bool(np.abs(between[:3]).max() < NEAR and 2.0 * np.abs(between[3:6]).max() < NEAR)


def _parts(axes: list[_Axis]) -> list[tuple[list[_Axis], np.ndarray]]:
    """Runs of axes that one joint can have, a ball by itself, and the point on the first body that all rotations of a run go through."""
    parts: list[tuple[list[_Axis], np.ndarray]] = []
    for axis in axes:
        if parts and "ball" not in (axis.letter, parts[-1][0][-1].letter):
            together = [*parts[-1][0], axis]
            centre = _meet([a for a in together if a.letter == "r"] or [together[0]])
            if centre is not None:
                parts[-1] = (together, centre)
                continue
        parts.append(([axis], axis.frame[:3]))
    return parts


def _meet(axes: list[_Axis]) -> np.ndarray | None:
    """Where lines meet; None where they do not."""
    points = np.array([axis.frame[:3] for axis in axes])
    across = [np.eye(3) - np.outer(axis.direction, axis.direction) for axis in axes]
    start = points.mean(axis=0)
    change = np.linalg.lstsq(
        np.concatenate(across), np.concatenate([a @ (x - start) for a, x in zip(across, points, strict=True)]), rcond=1e-6
    )
    centre = start + change[0]
    return centre if all(np.linalg.norm(a @ (centre - x)) < NEAR for a, x in zip(across, points, strict=True)) else None


def some(paths: list[str]) -> str:
    """A few of many, for a message."""
    return ", ".join(paths[:3]) + (f" and {len(paths) - 3} more" if len(paths) > 3 else "")
