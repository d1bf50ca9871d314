# SPDX-License-Identifier: Apache-2.0
"""Batches: environments are independent to the last bit, failures stay where they are, parameters differ per environment."""

import ast
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import warp as wp
import warp_lcp.kernels
from conftest import DEVICE, block_on_plane, paper_box, random_quaternions, simulator
from conftest import GRAVITY as G

import warp_lcp as wl
from warp_lcp import methods


def boxes_far_apart(n: int) -> wl.ModelBuilder:
    """On a plane, at rest."""
    builder = wl.ModelBuilder()
    builder.add_plane()
    for k in range(n):
        builder.add_box(builder.add_body(pose=(0.3 * k, 0, 0.1, 0, 0, 0, 1)), (0.1, 0.1, 0.1))
    return builder


METHOD_NAMES = {"VelocityPivoting": "velocity_pivoting", "ProximalNewton": "proximal_newton", "BlockPGS": "pgs"}


def bits(sim: wl.Simulator) -> np.ndarray:
    """State of every environment as integers, so that equality means equal bits."""
    kind = np.uint64 if sim.precision == "float64" else np.uint32
    return np.concatenate([sim.q.numpy(), sim.v.numpy()], axis=1).view(kind)


def randomised(envs: int, which=slice(None), **options) -> wl.Simulator:
    """Tumbling blocks with their own mass, inertia, friction, gravity and start."""
    rng = np.random.default_rng(3)
    model = block_on_plane(0.5, half=(0.2, 0.15, 0.1)).finalize()
    scale = rng.uniform(0.5, 2.0, (envs, 1))
    inertia = model.inertia * rng.uniform(0.8, 1.2, (envs, 1, 1, 1)) * scale[..., None, None]
    mu = np.repeat(rng.uniform(0.1, 1.0, (envs, 1, 1)), 2, axis=1)
    friction = np.concatenate([mu, 0.8 * mu], axis=2)
    gravity = np.array([0, 0, -G]) * rng.uniform(0.5, 1.5, (envs, 1))
    q = np.zeros((envs, 7))
    q[:, 2], q[:, 3:] = 0.4, random_quaternions(rng, envs)
    v = rng.normal(size=(envs, 6))
    pick = np.arange(envs)[which]
    sim = simulator(model, len(pick), 2e-3, **options)
    sim.set_parameters(mass=(model.mass * scale)[pick], inertia=inertia[pick], friction=friction[pick], gravity=gravity[pick])
    sim.q.assign(q[pick])
    sim.v.assign(v[pick])
    return sim


@pytest.mark.parametrize("method", ["auto", "pgs"])
def test_equal_environments_stay_equal(method):
    sim = simulator(paper_box(), 33, 1e-2, method=method)
    sim.step(80)
    assert (bits(sim) == bits(sim)[0]).all()


@pytest.mark.parametrize(
    "options", [{}, {"method": "pgs", "precision": "float32"}, {"integrator": "midpoint"}], ids=["auto", "pgs float32", "midpoint"]
)
def test_a_batch_is_bit_identical_to_its_environments_alone(options):
    """1024 environments with their own mu, m, I; then the same alone, in another batch, and the whole once more."""
    whole = randomised(1024, **options)
    whole.step(300)
    again = randomised(1024, **options)
    again.step(300)
    assert (bits(whole) == bits(again)).all()
    assert np.isfinite(whole.q.numpy()).all()
    for which in ([0], [511], [1023], [100, 7, 900]):
        alone = randomised(1024, which, **options)
        alone.step(300)
        assert (bits(alone) == bits(whole)[which]).all()
    assert len(np.unique(bits(whole), axis=0)) == 1024


def test_steps_one_by_one_equal_steps_together():
    together, one_by_one = randomised(4), randomised(4)
    together.step(100)
    for _ in range(100):
        one_by_one.step()
    assert (bits(together) == bits(one_by_one)).all()


