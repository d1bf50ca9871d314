# SPDX-License-Identifier: Apache-2.0
"""What acts along joints that close loops: limits, drives, damping and dry friction, against closed forms and the loop cut elsewhere."""

import json

import numpy as np
import pytest
import warp as wp
from conftest import DEVICE, GRAVITY, simulator
from scipy.optimize import brentq
from test_joint_scenes import ALONG, hinge, openings, rod
from test_usd import JOINT, SCENE, layer, load
from test_usd_joints import joint, pair
from warp_lcp.kernels import joint_rows
from warp_lcp.kernels.types import scalar_types

import warp_lcp as wl
from warp_lcp.cli import main
from warp_lcp.joints import about, multiply
from warp_lcp.model import Drive, JointType

pytest.importorskip("pxr", reason="needs the extra 'usd'")

CRANK, CRANK_MASS, COUPLER_MASS = 0.4, 0.5, 2.0
INERTIA = (2 * CRANK_MASS / 3 + COUPLER_MASS) * CRANK**2  # of the parallelogram, by its crank's angle
WEIGHT = (COUPLER_MASS + CRANK_MASS) * CRANK * GRAVITY  # N m at a right angle


def parallelogram(lean: float, elsewhere: bool = False, gravity: bool = True, **options) -> wl.Model:
    """Two cranks and a coupler that stays level; `options` act along the hinge of coupler and second crank, whose angle is the crank's.

    That hinge closes the loop or, `elsewhere`, the second crank's on the ground does.
    """
    builder = wl.ModelBuilder() if gravity else wl.ModelBuilder(gravity=(0, 0, 0))
    feet, up = np.array([[0.0, 0, 0], [1.0, 0, 0]]), CRANK * np.array([np.sin(lean), 0, np.cos(lean)])
    bodies = [rod(builder, foot, foot + up, CRANK_MASS) for foot in feet]
    bodies.append(rod(builder, feet[0] + up, feet[1] + up, COUPLER_MASS))
    place = {bodies[0]: feet[0] + 0.5 * up, bodies[1]: feet[1] + 0.5 * up, bodies[2]: feet.mean(axis=0) + up}
    hinge(builder, -1, bodies[0], feet[0], "y", place)
    hinge(builder, -1, bodies[1], feet[1], "y", place, loop=elsewhere)
    hinge(builder, bodies[0], bodies[2], feet[0] + up, "y", place)
    hinge(builder, bodies[2], bodies[1], feet[1] + up, "y", place, loop=not elsewhere, name="hinge", **options)
    return builder.finalize()


def turned(model: wl.Model, seconds: float, h: float, rate: float = 0.0) -> np.ndarray:
    """[T, 2] angle of the first crank from its start and angular velocity, all steps certified."""
    sim = simulator(model, dt=h)
    sim.v.assign(rate * np.array([[-1.0 if name == "joint2" else 1.0 for name in model.dof_names]]))  # the coupler's turns it back
    moved = sim.rollout(round(seconds / h), record=("q", "v", "status", "residual"))
    assert not moved.status.numpy().any()
    assert moved.residual.numpy().max() < 1e-6
    return np.stack([moved.q.numpy()[:, 0, 0], moved.v.numpy()[:, 0, 0]], axis=1)


def test_a_part_of_a_body_is_carried():
    """Mass and centre stay those of the whole; the scene's bodies are told apart from parts."""
    plain, acting = parallelogram(0.2), parallelogram(0.2, damping=0.1)
    assert (plain.num_bodies, acting.num_bodies) == (3, 4)
    assert acting.part_of.tolist() == [0, 1, 2, 1]
    assert acting.scene_bodies.tolist() == [0, 1, 2]
    assert acting.mass.tolist() == [CRANK_MASS, CRANK_MASS / 2, COUPLER_MASS, CRANK_MASS / 2]
    assert acting.inertia[1] == pytest.approx(0.5 * plain.inertia[1])
    assert acting.inertia[3] == pytest.approx(0.5 * plain.inertia[1])
    assert acting.dof_names[-1] == "hinge"
    (weld,) = acting.loops
    assert (weld.bodies, weld.ways, weld.turns) == ((1, 3), (True,) * 3, (True,) * 3)
    assert "hinge: closes a loop" in " ".join(acting.report.notes)
    assert not plain.report.notes


