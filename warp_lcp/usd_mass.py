# SPDX-License-Identifier: Apache-2.0
"""Mass, centre of mass and inertia of a UsdPhysics body: by USD's own rules, with the volumes of its colliders."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .builder import compose_mass, rotation_matrix
from .errors import ModelError
from .usd_attributes import decimals, written
from .usd_shapes import COLLIDERS


class Unusable(Exception):
    """A body whose mass cannot be used."""


class MassReader:
    """Reads masses for its reader (usd.py), which knows the stage, its units and its colliders."""

    def __init__(self, reader: Any):
        self.reader = reader

    def of(self, path: Any, frame: Any) -> dict[str, Any]:
        """Mass [kg], centre of mass [m, body frame] and inertia [kg m^2, body axes]; None where unknown.

        USD's own precedence rules, by ComputeMassProperties. What is authored on the body itself is taken from there:
        the function takes any inertia under 1e-5 for unauthored and works in single precision.
        """
        prim = self.reader.stage.GetPrimAtPath(path)
        own = [p for p, d in self.reader.colliders.items() if d.rigidBody == path and d.collisionEnabled]
        for p in (path, *own):
            self._check_authored(p)
        unknown: list[Any] = []
        found, diagonal, com, axes = self.reader.px.UsdPhysics.RigidBodyAPI(prim).ComputeMassProperties(
            lambda collider: self._unit_mass(collider, frame, unknown)
        )
        authored = self._authored_mass(prim)
        mass = authored["mass"] or found
        if not unknown and not mass > 0.0:
            self.reader.massless.append(path)
            return {"mass": None}
        if not own and authored["diagonal"] is None:
            self.reader.notes.append(
                f"{path}: no collider and no physics:diagonalInertia: the inertia of a sphere of 0.1 m radius, as in USD"
            )
        elif authored["zero"]:
            self.reader.notes.append(f"{path}: physics:mass = 0 means 'not authored' in USD: its mass follows from its colliders")
        if authored["diagonal"] is not None:
            diagonal, axes = authored["diagonal"], authored["axes"]
        if authored["com"] is not None:
            com = frame.rotation.T @ frame.linear @ authored["com"]
        if unknown and not authored["mass"]:
            return {"mass": None}
        values: dict[str, Any] = {"mass": self.reader.mass_unit * mass}
        if len(own) == 1 and not self.reader.stage.GetPrimAtPath(own[0]).HasAPI(self.reader.px.UsdPhysics.MassAPI):
            unknown = own  # whatever its density: the builder finds centre and inertia in double precision
        if not unknown or authored["com"] is not None:
            values["com"] = self.reader.length * np.array(com, dtype=float)
        if not unknown or authored["diagonal"] is not None:
            turn = self._principal_axes(axes)
            inertia = self.reader.mass_unit * self.reader.length**2 * turn @ np.diag(np.array(diagonal, dtype=float)) @ turn.T
            values["inertia"] = 0.5 * (inertia + inertia.T)
        return values

    def _principal_axes(self, quat: Any) -> np.ndarray:
        """Rotation matrix; the identity where the quaternion is unauthored (zero) or was never set."""
        xyzw = np.array([*quat.GetImaginary(), quat.GetReal()], dtype=float)
        norm = np.linalg.norm(xyzw)
        return rotation_matrix(xyzw / norm) if abs(norm - 1.0) < 1e-3 else np.eye(3)

    def _check_authored(self, path: Any) -> None:
        """Refuse mass and density that USD would silently take for unauthored."""
        prim = self.reader.stage.GetPrimAtPath(path)
        if not prim.HasAPI(self.reader.px.UsdPhysics.MassAPI):
            return
        for name in ("physics:mass", "physics:density"):
            value = prim.GetAttribute(name).Get()
            if value is not None and not (math.isfinite(value) and value >= 0.0):
                raise Unusable(f"{path}: {name} is {written(value):g}; it must be finite and greater than zero")

    def _authored_mass(self, prim: Any) -> dict[str, Any]:
        """What the body prim itself says: mass, com (prim's local space), diagonal, axes; None where unauthored."""
        result: dict[str, Any] = {"mass": None, "com": None, "diagonal": None, "axes": None, "zero": False}
        if not prim.HasAPI(self.reader.px.UsdPhysics.MassAPI):
            return result
        api = self.reader.px.UsdPhysics.MassAPI(prim)
        mass = api.GetMassAttr()
        result["mass"] = written(mass.Get()) or None
        result["zero"] = mass.HasAuthoredValue() and mass.Get() == 0.0 and not api.GetDensityAttr().Get()
        com = decimals(api.GetCenterOfMassAttr().Get())
        if np.isfinite(com).all():
            result["com"] = com
        diagonal = decimals(api.GetDiagonalInertiaAttr().Get())
        if diagonal.any():
            result["diagonal"], result["axes"] = diagonal, api.GetPrincipalAxesAttr().Get()
        return result

    def _unit_mass(self, prim: Any, body: Any, unknown: list[Any]) -> Any:
        """Volume and inertia at unit density of one collider, stage units, for ComputeMassProperties."""
        Gf = self.reader.px.Gf
        info = self.reader.px.UsdPhysics.RigidBodyAPI.MassInformation()
        frame = self.reader._frame(prim.GetPath())
        solid = self._solid(prim, self.reader.colliders.get(prim.GetPath()), frame)
        if solid is None:
            unknown.append(prim.GetPath())
            solid = (1.0, np.zeros(3), np.eye(3))
        volume, centre, inertia = solid
        info.volume = float(volume)
        info.inertia = Gf.Matrix3f(*(volume * inertia).ravel().tolist())
        info.centerOfMass = Gf.Vec3f(*centre.tolist())
        info.localPos = Gf.Vec3f(*(body.rotation.T @ (frame.position - body.position)).tolist())
        x, y, z, w = self.reader._quaternion(body.rotation.T @ frame.rotation)
        info.localRot = Gf.Quatf(w, x, y, z)
        return info

    def _solid(self, prim: Any, desc: Any, frame: Any) -> tuple[float, np.ndarray, np.ndarray] | None:
        """(volume, centre, inertia [3, 3] per unit mass about it) in the collider's frame; None = unknown."""
        if desc is None or str(desc.type).rpartition(".")[2] not in COLLIDERS:
            return None
        try:
            parts = [solid.volume() for solid in self.reader.solids_of(prim, desc, frame)]
        except ModelError:
            return None  # refused as a shape
        if any(part is None for part in parts):
            return None
        if len(parts) == 1:
            return parts[0]
        volume, centre, inertia = compose_mass([(v, c, v * i) for v, c, i in parts])  # type: ignore[misc]
        return volume, centre, inertia / volume
