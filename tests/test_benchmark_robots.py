# SPDX-License-Identifier: Apache-2.0
"""Robots beside other engines: the maps between their coordinates and ours, what is written for them, what counts as agreement."""

import sys
from dataclasses import fields, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from test_benchmarks import fake, folder  # noqa: F401
from test_joints import moved, pendulum, poses, quadruped, random_state, random_tree

import warp_lcp as wl
from benchmarks import dynamics, motion, peers, regression, robot_speed, robots, start_up
from benchmarks.cases import CASES
from benchmarks.peers import compare
from benchmarks.peers.session import session
from warp_lcp.model import DofKind, Drive, JointType

sys.path.insert(0, str(Path(peers.__file__).parent / "adapters"))
import mjcf
import protocol

MUJOCO = peers.PEERS["mujoco"]
needs_mujoco = pytest.mark.skipif(not MUJOCO.installed(peers.FOLDER), reason="the peer's interpreter is not installed")


def job(robot: robots.Robot, tmp_path: Path) -> protocol.Job:
    """What an adapter reads of a robot."""
    robot.save(tmp_path / "robot.npz")
    given = {"scene": "", "dt": 1e-3, "steps": 0, "every": 1, "friction": 0.5, "restitution": 0.0, "settings": {}}
    return protocol.read({"job": given | {"state": str(tmp_path / "robot.npz")}})


def robot(model: wl.Model, envs: int = 3) -> robots.Robot:
    """At states of random_state: unit quaternions, angles of order one."""
    q, v = zip(*(random_state(model, seed) for seed in range(envs)), strict=True)
    return robots.Robot("random", model, 1e-3, 0, np.array(q), np.array(v))


def test_adapters_read_what_is_written():
    loops = {f"loop_{name}" for name in robots.LOOPS}
    assert {field.name for field in fields(protocol.Tree)} == {*robots.TREE, *loops, "q", "v"}


def test_map_to_the_velocities_of_mujoco(tmp_path):
    """B v is what moves qpos, by differences along the motion at constant v; dB/dt v is how B v changes on the way."""
    model, h = random_tree(), 1e-4
    made = robot(model)
    tree = job(made, tmp_path).tree
    jacobian, rate = mjcf.velocity_map(tree, made.q, made.v)
    sides = []
    for side in (-h, h):
        q = np.array([moved(model, q, v, side) for q, v in zip(made.q, made.v, strict=True)])
        sides.append((mjcf.coordinates(tree, q), np.einsum("eij,ej->ei", mjcf.velocity_map(tree, q, made.v)[0], made.v)))
    qvel = np.einsum("eij,ej->ei", jacobian, made.v)
    assert np.abs((sides[1][1] - sides[0][1]) / (2 * h) - rate).max() < 1e-6
    at_q = at_v = 0
    for body in mjcf.depth_first(tree):
        kind, number = tree.joint_type[body], int(np.count_nonzero(tree.dof_body == body))
        before, after = (qpos[:, at_q:] for qpos, _ in sides)
        if kind == JointType.FREE:
            assert np.abs((after - before)[:, :3] / (2 * h) - qvel[:, at_v : at_v + 3]).max() < 1e-6
            before, after = before[:, 3:], after[:, 3:]
        if kind in (JointType.FREE, JointType.SPHERICAL):  # q^-1 dq/dt is half the angular velocity in the body's axes
            turns = [np.roll(x[:, :4], -1, axis=1) for x in (before, after)]
            change = 2.0 * mjcf.product(turns[0] * [-1, -1, -1, 1], turns[1])[:, :3] / (2 * h)
            w = qvel[:, at_v + number - 3 : at_v + number]
            assert np.abs(change - w).max() < 1e-3 * np.abs(w).max()  # the axes turn by h w between the two
            at_q += 4 if kind == JointType.SPHERICAL else 7
        else:
            assert np.abs((after - before)[:, :number] / (2 * h) - qvel[:, at_v : at_v + number]).max(initial=0.0) < 1e-9
            at_q += number
        at_v += number
    assert (at_q, at_v) == (model.nq, model.nv)


def test_quaternion_of_a_matrix():
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        assert abs(abs(mjcf.quaternion(mjcf.matrix(q)) @ q) - 1.0) < 1e-14


