# SPDX-License-Identifier: Apache-2.0
"""Reading USD scenes: units, mass, poses, materials, pairs, what is refused, and what the shipped scenes say."""

import builtins
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warp_lcp as wl
from warp_lcp import JointType, ShapeType, scenes
from warp_lcp.usd import read_usd

pytest.importorskip("pxr", reason="needs the extra 'usd'")

SHARED = Path(__file__).resolve().parents[2] / "shared" / "usd"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"{SHARED} does not exist")

SI = 'metersPerUnit = 1\n    kilogramsPerUnit = 1\n    upAxis = "Z"'
CM = 'metersPerUnit = 0.01\n    kilogramsPerUnit = 1\n    upAxis = "Z"'
SCENE = 'def PhysicsScene "Scene" {}'
BODY = "PhysicsRigidBodyAPI"
MASS = "PhysicsMassAPI"
COLLIDER = "PhysicsCollisionAPI"


def prim(kind, name, apis=(), content="", metadata=""):
    """Text of one prim; ';' ends a statement, so that cases stay short."""
    api = f"prepend apiSchemas = [{', '.join(f'{chr(34)}{a}{chr(34)}' for a in apis)}]" if apis else ""
    return f'def {kind} "{name}" (\n{api}\n{metadata}\n)\n{{\n' + content.replace(";", "\n") + "\n}\n"


def xform(**ops):
    order = ", ".join(f'"xformOp:{name}"' for name in ops)
    types = {"translate": "double3", "scale": "double3", "rotateXYZ": "double3"}
    lines = [f"{types.get(n, 'double')} xformOp:{n} = {v}" for n, v in ops.items()]
    return ";".join([*lines, f"uniform token[] xformOpOrder = [{order}]"]) + ";"


def layer(*prims, head=SI):
    return f"#usda 1.0\n(\n    {head}\n)\n" + "\n".join(p.replace("{}", "{\n}") for p in prims)


def stage(*prims, head=SI):
    from pxr import Sdf, Usd

    root = Sdf.Layer.CreateAnonymous(".usda")
    root.ImportFromString(layer(*prims, head=head))
    return Usd.Stage.Open(root)


def cube(name="C", content="", apis=(COLLIDER,), size=1.0):
    return prim("Cube", name, apis, f"double size = {size};{content}")


def body(name="B", content="", inner=None, apis=(BODY, MASS)):
    return prim("Xform", name, apis, content + ";" + (cube() if inner is None else inner))


def load(*prims, head=SI, **options):
    return wl.load_usd(stage(SCENE, *prims, head=head), **options)


def read(*prims, head=SI, **options):
    return read_usd(stage(SCENE, *prims, head=head), **options)


def refused(*prims, head=SI):
    with pytest.raises(wl.SceneError) as caught:
        load(*prims, head=head)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def material(content, name="M"):
    return prim("Material", name, ("PhysicsMaterialAPI",), content)


BOUND = "rel material:binding:physics = </M>;"


def bound_cube(content="", name="C"):
    return cube(name, BOUND + content, (COLLIDER, "MaterialBindingAPI"))


# -- units ----------------------------------------------------------------------------------------------------------


def test_centimetre_stage_is_converted():
    spin = "vector3f physics:velocity = (100, 0, 0); vector3f physics:angularVelocity = (0, 0, 180);"
    model = load(body(content=spin + xform(translate="(0, 0, 500)"), inner=cube(size=25)), head=CM)
    assert model.mass == pytest.approx([15.625], rel=1e-6)  # (0.25 m)^3 at 1000 kg/m^3
    assert model.inertia[0] == pytest.approx(15.625 * 0.25**2 / 6 * np.eye(3), rel=1e-6)
    assert model.q0 == pytest.approx([0, 0, 5, 0, 0, 0, 1])
    assert model.v0 == pytest.approx([1, 0, 0, 0, 0, math.pi])
    assert model.shape_size[0] == pytest.approx([0.125] * 3)
    assert model.gravity == pytest.approx([0, 0, -9.81])


def test_gravity_in_stage_units_and_along_an_authored_direction():
    scene = prim("PhysicsScene", "S", (), "vector3f physics:gravityDirection = (0, 3, 4); float physics:gravityMagnitude = 162;")
    model = wl.load_usd(stage(scene, body(), head=CM))
    assert model.gravity == pytest.approx([0, 1.62 * 0.6, 1.62 * 0.8])


def test_kilograms_per_unit():
    grams = SI.replace("kilogramsPerUnit = 1", "kilogramsPerUnit = 0.001")
    inertia = "float physics:mass = 5; float3 physics:diagonalInertia = (1, 1, 1);"
    model = load(body(content=inertia), body("Default"), head=grams)
    assert model.mass == pytest.approx([0.005, 1000.0], rel=1e-6)  # the default density is 1000 kg/m^3 in any unit
    assert model.inertia[0] == pytest.approx(0.001 * np.eye(3))


