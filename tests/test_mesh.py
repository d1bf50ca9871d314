# SPDX-License-Identifier: Apache-2.0
"""Meshes of triangles as ground: against planes and boxes of the same form, nearest points, closed forms."""

import numpy as np
import pytest
from conftest import random_quaternions, simulator
from test_convex import ROCK, nearest_on_triangles
from warp_lcp.kernels.collide import NO_POINT

import warp_lcp as wl
from warp_lcp.hulls import CORNERS, arrays, mesh

LYING = (-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # z of the shape along y


def grid(cells: int, height=lambda x, y: 0.0 * x, size: float = 10.0) -> tuple[np.ndarray, np.ndarray]:
    """Square ground of cells x cells squares, two triangles each."""
    x, y = np.meshgrid(*2 * [np.linspace(-0.5 * size, 0.5 * size, cells + 1)], indexing="ij")
    i, j = (a.ravel() for a in np.meshgrid(*2 * [np.arange(cells)], indexing="ij"))
    a = i * (cells + 1) + j
    b = a + cells + 1
    triangles = np.concatenate([np.stack([a, b, b + 1], axis=-1), np.stack([a, b + 1, a + 1], axis=-1)])
    return np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3), triangles


ADDS = {
    "box": (lambda b, i: b.add_box(i, (0.3, 0.2, 0.2)), 0.2, (0, 0, 0.2, np.sqrt(1 - 0.04))),
    "ball": (lambda b, i: b.add_sphere(i, 0.3), 0.3, (0, 0, 0, 1)),
    "capsule": (lambda b, i: b.add_capsule(i, 0.1, 0.3), 0.1, LYING),
    "cylinder": (lambda b, i: b.add_cylinder(i, 0.2, 0.3), 0.2, LYING),
    "standing": (lambda b, i: b.add_cylinder(i, 0.2, 0.3), 0.3, (0, 0, 0, 1)),
    "hull": (lambda b, i: b.add_hull(i, CORNERS * [0.3, 0.2, 0.2]), 0.2, (0, 0, 0.2, np.sqrt(1 - 0.04))),
}


def slid(kind: str, ground, velocity=(2.0, 0.3, 0.0)) -> tuple[np.ndarray, int]:
    """Pose after half a second of sliding or rolling, and the most contacts of a step."""
    add, height, turn = ADDS[kind]
    b = wl.ModelBuilder()
    ground(b)
    add(b, b.add_body(pose=(0.1, 0.05, height, *turn), velocity=velocity))
    sim = simulator(b)
    most = 0
    for _ in range(50):
        sim.step(10)
        assert not sim.status.numpy().any()
        most = max(most, int(sim.contacts.count.numpy()[0]))
    return sim.q.numpy()[0], most


@pytest.mark.parametrize("cells", [1, 7, 23])
@pytest.mark.parametrize("kind", ADDS)
def test_flat_mesh_is_a_plane(kind, cells):
    """What slides over seams goes where it goes on a plane, flat faces to round-off; what is round has the second order of its bend."""
    on_plane, _ = slid(kind, lambda b: b.add_plane())
    on_mesh, most = slid(kind, lambda b: b.add_mesh(-1, *grid(cells)))
    # What is round comes to a seam as to an edge: up to (v h)^2 / 2 r, 2e-5 m for the capsule, each; 6 seams at most.
    assert on_mesh == pytest.approx(on_plane, abs=1.2e-4 if kind in ("ball", "capsule") else 2e-6)
    if kind in ("box", "hull"):
        assert most <= 8  # corners, none where triangles meet


def test_ball_touches_the_nearest_point_of_every_triangle():
    """Over a rough mesh: the least gap is that of the nearest point, found triangle by triangle."""
    rng = np.random.default_rng(3)
    points, triangles = grid(6, lambda x, y: 0.3 * np.sin(3.0 * x) * np.cos(2.0 * y), 3.0)
    b = wl.ModelBuilder(gravity=(0, 0, 0))
    b.add_mesh(-1, points, triangles)
    b.add_sphere(b.add_body(), 0.25)
    envs = 80
    q = np.zeros((envs, 7))
    q[:, :3], q[:, 6] = rng.uniform([-1.3, -1.3, 0.0], [1.3, 1.3, 0.6], (envs, 3)), 1.0
    sim = simulator(b, num_envs=envs)
    sim.q.assign(q)
    sim.step()
    gap, point, normal, seen = sim.slots.gap.numpy(), sim.slots.point.numpy(), sim.slots.normal.numpy(), 0

    class Faces:
        simplices = triangles
        equations = None

    p = points[triangles]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    n /= np.linalg.norm(n, axis=1)[:, None]
    Faces.equations = np.c_[n, -(n * p[:, 0]).sum(axis=1)]
    for env in range(envs):
        best = nearest_on_triangles(q[env, :3], Faces, points) - 0.25
        if best > 0.0:
            assert (gap[env] > 0.0).all()
        if best < -1e-3:
            seen += 1
            k = gap[env].argmin()
            assert gap[env, k] == pytest.approx(best, abs=1e-9)
            # From the mesh's point, half-way across the gap, the normal leads away from the centre.
            assert point[env, k] == pytest.approx(q[env, :3] + normal[env, k] * (0.25 + 0.5 * gap[env, k]), abs=1e-9)
    assert seen > 15