def test_what_mjcf_cannot_say_is_refused(tmp_path):
    def made(**options) -> wl.Model:
        builder = wl.ModelBuilder()
        body = builder.add_body(mass=1.0, inertia=0.01 * np.eye(3))
        builder.add_joint(JointType.REVOLUTE, -1, body, **options)
        return builder.finalize()

    text = mjcf.model(job(robot(made(drive=Drive(3.0, 2.0, target=0.1), damping=0.5, limit=(-1, 2))), tmp_path))
    assert 'damping="2.5"' in text
    assert 'stiffness="3.0" springref="0.1"' in text
    assert 'range="-1.0 2.0"' in text
    assert 'range="0.499999999 0.500000001"' in mjcf.model(job(robot(made(limit=(0.5, 0.5))), tmp_path))
    # All shapes of two bodies touch or none: the thigh of a leg passes through nothing but its own shank.
    model = quadruped().finalize()
    text = mjcf.model(job(robot(replace(model, drive=np.zeros_like(model.drive))), tmp_path))
    assert '<exclude body1="b2" body2="b3"/>' in text or '<exclude body1="b3" body2="b2"/>' in text
    two = wl.ModelBuilder()
    for x in (0.0, 1.0):
        body = two.add_body(pose=(x, 0, 0, 0, 0, 0, 1))
        two.add_sphere(body, 0.1)
        two.add_sphere(body, 0.2)
    two.filter_pair(0, 2)
    with pytest.raises(protocol.Refused, match="not with others"):
        mjcf.model(job(robot(two.finalize()), tmp_path))


def test_drives_of_limited_force_are_actuators(tmp_path):
    """Force a + b q + c dq/dt, limited, of no control: 6 (0.2 - q) + 0.5 (0.3 - dq/dt) within 4 N m."""
    builder = wl.ModelBuilder()
    body = builder.add_body(mass=1.0, inertia=0.01 * np.eye(3))
    builder.add_joint(JointType.REVOLUTE, -1, body, drive=Drive(6.0, 0.5, 4.0, target=0.2, target_velocity=0.3), damping=0.1)
    text = mjcf.model(job(robot(builder.finalize()), tmp_path))
    actuator = ElementTree.fromstring(text).find("actuator/general")
    assert [float(x) for x in actuator.get("biasprm").split()] == pytest.approx([1.35, -6.0, -0.5])
    assert actuator.get("forcerange") == "-4.0 4.0"
    assert actuator.get("gainprm") == "0"
    joint = ElementTree.fromstring(text).find(f".//joint[@name='{actuator.get('joint')}']")
    assert (joint.get("stiffness"), joint.get("damping")) == ("0.0", "0.1")
    assert ElementTree.fromstring(text).find("option").get("integrator") == "implicitfast"


def looped(ways=(True, True, True), turns=(False, True, True)) -> wl.Model:
    """The model of the four-bar, its loop closed by another joint."""
    model = CASES["fourbar"].scene(1e-3).made
    return replace(model, loops=(replace(model.loops[0], ways=ways, turns=turns),))


def test_loops_in_mjcf(tmp_path):
    """A ball is one point, a weld a frame, a hinge two points of its axis; both sides are where the mechanism closes."""
    for turns, kinds in (((False,) * 3, ["connect"]), ((True,) * 3, ["weld"]), ((False, True, True), ["connect", "connect"])):
        tree = ElementTree.fromstring(mjcf.model(job(robot(looped(turns=turns), 1), tmp_path)))
        assert [element.tag for element in tree.find("equality")] == kinds
        assert len(tree.findall(".//site")) == 2 * len(kinds)
        assert tree.find(".//body[@name='b1']/site").get("name") == "a0"
    with pytest.raises(protocol.Refused, match="balls, hinges and welds"):
        mjcf.model(job(robot(looped(turns=(True, False, False)), 1), tmp_path))
    told = job(robots.of_scene(CASES["fourbar"].scene(1e-3)), tmp_path)
    for _, bodies, frames in mjcf.closures(told.tree):
        ends = [told.pose[0, body, :3] + mjcf.rotate(told.pose[0, body, 3:], place[:3]) for body, place in zip(bodies, frames, strict=True)]
        assert np.abs(ends[0] - ends[1]).max() < 1e-9


