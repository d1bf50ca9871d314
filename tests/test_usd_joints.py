# SPDX-License-Identifier: Apache-2.0
"""Joints of USD stages: frames, units, limits, drives, loops, and what is not simulated."""

import math

import numpy as np
import pytest
from test_usd import BODY, CM, JOINT, MASS, SCENE, SI, body, cube, layer, load, needs_shared, prim, read, refused, stage, xform  # noqa: F401

import warp_lcp as wl
from warp_lcp import JointType
from warp_lcp.joints import compose, inverse, rotate
from warp_lcp.usd import read_usd

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
        ("newton/kamino_boxes_fourbar.usda", 4, 10, 4.0),
        ("ovphysx_bsd/links_chain_sample.usda", 15, 14, 200.44),
    ],
)
def test_robots_made_by_others_load(shared, file, bodies, nv, mass):
    """Bodies, degrees of freedom and the mass that moves (shared/usd/README.md gives it with that of fixed bases)."""
    model = wl.load_usd(shared / "usd" / file)
    assert (len(model.scene_bodies), model.dofs) == (bodies, nv)
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


# -- joints whose mobilities add ------------------------------------------------------------------------------------


def root(*prims, adds=1, more=""):
    """An articulation in which mobilities of joints between the same two bodies add."""
    content = f"uniform bool newton:jointsAddMobility = {adds};{more}"
    return prim("Xform", "Root", ("PhysicsArticulationRootAPI",), content + "".join(prims))


ENDS = "rel physics:body0 = </Root/A>; rel physics:body1 = </Root/B>;"


def stacked(*members, adds=1, at="(1, 0, 0)"):
    """Two bodies, B one unit beside A, and joints (kind, name, axis, localPos0 on A, more) between them."""
    bodies = [body("A", LIGHT, inner=""), body("B", LIGHT + xform(translate=at), inner="")]
    joints = []
    for kind, name, axis, place, more in members:
        on_b = tuple(np.subtract(place, eval(at)).tolist())
        frames = f"point3f physics:localPos0 = {place}; point3f physics:localPos1 = {on_b};"
        along = f'uniform token physics:axis = "{axis}";' if kind != "Spherical" else ""
        joints.append(joint(kind, ENDS + along + frames + more, (), name))
    return [root(*bodies, *joints, adds=adds)]


def relative(model, q):
    """Pose of the second body in the first: of the last body, in a model whose first body is free."""
    sim = wl.Simulator(model, device="cpu")
    sim.q.assign(np.r_[model.q0[:7], q][None])
    pose = sim.body_pose.numpy()[0]
    return compose(inverse(pose[0]), pose[model.body_names.index("/Root/B")])


def expected(motions, at=(1, 0, 0)):
    """E_1 E_2 ... on where B stands at zero: each a way along an axis, or an angle about one through a point, as written in A."""
    pose = np.array([0, 0, 0, 0, 0, 0, 1.0])
    for kind, axis, point, value in motions:
        direction = np.eye(3)["XYZ".index(axis)]
        turn = np.r_[np.sin(value / 2) * direction, np.cos(value / 2)] if kind == "Revolute" else np.r_[0, 0, 0, 1.0]
        way = value * direction if kind == "Prismatic" else np.array(point) - rotate(turn, np.array(point, dtype=float))
        pose = compose(pose, np.r_[way, turn])
    return compose(pose, np.array([*at, 0, 0, 0, 1.0]))


STACKS = {
    "universal": [("Revolute", "h1", "Y", (0.5, 0, 0), ""), ("Revolute", "h2", "X", (0.5, 0, 0), "")],
    "left-handed": [("Revolute", name, name, (0.5, 0, 0), "") for name in "ZYX"],
    "planar": [("Prismatic", "s1", "X", (0, 0, 0), ""), ("Prismatic", "s2", "Z", (1, 0, 0), ""), ("Revolute", "h", "Y", (0.2, 3, 0), "")],
    "slide carried by a hinge": [("Revolute", "h", "Z", (0.2, 0, 0), ""), ("Prismatic", "s", "X", (0, 0, 0), "")],
    "lines that meet elsewhere": [("Revolute", "h1", "Z", (0.5, 0, 3), ""), ("Revolute", "h2", "X", (4, 0, 0.25), "")],
    "parallel hinges": [("Revolute", "h1", "Z", (0.25, 0, 0), ""), ("Revolute", "h2", "Z", (0.75, 0, 0), "")],
    "skew hinges": [("Revolute", "h1", "Z", (0.25, 0, 0), ""), ("Revolute", "h2", "Y", (0.75, 0.1, 0), "")],
}