def test_small_inertia_in_grams_and_centimetres():
    head = CM.replace("kilogramsPerUnit = 1", "kilogramsPerUnit = 0.001")
    model = load(body(content="float physics:mass = 3; float3 physics:diagonalInertia = (2, 2, 2);"), head=head)
    assert model.inertia[0] == pytest.approx(2e-7 * np.eye(3), rel=1e-6)  # g cm^2


def test_unauthored_units_follow_usd_and_are_noted():
    reading = read(body(), head='upAxis = "Z"')
    assert (reading.meters_per_unit, reading.kilograms_per_unit) == (0.01, 1.0)
    assert any("metersPerUnit is not authored" in n for n in reading.report.notes)


def test_meters_per_unit_can_be_overridden_and_the_stage_is_left_alone():
    from pxr import UsdGeom

    source = stage(SCENE, body(), head=CM)
    model = wl.load_usd(source, meters_per_unit=2.0)
    assert model.mass == pytest.approx([8000.0], rel=1e-6)
    assert model.gravity == pytest.approx([0, 0, -9.81])
    assert UsdGeom.GetStageMetersPerUnit(source) == 0.01
    with pytest.raises(wl.SceneError, match="meters_per_unit is 0"):
        wl.load_usd(source, meters_per_unit=0.0)


def test_up_axis_and_missing_scene_prim():
    model = wl.load_usd(stage(body(), head=SI.replace('"Z"', '"Y"')))
    assert (model.up_axis, model.gravity.tolist()) == ("Y", [0, -9.81, 0])
    assert any("no PhysicsScene" in n for n in model.report.notes)


# -- poses ----------------------------------------------------------------------------------------------------------


def test_nested_transforms_and_non_uniform_scale():
    inner = cube("C", xform(translate="(1, 0, 0)", rotateZ=90, scale="(1, 2, 3)"))
    outer = xform(translate="(0, 0, 10)", rotateZ=90, scale="(2, 2, 2)")
    model = load(prim("Xform", "Root", (), outer + body(content=xform(translate="(1, 0, 0)"), inner=inner)))
    half = math.sqrt(0.5)
    assert model.body_names == ("/Root/B",)
    assert model.q0 == pytest.approx([0, 2, 10, 0, 0, half, half])
    assert model.shape_pose[0] == pytest.approx([2, 0, 0, 0, 0, half, half])
    assert model.shape_size[0] == pytest.approx([1, 2, 3])
    assert model.mass == pytest.approx([1000 * 2 * 4 * 6], rel=1e-6)


def test_mirrored_transforms_keep_proper_rotations():
    plane = prim("Plane", "P", (COLLIDER,), 'uniform token axis = "X";' + xform(scale="(-1, 1, 1)"))
    ball = prim("Sphere", "S", (COLLIDER,), "double radius = 1;" + xform(scale="(2, -2, 2)"))
    model = load(plane, body(content=xform(translate="(1, 2, 3)", scale="(-1, 1, 1)"), inner=cube(size=2)), body("B2", inner=ball))
    assert np.linalg.norm(model.q0[3:7]) == pytest.approx(1)
    assert model.shape_size[1:].tolist() == [[1, 1, 1], [2, 0, 0]]
    x, y, z, w = model.shape_pose[0, 3:]
    normal = [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]
    assert normal == pytest.approx([-1, 0, 0], abs=1e-12)  # +x, mirrored


def test_sheared_cube_and_capsule_with_ellipsoids_are_refused():
    slanted = prim("Xform", "X", (), xform(scale="(1, 2, 1)") + cube("C", xform(rotateZ=30)))
    pill = prim("Capsule", "Pill", (COLLIDER,), xform(scale="(1, 1, 1.5)"))
    message = refused(body(), slanted, pill)
    assert "sheared Cube collider /X/C" in message
    assert "Capsule collider with ends scaled to ellipsoids /Pill" in message


def test_spheres_scaled_unevenly_are_ellipsoids():
    """Their points x = L u + c, |u| = radius, have |A^-1 R^T (x - c)| = 1, however turned, mirrored, slanted or scaled; mass by volume."""
    egg = prim("Sphere", "Egg", (COLLIDER,), "double radius = 2;" + xform(translate="(1, 2, 3)", rotateZ=30, scale="(0.5, -1, 1.5)"))
    slanted = prim("Xform", "X", (), xform(scale="(1, 2, 1)") + prim("Sphere", "S", (COLLIDER,), xform(rotateZ=30, scale="(1, 1, 3)")))
    model = load(body(inner=egg), body("B2", inner=slanted), head=CM)
    assert model.shape_type.tolist() == [ShapeType.ELLIPSOID] * 2
    assert model.shape_size[0] == pytest.approx([0.01, 0.02, 0.03])
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    for shape, linear in enumerate((0.02 * turn @ np.diag([0.5, -1, 1.5]), 0.01 * np.diag([1, 2, 1]) @ turn @ np.diag([1, 1, 3]))):
        u = np.random.default_rng(0).normal(size=(20, 3))
        x = (u / np.linalg.norm(u, axis=1, keepdims=True)) @ linear.T
        within = x @ wl.builder.rotation_matrix(model.shape_pose[shape, 3:]) / model.shape_size[shape]
        assert np.linalg.norm(within, axis=1) == pytest.approx(np.ones(20), rel=1e-6)  # scales are single precision
        mass = 1000 * 4 / 3 * np.pi * abs(np.linalg.det(linear))
        assert model.mass[shape] == pytest.approx(mass, rel=1e-6)
        square = linear @ linear.T  # the integral of x x^T over an ellipsoid is a fifth of its mass times this
        assert model.inertia[shape] == pytest.approx(mass / 5 * (np.trace(square) * np.eye(3) - square), rel=1e-5, abs=1e-6 * mass * 1e-4)
    assert model.shape_pose[0, :3] == pytest.approx([0.01, 0.02, 0.03])


