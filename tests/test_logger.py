# SPDX-License-Identifier: Apache-2.0
"""Recordings for Rerun, read back from the file: poses, timelines, contacts, residuals, what survives a kill."""

import builtins
import os
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp.logger import STATE_COLORS, ball, free_port, rotate

rr = pytest.importorskip("rerun", reason="needs the extra 'rerun'")
pa = pytest.importorskip("pyarrow")
RrdReader = pytest.importorskip("rerun.chunk").RrdReader


def read(path, entity, component, timeline="step"):
    """[(time, values), ...] of one component, sorted; time is None for static data and nanoseconds for durations."""
    found = []
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path != entity or component not in batch.schema.names:
            continue
        times = [None] * batch.num_rows if chunk.is_static else batch.column(timeline).cast(pa.int64()).to_pylist()
        for when, value in zip(times, batch.column(component), strict=True):
            if value.is_valid:
                inner = value.values
                if pa.types.is_fixed_size_list(inner.type):
                    array = np.asarray(inner.flatten()).reshape(-1, inner.type.list_size)
                else:
                    array = inner.to_numpy(zero_copy_only=False)
                found.append((when, array))
    return sorted(found, key=lambda x: -1 if x[0] is None else x[0])


def box_model(height=0.5, speed=0.0, up="Z", mu=0.5):
    axis = "XYZ".index(up)
    builder = wl.ModelBuilder(gravity=-9.81 * np.eye(3)[axis], up_axis=up)
    turn = (0.0, 0.0, 0.0, 1.0) if up == "Z" else (-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # local +z to +y
    material = wl.Material(mu, mu)
    body = builder.add_body("box", pose=[*(height * np.eye(3)[axis]), 0, 0, 0, 1], velocity=(speed, 0, 0), mass=2.0)
    # Off the body's origin and turned, so that shape poses are not body poses.
    builder.add_box(body, (0.5, 0.5, 0.5), pose=(0, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)), name="/World/Box/Geometry", material=material)
    builder.add_plane(pose=(0, 0, 0, *turn), name="ground", material=material)
    return builder.finalize()


def simulate(path, model, frames=4, num_envs=3, dt=0.01, before=None, **options):
    """A recording of a few steps; returns the simulator, the logger and the body poses at each step."""
    sim = wl.Simulator(model, num_envs, dt, device="cpu")
    if before is not None:
        before(sim)
    poses = []
    with wl.RerunLogger(sim, path, **options) as logger:
        for k in range(frames):
            if k:
                sim.step()
            logger.log()
            poses.append(sim.body_pose.numpy().copy())
    return sim, logger, np.array(poses)


def spread(sim):
    """Environments that differ."""
    v = sim.v.numpy().copy()
    v[:, 0] = np.linspace(-2, 3, sim.num_envs)
    v[:, 5] = np.linspace(1, 2, sim.num_envs)
    sim.v.assign(v)


def test_poses_and_timelines_are_those_of_the_simulation(tmp_path):
    path = tmp_path / "run.rrd"
    _, logger, poses = simulate(path, box_model(), before=spread, every=1)
    entity = "/world/bodies/World/Box/Geometry"
    at, turned = read(path, entity, "InstancePoses3D:translations"), read(path, entity, "InstancePoses3D:quaternions")
    assert [t for t, _ in at] == [0, 1, 2, 3]
    assert [t for t, _ in read(path, entity, "InstancePoses3D:translations", "sim_time")] == [0, 10_000_000, 20_000_000, 30_000_000]
    local = np.array((0, 0, np.sqrt(0.5), np.sqrt(0.5)))
    for k in range(4):
        np.testing.assert_allclose(at[k][1], poses[k, :, 0, :3] + logger.layout.offsets, atol=1e-6)
        x = np.array((1.0, 0.0, 0.0))
        expected = rotate(poses[k, :, 0, 3:], rotate(local, x))
        np.testing.assert_allclose(rotate(turned[k][1].astype(float), x), expected, atol=1e-6)