@pytest.mark.parametrize("case", STACKS)
def test_mobilities_add_in_stage_order(case):
    """Where the second body stands, at any coordinates; only axes of rotation that do not meet take a body between."""
    members = STACKS[case]
    model = load(*stacked(*members))
    values = np.array([0.4, -0.3, 0.7])[: len(members)]
    assert (model.dofs, len(model.loops)) == (6 + len(members), 0)
    assert model.num_bodies == (3 if case in ("parallel hinges", "skew hinges") else 2)
    motions = [(kind, axis, place, value) for (kind, _, axis, place, _), value in zip(members, values, strict=True)]
    assert expected(motions) == pytest.approx(relative(model, values), abs=1e-9)
    sim = wl.Simulator(model, device="cpu")
    sim.step(10)
    assert not sim.status.numpy().any()
    assert "act one after the other" in " ".join(model.report.notes)


def test_stack_of_slides_and_a_ball():
    members = [("Prismatic", "s1", "X", (0, 0, 0), ""), ("Prismatic", "s2", "Y", (0, 0, 0), ""), ("Spherical", "b", "", (0.5, 0, 0), "")]
    model = load(*stacked(*members))
    assert model.joint_type.tolist().count(JointType.SPHERICAL) == 1
    turn = np.array([0.1, 0.2, -0.3, math.sqrt(1 - 0.14)])
    pose = relative(model, [0.4, -0.3, *turn])
    assert pose == pytest.approx(np.r_[np.array([0.9, -0.3, 0]) + rotate(turn, np.array([0.5, 0, 0])), turn], abs=1e-9)


def test_without_the_attribute_joints_between_the_same_bodies_hold_together():
    model = load(*stacked(*STACKS["universal"], adds=0))
    assert (model.dofs, [loop.name for loop in model.loops]) == (7, ["/Root/h2"])


def test_limits_drives_and_states_of_a_stack_stay_with_their_axes():
    more = "float physics:lowerLimit = -30; float physics:upperLimit = 60; float state:angular:physics:position = 45;"
    more += "float newton:armature = 0.5;"
    model = load(*stacked(("Revolute", "h1", "Z", (0, 0, 0), more), ("Revolute", "h2", "Y", (0, 0, 0), "float newton:damping = 2;")))
    assert model.limit[6] == pytest.approx(np.radians([-30, 60]))
    assert np.isinf(model.limit[7]).all()
    assert model.armature[6:] == pytest.approx([0.5, 0])
    assert model.damping[6:] == pytest.approx([0, 2 * 180 / math.pi])
    assert model.q0[7:] == pytest.approx([math.pi / 4, 0], abs=1e-12)


def test_stacks_that_are_none():
    same = [("Revolute", "h1", "Z", (0, 0, 0), ""), ("Revolute", "h2", "Z", (0, 0, 0), "")]
    assert "/Root/h1, /Root/h2 add mobilities that are not independent" in refused(*stacked(*same))
    heavy = [(*m[:4], "float newton:armature = 1;") for m in same]
    assert load(*stacked(*heavy)).dofs == 8
    away = "point3f physics:localPos1 = (7, 0, 0);"
    apart = [STACKS["universal"][0], joint("Revolute", ENDS + away, (), "h2")]
    stage = stacked(apart[0])[0].rstrip().removesuffix("}") + apart[1] + "}"
    assert "/Root/h1: it and /Root/h2 add their mobilities, but disagree about where /Root/B stands" in refused(stage)


def test_dynamics_of_hinges_that_do_not_meet():
    """Two parallel hinges with a body without mass between them are a double pendulum with a rod of no mass.

    M = J^T diag(m, m, I) J of the end: at q = 0, B's centre 0.75 and 0.25 from the hinges.
    """
    model = load(*stacked(*STACKS["parallel hinges"]))
    mass = wl.Simulator(model, device="cpu").mass_matrix().numpy()[0, 6:, 6:]
    j = np.array([[0.75, 0.25], [1, 1]])  # velocity along y and angular velocity about z
    assert mass == pytest.approx(j.T @ np.diag([2.0, 1.0]) @ j)
    sim = wl.Simulator(model, 2, device="cpu")
    sim.set_parameters(mass=np.outer([1, 3], model.mass))  # that of the body between stays zero
    assert sim.mass_matrix().numpy()[1] == pytest.approx(3 * sim.mass_matrix().numpy()[0])