@pytest.mark.parametrize(("axis", "along"), [("X", (0, 1, 0)), ("Y", (-1, 0, 0)), ("Z", (0, 0, 1))])
def test_capsule_along_any_axis(axis, along):
    """Its axis becomes local z; turned by 90 degrees about z by the prim, twice as large, in centimetres; 1000 kg/m^3."""
    content = f'double radius = 10; double height = 60; uniform token axis = "{axis}"; vector3f warpLcp:surfaceVelocity = (100, 0, 0);'
    inner = prim("Capsule", "C", (COLLIDER,), content + xform(translate="(5, 0, 0)", rotateZ=90, scale="(2, 2, 2)"))
    model = load(body(inner=inner), head=CM)
    assert model.shape_type.tolist() == [ShapeType.CAPSULE]
    assert model.shape_size[0] == pytest.approx([0.2, 0.6, 0])
    rotation = wl.builder.rotation_matrix(model.shape_pose[0, 3:])
    assert rotation[:, 2] == pytest.approx(along, abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert rotation @ model.shape_surface_velocity[0] == pytest.approx([0, 1, 0], abs=1e-12)
    rod, ball = 1000 * math.pi * 0.04 * 1.2, 1000 * 4 / 3 * math.pi * 0.008
    assert model.mass == pytest.approx([rod + ball], rel=1e-6)
    assert model.com[0] == pytest.approx([0.05, 0, 0], abs=1e-9)
    spin = rod * 0.04 / 2 + ball * 0.4 * 0.04
    across = rod * (0.04 / 4 + 1.2**2 / 12) + ball * (0.4 * 0.04 + 0.6**2 + 0.75 * 0.6 * 0.2)
    expected = np.where(np.abs(along), spin, across)
    assert model.inertia[0] == pytest.approx(np.diag(expected), rel=1e-6, abs=1e-6 * across)


def test_capsule_defaults_are_those_of_usd_and_a_density_counts():
    """radius 0.5, height 1, axis Z; as part of a compound the mass comes by way of ComputeMassProperties, single precision."""
    inner = prim("Capsule", "C", (COLLIDER, MASS), "float physics:density = 500;") + cube("D", xform(translate="(3, 0, 0)"))
    model = load(body(inner=inner))
    volume = math.pi * 0.25 + 4 / 3 * math.pi * 0.125
    assert model.shape_size[0].tolist() == [0.5, 0.5, 0]
    assert model.mass == pytest.approx([500 * volume + 1000], rel=1e-6)
    assert model.com[0] == pytest.approx([3000 / (500 * volume + 1000), 0, 0], rel=1e-6)
    assert "its axis is 'Q'; give one of X, Y, Z" in refused(body(inner=prim("Capsule", "C", (COLLIDER,), 'uniform token axis = "Q";')))
    assert "/B/C: capsule: half length is 0.0 m" in refused(body(inner=prim("Capsule", "C", (COLLIDER,), "double height = 0;")))


def test_velocities_are_along_the_body_and_of_its_centre_of_mass():
    content = (
        "float physics:mass = 1; point3f physics:centerOfMass = (0.4, 0, 0);"
        "vector3f physics:velocity = (2, 0, 0); vector3f physics:angularVelocity = (90, 0, 0);"
    )
    model = load(body(content=content + xform(rotateZ=90, scale="(3, 3, 3)")))
    assert model.v0 == pytest.approx([0, 2, 0, 0, math.pi / 2, 0], abs=1e-12)


def test_shapes_of_static_colliders_stand_in_the_world():
    model = load(
        body(), prim("Xform", "X", (), xform(translate="(0, 0, -2)") + prim("Plane", "P", (COLLIDER,), 'uniform token axis = "Z";'))
    )
    assert model.shape_names == ("/B/C", "/X/P")
    assert model.shape_type.tolist() == [ShapeType.BOX, ShapeType.PLANE]
    assert model.shape_body.tolist() == [0, -1]
    assert model.shape_pose[1] == pytest.approx([0, 0, -2, 0, 0, 0, 1])
    assert model.pairs.tolist() == [[1, 0]]


# -- bodies ---------------------------------------------------------------------------------------------------------


def test_kinematic_body_keeps_its_velocity_and_needs_no_mass():
    inner = prim("Plane", "P", (COLLIDER,), "")
    model = load(body("K", "bool physics:kinematicEnabled = 1; vector3f physics:velocity = (1, 0, 0);", inner), body())
    assert model.joint_type.tolist() == [JointType.KINEMATIC, JointType.FREE]
    assert model.v0[:3].tolist() == [1, 0, 0]
    assert read(body("K", "bool physics:kinematicEnabled = 1;"), body()).mass == pytest.approx(1000)


def test_animated_kinematic_body_is_reported():
    moved = 'double3 xformOp:translate.timeSamples = { 0: (0, 0, 1), 1: (1, 0, 1) }; uniform token[] xformOpOrder = ["xformOp:translate"];'
    reading = read(body("K", "bool physics:kinematicEnabled = 1;" + moved))
    assert [(i.path, i.what) for i in reading.report.ignored] == [("/K", "animated pose")]
    assert reading.builder.finalize().q0[:3].tolist() == [0, 0, 1]


def test_nested_bodies_are_independent_and_in_stage_order():
    inner = cube() + body("N", xform(translate="(0, 0, 5)"))
    model = load(body("A", xform(translate="(1, 0, 0)"), inner), body("Z"))
    assert model.body_names == ("/A", "/A/N", "/Z")
    assert model.q0[7:10].tolist() == [1, 0, 5]
    assert model.mass == pytest.approx([1000] * 3)
    assert len(model.pairs) == 3


def test_disabled_body_becomes_static():
    model = load(body("Off", "bool physics:rigidBodyEnabled = 0;"), body())
    assert model.body_names == ("/B",)
    assert model.shape_body.tolist() == [-1, 0]
    assert any(n.startswith("/Off: physics:rigidBodyEnabled") for n in model.report.notes)


def test_disabled_collider_makes_no_contact():
    model = load(body(), cube("Ground", "bool physics:collisionEnabled = 0;"))
    assert model.shape_names == ("/B/C",)


def test_instances_are_read_and_their_prototype_is_not():
    proto = body("Part").replace("def Xform", "class Xform", 1)
    copies = [prim("Xform", n, (), "", "instanceable = true\nprepend references = </Part>") for n in ("I1", "I2")]
    model = load(proto, *copies)
    assert model.body_names == ("/I1", "/I2")
    assert model.shape_names == ("/I1/C", "/I2/C")


def test_only_the_first_scene_is_simulated():
    owner = "rel physics:simulationOwner = </Other>;"
    reading = read(prim("PhysicsScene", "Other"), body("A"), body("B", owner), cube("Ground", owner))
    assert (reading.bodies, reading.shapes) == (("/A",), ("/A/C",))
    assert sorted(i.path for i in reading.report.ignored) == ["/B", "/Ground"]
    assert any(n.startswith("/Other: a second PhysicsScene") for n in reading.report.notes)


# -- materials and pairs --------------------------------------------------------------------------------------------


def test_material_inherited_from_above():
    root = prim("Xform", "Root", ("MaterialBindingAPI",), BOUND + body())
    model = load(material("float physics:staticFriction = 0.8; float physics:dynamicFriction = 0.6;"), root)
    assert model.friction.tolist() == [[0.8, 0.6]]
    assert not model.report.notes


def test_no_material_takes_the_default_and_is_noted():
    model = load(body(), cube("Ground"))
    assert model.friction.tolist() == [[0.5, 0.5]] * 2
    assert [n for n in model.report.notes if "no physics material on /B/C, /Ground: friction 0.5 / 0.5" in n]


def test_static_friction_below_dynamic_takes_the_larger():
    model = load(material("float physics:dynamicFriction = 0.3;"), body(inner=bound_cube()))
    assert model.friction.tolist() == [[0.3, 0.3]]
    assert any("/M: dynamicFriction 0.3 exceeds staticFriction 0" in n for n in model.report.notes)


def test_restitution_is_read():
    """A collider without a material has none."""
    model = load(material("float physics:restitution = 0.8;"), body(inner=bound_cube()), cube("Ground"))
    assert dict(zip(model.shape_names, model.restitution, strict=True)) == {"/B/C": 0.8, "/Ground": 0.0}
    assert model.report.ignored == ()


def test_restitution_above_one_is_refused():
    with pytest.raises(wl.WarpLcpError, match=r"/B/C.*restitution is 1.5; it must be at most 1"):
        load(material("float physics:restitution = 1.5;"), body(inner=bound_cube()))


def test_contact_parameters_in_stage_units():
    attributes = (
        "float warpLcp:normalStiffness = 1e6; float warpLcp:normalDamping = 1e4; double warpLcp:tangentStiffness = 2e5;"
        "float warpLcp:tangentDamping = 300; float warpLcp:slipThreshold = 5;"
    )
    head = CM.replace("kilogramsPerUnit = 1", "kilogramsPerUnit = 0.001")
    model = load(material(attributes), body(inner=bound_cube()), cube("Ground"), head=head)
    assert model.contact[0] == pytest.approx([1e3, 10, 200, 0.3, 0.05])  # g/s^2, g/s and cm/s
    assert np.isnan(model.contact[1]).all()
    assert not model.report.ignored


def test_surface_velocity_is_along_the_colliders_axes():
    belt = "vector3f warpLcp:surfaceVelocity = (100, 20, 0);"
    plane = prim("Plane", "P", (COLLIDER,), 'uniform token axis = "X"; vector3f warpLcp:surfaceVelocity = (0, 100, 0);')
    model = load(body(), cube("Belt", belt + xform(rotateZ=90, scale="(4, 1, 0.1)")), plane, head=CM)
    assert model.shape_surface_velocity[1] == pytest.approx([1, 0.2, 0])
    x, y, z, w = model.shape_pose[2, 3:]
    rotation = wl.builder.rotation_matrix(np.array([x, y, z, w]))
    assert rotation @ model.shape_surface_velocity[2] == pytest.approx([0, 1, 0], abs=1e-12)


def test_own_attributes_in_the_wrong_place_or_misspelt_are_reported():
    stray = "float warpLcp:normalStifness = 1; vector3f warpLcp:surfaceVelocity = (1, 0, 0);"
    ignored = read(body(content=stray)).report.ignored
    assert {i.what for i in ignored} == {"warpLcp:normalStifness", "warpLcp:surfaceVelocity"}
    assert any("did you mean warpLcp:normalStiffness?" in i.why for i in ignored)


def group(name, members, content=""):
    return prim("PhysicsCollisionGroup", name, (), f"rel collection:colliders:includes = [{', '.join(members)}];" + content)


def touching(*prims):
    model = load(body("A"), body("B"), cube("Ground"), *prims)
    return {tuple(sorted(model.shape_names[i].strip("/")[0] for i in pair)) for pair in model.pairs}


ALL = {("A", "B"), ("A", "G"), ("B", "G")}


@pytest.mark.parametrize(
    ("prims", "apart"),
    [
        ((group("G1", ["</A>"], "rel physics:filteredGroups = </G2>;"), group("G2", ["</B>"])), {("A", "B")}),
        ((group("G1", ["</A>", "</B>"], "rel physics:filteredGroups = </G1>;"),), {("A", "B")}),
        ((group("G1", ["</A>", "</B>"], "rel physics:filteredGroups = </Nowhere>;"),), set()),
        (
            (
                group("G1", ["</A>"], "rel physics:filteredGroups = </G2>; bool physics:invertFilteredGroups = 1;"),
                group("G2", ["</B>"]),
                group("G3", ["</Ground>"]),
            ),
            {("A", "G")},
        ),
        (
            (
                group("G1", ["</A>"], "rel physics:filteredGroups = </G3>;"),
                group("G2", ["</B>"], 'string physics:mergeGroup = "x";'),
                group("G3", ["</Ground>"], 'string physics:mergeGroup = "x";'),
            ),
            {("A", "B"), ("A", "G")},
        ),
    ],
    ids=["two-groups", "one-group", "missing-target", "inverted", "merged"],
)
def test_collision_groups(prims, apart):
    assert touching(*prims) == ALL - apart


def test_filtered_pairs_of_bodies_and_colliders():
    filtered = (BODY, MASS, "PhysicsFilteredPairsAPI")
    model = load(
        body("A", "rel physics:filteredPairs = [</B>, </Ground>];", cube() + body("N"), filtered),
        body("B", "rel physics:filteredPairs = </A/N/C>;", apis=filtered),
        cube("Ground"),
    )
    names = {frozenset(model.shape_names[i] for i in pair) for pair in model.pairs}
    assert names == {frozenset(x) for x in [("/A/C", "/A/N/C"), ("/A/N/C", "/Ground"), ("/B/C", "/Ground")]}


# -- what is not simulated ------------------------------------------------------------------------------------------

JOINT = "rel physics:body0 = </A>; rel physics:body1 = </B>;"


def test_disabled_joints_are_ignored():
    joint = prim("PhysicsRevoluteJoint", "J", ("PhysicsDriveAPI:angular",), JOINT + "float drive:angular:physics:stiffness = 3;")
    reading = read(
        body("A"), body("B"), joint.replace(JOINT.replace(";", "\n"), JOINT.replace(";", "\n") + "bool physics:jointEnabled = 0\n")
    )
    assert (reading.joints, reading.report.unsupported) == ((), ())
    assert [(i.path, i.what) for i in reading.report.ignored] == [("/J", "PhysicsRevoluteJoint")]


def test_unknown_joint_type_collider_on_xform_and_bare_articulation_root():
    strange = prim("DistancePhysicsJoint", "J", (), JOINT)
    floor = prim("Xform", "Floor", (COLLIDER,))
    reading = read(body("A", apis=(BODY, "PhysicsArticulationRootAPI")), body("B"), strange, floor)
    assert [(i.path, i.what) for i in reading.report.ignored] == [
        ("/A", "articulation root"),
        ("/J", "DistancePhysicsJoint"),
        ("/Floor", "PhysicsCollisionAPI on Xform"),
    ]
    assert not reading.report.unsupported


def test_unsupported_shapes_are_all_named():
    others = [prim(kind, kind, (COLLIDER,)) for kind in ("Mesh", "Capsule_1")]
    plane = body("Flying", inner=prim("Plane", "P", (COLLIDER,)) + cube())
    off = prim("Cone", "Off", (COLLIDER,), "bool physics:collisionEnabled = 0;")
    message = refused(plane, *others, off)
    assert "Plane collider /Flying/P: a plane is infinite" in message
    for kind in ("Mesh", "Capsule_1"):
        assert f"{kind} collider /{kind}" in message
    assert "/Off" not in message


def test_point_instancer_with_physics():
    inner = (
        prim("Scope", "Protos", (), body("P"))
        + "rel prototypes = </I/Protos/P>\nint[] protoIndices = [0]\npoint3f[] positions = [(0,0,0)]\n"
    )
    reading = read(body(), prim("PointInstancer", "I", (), inner))
    assert [(i.path, i.what) for i in reading.report.unsupported] == [("/I", "PointInstancer")]
    assert reading.bodies == ("/B",)


def test_attributes_of_other_engines_are_reported_once_per_family():
    content = (
        "bool physxRigidBody:disableGravity = 1; float physxRigidBody:linearDamping = 0.1; float physxRigidBody:angularDamping = 0;"
        "int physxRigidBody:solverPositionIterationCount = 8; float newton:contactMargin = 0.01; uniform bool physics:startsAsleep = 1;"
    )
    ignored = read(body(content=content)).report.ignored
    assert {i.what for i in ignored} == {
        "physics:startsAsleep",
        "physxRigidBody:disableGravity, physxRigidBody:linearDamping",
        "newton:contactMargin",
    }
    many = read(*(body(f"B{i}", content) for i in range(20))).report.ignored
    assert len(many) == 3
    assert all("and on 19 more prims" in i.what for i in many)


def test_attributes_without_their_schema_are_reported():
    ignored = read(body(content="float physics:mass = 4;", apis=(BODY,))).report.ignored
    assert [(i.path, i.what) for i in ignored] == [("/B", "physics:mass")]


# -- errors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "parts"),
    [
        ("no/such/xyz.usda", ["no/such/xyz.usda: no such file", "check the path"]),
        ("box_on_grond", ["box_on_grond: no file and no shipped scene", "did you mean the shipped scene 'box_on_ground'?", "stack"]),
        ("box_on_ground.usd", ["no such file", "'box_on_ground'"]),
        (Path("zzz"), ["zzz: no file and no shipped scene", "shipped: belt, bouncing_balls"]),
        (7, ["a scene is a path", "not int"]),
    ],
)
def test_scene_that_does_not_exist(scene, parts):
    with pytest.raises(wl.SceneError) as caught:
        wl.load_usd(scene)
    for part in parts:
        assert part in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ['#usda 1.0\ndef Xform "A" {\n    double x = \n}\n', "hello\n", ""])