def test_loops_are_cut_where_nothing_acts():
    """If a joint of the loop only holds, it is the one that closes the loop, and no body is parted."""
    builder = wl.ModelBuilder()
    bodies = [builder.add_body(pose=(x, 0, 0, 0, 0, 0, 1), mass=1.0, inertia=np.eye(3)) for x in (0.0, 1.0, 2.0)]
    place = {body: np.array([x, 0.0, 0.0]) for body, x in zip(bodies, (0.0, 1.0, 2.0), strict=True)}
    ends = [(-1, 0, 0.0), (-1, 2, 2.0), (0, 1, 0.5), (1, 2, 1.5)]
    for k, (a, b, x) in enumerate(ends):
        hinge(builder, a, b, np.array([x, 0, 0]), "y", place, damping=0.1 * (k in (0, 2, 3)), name=str(k))
    model = builder.finalize()
    assert model.num_bodies == 3
    assert [loop.name for loop in model.loops] == ["1"]
    assert model.damping.tolist() == [0.1] * 3


@pytest.mark.parametrize("elsewhere", [False, True])
def test_limit_of_what_closes_a_loop(elsewhere):
    """The mechanism falls until the limit holds it, at 0.5 rad but for what limits and loops give under 20 N: 1e-10 m a N and 0.1 kg."""
    path = turned(parallelogram(0.2, elsewhere, limit=(-1.0, 0.5), damping=0.05), 3.0, 2e-3)
    assert path[-1, 0] == pytest.approx(0.5, abs=1e-7)
    assert abs(path[-1, 1]) < 1e-9
    assert path[:, 0].max() < 0.5 + 5e-6  # the impact: a thousandth of the way of a step


@pytest.mark.parametrize("elsewhere", [False, True])
def test_drive_of_what_closes_a_loop(elsewhere):
    """It stands where the spring of the drive and the weight agree, a root of one equation."""
    k = 40.0
    known = brentq(lambda x: WEIGHT * np.sin(0.2 + x) - k * (x - 0.1), 0.0, 1.0, xtol=1e-14)
    path = turned(parallelogram(0.2, elsewhere, drive=Drive(k, 8.0, np.inf, 0.1)), 6.0, 5e-3)
    assert path[-1, 0] == pytest.approx(known, abs=1e-7)
    assert abs(path[-1, 1]) < 1e-8


@pytest.mark.parametrize(("share", "holds"), [(1.02, True), (0.98, False)])
def test_drive_of_limited_force_holds_a_loop_or_does_not(share, holds):
    """With 1.02 times the torque of its weight it stands; with 0.98 times it falls, I x'' = W sin(lean + x) - F, here linear in x."""
    model = parallelogram(0.2, drive=Drive(1e6, 1e5, share * WEIGHT * np.sin(0.2)))
    path = turned(model, 0.2, 1e-3)
    if holds:
        assert np.abs(path[:, 0]).max() < 1e-5  # what its spring gives
    else:
        rate = np.sqrt(WEIGHT * np.cos(0.2) / INERTIA)
        known = 0.02 * WEIGHT * np.sin(0.2) / INERTIA * np.sinh(rate * 0.2) / rate
        assert path[-1, 1] == pytest.approx(known, rel=5e-3)


@pytest.mark.parametrize("what", ["friction", "damping"])
def test_friction_and_damping_of_what_closes_a_loop(what):
    """Without weight: dry friction stops it after w I / F and an angle of w^2 I / 2 F, damping lets w fall as exp(-b t / I).

    Of first order: dry friction stops in the middle of a step, w h at most; damping is implicit, b / I h of w.
    """
    rate, amount = 1.0, 0.5
    for h in (4e-3, 2e-3, 1e-3):
        path = turned(parallelogram(-0.5, gravity=False, **{what: amount}), 1.5, h, rate)
        if what == "friction":
            assert path[-1, 0] == pytest.approx(rate**2 * INERTIA / (2 * amount), abs=0.6 * rate * h)
            assert abs(path[-1, 1]) < 1e-8
        else:
            assert path[-1, 1] == pytest.approx(rate * np.exp(-amount * 1.5 / INERTIA), abs=2.0 * h)