def test_recorded_steps_equal_eager_steps():
    """The captured graph and plain launches do the same."""
    recorded, eager = randomised(4), randomised(4)
    recorded.step(100)
    for _ in range(100):
        eager._step_kernels()
    assert (bits(recorded) == bits(eager)).all()


@pytest.mark.parametrize("shape", ["sphere", "box", "capsule", "cylinder", "cone", "ellipsoid", "hull"])
@pytest.mark.parametrize("ground", ["plane", "box", "mesh"])
def test_environments_of_every_shape_on_every_ground_are_alike(shape, ground):
    """Those of a batch end as one alone does: threads of the CPU walk over all of them."""
    builder = wl.ModelBuilder()
    if ground == "plane":
        builder.add_plane()
    elif ground == "box":
        builder.add_box(-1, (5, 5, 0.5), pose=(0, 0, -0.5, 0, 0, 0, 1))
    else:
        builder.add_mesh(-1, [(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)], [(0, 1, 2), (0, 2, 3)])
    body = builder.add_body(pose=(0, 0, 0.21 if shape == "capsule" else 0.11, 0, 0, 0, 1), velocity=(0.5, 0.2, 0))
    if shape == "hull":
        builder.add_hull(body, [(x, y, z) for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
    else:
        sizes = {"sphere": (0.1,), "box": ((0.1, 0.1, 0.1),), "ellipsoid": ((0.1, 0.12, 0.1),)}
        getattr(builder, f"add_{shape}")(body, *sizes.get(shape, (0.1, 0.1)))
    alone, batch = simulator(builder, dt=2e-3), simulator(builder, 4, dt=2e-3)
    for sim in (alone, batch):
        sim.step(100)
    assert (bits(batch) == bits(alone)).all()
    assert 0.05 < alone.q.numpy()[0, 2] < 0.21


def test_no_kernel_assigns_to_its_parameters():
    """On the CPU the next environment of the same thread would find them changed."""
    kernels = 0
    for file in Path(warp_lcp.kernels.__path__[0]).glob("*.py"):
        for function in ast.walk(ast.parse(file.read_text())):
            if isinstance(function, ast.FunctionDef) and any(ast.unparse(d).startswith("kernel(") for d in function.decorator_list):
                stored = {n.id for n in ast.walk(function) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
                assert not stored & {argument.arg for argument in function.args.args}, (file.name, function.name)
                kernels += 1
    assert kernels > 50


@pytest.mark.parametrize("integrator", ["euler", "midpoint"])
@pytest.mark.parametrize("joints", [False, True])
def test_bodies_are_where_the_last_step_of_a_call_brought_them(joints, integrator):
    """Arrays that somebody holds, without asking for them again, beside those of a simulator that is given the same q and v."""
    builder = wl.ModelBuilder()
    builder.add_plane()
    for x in (0.0, 0.5):
        builder.add_box(builder.add_body(pose=(x, 0, 0.2, 0, 0, 0, 1), velocity=(1, 0, -1), angular_velocity=(0, x, 0)), (0.1, 0.1, 0.1))
    if joints:
        builder.add_joint(wl.JointType.REVOLUTE, 0, 1, parent_frame=(0.25, 0, 0, 0, 0, 0, 1), child_frame=(-0.25, 0, 0, 0, 0, 0, 1))
    sim, other = simulator(builder, 2, integrator=integrator), simulator(builder, 2, integrator=integrator)
    pose, velocity = sim.body_pose, sim.body_velocity
    for steps in (1, 3, 100, 1):
        sim.step(steps)
        other.q.assign(sim.q)
        other.v.assign(sim.v)
        assert (pose.numpy() == other.body_pose.numpy()).all()
        assert (velocity.numpy() == other.body_velocity.numpy()).all()
    run = sim.rollout(5)
    other.q.assign(run.q[4])
    other.v.assign(run.v[4])
    assert (pose.numpy() == other.body_pose.numpy()).all()
    assert (velocity.numpy() == other.body_velocity.numpy()).all()
    run = sim.rollout(4, record=("q", "v", "body_pose", "body_velocity"), every=2)
    for row in range(2):
        other.q.assign(run.q[row])
        other.v.assign(run.v[row])
        assert (run.body_pose.numpy()[row] == other.body_pose.numpy()).all()
        assert (run.body_velocity.numpy()[row] == other.body_velocity.numpy()).all()


def test_memory_layout_and_threads_of_a_gpu_give_the_same_bits(monkeypatch):
    """What a GPU does differently, done on the CPU: environments fastest in memory, a thread for each, several workspaces."""

    def pass_each_other():
        """Boxes, in reach of one another or not."""
        sim = simulator(boxes_far_apart(5), 40, 2e-3)
        sim.v.assign(np.random.default_rng(4).normal(size=sim.v.shape))
        return sim

    def kicked(name, **options):
        """A scene with joints, each of which starts at a velocity of its own."""
        sim = simulator(wl.load_usd(name), 20, 5e-3, **options)
        sim.v.assign(np.random.default_rng(4).normal(size=sim.v.shape))
        return sim

    jointed = [("quadruped", {}), ("quadruped", {"method": "proximal_newton"}), ("humanoid", {"integrator": "midpoint"})]
    cases = [(partial(kicked, name, **options), 60) for name, options in (*jointed, ("fourbar", {"project_loops": True}))]
    cases += [(partial(randomised, 40, **options), 200) for options in ({}, {"method": "lemke"}, {"integrator": "midpoint"})]
    cases += [(pass_each_other, 200)]
    expected = []
    for case, steps in cases:
        sim = case()
        sim.step(steps)
        expected.append(bits(sim))
    listed = np.diff(sim.listed.numpy()[:, :3])  # on the plane, on each other
    assert (listed[:, 0] == 5).all()
    assert 0 < listed[:, 1].max() < 10
    assert listed[:, 1].min() < listed[:, 1].max()

    def array(self, n, dtype):
        return wp.zeros((n, self.num_envs), dtype=dtype, device=self.device).transpose()

    def launch(self, kernel, inputs, width=1):
        wp.launch(kernel, dim=(self.num_envs, width), inputs=[*inputs, self.num_envs], device=self.device)

    monkeypatch.setattr(wl.Simulator, "_array", array)
    monkeypatch.setattr(wl.Simulator, "launch", launch)
    monkeypatch.setattr(wl.Simulator, "lanes", lambda self, number: number)
    monkeypatch.setattr("warp_lcp.methods.workspaces", lambda envs, scalars, device: 7)
    for (case, steps), same in zip(cases, expected, strict=True):
        sim = case()
        assert sim.q.strides[0] < sim.q.strides[1]
        sim.step(steps)
        assert (bits(sim) == same).all()


@pytest.mark.parametrize("name", ["VelocityPivoting", "ProximalNewton", "BlockPGS"])
def test_a_method_that_is_stopped_says_so(monkeypatch, name):
    """Alone and without a single sweep or step: not certified, and the limit is named as what stopped it."""
    method = getattr(methods, name)
    monkeypatch.setattr(method, "SWEEPS", 0, raising=False)
    monkeypatch.setattr(method, "LIMIT", 0, raising=False)
    monkeypatch.setattr(method, "NEWTON_LIMITS", (0, 0), raising=False)
    for model in (paper_box(), boxes_far_apart(2)):
        sim = simulator(model, method=METHOD_NAMES[name])
        sim.rows.impulse.fill_(1e3)  # nothing is left of what was there
        sim.v.assign(np.tile([0.0, 0.0, -1.0, 3.0, 0.0, 0.0], (1, sim.v.shape[1] // 6)))  # not solved at once
        sim.step()
        assert sim.status.numpy()[0] == wl.Status.ITERATION_LIMIT | wl.Status.UNCERTIFIED


@pytest.mark.parametrize("method", ["velocity_pivoting", "proximal_newton", "lemke"])
def test_workspaces_take_what_they_are_counted_at(monkeypatch, method):
    """Scalars a workspace, by which a GPU's memory is shared out, against the bytes that three of them take: 40 boxes."""
    counted = []

    def workspaces(envs, scalars, device):
        counted.append(scalars)
        return 3

    monkeypatch.setattr("warp_lcp.methods.workspaces", workspaces)
    (made,) = simulator(boxes_far_apart(40), method=method)._methods
    parts = [part for value in vars(made).values() for part in (value if isinstance(value, tuple) else (value,))]
    arrays = [getattr(part, name) for part in parts if hasattr(part, "_cls") for name in part._cls.vars]
    total = sum(a.capacity for a in arrays if a is not None and a.shape[0] == 3)
    assert total / 3 == pytest.approx(8 * counted[0], rel=0.03)


@pytest.mark.parametrize("method", ["auto", "velocity_pivoting", "proximal_newton", "pgs", "lemke"])
@pytest.mark.parametrize("entry", [0, 5])
def test_a_nan_in_a_kinematic_partner_is_flagged(method, entry):
    """Its contacts vanish, for a gap that is not a number is none; what is left of the problem is solved, and not OK."""
    builder = wl.ModelBuilder()
    builder.add_box(builder.add_body(pose=(0, 0, 0.1, 0, 0, 0, 1)), (0.1, 0.1, 0.1))
    builder.add_box(builder.add_body(pose=(0, 0, -0.1, 0, 0, 0, 1), joint=wl.JointType.KINEMATIC), (1, 1, 0.1))
    sim = simulator(builder, 2, method=method)
    sim.step(2)
    assert (sim.status.numpy() & wl.Status.NOT_A_NUMBER == 0).all()
    q = sim.q.numpy()
    q[1, 7 + entry] = np.nan
    sim.q.assign(q)
    sim.step()
    assert (sim.status.numpy() & wl.Status.NOT_A_NUMBER != 0).tolist() == [False, True]


def test_methods_come_in_any_order(monkeypatch):
    """One that makes its rows and judges its answers, behind another that gives up: it takes the rows there are."""
    monkeypatch.setattr(methods.BlockPGS, "SWEEPS", 0)
    monkeypatch.setitem(methods.METHODS, "auto", (methods.BlockPGS, methods.VelocityPivoting))
    alone, behind = simulator(paper_box(), 3, method="velocity_pivoting"), simulator(paper_box(), 3)
    for sim in (alone, behind):
        sim.step(20)
        assert (sim.status.numpy() == 0).all()
    assert behind.v.numpy() == pytest.approx(alone.v.numpy(), abs=1e-9)


def test_a_nan_is_flagged_contained_and_healed_by_a_masked_reset():
    fresh = simulator(paper_box(), 8)
    fresh.step(50)
    expected = bits(fresh)[0]

    sim = simulator(paper_box(), 8)
    sim.step(20)
    v = sim.v.numpy().copy()
    v[5, 1] = np.nan
    sim.v.assign(v)
    sim.step(30)
    assert sim.status.numpy()[5] & wl.Status.NOT_A_NUMBER
    others = np.arange(8) != 5
    assert (sim.status.numpy()[others] == 0).all()
    assert (bits(sim)[others] == expected).all()

    sim.reset(~others)
    sim.step(50)
    assert sim.status.numpy()[5] == 0
    assert (bits(sim)[5] == expected).all()


@pytest.mark.parametrize(("where", "index"), [("q", 0), ("q", 6), ("v", 0), ("v", 5), ("wrench", 0), ("wrench", 5)])
def test_no_nan_passes_silently(where, index):
    sim = simulator(paper_box(), 3)
    array = getattr(sim, where)
    values = array.numpy().copy()
    values.reshape(3, -1)[1, index] = np.inf if where == "wrench" else np.nan
    array.assign(values)
    sim.step()
    assert [bool(s & wl.Status.NOT_A_NUMBER) for s in sim.status.numpy()] == [False, True, False]


def test_reset_clears_contact_history():
    """A reset box repeats its first run to the bit; without clearing bristles and impulses it would not."""
    sim = simulator(paper_box(), 2, 1e-2)
    sim.step(40)
    first = bits(sim)
    sim.reset()
    sim.step(40)
    assert (bits(sim) == first).all()


def test_reset_forgets_what_was_about_to_hit():
    """A ball that hits a row in its first step, after a reset as from the start, bit by bit: no reach is left from the run before."""
    builder = wl.ModelBuilder(gravity=(0, 0, 0))
    for x, speed in ((-0.13, 5.0), (0.0, 0.0), (0.104, 0.0)):
        builder.add_sphere(builder.add_body(pose=(x, 0, 0, 0, 0, 0, 1), velocity=(speed, 0, 0)), 0.05)
    sim, fresh = (simulator(builder, dt=1e-2) for _ in range(2))
    sim.step()
    sim.reset()
    for each in (sim, fresh):
        each.step(3)
    np.testing.assert_array_equal(sim.q.numpy(), fresh.q.numpy())
    np.testing.assert_array_equal(sim.v.numpy(), fresh.v.numpy())


def test_reset_takes_warp_masks_and_new_start_states():
    sim = simulator(paper_box(), 3)
    q0 = sim.q0.numpy().copy()
    q0[:, 0] = [1, 2, 3]
    sim.q0.assign(q0)
    sim.step(5)
    sim.reset(wp.array([True, False, True], dtype=wp.bool, device=DEVICE))
    assert sim.q.numpy()[[0, 2], 0].tolist() == [1, 3]
    assert sim.q.numpy()[1, 0] != 2
    with pytest.raises(wl.WarpLcpError, match=r"mask has shape \(2,\); give \(3,\)"):
        sim.reset([True, False])


def test_changing_the_mass_updates_what_follows_from_it():
    """Ten times the mass: the same sliding acceleration, ten times the impulse, and the same deflection, for k_n scales."""
    sim = simulator(block_on_plane(0.5, mass=1.0), 2)
    sim.step(10)
    sim.set_parameters(mass=np.array([[1.0], [10.0]]))
    assert sim.parameters.inertia.numpy()[1, 0] == pytest.approx(10 * sim.parameters.inertia.numpy()[0, 0])
    sim.wrench.assign(np.tile([0, 0, 0, 0, 0, 0.0], (2, 1, 1)))
    sim.step(500)
    impulse = sim.contacts.impulse.numpy()[:, :4, 0].sum(axis=1)
    assert impulse == pytest.approx([G * 1e-3, 10 * G * 1e-3], rel=1e-6)
    assert 0.1 - sim.q.numpy()[:, 2] == pytest.approx(np.full(2, G / 4e10), rel=1e-3)


def test_what_a_pair_has_is_stored_once_unless_it_differs():
    """Coefficients for each environment where friction differs, contact parameters where masses or stiffnesses do."""
    sim = simulator(block_on_plane(0.5), 4)
    m = sim.model
    mu, mass = np.linspace(0.1, 0.4, 4), m.mass[0] * np.linspace(1.0, 4.0, 4)
    randomised_mass, randomised_friction = {"mass": mass[:, None]}, {"friction": np.tile(mu[:, None, None], (1, 2, 2))}
    for values, expected_mu, expected_mass in [
        (randomised_mass, [0.5], mass),
        (randomised_friction, mu, mass),
        ({"mass": m.mass}, mu, m.mass),
        ({"contact": np.tile(m.contact, (4, 1, 1))}, mu, np.tile(m.mass, 4)),
        ({"friction": m.friction, "contact": m.contact}, [0.5], m.mass),
    ]:
        sim.set_parameters(**values)
        friction, contact = sim.parameters.pair_friction.numpy(), sim.parameters.pair_contact.numpy()
        assert friction == pytest.approx(np.tile(np.reshape(expected_mu, (-1, 1, 1)), (1, 1, 2)))
        assert contact[:, 0, 0] == pytest.approx(1e10 * expected_mass)
        sim.step()


def test_parameters_reject_what_no_body_can_have():
    sim = simulator(paper_box(), 2)
    for values, message in [
        ({"mass": [0.0]}, r"mass\[0, 0\] is 0.0; it must be finite and greater than zero"),
        ({"mass": [[1.0], [np.nan]]}, r"mass\[1, 0\] is nan"),
        ({"friction": np.full((2, 2), -0.1)}, "it must be finite and not negative"),
        ({"friction": [[0.3, 0.9]] * 2}, "mu_k no larger than mu_s"),
        ({"contact": np.zeros((2, 5))}, "greater than zero"),
        ({"inertia": -np.eye(3)[None]}, "positive definite"),
        ({"inertia": [np.diag([1.0, 1.0, 3.0])]}, "no moment may exceed"),
        ({"inertia": [[[1, 0.9, 0], [0, 1, 0], [0, 0, 1]]]}, "must be symmetric"),
        ({"gravity": [0, 0]}, r"gravity has shape \(2,\); give \(3,\) or \(2, 3\)"),
        ({"weight": [1.0]}, "'weight' is not a parameter; choose from mass"),
    ]:
        with pytest.raises(wl.WarpLcpError, match=message):
            sim.set_parameters(**values)


def test_relaxation_may_differ_between_environments():
    """Static deflection m g / (4 k_n) for each environment's own stiffness."""
    sim = simulator(block_on_plane(0.5, mass=1.0), 3)
    contact = np.full((3, 2, 5), np.nan)
    contact[:, :, 0] = np.array([1e6, 1e8, 1e10])[:, None]
    sim.set_parameters(contact=contact)
    # b_n stays at 1e8 N s/m: the time to settle is b_n / k_n, so start with the deflection already there.
    q = sim.q.numpy().copy()
    deflection = G / (4 * np.array([1e6, 1e8, 1e10]))
    q[:, 2] -= deflection
    sim.q.assign(q)
    sim.step(100)
    assert 0.1 - sim.q.numpy()[:, 2] == pytest.approx(deflection, rel=1e-6)


def test_strict_raises_and_names_the_environment():
    sim = simulator(paper_box(), 4, strict=True)
    sim.step(3)
    v = sim.v.numpy().copy()
    v[2] = np.nan
    sim.v.assign(v)
    with pytest.raises(wl.SimulationError, match=r"1 of 4 environments are not OK .* environment 2, NOT_A_NUMBER"):
        sim.step()


def test_overflow_is_flagged_not_silent():
    """A block on nine planes at one place has 72 points, more than the 64 there is room for; the environment says so."""
    builder = wl.ModelBuilder()
    for _ in range(9):
        builder.add_plane()
    body = builder.add_body(pose=(0, 0, 0.1, 0, 0, 0, 1))
    builder.add_box(body, (0.1, 0.1, 0.1), pose=(0, 0, 0, 0, 0, 0, 1))
    model = builder.finalize()
    assert (model.num_slots, model.max_contacts) == (72, 64)
    sim = simulator(model, dt=0.5)  # a step so long that all corners are within reach
    sim.step()
    assert sim.status.numpy()[0] & wl.Status.OVERFLOW
    assert sim.contacts.count.numpy()[0] == 64


def test_a_plank_on_seven_supports_has_room():
    builder = wl.ModelBuilder()
    for i in range(7):
        builder.add_box(-1, (0.1, 0.5, 0.1), pose=(0.2 * i, 0, -0.1, 0, 0, 0, 1))
    body = builder.add_body(pose=(0.6, 0, 0.1, 0, 0, 0, 1))
    builder.add_box(body, (0.63, 0.1, 0.1))
    sim = simulator(builder, strict=True)
    sim.step(200)
    assert sim.q.numpy()[0, 2] == pytest.approx(0.1, abs=1e-9)


def test_scenes_without_contacts_or_movable_bodies():
    """A free body alone, and a kinematic body alone: they follow their velocity."""
    for joint, fall in ((wl.JointType.FREE, G * 0.01 * 0.011 / 2), (wl.JointType.KINEMATIC, 0.0)):
        builder = wl.ModelBuilder()
        builder.add_body(joint=joint, velocity=(1, 0, 0), mass=1.0, inertia=np.eye(3))
        sim = simulator(builder, strict=True)
        sim.step(10)
        assert sim.q.numpy()[0, :3] == pytest.approx([0.01, 0, -fall], abs=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dt": np.nan}, "dt is nan s; it must be finite"),
        ({"dt": -1e-3}, "greater than zero"),
        ({"dt": "0.01"}, "dt is '0.01'; it must be finite"),
        ({"dt": [0.01, 0.02]}, r"dt is \[0.01, 0.02\] s; it must be finite"),
        ({"num_envs": 0}, "num_envs is 0; give a whole number of at least 1"),
        ({"directions": 1}, "directions is 1"),
        ({"rho_scale": 0.0}, "rho_scale is 0.0"),
        ({"rho_scale": None}, "rho_scale is None"),
        ({"method": "simplex"}, "method is 'simplex'; choose one of auto, velocity_pivoting, proximal_newton, pgs, lemke, murty"),
        ({"precision": "half"}, "choose one of float64, float32"),
        ({"formulation": "magic"}, "choose one of phantom_inertia"),
        ({"sliding": "no"}, "choose one of regularized, aligned, facets"),
        ({"integrator": "rk4"}, "choose one of euler, midpoint"),
        ({"method": "velocity_pivoting", "precision": "float32"}, "needs precision 'float64'"),
    ],
)
def test_arguments_are_checked(arguments, message):
    with pytest.raises(wl.WarpLcpError, match=message):
        simulator(paper_box(), **arguments)


@pytest.mark.parametrize("value", [np.nan, np.inf, None, "2", "two", 2.5, True, -1, [2, 2], 2j], ids=str)
def test_counts_are_whole_numbers(value):
    """Anything else is one clear line, whoever asks for the count."""
    sim = simulator(paper_box())
    asked = {
        "num_envs": lambda x: simulator(paper_box(), num_envs=x),
        "directions": lambda x: simulator(paper_box(), directions=x),
        "step: count": sim.step,
        "rollout: steps": sim.rollout,
        "rollout: every": lambda x: sim.rollout(3, every=x),
        "solve_contact: directions": lambda x: wl.solve_contact(np.eye(3), np.ones(3), 0.5, directions=x, device="cpu"),
    }
    for what, ask in asked.items():
        with pytest.raises(wl.WarpLcpError, match=rf"^{what} is {re.escape(repr(value))}; give a whole number of at least [012]$"):
            ask(value)
    assert sim.time == 0.0
    for number in (2, 2.0, np.int32(2), np.float64(2.0), np.array(2)):
        sim.step(number)
    assert sim.time == pytest.approx(0.01)


def test_environments_that_need_another_method_leave_the_others_alone():
    """Contacts too stiff for velocity pivoting (1e25 N/m) in two of eight environments: those are solved by the next method, and the
    six others end in the same bits as without them."""
    bits = []
    for stiff in (False, True):
        sim = simulator(paper_box(), 8, 5e-3)
        contact = np.tile(sim.model.contact, (8, 1, 1))
        if stiff:
            contact[[2, 5], :, :2] = [1e25, 1e22]
        sim.set_parameters(contact=contact)
        sim.step(40)
        assert (sim.status.numpy() == 0).all()
        bits.append((sim.q.numpy(), sim.iterations.numpy()))
    alike = [0, 1, 3, 4, 6, 7]
    np.testing.assert_array_equal(bits[0][0][alike], bits[1][0][alike])
    assert (bits[1][1][[2, 5]] > 5 * bits[0][1][[2, 5]]).all()  # sweeps and factorisations of the second method
    # Stiffness in the normals alone: the motion is that of Table 1's contacts to what those give way, mg / k_n and less.
    np.testing.assert_allclose(bits[1][0][[2, 5]], bits[0][0][[2, 5]], atol=1e-3)