def test_broken_file(tmp_path, text):
    path = tmp_path / "broken.usda"
    path.write_text(text)
    with pytest.raises(wl.SceneError, match=r"broken\.usda: not a readable USD file: ") as caught:
        wl.load_usd(path)
    assert "\n" not in str(caught.value)


def test_folder_is_no_scene(tmp_path):
    with pytest.raises(wl.SceneError, match="is a folder"):
        wl.load_usd(tmp_path)


def test_path_and_string_read_the_same_file(tmp_path):
    path = tmp_path / "one.usda"
    path.write_text(layer(SCENE, body()))
    assert wl.load_usd(path).report.source == wl.load_usd(str(path)).report.source == str(path)


def test_stage_without_physics_and_stage_where_nothing_moves():
    assert "no physics in this stage" in refused(prim("Cube", "C"))
    message = refused(cube("Ground"))
    assert "nothing can move" in message
    assert "/Ground" in message


def test_broken_reference_is_refused():
    message = refused(body(), prim("Xform", "R", (), "", "prepend references = @missing.usda@"))
    assert "broken reference /R" in message
    assert "missing.usda" in message


def test_bad_numbers_name_the_prim():
    assert "/Flat" in refused(body(), cube("Flat", size=0))
    assert "/B/C" in refused(material("float physics:staticFriction = -1; float physics:dynamicFriction = -1;"), body(inner=bound_cube()))
    nan = "vector3f physics:velocity = (nan, 0, 0);"
    assert "velocity" in refused(body("Wild", nan))


