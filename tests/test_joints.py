# SPDX-License-Identifier: Apache-2.0
"""Kinematic trees, loops, limits and drives against closed forms, converged integrations and another way to the same matrices."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import DEVICE, GRAVITY, paper_box, simulator
from scipy.integrate import solve_ivp

import warp_lcp as wl
from warp_lcp import joints
from warp_lcp.model import DofKind, Drive, JointType

HALF = np.sqrt(0.5)
ABOUT_Z = (0.0, -HALF, 0.0, HALF)  # x of such a frame is the world's z
ABOUT_Y = (0.0, 0.0, HALF, HALF)
UP = (0.0, -HALF, 0.0, HALF)
SMALL = 0.01 * np.eye(3)


# ------------------------------------------------------------------------------------------- mass matrix, bias and kinematics


def random_tree(seed: int = 0) -> wl.Model:
    """Nine bodies on a free one, with a joint of every type, frames and inertias of no symmetry."""
    rng = np.random.default_rng(seed)

    def turn() -> np.ndarray:
        q = rng.normal(size=4)
        return q / np.linalg.norm(q)

    def frame() -> np.ndarray:
        return np.r_[rng.normal(size=3) * 0.2, turn()]

    builder = wl.ModelBuilder()
    kinds = [
        (JointType.REVOLUTE, None, 0),
        (JointType.PRISMATIC, None, 1),
        (JointType.SPHERICAL, None, 1),
        (JointType.UNIVERSAL, None, 0),
        (JointType.PLANAR, None, 4),
        (JointType.D6, ("tx", "ry", "rz"), 5),
        (JointType.FIXED, None, 2),
        (JointType.D6, ("rx", "ry", "rz"), 7),
        (JointType.REVOLUTE, None, 8),
    ]
    for _ in range(len(kinds) + 1):
        a = rng.normal(size=(3, 3))
        inertia = 0.02 * np.eye(3) + 0.002 * a @ a.T
        com = rng.normal(size=3) * 0.1
        builder.add_body(
            pose=np.r_[rng.normal(size=3), turn()], mass=float(rng.uniform(0.5, 2.0)), com=com, inertia=0.5 * (inertia + inertia.T)
        )
    for child, (kind, axes, parent) in enumerate(kinds, start=1):
        builder.add_joint(kind, parent, child, parent_frame=frame(), child_frame=frame(), axes=axes)
    return builder.finalize()


def random_state(model: wl.Model, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=model.nq)
    for b in range(model.num_bodies):
        first = model.q_start[b] + (3 if model.joint_type[b] == JointType.FREE else 0)
        if model.joint_type[b] in (JointType.FREE, JointType.SPHERICAL):
            q[first : first + 4] /= np.linalg.norm(q[first : first + 4])
    return q, rng.normal(size=model.nv)


def poses(model: wl.Model, q: np.ndarray) -> np.ndarray:
    """Poses of all bodies, in numpy."""
    result = np.zeros((model.num_bodies, 7))
    for b in model.order:
        axes = [f"{'t' if k == DofKind.LINEAR else 'r'}{'xyz'[int(np.argmax(a))]}" for k, a in _dofs(model, b)]
        at, parent = model.q_start[b], model.body_parent[b]
        if model.joint_type[b] == JointType.FREE:
            result[b] = q[at : at + 7]
            continue
        spherical = model.joint_type[b] == JointType.SPHERICAL
        values, pose = q[at : at + (4 if spherical else len(axes))], np.r_[np.zeros(6), 1.0]
        if spherical:
            pose[3:] = values
        else:
            for axis, value in zip(axes, values, strict=True):
                step = np.r_[np.zeros(6), 1.0]
                if axis[0] == "t":
                    step["xyz".index(axis[1])] = value
                else:
                    step[3:] = joints.about("xyz".index(axis[1]), value)
                pose = joints.compose(pose, step)
        base = model.joint_pose[b] if parent < 0 else joints.compose(result[parent], model.joint_pose[b])
        result[b] = joints.compose(joints.compose(base, pose), joints.inverse(model.joint_child_pose[b]))
    return result


def _dofs(model: wl.Model, b: int):
    return [(model.dof_kind[i], model.dof_axis[i]) for i in np.flatnonzero(model.dof_body == b)]


def moved(model: wl.Model, q: np.ndarray, v: np.ndarray, h: float) -> np.ndarray:
    """q after h at velocities v, by what the coordinates of each joint mean."""
    result = q.copy()
    for b in range(model.num_bodies):
        at, first = model.q_start[b], model.v_start[b]
        if model.joint_type[b] == JointType.FREE:
            turn = _exp(v[first + 3 : first + 6], h)
            pose = q[at : at + 7]
            centre = pose[:3] + joints.rotate(pose[3:], model.com[b])
            after = joints.multiply(turn, pose[3:])
            result[at : at + 7] = np.r_[centre + h * v[first : first + 3] - joints.rotate(after, model.com[b]), after]
        elif model.joint_type[b] == JointType.SPHERICAL:
            result[at : at + 4] = joints.multiply(q[at : at + 4], _exp(v[first : first + 3], h))
        else:
            n = int(np.count_nonzero(model.dof_body == b))
            result[at : at + n] += h * v[first : first + n]
    return result


def _exp(w: np.ndarray, h: float) -> np.ndarray:
    angle = h * np.linalg.norm(w)
    return np.r_[np.sin(0.5 * angle) * w / np.linalg.norm(w), np.cos(0.5 * angle)] if angle != 0.0 else np.array([0, 0, 0, 1.0])


def jacobian(model: wl.Model, q: np.ndarray) -> np.ndarray:
    """[B, 6, nv] velocity of the centre of mass and angular velocity of each body, by central differences of `poses`."""
    h, result = 1e-5, np.zeros((model.num_bodies, 6, model.nv))
    for i in range(model.nv):
        v = np.eye(model.nv)[i]
        before, after = poses(model, moved(model, q, v, -h)), poses(model, moved(model, q, v, h))
        for b in range(model.num_bodies):
            ends = [pose[b, :3] + joints.rotate(pose[b, 3:], model.com[b]) for pose in (before, after)]
            turn = joints.multiply(after[b, 3:], joints.conjugate(before[b, 3:]))
            result[b, :, i] = np.r_[ends[1] - ends[0], 2.0 * np.sign(turn[3]) * turn[:3]] / (2.0 * h)
    return result


def test_mass_matrix_and_kinematics_of_every_joint():
    """M = sum J^T diag(m, I) J with J from differences of poses: their error is h^2 = 1e-10 of terms of order one."""
    model = random_tree()
    sim = simulator(model, dt=1e-9)
    for seed in range(3):
        q, v = random_state(model, seed)
        sim.q.assign(q[None])
        sim.v.assign(v[None])
        pose, velocity = sim.body_pose.numpy()[0].copy(), sim.body_velocity.numpy()[0].copy()
        expected = poses(model, q)
        assert np.abs(pose[:, :3] - expected[:, :3]).max() < 1e-13
        assert (1.0 - np.abs((pose[:, 3:] * expected[:, 3:]).sum(axis=1))).max() < 1e-14
        j = jacobian(model, q)
        assert np.abs(j @ v - velocity).max() < 1e-8
        mass = np.zeros((model.nv, model.nv))
        for b in range(model.num_bodies):
            turn = np.array([joints.rotate(expected[b, 3:], e) for e in np.eye(3)]).T
            spatial = np.block([[model.mass[b] * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), turn @ model.inertia[b] @ turn.T]])
            mass += j[b].T @ spatial @ j[b]
        assert np.abs(sim.mass_matrix().numpy()[0] - mass).max() < 1e-8 * np.abs(mass).max()
        sim.step()
        assert np.abs(mass_matrix(sim) - mass).max() < 1e-8 * np.abs(mass).max()


def mass_matrix(sim: wl.Simulator) -> np.ndarray:
    """M = L^T D L of the first environment at the start of the last step, from the factors that the step had."""
    trees, before = sim.mechanics, sim.model.dof_before
    screw, taken, pivot = (array.numpy()[0] for array in (trees.screw, trees.taken, trees.pivot))
    factor = np.eye(sim.model.nv)
    for i in range(sim.model.nv):
        j = before[i]
        while j >= 0:
            factor[i, j] = taken[i] @ screw[j]
            j = before[j]
    return factor.T @ np.diag(pivot) @ factor


def test_accelerations_of_every_joint():
    """M a = -c with c = sum J^T (m (dJ/dt v - g), I dJ/dt v + w x I w), dJ/dt v by differences of velocities along the motion.

    Their error is 1e-9 / 1e-4; a itself is known to 1e-16 / h = 1e-8. bias() is c.
    """
    model, h = random_tree(), 1e-8
    sim = simulator(model, dt=h)
    for seed in range(3):
        q, v = random_state(model, seed)
        rates = []
        for side in (-1e-4, 1e-4):
            sim.q.assign(moved(model, q, v, side)[None])
            sim.v.assign(v[None])
            rates.append(sim.body_velocity.numpy()[0].copy())
        rate = (rates[1] - rates[0]) / 2e-4
        pose, velocity, j = poses(model, q), rates[0] + rate * 1e-4, jacobian(model, q)
        bias = np.zeros(model.nv)
        for b in range(model.num_bodies):
            turn = np.array([joints.rotate(pose[b, 3:], e) for e in np.eye(3)]).T
            inertia, w = turn @ model.inertia[b] @ turn.T, velocity[b, 3:]
            force = np.r_[model.mass[b] * (rate[b, :3] - model.gravity), inertia @ rate[b, 3:] + np.cross(w, inertia @ w)]
            bias += j[b].T @ force
        sim.q.assign(q[None])
        sim.v.assign(v[None])
        assert np.abs(sim.bias().numpy()[0] - bias).max() < 1e-7 * np.abs(bias).max()
        sim.step()
        acceleration = (sim.v.numpy()[0] - v) / h
        assert np.abs(mass_matrix(sim) @ acceleration + bias).max() < 1e-5 * np.abs(bias).max()


def test_mass_matrix_and_bias_of_free_and_kinematic_bodies():
    """m, R I R^T; m (-g), w x I w; what is prescribed has neither. Masses and gravity of each environment."""
    builder, turn = wl.ModelBuilder(), np.array([0.1, -0.5, 0.3, 0.8]) / np.sqrt(0.99)
    inertia = np.array([[0.03, 0.004, 0.0], [0.004, 0.05, -0.002], [0.0, -0.002, 0.04]])
    builder.add_body(pose=(1, 2, 3, *turn), angular_velocity=(3, -2, 1), mass=2.0, com=(0.1, 0.2, 0.0), inertia=inertia)
    builder.add_body(angular_velocity=(1, 1, 1), joint=JointType.KINEMATIC, mass=1.0, inertia=inertia)
    sim = simulator(builder, num_envs=2)
    sim.set_parameters(gravity=np.array([[0, 0, -GRAVITY], [1.0, 0, 0]]), mass=np.array([[2.0, 1.0], [4.0, 1.0]]))
    mass, bias = sim.mass_matrix().numpy(), sim.bias().numpy()
    matrix, w = np.array([joints.rotate(turn, e) for e in np.eye(3)]).T, np.array([3.0, -2.0, 1.0])
    for env, (m, g) in enumerate(((2.0, [0, 0, -GRAVITY]), (4.0, [1.0, 0, 0]))):
        own = 0.5 * m * matrix @ inertia @ matrix.T
        expected = np.eye(12)
        expected[:3, :3], expected[3:6, 3:6] = m * np.eye(3), own
        assert np.abs(mass[env] - expected).max() < 1e-14
        assert np.abs(bias[env] - np.r_[-m * np.array(g), np.cross(w, own @ w), np.zeros(6)]).max() < 1e-13


def test_asking_for_the_mass_matrix_changes_no_step():
    """Bit for bit."""
    ends = []
    for asks in (False, True):
        sim = simulator(quadruped(), dt=2e-3)
        for _ in range(20):
            sim.step(2)
            if asks:
                sim.mass_matrix()
                sim.bias()
        ends.append(np.r_[sim.q.numpy()[0], sim.v.numpy()[0]])
    assert ends[0].tobytes() == ends[1].tobytes()


def test_bodies_are_placed_where_joints_let_them():
    """A child that stands beside its hinge is moved to it; its angle and velocity are those nearest to what was asked for."""
    builder = wl.ModelBuilder()
    body = builder.add_body(pose=(1.0, 0.2, 0.0, 0, 0, np.sin(0.3), np.cos(0.3)), velocity=(0, 2.0, 0), mass=1.0, inertia=SMALL)
    builder.add_joint(JointType.REVOLUTE, -1, body, parent_frame=(0, 0, 0, *ABOUT_Z), child_frame=(-1, 0, 0, *ABOUT_Z))
    model = builder.finalize()
    assert abs(abs(model.q0[0]) - 0.6) < 1e-12
    pose = simulator(model).body_pose.numpy()[0, 0]
    assert np.abs(pose[:3] - [np.cos(0.6), np.sin(0.6), 0.0]).max() < 1e-12


@pytest.mark.parametrize("axes", [("rx", "ry"), ("ry", "rz"), ("rx", "rz"), ("rx", "ry", "rz"), ("tx", "tz", "ry"), ("ty",)])
def test_coordinates_are_read_back_from_poses(axes):
    """pose_of and coordinates are inverse to each other, within the middle angle's right angle."""
    rng = np.random.default_rng(1)
    n = len(axes)
    joint = joints.Joint(
        "j", JointType.D6, -1, 0, *(np.r_[np.zeros(6), 1.0],) * 2, axes, *np.zeros((3, n)), np.zeros((n, 2)), np.zeros((n, 5))
    )
    for _ in range(20):
        q = rng.uniform(-1.5, 1.5, size=n)
        assert np.abs(joints.coordinates(joint, joints.pose_of(joint, q)) - q).max() < 1e-12


