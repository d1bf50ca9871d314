# SPDX-License-Identifier: Apache-2.0
"""Joints of USD stages: frames, units, limits, drives, loops, and what is not simulated."""

import math

import numpy as np
import pytest
from test_usd import BODY, CM, JOINT, MASS, body, cube, layer, load, needs_shared, prim, read, refused, xform  # noqa: F401

import warp_lcp as wl
from warp_lcp import JointType

pytest.importorskip("pxr", reason="needs the extra 'usd'")

LIGHT = "float physics:mass = 2; float3 physics:diagonalInertia = (1, 1, 1);"
WORLD = "rel physics:body1 = </A>;"


def joint(kind, content="", apis=(), name="J"):
    return prim(f"Physics{kind}Joint", name, apis, content)


def pair(kind, content="", apis=()):
    """Two bodies one unit apart along x, joined half-way."""
    frames = "point3f physics:localPos0 = (0.5, 0, 0); point3f physics:localPos1 = (-0.5, 0, 0);"
    bodies = [body(n, LIGHT + xform(translate=f"({x}, 0, 0)"), inner="") for n, x in (("A", 0), ("B", 1))]
    return [*bodies, joint(kind, JOINT + frames + content, apis)]


def test_revolute_joint_with_limit_and_drive_in_stage_units():
    """Degrees, centimetres and gains by degree: k = 3 kg cm^2 / s^2 / degree."""
    drive = "float drive:angular:physics:stiffness = 3; float drive:angular:physics:damping = 2; float drive:angular:physics:maxForce = 5;"
    target = "float drive:angular:physics:targetPosition = 90; float drive:angular:physics:targetVelocity = 180;"
    limits = 'uniform token physics:axis = "Z"; float physics:lowerLimit = -90; float physics:upperLimit = 45;'
    model = load(*pair("Revolute", limits + drive + target, ("PhysicsDriveAPI:angular",)), head=CM)
    assert model.joint_type.tolist() == [JointType.FREE, JointType.REVOLUTE]
    assert model.limit[6] == pytest.approx([-math.pi / 2, math.pi / 4])
    unit = 1e-4 * 180 / math.pi
    assert model.drive[6] == pytest.approx([3 * unit, 2 * unit, 5e-4, math.pi / 2, math.pi], rel=1e-6)
    assert model.joint_pose[1][:3] == pytest.approx([0.005, 0, 0])
    sim = wl.Simulator(model, device="cpu")
    sim.v.assign(np.eye(7)[6][None])
    assert sim.body_velocity.numpy()[0, 1, 3:] == pytest.approx([0, 0, 1])  # the axis is z


@pytest.mark.parametrize(("axis", "along"), [("X", 0), ("Y", 1), ("Z", 2)])
def test_prismatic_joint_moves_along_its_axis(axis, along):
    limits = f'uniform token physics:axis = "{axis}"; float physics:lowerLimit = -10; float physics:upperLimit = 20;'
    model = load(*pair("Prismatic", limits), head=CM)
    assert model.limit[6] == pytest.approx([-0.1, 0.2])
    sim = wl.Simulator(model, device="cpu")
    sim.v.assign(np.eye(7)[6][None])
    assert sim.body_velocity.numpy()[0, 1, :3] == pytest.approx(np.eye(3)[along])


def test_joint_to_the_world_is_a_fixed_base():
    model = load(
        body("A", LIGHT + xform(translate="(0, 0, 3)"), inner=""), joint("Revolute", WORLD + "point3f physics:localPos0 = (0, 0, 3);")
    )
    assert (model.nq, model.nv) == (1, 1)
    assert model.q0 == pytest.approx([0])


def test_initial_coordinate_comes_from_the_poses():
    turned = xform(translate="(0, 0, 3)", rotateXYZ="(30, 0, 0)")
    model = load(body("A", LIGHT + turned, inner=""), joint("Revolute", WORLD + "point3f physics:localPos0 = (0, 0, 3);"))
    assert abs(model.q0[0]) == pytest.approx(math.radians(30))
    assert wl.Simulator(model, device="cpu").body_pose.numpy()[0, 0, 3:] == pytest.approx(
        [math.sin(math.pi / 12), 0, 0, math.cos(math.pi / 12)]
    )


def limit(axis, low, high):
    return f"float limit:{axis}:physics:low = {low}; float limit:{axis}:physics:high = {high};"