def test_a_body_without_mass_carries_what_hangs_on_it():
    """A swing of 2 s about two hinges keeps its energy, and is that with 1 mg between them, whose own motion is 1e-6 of it."""
    ends = []
    for weight in (0.0, 1e-6):
        builder = wl.ModelBuilder()
        own = {} if weight == 0.0 else {"inertia": weight * np.eye(3)}
        between, end = builder.add_body(mass=weight, **own), builder.add_body(mass=1.0, inertia=0.01 * np.eye(3))
        x = np.array([0, 0, 0, 0.5, 0.5, 0.5, 0.5])  # its x along y
        far = x + np.eye(7)[0]
        builder.add_joint(JointType.REVOLUTE, -1, between, parent_frame=x, child_frame=x)
        builder.add_joint(JointType.REVOLUTE, between, end, parent_frame=far, child_frame=x - 0.5 * np.eye(7)[0])
        sim = wl.Simulator(builder.finalize(), dt=1e-4, device="cpu")
        sim.q.assign(np.array([[0.3, 0.5]]))
        height = sim.body_pose.numpy()[0, end, 2]
        sim.step(20000)
        v, w = np.split(sim.body_velocity.numpy()[0, end], 2)
        energy = 0.5 * (v @ v + 0.01 * w @ w) + 9.81 * (sim.body_pose.numpy()[0, end, 2] - height)
        assert abs(energy) < 2e-2
        ends.append(sim.q.numpy()[0])
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)


@needs_shared
def test_stacked_joints_of_the_converter(shared):
    """MuJoCo's model has a free root with a universal joint, and one with a hinge."""
    model = wl.load_usd(shared / "usd/converted/muc_stacked_joints/stacked_joints.usdc")
    assert (model.num_bodies, model.dofs, len(model.loops)) == (4, 15, 0)
    assert np.degrees(model.limit[6:8]) == pytest.approx(np.array([[-45, 45], [-30, 30]]))
    axes = [rotate(model.joint_pose[1, 3:], model.dof_axis[i]) for i in (6, 7)]
    assert np.array(axes) == pytest.approx(np.eye(3)[:2], abs=1e-12)


# -- drives of type acceleration, states at the start ----------------------------------------------------------------

WEIGHTLESS = prim("PhysicsScene", "Scene", (), "float physics:gravityMagnitude = 0;")


def accelerated(mass, kind="Revolute", world=True, head=SI, more=""):
    """k = 0.2 and b = 0.05 by degree (revolute), k = 4 and b = 3 (prismatic), target 40 degrees or 40 units."""
    inst, k, b = ("angular", 0.2, 0.05) if kind == "Revolute" else ("linear", 4, 3)
    drive = f'uniform token drive:{inst}:physics:type = "acceleration"; float drive:{inst}:physics:stiffness = {k};'
    drive += f"float drive:{inst}:physics:damping = {b}; float drive:{inst}:physics:targetPosition = 40; {more}"
    inertia = f"float physics:mass = {mass}; float3 physics:diagonalInertia = ({mass}, {2 * mass}, {2 * mass});"
    bodies = [body(n, inertia + xform(translate="(0, 0, 3)"), inner="") for n in ("A", "B")[: 1 if world else 2]]
    place = "point3f physics:localPos0 = (0, 0, 3);" if world else ""
    ends = "rel physics:body1 = </A>;" if world else JOINT
    return wl.load_usd(stage(WEIGHTLESS, *bodies, joint(kind, ends + place + drive, (f"PhysicsDriveAPI:{inst}",)), head=head))


@pytest.mark.parametrize("world", [True, False])
@pytest.mark.parametrize(("kind", "head"), [("Revolute", SI), ("Prismatic", SI), ("Revolute", CM), ("Prismatic", CM)])
def test_drive_of_type_acceleration(kind, head, world):
    """q'' = k (q* - q) - b q', whatever the masses and units of length; from rest after 0.5 s."""
    angular, step = kind == "Revolute", 1e-4
    k, b, goal = (0.2 * 180 / math.pi, 0.05 * 180 / math.pi, math.radians(40)) if angular else (4, 3, 40 * (0.01 if head == CM else 1))
    w = np.emath.sqrt(k - b * b / 4)  # imaginary where it creeps
    t = 0.5
    exact = goal * (1 - np.exp(-b * t / 2) * (np.cos(w * t) + b / (2 * w) * np.sin(w * t))).real
    for mass in (0.5, 300):
        model = accelerated(mass, kind, world, head)
        sim = wl.Simulator(model, dt=step, device="cpu")
        sim.step(round(t / step))
        assert sim.q.numpy()[0, -1] == pytest.approx(exact, rel=1e-3)
    assert model.report.notes[-1].startswith("/J: gains of drives of type acceleration are multiplied by the inertia")


