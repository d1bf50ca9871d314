# SPDX-License-Identifier: Apache-2.0
"""integrator="midpoint": second order where nothing collides, and no worse than Euler where something does."""

import numpy as np
import pytest
from conftest import GRAVITY as G
from conftest import block_on_plane, paper_box, random_quaternions, simulator, yaw
from test_paper_box import CONTINUOUS, stop

import warp_lcp as wl
from warp_lcp.builder import rotation_matrix

INERTIA = np.diag([0.1, 0.2, 0.3])


def midpoint(model, num_envs: int = 1, dt: float = 1e-3, **options) -> wl.Simulator:
    return simulator(model, num_envs, dt, integrator="midpoint", **options)


def overlap(sim: wl.Simulator) -> float:
    """Deepest overlap [m] at the start of the last step."""
    count, gap = sim.contacts.count.numpy(), sim.contacts.gap.numpy()
    return -min(0.0, *(gap[env, :n].min() for env, n in enumerate(count) if n), 0.0)


# ------------------------------------------------------------------------------------------------------- second order


@pytest.mark.parametrize("method", ["auto", "lemke"])
def test_paper_box_at_10_ms(method):
    """Bars: 3 mm and 4 mrad of the continuous motion, where Euler is 27 mm and 30 mrad off; certified, no lift."""
    pose, seen = stop(1e-2, integrator="midpoint", method=method)
    error = np.abs(pose - CONTINUOUS)
    assert error[:2].max() < 3e-3
    assert error[2] < 4e-3
    assert seen["not_ok"] == 0
    assert seen["residual"] < 1e-9
    assert seen["lift"] < 1e-6
    assert seen["speed"] < 1e-9


def test_paper_box_converges():
    """What is left is of first order, for the friction law looks at the start of the step: 0.49 mm and mrad together at 1 ms
    and ten times that at 10 ms, within 15 %; Euler: 4.0 at 1 ms."""
    errors = [np.linalg.norm(stop(h, integrator="midpoint")[0] - CONTINUOUS) for h in (1e-2, 1e-3)]
    assert errors[1] == pytest.approx(0.494e-3, rel=0.02)
    assert errors[0] == pytest.approx(10 * errors[1], rel=0.15)


def test_free_flight_is_exact():
    """A parabola to round-off at 10 ms, the centre of mass beside the frame's origin."""
    builder = wl.ModelBuilder()
    builder.add_body(velocity=(1, 2, 3), angular_velocity=(0, 0, 2), mass=1.0, inertia=np.eye(3), com=(0.3, 0, 0))
    sim = midpoint(builder, dt=1e-2)
    start = sim.v.numpy()[0, :3].copy()
    sim.step(100)
    pose = sim.q.numpy()[0]
    com = pose[:3] + rotation_matrix(pose[3:]) @ [0.3, 0, 0]
    assert com == pytest.approx(np.array([0.3, 0, 0]) + start + [0, 0, -G / 2], abs=1e-12)
    assert yaw(pose) == pytest.approx(2.0, abs=1e-12)


def tumble(h: float, time: float, spin, torque) -> tuple[wl.Simulator, np.ndarray]:
    """A free body under a torque that stays in the world: the simulator and its kinetic energies."""
    builder = wl.ModelBuilder(gravity=(0, 0, 0))
    builder.add_body(angular_velocity=spin, mass=1.0, inertia=INERTIA)
    sim = midpoint(builder, dt=h)
    sim.wrench.assign(np.array([[[0, 0, 0, *torque]]], dtype=float))
    energy = []
    for _ in range(round(time / h / 10)):
        sim.step(10)
        w = rotation_matrix(sim.q.numpy()[0, 3:]).T @ sim.v.numpy()[0, 3:]
        energy.append(0.5 * w @ INERTIA @ w)
    return sim, np.array(energy)


