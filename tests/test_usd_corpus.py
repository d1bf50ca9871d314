# SPDX-License-Identifier: Apache-2.0
"""UsdPhysics scenes made by others: what loads, what is refused and for which prims."""

import math

import numpy as np
import pytest
from test_usd import SHARED, needs_shared

import warp_lcp as wl
from warp_lcp.usd import read_usd

#: Files that can be simulated: bodies, mass [kg], pairs.
LOADED = {
    "converted/muc_contact_excludes/contact_excludes.usdc": (4, 108.0, 7),
    "newton/ex_palletizer_scene.usda": (7, 102.0, 35),
    "newton/kamino_box_on_plane.usda": (1, 1.0, 1),
    "newton/test_geom_capsule.usda": (1, 1.0, 0),
    "openusd/usdPhysicsBoxOnBox.usda": (1, 15.625, 1),
    "openusd/usdPhysicsDistanceJoint.usda": (1, 10.0, 1),
    "openusd/usdPhysicsGroupFiltering.usda": (2, 31.25, 2),
    "openusd/usdPhysicsPairFiltering.usda": (2, 31.25, 2),
    "ovphysx_bsd/basic_simulation.usda": (1, 10.0, 0),
    "ovphysx_bsd/clone_with_root_transforms.usda": (1, 1.0, 0),
    "ovphysx_bsd/heterogeneous_clone.usda": (3, 8.5, 3),
    "ovphysx_bsd/simple_physics_scene.usda": (4, 4.5, 9),
}
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
        odd_shape = collider and (p.GetTypeName() not in ("Cube", "Sphere", "Plane", "Capsule") or "ellipsoid" in p.GetName())
        flying_plane = collider and p.GetTypeName() == "Plane" and body_above
        massless = p.HasAPI(UsdPhysics.RigidBodyAPI) and not massive(p)
        if odd_shape or flying_plane or massless:
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
    if name in LOADED:
        bodies, mass, pairs = LOADED[name]
        model = wl.load_usd(SHARED / name)
        assert not unsupported
        assert (model.num_bodies, len(model.pairs)) == (bodies, pairs)
        assert reading.mass == pytest.approx(mass, rel=1e-6)
        return
    if not unsupported and name not in NO_PHYSICS:
        model = wl.load_usd(SHARED / name)
        assert list(model.body_names) == rigid_bodies(SHARED / name)
        assert np.isfinite(model.q0).all()
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


#: What each refused OpenUSD example is refused for, read off the files by eye.
REFUSED = {
    "usdPhysicsBoxOnQuad.usda": ["/World/Ground"],
    "usdPhysicsSpheresWithMaterial.usda": ["/World/Ground"],
}


@needs_shared
@pytest.mark.parametrize("name", REFUSED)
def test_refused_openusd_examples(name):
    assert [i.path for i in read_usd(SHARED / "openusd" / name).report.unsupported] == REFUSED[name]


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
@pytest.mark.parametrize(
    ("name", "mass"),
    [("converted/go1/go1.usda", 12.74), ("converted/quadruped_urdf/quadruped.usda", 30.7), ("newton/ex_humanoid.usda", 40.84),
     ("ovphysx_bsd/links_chain_sample.usda", 214.8), ("ovphysx_bsd/two_articulations.usda", 85.9), ("newton/ant.usda", 0.1822)],
)  # fmt: skip
def test_total_mass_agrees_with_newton(name, mass):
    """The masses of shared/usd/README.md, to the digits given there."""
    assert read_usd(SHARED / name).mass == pytest.approx(mass, rel=6e-4)