def test_acceleration_drive_of_a_chain_has_the_inertia_of_all_it_moves():
    """1 / (M^-1)_ii of the simulator's own M, where links are free to give way; the greatest force stays a force."""
    frames = "point3f physics:localPos0 = (0.5, 0, 0); point3f physics:localPos1 = (-0.5, 0, 0);"
    drive = 'uniform token drive:angular:physics:type = "acceleration"; float drive:angular:physics:stiffness = 1;'
    drive += 'float drive:angular:physics:maxForce = 7; uniform token physics:axis = "Z"; float newton:armature = 0.3;'
    names = ("A", "B", "C")
    bodies = [body(n, LIGHT + xform(translate=f"({i}, 0, 0)", rotateXYZ="(0, 0, 0)"), inner="") for i, n in enumerate(names)]
    joints = []
    for a, b in ("AB", "BC"):
        ends = f"rel physics:body0 = </{a}>; rel physics:body1 = </{b}>;"
        joints.append(joint("Revolute", ends + frames + drive, ("PhysicsDriveAPI:angular",), f"J{b}"))
    model = load(*bodies, *joints)
    mass = wl.Simulator(model, device="cpu").mass_matrix().numpy()[0]
    seen = 1 / np.diag(np.linalg.inv(mass))[6:]
    assert model.drive[6:, 0] == pytest.approx(seen * 180 / math.pi, rel=1e-9)
    assert model.drive[6:, 2].tolist() == [7, 7]
    assert (seen < np.diag(mass)[6:]).all()


def test_joint_states_place_and_move_what_they_carry():
    """The first hinge at 90 degrees and 30 degrees/s, the second where the bodies stand: the arm of two turns as one."""
    state = 'uniform token physics:axis = "Z"; float state:angular:physics:position = 90; float state:angular:physics:velocity = 30;'
    second = "rel physics:body0 = </A>; rel physics:body1 = </B>; point3f physics:localPos0 = (0.5, 0, 0);"
    bodies = [body(n, LIGHT + xform(translate=f"({x}, 0, 0)"), inner="") for n, x in (("A", 0.5), ("B", 1.5))]
    first = "rel physics:body1 = </A>; point3f physics:localPos1 = (-0.5, 0, 0);" + state
    more = 'point3f physics:localPos1 = (-0.5, 0, 0); uniform token physics:axis = "Z";'
    model = load(*bodies, joint("Revolute", first, (), "J"), joint("Revolute", second + more, (), "K"))
    assert model.q0 == pytest.approx([math.pi / 2, 0], abs=1e-12)
    assert model.v0 == pytest.approx([math.pi / 6, 0], abs=1e-12)
    pose = wl.Simulator(model, device="cpu").body_pose.numpy()[0]
    assert pose[:, :3] == pytest.approx(np.array([[0, 0.5, 0], [0, 1.5, 0]]), abs=1e-12)
    assert model.report.notes[-1].startswith("/J: stand and move at the start as state:<axis>")
    assert not any("state:" in i.what for i in model.report.ignored)


def test_joint_state_of_a_d6_joint_in_centimetres():
    apis = [f"PhysicsLimitAPI:{axis}" for axis in ("transY", "transZ", "rotX", "rotY")]
    locked = "".join(limit(axis, 1, -1) for axis in ("transY", "transZ", "rotX", "rotY"))
    model = load(*pair("", locked + "float state:transX:physics:position = 20; float state:rotZ:physics:position = -30;", apis), head=CM)
    assert model.q0[7:] == pytest.approx([0.2, -math.pi / 6])


def test_what_a_joint_moves_at_the_start_is_told():
    frames = "point3f physics:localPos0 = (0.5, 0, 0); point3f physics:localPos1 = (-0.5, 0.25, 0);"
    bodies = [body(n, LIGHT + xform(translate=f"({x}, 0, 0)"), inner="") for n, x in (("A", 0), ("B", 1))]
    model = load(*bodies, joint("Revolute", JOINT + frames))
    assert "/B does not stand where joints let them: moved there by 0.25 m" in model.report.notes


