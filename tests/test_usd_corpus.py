# SPDX-License-Identifier: Apache-2.0
"""UsdPhysics scenes made by others: what loads, what is refused and for which prims."""

import math

import numpy as np
import pytest
from test_usd import SHARED, needs_shared

import warp_lcp as wl
from warp_lcp.usd import read_usd

#: Pairs of shapes that may touch, read off the files by eye.
PAIRS = {
    "converted/muc_contact_excludes/contact_excludes.usdc": 7,
    "newton/ex_palletizer_scene.usda": 35,
    "newton/kamino_box_on_plane.usda": 1,
    "newton/test_geom_capsule.usda": 0,
    "newton/test_geom_ellipsoid.usda": 0,
    "openusd/usdPhysicsBoxOnBox.usda": 1,
    "openusd/usdPhysicsDistanceJoint.usda": 1,
    "openusd/usdPhysicsGroupFiltering.usda": 2,
    "openusd/usdPhysicsPairFiltering.usda": 2,
    "ovphysx_bsd/basic_simulation.usda": 0,
    "ovphysx_bsd/clone_with_root_transforms.usda": 0,
    "ovphysx_bsd/heterogeneous_clone.usda": 3,
    "ovphysx_bsd/simple_physics_scene.usda": 9,
}
#: Files in which mobilities of joints between the same two bodies add.
ADDED = {"converted/muc_stacked_joints/stacked_joints.usdc"}
NO_PHYSICS = {"newton/ex_crazyflie.usd", "ovphysx_bsd/api_surface_permutations.usda"}


def corpus():
    files = (p for p in SHARED.rglob("*.usd*") if "Payload" not in p.parts)
    return sorted(p.relative_to(SHARED).as_posix() for p in files)


def refusable(path):
    """Prims of a file that cannot be simulated, found by looking at the stage rather than by the loader."""
    from pxr import Usd, UsdGeom, UsdPhysics

    source = Usd.Stage.Open(str(path))
    found = set()
    for p in Usd.PrimRange.Stage(source, Usd.TraverseInstanceProxies()):
        collider = p.HasAPI(UsdPhysics.CollisionAPI) and p.IsA(UsdGeom.Gprim)
        body_above = next((a for a in chain(p) if a.HasAPI(UsdPhysics.RigidBodyAPI)), None)
        flying_plane = collider and p.GetTypeName() == "Plane" and body_above
        massless = p.HasAPI(UsdPhysics.RigidBodyAPI) and not massive(p) and not welded(source, p)
        if flying_plane or massless:
            found.add(str(p.GetPath()))
    return found


def rigid_bodies(path):
    """Prims with an enabled PhysicsRigidBodyAPI, in stage order."""
    from pxr import Usd, UsdPhysics

    source = Usd.Stage.Open(str(path))
    bodies = [p for p in Usd.PrimRange.Stage(source, Usd.TraverseInstanceProxies()) if p.HasAPI(UsdPhysics.RigidBodyAPI)]
    return [str(p.GetPath()) for p in bodies if UsdPhysics.RigidBodyAPI(p).GetRigidBodyEnabledAttr().Get()]


def chain(p):
    while p and not p.IsPseudoRoot():
        yield p
        p = p.GetParent()


def joints(source):
    """Enabled joints of types that UsdPhysics has."""
    from pxr import Usd, UsdPhysics

    found = [UsdPhysics.Joint(p) for p in Usd.PrimRange.Stage(source, Usd.TraverseInstanceProxies()) if p.IsA(UsdPhysics.Joint)]
    return [joint for joint in found if joint.GetJointEnabledAttr().Get()]


def ends(joint):
    """The rigid bodies that a joint joins, None = the world: the one a relationship names, or the one above what it names."""
    from pxr import UsdPhysics

    result = []
    for targets in (joint.GetBody0Rel().GetTargets(), joint.GetBody1Rel().GetTargets()):
        prim = joint.GetPrim().GetStage().GetPrimAtPath(targets[0]) if targets else None
        owner = next((a for a in chain(prim) if a.HasAPI(UsdPhysics.RigidBodyAPI)), None) if prim else None
        result.append(str(owner.GetPath()) if owner else None)
    return result