def test_d6_joint_has_the_axes_that_are_not_locked():
    locked = "".join(limit(axis, 1, -1) for axis in ("transX", "transY", "transZ", "rotY"))
    apis = [f"PhysicsLimitAPI:{axis}" for axis in ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")]
    model = load(*pair("", locked + limit("rotX", -30, 60), apis))
    assert model.joint_type[1] == JointType.D6
    assert model.dof_axis[6:].tolist() == [[1, 0, 0], [0, 0, 1]]
    assert model.limit[6] == pytest.approx([-math.pi / 6, math.pi / 3])
    assert np.isinf(model.limit[7]).all()


def test_d6_joints_that_are_other_joints():
    apis = [f"PhysicsLimitAPI:trans{axis}" for axis in "XYZ"]
    ball = load(*pair("", "".join(limit(f"trans{axis}", 1, -1) for axis in "XYZ"), apis))
    assert ball.joint_type[1] == JointType.SPHERICAL
    free = read(*pair(""))
    assert free.builder.finalize().nv == 12
    assert [i.why for i in free.report.ignored] == ["all its axes are free and none is driven: nothing is held"]
    apis += [f"PhysicsLimitAPI:rot{axis}" for axis in "XYZ"]
    held = "".join(limit(f"{kind}{axis}", 1, -1) for kind in ("trans", "rot") for axis in "XYZ")
    assert load(*pair("", held, apis)).joint_type[1] == JointType.FIXED


def test_fixed_spherical_and_distance_joints():
    assert load(*pair("Fixed")).nv == 6
    assert load(*pair("Spherical")).nv == 9
    distance = load(*pair("Distance", "float physics:minDistance = 10; float physics:maxDistance = 200;"), head=CM)
    assert distance.nv == 12
    assert distance.loops[0].distance == pytest.approx((0.1, 2.0))


def test_excluded_joint_closes_a_loop():
    model = load(*pair("Revolute"), joint("Spherical", JOINT + "bool physics:excludeFromArticulation = 1;", name="K"))
    assert [loop.name for loop in model.loops] == ["/K"]
    assert (model.loops[0].ways, model.loops[0].turns) == ((True,) * 3, (False,) * 3)


def test_joined_bodies_pass_through_each_other_unless_they_collide():
    boxes = [body(n, xform(translate=f"({x}, 0, 0)"), inner=cube(size=0.9)) for n, x in (("A", 0), ("B", 1))]
    assert len(load(*boxes, joint("Revolute", JOINT)).pairs) == 0
    assert len(load(*boxes, joint("Revolute", JOINT + "bool physics:collisionEnabled = 1;")).pairs) == 1


def test_what_is_not_simulated_is_named():
    breaks = read(*pair("Fixed", "float physics:breakForce = 10;"))
    assert [(i.path, i.why) for i in breaks.report.ignored] == [("/J", "joints do not break here")]
    cone = read(*pair("Spherical", "float physics:coneAngle0Limit = 30; float physics:coneAngle1Limit = 30;"))
    assert [i.path for i in cone.report.ignored] == ["/J"]
    drive = 'uniform token drive:angular:physics:type = "acceleration"; float drive:angular:physics:stiffness = 3;'
    assert "type acceleration is not supported" in refused(*pair("Revolute", drive, ("PhysicsDriveAPI:angular",)))


def test_attributes_of_other_engines():
    content = "float newton:armature = 0.01; float newton:damping = 0.1; float physxJoint:jointFriction = 2;"
    model = load(*pair("Revolute", content))
    assert model.armature[6] == pytest.approx(0.01, rel=1e-6)
    assert model.damping[6] == pytest.approx(0.1 * 180 / math.pi, rel=1e-6)
    assert model.joint_friction[6] == pytest.approx(2.0)


def test_attributes_of_other_engines_that_are_not_read_are_named():
    """On joints too: a limit on the velocity, and stiffness of a limit."""
    content = "float physxJoint:maxJointVelocity = 100; float physxLimit:angular:stiffness = 5; float newton:armature = 0.01;"
    ignored = read(*pair("Revolute", content)).report.ignored
    assert [(i.path, i.what) for i in ignored] == [("/J", "physxJoint:maxJointVelocity"), ("/J", "physxLimit:angular:stiffness")]


@needs_shared
@pytest.mark.parametrize(
    ("file", "bodies", "nv", "mass"),
    [
        ("converted/go1/go1.usda", 13, 18, 12.7434),
        ("converted/gym_ant/ant.usda", 13, 14, 0.91088),
        ("newton/ex_humanoid.usda", 16, 27, 40.844),
        ("newton/kamino_boxes_fourbar.usda", 4, 9, 4.0),
        ("ovphysx_bsd/links_chain_sample.usda", 15, 14, 200.44),
    ],
)
def test_robots_made_by_others_load(shared, file, bodies, nv, mass):
    """Bodies, degrees of freedom and the mass that moves (shared/usd/README.md gives it with that of fixed bases)."""
    model = wl.load_usd(shared / "usd" / file)
    assert (model.num_bodies, model.dofs) == (bodies, nv)
    assert model.mass[model.movable[:-1]].sum() == pytest.approx(mass, rel=1e-4)


@needs_shared
def test_hips_of_the_gym_ant_turn(shared):
    """Their capsules end inside the torso, to which each is joined by way of a welded body: 0.3 N m turn them as if nothing touched."""
    model = wl.load_usd(shared / "usd/converted/gym_ant/ant.usda")
    hips = [i for i in range(6, 14) if model.body_names[model.dof_body[i]].rpartition("/")[2].startswith("aux")]
    sim = wl.Simulator(model, dt=2e-3, device="cpu")
    q, force = sim.q.numpy(), np.zeros((1, model.nv))
    q[0, 2], force[0, hips] = 5.0, 0.3
    sim.q.assign(q)
    sim.control.force.assign(force)
    sim.step(100)
    assert len(hips) == 4
    assert sim.contacts.count.numpy()[0] == 0
    # Armature 1 kg m^2 and damping 1 N m s, beside which the legs weigh nothing.
    assert sim.v.numpy()[0, hips] == pytest.approx(0.3 * (1.0 - math.exp(-0.2)), rel=0.05)


def test_numbers_are_the_decimals_that_were_written():
    """USD keeps single precision, in which 0.1 reads 0.1000000015: bodies would be moved by that to where joints let them."""
    frames = "point3f physics:localPos0 = (0.1, 0, 0); point3f physics:localPos1 = (-0.1, 0.7, 0); float physics:upperLimit = 0.3;"
    drive = "float drive:linear:physics:stiffness = 0.9; float drive:linear:physics:maxForce = 0.6;"
    model = load(*pair("Prismatic", frames + "float physics:lowerLimit = -0.7;" + drive, ("PhysicsDriveAPI:linear",)))
    assert model.joint_pose[1, :3].tolist() == [0.1, 0, 0]
    assert model.joint_child_pose[1, :3].tolist() == [-0.1, 0.7, 0]
    assert model.limit[6].tolist() == [-0.7, 0.3]
    assert model.drive[6, [0, 2]].tolist() == [0.9, 0.6]