def test_bodies_of_a_stack_pass_through_each_other_with_a_body_between_them():
    boxes = [body("A", LIGHT, inner=cube()), body("B", LIGHT + xform(translate="(1, 0, 0)"), inner=cube())]
    for more, pairs in (("", 0), ("bool physics:collisionEnabled = 1;", 1)):
        hinges = []
        for name, x in (("h1", 0.25), ("h2", 0.75)):
            frames = (
                f'point3f physics:localPos0 = ({x}, 0, 0); point3f physics:localPos1 = ({x - 1}, 0, 0); uniform token physics:axis = "Z";'
            )
            hinges.append(joint("Revolute", ENDS + frames + more, (), name))
        assert len(load(root(*boxes, *hinges)).pairs) == pairs


# -- where joints stand: every kind of prim that one may name ------------------------------------------------------------

TURN = np.array([0.2, -0.4, 0.4, 0.8])  # (x y z w)
PLACE = (0.3, -0.2, 0.5)
FRAME = f"point3f physics:localPos1 = {PLACE}; quatf physics:localRot1 = (0.8, 0.2, -0.4, 0.4);"
MOVED = {"translate": "(1, 2, 3)", "rotateXYZ": "(10, 20, 30)"}
SIMPLE = xform(translate="(0.3, 0, 1)", rotateXYZ="(50, 0, 0)")


def world_frame(source, path):
    """Where FRAME of a prim is in the world, by USD's own transform, and the image of its x axis (stage units)."""
    from pxr import UsdGeom

    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(source.GetPrimAtPath(path)))
    return np.array(PLACE) @ matrix[:3, :3] + matrix[3, :3], rotate(TURN, np.eye(3)[0]) @ matrix[:3, :3]


@pytest.mark.parametrize("head", [SI, CM])
@pytest.mark.parametrize("scale", [None, "(2, 2, 2)", "(2, 3, 0.5)", "(-1, 1, 1)", "(-2, -2, -2)"])
@pytest.mark.parametrize("case", ["body", "child", "nested body", "body below"])
def test_frame_of_a_joint_is_where_the_prim_that_it_names_has_it(case, scale, head):
    """Scaled, slanted, mirrored (which turns angles round), child prims, nested bodies; metres and centimetres."""
    outer = xform(**MOVED, **({} if scale is None else {"scale": scale}))
    prims, named = {
        "body": (body("A", LIGHT + outer, inner=""), "/A"),
        "child": (body("A", LIGHT + outer, inner=prim("Xform", "K", (), SIMPLE)), "/A/K"),
        "nested body": (body("A", LIGHT + outer, inner=body("B", LIGHT + SIMPLE, inner="")), "/A/B"),
        "body below": (prim("Xform", "W", (), outer + body("B", LIGHT + SIMPLE, inner="")), "/W/B"),
    }[case]
    source = stage(SCENE, prims, joint("Revolute", f"rel physics:body1 = <{named}>;" + FRAME), head=head)
    reading = read_usd(source)
    model = reading.builder.finalize()
    b = next(b for b in range(model.num_bodies) if model.joint_type[b] == JointType.REVOLUTE)
    path = model.body_names[b]
    stands = np.array(reading.builder.pose(b))
    frame = compose(stands, model.joint_child_pose[b])
    place, axis = world_frame(source, named)
    unit = 0.01 if head == CM else 1.0
    assert frame[:3] == pytest.approx(unit * place, abs=1e-12)
    if scale != "(2, 3, 0.5)":  # an uneven scale leaves no axis where it is
        mirrored = -1.0 if scale and "-" in scale else 1.0
        assert rotate(frame[3:], np.eye(3)[0]) == pytest.approx(mirrored * axis / np.linalg.norm(axis), abs=1e-6)
    assert path == ("/A" if case == "child" else named)