def test_stiff_settings_are_those_of_limits_and_loops(tmp_path):
    made = job(robot(looped(), 1), tmp_path)
    made.settings["time_constant_steps"] = 2
    tree = ElementTree.fromstring(mjcf.model(made))
    assert tree.find("equality/connect").get("solref") == tree.find("default/joint").get("solreflimit") == "0.002 1"


def test_constant_forces_on_trees(tmp_path):
    scene = CASES["wedge_slips"].scene(1e-3)
    assert np.array_equal(job(robots.of_scene(scene), tmp_path).wrench, scene.wrench)


@pytest.mark.parametrize(
    ("name", "variant", "most"),
    [
        ("mujoco", "elliptic, stiff, RK4", 1e-3),
        ("drake", "sap", 1e-2),
        pytest.param("mujoco_warp", "elliptic, stiff, RK4", 1e-3, marks=pytest.mark.slow),
        pytest.param("newton_steel", "12 sweeps", 1e-2, marks=pytest.mark.slow),
        pytest.param("newton_lox", "200 iterations", 1e-2, marks=pytest.mark.slow),
    ],
)
def test_a_loop_and_a_force_in_other_engines(name, variant, most):
    """The four-bar's crank is after 0.2 s where Lagrange's equation has it, and again; a jaw is pushed as far as by us."""
    peer = peers.PEERS[name]
    if not peer.installed(peers.FOLDER):
        pytest.skip("the peer's interpreter is not installed")
    bars = replace(CASES["fourbar"].scene(1e-3), steps=200)
    wedge = CASES["wedge_slips"].scene(1e-3)
    alone = replace(wedge, steps=100, made=replace(wedge.made, pairs=wedge.made.pairs[:0]))
    with session(peer, peers.FOLDER) as running:
        for scene in (bars, alone):
            fine = replace(scene, dt=1e-4, steps=10 * scene.steps)
            expected = motion.simulate(fine, fine.steps, device="cpu").pose[-1, 0, :, :3]
            task = running.make(variant, scene, scene.steps)
            assert np.abs(task.pose[-1, 0, :, :3] - expected).max() < most
            task.repeat()
            assert task.same
            assert compare.problems(scene, task) == []


def test_scenes_with_joints_are_robots_to_others():
    """Where they have nothing that adapters are not told: belts."""
    chain = CASES["chain"].scene(1e-3, 2)
    told = robots.of_scene(chain)
    assert told.q.shape == (2, chain.made.nq)
    assert np.abs(told.pose - chain.pose).max() < 1e-12
    with pytest.raises(ValueError, match="move by themselves"):
        robots.of_scene(CASES["stick_slip"].scene(1e-3, 1))


def test_distances_and_unequal_friction_are_no_jobs(tmp_path):
    builder = wl.ModelBuilder()
    builder.add_sphere(builder.add_body(), 0.1)
    builder.add_plane(material=wl.Material(0.7, 0.7))
    with pytest.raises(ValueError, match="friction coefficients"):
        _ = robot(builder.finalize()).friction
    builder.add_distance(-1, 0, 0.0, 1.0, name="string")
    with pytest.raises(ValueError, match="string"):
        robot(builder.finalize()).save(tmp_path / "x.npz")


def test_lowest_point_and_torn_joints():
    """A capsule on end and on its side, a tilted box; joints of our poses hold, and a body that is shifted tears by as much."""
    builder = wl.ModelBuilder()
    body = builder.add_body(pose=(0, 0, 1, 0, 0, 0, 1))
    builder.add_capsule(body, 0.1, 0.3)
    up = robot(builder.finalize(), 1)
    pose = np.array([[[0, 0, 1.0, 0, 0, 0, 1]], [[0, 0, 1.0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]]])
    assert robots.lowest(up.model, pose) == pytest.approx([0.6, 0.9])
    builder = wl.ModelBuilder()
    builder.add_box(builder.add_body(), (0.1, 0.1, 0.1))
    eighth = np.array([[[0, 0, 1.0, np.sin(np.pi / 8), 0, 0, np.cos(np.pi / 8)]]])
    assert robots.lowest(builder.finalize(), eighth) == pytest.approx([1.0 - 0.1 * np.sqrt(2)])
    model = pendulum((1.0, 0.5), (1.0, 1.0), inertia=1e-3)
    pose = np.array([poses(model, q) for q in robot(model).q])
    assert robots.torn(model, pose) < 1e-14
    pose[1, 1, 0] += 0.01
    assert robots.torn(model, pose) == pytest.approx(0.01)