def test_missing_extra(monkeypatch):
    real = builtins.__import__

    def without_pxr(name, *args, **kwargs):
        if name.partition(".")[0] == "pxr":
            raise ImportError("No module named 'pxr'")
        return real(name, *args, **kwargs)

    for name in [m for m in sys.modules if m.partition(".")[0] == "pxr"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", without_pxr)
    with pytest.raises(wl.MissingExtra, match=r"reading USD scenes needs the extra 'usd': python -m pip install 'warp_lcp\[usd\]'"):
        wl.load_usd("stack")


# -- shipped scenes -------------------------------------------------------------------------------------------------


def test_every_shipped_scene_says_what_it_shows_and_loads_without_remarks():
    from pxr import Sdf

    boxes_and_balls = {"belt", "box_on_ground", "heavy_on_light", "incline", "spinning_box", "sphere_slip_roll", "stack"}
    jointed = {"chain", "fourbar", "gripper", "humanoid", "quadruped"}
    others = {"bouncing_balls", "launch_fan", "painleve_rod", "pile", "plate_many_contacts"}
    assert set(scenes.names()) == boxes_and_balls | others | jointed
    for name in scenes.names():
        root = Sdf.Layer.FindOrOpen(str(scenes.path(name)))
        assert "Expected:" in root.documentation
        model = wl.load_usd(name)
        assert (model.report.notes, model.report.ignored) == ((), ())
        assert model.gravity == pytest.approx([0, 0, -9.81], abs=1e-12)
        assert model.up_axis == "Z"


def test_box_on_ground_is_table_1_of_the_paper():
    model = wl.load_usd("box_on_ground")
    assert model.body_names == ("/World/Box",)
    assert "/World/Ground" in model.shape_names
    assert model.mass.tolist() == [1.0]
    assert model.inertia[0] == pytest.approx(np.eye(3) / 6, abs=1e-15)
    assert model.q0 == pytest.approx([0, 0, 0.5, 0, 0, 0, 1], abs=1e-15)
    assert model.v0 == pytest.approx([0, 5, 0, 0, 0, 2 * math.pi], abs=1e-14)
    assert model.shape_size[0].tolist() == [0.5] * 3
    assert model.friction.tolist() == [[1, 1]] * 2
    assert model.contact == pytest.approx(np.array([[1e10, 1e8, 1e8, 1e5, 1e-3]] * 2), rel=1e-12)


def test_incline():
    model = wl.load_usd("incline")
    x, y, z, w = model.q0[3:7]
    down = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])  # the slope's x axis
    assert -down[2] / down[0] == pytest.approx(0.6, rel=1e-12)
    assert model.friction.tolist() == [[0.5, 0.5], [0.5, 0.5], [0.9, 0.9]]
    mean = model.friction[1:, 1] / 2 + model.friction[0, 1] / 2
    assert mean.tolist() == pytest.approx([0.5, 0.7])
    assert model.mass.tolist() == [8, 8]