def welded(source, p):
    from pxr import UsdPhysics

    return any(UsdPhysics.FixedJoint(joint.GetPrim()) and str(p.GetPath()) in ends(joint) for joint in joints(source))


def held(joint):
    """How many of the six ways to move a joint takes away."""
    from pxr import UsdPhysics

    prim = joint.GetPrim()
    if prim.GetTypeName() in ("PhysicsRevoluteJoint", "PhysicsPrismaticJoint"):
        api = UsdPhysics.RevoluteJoint(prim) or UsdPhysics.PrismaticJoint(prim)
        return 6 if api.GetLowerLimitAttr().Get() > api.GetUpperLimitAttr().Get() else 5
    if prim.GetTypeName() == "PhysicsSphericalJoint":
        return 3
    if prim.GetTypeName() == "PhysicsFixedJoint":
        return 6
    axes = [axis for axis in ("transX", "transY", "transZ", "rotX", "rotY", "rotZ") if prim.HasAPI(UsdPhysics.LimitAPI, axis)]
    limits = [UsdPhysics.LimitAPI(prim, axis) for axis in axes]
    return sum(limit.GetLowAttr().Get() > limit.GetHighAttr().Get() for limit in limits)


def volume(prim, scale):
    """Of a collider, stage units; of a mesh that of its convex hull, by Qhull."""
    from pxr import UsdGeom
    from scipy.spatial import ConvexHull

    kind = prim.GetTypeName()
    if kind == "Mesh":
        return ConvexHull(np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(), dtype=float) * scale).volume
    if kind == "Cube":
        return UsdGeom.Cube(prim).GetSizeAttr().Get() ** 3 * np.prod(scale)
    if kind == "Sphere":
        return 4 / 3 * np.pi * UsdGeom.Sphere(prim).GetRadiusAttr().Get() ** 3 * np.prod(scale)
    api = getattr(UsdGeom, kind)(prim)
    k = "XYZ".index(api.GetAxisAttr().Get())
    r, h = api.GetRadiusAttr().Get() * scale[(k + 1) % 3], api.GetHeightAttr().Get() * scale[k]
    return np.pi * r**2 * {"Cylinder": h, "Cone": h / 3, "Capsule": h + 4 / 3 * r}[kind]


def masses(path):
    """kg by body, of those that are not kinematic: usd-core's own precedence rules, with the volumes above."""
    from pxr import Gf, Usd, UsdGeom, UsdPhysics

    source = Usd.Stage.Open(str(path))
    xforms = UsdGeom.XformCache()
    found = {}

    def information(prim):
        result = UsdPhysics.RigidBodyAPI.MassInformation()
        matrix = np.array(xforms.GetLocalToWorldTransform(prim))[:3, :3]
        result.volume = float(volume(prim, np.linalg.norm(matrix, axis=1)))
        result.inertia = Gf.Matrix3f(1.0)
        result.localRot = Gf.Quatf(1.0)
        return result

    for body in rigid_bodies(path):
        api = UsdPhysics.RigidBodyAPI(source.GetPrimAtPath(body))
        if not api.GetKinematicEnabledAttr().Get():
            mass = api.ComputeMassProperties(information)[0]  # -1: neither a mass nor a collider
            found[body] = max(mass, 0.0) * UsdPhysics.GetStageKilogramsPerUnit(source)
    return found


def massive(p):
    """Whether a mass or a collider of its own gives the body mass."""
    from pxr import Usd, UsdPhysics

    def owned(q):
        return next((a for a in chain(q) if a.HasAPI(UsdPhysics.RigidBodyAPI)), None) == p

    if p.HasAPI(UsdPhysics.MassAPI) and p.GetAttribute("physics:mass").Get() > 0:
        return True
    inner = Usd.PrimRange(p, Usd.TraverseInstanceProxies())
    return any(q.HasAPI(UsdPhysics.CollisionAPI) and owned(q) for q in inner)


@needs_shared
def test_the_whole_corpus_is_there():
    assert len(corpus()) == 52