def test_joint_that_names_what_is_no_body_holds_to_the_world_there():
    static = prim("Xform", "S", (), xform(translate="(5, 0, 0)", rotateXYZ="(0, 0, 90)", scale="(2, 2, 2)"))
    ends = "rel physics:body0 = </S>; rel physics:body1 = </A>; point3f physics:localPos0 = (1, 0, 0);"
    model = load(static, body("A", LIGHT + xform(translate="(5, 2, 0)", rotateXYZ="(0, 0, 90)"), inner=""), joint("Revolute", ends))
    assert model.joint_pose[0] == pytest.approx([5, 2, 0, 0, 0, math.sqrt(0.5), math.sqrt(0.5)], abs=1e-12)
    assert (model.nq, model.q0[0]) == (1, pytest.approx(0, abs=1e-12))


def test_joint_of_a_disabled_body_holds_to_the_world():
    off = body("B", LIGHT + "bool physics:rigidBodyEnabled = 0;" + xform(translate="(0, 0, 2)"), inner="")
    model = load(body("A", LIGHT, inner=""), off, joint("Revolute", JOINT + "point3f physics:localPos1 = (0, 0, -2);"))
    assert (model.dofs, model.joint_pose[0, :3].tolist()) == (1, pytest.approx([0, 0, 0]))


def test_joint_that_names_nothing_is_refused():
    message = refused(body("A", LIGHT, inner=""), joint("Revolute", "rel physics:body0 = </Nope>; rel physics:body1 = </A>;"))
    assert "/J: physics:body0 names /Nope, which does not exist" in message


def test_joint_that_names_what_stands_nowhere_is_refused():
    message = refused(body("A", LIGHT, inner=""), joint("Revolute", "rel physics:body0 = </Scene>; rel physics:body1 = </A>;"))
    assert "/J: physics:body0 names /Scene, which stands nowhere" in message


def test_joint_that_names_a_prim_without_type_holds_to_the_world():
    model = load('def "Group" {}', body("A", LIGHT, inner=""), joint("Revolute", "rel physics:body0 = </Group>; rel physics:body1 = </A>;"))
    assert (model.nv, model.body_parent.tolist()) == (1, [-1])


@pytest.mark.parametrize("kind", ["Revolute", "Prismatic"])
def test_axis_that_is_none(kind):
    """The parser takes x for it."""
    assert "/J: physics:axis is 'Q'; give one of X, Y, Z" in refused(*pair(kind, 'uniform token physics:axis = "Q";'))


DRIVE = "float drive:{0}:physics:stiffness = 10; float drive:{0}:physics:damping = 1;"


@pytest.mark.parametrize(
    ("kind", "content", "apis", "what", "why"),
    [
        ("Revolute", DRIVE.format("linear"), ["PhysicsDriveAPI:linear"], "PhysicsDriveAPI:linear", "takes angular alone"),
        ("Prismatic", DRIVE.format("angular"), ["PhysicsDriveAPI:angular"], "PhysicsDriveAPI:angular", "takes linear alone"),
        ("Fixed", "float state:linear:physics:position = 1;", ["PhysicsJointStateAPI:linear"], "PhysicsJointStateAPI:linear", "takes none"),
        ("Spherical", DRIVE.format("rotX"), ["PhysicsDriveAPI:rotX"], "PhysicsDriveAPI:rotX", "takes none"),
        ("Revolute", "float limit:rotX:physics:low = -10;", ["PhysicsLimitAPI:rotX"], "PhysicsLimitAPI:rotX", "takes none"),
        (
            "Revolute",
            DRIVE.format("angular"),
            [],
            "drive:angular:physics:damping, drive:angular:physics:stiffness",
            "no PhysicsDriveAPI is",
        ),
        ("", limit("transX", 1, -1) + DRIVE.format("transX"), ["PhysicsLimitAPI:transX", "PhysicsDriveAPI:transX"], None, "is locked"),
    ],
)
def test_what_acts_along_an_axis_that_the_joint_has_not_is_told(kind, content, apis, what, why):
    model = load(*pair(kind, content, apis))
    (told,) = [i for i in model.report.ignored if why in i.why]
    assert (told.path, told.what) == ("/J", what or "PhysicsDriveAPI:transX")
    assert not model.drive[6:, :2].any()


def test_drives_that_drive_nothing_are_not_told():
    """Converters apply them everywhere."""
    idle = "float drive:linear:physics:stiffness = 0; float drive:linear:physics:maxForce = 100; float limit:rotX:physics:high = inf;"
    model = load(*pair("Fixed", idle, ["PhysicsDriveAPI:linear", "PhysicsLimitAPI:rotX"]))
    assert not [i for i in model.report.ignored if i.path == "/J"]


