# SPDX-License-Identifier: Apache-2.0
"""Scenes from USD, simulated: the shipped ones against what their doc promises, and others' files."""

import numpy as np
import pytest
from conftest import GRAVITY as G
from conftest import simulator, yaw

import warp_lcp as wl


def run(scene, seconds: float, dt: float = 1e-3) -> wl.Simulator:
    """Simulate one environment; every step must be OK."""
    sim = simulator(wl.load_usd(scene), dt=dt)
    for _ in range(round(seconds / dt / 10)):
        sim.step(10)
        assert sim.status.numpy()[0] == 0
    return sim


def test_box_on_ground():
    """An exact-cone stepper rests at this pose at 1 ms; bars of the design."""
    q = run("box_on_ground", 0.8).q.numpy()[0]
    assert q[:2] == pytest.approx([0.44037, 1.58125], abs=5e-5)
    assert yaw(q) == pytest.approx(1.95063, abs=5e-5)


def test_spinning_box():
    """Stops after 0.4742687 rad; the step of 1 ms costs half a step at 2 pi rad/s, 3.1 mrad."""
    assert yaw(run("spinning_box", 0.3).q.numpy()[0]) == pytest.approx(0.4742687, abs=3.5e-3)


def test_sphere_slip_roll():
    assert run("sphere_slip_roll", 0.4).v.numpy()[0, 0] == pytest.approx(10 / 7, rel=1e-6)


def test_incline():
    """tan = 0.6: the block with mu = 0.5 slides at g (sin - mu cos), the other stays."""
    sim = run("incline", 0.5)
    slope = np.arctan(0.6)
    speeds = sorted(np.linalg.norm(sim.body_velocity.numpy()[0, :, :3], axis=1))
    assert speeds[0] < 1e-9
    assert speeds[-1] == pytest.approx(0.5 * G * (np.sin(slope) - 0.5 * np.cos(slope)), rel=1e-3)


def test_belt():
    assert run("belt", 1.0).v.numpy()[0, 0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("scene", "bodies"), [("heavy_on_light", 2), ("stack", 10)])
def test_stacks_stand(scene, bodies):
    """2 s at 5 ms: static deflection (under 1 um) and nothing else."""
    sim = run(scene, 2.0, dt=5e-3)
    pose = sim.body_pose.numpy()[0]
    assert len(pose) == bodies
    assert pose[:, :3] == pytest.approx(np.array([[0, 0, 0.1 + 0.2 * k] for k in range(bodies)]), abs=1e-6)
    assert np.abs(sim.v.numpy()).max() < 1e-9


@pytest.mark.parametrize(
    ("file", "mass", "rest"),
    [
        ("usdPhysicsBoxOnBox", [15.625], [0.225]),
        ("usdPhysicsGroupFiltering", [15.625] * 2, [0.225] * 2),
        ("usdPhysicsPairFiltering", [15.625] * 2, [0.225] * 2),
    ],
)
def test_openusd_examples_come_to_rest(shared, file, mass, rest):
    """Authored in centimetres: boxes of 0.25 m and the default density fall on a ground box whose top is at 0.1 m.

    Filtered boxes pass through each other and lie in the same place.
    """
    sim = run(str(shared / "usd" / "openusd" / f"{file}.usda"), 2.0)
    assert sim.model.mass == pytest.approx(mass, rel=1e-6)
    assert sim.model.gravity == pytest.approx([0, 0, -G])
    assert sim.body_pose.numpy()[0, :, 2] == pytest.approx(rest, abs=1e-6)
    assert np.abs(sim.v.numpy()).max() < 1e-6
