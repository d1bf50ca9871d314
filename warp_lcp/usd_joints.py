# SPDX-License-Identifier: Apache-2.0
"""Joints of a UsdPhysics stage: bodies, frames, limits, drives, and the few attributes of other engines that real robots need.

Decisions where USD leaves room:

- A limit whose lower bound is above its upper one locks its axis, as the schema says of D6 joints.
- Bodies that do not stand where a joint lets them are moved there when the scene starts; how far is noted.
- Joints with physics:excludeFromArticulation close loops. Of others that do, those that are furthest from the root.
- ``newton:armature``, ``newton:damping``, ``newton:friction`` and ``physxJoint:armature``, ``physxJoint:jointFriction`` are read. Damping
  of an angle is torque by degree/s, as drive gains are.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .errors import ModelError
from .joints import multiply
from .model import Drive, Ignored, JointType
from .usd_attributes import written

#: The axes of the parser's degrees of freedom.
DOFS = {"TransX": "tx", "TransY": "ty", "TransZ": "tz", "RotX": "rx", "RotY": "ry", "RotZ": "rz"}
#: Attributes by what they give, first come first served.
ATTRIBUTES = {
    "armature": ("newton:armature", "physxJoint:armature"),
    "damping": ("newton:damping",),
    "friction": ("newton:friction", "physxJoint:jointFriction"),
}
#: x of the joint's frame along the axis that is authored: (x y z w).
ALONG = {"X": (0.0, 0.0, 0.0, 1.0), "Y": (0.5, 0.5, 0.5, 0.5), "Z": (-0.5, -0.5, -0.5, 0.5)}


class JointReader:
    """Adds the joints of a stage to the builder of its reader (usd.py), whose bodies are there already."""

    def __init__(self, reader: Any):
        self.reader = reader

    def read(self) -> list[Any]:
        """Paths of enabled joints, in stage order."""
        reader, found = self.reader, []
        joints = [(path, desc, kind) for kind in reader._kinds("Joint") for path, desc in reader._descs(kind)]
        reader.all_joints = {path for path, _, _ in joints}
        for path, desc, kind in sorted(joints, key=lambda x: reader.order.get(x[0], 0)):
            prim = reader.stage.GetPrimAtPath(path)
            if not reader.px.UsdPhysics.Joint(prim).GetJointEnabledAttr().Get():
                reader._repeat(path, str(prim.GetTypeName()), "physics:jointEnabled = false")
                continue
            found.append(path)
            try:
                self._joint(path, desc, kind, prim)
            except ModelError as error:
                what = str(error).removeprefix(f"{path}: ")
                reader.unsupported.append(Ignored(str(path), str(prim.GetTypeName()), what))
        for path, desc in reader._descs("Articulation"):
            if not set(desc.articulatedJoints) & set(found):
                reader.ignored.append(Ignored(str(path), "articulation root", "no enabled joint belongs to it"))
        return found

    def _joint(self, path: Any, desc: Any, kind: str, prim: Any) -> None:
        reader = self.reader
        sides = [(desc.body0, desc.localPose0Position, desc.localPose0Orientation)]
        sides.append((desc.body1, desc.localPose1Position, desc.localPose1Orientation))
        bodies = [self._body(body) for body, _, _ in sides]
        if bodies[0] == bodies[1]:
            where = "the world to the world" if bodies[0] < 0 else f"{sides[0][0]} to itself"
            reader._repeat(path, str(prim.GetTypeName()), f"it joins {where}: nothing is held")
            return
        if any(body is not None and body < -1 for body in bodies):
            return  # refused with its body
        frames = [self._frame(position, turn) for _, position, turn in sides]
        if min(desc.breakForce, desc.breakTorque) < 1e30:
            reader._repeat(path, "physics:breakForce, physics:breakTorque", "joints do not break here")
        options: dict[str, Any] = {"name": str(path), "collide": desc.collisionEnabled, "loop": desc.excludeFromArticulation}
        if kind == "DistanceJoint":
            least = reader.length * written(desc.limit.lower) if desc.minEnabled else 0.0
            greatest = reader.length * written(desc.limit.upper) if desc.maxEnabled else math.inf
            options.pop("loop")
            reader.builder.add_distance(*bodies, least, greatest, parent_frame=frames[0], child_frame=frames[1], **options)
            return
        if kind in ("RevoluteJoint", "PrismaticJoint"):
            self._single(path, desc, kind, prim, bodies, frames, options)
        elif kind == "SphericalJoint":
            if desc.limit.enabled:
                reader._repeat(path, "cone limit (physics:coneAngle0Limit, coneAngle1Limit)", "not supported yet: the joint turns freely")
            options |= self._attributes(prim, "rrr")
            reader.builder.add_joint(JointType.SPHERICAL, *bodies, parent_frame=frames[0], child_frame=frames[1], **options)
        elif kind == "FixedJoint":
            reader.builder.add_joint(JointType.FIXED, *bodies, parent_frame=frames[0], child_frame=frames[1], **options)
        elif kind == "D6Joint":
            self._general(path, desc, prim, bodies, frames, options)
        else:
            raise ModelError(f"{path}: joints of this type are not supported; use a joint of UsdPhysics")

    def _single(self, path: Any, desc: Any, kind: str, prim: Any, bodies: list[int], frames: list[Any], options: dict[str, Any]) -> None:
        """A revolute or prismatic joint: along x of its frame, once that is turned to the axis."""
        angular = kind == "RevoluteJoint"
        turn = np.array(ALONG[str(desc.axis).rpartition(".")[2]])
        frames = [np.r_[frame[:3], multiply(frame[3:], turn)] for frame in frames]
        unit = math.radians(1.0) if angular else self.reader.length
        type_ = JointType.REVOLUTE if angular else JointType.PRISMATIC
        if desc.limit.enabled and desc.limit.lower > desc.limit.upper:
            type_ = JointType.FIXED
            self.reader.notes.append(f"{path}: its lower limit is above its upper one: locked")
        else:
            if desc.limit.enabled:
                options["limit"] = (unit * written(desc.limit.lower), unit * written(desc.limit.upper))
            options["drive"] = self._drive(path, desc.drive, angular)
            options |= self._attributes(prim, "r" if angular else "t")
        self.reader.builder.add_joint(type_, *bodies, parent_frame=frames[0], child_frame=frames[1], **options)

    def _general(self, path: Any, desc: Any, prim: Any, bodies: list[int], frames: list[Any], options: dict[str, Any]) -> None:
        """A D6 joint: six free axes, less what is locked."""
        free = dict.fromkeys(DOFS.values(), (-math.inf, math.inf))
        for dof, limit in _by_axis(desc.jointLimits):
            if dof not in DOFS:
                self.reader._repeat(path, "limit of the distance", "not supported on a D6 joint; use a distance joint")
            elif limit.enabled:
                unit = math.radians(1.0) if dof.startswith("Rot") else self.reader.length
                if limit.lower > limit.upper:
                    free.pop(DOFS[dof])
                else:
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
            self.reader.builder.add_joint(JointType.D6, *bodies, **options)

    def _body(self, path: Any) -> int:
        """Index of a body; -1 = world, -2 = one that is not there."""
        if not path or path not in self.reader.body_descs:
            return -1
        return self.reader.bodies[path].index if path in self.reader.bodies else -2

    def _frame(self, position: Any, turn: Any) -> np.ndarray:
        """(x y z qx qy qz qw), m."""
        quat = np.array([*turn.GetImaginary(), turn.GetReal()], dtype=float)
        return np.r_[self.reader.length * np.array([written(x) for x in position]), quat / np.linalg.norm(quat)]

    def _gain(self, angular: bool) -> float:
        """Unit of a drive's stiffness or damping."""
        reader = self.reader
        return reader.mass_unit * (reader.length**2 * 180.0 / math.pi if angular else 1.0)

    def _drive(self, path: Any, drive: Any, angular: bool) -> Drive | None:
        if not drive.enabled or not (drive.stiffness or drive.damping):
            return None
        reader = self.reader
        if drive.acceleration:
            raise ModelError(f"{path}: a drive of type acceleration is not supported yet; use type force")
        unit = math.radians(1.0) if angular else reader.length
        force = reader.mass_unit * reader.length ** (2 if angular else 1)
        limit = force * written(drive.forceLimit) if drive.forceLimit < 1e30 else math.inf
        gain = self._gain(angular)
        targets = unit * written(drive.targetPosition), unit * written(drive.targetVelocity)
        return Drive(gain * written(drive.stiffness), gain * written(drive.damping), limit, *targets)

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