def test_a_joint_followed_backwards_keeps_its_coordinate():
    """The parent hangs on the child where only the child is held: same angle, same pose."""
    rng = np.random.default_rng(2)

    def frame() -> np.ndarray:
        q = rng.normal(size=4)
        return np.r_[rng.normal(size=3), q / np.linalg.norm(q)]

    for axis in ("rx", "ry", "rz", "tx", "ty", "tz"):
        zero = np.zeros(1)
        joint = joints.Joint("j", JointType.D6, 0, 1, frame(), frame(), (axis,), zero, zero, zero, np.zeros((1, 2)), np.zeros((1, 5)))
        back, q = joints.turned(joint), np.array([0.7])
        child = joints.compose(joints.compose(joint.parent_frame, joints.pose_of(joint, q)), joints.inverse(joint.child_frame))
        parent = joints.compose(joints.compose(back.parent_frame, joints.pose_of(back, q)), joints.inverse(back.child_frame))
        assert np.abs(joints.compose(child, parent)[:3]).max() < 1e-12
        assert abs(abs(joints.compose(child, parent)[6]) - 1.0) < 1e-12


# ------------------------------------------------------------------------------------------------------------------- motion


def pendulum(lengths=(1.0,), masses=(1.0,), inertia=1e-12, angle=np.pi / 2) -> wl.Model:
    """Point masses on massless links in the x-y plane, gravity along -y, at `angle` from the vertical; joints about z."""
    builder = wl.ModelBuilder(gravity=(0, -GRAVITY, 0), up_axis="Y")
    parent, along = -1, np.array([np.sin(angle), -np.cos(angle), 0.0])
    turn, place = joints.about(2, angle - np.pi / 2), np.zeros(3)
    for length, mass in zip(lengths, masses, strict=True):
        place = place + length * along
        body = builder.add_body(pose=np.r_[place, turn], mass=mass, inertia=inertia * np.eye(3))
        first = (0, 0, 0, *ABOUT_Z)
        builder.add_joint(JointType.REVOLUTE, parent, body, parent_frame=first, child_frame=(-length, 0, 0, *ABOUT_Z))
        parent = body
    return builder.finalize()


