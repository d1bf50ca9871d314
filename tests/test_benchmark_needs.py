# SPDX-License-Identifier: Apache-2.0
"""What scenes take and use, and what features elsewhere change: kernels, bytes, rows and motion. Times are measured, not tested."""

import json

import numpy as np
import pytest

import warp_lcp as wl
from benchmarks import needs
from warp_lcp import scenes
from warp_lcp.cli import ledger
from warp_lcp.methods import VelocityPivoting

ENVS = 37  # as `needs.allocated` wants it
BY_NAME = {feature.name: feature for feature in needs.FEATURES}


def model(scene: str | None, feature: needs.Feature = needs.NOTHING) -> wl.Model:
    """Of a base with a feature."""
    return needs.model(needs.base(scene, 1) if scene else None, feature)


#: Features in which forces move nothing: the scene must not feel them at all.
INERT = [name for name, feature in BY_NAME.items() if model("box", feature).dofs == 6]


def kernels(scene: str, name: str = "") -> set[str]:
    """That a base with a feature compiles."""
    return set(ledger(model(scene, BY_NAME[name] if name else needs.NOTHING))["kernels"])


@pytest.mark.parametrize("name", scenes.names())
def test_ledger_is_what_a_simulator_takes(name):
    """Bytes of a further environment and kernels, of every shipped scene; room for as many contacts as it says."""
    sim = wl.Simulator(wl.load_usd(name), 211, device="cpu")
    facts = ledger(sim.model)
    assert facts["bytes_per_env"] == needs.allocated(sim)
    assert sorted(facts["kernels"]) == sorted(needs.compiled(sim))
    assert sim.slots.gap.shape == (211, facts["contact_slots"])
    assert sim.contacts.gap.shape == (211, facts["max_contacts"] + facts["joint_rows"])
    assert facts["largest_lcp"] == min(5 * (facts["max_contacts"] + facts["joint_rows"]), 2000)
    assert (facts["joint_rows"] > 0) == bool(len(sim.model.loops) or np.isfinite(sim.model.limit).any())


@pytest.mark.parametrize("name", scenes.names())
def test_shipped_scenes_compile_kernels_of_what_is_in_them(name):
    """A kernel for each kind of pair, of restitution where something bounces, of joints, of one or of several bodies; and no other."""
    scene = wl.load_usd(name)
    stages = {"kinematics", "free_motion", "combine_pairs", "select_contacts", "certify", "integrate", "reset", "proximal_contacts"}
    pairs = {"_".join(wl.ShapeType(scene.shape_type[s]).name.lower() for s in pair) for pair in scene.pairs}
    bounds = {"bounds", "list_pairs"} if any(not name.startswith("plane") for name in pairs) else set()
    bounces = {"bounce", "judge", "settle"} if scene.bounces else set()
    single = scene.dofs == 6
    rows = {"contact_rows"} if bounces or not single else set()
    joints = {"reset_control", "judge_landing", "land"} if scene.articulated else {"pgs"}
    joints |= {"joint_rows"} if ledger(scene)["joint_rows"] else set()
    joints |= {"calm_overlaps"} if scene.articulated and scene.bodies_meet else set()
    assert set(ledger(scene)["kernels"]) == stages | pairs | bounds | bounces | rows | joints | {"solve_single" if single else "pivot"}


def test_features_compile_only_their_own_kernels():
    alone, stack = kernels("box"), kernels("stack")
    assert kernels("box", "3 shapes filtered out") == alone
    assert kernels("box", "3 shapes filtered out, e = 0.5") == alone
    assert kernels("box", "100 static boxes") == alone | {"bounds", "list_pairs", "box_box"}
    assert kernels("box", "10 static capsules") == alone | {"bounds", "list_pairs", "box_capsule"}
    assert kernels("box", "fixed body, 2 shapes") == alone | {"bounds", "list_pairs", "box_box", "sphere_box"}
    assert kernels("stack", "kinematic belt") == stack
    assert kernels("stack", "free ball at rest") == stack | {"plane_sphere", "sphere_box"}
    assert kernels("stack", "its mass randomised") == kernels("stack", "free ball at rest")
    assert kernels("stack", "1 static box, e = 0.5") == stack | {"bounce", "judge", "settle"}


def test_rows_are_counted():
    """A contact without friction is one row of the LCP, one with two directions five, one in the air none."""
    builder = wl.ModelBuilder()
    builder.add_plane(material=wl.Material(0.0, 0.0))
    for k, mu in enumerate((0.0, 1.0)):
        builder.add_box(builder.add_body(pose=(k, 0, 0.1, 0, 0, 0, 1)), (0.1, 0.1, 0.1), material=wl.Material(mu, mu))
    sim = wl.Simulator(builder.finalize(), 3, device="cpu")
    q = sim.q0.numpy()
    q[1, 7 + 2] = q[2, 2] = 1.0  # the rough one, the smooth one is lifted
    sim.q0.assign(q)
    sim.reset()
    sim.step()
    assert needs.rows(sim).tolist() == [4 + 20, 4, 20]
    usage, motion = needs.used(sim, 3, 1)
    assert usage == {
        "contacts_mean": pytest.approx(16 / 3),
        "contacts_largest": 8.0,
        "rows_mean": pytest.approx(16.0),
        "rows_largest": 24.0,
    }
    assert motion.shape == (3, 3, 13)
    assert (motion[-1, :, :7] == sim.q.numpy()[:, :7]).all()


