# SPDX-License-Identifier: Apache-2.0
"""Simulator.rollout: the same bits as step(), recorded on the device, without a copy on the way to other libraries."""

import numpy as np
import pytest
import warp as wp
from conftest import DEVICE, block_on_plane, paper_box, simulator
from test_batch import bits, randomised

import warp_lcp as wl
from warp_lcp.rollout import FIELDS, Recorder


def pushes(steps: int, envs: int, seed: int = 0) -> np.ndarray:
    """Wrenches [steps, envs, 1, 6] strong enough to lift a block of 24 kg now and then."""
    return np.random.default_rng(seed).normal(size=(steps, envs, 1, 6)) * 200.0


def one_by_one(sim: wl.Simulator, steps: int, wrench: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Every field after each of so many step() calls, with status and iterations of that step alone."""
    rows: dict[str, list[np.ndarray]] = {name: [] for name in FIELDS}
    for i in range(steps):
        if wrench is not None:
            sim.wrench.assign(wrench[i])
        sim.step()
        for name in FIELDS:
            rows[name].append(getattr(sim, name).numpy().copy())
    return {name: np.array(values) for name, values in rows.items()}


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()


@pytest.mark.parametrize("pushed", [False, True])
@pytest.mark.parametrize("options", [{}, {"integrator": "midpoint"}, {"method": "pgs", "precision": "float32"}], ids=str)
def test_same_bits_as_single_steps(options, pushed):
    """Two rollouts with a masked reset between them."""
    stepped, rolled = randomised(5, **options), randomised(5, **options)
    for steps, mask in ((150, [False, True, False, True, False]), (40, None)):
        wrench = pushes(steps, 5) if pushed else None
        expected = one_by_one(stepped, steps, wrench)
        result = rolled.rollout(steps, wrench, FIELDS)
        for name in FIELDS:
            assert same_bits(getattr(result, name).numpy(), expected[name]), name
        assert (bits(rolled) == bits(stepped)).all()
        assert rolled.iterations.numpy().tolist() == expected["iterations"].sum(axis=0).tolist()
        assert rolled.status.numpy().tolist() == np.bitwise_or.reduce(expected["status"]).tolist()
        if mask is not None:
            stepped.reset(mask)
            rolled.reset(mask)


def test_rows_every_so_many_steps():
    """23 steps, a row every 5: the state after 5, 10, 15, 20; status or-ed and iterations summed in between, residual of the row."""
    options = {"method": "pgs", "dt": 1e-3}
    stepped, rolled = simulator(paper_box(), 2, **options), simulator(paper_box(), 2, **options)
    for sim in (stepped, rolled):
        sim.step(155)  # from here on PGS leaves twelve steps uncertified and not those after them
    expected = one_by_one(stepped, 23)
    result = rolled.rollout(23, record=FIELDS, every=5)
    rows = [4, 9, 14, 19]
    assert result.time == pytest.approx(1e-3 * (156 + np.array(rows)), abs=1e-12)
    for name in set(FIELDS) - {"status", "iterations"}:
        assert same_bits(getattr(result, name).numpy(), expected[name][rows]), name
    blocks = [expected["status"][i : i + 5] for i in (0, 5, 10, 15)]
    assert result.status.numpy().tolist() == [np.bitwise_or.reduce(block).tolist() for block in blocks]
    assert result.iterations.numpy().tolist() == [expected["iterations"][i : i + 5].sum(axis=0).tolist() for i in (0, 5, 10, 15)]
    assert 0 < np.count_nonzero(expected["status"]) < expected["status"].size  # there was something to or

    # The simulator is left as after step(23), with the three steps that no row shows.
    assert rolled.status.numpy().tolist() == np.bitwise_or.reduce(expected["status"]).tolist()
    assert rolled.iterations.numpy().tolist() == expected["iterations"].sum(axis=0).tolist()
    assert (rolled.last_count, round(rolled.time / 1e-3)) == (23, 178)
    assert (bits(rolled) == bits(stepped)).all()


def test_wrenches_in_every_form():
    """Numbers for all, for each, spatial vectors on the device: the same; the last one stays, as if written before each step."""
    shared, spatial = pushes(30, 1), wp.spatial_vectord
    ends = []
    for wrench in (
        shared,
        np.tile(shared, (1, 3, 1, 1)),
        wp.array(shared, dtype=spatial, device=DEVICE),
        wp.array(np.tile(shared, (1, 3, 1, 1)), dtype=spatial, device=DEVICE),
    ):
        sim = simulator(block_on_plane(), 3)
        sim.rollout(30, wrench)
        assert same_bits(sim.wrench.numpy(), np.tile(shared[-1], (3, 1, 1)))
        ends.append(bits(sim))
    assert all((end == ends[0]).all() for end in ends)

    sim = simulator(block_on_plane(), 3)
    sim.wrench.assign(np.tile(shared[0], (3, 1, 1)))
    sim.rollout(5)
    constant = simulator(block_on_plane(), 3)
    constant.rollout(5, np.repeat(shared[:1], 5, axis=0))
    assert (bits(sim) == bits(constant)).all()
    assert (bits(sim) != ends[0]).any()


def test_rollouts_share_a_graph_and_no_arrays(monkeypatch):
    """The next rollouts capture nothing, whatever they record, and leave the arrays of the first alone. Those of bodies have a graph."""
    sim = randomised(3)
    first = sim.rollout(20)
    kept = first.q.numpy().copy()
    sim.rollout(1, record="body_velocity")

    def refuse(*_, **__):
        raise AssertionError("captured again")

    monkeypatch.setattr(wp, "ScopedCapture", refuse)
    second = sim.rollout(35, record=("q", "body_pose"), every=5)
    assert same_bits(first.q.numpy(), kept)
    assert second.q.shape == (7, 3, 7)
    assert second.q.is_contiguous
    assert second.v is None
    assert sim.rollout(1, record=("residual", "iterations")).q is None
    with pytest.raises(AssertionError, match="captured again"):
        sim.rollout(20, pushes(20, 3))  # with wrenches it is another step


def test_nothing_recorded_is_step():
    sim, stepped = randomised(3), randomised(3)
    result = sim.rollout(20, record=())
    stepped.step(20)
    assert all(getattr(result, name) is None for name in FIELDS)
    assert (bits(sim) == bits(stepped)).all()
    assert sim.iterations.numpy().tolist() == stepped.iterations.numpy().tolist()


def test_parameters_set_between_rollouts_count():
    """Friction for each environment moves to a larger array; the captured step must not keep the old one."""
    sim, stepped = simulator(paper_box(), 2), simulator(paper_box(), 2)
    friction = np.array([[[0.2, 0.2]] * 2, [[0.9, 0.9]] * 2])
    sim.rollout(10)
    stepped.step(10)
    for each in (sim, stepped):
        each.set_parameters(friction=friction)
    sim.rollout(50)
    stepped.step(50)
    assert (bits(sim) == bits(stepped)).all()
    assert sim.v.numpy()[0, 1] - sim.v.numpy()[1, 1] > 0.1


def test_several_bodies():
    """A pose and a velocity for each body, the fixed one too."""
    builder = wl.ModelBuilder()
    builder.add_body("ledge", joint=wl.JointType.FIXED, pose=(0, 0, 2, 0, 0, 0, 1))
    builder.add_body("a", velocity=(1, 0, 0), mass=1.0, inertia=np.eye(3))
    builder.add_body("b", velocity=(0, 2, 0), mass=1.0, inertia=np.eye(3))
    sim = simulator(builder, 2, 1e-2)
    result = sim.rollout(10, record=("q", "body_pose", "body_velocity"))
    assert (result.q.shape, result.body_pose.shape, result.body_velocity.shape) == ((10, 2, 14), (10, 2, 3), (10, 2, 3))
    pose = result.body_pose.numpy()
    assert (pose[:, :, 0] == [0, 0, 2, 0, 0, 0, 1]).all()
    assert pose[:, 1, 1, 0] == pytest.approx(0.01 * np.arange(1, 11), abs=1e-12)
    assert same_bits(pose[-1], sim.body_pose.numpy())
    assert same_bits(result.body_velocity.numpy()[-1], sim.body_velocity.numpy())


@pytest.mark.parametrize("joints", [False, True])
def test_threads_and_memory_of_a_gpu_give_the_same_bits(monkeypatch, joints):
    """What a GPU does differently, done on the CPU: environments fastest in memory, a thread for each column of each row."""

    def rollout(sim):
        control = None
        if joints:
            shape = (60, 6, sim.model.nv)
            control = {name: np.random.default_rng(5).normal(size=shape) for name in ("position", "velocity", "force")}
        return sim.rollout(60, None if joints else pushes(60, 6), FIELDS, every=7, control=control)

    def make():
        return simulator(wl.load_usd("quadruped"), 6, 5e-3) if joints else randomised(6)

    expected = rollout(make())

    def array(self, n, dtype):
        return wp.zeros((n, self.num_envs), dtype=dtype, device=self.device).transpose()

    def launch(self, kernel, inputs, width=1):
        wp.launch(kernel, dim=(self.num_envs, width), inputs=[*inputs, self.num_envs], device=self.device)

    monkeypatch.setattr(wl.Simulator, "_array", array)
    monkeypatch.setattr(wl.Simulator, "launch", launch)
    sim = make()
    recorder = sim._recorder = Recorder(sim)
    recorder.columns = 7
    recorder.step = wp.zeros((6, 7), dtype=int, device=DEVICE)
    result = rollout(sim)
    for name in FIELDS:
        assert same_bits(getattr(result, name).numpy(), getattr(expected, name).numpy()), name


def test_strict_raises_after_the_rollout():
    """A NaN in the third step of one environment; the status says so although a later row began anew."""
    sim = simulator(paper_box(), 3, strict=True)
    wrench = np.zeros((20, 3, 1, 6))
    wrench[2, 1, 0, 0] = np.nan
    with pytest.raises(wl.SimulationError, match=r"1 of 3 environments are not OK at t = 0.02 s; first: environment 1, NOT_A_NUMBER"):
        sim.rollout(20, wrench, every=5)


def test_numpy_takes_the_arrays_without_a_copy():
    sim = simulator(paper_box(), 4)
    result = sim.rollout(6, record=("q", "body_pose", "status"))
    if not sim.device.is_cpu:
        pytest.skip("numpy sees the memory of the CPU alone")
    for array, shape in ((result.q, (6, 4, 7)), (result.body_pose, (6, 4, 1, 7)), (result.status, (6, 4))):
        view = np.from_dlpack(array)
        assert view.shape == shape
        assert view.ctypes.data == array.ptr == array.numpy().ctypes.data
    seen = np.from_dlpack(result.q)[-1, 0, 1]
    assert seen == sim.q.numpy()[0, 1] > 0.0


def test_torch_takes_the_arrays_without_a_copy():
    torch = pytest.importorskip("torch")
    sim = simulator(paper_box(), 4)
    result = sim.rollout(6)
    view = torch.from_dlpack(result.q)
    assert tuple(view.shape) == (6, 4, 7)
    assert view.data_ptr() == result.q.ptr
    assert torch.equal(view[-1, 0].cpu(), torch.as_tensor(sim.q.numpy()[0]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "steps is 0; give a whole number of at least 1"),
        ({"steps": 2.5}, "steps is 2.5; give a whole number"),
        ({"steps": "ten"}, "steps is 'ten'; give a whole number"),
        ({"every": 0}, "every is 0; give a whole number of at least 1"),
        ({"every": 4}, "every is 4, more than the 3 steps"),
        ({"record": ("q", "pose")}, "record holds 'pose'; choose from q, v, body_pose"),
        ({"record": "contacts"}, "record holds 'contacts'"),
        ({"record": None}, "record is None; give names out of q, v"),
        ({"wrench": np.zeros((3, 3, 1, 6))}, r"wrench has shape \(3, 3, 1, 6\); give \(3, 2, 1, 6\) or \(3, 1, 1, 6\)"),
        ({"wrench": np.zeros((2, 2, 1, 6))}, r"wrench has shape \(2, 2, 1, 6\)"),
        ({"wrench": "hard"}, "wrench is no array of numbers"),
        ({"wrench": wp.zeros((3, 2), dtype=wp.spatial_vectord, device="cpu")}, r"wrench is \(3, 2\) of spatial_vectord on cpu"),
        ({"wrench": wp.zeros((3, 2, 1), dtype=wp.spatial_vectorf, device="cpu")}, r"give \(3, 2, 1\) or \(3, 1, 1\) of spatial_vectord"),
    ],
)
def test_arguments_are_checked(arguments, message):
    sim = simulator(paper_box(), 2)
    with pytest.raises(wl.WarpLcpError, match=f"rollout: .*{message}"):
        sim.rollout(**{"steps": 3, **arguments})
    assert sim.time == 0.0


def arm() -> wl.ModelBuilder:
    """Two links with a drive each, over a plane that the second reaches."""
    b = wl.ModelBuilder()
    b.add_plane(pose=(0, 0, -0.8, 0, 0, 0, 1))
    first, second = (b.add_body(pose=(x, 0, 0, 0, 0, 0, 1), mass=1.0, inertia=0.1 * np.eye(3)) for x in (0.5, 1.5))
    b.add_sphere(second, 0.2)
    turn = (0, 0, np.sqrt(0.5), np.sqrt(0.5))  # x of the joint along y
    for parent, child, at in ((-1, first, 0.0), (first, second, 0.5)):
        frames = {"parent_frame": (at, 0, 0, *turn), "child_frame": (-0.5, 0, 0, *turn)}
        b.add_joint(wl.JointType.REVOLUTE, parent, child, **frames, drive=wl.Drive(20.0, 2.0))
    return b


@pytest.mark.parametrize("names", [("position",), ("velocity", "force"), ("position", "velocity", "force")])
@pytest.mark.parametrize("pushed", [False, True])
def test_controls_of_every_step(names, pushed):
    """The same bits as writing them between steps; what is not given stays, and the last ones do."""
    rng, steps, envs = np.random.default_rng(3), 120, 3
    stepped, rolled = simulator(arm(), envs), simulator(arm(), envs)
    for sim in (stepped, rolled):
        sim.control.force.assign(np.full((envs, 2), 0.25))
    control = {name: rng.normal(size=(steps, envs, 2)) for name in names}
    wrench = rng.normal(size=(steps, envs, 2, 6)) if pushed else None
    expected = []
    for i in range(steps):
        for name in names:
            getattr(stepped.control, name).assign(control[name][i])
        if wrench is not None:
            stepped.wrench.assign(wrench[i])
        stepped.step()
        expected.append(stepped.q.numpy().copy())
    result = rolled.rollout(steps, wrench, ("q",), control=control)
    assert same_bits(result.q.numpy(), np.array(expected))
    for name in ("position", "velocity", "force"):
        assert (getattr(rolled.control, name).numpy() == getattr(stepped.control, name).numpy()).all()


def test_controls_on_the_device_and_for_all_environments_alike():
    steps, target = 50, np.random.default_rng(4).normal(size=(50, 1, 2))
    ends = []
    for value in (target, np.repeat(target, 2, axis=1), wp.array(target, dtype=wp.float64, device=DEVICE)):
        ends.append(simulator(arm(), 2).rollout(steps, record="q", control={"position": value}).q.numpy())
    assert same_bits(ends[0], ends[1])
    assert same_bits(ends[0], ends[2])


@pytest.mark.parametrize(
    ("control", "message"),
    [
        ({"torque": np.zeros((2, 1, 2))}, "give a dict with some of position, velocity, force"),
        ({"force": np.zeros((2, 2))}, r"force has shape \(2, 2\); give \(2, 3, 2\) or \(2, 1, 2\)"),
        ({"force": "much"}, "no array of numbers"),
        ("force", "give a dict"),
    ],
)
def test_controls_that_are_none(control, message):
    with pytest.raises(wl.WarpLcpError, match=message):
        simulator(arm(), 3).rollout(2, control=control)


def test_controls_need_joints():
    with pytest.raises(wl.WarpLcpError, match="the model has none"):
        simulator(paper_box()).rollout(2, control={"force": np.zeros((2, 1, 6))})