def test_where_the_loop_is_cut_makes_no_difference():
    """A swinging mechanism, driven, damped and limited, cut at one hinge or another: apart by what comes back of an impact."""
    options = {"drive": Drive(30.0, 0.5, 12.0, 0.3), "limit": (-0.6, 0.9), "friction": 0.05}
    for h in (2e-3, 5e-4):
        paths = [turned(parallelogram(0.3, elsewhere, **options), 1.0, h)[:, 0] for elsewhere in (False, True)]
        assert np.ptp(paths[0]) > 0.5
        assert np.abs(paths[0] - paths[1]).max() < 3e-4


@pytest.mark.parametrize("elsewhere", [False, True])
def test_what_closes_a_loop_does_not_throw_back_an_impact(elsewhere):
    """At 1 rad/s against a limit, which stops it: 3e-4 come back, at any step. (Of loops of Table 1's stiffness an eighth at 0.1 ms.)"""
    model = parallelogram(-0.5, elsewhere, gravity=False, limit=(-1.0, 0.3))
    for h in (1e-2, 1e-3, 1e-4):
        assert abs(turned(model, 0.9, h, 1.0)[-1, 1]) < 4e-4


def test_the_weld_stays_closed():
    """A part parts from its whole as little as a loop opens, 1e-6 m, and under 1e-8 m where loops are projected."""
    model = parallelogram(0.3, limit=(-0.6, 0.9))
    for options, most in (({}, 2e-5), ({"project_loops": True}, 1e-8)):
        moved = simulator(model, dt=1e-3, **options).rollout(1000, record=("body_pose", "status"))
        assert not moved.status.numpy().any()
        assert openings(model, moved)[1:].max() < most


def test_stacked_axes_may_close_a_loop():
    """Damped ways in a plane beside the hinge that lets a pendulum move in it: as a hinge whose damper acts on the arm of its centre."""
    h, damping, paths = 1e-3, 0.7, []
    for stacked in (True, False):
        builder = wl.ModelBuilder()
        bob = builder.add_body(pose=(0.5, 0, 0, 0, 0, 0, 1), mass=1.0, inertia=0.02 * np.eye(3))
        place = {bob: np.array([0.5, 0, 0])}
        hinge(builder, -1, bob, np.zeros(3), "y", place, damping=0.0 if stacked else damping * 0.5**2)
        if stacked:
            axes = [("t", (1, 0, 1)), ("t", (1, 0, -1)), ("r", (0, 1, 0))]
            frame = (0.5, 0, 0, 0, 0, 0, 1)
            builder.add_joint(JointType.D6, -1, bob, parent_frame=frame, axes=axes, damping=(damping, damping, 0.0), loop=True)
        sim = simulator(builder, dt=h)
        moved = sim.rollout(1000, record=("q", "status"))
        assert not moved.status.numpy().any()
        paths.append(moved.q.numpy()[:, 0, 0])
    assert np.abs(paths[0]).max() > 1.0
    assert paths[0] == pytest.approx(paths[1], abs=2.0 * h)


def bars(*masses: float | None) -> tuple[wl.ModelBuilder, dict[int, np.ndarray]]:
    """Bodies in a row, a metre apart, of these masses; None: nothing says, a joint holds it. And where they are."""
    builder = wl.ModelBuilder()
    for k, mass in enumerate(masses):
        builder.add_body(f"b{k}", pose=(k, 0, 0, 0, 0, 0, 1), mass=mass, inertia=np.eye(3) if mass else None)
    return builder, {k: np.array([k, 0.0, 0.0]) for k in range(len(masses))}


def closed(builder: wl.ModelBuilder, place: dict[int, np.ndarray], ends: list[tuple[int, int]], weld: int, **options) -> wl.Model:
    """Finalized, with a hinge half-way between each two bodies but for one weld; `options` act along the hinges."""
    for k, (a, b) in enumerate(ends):
        at = 0.5 * (place.get(a, np.array([-1.0, 0, 0])) + place.get(b, np.array([len(place), 0.0, 0])))
        if k == weld:
            frames = [(*(at - place[body]), 0, 0, 0, 1) for body in (a, b)]
            builder.add_joint(JointType.FIXED, a, b, parent_frame=frames[0], child_frame=frames[1])
        else:
            hinge(builder, a, b, at, "y", place, name=f"h{k}", **options)
    return builder.finalize()