@pytest.mark.parametrize(("name", "masses"), [("heavy_on_light", [8, 8000]), ("stack", [8] * 10)])
def test_stacks_touch_and_rest(name, masses):
    model = wl.load_usd(name)
    assert model.mass.tolist() == masses
    assert model.q0.reshape(-1, 7)[:, 2] == pytest.approx([0.1 + 0.2 * i for i in range(len(masses))], abs=1e-15)
    assert not model.v0.any()
    assert (model.friction == 0.5).all()
    assert model.inertia[0] == pytest.approx(8 * 0.04 / 6 * np.eye(3))


def test_spinning_box_sphere_and_belt():
    spin = wl.load_usd("spinning_box")
    assert spin.v0 == pytest.approx([0, 0, 0, 0, 0, 2 * math.pi])
    assert (spin.mass.tolist(), spin.friction.tolist()) == ([1], [[1, 1]] * 2)
    ball = wl.load_usd("sphere_slip_roll")
    assert ball.v0.tolist() == [2, 0, 0, 0, 0, 0]
    assert ball.inertia[0] == pytest.approx(0.004 * np.eye(3))
    assert ball.shape_size[ball.shape_type == ShapeType.SPHERE, 0].tolist() == [0.1]
    assert ball.friction.tolist() == [[0.3, 0.3]] * 2
    belt = wl.load_usd("belt")
    static = int(np.flatnonzero(belt.shape_body < 0)[0])
    assert belt.shape_surface_velocity[static].tolist() == [1, 0, 0]
    assert not belt.v0.any()
    assert belt.q0[2] - 0.1 == pytest.approx(belt.shape_pose[static, 2] + belt.shape_size[static, 2], abs=1e-15)


