# SPDX-License-Identifier: Apache-2.0
"""The command line: what info lists, what run writes, and that bad input ends with one clear line."""

import builtins
import functools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from warp_lcp import scenes
from warp_lcp.cli import SAMPLES, Tally, bytes_per_env, main
from warp_lcp.laws import FORMULATIONS, Law

pytest.importorskip("pxr", reason="needs the extra 'usd'")

ROOT = Path(__file__).resolve().parents[1]
OPENUSD = ROOT.parent / "shared" / "usd" / "openusd"
PILL = """def Capsule "Pill" (prepend apiSchemas = ["PhysicsCollisionAPI"])
{
    double3 xformOp:scale = (1, 1, 2)
    uniform token[] xformOpOrder = ["xformOp:scale"]
}
"""
PHYSICS = 'def PhysicsScene "Scene" {}\n'
BOX = """def Cube "Box" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI"])
{
    float physics:mass = %s
    double size = 0.2
}
"""
HEADER = '#usda 1.0\n(\n    metersPerUnit = 1\n    kilogramsPerUnit = 1\n    upAxis = "Z"\n)\n'
#: Of the eight examples of OpenUSD: bodies and what keeps them from being simulated.
OPENUSD_SCENES = {
    "usdPhysicsBoxOnBox": 1,
    "usdPhysicsBoxOnQuad": 1,
    "usdPhysicsDistanceJoint": 1,
    "usdPhysicsGroupFiltering": 2,
    "usdPhysicsJoints": 1,
    "usdPhysicsNestedArticulation": 2,
    "usdPhysicsPairFiltering": 2,
    "usdPhysicsSpheresWithMaterial": 2,
}


def run(*arguments):
    return main(["run", *map(str, arguments), "--device", "cpu"])


def summary(capsys, *arguments):
    assert run(*arguments, "--json") == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


def python(*arguments, **options):
    """``python -m warp_lcp`` in a process of its own."""
    command = [sys.executable, "-m", "warp_lcp", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, **options)


def info(capsys, scene, *options):
    assert main(["info", str(scene), "--json", *map(str, options)]) == 0
    return json.loads(capsys.readouterr().out)


# ----------------------------------------------------------------------------------------------------------------- info


def test_info_of_the_paper_box(capsys):
    facts = info(capsys, "box_on_ground")
    assert facts["bodies"] == [{"name": "/World/Box", "joint": "free", "mass": 1.0, "dofs": 6}]
    assert facts["shapes"][0] == {"name": "/World/Box/Geometry", "type": "box", "body": "/World/Box"}
    assert facts["shapes"][1]["body"] is None
    assert facts["pairs"] == [["/World/Ground", "/World/Box/Geometry"]]
    assert (facts["dofs"], facts["mass"], facts["gravity"], facts["joints"]) == (6, 1.0, [0.0, 0.0, -9.81], [])
    assert (facts["contact_slots"], facts["max_contacts"], facts["largest_lcp"]) == (8, 8, 40)
    assert (facts["simulable"], facts["ignored"], facts["unsupported"]) == (True, [], [])