def test_random_states_respect_limits():
    model = quadruped().finalize()
    q, v = robots.random_states(model, 50, seed=0)
    angle = q[:, 7:]
    assert (angle >= model.limit[6:, 0]).all()
    assert (angle <= model.limit[6:, 1]).all()
    assert angle.std(axis=0).min() > 0.3
    assert np.abs(np.linalg.norm(q[:, 3:7], axis=1) - 1.0).max() < 1e-14
    near, _ = robots.random_states(model, 50, seed=0, spread=0.1)
    assert np.abs(near[:, 7:] - model.q0[7:]).max() <= 0.1
    assert v.shape == (50, model.nv)
    held = replace(model, limit=np.zeros_like(model.limit))
    assert robots.random_states(held, 50, seed=0)[0][:, 7:].std(axis=0).min() > 1.0


def test_a_dropped_robot_starts_above_the_ground(tmp_path, monkeypatch):
    model = quadruped().finalize()
    monkeypatch.setattr(robots, "load", lambda path: model)
    made = robots.dropped("quadruped", tmp_path, 4, 2e-3, 10, height=0.05)
    assert robots.lowest(model, made.pose) == pytest.approx(np.full(4, 0.05), abs=1e-12)
    assert np.ptp(made.q[:, 7:], axis=0).min() > 0.0
    later = robots.settled(made, "later", 1.0)
    assert np.abs(robots.lowest(model, later.pose)).max() < 1e-3


def test_differences_are_seen():
    """One entry of M, of a small degree of freedom beside large ones, and one of c, each by 1e-9 of its size."""
    made = dynamics.ours(robot(random_tree(), 2))
    assert max(dynamics.differences(made, made).values()) == 0.0
    for name, at in (("mass", (1, 7, 7)), ("bias", (0, 3)), ("velocity", (0, 2, 1))):
        other = {key: array.copy() for key, array in made.items()}
        other[name][at] *= 1 + 1e-6
        found = dynamics.differences(other, made)
        assert max(found.values()) > dynamics.AGREES
    known = {"bodies": 2, "dofs": 7, "mass": 1.0}
    row = dict.fromkeys(("position", "turn", "velocity", "mass_matrix"), 1e-15) | {"bias": 1e-9, "bodies": 2, "dofs": 6, "mass": 1.1}
    assert [text.split()[0] for text in dynamics.problems(row | {"known": known})] == ["bias", "dofs", "mass"]


def test_without_robots_or_peer(tmp_path):
    with pytest.raises(FileNotFoundError, match="no robots"):
        dynamics.measure(True, peers.FOLDER, tmp_path / "none")
    with pytest.raises(FileNotFoundError, match="peers install mujoco"):
        dynamics.measure(True, tmp_path, tmp_path)


@needs_mujoco
def test_every_joint_agrees_with_mujoco():
    """Poses, velocities, M and c of a tree with a joint of every type."""
    model = random_tree()
    armature = np.where(np.isin(model.dof_kind, (DofKind.LINEAR, DofKind.ANGULAR)), np.linspace(0.0, 0.1, model.nv), 0.0)
    made = robot(replace(model, armature=armature), 5)
    found = dynamics.differences(dynamics.ours(made), dynamics.theirs(made, MUJOCO, peers.FOLDER))
    assert max(found.values()) < 1e-13, found


@needs_mujoco
@pytest.mark.parametrize("name", dynamics.KNOWN)
def test_robots_of_others_agree_with_mujoco(shared, name):
    """What USD says and what MuJoCo computes: as `python -m benchmarks dynamics`, which has more states."""
    data = dynamics.measure(True, peers.FOLDER, shared / "usd", (name,))
    if name in data["absent"]:
        pytest.skip(data["absent"][name][:100])
    assert dynamics.problems(data["rows"][0]) == []


# ------------------------------------------------------------------------------------------------------------------ speed


def standing() -> robots.Robot:
    """A quadruped on its feet, under its drives."""
    model = quadruped().finalize()
    return robots.Robot("quadruped", model, 2e-3, 20, np.tile(model.q0, (3, 1)), np.zeros((3, model.nv)))