def test_default_rate_is_sixty_frames_a_simulated_second(tmp_path):
    sim = wl.Simulator(box_model(), 1, 1e-3, device="cpu")
    with wl.RerunLogger(sim, tmp_path / "run.rrd") as logger:
        assert logger.every == 17
        written = [logger.log()]
        for _ in range(40):
            sim.step()
            written.append(logger.log())
    assert np.flatnonzero(written).tolist() == [0, 17, 34]
    assert [t for t, _ in read(tmp_path / "run.rrd", "/plots/energy", "Scalars:scalars")] == [0, 17, 34]
    assert wl.RerunLogger(wl.Simulator(box_model(), 1, 1 / 60, device="cpu"), tmp_path / "other.rrd").every == 1


def test_resting_box_contact_forces_sum_to_its_weight(tmp_path):
    path = tmp_path / "run.rrd"
    sim, logger, _ = simulate(path, box_model(), frames=21, every=20)
    origins, vectors = (read(path, "/world/contacts/forces", f"Arrows3D:{c}") for c in ("origins", "vectors"))
    assert [t for t, _ in vectors] == [0, 20]
    assert len(vectors[0][1]) == 0  # nothing was solved yet
    assert len(vectors[1][1]) == sim.contacts.count.numpy().sum() == 12
    np.testing.assert_allclose(vectors[1][1].sum(0) / logger.force_scale / 3, (0, 0, 2 * 9.81), atol=1e-4)
    expected = sim.contacts.point.numpy()[:, :4] + logger.layout.offsets[:, None]
    np.testing.assert_allclose(origins[1][1], expected.reshape(-1, 3), atol=1e-5)


def test_colors_tell_sticking_from_sliding(tmp_path):
    def throw_two_of_three(sim):
        sim.v.assign(np.array([[1.0, 0, 0, 0, 0, 1.0], [0] * 6, [3.0, 0, 0, 0, 0, -1.0]]))

    path = tmp_path / "run.rrd"
    sim, _, _ = simulate(path, box_model(), frames=2, every=1, before=throw_two_of_three)
    (_, color) = read(path, "/world/contacts/forces", "Arrows3D:colors")[-1]
    pressed = sim.contacts.impulse.numpy()[:, :4, 0] > 1e-9
    np.testing.assert_array_equal(sim.contacts.state.numpy()[:, :4][pressed], np.repeat([2, 1, 2], 4)[pressed.ravel()])
    red, green, blue = STATE_COLORS[sim.contacts.state.numpy()[:, :4].ravel()].astype(np.uint32).T
    np.testing.assert_array_equal(color, (red << 24) | (green << 16) | (blue << 8) | 255)


def test_force_is_drawn_on_the_body_that_moves(tmp_path):
    builder = wl.ModelBuilder()
    body = builder.add_body("top", pose=(0, 0, 0.2, 0, 0, 0, 1), mass=1.0)
    builder.add_box(body, (0.1, 0.1, 0.1))
    builder.add_box(-1, (1, 1, 0.1))  # the second shape of the pair is the world's
    path = tmp_path / "run.rrd"
    _, logger, _ = simulate(path, builder.finalize(), frames=11, num_envs=1, every=10)
    np.testing.assert_allclose(
        read(path, "/world/contacts/forces", "Arrows3D:vectors")[-1][1].sum(0) / logger.force_scale, (0, 0, 9.81), atol=1e-4
    )


def test_no_contacts_log_empty_arrays_and_an_impact_does_not_fill_the_view(tmp_path):
    path = tmp_path / "run.rrd"
    _, logger, _ = simulate(path, box_model(height=0.56), frames=16, num_envs=1, every=1)
    vectors = read(path, "/world/contacts/forces", "Arrows3D:vectors")
    points = read(path, "/world/contacts/points", "Points3D:positions")
    assert [t for t, _ in vectors] == [t for t, _ in points] == list(range(16))
    assert len(vectors[5][1]) == len(points[5][1]) == 0
    assert len(vectors[-1][1]) == 4
    longest = max(np.linalg.norm(v, axis=1).max(initial=0.0) for _, v in vectors)
    assert 0.1 * logger.longest_arrow < longest <= logger.longest_arrow * (1 + 1e-6)