def attitude_and_spin(time: float, spin, torque) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrix and angular velocity (world axes) of the same motion by an ODE solver at rtol 1e-13."""
    integrate = pytest.importorskip("scipy.integrate")

    def rate(_, y):
        w, rotation = y[9:], y[:9].reshape(3, 3)
        accelerated = np.linalg.solve(INERTIA, rotation.T @ torque - np.cross(w, INERTIA @ w))
        return np.concatenate([(rotation @ np.cross(w, np.eye(3)).T).ravel(), accelerated])

    start = np.concatenate([np.eye(3).ravel(), spin])
    end = integrate.solve_ivp(rate, (0, time), start, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    rotation = end[:9].reshape(3, 3)
    return rotation, rotation @ end[9:]


@pytest.mark.parametrize(
    ("time", "spin", "torque"),
    [(10.0, (1e-3, 5.0, 0.0), (0, 0, 0)), (2.0, (1.0, 0.5, 0.5), (0.1, 0.3, -0.2))],
    ids=["torque-free flip", "constant torque"],
)
def test_attitude_and_spin_are_of_second_order(time, spin, torque):
    """Errors at 5 and 2.5 ms in ratio 4 (20 %); without a torque the energy stays to round-off."""
    rotation, w = attitude_and_spin(time, np.array(spin), np.array(torque))
    errors = []
    for h in (5e-3, 2.5e-3):
        sim, energy = tumble(h, time, spin, torque)
        errors.append((np.abs(rotation_matrix(sim.q.numpy()[0, 3:]) - rotation).max(), np.abs(sim.v.numpy()[0, 3:] - w).max()))
        if not any(torque):
            assert np.abs(energy / (0.5 * np.array(spin) @ INERTIA @ spin) - 1).max() < 1e-10
    assert np.divide(*errors) == pytest.approx([4.0, 4.0], rel=0.2)
    assert max(errors[1]) < 1e-3


@pytest.mark.parametrize("h", [1e-2, 1e-3])
def test_sphere_slips_then_rolls(h):
    """x = 0.3328549 m when slip ends at 0.1941653 s, 5/7 of 2 m/s from then on: within 0.05 mm at 10 ms (Euler: 2.8 mm)."""
    builder, material = wl.ModelBuilder(), wl.Material(0.3, 0.3)
    builder.add_plane(material=material)
    body = builder.add_body(pose=(0, 0, 0.1, 0, 0, 0, 1), velocity=(2, 0, 0))
    builder.add_sphere(body, 0.1, material=material)
    sim = midpoint(builder, dt=h)
    sim.step(round(0.5 / h))
    velocity = sim.v.numpy()[0]
    assert velocity[0] == pytest.approx(10 / 7, rel=1e-6)
    assert velocity[4] * 0.1 == pytest.approx(velocity[0], rel=1e-6)
    assert sim.q.numpy()[0, 0] == pytest.approx(0.3328549 + (0.5 - 0.1941653) * 10 / 7, abs=5e-3 * h)


def test_sphere_rolls_down_an_incline_exactly():
    """x = 5/14 g sin t^2: constant acceleration, so the midpoint rule has it at any step; 1e-8 m is the bristles' give."""
    slope = 0.2
    builder, material = wl.ModelBuilder(gravity=(G * np.sin(slope), 0, -G * np.cos(slope))), wl.Material(0.5, 0.5)
    builder.add_plane(material=material)
    body = builder.add_body(pose=(0, 0, 0.1, 0, 0, 0, 1))
    builder.add_sphere(body, 0.1, material=material)
    sim = midpoint(builder, dt=1e-2)
    sim.step(100)
    assert sim.q.numpy()[0, 0] == pytest.approx(5 / 14 * G * np.sin(slope), abs=1e-8)


def test_spinning_box_stops():
    """omega_z = 2 pi, mu = 1: 0.4742687 rad within 0.3 mrad at 10 ms (Euler: 31 mrad), 0.05 mrad at 1 ms."""
    for h, bar in ((1e-2, 3e-4), (1e-3, 5e-5)):
        sim = midpoint(block_on_plane(1.0, half=(0.5, 0.5, 0.5), mass=1.0, angular_velocity=(0, 0, 2 * np.pi)), dt=h)
        sim.step(round(0.3 / h))
        assert yaw(sim.q.numpy()[0]) == pytest.approx(0.4742687, abs=bar)