def test_a_peer_that_refuses_a_robot(folder, monkeypatch):  # noqa: F811
    """It is told, and the others are measured; that a later result is worse is seen as for scenes of boxes."""
    monkeypatch.setitem(robot_speed.VARIANTS, "fake", ("plain",))
    with session(fake(folder, fault="refuses"), folder) as running:
        refused, mine = robot_speed.one(standing(), [running], 2)
    assert refused["refused"] == "fake, plain: no such thing"
    data = {"peers": [mine], "refused": [refused], "absent": {}}
    assert "quadruped: refused by fake, plain: no such thing" in robot_speed.markdown(data)
    slower = mine | {"engine": "x", "ours_over_peer": 0.5, "ours_over_peer_range": [0.4, 0.6]}
    faster = slower | {"ours_over_peer": 1.0, "ours_over_peer_range": [0.9, 1.1]}
    assert len(regression.worse({"what": "robots", "peers": [faster]}, {"what": "robots", "peers": [slower]})) == 1


def test_start_up_of_a_peer(folder, monkeypatch):  # noqa: F811
    """Two processes with a robot; what refuses it or ends on the way is told."""
    monkeypatch.setitem(robot_speed.VARIANTS, "fake", ("plain",))
    row = start_up.other(standing(), fake(folder), folder)
    assert (row["scene"], row["engine"]) == ("quadruped", "fake, plain")
    assert min(row["cold_s"], row["warm_s"]) > 0.0
    assert start_up.other(standing(), fake(folder, fault="refuses"), folder)["refused"] == "fake, plain: no such thing"


@pytest.mark.parametrize(
    ("fault", "problem"), [(None, []), ("start", ["another start pose"]), ("overflow", ["contacts or rows overflowed"])]
)
def test_turns_with_a_robot(folder, monkeypatch, fault, problem):  # noqa: F811
    """The peer gets the bodies of the robot; ours is told with its residuals, and both by how they end."""
    monkeypatch.setitem(robot_speed.VARIANTS, "fake", ("plain",))
    with session(fake(folder, **({} if fault is None else {"fault": fault})), folder) as running:
        mine, theirs = robot_speed.one(standing(), [running], 3)
    assert (len(mine["seconds"]), len(theirs["seconds"])) == (3, 3)
    assert mine["certified"] == 1.0
    assert 0.0 < mine["residual_max"] < 1e-6
    assert mine["contacts"] == 4.0  # four feet
    assert mine["base_moved"] < 0.01
    assert mine["torn"] < 1e-12
    assert theirs["problems"] == problem
    assert theirs["contacts"] == 4.0
    text = robot_speed.markdown({"peers": [mine, theirs], "refused": [], "absent": {"x": "x: cannot be simulated"}})
    assert ("NOT COMPARED" in text) == bool(problem)
    assert "100.00% certified" in text
    assert "left out: x: cannot" in text


def test_what_is_said_of_another_motion():
    same = {"penetration": 1e-5, "torn": 1e-12, "base": 0.5}
    assert robot_speed.remarks(same, same) == []
    other = {"penetration": 5e-3, "torn": 4e-3, "base": 0.4}
    assert robot_speed.remarks(same, other) == ["5 mm in the ground", "joints torn by 4 mm", "base at 0.40 m, ours 0.50 m"]


@pytest.mark.parametrize(
    ("name", "variant"),
    [
        ("mujoco", "elliptic"),
        pytest.param("mujoco_warp", "pyramidal", marks=pytest.mark.slow),
        pytest.param("newton_xpbd", "2 iterations", marks=pytest.mark.slow),
        pytest.param("newton_steel", "12 sweeps", marks=pytest.mark.slow),
    ],
)
def test_a_robot_falls_alike_in_other_engines(shared, name, variant):
    """They start where we do, and after 20 ms of free fall the base is where ours is, to 0.1 mm."""
    peer = peers.PEERS[name]
    if not peer.installed(peers.FOLDER):
        pytest.skip("the peer's interpreter is not installed")
    falling = robots.dropped("go1", shared / "usd" / robot_speed.FILES["go1"], 2, 2e-3, 10)
    end, _ = robot_speed.record(falling.simulator(device="cpu"), falling)
    with session(peer, peers.FOLDER) as running:
        task = running.make(variant, falling, falling.steps)
        task.repeat()
    assert robot_speed.compare.problems(falling, task) == []
    assert np.abs(task.pose[-1] - end.pose)[:, 0, :3].max() < 1e-4
    assert robots.torn(falling.model, task.pose[-1]) < 1e-4