def test_ball_in_a_groove_of_triangles():
    """Two slopes of 45 degrees: the centre hangs r sqrt(2) above their line, and the ball stays."""
    points = [(-1, -1, 1), (-1, 1, 1), (0, -1, 0), (0, 1, 0), (1, -1, 1), (1, 1, 1)]
    b = wl.ModelBuilder()
    b.add_mesh(-1, points, [(0, 2, 1), (1, 2, 3), (2, 4, 3), (3, 4, 5)])
    b.add_sphere(b.add_body(pose=(0.05, 0.1, 0.6, 0, 0, 0, 1)), 0.2)
    sim = simulator(b)
    sim.step(3000)
    assert not sim.status.numpy().any()
    assert sim.q.numpy()[0, [0, 2]] == pytest.approx([0.0, 0.2 * np.sqrt(2.0)], abs=1e-6)


def test_belt_of_triangles_carries_a_box():
    """A kinematic body with a mesh at 0.7 m/s: a box on it ends at that speed, after (0.7)^2 / (2 mu g) of slip."""
    b = wl.ModelBuilder()
    belt = b.add_body(joint=wl.JointType.KINEMATIC, velocity=(0.7, 0, 0))
    b.add_mesh(belt, *grid(9))
    b.add_box(b.add_body(pose=(0, 0, 0.2, 0, 0, 0, 1)), (0.2, 0.2, 0.2))
    sim = simulator(b)
    sim.step(1000)
    q, v = sim.q.numpy()[0], sim.v.numpy()[0]
    assert v[6:9] == pytest.approx([0.7, 0.0, 0.0], abs=1e-6)
    assert q[0] - q[7] == pytest.approx(0.7**2 / (2 * 0.5 * 9.81), abs=0.7 * 1e-3)  # Euler's rule: half a step of the speed, and less


@pytest.mark.parametrize("dt", [1e-3, 5e-3])
def test_everything_on_rough_ground(dt):
    """Boxes, balls, capsules, cylinders, cones and rocks dropped on bumps of 10 cm: certified, and nothing falls through."""
    rng = np.random.default_rng(11)
    b = wl.ModelBuilder()
    b.add_mesh(-1, *grid(16, lambda x, y: 0.05 * np.sin(2.5 * x) * np.cos(2.1 * y) + 0.02 * (x**2 + y**2), 4.0))
    adds = [
        lambda i: b.add_box(i, (0.15, 0.1, 0.08)),
        lambda i: b.add_sphere(i, 0.12),
        lambda i: b.add_capsule(i, 0.08, 0.12),
        lambda i: b.add_cylinder(i, 0.12, 0.1),
        lambda i: b.add_cone(i, 0.12, 0.12),
        lambda i: b.add_hull(i, 0.5 * ROCK),
    ]
    for k, add in enumerate(adds):
        x, y = 0.5 * (k % 3 - 1), 0.6 * (k // 3) - 0.3
        add(b.add_body(pose=(x, y, 0.5, *random_quaternions(rng, 1, 1)[0, 0])))
    sim = simulator(b, dt=dt)
    worst = 0.0
    for _ in range(round(2.0 / dt) // 10):
        sim.step(10)
        assert not sim.status.numpy().any()
        count = sim.contacts.count.numpy()[0]
        worst = min(worst, sim.contacts.gap.numpy()[0, :count].min(initial=0.0))
    q = sim.q.numpy()[0].reshape(-1, 7)
    assert worst > -2.0 * dt  # m: first order, as of all that lands and turns
    assert (q[:, 2] > 0.0).all()
    assert np.abs(sim.v.numpy()[0].reshape(-1, 6)[:, :3]).max() < 1.0


def test_points_of_seams_are_none():
    """Bits of sides beyond which triangles go on, of front and back: of a square the diagonal, of a folded one none."""
    flat = wl.ModelBuilder()
    flat.add_mesh(-1, [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2), (0, 2, 3)])
    flat.add_box(flat.add_body(), (0.1, 0.1, 0.1))
    folded = wl.ModelBuilder()
    folded.add_mesh(-1, [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.1)], [(0, 1, 2), (0, 2, 3)])
    folded.add_box(folded.add_body(), (0.1, 0.1, 0.1))
    for builder, expected in ((flat, [4, 4, 1, 2]), (folded, [0, 0, 0, 0])):
        sim = simulator(builder)
        hulls, _ = arrays(builder.finalize(), sim)
        assert hulls.seam.numpy()[-4:].tolist() == expected


def test_far_away_it_has_no_points():
    b = wl.ModelBuilder()
    b.add_mesh(-1, *grid(3))
    b.add_box(b.add_body(pose=(0, 0, 5, 0, 0, 0, 1)), (0.1, 0.1, 0.1))
    sim = simulator(b)
    sim.step()
    assert (sim.slots.gap.numpy() >= NO_POINT).all()


@pytest.mark.parametrize(
    ("points", "triangles", "message"),
    [
        ([(0, 0, 0), (1, 0, 0)], [(0, 1, 2)], "corner 2 of 2 points"),
        ([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1)], "\\[T, 3\\]"),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)], "no triangle has an area"),
        ([(0, 0, np.inf), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)], "finite"),
    ],
)
def test_meshes_that_are_none(points, triangles, message):
    with pytest.raises(wl.ModelError, match=message):
        mesh("ground", points, triangles)


def test_mesh_cannot_move_freely():
    b = wl.ModelBuilder()
    with pytest.raises(wl.ModelError, match="cannot move freely; use add_hull"):
        b.add_mesh(b.add_body(), *grid(1))