def test_soft_contacts_that_give_are_no_impacts():
    """k_n = 1e6 N/m: the corners of the sliding box move by 2 um as the load passes from one to the next; bars as above."""
    builder, rough = wl.ModelBuilder(), wl.Material(1.0, 1.0, normal_stiffness=1e6, normal_damping=1e4)
    builder.add_plane(material=rough)
    body = builder.add_body(pose=(0, 0, 0.5 - G / 4e6, 0, 0, 0, 1), velocity=(0, 5, 0), angular_velocity=(0, 0, 2 * np.pi), mass=1.0)
    builder.add_box(body, (0.5, 0.5, 0.5), material=rough)
    sim = midpoint(builder, dt=1e-2)
    sim.step(80)
    q = sim.q.numpy()[0]
    error = np.abs(np.array([q[0], q[1], yaw(q)]) - CONTINUOUS)
    assert error[:2].max() < 3e-3
    assert error[2] < 4e-3


def test_block_pgs_in_single_precision_keeps_the_gain():
    """Round-off of float32 is no impact: 5 mm at 10 ms, where Euler is 27 mm off."""
    pose, _ = stop(1e-2, integrator="midpoint", method="pgs", precision="float32")
    assert np.abs(pose - CONTINUOUS)[:2].max() < 5e-3


# ------------------------------------------------------------------------------------------------------------- impacts


@pytest.mark.parametrize("h", [1e-2, 1e-3])
@pytest.mark.parametrize(("tilt", "bar"), [(0.0, 1e-8), (0.3, 2e-5)])
def test_an_impact_is_not_averaged(h, tilt, bar):
    """Dropped from 0.3 m. Averaged, the approach would carry it 11 mm into the ground at 10 ms; Euler: 5 nm flat, 4 um tilted."""
    sim = midpoint(block_on_plane(half=(0.5, 0.5, 0.5)), dt=h)
    axis = np.array([0.8, 0.6, 0.0]) * np.sin(tilt / 2)
    sim.q.assign(np.array([[0, 0, 0.8 if tilt == 0.0 else 1.1, *axis, np.cos(tilt / 2)]]))
    worst = 0.0
    for _ in range(round(2.0 / h)):
        sim.step()
        worst = max(worst, overlap(sim))
    assert worst < bar
    assert np.abs(sim.v.numpy()).max() < 1e-9
    assert sim.q.numpy()[0, 2] == pytest.approx(0.5 - G / 4e10, abs=1e-11)


def test_an_impact_concerns_those_it_stops_and_no_others():
    """A tower of three falls, and a box beside it: the tower lands without overlap, the other box stays on its parabola.

    Middle, top, bottom: in this order the contact above is looked at before the middle box is found to be stopped.
    """
    builder = wl.ModelBuilder()
    builder.add_plane()
    for x, z in ((0, 0.5), (0, 0.7), (0, 0.3), (1, 1.1)):
        builder.add_box(builder.add_body(pose=(x, 0, z, 0, 0, 0, 1)), (0.1, 0.1, 0.1))
    sim = midpoint(builder, dt=1e-2)
    worst = 0.0
    for _ in range(42):  # the tower lands after 0.2 s, the box would after 0.45 s
        sim.step()
        worst = max(worst, overlap(sim))
    pose = sim.body_pose.numpy()[0]
    assert worst < 1e-7
    assert pose[:3, 2] == pytest.approx([0.3, 0.5, 0.1], abs=1e-7)
    assert pose[3, 2] == pytest.approx(1.1 - G * 0.42**2 / 2, abs=1e-12)