def test_residuals_iterations_and_energy(tmp_path):
    path = tmp_path / "run.rrd"
    sim, _, _ = simulate(path, box_model(), frames=3, every=1, before=spread, envs=[0])
    last = {
        name: read(path, f"/plots/{name}", "Scalars:scalars")[-1] for name in ("residual", "iterations", "contacts", "energy", "status")
    }
    assert all(step == 2 for step, _ in last.values())
    residual = np.maximum((sim.residual.numpy().max(), np.percentile(sim.residual.numpy(), 99)), 1e-17)
    np.testing.assert_allclose(last["residual"][1], np.log10(residual))
    np.testing.assert_allclose(last["iterations"][1], (sim.iterations.numpy().mean(), sim.iterations.numpy().max()))
    np.testing.assert_allclose(last["contacts"][1], (4.0, 4.0))
    assert last["status"][1].tolist() == [0] * 6
    v, z = sim.body_velocity.numpy()[0, 0], sim.body_pose.numpy()[0, 0, 2]
    energy = 0.5 * 2.0 * v[:3] @ v[:3] + 0.5 * (2.0 / 6.0) * v[3:] @ v[3:] + 2.0 * 9.81 * z
    np.testing.assert_allclose(last["energy"][1], [energy] * 3, rtol=1e-9)
    assert [t for t, _ in read(path, "/plots/residual", "Scalars:scalars")] == [1, 2]


def test_energy_of_bodies_on_joints(tmp_path):
    """A body that a joint carries has energy as a free one has: m g z of a pendulum on a hinge 2 m up, plus what its fall made."""
    builder = wl.ModelBuilder()
    bob = builder.add_body(pose=(1.0, 0, 2.0, 0, 0, 0, 1), mass=3.0, inertia=1e-9 * np.eye(3))
    frames = {"parent_frame": (0, 0, 2.0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)), "child_frame": (-1.0, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5))}
    builder.add_joint(wl.JointType.REVOLUTE, -1, bob, **frames)
    builder.add_sphere(bob, 0.1)
    path = tmp_path / "run.rrd"
    sim, _, _ = simulate(path, builder.finalize(), frames=50, every=1, envs=[0])
    (_, first), *_, (_, last) = read(path, "/plots/energy", "Scalars:scalars")
    pose, velocity = sim.body_pose.numpy()[0, 0], sim.body_velocity.numpy()[0, 0]
    assert first[0] == pytest.approx(3.0 * 9.81 * 2.0, rel=1e-2)
    assert last[0] == pytest.approx(0.5 * 3.0 * velocity[:3] @ velocity[:3] + 3.0 * 9.81 * pose[2], rel=1e-8)
    assert np.linalg.norm(velocity[:3]) > 0.4  # so that both are seen


def test_not_ok_is_logged_once_and_not_missed_between_frames(tmp_path):
    """A bounce that was reduced is counted, but nothing to warn of."""
    path = tmp_path / "run.rrd"
    sim = wl.Simulator(box_model(), 5, 0.01, device="cpu")
    with wl.RerunLogger(sim, path, every=4, envs=2) as logger:
        for k in range(9):
            logger.log()
            sim.step()
            if k == 1:  # a status that the next step() clears
                sim.status.assign(np.array([0, 0, 32, 16 | 1, 0], dtype=np.int32))
                logger.log()
    lines = read(path, "/log", "TextLog:text")
    assert [t for t, _ in lines] == [4]
    assert lines[0][1][0].startswith("environment 3: ITERATION_LIMIT | UNCERTIFIED, residual ")
    assert read(path, "/log", "TextLog:level")[0][1].tolist() == ["WARN"]
    assert [v.tolist() for _, v in read(path, "/plots/status", "Scalars:scalars")] == [[1, 0, 0, 0, 1, 1], [0] * 6]