def test_welds_carry_before_hinges_along_which_something_acts():
    """A frame without mass that is welded to a bar: cut at the weld it would hang on a hinge that nothing makes inert."""
    model = closed(*bars(2.0, None, 1.0), [(-1, 0), (0, 1), (1, 2), (2, -1)], weld=1, limit=(-1.0, 1.0))
    assert model.body_parent.tolist() == [-1, 0, -1, 1]
    sim = simulator(model)
    sim.step(10)
    assert not sim.status.numpy().any()


def test_what_is_welded_to_the_world_stays_there():
    """A damped hinge between two bodies that the world holds neither moves nor parts them."""
    builder, place = bars(1.0, 1.0, 1.0)
    for body in (0, 1):
        builder.add_joint(JointType.FIXED, -1, body, parent_frame=(*place[body], 0, 0, 0, 1))
    hinge(builder, 0, 1, np.array([0.5, 0, 0]), "y", place, damping=0.1, name="idle")
    model = builder.finalize()
    assert model.movable.tolist() == [False, False, True, False]
    assert model.num_bodies == 3
    assert any(note.startswith("idle: closes a loop between bodies that forces do not move") for note in model.report.notes)


def test_a_body_without_mass_carries_on():
    """Between two hinges that meet in it, one plain, all others damped: both carry, and another one is cut."""
    builder, place = bars(1.0, 0.0, 1.0, 1.0)
    for k, (a, b) in enumerate([(-1, 0), (0, 1), (1, 2), (2, 3), (3, -1)]):
        at = 0.5 * (place.get(a, np.array([-1.0, 0, 0])) + place.get(b, np.array([4.0, 0, 0])))
        hinge(builder, a, b, at, "xyzyx"[k], place, damping=0.0 if k == 2 else 0.1, name=f"h{k}")
    model = builder.finalize()
    assert model.body_parent[[1, 2]].tolist() == [0, 1]
    assert [loop.name for loop in model.loops] == ["h3:weld"]


def test_a_joint_that_carries_nothing_with_mass():
    """Two frames that are welded together and that nobody gave a mass: M would be singular, unless the joint has an armature."""
    for armature in (0.0, 0.1):
        builder, place = bars(1.0, None, None)
        hinge(builder, -1, 0, np.zeros(3), "y", place)
        hinge(builder, 0, 1, np.array([0.5, 0, 0]), "y", place, name="empty", armature=armature)
        builder.add_joint(JointType.FIXED, 1, 2, parent_frame=(1, 0, 0, 0, 0, 0, 1))
        if armature:
            builder.finalize()
        else:
            with pytest.raises(wl.WarpLcpError, match="empty: nothing that it carries has mass; give b1 some, or the joint an armature"):
                builder.finalize()


def test_two_joints_may_part_one_body():
    """In equal shares, whatever the number; and what asks for accelerations sees all of the body."""
    drive = Drive(10.0, 1.0, acceleration=True)
    plain, parted = bars(1.0, 2.0), bars(1.0, 2.0)
    for builder, place in (plain, parted):
        hinge(builder, -1, 0, np.array([-0.5, 0, 0]), "y", place)
        hinge(builder, 0, 1, np.array([0.5, 0, 0]), "y", place, drive=drive)
    for name in "ab":
        hinge(*(parted[0], 0, 1, np.array([0.5, 0, 0]), "y", parted[1]), damping=0.1, loop=True, name=name)
    model = parted[0].finalize()
    assert model.mass == pytest.approx([1.0, 2 / 3, 2 / 3, 2 / 3])
    assert model.part_of.tolist() == [0, 1, 1, 1]
    assert model.drive[1] == pytest.approx(plain[0].finalize().drive[1])