def test_tumbling_boxes_gain_no_energy_and_come_to_rest():
    """The bar of Euler's test, 1e-6 m of height in 10 ms, with free flight that loses none."""
    envs, half = 64, np.array([0.2, 0.15, 0.1])
    sim = midpoint(block_on_plane(0.5, half=half), envs, 2e-3)
    rng = np.random.default_rng(1)
    start = np.zeros((envs, 7))
    start[:, 2], start[:, 3:] = 0.6, random_quaternions(rng, envs)
    sim.q.assign(start)
    sim.v.assign(rng.normal(size=(envs, 6)) * 2)
    mass, inertia = sim.model.mass[0], sim.model.inertia[0]

    def energy():
        q, v = sim.q.numpy(), sim.v.numpy()
        spin = [rotation_matrix(a[3:]).T @ b[3:] for a, b in zip(q, v, strict=True)]
        return mass * (G * q[:, 2] + 0.5 * (v[:, :3] ** 2).sum(1)) + [0.5 * w @ inertia @ w for w in spin]

    last, status = energy(), 0
    for _ in range(300):
        sim.step(5)
        now = energy()
        assert (now - last).max() < mass * G * 1e-6
        last = now
        status |= np.bitwise_or.reduce(sim.status.numpy())
    assert status == 0
    assert np.abs(sim.v.numpy()).max() < 1e-9


# ---------------------------------------------------------------------------------------------------------------- rest


def test_a_stack_rests_as_with_euler():
    """Ten boxes, 10 s at 5 ms: the same deflection to 1e-12 m, no creep to 1e-12 m/s."""
    builder = wl.ModelBuilder()
    builder.add_plane()
    for k in range(10):
        builder.add_box(builder.add_body(pose=(0, 0, 0.1 + 0.2 * k, 0, 0, 0, 1)), (0.1, 0.1, 0.1))
    model = builder.finalize()
    euler, sim = simulator(model, dt=5e-3), midpoint(model, dt=5e-3)
    euler.step(400)
    sim.step(400)
    settled = sim.q.numpy().copy()
    sim.step(1600)
    assert np.abs(sim.q.numpy() - settled).max() / 8.0 < 1e-12
    assert sim.q.numpy()[0, 2::7] == pytest.approx(euler.q.numpy()[0, 2::7], abs=1e-12)
    assert sim.status.numpy()[0] == 0


def test_a_sticking_block_does_not_creep():
    """0.1 degree below the friction angle, 9 s: under 1e-12 m/s."""
    slope = np.arctan(0.5) - np.radians(0.1)
    sim = midpoint(block_on_plane(0.5, gravity=(G * np.sin(slope), 0, -G * np.cos(slope))))
    sim.step(1000)
    before = sim.q.numpy()[0, :3].copy()
    sim.step(9000)
    assert np.linalg.norm(sim.q.numpy()[0, :3] - before) / 9.0 < 1e-12


def test_a_resting_box_keeps_its_bits():
    """A box in its static deflection: after 1000 more steps the pose is the same to 1e-15 m."""
    sim = midpoint(paper_box(velocity=(0, 0, 0), spin=0.0))
    sim.step(1000)
    before = sim.q.numpy().copy()
    sim.step(1000)
    assert np.abs(sim.q.numpy() - before).max() <= 1e-15


def test_kinematic_bodies_move_with_their_velocity():
    """v is written by the user, not accelerated: h v a step, what Euler does to the round-off of 50 steps (two kernels, whose products
    and sums a compiler may fuse differently)."""
    builder = wl.ModelBuilder()
    builder.add_body(joint=wl.JointType.KINEMATIC, velocity=(1, 0, 0), angular_velocity=(0.1, 0.2, 0.3))
    model = builder.finalize()
    euler, sim = simulator(model, dt=1e-2), midpoint(model, dt=1e-2)
    euler.step(50)
    sim.step(50)
    np.testing.assert_allclose(sim.q.numpy(), euler.q.numpy(), rtol=0.0, atol=50 * 2.0**-53)
    assert (sim.v.numpy() == euler.v.numpy()).all()