def test_a_rotation_of_no_length_is_told():
    model = load(*pair("Revolute", "quatf physics:localRot1 = (0, 0, 0, 0);"))
    assert "/J: physics:localRot1 is zero, which is no rotation; (1, 0, 0, 0) is taken" in model.report.notes


@pytest.mark.parametrize(("name", "value"), [("stiffness", "-10"), ("damping", "nan"), ("maxForce", "-1")])
def test_drive_that_is_none_is_refused_as_it_was_written(name, value):
    numbers = {"stiffness": "10", "damping": "1", "maxForce": "5"} | {name: value}
    content = "".join(f"float drive:angular:physics:{k} = {x};" for k, x in numbers.items())
    message = refused(*pair("Revolute", content, ["PhysicsDriveAPI:angular"]))
    assert f"/J: its drive's physics:{name} is {value}; give a finite number" in message


def test_robots_of_instances_and_their_joints():
    """Two instances of one robot, 5 apart: each has bodies, joint and articulation of its own, which passes through itself alone."""
    arms = [body(n, LIGHT + xform(translate=f"({x}, 0, 0)"), inner=cube()) for n, x in (("A", 0), ("B", 1), ("C", 2))]
    ends = [f"rel physics:body0 = </R/{a}>; rel physics:body1 = </R/{b}>;" for a, b in ("AB", "BC")]
    frames = "point3f physics:localPos0 = (0.5, 0, 0); point3f physics:localPos1 = (-0.5, 0, 0);"
    hinges = [joint("Revolute", e + frames, (), n) for n, e in zip(("J", "K"), ends, strict=True)]
    robot = prim("Xform", "R", ("PhysicsArticulationRootAPI",), "bool newton:selfCollisionEnabled = 0;" + "".join([*arms, *hinges]))
    copies = [
        prim("Xform", n, (), xform(translate=f"({x}, 0, 0)"), "instanceable = true\nprepend inherits = </R>")
        for n, x in (("I", 0), ("K", 5))
    ]
    model = load(robot.replace("def Xform", "class Xform", 1), *copies)
    assert model.joint_names == ("", "/I/J", "/I/K", "", "/K/J", "/K/K")
    assert model.body_parent.tolist() == [-1, 0, 1, -1, 3, 4]
    poses = wl.Simulator(model, device="cpu").body_pose.numpy()[0]
    assert poses[:, 0] == pytest.approx([0, 1, 2, 5, 6, 7])
    touching = {tuple(sorted(model.shape_body[pair])) for pair in model.pairs}
    assert touching == {(a, b) for a in range(3) for b in range(3, 6)}


def test_joints_in_grams_and_centimetres():
    """Units of mass and length in armature, damping, friction, drives: g cm^2, g cm^2/s by degree, g cm^2/s^2."""
    head = CM.replace("kilogramsPerUnit = 1", "kilogramsPerUnit = 0.001")
    content = "float newton:armature = 3; float newton:damping = 2; float newton:friction = 5; float drive:angular:physics:stiffness = 7;"
    model = load(*pair("Revolute", content + "float drive:angular:physics:maxForce = 11;", ("PhysicsDriveAPI:angular",)), head=head)
    unit = 1e-3 * 1e-4
    found = [model.armature[6], model.damping[6], model.joint_friction[6], model.drive[6, 0], model.drive[6, 2]]
    assert found == pytest.approx([3 * unit, 2 * unit * 180 / math.pi, 5 * unit, 7 * unit * 180 / math.pi, 11 * unit], rel=1e-9)
    content = content.replace("angular", "linear")
    model = load(*pair("Prismatic", content + "float drive:linear:physics:maxForce = 11;", ("PhysicsDriveAPI:linear",)), head=head)
    found = [model.armature[6], model.damping[6], model.joint_friction[6], model.drive[6, 0], model.drive[6, 2]]
    assert found == pytest.approx([3e-3, 2e-3, 5e-5, 7e-3, 11e-5], rel=1e-9)