@pytest.fixture(scope="module")
def plain() -> dict[str, np.ndarray]:
    """Motion of the bases alone, [steps, E, 13 bodies]."""
    return {name: moved(name, needs.NOTHING) for name in needs.BASES}


def moved(name: str, feature: needs.Feature) -> np.ndarray:
    scene = needs.base(name, ENVS)
    return needs.used(needs.simulator(scene, feature, ENVS), 150, scene.bodies)[1]


@pytest.mark.parametrize("scene", needs.BASES)
@pytest.mark.parametrize("name", INERT)
def test_motion_is_bit_identical_with_features_elsewhere(plain, scene, name):
    """While boxes land; what moves by itself shares solves, and differs by round-off."""
    assert (moved(scene, BY_NAME[name]).view(np.uint64) == plain[scene].view(np.uint64)).all()


def test_motion_feels_features_that_are_near(plain, monkeypatch):
    """So the test above can fail."""
    monkeypatch.setattr(needs, "FAR", 0.3)
    assert np.abs(moved("box", BY_NAME["1 static box"]) - plain["box"]).max() > 1e-3


def test_a_free_body_elsewhere_is_felt_by_round_off_alone(plain):
    """One more body is another solver (solve_single, pivot)."""
    ball = moved("box", BY_NAME["free ball at rest"])
    assert 0.0 < np.abs(ball - plain["box"])[..., :7].max() < 1e-6


def test_the_mass_of_another_body_is_felt_by_line_searches_alone():
    """Those have one step length for an environment; where flips of contact states do, to the bit as it was."""
    scene = needs.base("box", ENVS)
    before, after = (needs.simulator(scene, BY_NAME[name], ENVS) for name in ("free ball at rest", "its mass randomised"))
    searched = np.zeros(ENVS, dtype=bool)
    for _ in range(150):
        before.step()
        after.step()
        searched |= np.maximum(before.iterations.numpy(), after.iterations.numpy()) > VelocityPivoting.LIMIT
        same = (before.q.numpy()[:, :7].view(np.uint64) == after.q.numpy()[:, :7].view(np.uint64)).all(axis=1)
        assert (same | searched).all()
    assert searched.sum() < ENVS / 2


@pytest.mark.parametrize("name", ["3 shapes filtered out", "1 static box", "free ball at rest", "its mass randomised"])
def test_comparison_says_what_changed(monkeypatch, name):
    """All but times: those are there and positive."""
    monkeypatch.setattr(needs, "PASSES", 1)
    scene, feature = needs.base("box", ENVS), BY_NAME[name]
    row = needs.compare(scene, feature, 20, 1)
    facts, beside = ledger(model("box", feature)), ledger(model("box", BY_NAME.get(feature.beside, needs.NOTHING)))
    assert (row["bytes_base"], row["slots"]) == (beside["bytes_per_env"], facts["contact_slots"])
    expected = {
        "3 shapes filtered out": set(),
        "1 static box": {"kernels", "bytes"},
        "free ball at rest": {"kernels", "bytes"},
        "its mass randomised": {"bytes"},
    }[name]
    assert set(needs.changed(row)) - {"time"} == expected
    # Of its own: mass and inertia of two bodies, contact parameters of three pairs.
    own = 2 * (8 + 72) + 3 * 5 * 8 if feature.change else 0
    assert row["bytes"] == facts["bytes_per_env"] + own
    assert row["bytes_expected"] == row["bytes_base"] + (ledger(model(None, feature))["bytes_per_env"] if feature.moves else 0)
    assert row["kernels_less"] == (["solve_single"] if feature.moves else [])
    assert row["ratio_range"][0] <= row["ratio"] <= row["ratio_range"][1]
    assert min(row["env_step_s"], row["base_env_step_s"], row["ratio_expected"]) > 0.0
    assert {"kinematics", "plane_box", "select_contacts"} <= set(row["kernel_growth_s"]) <= set(facts["kernels"]) | {"solve_single"}
    data = {
        "scenes": [needs.shipped_scene("sphere_slip_roll", True)],
        "envs": {"box": ENVS},
        "steps": 20,
        "repetitions": 1,
        "features": [row],
    }
    text = needs.markdown(json.loads(json.dumps(data)))
    assert f"| {name}" in text
    assert "| 7, 6 (6) | 1 | 1 | 1 | 5 |" in text


def test_what_counts_as_changed():
    same = {"kernels_more": [], "bytes": 8, "bytes_expected": 8, "rows_mean": 5.0, "rows_mean_expected": 5.0, "envs_that_differ": 0}
    same |= {"ratio_expected": 1.04}
    assert needs.changed(same) == []
    for what, change in {
        "kernels": {"kernels_more": ["pivot"]},
        "bytes": {"bytes": 9},
        "rows": {"rows_mean": 5.1},
        "time": {"ratio_expected": 1.06},
        "motion": {"envs_that_differ": 1},
    }.items():
        assert needs.changed(same | change) == [what]
