# SPDX-License-Identifier: Apache-2.0
"""Attributes of USD prims beyond UsdPhysics: those that are read, and those of other engines that change the motion and are not."""

from __future__ import annotations

import difflib
from typing import Any

import numpy as np

CONTACT_ATTRIBUTES = {
    "warpLcp:normalStiffness": "normal_stiffness",
    "warpLcp:normalDamping": "normal_damping",
    "warpLcp:tangentStiffness": "tangent_stiffness",
    "warpLcp:tangentDamping": "tangent_damping",
    "warpLcp:slipThreshold": "slip_threshold",
}
COMBINE_ATTRIBUTES = {
    "physxMaterial:frictionCombineMode": "friction_combine",
    "physxMaterial:restitutionCombineMode": "restitution_combine",
}
SELF_COLLISION = ("newton:selfCollisionEnabled", "physxArticulation:enabledSelfCollisions")
SURFACE_VELOCITY = "warpLcp:surfaceVelocity"

#: Attributes of other engines that change the motion: family -> names (None: all), with the value that has no effect.
VENDOR_ATTRIBUTES: dict[str, dict[str, Any] | None] = {
    "physxRigidBody": {
        "disableGravity": False,
        "linearDamping": 0.0,
        "angularDamping": 0.0,
        "lockedPosAxis": 0,
        "lockedRotAxis": 0,
        "enableGyroscopicForces": True,
    },
    "physxForce": None,
    "physxSurfaceVelocity": None,
    "physxTendon": None,
    "physxLimit": None,
    "physxJoint": {"maxJointVelocity": 0.0},
    "physxArticulation": {"enabledSelfCollisions": True},
    "physxParticle": None,
    "physxDeformable": None,
    "physxMaterial": {"compliantContactStiffness": 0.0, "compliantContactDamping": 0.0},
    "physxCollision": {"restOffset": 0.0},
    "newton": {
        "contactStiffness": 0.0,
        "contactDamping": 0.0,
        "rollingFriction": 0.0,
        "torsionalFriction": 0.0,
        "contactMargin": 0.0,
        "massModel": "solid",
        "velocityLimit": 0.0,
        "effortLimit": 0.0,
        "limitStiffness": 0.0,
        "limitDamping": 0.0,
        "selfCollisionEnabled": True,
        "jointsAddMobility": False,
    },
    "mjc": {
        "stiffness": 0.0,
        "solref": None,
        "solimp": None,
        "condim": 3,
        "priority": 0,
        "solmix": 1.0,
        "gravcomp": 0.0,
        "margin": 0.0,
        "inertia": "",
    },
}
#: Applied schemas that couple joints: beginnings of their names, which need not be registered.
COUPLINGS = ("NewtonMimicAPI", "PhysxMimicJointAPI", "MjcEquality")
VENDOR_NAMES = {"physx": "PhysX", "newton": "Newton", "mjc": "MuJoCo"}


def unread(prim: Any, read: set[Any]) -> list[tuple[str, str]]:
    """(what, why) of authored attributes that would change the motion and are not in ``read``: one entry for each family."""
    entries: list[tuple[str, str]] = []
    families: dict[str, list[str]] = {}
    defined: set[str] | None = None
    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        family = name.partition(":")[0]
        if family == "warpLcp" and attribute.GetPath() not in read:
            entries.append(_stray(name))
        elif family == "physics":
            defined = set(prim.GetPrimDefinition().GetPropertyNames()) if defined is None else defined
            stray = name.count(":") == 1 and name not in defined and not isinstance(attribute.Get(), str)
            if stray and not neutral(attribute.Get()):
                families.setdefault("physics", []).append(name)
        elif attribute.GetPath() not in read and _changes_motion(name, attribute):
            families.setdefault(family, []).append(name)
    schemas = prim.GetMetadata("apiSchemas")
    for schema in schemas.GetAppliedItems() if schemas else ():
        if schema.startswith(COUPLINGS):
            entries.append((schema, "joints that follow others are not supported yet: the joint moves by itself"))
    for family, names in families.items():
        if family == "physics":
            why = "no schema applied to this prim has it, so USD does not read it; apply PhysicsMassAPI, PhysicsRigidBodyAPI, ..."
        else:
            engine = next((v for k, v in VENDOR_NAMES.items() if family.startswith(k)), family)
            why = f"an extension of {engine} that warp_lcp does not read"
        entries.append((", ".join(sorted(names)), why))
    return entries


def _stray(name: str) -> tuple[str, str]:
    """Of an attribute of ours that has no effect where it is."""
    known = [*CONTACT_ATTRIBUTES, SURFACE_VELOCITY]
    if name in known:
        where = "an enabled collider" if name == SURFACE_VELOCITY else "a PhysicsMaterialAPI prim bound to a collider"
        return name, f"has an effect only on {where}"
    near = difflib.get_close_matches(name, known, n=1)
    return name, f"unknown attribute{f'; did you mean {near[0]}?' if near else ''}"


def _changes_motion(name: str, attribute: Any) -> bool:
    family, _, rest = name.partition(":")
    names = VENDOR_ATTRIBUTES.get(family, {})
    if names is None:
        return not neutral(attribute.Get())
    if rest not in names:
        return False
    value, default = attribute.Get(), names[rest]
    return value != default and (default is True or not neutral(value))


def neutral(value: Any) -> bool:
    """Zero, false, empty or infinite: the ways in which schemas say 'nothing'."""
    if value is None or isinstance(value, str):
        return not value
    try:
        numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return False
    return not np.any(np.isfinite(numbers) & (numbers != 0.0))


def written(value: float) -> float:
    """The decimal an author wrote: USD keeps single precision, in which 9.81 reads 9.8100004196."""
    return float(str(np.float32(value)))


def decimals(values: Any) -> np.ndarray:
    """The same of several numbers."""
    return np.array([written(value) for value in values])