def test_a_joint_of_several_axes_may_carry_its_first_body():
    """Only its second body is held: poses and mass matrix are those of the same joint with its bodies exchanged, coordinates reversed."""
    content = LIGHT + xform(translate="(1, 0, 0)")
    free = [f"PhysicsLimitAPI:{axis}" for axis in ("transX", "transY", "transZ", "rotZ")]
    locked = "".join(limit(axis, 1, -1) for axis in ("transX", "transY", "transZ", "rotZ")) + limit("rotY", -20, 30)
    ends = "rel physics:body0 = </A>; point3f physics:localPos1 = (1, 0, 0);"
    model = load(body("A", content, inner=""), joint("", ends + locked, (*free, "PhysicsLimitAPI:rotY")))
    assert model.dofs == 2
    assert model.limit[0] == pytest.approx(np.radians([-20, 30]))
    sim, (a, b) = wl.Simulator(model, device="cpu"), (0.3, -0.4)  # about y, then about x: the world turns by R_x(b) R_y(a) in A
    sim.q.assign(np.array([[a, b]]))
    pose = sim.body_pose.numpy()[0, 0]
    x, y = np.array([math.sin(b / 2), 0, 0, math.cos(b / 2)]), np.array([0, math.sin(a / 2), 0, math.cos(a / 2)])
    assert pose == pytest.approx(inverse(compose(np.r_[0, 0, 0, x], np.r_[0, 0, 0, y])) + np.eye(7)[0], abs=1e-12)


@pytest.mark.parametrize("kind", ["Revolute", "Prismatic"])
@pytest.mark.parametrize(("limits", "expected"), [({"upper": 10}, (-np.inf, 10)), ({"lower": -10}, (-10, np.inf)), ({}, (-np.inf, np.inf))])
def test_limits_on_one_side(kind, limits, expected):
    """The parser enables no limit of an angle that has one side."""
    content = "".join(f"float physics:{side}Limit = {value};" for side, value in limits.items())
    unit = math.radians(1) if kind == "Revolute" else 1.0
    assert load(*pair(kind, content)).limit[6] == pytest.approx(unit * np.array(expected))


def test_infinite_limits_that_lock():
    apis = [f"PhysicsLimitAPI:{axis}" for axis in ("transX", "rotX")]
    model = load(*pair("", limit("transX", "inf", "-inf") + limit("rotX", -10, "inf"), apis))
    assert model.dofs == 11
    assert model.limit[8] == pytest.approx([-math.radians(10), np.inf])  # after ty and tz


def test_each_cone_limit_breaking_and_mimic_joint_is_named():
    one = read(*pair("Spherical", "float physics:coneAngle1Limit = 30;")).report.ignored
    assert [(i.path, i.what.split()[0]) for i in one] == [("/J", "cone")]
    mimic = "rel newton:mimicJoint = </K>; float newton:mimicCoef1 = 2;"
    ignored = read(*pair("Revolute", mimic, ("NewtonMimicAPI",))).report.ignored
    assert [(i.path, i.what) for i in ignored] == [("/J", "NewtonMimicAPI")]
    ignored = read(*pair("Revolute", "", ("PhysxMimicJointAPI:rotX",))).report.ignored
    assert [(i.path, i.what) for i in ignored] == [("/J", "PhysxMimicJointAPI:rotX")]
    ignored = read(*pair("Revolute", "float physics:breakTorque = 3;")).report.ignored
    assert [(i.path, i.what) for i in ignored] == [("/J", "physics:breakForce, physics:breakTorque")]


@needs_shared
def test_feet_that_stand_in_each_other_part_slowly(shared):
    """Joints within 0.2 rad of their zeros, of which crossed feet overlap by up to 97 mm: one such overlap is pushed apart with 1 m/s.
    Without calming them they leave with 48 m/s after one step and with more than 400 within five."""
    model = wl.load_usd(shared / "usd/newton/ex_humanoid.usda")
    envs = 512
    sim = wl.Simulator(model, envs, dt=2e-3, device="cpu")
    q = np.tile(model.q0, (envs, 1))
    q[:, 7:] += np.random.default_rng(0).uniform(-0.2, 0.2, q[:, 7:].shape)
    q[:, 2] += 1
    sim.q.assign(q)
    peak = 0.0
    for step in range(50):
        sim.step()
        velocity = sim.body_velocity.numpy()[:, :, :3]
        centre = (velocity * model.mass[:, None]).sum(axis=1, keepdims=True) / model.mass.sum()
        peak = max(peak, np.linalg.norm(velocity - centre, axis=-1).max())
        assert peak < (4.0 if step == 0 else 15.0)
        assert not sim.status.numpy().any()
    depth = np.where(np.arange(sim.contacts.gap.shape[1]) < sim.contacts.count.numpy()[:, None], -sim.contacts.gap.numpy(), 0.0).max(axis=1)
    assert (depth > 5e-3).sum() < 60  # 107 at the start