@needs_shared
@pytest.mark.parametrize("name", corpus() if SHARED.is_dir() else [])
def test_scenes_of_others(name):
    reading = read_usd(SHARED / name)
    unsupported = {i.path for i in reading.report.unsupported}
    assert unsupported == refusable(SHARED / name)
    if not unsupported and name not in NO_PHYSICS:
        from pxr import Usd

        model, source = wl.load_usd(SHARED / name), Usd.Stage.Open(str(SHARED / name))
        assert [model.body_names[b] for b in model.scene_bodies] == rigid_bodies(SHARED / name)
        assert np.isfinite(model.q0).all()
        assert len(reading.joints) == len(joints(source))
        by_body = masses(SHARED / name)
        assert reading.mass == pytest.approx(sum(by_body.values()), rel=1e-6)  # USD's single precision
        mass = dict(zip(model.body_names, np.bincount(model.part_of, model.mass), strict=False))
        assert [mass[body] for body in by_body] == pytest.approx(list(by_body.values()), rel=1e-6)
        # What joints leave of six ways a body, whether they carry a body or close a loop.
        between = {}
        for joint in joints(source):
            if set(ends(joint)) - {None} and len(set(ends(joint))) == 2:
                between.setdefault(frozenset(ends(joint)) if name in ADDED else joint, []).append(held(joint))
        taken = sum(6 - sum(6 - h for h in each) for each in between.values())
        assert model.dofs - sum(sum(loop.ways) + sum(loop.turns) for loop in model.loops) == 6 * len(by_body) - taken
        if name in PAIRS:
            assert len(model.pairs) == PAIRS[name]
        return
    with pytest.raises(wl.SceneError) as caught:
        wl.load_usd(SHARED / name)
    message = str(caught.value)
    assert message.startswith(f"{SHARED / name}: ")
    assert "\n" not in message
    if name in NO_PHYSICS:
        assert "no physics in this stage" in message
    elif len(unsupported) <= 100:
        assert all(path in message for path in unsupported)


@needs_shared
def test_openusd_examples_in_si():
    model = wl.load_usd(SHARED / "openusd/usdPhysicsBoxOnBox.usda")
    assert model.gravity == pytest.approx([0, 0, -9.81])
    assert model.v0 == pytest.approx([0.02, 0.01, 0.02, math.radians(1), 0, 0])
    assert model.q0[:3] == pytest.approx([0, 0, 5])
    assert model.shape_size[1] == pytest.approx([7.5, 7.5, 0.1])  # size 2 scaled by 750, 750, 10 cm
    for name in ("Group", "Pair"):
        model = wl.load_usd(SHARED / f"openusd/usdPhysics{name}Filtering.usda")
        assert model.mass == pytest.approx([15.625] * 2, rel=1e-6)
        assert (model.shape_body[model.pairs] < 0).any(axis=1).all()  # each box touches the ground, not the other box
    joint = wl.load_usd(SHARED / "openusd/usdPhysicsDistanceJoint.usda").report.ignored
    assert [(i.path, i.what) for i in joint] == [("/World/DistanceJoint", "DistancePhysicsJoint")]


@needs_shared
def test_an_ellipsoid_has_the_axes_of_its_file():
    model = wl.load_usd(SHARED / "newton/test_geom_ellipsoid.usda")
    assert [wl.ShapeType(kind).name for kind in model.shape_type] == ["ELLIPSOID"]
    assert model.shape_size[0] == pytest.approx([0.11, 0.22, 0.33])
    assert model.mass == pytest.approx([1.0])


def table():
    """Total mass, bodies and joints that the README of the corpus gives for files in metres, as another engine reads them."""
    text, folder, rows = (SHARED / "README.md").read_text(), "", {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("## "):
            folder = line[3:].strip()
        elif len(cells) == 20 and cells[3] == "1" and cells[19].count(" ") == 2:
            mass, bodies, _ = cells[19].split()
            rows[f"{folder}/{cells[0]}"] = (float(mass), int(bodies[1:]))
    return rows


@needs_shared
def test_masses_and_bodies_agree_with_the_table():
    """To the four digits given there. What is kinematic has no mass with us; a body without mass or collider has none anywhere."""
    compared = 0
    for name, (mass, bodies) in table().items():
        reading = read_usd(SHARED / name)
        kinematic = name == "ovphysx_bsd/simple_physics_scene.usda"
        assert len(reading.bodies) == bodies, name
        if not kinematic and reading.mass is not None:
            assert reading.mass == pytest.approx(mass, rel=6e-4), name
            compared += 1
    assert compared > 35