def test_launch_fan_pile_and_plates():
    fan = wl.load_usd("launch_fan")
    v = fan.v0.reshape(16, 6)
    assert np.linalg.norm(v[:, :3], axis=1) == pytest.approx(np.full(16, 6), rel=1e-6)
    assert np.degrees(np.arctan2(v[:, 1], v[:, 0])) == pytest.approx(np.arange(0, 91, 6), abs=1e-4)
    assert (fan.q0.reshape(16, 7)[:, 3:] == (0, 0, 0, 1)).all()
    plates = wl.load_usd("plate_many_contacts")
    feet = np.bincount(plates.shape_body[plates.shape_type == ShapeType.SPHERE])
    assert feet.tolist() == [4, 9, 16, 64]
    assert np.ptp(plates.mass) == np.ptp(plates.com, axis=0).max() == np.ptp(plates.inertia, axis=0).max() == 0
    assert plates.max_contacts >= feet.sum()
    assert (plates.shape_body[plates.pairs] < 0).any(axis=1).all()  # plates pass through one another
    pile = wl.load_usd("pile")
    moving = pile.shape_type[pile.shape_body >= 0]
    assert [np.count_nonzero(moving == kind) for kind in (ShapeType.BOX, ShapeType.SPHERE, ShapeType.CAPSULE)] == [4, 4, 4]