def chain_end(n: int, length: float, mass: float, end: float, time: float) -> np.ndarray:
    """Where the last of n point masses on massless links is, released at rest at a right angle; DOP853 in angles."""
    masses = np.r_[np.full(n - 1, mass), end]
    below = np.cumsum(masses[::-1])[::-1]
    pairs = below[np.maximum.outer(range(n), range(n))] * length**2

    def rates(_, y):
        angle, w = y[:n], y[n:]
        d = angle[:, None] - angle[None, :]
        force = -(pairs * np.sin(d)) @ w**2 - below * GRAVITY * length * np.sin(angle)
        return np.r_[w, np.linalg.solve(pairs * np.cos(d), force)]

    angle = solve_ivp(rates, (0, time), np.r_[np.full(n, np.pi / 2), np.zeros(n)], method="DOP853", rtol=1e-11, atol=1e-12).y[:n, -1]
    return length * np.array([np.sin(angle).sum(), -np.cos(angle).sum()])


def test_chain_with_a_heavy_end():
    """Ten links, 0.1 kg each and 100 kg at the end: after 0.5 s within 2 h of the converged angles, half of it at half the step."""
    known = chain_end(10, 0.1, 0.1, 100.0, 0.5)
    model, errors = pendulum([0.1] * 10, [0.1] * 9 + [100.0]), []
    for h in (1e-3, 5e-4):
        sim = simulator(model, dt=h)
        sim.step(round(0.5 / h))
        errors.append(np.linalg.norm(sim.body_pose.numpy()[0, -1, :2] - known))
        assert not sim.status.numpy().any()
    assert errors[0] < 4e-3
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("h", [2e-3, 5e-3, 1e-2])
def test_chain_with_a_heavy_end_in_long_steps(h):
    """Its links swing at up to 1100 rad/s, which no explicit step of 2 ms and more follows: nothing blows up, no energy is made.

    Within h m of where it should be after 2 s; 1 % of the energy that it had may come and go.
    """
    known = chain_end(10, 0.1, 0.1, 100.0, 2.0)
    model = pendulum([0.1] * 10, [0.1] * 9 + [100.0])
    sim = simulator(model, dt=h)
    highest = -np.inf
    for _ in range(round(2.0 / h)):
        sim.step()
        pose, velocity = sim.body_pose.numpy()[0].copy(), sim.body_velocity.numpy()[0].copy()
        highest = max(highest, float((model.mass * (GRAVITY * pose[:, 1] + 0.5 * (velocity[:, :3] ** 2).sum(axis=1))).sum()))
    assert np.linalg.norm(pose[-1, :2] - known) < 2.0 * h
    assert highest < 0.01 * 100.0 * GRAVITY