@pytest.mark.parametrize("loop", [False, True])
def test_angles_start_within_their_limits(loop):
    """Where a body stands tells an angle but for whole turns: of 3.2 and 3.2 - 2 pi the one that the limit allows. Nothing moves then."""
    builder = wl.ModelBuilder(gravity=(0, 0, 0))
    turn = np.array([0, np.sin(1.6), 0, np.cos(1.6)])
    body = builder.add_body(pose=(0, 0, 0, *turn), mass=1.0, inertia=np.eye(3))
    builder.add_joint(JointType.D6, -1, body, axes=("ry",))
    if loop:
        builder.add_joint(JointType.D6, -1, body, axes=("ry",), limit=(2.9, 3.5), start=3.0, start_velocity=5.0, loop=True)
    else:
        builder = wl.ModelBuilder(gravity=(0, 0, 0))
        body = builder.add_body(pose=(0, 0, 0, *turn), mass=1.0, inertia=np.eye(3))
        builder.add_joint(JointType.D6, -1, body, axes=("ry",), limit=(2.9, 3.5))
    model = builder.finalize()
    assert model.q0[-1] == pytest.approx(3.2)
    sim = simulator(model)
    sim.step(10)
    assert np.abs(sim.v.numpy()).max() < 1e-9


# --------------------------------------------------------------------------------------------------------------------- USD


def loop_stage() -> list[str]:
    """A joint that closes a loop beside the hinge between A and B, with a limit of 10 degrees."""
    frames = "point3f physics:localPos0 = (0.5, 0, 0); point3f physics:localPos1 = (-0.5, 0, 0);"
    content = JOINT + frames + "bool physics:excludeFromArticulation = 1; float physics:lowerLimit = -180; float physics:upperLimit = 10;"
    return [*pair("Revolute"), joint("Revolute", content, name="K")]


def test_excluded_joint_with_a_limit():
    """Both turn about the same axis: the limit of the one that closes the loop holds the other."""
    model = load(*loop_stage())
    assert model.body_names == ("/A", "/B", "/K:part")
    assert np.degrees(model.limit[-1]) == pytest.approx([-180, 10])
    sim = simulator(model, dt=2e-3)
    sim.v.assign(np.r_[np.zeros(6), 1.0, 1.0][None])
    sim.step(100)
    assert np.degrees(sim.q.numpy()[0, 7:]) == pytest.approx([10, 10], abs=1e-3)  # 3e-4 of the impact comes back
    assert not sim.status.numpy().any()