# -- how coefficients of two materials become one ----------------------------------------------------------------------


def two_materials(mode_a, mode_b, which="friction", values=(0.8, 0.3)):
    """A box on the ground, of materials with mu = e = 0.8 and 0.3."""
    prims = []
    for name, mode, value in (("M", mode_a, values[0]), ("N", mode_b, values[1])):
        content = f"float physics:staticFriction = {value}; float physics:dynamicFriction = {value}; float physics:restitution = {value};"
        if mode:
            content += f'uniform token physxMaterial:{which}CombineMode = "{mode}";'
        prims.append(material(content, name))
    ground = prim("Plane", "Ground", (COLLIDER, "MaterialBindingAPI"), 'token axis = "Z"; rel material:binding:physics = </N>;')
    return [*prims, ground, body(content=xform(translate="(0, 0, 0.5)"), inner=bound_cube())]


@pytest.mark.parametrize(
    ("mode_a", "mode_b", "mu"),
    [
        ("", "", 0.55),
        ("average", "average", 0.55),
        ("min", "average", 0.3),
        ("average", "multiply", 0.24),
        ("multiply", "min", 0.24),
        ("max", "multiply", 0.8),
        ("min", "max", 0.8),
    ],
)
def test_combine_modes(mode_a, mode_b, mu):
    """The later of average, min, multiply, max rules. A box that slides at 2 m/s loses mu g t, one that falls bounces with e."""
    sim = wl.Simulator(load(*two_materials(mode_a, mode_b)), device="cpu")
    sim.v.assign(np.array([[2.0, 0, 0, 0, 0, 0]]))
    sim.step(100)
    assert sim.v.numpy()[0, 0] == pytest.approx(2 - mu * 9.81 * 0.1, rel=1e-4)
    model = load(*two_materials(mode_a, mode_b, "restitution"))
    sim = wl.Simulator(model, device="cpu")
    q, v = model.q0.copy(), np.zeros(6)
    q[2], v[2] = 0.5001, -1.0
    sim.q.assign(q[None])
    sim.v.assign(v[None])
    sim.step(1)
    assert sim.v.numpy()[0, 2] == pytest.approx(mu, rel=1e-4)


def test_combine_mode_that_is_none():
    ignored = read(*two_materials("median", "")).report.ignored
    assert [(i.path, i.what) for i in ignored] == [("/M", "physxMaterial:frictionCombineMode")]
    with pytest.raises(wl.ModelError, match=r"friction_combine is 7; give one of Combine\.AVERAGE"):
        wl.ModelBuilder().add_plane(material=wl.Material(friction_combine=7))


# -- articulations that pass through themselves -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "pairs"),
    [
        ("", 4),
        ("bool physxArticulation:enabledSelfCollisions = 0;", 3),
        ("bool newton:selfCollisionEnabled = 0;", 3),
        ("bool newton:selfCollisionEnabled = 1; bool physxArticulation:enabledSelfCollisions = 0;", 4),
    ],
)
def test_self_collision_of_an_articulation(content, pairs):
    """A - B - C in a row, A and C may touch unless the articulation says otherwise; all three touch what stands beside them."""
    bodies = [body(n, xform(translate=f"({2 * i}, 0, 0)")) for i, n in enumerate("ABC")]
    ends = [f"rel physics:body0 = </R/{a}>; rel physics:body1 = </R/{b}>;" for a, b in ("AB", "BC")]
    frames = "point3f physics:localPos0 = (1, 0, 0); point3f physics:localPos1 = (-1, 0, 0);"
    joints = [prim("PhysicsRevoluteJoint", f"J{i}", (), e + frames) for i, e in enumerate(ends)]
    root = prim("Xform", "R", ("PhysicsArticulationRootAPI",), content + "".join([*bodies, *joints]))
    reading = read(root, cube("Ground"))
    model = reading.builder.finalize()
    assert len(model.pairs) == pairs
    assert not reading.report.ignored