def test_chosen_environments(tmp_path):
    sim = wl.Simulator(box_model(), 100, 0.01, device="cpu")
    assert wl.RerunLogger(sim, tmp_path / "a.rrd").envs.tolist() == list(range(64))
    assert wl.RerunLogger(sim, tmp_path / "b.rrd", envs=3).envs.tolist() == [0, 1, 2]
    path = tmp_path / "c.rrd"
    _, logger, poses = simulate(path, box_model(), num_envs=6, before=spread, every=1, envs=[4, 1])
    (_, at) = read(path, "/world/bodies/World/Box/Geometry", "InstancePoses3D:translations")[-1]
    np.testing.assert_allclose(at, poses[-1, [4, 1], 0, :3] + logger.layout.offsets, atol=1e-6)
    for bad in ([], [1, 1], [100], [-1], 0, 101, [0.5]):
        with pytest.raises(wl.WarpLcpError, match=r"^envs: "):
            wl.RerunLogger(sim, tmp_path / "d.rrd", envs=bad)
    for bad in (0, -1, 1.5, float("nan"), float("inf"), "2", True):
        with pytest.raises(wl.WarpLcpError, match=r"^every is "):
            wl.RerunLogger(sim, tmp_path / "d.rrd", every=bad)


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_environments_that_slide_stay_in_their_rooms(tmp_path, up):
    sim = wl.Simulator(box_model(speed=5.0, up=up, mu=1.0), 9, 0.01, device="cpu")
    with wl.RerunLogger(sim, tmp_path / "run.rrd") as logger:
        layout = logger.layout
        sim.step(150)
    half = np.linalg.norm([0.5] * 3)
    flat = [0, 1] if up == "Z" else [0, 2]
    moved = sim.body_pose.numpy()[:, 0, :3] - layout.centre
    assert moved[0, 0] > 0.1
    assert (np.abs(moved[:, flat]) + half <= layout.half[flat]).all()
    gaps = np.abs(layout.offsets[:, None] - layout.offsets[None])[:, :, flat] >= 2 * layout.half[flat] - 1e-9
    assert (gaps.any(-1) | np.eye(9, dtype=bool)).all()
    tile = read(tmp_path / "run.rrd", "/world/static/ground", "Boxes3D:half_sizes")[0][1][0]
    place = read(tmp_path / "run.rrd", "/world/static/ground", "InstancePoses3D:translations")[0][1]
    top = place[:, "XYZ".index(up)] + tile[2]
    np.testing.assert_allclose(top, 0.0, atol=1e-6)


def test_ball_is_closed_and_turned_outwards():
    vertices, triangles, _ = ball(2.0)
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(4 / 3 * np.pi * 8, rel=0.02)
    assert (np.einsum("ij,ij->i", a + b + c, np.cross(b - a, c - a)) > -1e-12).all()


def test_capsules_are_drawn_about_their_middle(tmp_path):
    """Rerun draws a capsule from z = 0 to its length: it is put back by half of that, so that the pose is that of the shape.

    And as many as there are lengths (with one for three environments the first alone has its capsule): there are three.
    """
    half = np.sqrt(0.5)
    builder = wl.ModelBuilder()
    builder.add_plane()
    body = builder.add_body("pill", pose=(0, 0, 0.2, 0, 0, 0, 1))
    builder.add_capsule(body, 0.2, 0.3, pose=(0.1, 0, 0, 0, half, 0, half), name="pill")
    builder.add_capsule(-1, 0.1, 2.0, pose=(3, 0, 0, 0, half, 0, half), name="rail")
    path = tmp_path / "run.rrd"
    _, logger, poses = simulate(path, builder.finalize(), frames=2, every=1)
    for entity, length, radius in (("/world/bodies/pill", 0.6, 0.2), ("/world/static/rail", 4.0, 0.1)):
        found = {c: read(path, entity, f"Capsules3D:{c}")[0][1] for c in ("lengths", "radii", "translations")}
        assert found["lengths"] == pytest.approx(3 * [length])
        assert found["radii"] == pytest.approx(3 * [radius])
        np.testing.assert_allclose(found["translations"], 3 * [(0, 0, -length / 2)], atol=1e-6)
    (_, at) = read(path, "/world/bodies/pill", "InstancePoses3D:translations")[-1]
    np.testing.assert_allclose(at, poses[-1, :, 0, :3] + (0.1, 0, 0) + logger.layout.offsets, atol=1e-6)
    (_, turned) = read(path, "/world/bodies/pill", "InstancePoses3D:quaternions")[-1]
    np.testing.assert_allclose(rotate(turned.astype(float), np.array((0, 0, 1.0))), np.tile((1.0, 0, 0), (3, 1)), atol=1e-6)
    # The room of an environment holds the rail to its end caps and the pill however it turns.
    assert logger.layout.half[0] >= 0.5 * (3 + 2.1 - (0.1 - 0.5))
    assert logger.layout.size == pytest.approx(1.0)