@pytest.mark.parametrize("speed", [30.0, 300.0, 3000.0])
def test_joints_that_no_step_resolves(speed):
    """Up to 30 rad a step, without weight: what links do to one another while they turn is out of reach, but nothing grows of it.

    Some velocities grow in the first steps, by turning from one pose to another, and none later. c at the velocities before the step, which
    grows with their square, ends in no number at all.
    """
    builder = wl.ModelBuilder(gravity=(0, 0, 0))
    bodies = [builder.add_body(pose=(0.2 * k, 0, 0, 0, 0, 0, 1), mass=1.0 + k, inertia=SMALL * (1 + k)) for k in range(4)]
    for k, axis in ((1, ABOUT_Z), (2, ABOUT_Y), (3, ABOUT_Z)):
        frames = {"parent_frame": (0.1, 0, 0, *axis), "child_frame": (-0.1, 0, 0, *axis)}
        builder.add_joint(JointType.REVOLUTE, bodies[k - 1], bodies[k], **frames)
    sim = simulator(builder, num_envs=16, dt=1e-2)
    start = speed * np.random.default_rng(3).normal(size=(16, sim.model.nv))
    sim.v.assign(start)
    highest = []
    for _ in range(10):
        sim.step(100)
        assert not sim.status.numpy().any()
        highest.append(np.abs(sim.v.numpy()).max())
    assert max(highest) < 10.0 * np.abs(start).max()
    assert max(highest[1:]) < 1.2 * highest[0]


def test_heavy_top_precesses():
    """Steady precession with spin 100 rad/s at 30 degrees: its rate, of first order in h."""
    i_1, i_3, mgl, spin, tilt = 0.1, 0.02, 0.5, 100.0, np.pi / 6
    a, b = i_1 * np.cos(tilt), i_3 * spin
    rate = (b - np.sqrt(b * b - 4 * a * mgl)) / (2 * a)
    arm = mgl / GRAVITY
    errors = []
    for h in (2e-3, 1e-3):
        builder = wl.ModelBuilder()
        inertia = np.diag([i_1 - arm**2, i_1 - arm**2, i_3])
        body = builder.add_body(pose=np.r_[np.zeros(3), joints.about(0, tilt)], mass=1.0, com=(0, 0, arm), inertia=inertia)
        builder.add_joint(JointType.SPHERICAL, -1, body)
        sim = simulator(builder, dt=h)
        sim.v.assign(np.array([[0.0, rate * np.sin(tilt), spin]]))
        sim.step(round(2.0 / h))
        axis = joints.rotate(sim.body_pose.numpy()[0, 0, 3:], np.array([0, 0, 1.0]))
        errors.append(abs(np.arctan2(axis[0], -axis[1]) / 2.0 - rate) / rate)
        assert abs(np.degrees(np.arccos(axis[2])) - 30.0) < 0.1
    assert errors[0] < 0.02
    assert errors[1] < 0.7 * errors[0]


def test_free_flip_keeps_its_energy():
    """A body on a ball that nothing pulls: energy to 1e-9, momentum to the first order of the step in direction only."""
    inertia = np.diag([0.1, 0.2, 0.3])
    builder = wl.ModelBuilder(gravity=(0, 0, 0))
    body = builder.add_body(mass=1.0, inertia=inertia)
    builder.add_joint(JointType.SPHERICAL, -1, body)
    sim = simulator(builder, dt=1e-2)
    sim.v.assign(np.array([[0.001, 5.0, 0.0]]))
    energy = []
    for _ in range(1000):
        sim.step()
        w = sim.v.numpy()[0]
        energy.append(0.5 * w @ inertia @ w)
    assert max(energy) < 2.5 * (1 + 1e-6)
    assert min(energy) > 2.5 * (1 - 1e-6)