def test_parts_of_bodies_on_the_command_line(capsys, tmp_path):
    """info lists joints and bodies of the scene, with their whole mass; --out holds them alone."""
    scene, out = tmp_path / "loop.usda", tmp_path / "out.npz"
    scene.write_text(layer(SCENE, *loop_stage()))
    assert main(["info", str(scene), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [(b["name"], b["mass"]) for b in facts["bodies"]] == [("/A", 2.0), ("/B", 2.0)]
    assert [(j["name"], j["from"], j["to"], j["loop"]) for j in facts["joints"]] == [("/J", "/A", "/B", False), ("/K", "/A", "/B", True)]
    assert facts["joint_row_kinds"] == {"limits": 2, "drives": 0, "friction": 0, "loops": 6, "distances": 0}
    assert main(["run", str(scene), "--duration", "0.01", "--device", "cpu", "--out", str(out), "--json"]) == 0
    capsys.readouterr()
    saved = np.load(out)
    assert saved["body_names"].tolist() == ["/A", "/B"]
    assert saved["pose"].shape[2] == saved["velocity"].shape[2] == 2


def test_boxes_fourbar_of_kamino(shared):
    """All four hinges have limits of 45 degrees, the one that closes the loop too. Angles around the loop add up to nothing."""
    model = wl.load_usd(shared / "usd/newton/kamino_boxes_fourbar.usda")
    assert (len(model.scene_bodies), model.num_bodies, len(model.loops)) == (4, 5, 1)
    assert np.degrees(model.limit[6:]) == pytest.approx(np.tile([-45.0, 45.0], (4, 1)), rel=1e-6)
    sim = simulator(model, dt=2e-3)
    moved = sim.rollout(1000, record=("q", "status", "body_pose"))
    assert not moved.status.numpy().any()
    assert openings(model, moved)[1:].max() < 1e-5
    angles = dict(zip(model.dof_names[6:], moved.q.numpy()[:, 0, 7:].T, strict=True))
    first, second, third, fourth = (angles[f"/boxes_fourbar/Joints/joint_{k}"] for k in (1, 2, 3, 4))
    assert np.abs([first, second, third, fourth]).max() < np.radians(45) + 1e-6
    assert np.abs(first + second + third + fourth).max() < 1e-5


# ------------------------------------------------------------------------------------------------- loops that are open


def chain_between(gap: np.ndarray, axis: str = "y", **options) -> wl.ModelBuilder:
    """Two links of 0.5 m from a hinge on the world, in line along x; a hinge on the world, `gap` from their end, closes the loop."""
    builder, ends = wl.ModelBuilder(gravity=(0, 0, 0)), np.array([[0.0, 0, 1], [0.5, 0, 1], [1.0, 0, 1]])
    bodies = [rod(builder, ends[k], ends[k + 1], 1.0) for k in range(2)]
    place = {body: ends[k : k + 2].mean(axis=0) for k, body in enumerate(bodies)}
    hinge(builder, -1, bodies[0], ends[0], axis, place)
    hinge(builder, *bodies, ends[1], axis, place)
    frames = [(*(ends[2] + gap), *ALONG[axis]), (0.25, 0, 0, *ALONG[axis])]
    builder.add_joint(JointType.REVOLUTE, -1, bodies[1], parent_frame=frames[0], child_frame=frames[1], loop=True, name="last", **options)
    return builder


@pytest.mark.parametrize("options", [{}, {"damping": 0.1}])
@pytest.mark.parametrize(("gap", "stays"), [((0.5, 0, 0), 0.5), ((0, 0.3, 0), 0.3), ((-0.1, 0, 0), 0.0)])
def test_a_loop_that_is_open_is_told(gap, stays, options):
    """Too far along the chain, beside it, or within reach: then a second closes it. How far it is open is there to be asked for."""
    builder = chain_between(np.array(gap), **options)
    sim = simulator(builder, num_envs=2, dt=1e-3)
    told = [note for note in sim.model.report.notes if "open at the start" in note]
    assert len(told) == 1
    assert told[0].startswith(f"last: a loop that is open at the start, by {np.linalg.norm(gap):.3g} m:")
    assert sim.loop_gaps() == pytest.approx(np.broadcast_to([np.linalg.norm(gap), 0.0], (2, 1, 2)), abs=1e-12)
    sim.v.assign(np.tile(np.array([0.1, -0.2] + [0.0] * (sim.model.nv - 2)), (2, 1)))  # away from the line, along which nothing pulls
    sim.step(1000)
    assert stays - 1e-6 <= sim.loop_gaps()[..., 0].max() <= stays + 0.1
    if stays == 0.0:
        assert sim.loop_gaps().max() < 1e-5


@pytest.mark.parametrize("gap", [(1e-4, 0, 0), (0.01, 0, 0), (0.5, 0, 0), (0.3, 0, 0.2), (-0.1, 0, 0.1)])
@pytest.mark.parametrize("h", [1e-3, 5e-3])
def test_a_loop_at_its_dead_point_does_not_run_away(gap, h):
    """Short by a little, by a lot or within reach, in line or not: links of 0.5 m that are pulled at 3 m/s by levers of 0.1 m turn at
    30 rad/s, and half as fast again is allowed. It was up to 39,000 rad/s, 888 for the tenth of a millimetre."""
    sim = simulator(chain_between(np.array(gap)), dt=h)
    sim.v.assign(np.array([[0.1, -0.2]]))
    moved = sim.rollout(round(2.0 / h), record=("v", "status"))
    assert not moved.status.numpy().any()
    assert np.abs(moved.v.numpy()).max() < 45.0


@pytest.mark.parametrize("real", [wp.float64, wp.float32])
@pytest.mark.parametrize("rank", [1, 2, 3])
def test_damped_pull(real, rank):
    """W (W + lambda)^-1 p of mobilities that are oblique to the rows, down to the least lambda that there is, a millionth of W: what rounds
    off of p lies where W gives nothing, and only lambda holds it there."""
    rng, n = np.random.default_rng(rank), 200
    damped, t = joint_rows.functions(real).damped, scalar_types(real)

    @wp.kernel(module="unique", enable_backward=False)
    def pull(w: wp.array(dtype=t.mat33), damping: wp.array(dtype=real), p: wp.array(dtype=t.vec3), result: wp.array(dtype=t.vec3)):
        i = wp.tid()
        result[i] = damped(w[i], damping[i], p[i])

    basis = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0][:, :, :rank]
    gives = 10.0 ** rng.uniform(-1, 0, (n, rank))
    w = (basis * gives[:, None]) @ np.swapaxes(basis, 1, 2)
    p = np.einsum("nij,nj->ni", basis, rng.normal(size=(n, rank)))
    damping = 10.0 ** rng.uniform(-6, 0, n)
    exact = np.einsum("nij,nj->ni", basis, gives / (gives + damping[:, None]) * np.einsum("nij,ni->nj", basis, p))
    arrays = [wp.array(x, dtype=kind, device=DEVICE) for x, kind in ((w, t.mat33), (damping, real), (p, t.vec3))]
    result = wp.empty(n, dtype=t.vec3, device=DEVICE)
    wp.launch(pull, dim=n, inputs=[*arrays, result], device=DEVICE)
    error = np.linalg.norm(result.numpy() - exact, axis=1) / np.linalg.norm(p, axis=1)
    assert error.max() < 50.0 * np.finfo(wp.dtype_to_numpy(real)).eps / damping.min()


def test_a_light_rod_closes_its_loop_as_fast_as_a_heavy_one():
    """A crank of 10 kg at 20 rad/s and a rocker: a step opens the hinge of their coupler by h^2 w^2 r / 2 = 0.08 mm, which the next one has
    to close, whatever it weighs. (Measured by the mobility of the rod alone, a loop with 1 g is pulled so gently that it opens by 5 mm.)"""
    opened = []
    for mass in (10.0, 1e-3):
        builder, feet = wl.ModelBuilder(gravity=(0, 0, 0)), np.array([[0.0, 0, 0], [1.0, 0, 0]])
        tips = feet + np.array([[0, 0, 0.4], [0, 0, 0.5]])
        bodies = [rod(builder, foot, tip, 10.0) for foot, tip in zip(feet, tips, strict=True)]
        bodies.append(rod(builder, *tips, mass))
        place = {bodies[0]: (feet[0] + tips[0]) / 2, bodies[1]: (feet[1] + tips[1]) / 2, bodies[2]: tips.mean(axis=0)}
        hinge(builder, -1, bodies[0], feet[0], "y", place)
        hinge(builder, -1, bodies[1], feet[1], "y", place)
        hinge(builder, bodies[0], bodies[2], tips[0], "y", place)
        hinge(builder, bodies[2], bodies[1], tips[1], "y", place, loop=True)
        sim = simulator(builder, dt=1e-3)
        sim.v.assign(20.0 * np.array([[1.0, 0.8, -1.0]]))  # as far as the loop lets them
        gaps = []
        for _ in range(500):
            sim.step()
            gaps.append(sim.loop_gaps()[0, 0, 0])
        assert not sim.status.numpy().any()
        opened.append(max(gaps))
    assert opened[1] < 2.0 * opened[0] < 1e-3


def test_a_loop_that_is_closed_is_not_told():
    assert not chain_between(np.zeros(3)).finalize().report.notes


def test_a_distance_out_of_its_range_is_told():
    builder = wl.ModelBuilder()
    ball = builder.add_body(pose=(0, 0, 2, 0, 0, 0, 1), mass=1.0, inertia=np.eye(3))
    builder.add_distance(-1, ball, 0.5, 1.5, name="rope")
    model = builder.finalize()
    assert model.report.notes[0].startswith("rope: a distance out of its range at the start, by 0.5 m:")
    assert wl.Simulator(model, device="cpu").loop_gaps() == pytest.approx(np.array([[[0.5, 0.0]]]))


@pytest.mark.parametrize(
    ("axes", "turn", "expected"), [((), (0.3, 0, 0), 0.3), (("rx",), (0.3, 0.2, 0), 0.2), (("rx", "ry"), (0, 0, 0.4), 0.4)]
)
def test_how_far_a_loop_is_turned(axes, turn, expected):
    """A weld by the angle of the rotation, a hinge by that between its axes, two free axes by what they lack of a right angle."""
    builder = wl.ModelBuilder()
    q = multiply(about(0, turn[0]), multiply(about(1, turn[1]), about(2, turn[2])))
    builder.add_body(pose=(0, 0, 0, *q), mass=1.0, inertia=np.eye(3))
    builder.add_joint(JointType.D6 if axes else JointType.FIXED, -1, 0, axes=axes or None, loop=True)
    sim = wl.Simulator(builder.finalize(), device="cpu")
    assert sim.loop_gaps()[0, 0] == pytest.approx([0.0, expected], abs=1e-12)