def test_cylinders_cones_hulls_and_meshes_are_drawn(tmp_path):
    """A cylinder by its radius and length; others as triangles whose volume is theirs, turned outwards, a mesh as it is."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    builder = wl.ModelBuilder()
    builder.add_mesh(-1, [(-2, -2, -1), (2, -2, -1), (2, 2, -1), (-2, 2, -1)], [(0, 1, 2), (0, 2, 3)], name="field")
    builder.add_cylinder(builder.add_body("roll"), 0.2, 0.3, name="roll")
    builder.add_cone(builder.add_body("hat", pose=(2, 0, 0, 0, 0, 0, 1)), 0.2, 0.3, name="hat")
    builder.add_hull(builder.add_body("rock", pose=(4, 0, 0, 0, 0, 0, 1)), corners, name="rock")
    path = tmp_path / "run.rrd"
    simulate(path, builder.finalize(), frames=1, every=1)
    assert read(path, "/world/bodies/roll", "Cylinders3D:radii")[0][1] == pytest.approx([0.2])
    assert read(path, "/world/bodies/roll", "Cylinders3D:lengths")[0][1] == pytest.approx([0.6])
    for entity, volume in (("/world/bodies/hat", np.pi * 0.04 * 0.6 / 3), ("/world/bodies/rock", 1.0), ("/world/static/field", 0.0)):
        points = read(path, entity, "Mesh3D:vertex_positions")[0][1].astype(float)
        triangles = read(path, entity, "Mesh3D:triangle_indices")[0][1]
        normals = read(path, entity, "Mesh3D:vertex_normals")[0][1]
        a, b, c = (points[triangles[:, k]] for k in range(3))
        assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.01, abs=1e-6)
        n = np.cross(b - a, c - a)
        assert (np.einsum("ij,ij->i", n, normals[triangles[:, 0]]) > 0.99 * np.linalg.norm(n, axis=1)).all()


def test_ellipsoids_are_drawn_with_their_axes(tmp_path):
    builder = wl.ModelBuilder()
    builder.add_plane()
    builder.add_ellipsoid(builder.add_body("egg", pose=(0, 0, 0.3, 0, 0, 0, 1)), (0.1, 0.2, 0.3), name="egg")
    path = tmp_path / "run.rrd"
    _, logger, _ = simulate(path, builder.finalize(), frames=1, every=1)
    assert read(path, "/world/bodies/egg", "Ellipsoids3D:half_sizes")[0][1][0] == pytest.approx([0.1, 0.2, 0.3])
    assert logger.layout.size == pytest.approx(0.6)  # the ball around it


def test_killed_process_leaves_its_frames(tmp_path):
    script = tmp_path / "run.py"
    script.write_text(
        "import os, signal, sys, time, warp_lcp as wl\n"
        "builder = wl.ModelBuilder()\n"
        "builder.add_sphere(builder.add_body('ball', mass=1.0), 0.1)\n"
        "builder.add_plane()\n"
        "sim = wl.Simulator(builder.finalize(), 2, 0.01, device='cpu')\n"
        "logger = wl.RerunLogger(sim, sys.argv[1], every=1)\n"
        "for k in range(20):\n"
        "    logger.log(); sim.step()\n"
        "time.sleep(1.1)\n"
        "logger.log()\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    path = tmp_path / "run.rrd"
    root = os.path.dirname(os.path.dirname(wl.__file__))
    done = subprocess.run(
        [sys.executable, str(script), str(path)], env={**os.environ, "PYTHONPATH": root}, capture_output=True, timeout=120
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert [t for t, _ in read(path, "/world/bodies/shape0", "InstancePoses3D:translations")] == list(range(21))


def test_missing_rerun_names_the_extra(tmp_path, monkeypatch):
    sim = wl.Simulator(box_model(), 1, 0.01, device="cpu")
    real = builtins.__import__
    monkeypatch.setattr(
        builtins, "__import__", lambda name, *a: (_ for _ in ()).throw(ImportError("gone")) if name == "rerun" else real(name, *a)
    )
    with pytest.raises(wl.MissingExtra, match=r"python -m pip install 'warp_lcp\[rerun\]'"):
        wl.RerunLogger(sim, tmp_path / "run.rrd")


def test_bad_sinks(tmp_path, monkeypatch):
    sim = wl.Simulator(box_model(), 1, 0.01, device="cpu")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    for sink, what in {
        "run": "not a place to log to",
        "server": "not a place to log to",
        str(tmp_path): "not a place to log to",
        str(tmp_path / "absent" / "run.rrd"): "No such file or directory",
        "foo://bar": "not the address of a viewer",
        f"rerun+http://127.0.0.1:{free_port(0)}/proxy": "no viewer answers there",
        **({"spawn": "no display"} if sys.platform == "linux" else {}),
    }.items():
        with pytest.raises(wl.WarpLcpError, match=what):
            wl.RerunLogger(sim, sink)


def test_serve_takes_free_ports_and_a_viewer_can_be_streamed_to(tmp_path, capfd):
    sim = wl.Simulator(box_model(), 1, 0.01, device="cpu")
    with socket.socket() as taken:
        taken.bind(("0.0.0.0", 0))
        taken.listen()
        assert free_port(taken.getsockname()[1]) != taken.getsockname()[1]
    with wl.RerunLogger(sim, "serve") as served:
        assert served.address in capfd.readouterr().err
        uri = "rerun+http://127.0.0.1:" + served.address.rpartition("%3A")[2].replace("%2F", "/")
        with wl.RerunLogger(sim, uri) as streamed:
            assert streamed.log()
        assert streamed.address == uri
    assert not streamed.log()  # closed


def test_entity_names_are_unique(tmp_path):
    builder = wl.ModelBuilder()
    body = builder.add_body("a", mass=1.0)
    for _ in range(2):
        builder.add_sphere(body, 0.1, name="same name")
    path = tmp_path / "run.rrd"
    simulate(path, builder.finalize(), frames=1, num_envs=1)
    entities = {chunk.entity_path for chunk in RrdReader(str(path)).stream()}
    assert len([e for e in entities if e.startswith("/world/bodies/")]) == 2


def test_an_environment_that_is_no_number_leaves_the_others_visible(tmp_path):
    def spoil(sim):
        q = sim.q.numpy().copy()
        q[1, 0] = np.nan
        sim.q.assign(q)

    path = tmp_path / "run.rrd"
    sim = wl.Simulator(box_model(), 3, 0.01, precision="float32", device="cpu")
    with wl.RerunLogger(sim, path, every=1) as logger:
        spoil(sim)
        sim.step()
        logger.log()
    assert np.isfinite(read(path, "/plots/energy", "Scalars:scalars")[-1][1]).all()
    assert any(text[0].startswith("environment 1: NOT_A_NUMBER") for _, text in read(path, "/log", "TextLog:text"))
    at = read(path, "/world/bodies/World/Box/Geometry", "InstancePoses3D:translations")[-1][1]
    assert np.isfinite(at).all(axis=1).tolist() == [True, False, True]


def test_a_scene_without_shapes(tmp_path):
    builder = wl.ModelBuilder(gravity=(0, 0, 0))
    builder.add_body("point", mass=1.0, inertia=np.eye(3))
    simulate(tmp_path / "run.rrd", builder.finalize(), frames=2, every=1)
    assert len(read(tmp_path / "run.rrd", "/plots/energy", "Scalars:scalars")) == 2