def crank(h: float, loop: bool = True, method: str = "auto") -> wl.Simulator:
    """A four-bar of lengths 1 (ground), 0.3, 0.9, 0.6, which turns all round, its last hinge a loop."""
    ground, a, b, c = 1.0, 0.3, 0.9, 0.6
    # The crank along x: where the other two links meet.
    x = (b**2 - c**2 + ground**2 - a**2) / (2 * (ground - a))
    meet = np.array([x, np.sqrt(b**2 - (x - a) ** 2), 0.0])
    builder = wl.ModelBuilder(gravity=(0, -GRAVITY, 0), up_axis="Y")

    def link(start: np.ndarray, end: np.ndarray, mass: float) -> int:
        turn = joints.about(2, np.arctan2(*(end - start)[1::-1]))
        length = np.linalg.norm(end - start)
        return builder.add_body(pose=np.r_[0.5 * (start + end), turn], mass=mass, inertia=np.diag([0.01, 1.0, 1.0]) * mass * length**2 / 12)

    bodies = [link(np.zeros(3), np.array([a, 0, 0]), 3.0), link(np.array([a, 0, 0]), meet, 9.0), link(np.array([ground, 0, 0]), meet, 6.0)]
    ends = [(-1, bodies[0], (0, 0), -a / 2), (bodies[0], bodies[1], (a / 2, 0), -b / 2), (-1, bodies[2], (ground, 0), -c / 2)]
    for parent, child, at, back in ends:
        frames = {"parent_frame": (*at, 0, *ABOUT_Z), "child_frame": (back, 0, 0, *ABOUT_Z)}
        builder.add_joint(JointType.REVOLUTE, parent, child, **frames)
    frames = {"parent_frame": (b / 2, 0, 0, *ABOUT_Z), "child_frame": (c / 2, 0, 0, *ABOUT_Z)}
    builder.add_joint(JointType.REVOLUTE, bodies[1], bodies[2], loop=loop, **frames)
    return simulator(builder, dt=h, method=method)


def opening(sim: wl.Simulator) -> float:
    """How far the loop of `crank` is open [m]."""
    pose = sim.body_pose.numpy()[0]
    ends = [pose[b, :3] + joints.rotate(pose[b, 3:], np.array([x, 0, 0])) for b, x in ((1, 0.45), (2, 0.3))]
    return float(np.linalg.norm(ends[0] - ends[1]))


def test_loop_neither_opens_nor_grows():
    """What a step opens, of second order in h, the next one takes back; the last second is no worse than the first."""
    worst = []
    for h in (4e-3, 2e-3):
        sim = crank(h)
        sim.v.assign(np.array([[6.0, *np.zeros(2)]]))
        gaps = []
        for _ in range(round(4.0 / h)):
            sim.step()
            gaps.append(opening(sim))
            assert not sim.status.numpy().any()
        quarter = len(gaps) // 4
        assert max(gaps[-quarter:]) < 1.5 * max(gaps[:quarter])
        worst.append(max(gaps[quarter:]))
    assert worst[0] < 4e-3
    assert 3.0 < worst[0] / worst[1] < 5.5


# -------------------------------------------------------------------------------------------------- limits, drives, friction


def slider(mass: float = 1.0, **options) -> wl.ModelBuilder:
    """A body that moves up and down."""
    builder = wl.ModelBuilder()
    body = builder.add_body(mass=mass, inertia=SMALL)
    builder.add_joint(JointType.PRISMATIC, -1, body, parent_frame=(0, 0, 0, *UP), child_frame=(0, 0, 0, *UP), **options)
    return builder


@pytest.mark.parametrize("formulation", ["phantom_inertia", "coulomb"])
def test_limit_stops_a_fall(formulation):
    """From 0.3 m/s down on its limit: there it stays, within what its spring of 1e10 N/m a kg gives, and nothing bounces."""
    sim = simulator(slider(limit=(-0.2, 0.1)), dt=1e-3, formulation=formulation)
    sim.step(1000)
    assert abs(sim.q.numpy()[0, 0] + 0.2) < 1e-6
    assert abs(sim.v.numpy()[0, 0]) < 1e-9
    assert not sim.status.numpy().any()
    sim.wrench.assign(np.array([[[0, 0, 30.0, 0, 0, 0]]]))
    sim.step(1000)
    assert abs(sim.q.numpy()[0, 0] - 0.1) < 1e-6


@pytest.mark.parametrize("force", [5.0, 20.0, np.inf])
def test_drive_with_a_greatest_force(force):
    """1000 N/m and 50 N s/m to 0.2 m: it hangs where the spring carries it, or falls with what the drive does not carry."""
    sim = simulator(slider(drive=Drive(1000.0, 50.0, force, target=0.2)), dt=1e-3)
    sim.step(2000)
    q, v = sim.q.numpy()[0, 0], sim.v.numpy()[0, 0]
    if force < GRAVITY:
        assert v == pytest.approx(-(GRAVITY - force) * 2.0, rel=1e-9)
    else:
        assert q == pytest.approx(0.2 - GRAVITY / 1000.0, abs=1e-9)
        assert abs(v) < 1e-9
    assert not sim.status.numpy().any()


@pytest.mark.parametrize(("force", "states"), [(20.0, {True}), (60.0, {True, False}), (np.inf, {False})])
def test_what_a_drive_gave_follows_from_the_state_behind_a_step(force, states):
    """Its law there is all that changes the momentum beside the weight (docs/robots.md): at its bound in every step, in some or in none."""
    h, mass, bounded = 2e-3, 3.0, set()
    sim = simulator(slider(mass, drive=Drive(1000.0, 50.0, force, target=0.2, target_velocity=0.1)), dt=h)
    for _ in range(100):
        v = sim.v.numpy()[0, 0]
        sim.step()
        after = sim.v.numpy()[0, 0]
        law = 1000.0 * (0.2 - sim.q.numpy()[0, 0]) + 50.0 * (0.1 - after)
        bounded.add(bool(abs(law) > force))
        assert mass * ((after - v) / h + GRAVITY) == pytest.approx(np.clip(law, -force, force), abs=1e-10)
    assert bounded == states