@pytest.mark.parametrize(
    ("formulation", "sliding", "directions", "unknowns", "friction"),
    [
        (
            "phantom_inertia",
            "regularized",
            2,
            40,
            "phantom_inertia, regularized: isotropic while sliding; the limit of a sticking contact is ",
        ),
        ("phantom_inertia", "aligned", 3, 56, "(k = 3: at most +15 % elsewhere)"),
        (
            "phantom_inertia",
            "facets",
            2,
            40,
            "around the cone, from world x, +41 % friction between directions (stops up to 29 % too early)",
        ),
        ("phantom_inertia", "facets", 8, 136, "+2 % friction between directions (stops up to 1.9 % too early)"),
        (
            "anitescu_potra",
            "regularized",
            2,
            48,
            "within the cone, from world x, -29 % friction between directions (stops up to 41 % too far)",
        ),
        ("anitescu_potra", "regularized", 4, 80, "-7.6 % friction between directions (stops up to 8.2 % too far)"),
        ("box", "regularized", 2, 40, "(stops up to 29 % too early); limits follow the normal force of the step before"),
        ("hybrid", "regularized", 2, 40, "hybrid: isotropic while sliding; "),
        ("coulomb", "regularized", 2, None, "coulomb: exact"),
    ],
)
def test_info_is_about_the_law_that_would_run(capsys, formulation, sliding, directions, unknowns, friction):
    options = {"formulation": formulation, "sliding": sliding, "directions": directions}
    facts = info(capsys, "box_on_ground", *(f"--{name}={value}" for name, value in options.items()))
    model = wl.load_usd("box_on_ground")
    sim = wl.Simulator(model, device="cpu", **options)
    assert sorted(facts["kernels"]) == sorted(kernel.key.rpartition("__")[2] for kernel in sim.kernels)
    assert facts["bytes_per_env"] == bytes_per_env(model, Law(**options))
    assert facts["largest_lcp"] == unknowns
    assert friction in facts["friction"]
    assert main(["info", "box_on_ground", *(f"--{name}={value}" for name, value in options.items())]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert " ".join(facts["friction"].split()) in text
    assert ("none, the cone itself" if unknowns is None else f"{unknowns} unknowns") in text


@pytest.mark.parametrize(("option", "value"), [("--formulation", "magic"), ("--sliding", "magic"), ("--directions", "1")])
def test_info_refuses_laws_that_there_are_not(capsys, option, value):
    assert f"{option.strip('-')} is" in error_line(capsys, "info", "box_on_ground", option, value)


@pytest.mark.parametrize("scene", scenes.names())
def test_info_of_shipped_scenes(capsys, scene):
    facts = info(capsys, scene)
    assert facts["simulable"]
    assert facts["obstacle"] is None
    assert facts["dofs"] == sum(body["dofs"] for body in facts["bodies"]) > 0
    assert facts["joints"] or all(body["dofs"] == 6 for body in facts["bodies"])
    assert sum(body["mass"] or 0.0 for body in facts["bodies"]) == pytest.approx(facts["mass"])
    assert main(["info", scene]) == 0
    text = capsys.readouterr().out
    assert all(body["name"] in text for body in facts["bodies"])


@pytest.mark.skipif(not OPENUSD.is_dir(), reason="reference scenes beside the repository are absent")
@pytest.mark.parametrize(("scene", "bodies"), OPENUSD_SCENES.items())
def test_info_lists_scenes_made_elsewhere(capsys, scene, bodies):
    facts = info(capsys, OPENUSD / f"{scene}.usda")
    assert len(facts["bodies"]) == bodies
    assert facts["mass"] > 0.0
    assert facts["simulable"] == (not facts["unsupported"])
    for item in facts["ignored"] + facts["unsupported"]:
        assert set(item) == {"path", "what", "why"}
        assert all(item.values())
    assert main(["info", str(OPENUSD / f"{scene}.usda")]) == 0
    assert "/" in capsys.readouterr().out


def test_info_lists_what_cannot_be_simulated(capsys, tmp_path):
    scene = tmp_path / "pill.usda"
    hinge = 'def PhysicsRevoluteJoint "Hinge" {\nrel physics:body0 = </Box>\n}\n'
    scene.write_text(HEADER + PHYSICS + BOX % 2 + hinge + PILL)
    facts = info(capsys, scene)
    assert (facts["simulable"], facts["dofs"], facts["pairs"], facts["joints"]) == (False, None, None, [{"name": "/Hinge", "type": None}])
    assert facts["bodies"][0]["name"] == "/Box"
    assert facts["unsupported"][0]["path"] == "/Pill"
    assert main(["info", str(scene)]) == 0
    text = capsys.readouterr().out
    assert "cannot be simulated" in text
    assert "/Pill" in text


def test_info_lists_joints(capsys, tmp_path):
    scene = tmp_path / "joint.usda"
    scene.write_text(HEADER + PHYSICS + BOX % 2 + 'def PhysicsRevoluteJoint "Hinge" {\nrel physics:body0 = </Box>\n}')
    facts = info(capsys, scene)
    assert facts["joints"][0]["axes"][0].pop("axis") == pytest.approx([-1, 0, 0], abs=1e-15)  # the world is its second body
    axis = {"name": "/Hinge", "kind": "angle", "limit": None, "start": 0.0, "drive": None}
    ends = {"from": None, "to": "/Box", "loop": False, "held": None, "distance": None}
    hinge = {"name": "/Hinge", "type": "revolute", **ends, "axes": [axis | {"armature": 0.0, "damping": 0.0, "friction": 0.0}]}
    assert (facts["simulable"], facts["dofs"], facts["joints"]) == (True, 1, [hinge])
    assert (facts["bodies"][0]["joint"], facts["bodies"][0]["dofs"]) == ("revolute", 1)


def test_info_of_what_acts_along_joints(capsys, tmp_path):
    """A drive of limited force, friction, damping, a limit on one side, a loop and a distance: in JSON, in the table, as rows."""
    box = BOX % 2
    bodies = "".join(box.replace('"Box"', f'"{name}"') for name in "ABC")
    ends = "rel physics:body0 = <%s>\nrel physics:body1 = <%s>\n"
    drive = "float drive:angular:physics:stiffness = 2\nfloat drive:angular:physics:maxForce = 5\n"
    drive += "float drive:angular:physics:targetPosition = 90\nfloat newton:friction = 0.25\nfloat newton:damping = 0.1\n"
    scene = tmp_path / "joints.usda"
    scene.write_text(
        HEADER
        + PHYSICS
        + bodies
        + f'def PhysicsRevoluteJoint "AB" (prepend apiSchemas = ["PhysicsDriveAPI:angular"]) {{\n{ends % ("/A", "/B")}{drive}}}\n'
        + f'def PhysicsPrismaticJoint "x:y" {{\n{ends % ("/B", "/C")}float physics:upperLimit = 0.5\n}}\n'.replace("x:y", "BC")
        + f'def PhysicsSphericalJoint "CA" {{\n{ends % ("/C", "/A")}bool physics:excludeFromArticulation = 1\n}}\n'
        + f'def PhysicsDistanceJoint "D" {{\n{ends % ("/A", "/C")}float physics:maxDistance = 3\n}}\n'
    )
    facts = info(capsys, scene)
    first, second, third, fourth = facts["joints"]
    (axis,) = first["axes"]
    assert axis["drive"]["stiffness"] == pytest.approx(2 * 180 / np.pi)
    assert (axis["drive"]["max_force"], axis["drive"]["target"]) == (5.0, pytest.approx(np.pi / 2))
    assert (axis["friction"], axis["damping"]) == (0.25, pytest.approx(0.1 * 180 / np.pi))
    assert (second["type"], second["axes"][0]["limit"]) == ("prismatic", [None, 0.5])
    assert (third["type"], third["held"], third["loop"]) == ("loop", ["tx", "ty", "tz"], True)
    assert (fourth["type"], fourth["distance"]) == ("distance", [0.0, 3.0])
    assert facts["joint_row_kinds"] == {"limits": 1, "drives": 1, "friction": 1, "loops": 3, "distances": 1}
    assert main(["info", str(scene)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "k 114.6, b 0 to 1.571 rad, at most 5 N m" in text
    assert ".. 0.5 m" in text
    assert "holds tx ty tz" in text
    assert "4 of joints: 1 limits, 1 drives, 1 friction, 3 loops, 1 distances" in text


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_bytes_per_env_are_those_of_a_simulator(formulation):
    def size(owner, seen):
        """Bytes of the arrays that a simulator or one of its bundles holds, each once."""
        total = 0
        for value in vars(owner).values() if not hasattr(owner, "_cls") else (getattr(owner, v) for v in owner._cls.vars):
            if isinstance(value, wp.array):
                total += value.capacity * (value.ptr not in seen)
                seen.add(value.ptr)
            elif hasattr(value, "_cls") and hasattr(value._cls, "vars"):
                total += size(value, seen)
        return total

    for scene in ("box_on_ground", "bouncing_balls"):
        model = wl.load_usd(scene)
        one, three = (size(wl.Simulator(model, n, formulation=formulation, device="cpu"), set()) for n in (1, 3))
        assert bytes_per_env(model, Law(formulation)) == pytest.approx((three - one) / 2)


# ------------------------------------------------------------------------------------------------------------------ run


@pytest.mark.parametrize("every", [1, 7])
def test_out_is_what_a_simulator_does(tmp_path, capsys, every):
    path = tmp_path / "run.npz"
    facts = summary(capsys, "box_on_ground", "--envs", 2, "--dt", 0.01, "--duration", 0.5, "--every", every, "--out", path)
    assert (facts["steps"], facts["envs"], facts["out"]) == (50, 2, str(path))
    sim = wl.Simulator(wl.load_usd("box_on_ground"), 2, 0.01, device="cpu")
    with np.load(path) as rows:
        assert rows["body_names"].tolist() == ["/World/Box"]
        assert rows["body_names"].dtype.kind == "U"
        assert rows["pose"].shape == (50 // every + 1, 2, 1, 7)
        assert rows["velocity"].shape == (50 // every + 1, 2, 1, 6)
        for k in range(50 // every + 1):
            if k:
                sim.step(every)
            assert rows["time"][k] == pytest.approx(k * every * 0.01)
            np.testing.assert_array_equal(rows["pose"][k], sim.body_pose.numpy())
            np.testing.assert_array_equal(rows["velocity"][k], sim.body_velocity.numpy())
            for name in ("status", "residual", "iterations"):
                assert rows[name].shape == (50 // every + 1, 2)
                np.testing.assert_array_equal(rows[name][k], getattr(sim, name).numpy())


def test_out_of_a_mechanism_has_its_coordinates(tmp_path, capsys):
    """By joint, and the summary says how far its loop is open; a scene without joints has none of it."""
    path = tmp_path / "run.npz"
    facts = summary(capsys, "fourbar", "--envs", 2, "--dt", 0.002, "--duration", 0.1, "--out", path)
    model = wl.load_usd("fourbar")
    sim = wl.Simulator(model, 2, 0.002, device="cpu")
    with np.load(path) as rows:
        assert rows["dof_names"].tolist() == list(model.dof_names)
        for k in range(51):
            if k:
                sim.step()
            np.testing.assert_array_equal(rows["q"][k], sim.q.numpy())
            np.testing.assert_array_equal(rows["v"][k], sim.v.numpy())
    assert facts["loops_open"] == dict(zip(("m", "rad"), sim.loop_gaps().max(axis=(0, 1)), strict=True))
    assert 0.0 < facts["loops_open"]["m"] < 1e-4
    run("fourbar", "--dt", 0.002, "--duration", 0.1)
    assert "loops, most open" in capsys.readouterr().out
    assert summary(capsys, "box_on_ground", "--duration", 0.01, "--out", path)["loops_open"] is None
    with np.load(path) as rows:
        assert "q" not in rows


def test_summary_counts_every_step(capsys):
    facts = summary(capsys, "box_on_ground", "--envs", 3, "--dt", 0.002, "--duration", 0.5)
    sim = wl.Simulator(wl.load_usd("box_on_ground"), 3, 0.002, device="cpu")
    sim.step(250)
    assert facts["iterations_mean"] == pytest.approx(sim.iterations.numpy().mean() / 250)
    assert (facts["env_steps"], facts["simulated_time"], facts["contacts_mean"]) == (750, 0.5, 4.0)
    assert 0.0 < facts["residual_p99"] <= facts["residual_worst"] < 1e-6
    assert facts["residual_samples"] <= 3 * SAMPLES
    assert facts["envs_not_ok"] == sum(facts["status"].values()) == 0
    assert facts["env_steps_per_second"] == pytest.approx(750 / facts["wall_time"])


def test_options_reach_the_simulator(capsys):
    options = ("--method", "pgs", "--sliding", "aligned", "--directions", 4, "--rho-scale", 2.0, "--precision", "float64")
    facts = summary(capsys, "sphere_slip_roll", "--duration", 0.05, "--integrator", "euler", "--formulation", "phantom_inertia", *options)
    assert (facts["method"], facts["precision"], facts["formulation"], facts["steps"]) == ("pgs", "float64", "phantom_inertia", 50)


def test_the_midpoint_rule_reaches_the_simulator(tmp_path):
    """A box sliding at 10 ms ends up elsewhere than with Euler, by half a step at 5 m/s."""
    ends = []
    for integrator in ("euler", "midpoint"):
        path = tmp_path / f"{integrator}.npz"
        assert run("box_on_ground", "--dt", 0.01, "--duration", 0.8, "--integrator", integrator, "--out", path) == 0
        with np.load(path) as file:
            ends.append(file["pose"][-1, 0, 0, 1])
    assert ends[1] - ends[0] == pytest.approx(0.5 * 0.01 * 5.0, rel=0.01)


def test_what_is_not_certified_is_said_and_the_exit_status_stays_zero(capsys, monkeypatch):
    add = Tally.add

    def spoiled(self, count):
        self.sim.status.assign(np.array([0, 17], dtype=np.int32))
        add(self, count)

    monkeypatch.setattr(Tally, "add", spoiled)
    options = ("sphere_slip_roll", "--envs", 2, "--duration", 0.01)
    facts = summary(capsys, *options)
    assert facts["envs_not_ok"] == 1
    assert facts["status"] == {"ITERATION_LIMIT": 1, "RAY": 0, "NOT_A_NUMBER": 0, "OVERFLOW": 0, "UNCERTIFIED": 1, "RESTITUTION_REDUCED": 0}
    assert run(*options) == 0
    text = capsys.readouterr().out
    assert "1 of 2 environments were not OK" in text
    assert "uncertified answer was applied" in text


def test_rerun_gets_a_frame_each_every_steps(tmp_path, capsys):
    reader = pytest.importorskip("rerun.chunk").RrdReader
    path = tmp_path / "run.rrd"
    facts = summary(capsys, "sphere_slip_roll", "--duration", 0.1, "--every", 30, "--rerun", path)
    assert facts["rerun"] == str(path)
    chunks = [c.to_record_batch() for c in reader(str(path)).stream() if c.entity_path == "/plots/energy" and not c.is_static]
    assert sorted(s for c in chunks for s in c.column("step").to_pylist()) == [0, 30, 60, 90]


# ------------------------------------------------------------------------------------------------------------ bad input


def error_line(capsys, *arguments):
    """The single line on stderr of a call that must fail."""
    assert main([str(a) for a in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("warp-lcp: error: ")
    assert err.count("\n") == 1
    assert err.endswith("\n")
    return err


@pytest.mark.parametrize("command", ["info", "run"])
@pytest.mark.parametrize(
    ("content", "what"),
    [
        (None, "no such file"),
        ("not usd at all", "not a readable USD file"),
        (HEADER + 'def Xform "World" {', "not a readable USD file"),
        (HEADER + 'def Xform "World" {}', "no physics in this stage"),
    ],
)
def test_bad_files(capsys, tmp_path, command, content, what):
    scene = tmp_path / "scene.usda"
    if content is not None:
        scene.write_text(content)
    line = error_line(capsys, command, scene)
    assert what in line
    assert str(scene) in line


def test_scenes_that_run_refuses(capsys, tmp_path):
    scene = tmp_path / "scene.usda"
    scene.write_text(HEADER + PHYSICS + BOX.replace(', "PhysicsCollisionAPI"', "") % 0)
    assert "/Box" in error_line(capsys, "run", scene)  # without mass
    scene.write_text(HEADER + PHYSICS + BOX % 1 + PILL)
    assert "/Pill" in error_line(capsys, "run", scene)
    assert "no shipped scene of this name" in error_line(capsys, "run", "box_on_grund")
    assert "did you mean" in error_line(capsys, "info", "box_on_grund")


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        ((), "SCENE"),
        (("box_on_ground", "--dt", "nan"), "--dt is nan s"),
        (("box_on_ground", "--dt", "-1"), "--dt is -1.0 s"),
        (("box_on_ground", "--dt", "fast"), "invalid float value: 'fast'"),
        (("box_on_ground", "--duration", "inf"), "--duration is inf s"),
        (("box_on_ground", "--duration", "0"), "--duration is 0.0 s"),
        (("box_on_ground", "--duration", "1e-4"), "less than one step"),
        (("box_on_ground", "--envs", "0"), "num_envs is 0"),
        (("box_on_ground", "--envs", "-5"), "num_envs is -5"),
        (("box_on_ground", "--envs", "1.5"), "invalid int value: '1.5'"),
        (("box_on_ground", "--envs", "1000000000000"), "give fewer"),
        (("box_on_ground", "--every", "0"), "--every is 0"),
        (("box_on_ground", "--directions", "1"), "directions is 1"),
        (("box_on_ground", "--rho-scale", "nan"), "rho_scale is nan"),
        (("box_on_ground", "--formulation", "magic"), "formulation is 'magic'"),
        (("box_on_ground", "--method", "magic"), "method is 'magic'"),
        (("box_on_ground", "--sliding", "magic"), "sliding is 'magic'"),
        (("box_on_ground", "--precision", "magic"), "precision is 'magic'"),
        (("box_on_ground", "--integrator", "magic"), "integrator is 'magic'"),
        (("box_on_ground", "--device", "magic"), "--device magic"),
        (("box_on_ground", "--magic"), "--magic"),
        (("box_on_ground", "--out", "rows.csv"), "ending in .npz"),
        (("box_on_ground", "--out", "absent/rows.npz"), "No such file or directory"),
        (("box_on_ground", "--envs", "100000", "--duration", "10000", "--out", "rows.npz"), "larger --every"),
        (("box_on_ground", "--rerun", "absent/run.rrd"), "No such file or directory"),
        (("box_on_ground", "--rerun", "run"), "not a place to log to"),
        (("box_on_ground", "--rerun", "foo://bar"), "not the address of a viewer"),
    ],
)
def test_bad_arguments(capsys, tmp_path, monkeypatch, arguments, what):
    if "--rerun" in arguments:
        pytest.importorskip("rerun")
    monkeypatch.chdir(tmp_path)
    assert what in error_line(capsys, "run", *arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("module", "arguments"), [("pxr", ()), ("rerun", ("--rerun", "run.rrd"))])
def test_missing_extras_name_what_to_install(capsys, monkeypatch, tmp_path, module, arguments):
    real = builtins.__import__

    def without(name, *rest):
        if name.split(".")[0] == module:
            raise ImportError(f"No module named {name!r}")
        return real(name, *rest)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(builtins, "__import__", without)
    extra = {"pxr": "usd", "rerun": "rerun"}[module]
    assert f"python -m pip install 'warp_lcp[{extra}]'" in error_line(capsys, "run", "box_on_ground", *arguments)


# ------------------------------------------------------------------------------------------------------ as a process


def test_process_prints_one_json_object_and_one_error_line(tmp_path):
    done = python("run", "sphere_slip_roll", "--device", "cpu", "--duration", 0.01, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["steps"] == 10
    for arguments in (("--device", "magic"), ("--device", "cpu", "--rerun", "foo://bar"), ("--device", "cpu", "--envs", 0)):
        done = python("run", "box_on_ground", *arguments)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


def test_start_up_is_quick_and_loads_nothing_heavy():
    heavy = "('warp', 'pxr', 'rerun', 'rich', 'tqdm')"
    code = f"import sys; from warp_lcp.cli import main\ntry: main(['--help'])\nfinally: print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.endswith("[]\n"), done.stdout


def test_ctrl_c_leaves_readable_files(tmp_path):
    reader = pytest.importorskip("rerun.chunk").RrdReader
    rows, recording = tmp_path / "rows.npz", tmp_path / "run.rrd"
    command = [sys.executable, "-m", "warp_lcp", "run", "sphere_slip_roll", "--device", "cpu", "--duration", "1000", "--every", "10"]
    # A shell starts what runs in its background with Ctrl-C ignored, and that would be inherited.
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    command += ["--rerun", str(recording), "--out", str(rows)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, preexec_fn=heed)
    deadline = time.monotonic() + 60.0
    while not (recording.exists() and recording.stat().st_size > 100_000) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in out
    with np.load(rows) as file:
        assert 1 < len(file["time"]) < 100_001
        assert len(file["pose"]) == len(file["time"])
        assert np.isfinite(file["pose"]).all()
    assert sum(c.to_record_batch().num_rows for c in reader(str(recording)).stream() if c.entity_path == "/plots/energy") > 1
