# SPDX-License-Identifier: Apache-2.0
"""Scenes from USD, simulated: the shipped ones against what their doc promises, and others' files."""

import numpy as np
import pytest
from conftest import GRAVITY as G
from conftest import simulator, yaw

import warp_lcp as wl
from warp_lcp.builder import rotation_matrix


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


def test_bouncing_balls():
    """Highest point after the first bounce e^2 m, within what an impact in the middle of a step makes: (1 - e^2) h V and less.

    e = 1 comes back to 1 m, but for eps m and the sampling, 0.05 mm; e = 0 stays down.
    """
    h, e = 1e-3, np.array([0, 0.25, 0.5, 0.75, 0.9, 1.0])
    sim = simulator(wl.load_usd("bouncing_balls"), dt=h)
    run = sim.rollout(1200, record=("body_pose", "status"))
    assert (run.status.numpy() == 0).all()
    pose = run.body_pose.numpy()[:, 0]
    peaks = pose[460:, :, 2].max(0) - 0.1
    step = h * np.sqrt(2 * G)
    assert (peaks > e**2 - 1e-4).all()
    assert (peaks < e**2 + (1 - e**2 + e * (1 - e) / 2) * step + 1e-9).all()
    assert np.abs(pose[:, :, 0] - 0.5 * np.arange(6)).max() < 1e-12
    assert np.abs(pose[:, :, 1]).max() < 1e-12


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


def test_launch_fan():
    """Each cube stops after v^2 / (2 mu g), less half a step at 6 m/s as velocities are taken at the end of a step.

    1e-5 m: the bristles give by 5 um. None drifts sideways by more than a micron or turns by more than a nanoradian.
    """
    h, sim = 1e-3, simulator(wl.load_usd("launch_fan"))
    start, launch = sim.body_pose.numpy()[0].copy(), sim.body_velocity.numpy()[0, :, :3].copy()
    for _ in range(130):
        sim.step(10)
        assert sim.status.numpy()[0] == 0
        assert sim.contacts.count.numpy()[0] == 64  # with the ground alone
    moved = sim.body_pose.numpy()[0, :, :3] - start[:, :3]
    ahead = launch / 6
    assert (moved * ahead).sum(1) == pytest.approx(np.full(16, 36 / G - 3 * h), abs=1e-5)
    assert np.abs(np.cross(moved, ahead)).max() < 1e-6
    assert np.abs(sim.body_pose.numpy()[0, :, 3:] - start[:, 3:]).max() < 1e-9
    assert np.abs(sim.v.numpy()).max() < 1e-8


@pytest.mark.parametrize("h", [1e-3, 5e-3])
def test_plates_on_any_number_of_feet_move_alike(h):
    """4, 9, 16 and 64 contacts: one trajectory to 0.1 um, straight, and v^2 / (2 mu g) less half a step of sliding.

    The more feet, the stiffer: bristles under a plate give by 5 to 80 nm at this load. The step in which it stops is cut
    short: a h^2 / 4 at most, and 5 um of bristles.
    """
    sim = simulator(wl.load_usd("plate_many_contacts"), dt=h)
    start, most = sim.body_pose.numpy()[0].copy(), 0
    for _ in range(round(0.5 / h)):
        sim.step()
        assert sim.status.numpy()[0] == 0
        most = max(most, int(sim.contacts.count.numpy()[0]))
        moved = sim.body_pose.numpy()[0] - start
        assert np.ptp(moved, axis=0).max() < 1e-7
    assert most == 4 + 9 + 16 + 64
    assert moved[:, 0] == pytest.approx(np.full(4, 4 / G - h), abs=1e-5 + 0.5 * G * h**2 / 4)
    assert np.abs(moved[:, 1:]).max() < 1e-9
    assert np.abs(sim.v.numpy()).max() < 1e-8


def test_pile():
    """3 s at 2 ms: every step certified, no overlap of 1 mm (0.6 mm found), no step gains 1e-5 J (2e-6 J found) of 600 J.

    The boxes lie still in the end, and all are between the curbs.
    """
    model = wl.load_usd("pile")
    sim = simulator(model, dt=2e-3)
    last = np.inf
    for _ in range(1500):
        sim.step()
        assert sim.status.numpy()[0] == 0
        assert sim.slots.gap.numpy().min() > -1e-3
        pose, velocity = sim.body_pose.numpy()[0], sim.body_velocity.numpy()[0]
        spin = [rotation_matrix(p[3:]).T @ v[3:] for p, v in zip(pose, velocity, strict=True)]
        kinetic = 0.5 * model.mass @ (velocity[:, :3] ** 2).sum(1) + 0.5 * np.einsum("bi,bij,bj", spin, model.inertia, spin)
        energy = kinetic + G * model.mass @ pose[:, 2]
        assert energy < last + 1e-5
        last = energy
    boxes = model.shape_body[(model.shape_type == wl.ShapeType.BOX) & (model.shape_body >= 0)]
    assert np.abs(velocity[boxes]).max() < 1e-6
    assert np.abs(pose[:, :2]).max() < 0.55
    assert (pose[:, 2] > 0.15).sum() >= 1  # something lies on something


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