def test_stiff_drive_is_stable():
    """1e9 N/m with steps of 10 ms: there after a step, and it stays."""
    sim = simulator(slider(drive=Drive(1e9, 1e6, target=0.2)), dt=1e-2)
    sim.step(100)
    assert sim.q.numpy()[0, 0] == pytest.approx(0.2, abs=1e-7)


def test_dry_friction_of_a_joint():
    """Less than the weight slows the fall, more holds it: 1e-9 of a step's fall is what it gives way by."""
    sim = simulator(slider(friction=9.0), dt=1e-3)
    sim.step(1000)
    assert sim.v.numpy()[0, 0] == pytest.approx(-(GRAVITY - 9.0), rel=1e-9)
    sim = simulator(slider(friction=10.0), dt=1e-3)
    sim.step(1000)
    assert abs(sim.v.numpy()[0, 0]) < 1e-8


def test_mobility_of_rows_of_a_velocity():
    """w of limits, drives and dry friction is scale^2 (M^-1)_ii: what relaxes them, and what weighs their impulses.

    Other methods find the answer where it is wrong, so that no motion shows it. To 1e-12: two ways to the same number, cond M below 1e3.
    """
    builder = wl.ModelBuilder(gravity=(0, 0, 0))
    parent, frame = -1, (0, 0, 0, *ABOUT_Z)
    for k in range(3):
        body = builder.add_body(pose=(k + 1.0, 0, 0, 0, 0, 0, 1), mass=1.0 + k, inertia=0.1 * np.eye(3))
        parts = {"limit": (0.0, 1.0), "drive": Drive(10.0, 1.0, 5.0), "friction": 0.1, "armature": 0.2}
        builder.add_joint(JointType.REVOLUTE, parent, body, parent_frame=frame, child_frame=(-1, *frame[1:]), **parts)
        parent = body
    sim = simulator(builder.finalize(), dt=1e-3)
    mass = sim.mass_matrix().numpy()[0]
    assert np.linalg.cond(mass) < 1e3
    mobility = np.linalg.inv(mass).diagonal()
    sim.step()
    assert sim.rows.count.numpy()[0] == 3  # rows of the upper limits have nothing to do
    scale = sim.mechanics.row_scale.numpy()[0]
    scale = scale[scale[:, 0] != 0.0]
    assert (scale > 0.0).all()
    np.testing.assert_allclose(sim.rows.inv_mass.numpy()[0, :3], scale**2 * mobility[:, None], rtol=1e-12)


def test_damping_is_implicit():
    """v dies at exp(-d t / m), to first order of the step; a damper that is far stiffer than the step stops it and no more."""
    sim = simulator(slider(damping=2.0), dt=1e-3)
    sim.step(1000)
    assert sim.v.numpy()[0, 0] == pytest.approx(-GRAVITY / 2.0 * (1 - np.exp(-2.0)), rel=2e-3)
    sim = simulator(slider(damping=1e9), dt=1e-2)
    sim.step(100)
    assert sim.v.numpy()[0, 0] == pytest.approx(-GRAVITY / 1e9, rel=1e-9)


def test_distance_joint_is_a_string():
    """A mass on a string of 1.5 m swings freely inside and no further than that outside."""
    builder = wl.ModelBuilder()
    body = builder.add_body(pose=(0.5, 0, 0, 0, 0, 0, 1), mass=1.0, inertia=SMALL)
    builder.add_distance(-1, body, 0.0, 1.5)
    sim = simulator(builder, dt=1e-3)
    furthest = 0.0
    for k in range(2000):
        sim.step()
        where = sim.q.numpy()[0, :3]
        furthest = max(furthest, float(np.linalg.norm(where)))
        if k == 400:
            assert where[2] == pytest.approx(-0.5 * GRAVITY * 0.401**2, rel=5e-3)  # before the string is taut
        assert not sim.status.numpy().any()
    assert 1.49 < furthest < 1.5 + 1e-4


# ------------------------------------------------------------------------------------------------------ contacts on trees


@pytest.mark.parametrize("method", ["auto", "proximal_newton", "pgs", "lemke"])
def test_contacts_beside_a_tree_are_those_without(method):
    """The paper's box slides as it does alone when a pendulum swings 100 m away, by every method."""

    def scene(pendulum: bool) -> wl.ModelBuilder:
        builder = wl.ModelBuilder()
        rough = wl.Material(1.0, 1.0)
        builder.add_plane(material=rough)
        body = builder.add_body(pose=(0, 0, 0.5, 0, 0, 0, 1), velocity=(0, 5.0, 0), angular_velocity=(0, 0, 2 * np.pi), mass=1.0)
        builder.add_box(body, (0.5, 0.5, 0.5), material=rough)
        if pendulum:
            other = builder.add_body(pose=(100, 0, 5, 0, 0, 0, 1), mass=1.0, inertia=0.1 * np.eye(3))
            frames = {"parent_frame": (99, 0, 5, *ABOUT_Y), "child_frame": (-1, 0, 0, *ABOUT_Y)}
            builder.add_joint(JointType.REVOLUTE, -1, other, **frames)
        return builder

    sims = [simulator(scene(far), dt=2e-3, method=method) for far in (False, True)]
    for sim in sims:
        sim.step(300)
    difference = np.abs(sims[0].body_pose.numpy()[0, 0] - sims[1].body_pose.numpy()[0, 0]).max()
    assert difference < 1e-9


def test_box_of_two_halves():
    """Two half boxes welded together slide as one: stop distance v^2 / (2 mu g), less h v / 2 of Euler's rule."""
    builder = wl.ModelBuilder()
    material = wl.Material(0.5, 0.5)
    builder.add_plane(material=material)
    halves = [builder.add_body(pose=(0.1 * s, 0, 0.1, 0, 0, 0, 1), velocity=(0, 3.0, 0)) for s in (-1, 1)]
    for body in halves:
        builder.add_box(body, (0.1, 0.1, 0.1), material=material)
    builder.add_joint(JointType.FIXED, halves[0], halves[1], parent_frame=(0.1, 0, 0, 0, 0, 0, 1), child_frame=(-0.1, 0, 0, 0, 0, 0, 1))
    h = 1e-3
    sim = simulator(builder, dt=h)
    assert sim.model.nv == 6
    sim.step(1000)
    assert sim.body_pose.numpy()[0, 0, 1] == pytest.approx(9.0 / (2 * 0.5 * GRAVITY) - 0.5 * h * 3.0, abs=2e-5)
    assert not sim.status.numpy().any()


def test_arm_presses_on_the_ground():
    """A hinged beam leans on its far end: the ground, without friction, carries half its weight."""
    builder = wl.ModelBuilder()
    builder.add_plane(material=wl.Material(0.0, 0.0))
    beam = builder.add_body(pose=(0.5, 0, 0.1, 0, 0, 0, 1), mass=2.0, com=(0, 0, 0), inertia=SMALL)
    builder.add_sphere(beam, 0.1, pose=(0.5, 0, 0, 0, 0, 0, 1), material=wl.Material(0.0, 0.0))
    frames = {"parent_frame": (0, 0, 0.1, *ABOUT_Y), "child_frame": (-0.5, 0, 0, *ABOUT_Y)}
    builder.add_joint(JointType.REVOLUTE, -1, beam, **frames)
    sim = simulator(builder, dt=1e-3)
    sim.step(500)
    assert sim.contacts.count.numpy()[0] == 1
    assert sim.contacts.impulse.numpy()[0, 0, 0] / 1e-3 == pytest.approx(GRAVITY, rel=1e-6)
    assert np.abs(sim.v.numpy()).max() < 1e-9
    assert not sim.status.numpy().any()


def test_a_loop_between_what_forces_do_not_move_is_nothing():
    """A belt hinged to the world moves on as it does."""
    builder = slider()
    belt = builder.add_body(joint=JointType.KINEMATIC, velocity=(1.0, 0, 0))
    builder.add_joint(JointType.REVOLUTE, -1, belt, loop=True)
    sim = simulator(builder, dt=1e-2)
    sim.step(100)
    assert sim.body_pose.numpy()[0, 1, 0] == pytest.approx(1.0)
    assert not sim.status.numpy().any()


# ------------------------------------------------------------------------------------------------------------ bad input


def test_joints_that_are_none():
    builder = wl.ModelBuilder()
    body = builder.add_body("a", mass=1.0, inertia=SMALL)
    cases = [
        ({"type": JointType.REVOLUTE, "parent": -1, "child": 7}, "body 7 does not exist"),
        ({"type": JointType.REVOLUTE, "parent": body, "child": body}, "to itself"),
        ({"type": JointType.FREE, "parent": -1, "child": body}, "no joint between bodies"),
        ({"type": JointType.D6, "parent": -1, "child": body, "axes": ("rx", "up")}, "give some of tx"),
        ({"type": JointType.REVOLUTE, "parent": -1, "child": body, "axes": ("rx",)}, "are for D6"),
        ({"type": JointType.REVOLUTE, "parent": -1, "child": body, "limit": (1.0, -1.0)}, "leaves no room"),
        ({"type": JointType.REVOLUTE, "parent": -1, "child": body, "damping": -1.0}, "not negative"),
        (
            {"type": JointType.REVOLUTE, "parent": -1, "child": body, "drive": Drive(-1.0)},
            "stiffness of its drive is -1; it must be finite and not",
        ),
        ({"type": JointType.REVOLUTE, "parent": -1, "child": body, "drive": Drive(1.0, 1.0, np.nan)}, "max_force of its drive is nan"),
        (
            {"type": "revolute", "parent": -1, "child": body},
            "'revolute' is no type of joint; give one of JointType.FIXED, JointType.REVOLUTE",
        ),
        ({"type": JointType.REVOLUTE, "parent": -1, "child": "a"}, "body 'a' does not exist; add_body returns the index"),
        ({"type": JointType.SPHERICAL, "parent": -1, "child": body, "limit": [(-1, 1)] * 3}, "no angles to limit"),
    ]
    for options, message in cases:
        with pytest.raises(wl.WarpLcpError, match=message):
            builder.add_joint(**options)
    with pytest.raises(wl.WarpLcpError, match="no range"):
        builder.add_distance(-1, body, 2.0, 1.0)
    builder.add_joint(JointType.REVOLUTE, -1, body, name="hip")
    with pytest.raises(wl.WarpLcpError, match="hip: a joint of this name exists already"):
        builder.add_joint(JointType.REVOLUTE, -1, body, name="hip")


def test_a_start_beyond_a_limit_is_told():
    builder = slider()
    arm = builder.add_body("arm", mass=1.0, inertia=SMALL)
    builder.add_joint(JointType.REVOLUTE, 0, arm, limit=(-0.1, 0.1), start=1.0, name="elbow")
    (told,) = builder.finalize().report.notes
    assert told == "elbow (at 1, limits -0.1 .. 0.1): starts beyond its limits, which push it back at once"


# -------------------------------------------------------------------------------------------------------------- a robot


def quadruped(thigh: float = 0.6, knee: float = -1.2) -> wl.ModelBuilder:
    """A base of 6 kg on four legs of three driven hinges each, feet on the ground where the knees are bent as given."""
    builder = wl.ModelBuilder()
    rubber = wl.Material(0.8, 0.8)
    builder.add_plane(material=rubber)
    upper, lower, foot = 0.2, 0.2, 0.025
    height = upper * np.cos(thigh) + lower * np.cos(thigh + knee) + foot
    base = builder.add_body("base", pose=(0, 0, height, 0, 0, 0, 1), mass=6.0)
    builder.add_box(base, (0.2, 0.1, 0.05), material=rubber)
    drive = Drive(200.0, 5.0, 60.0)
    for x, y in ((0.2, 0.125), (0.2, -0.125), (-0.2, 0.125), (-0.2, -0.125)):  # thighs 5 mm beside the base
        hip = np.array([x, y, height])
        turns = [joints.about(1, 0.0), joints.about(1, thigh), joints.about(1, thigh + knee)]
        down = [joints.rotate(turn, np.array([0, 0, -1.0])) for turn in turns]
        places = [hip, hip, hip + upper * down[1]]
        link = [
            builder.add_body(pose=np.r_[place, turn], mass=mass, com=(0, 0, -arm), inertia=1e-3 * np.eye(3))
            for place, turn, mass, arm in zip(places, turns, (0.5, 0.5, 0.2), (0.0, upper / 2, lower / 2), strict=True)
        ]
        builder.add_capsule(link[1], 0.02, upper / 2 - 0.02, pose=(0, 0, -upper / 2, 0, 0, 0, 1), material=rubber)
        builder.add_sphere(link[2], foot, pose=(0, 0, -lower, 0, 0, 0, 1), material=rubber)
        same = (0, 0, 0, 0, 0, 0, 1)
        builder.add_joint(
            JointType.REVOLUTE, base, link[0], parent_frame=(x, y, 0, 0, 0, 0, 1), child_frame=same, limit=(-0.8, 0.8), drive=drive
        )
        for parent, child, at, low, high, target in (
            (link[0], link[1], 0.0, -1.5, 1.5, thigh),
            (link[1], link[2], -upper, -2.5, -0.2, knee),
        ):
            frames = {"parent_frame": (0, 0, at, *ABOUT_Y), "child_frame": (0, 0, 0, *ABOUT_Y)}
            builder.add_joint(JointType.REVOLUTE, parent, child, limit=(low, high), drive=replace(drive, target=target), **frames)
    return builder


def test_quadruped_stands():
    """Under position drives at 5 ms: every step certified, the base sinks by what its drives give and stays there."""
    sim = simulator(quadruped(), num_envs=4, dt=5e-3)
    start = sim.body_pose.numpy()[0, 0, :3].copy()
    for _ in range(400):
        sim.step()
        assert not sim.status.numpy().any()
    pose = sim.body_pose.numpy()[0, 0, :3].copy()
    sim.step(200)
    later = sim.body_pose.numpy()[:, 0, :3]
    assert np.abs(pose[:2] - start[:2]).max() < 0.02
    assert 0.0 < start[2] - pose[2] < 0.05
    assert np.abs(later - pose).max() < 1e-6
    # The feet carry the weight, whatever each of them does.
    carried = sim.contacts.impulse.numpy()[0, : sim.contacts.count.numpy()[0], 0].sum() / 5e-3
    assert carried == pytest.approx(sim.model.mass.sum() * GRAVITY, rel=1e-6)


def test_control_moves_the_joints():
    """New targets by environment, feed-forward forces, and a reset that gives the model's back."""
    builder = wl.ModelBuilder(gravity=(0, 0, 0))
    body = builder.add_body(mass=1.0, inertia=SMALL)
    frames = {"parent_frame": (0, 0, 0, *UP), "child_frame": (0, 0, 0, *UP)}
    builder.add_joint(JointType.PRISMATIC, -1, body, drive=Drive(100.0, 20.0), **frames)
    sim = simulator(builder, num_envs=3, dt=5e-3)
    sim.control.position.assign(np.array([[0.1], [0.2], [0.0]]))
    sim.control.force.assign(np.array([[0.0], [0.0], [5.0]]))
    sim.step(600)
    assert sim.q.numpy()[:, 0] == pytest.approx([0.1, 0.2, 0.05], abs=1e-6)
    sim.reset(np.array([True, False, False]))
    sim.step(600)
    assert sim.q.numpy()[:, 0] == pytest.approx([0.0, 0.2, 0.05], abs=1e-6)
    assert simulator(paper_box()).control is None


def test_scenes_without_joints_compile_no_kernel_of_joints():
    """What a box on the ground compiles has nothing of tree.py, articulated.py, landing.py or joint_rows.py, which a robot's has."""
    builder = wl.ModelBuilder()
    builder.add_plane()
    builder.add_box(builder.add_body(pose=(0, 0, 0.1, 0, 0, 0, 1)), (0.1, 0.1, 0.1))
    found = []
    for scene in (builder, quadruped()):
        sim = wl.Simulator(scene.finalize(), device=DEVICE)
        found.append({kernel.func.__code__.co_filename.rpartition("/")[2] for kernel in sim.kernels})
    assert not found[0] & {"tree.py", "articulated.py", "landing.py", "joint_rows.py"}
    assert found[1] >= {"articulated.py", "landing.py"}
