# SPDX-License-Identifier: Apache-2.0
"""Cylinders, cones and hulls: gaps against Qhull's Minkowski differences and nearest points on triangles, motion against closed forms."""

import numpy as np
import pytest
from conftest import random_quaternions, simulator
from scipy.spatial import ConvexHull
from test_collide import slots, two
from warp_lcp.kernels.collide import NO_POINT

import warp_lcp as wl
from warp_lcp.builder import rotation_matrix
from warp_lcp.hulls import BOX_FACES, CORNERS, MAX_POINTS, convex_hull, solid
from warp_lcp.model import Hull

LYING = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))  # z of the shape along x
BOX_POINTS = CORNERS * [0.3, 0.2, 0.1]
ROCK = np.random.default_rng(4).normal(size=(20, 3)) * [0.3, 0.2, 0.15]
COARSE = 0.2 * (1.0 - np.cos(np.pi / 120))  # m: what the prisms below are short of their cylinders by
NEAR = 1e-9  # m: ten digits of a size of about one, what products of edges and Qhull's normals leave


def many_sided(radius: float, half: float, sides: int = 120, tip: bool = False) -> np.ndarray:
    """Points of a prism inside a cylinder, or of a pyramid inside a cone: short of it by radius (1 - cos(pi / sides))."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, -half)], axis=1)
    return np.vstack([ring, [[0.0, 0.0, half]] if tip else ring * [1.0, 1.0, -1.0]])


SHAPES = {
    "box": (lambda b, i: b.add_box(i, (0.3, 0.2, 0.1)), BOX_POINTS),
    "hull": (lambda b, i: b.add_hull(i, ROCK), ROCK),
    "cylinder": (lambda b, i: b.add_cylinder(i, 0.2, 0.3), many_sided(0.2, 0.3)),
    "cone": (lambda b, i: b.add_cone(i, 0.2, 0.3), many_sided(0.2, 0.3, tip=True)),
}


def poses(rng, envs: int, reach: float) -> np.ndarray:
    q = np.zeros((envs, 2, 7))
    q[:, 1, :3] = rng.uniform(-reach, reach, (envs, 3))
    q[:, :, 3:] = random_quaternions(rng, envs, 2)
    return q


def placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return points @ rotation_matrix(pose[3:]).T + pose[:3]


def widest_gap(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Of the facets of the Minkowski difference the one that the origin is furthest outside of or least inside: (gap, normal to b)."""
    facets = ConvexHull((a[:, None] - b[None]).reshape(-1, 3)).equations
    k = facets[:, 3].argmax()
    return float(facets[k, 3]), facets[k, :3]


def separation(a: np.ndarray, b: np.ndarray, n: np.ndarray) -> float:
    return float((b @ n).min() - (a @ n).max())


@pytest.mark.parametrize("kinds", [("box", "hull"), ("hull", "hull"), ("hull", "cylinder"), ("box", "cone"), ("cylinder", "cylinder")])
def test_axis_is_the_widest_gap_between_faces_and_edges(kinds):
    """A pair's normal parts it as far as the best facet of the Minkowski difference, less what faces are preferred by."""
    (add_a, points_a), (add_b, points_b) = (SHAPES[kind] for kind in kinds)
    exact = not set(kinds) & {"cylinder", "cone"}
    few = 40 if exact else 12
    rng = np.random.default_rng(1)
    q = poses(rng, few, 0.45)
    normal, gap = slots(two(add_a, add_b), q, names="normal gap")
    prefer = 1e-3 * min(0.5 * np.ptp(points, axis=0).min() for points in (points_a, points_b))
    coarse = 0.0 if exact else 2.0 * COARSE
    touched = 0
    # Pairs are stored with the lower type first, and so are normals.
    flip = wl.ShapeType[kinds[0].upper()] > wl.ShapeType[kinds[1].upper()]
    for env in range(few):
        a, b = placed(points_a, q[env, 0]), placed(points_b, q[env, 1])
        best, _ = widest_gap(a, b)
        if best > 0.02:
            continue  # too far apart to have points
        n = -normal[env, 0] if flip else normal[env, 0]
        found = separation(a, b, n)
        assert best - prefer - coarse - NEAR <= found <= best + NEAR
        points = gap[env] < NO_POINT
        assert points.any()
        assert gap[env][points].min() >= found - coarse - NEAR  # none is deeper than the shapes are
        if found > -0.02:
            assert gap[env][points].min() <= found + 0.02  # and where they graze, one is nearly as deep
        touched += best < 0.0
    assert touched >= 3


def nearest_on_triangles(p: np.ndarray, hull: ConvexHull, points: np.ndarray) -> float:
    """Distance of a point outside from a hull: the least over its triangles, their sides and their corners."""
    best = np.inf
    for simplex, (*n, c) in zip(hull.simplices, hull.equations, strict=True):
        corners, n = points[simplex], np.array(n)
        foot = p - (p @ n + c) * n
        weights = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.r_[foot, 1.0], rcond=None)[0]
        if (weights >= 0.0).all():
            best = min(best, abs(p @ n + c))
        for i in range(3):
            e = corners[(i + 1) % 3] - corners[i]
            s = np.clip((p - corners[i]) @ e / (e @ e), 0.0, 1.0)
            best = min(best, float(np.linalg.norm(p - corners[i] - s * e)))
    return best


def test_ball_touches_the_nearest_point_of_a_hull():
    rng = np.random.default_rng(2)
    q = poses(rng, 60, 0.6)
    point, normal, gap = slots(two(lambda b, i: b.add_sphere(i, 0.15), SHAPES["hull"][0]), q, names="point normal gap")
    hull, seen = ConvexHull(ROCK), 0
    for env in range(60):
        centre = rotation_matrix(q[env, 1, 3:]).T @ (q[env, 0, :3] - q[env, 1, :3])
        if (hull.equations[:, :3] @ centre + hull.equations[:, 3]).max() <= 0.0 or gap[env, 0] > 0.02:
            continue
        seen += 1
        distance = nearest_on_triangles(centre, hull, ROCK)
        assert gap[env, 0] == pytest.approx(distance - 0.15, abs=NEAR)
        # The point is half-way across the gap, along the normal.
        assert point[env, 0] == pytest.approx(q[env, 0, :3] + normal[env, 0] * (0.15 + 0.5 * gap[env, 0]), abs=NEAR)
    assert seen >= 10


def test_ball_touches_the_nearest_point_of_a_cylinder_and_of_a_cone():
    rng = np.random.default_rng(3)
    for kind in ("cylinder", "cone"):
        q = poses(rng, 60, 0.5)
        (gap,) = slots(two(lambda b, i: b.add_sphere(i, 0.15), SHAPES[kind][0]), q, names="gap")
        seen = 0
        for env in range(60):
            x, y, z = rotation_matrix(q[env, 1, 3:]).T @ (q[env, 0, :3] - q[env, 1, :3])
            rho = np.hypot(x, y)
            if kind == "cylinder":
                if rho < 0.2 and abs(z) < 0.3:
                    continue
                distance = np.hypot(max(rho - 0.2, 0.0), max(abs(z) - 0.3, 0.0))
            else:  # in the plane of the axis: a triangle with the corners (0.2, -0.3), (0, 0.3), (0, -0.3)
                if z > -0.3 and rho / 0.2 + (z + 0.3) / 0.6 < 1.0:
                    continue
                distance = np.inf
                for p, r in (((0.2, -0.3), (0.0, 0.3)), ((0.0, -0.3), (0.2, -0.3))):
                    e, off = np.subtract(r, p), np.subtract((rho, z), p)
                    distance = min(distance, float(np.linalg.norm(off - np.clip(off @ e / (e @ e), 0.0, 1.0) * e)))
            if gap[env, 0] < 0.02:
                seen += 1
                assert gap[env, 0] == pytest.approx(distance - 0.15, abs=1e-7)  # round sides: the square root of the method's rest
        assert seen >= 8


@pytest.mark.parametrize("kind", ["hull", "cylinder", "cone"])
def test_capsule_end_and_middle(kind):
    """The deepest point of a capsule is the nearest of its core, found by trying a thousand balls along it."""
    rng = np.random.default_rng(5)
    q = poses(rng, 80, 0.6)
    (gap,) = slots(two(lambda b, i: b.add_capsule(i, 0.1, 0.25), SHAPES[kind][0]), q, names="gap")
    balls = np.linspace(-0.25, 0.25, 501)
    points = SHAPES[kind][1]
    hull, seen = ConvexHull(points), 0
    for env in range(80):
        if gap[env].min() > 0.02:
            continue
        A, B = rotation_matrix(q[env, 0, 3:]), rotation_matrix(q[env, 1, 3:])
        core = (q[env, 0, :3] + balls[:, None] * A[:, 2] - q[env, 1, :3]) @ B
        outside = (core @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
        if outside.min() <= 1e-3:
            continue
        near = np.argsort(outside)[:60] if kind != "hull" else np.arange(501)
        if kind == "hull":
            best = min(nearest_on_triangles(core[k], hull, points) for k in near[::5])
            assert best - 2e-3 <= gap[env].min() + 0.1 <= best + NEAR  # a ball in five is off by 2.5 mm along, less across
        else:
            assert gap[env].min() + 0.1 >= outside.min() - COARSE
        seen += 1
    assert seen >= 5


# ---------------------------------------------------------------------------------------------------------------- motion


def test_hull_of_a_box_moves_like_a_box():
    """On a plane a hull has the corners of the box for points: the same throw, to round-off that contacts pass on."""
    q = []
    for add in (lambda b, i: b.add_box(i, (0.3, 0.2, 0.1)), lambda b, i: b.add_hull(i, BOX_POINTS)):
        b = wl.ModelBuilder()
        b.add_plane()
        add(b, b.add_body(pose=(0, 0, 0.4, 0.1, 0.7, 0.1, 0.7), velocity=(1.0, 0.5, 0.0), angular_velocity=(1.0, 2.0, 3.0)))
        sim = simulator(b)
        sim.step(600)
        assert not sim.status.numpy().any()
        q.append(sim.q.numpy()[0])
    assert q[1] == pytest.approx(q[0], abs=1e-7)


def rolling(ground, kind: str, dt: float = 1e-3) -> np.ndarray:
    """Velocity after a second down a slope of 10 degrees, [6], of something round of 0.2 m that lies across it."""
    g = 9.81 * np.array([np.sin(np.radians(10.0)), 0.0, -np.cos(np.radians(10.0))])
    b = wl.ModelBuilder(gravity=g)
    ground(b)
    body = b.add_body(pose=(0.0, 0.0, 0.2, -np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)))  # z of the shape along y
    if kind == "cylinder":
        b.add_cylinder(body, 0.2, 0.3)
    sim = simulator(b, dt=dt)
    sim.step(round(1.0 / dt))
    assert not sim.status.numpy().any()
    return sim.v.numpy()[0]


def floor(b):
    b.add_plane()


def slab(b):
    b.add_box(-1, (5.0, 2.0, 0.5), pose=(2.0, 0.0, -0.5, 0.0, 0.0, 0.0, 1.0))


def slabs(b):
    for k in range(-2, 12):
        b.add_box(-1, (0.25, 2.0, 0.5), pose=(0.5 * k + 0.1, 0.0, -0.5, 0.0, 0.0, 0.0, 1.0))


def hull_slab(b):
    b.add_hull(-1, CORNERS * [5.0, 2.0, 0.5], pose=(2.0, 0.0, -0.5, 0.0, 0.0, 0.0, 1.0))


@pytest.mark.parametrize("ground", [floor, slab, slabs, hull_slab])
def test_cylinder_rolls_down_a_slope(ground):
    """a = 2/3 g sin(10 deg), which Euler's rule meets exactly where nothing bends; seams take 1e-4 of it at most."""
    v = rolling(ground, "cylinder")
    expected = 2.0 / 3.0 * 9.81 * np.sin(np.radians(10.0))
    tolerance = 1e-4 if ground is slabs else 1e-8  # the relaxation of Table 1 creeps by 1e-9
    assert v[0] == pytest.approx(expected, rel=tolerance)
    assert v[4] == pytest.approx(expected / 0.2, rel=tolerance)
    assert np.abs(v[[1, 2, 3, 5]]).max() < 1e-6


@pytest.mark.parametrize("kind", ["hull", "cylinder"])
def test_sliding_over_tiles_trips_over_no_side(kind):
    """Tiles of 0.5 m whose tops are flush, 4 m/s, 5 ms: as far as on one plane, and never off the ground.

    Where it is now, a tile ahead is parted from it by its side; where the step leads, by its top, which is what it must meet.
    """
    ends = []
    for tiles in (False, True):
        b = wl.ModelBuilder()
        if tiles:
            for k in range(-2, 12):
                b.add_hull(-1, CORNERS * [0.25, 2.0, 0.5], pose=(0.5 * k + 0.1, 0.0, -0.5, 0.0, 0.0, 0.0, 1.0))
        else:
            b.add_plane()
        body = b.add_body(pose=(0, 0, 0.1, 0, 0, 0, 1), velocity=(4.0, 0, 0))
        b.add_hull(body, CORNERS * [0.2, 0.2, 0.1]) if kind == "hull" else b.add_cylinder(body, 0.2, 0.1)
        sim = simulator(b, dt=5e-3)
        for _ in range(160):
            sim.step()
            assert not sim.status.numpy().any()
            assert abs(sim.q.numpy()[0, 2] - 0.1) < 1e-5
        ends.append(sim.q.numpy()[0, 0])
    assert ends[1] == pytest.approx(ends[0], abs=1e-4)


@pytest.mark.parametrize("kind", ["cylinder", "cone", "hull"])
def test_what_stands_stays(kind):
    """Two seconds on a plane and on a box: what is left of its speed is round-off."""
    for ground in (floor, slab):
        b = wl.ModelBuilder()
        ground(b)
        body = b.add_body(pose=(0.1, 0.1, 0.31, 0, 0, 0.2, 0.98))
        SHAPES[kind][0](b, body) if kind != "hull" else b.add_hull(body, CORNERS * 0.3)
        sim = simulator(b, dt=5e-3)
        sim.step(400)
        assert not sim.status.numpy().any()
        assert np.abs(sim.v.numpy()).max() < 1e-9
        assert sim.q.numpy()[0, 2] == pytest.approx(0.3, abs=1e-7)


def test_cylinder_tips_over_its_rim():
    """On a slope it stands up to tan = r / h (its corners on a plane: a hexagon, which reaches r cos 30 deg at least) and falls beyond."""
    for slope, stands in ((0.95 * np.arctan(0.2 * np.cos(np.pi / 6) / 0.3), True), (1.05 * np.arctan(0.2 / 0.3), False)):
        b = wl.ModelBuilder(gravity=(9.81 * np.sin(slope), 0.0, -9.81 * np.cos(slope)))
        b.add_plane(material=wl.Material(2.0, 2.0))
        b.add_cylinder(b.add_body(pose=(0, 0, 0.3, 0, 0, 0, 1)), 0.2, 0.3, material=wl.Material(2.0, 2.0))
        sim = simulator(b)
        sim.step(1000)
        tilt = np.degrees(2.0 * np.arccos(np.clip(np.abs(sim.q.numpy()[0, 6]), 0.0, 1.0)))
        assert not sim.status.numpy().any()
        assert tilt < 0.01 if stands else tilt > 10.0


def test_three_logs_rest_on_each_other():
    """Two on the ground, held apart by a hair, one on top: lines side by side touch at both ends, heights as of circles."""
    b = wl.ModelBuilder()
    b.add_plane()
    for y in (-0.201, 0.201):
        b.add_cylinder(b.add_body(pose=(0, y, 0.2, *LYING)), 0.2, 0.5, material=wl.Material(1.0, 1.0))
    b.add_cylinder(b.add_body(pose=(0, 0, 0.2 + np.sqrt(0.16 - 0.201**2) + 1e-3, *LYING)), 0.2, 0.5, material=wl.Material(1.0, 1.0))
    sim = simulator(b)
    sim.step(1000)
    assert not sim.status.numpy().any()
    q = sim.q.numpy()[0].reshape(3, 7)
    apart = 0.5 * (q[1, 1] - q[0, 1])
    assert q[2, 2] == pytest.approx(0.2 + np.sqrt(0.16 - apart**2), abs=1e-5)
    assert np.abs(sim.v.numpy()).max() < 1e-3


@pytest.mark.parametrize("dt", [1e-3, 5e-3])
def test_heap_of_everything_comes_to_rest(dt):
    """Cylinders, cones, rocks, balls, capsules and boxes dropped into a box: certified, nothing falls through, little overlap."""
    rng = np.random.default_rng(7)
    b = wl.ModelBuilder()
    b.add_plane()
    for x, y, half in ((0.8, 0, (0.1, 0.9, 0.5)), (-0.8, 0, (0.1, 0.9, 0.5)), (0, 0.8, (0.9, 0.1, 0.5)), (0, -0.8, (0.9, 0.1, 0.5))):
        b.add_box(-1, half, pose=(x, y, 0.5, 0, 0, 0, 1))
    adds = (
        lambda i: b.add_cylinder(i, 0.12, 0.2),
        lambda i: b.add_cone(i, 0.15, 0.15),
        lambda i: b.add_hull(i, 0.8 * ROCK),
        lambda i: b.add_sphere(i, 0.14),
        lambda i: b.add_capsule(i, 0.08, 0.15),
        lambda i: b.add_box(i, (0.15, 0.12, 0.1)),
    )
    for k, add in enumerate(2 * adds):
        x, y = rng.uniform(-0.4, 0.4, 2)
        add(b.add_body(pose=(x, y, 0.4 + 0.35 * k, *random_quaternions(rng, 1, 1)[0, 0])))
    sim = simulator(b, dt=dt)
    uncertified = 0
    for _ in range(round(3.0 / dt) // 20):
        sim.step(20)
        uncertified += int((sim.status.numpy() != 0).any())
    q = sim.q.numpy()[0].reshape(-1, 7)
    count = sim.contacts.count.numpy()[0]
    assert uncertified == 0
    assert np.isfinite(q).all()
    assert (np.abs(q[:, :2]) < 0.8).all()
    assert (q[:, 2] > 0.05).all()
    assert sim.contacts.gap.numpy()[0, :count].min() > -0.02


# ----------------------------------------------------------------------------------------------------------- mass, input


def test_solids():
    """Volume, centre and inertia of a box and of a fine prism and pyramid, against their formulas."""
    volume, centre, inertia = solid(convex_hull("box", CORNERS * [0.3, 0.2, 0.1] + [1.0, 2.0, 3.0])[0])
    assert volume == pytest.approx(0.048, rel=1e-12)
    assert centre == pytest.approx([1.0, 2.0, 3.0], rel=1e-12)
    assert inertia == pytest.approx(np.diag([0.05, 0.1, 0.13]) / 3.0, abs=1e-12)
    for kind in ("cylinder", "cone"):
        b = wl.ModelBuilder()
        SHAPES[kind][0](b, b.add_body())
        model = b.finalize()
        points = many_sided(0.2, 0.3, 720, kind == "cone")
        whole = ConvexHull(points)
        volume = np.pi * 0.2**2 * 0.6 / (3.0 if kind == "cone" else 1.0)
        assert model.mass[0] == pytest.approx(1000.0 * volume, rel=1e-12)
        assert whole.volume == pytest.approx(volume, rel=1e-4)
        # The inertia of the prism, from its triangles: 1 - cos(pi / 720) short.
        triangles = []
        place = {v: k for k, v in enumerate(whole.vertices)}
        for simplex, (*n, _) in zip(whole.simplices, whole.equations, strict=True):
            p = points[simplex]
            outward = np.cross(p[1] - p[0], p[2] - p[0]) @ n > 0.0
            triangles.append(tuple(place[k] for k in (simplex if outward else simplex[::-1])))
        _, centre, inertia = solid(Hull(points[whole.vertices], tuple(triangles)))
        assert model.com[0] == pytest.approx(centre, abs=1e-5)
        assert model.inertia[0] == pytest.approx(model.mass[0] * inertia, rel=1e-4, abs=1e-5 * model.mass[0])


def test_hull_of_many_points_keeps_those_that_matter():
    """A fine ball keeps 64 corners, and says how far it falls short: less than with as many spread by chance."""
    rng = np.random.default_rng(6)
    points = rng.normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    hull, short = convex_hull("ball", points)
    assert len(hull.points) == MAX_POINTS
    chance = ConvexHull(points[:MAX_POINTS])
    assert 0.0 < short < 0.5 * (points @ chance.equations[:, :3].T + chance.equations[:, 3]).max()


def test_faces_of_a_hull_are_merged():
    hull, short = convex_hull("box", np.vstack([CORNERS, CORNERS * [1.0, 0.5, 1.0], CORNERS * 0.2]))
    assert short == 0.0
    assert len(hull.points) == 8
    assert sorted(map(len, hull.faces)) == [4] * 6
    for points, faces in ((hull.points, hull.faces), (CORNERS, BOX_FACES)):
        for face in faces:
            corners = points[list(face)]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
            assert normal @ corners[0] > 0.0  # outward, counterclockwise


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((8, 3)), "span no volume"),
        (CORNERS * [1.0, 1.0, 0.0], "span no volume|one plane"),
        ([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], "span no volume"),
        (np.full((8, 3), np.nan), "finite"),
        (np.zeros((8, 2)), "\\[N, 3\\]"),
    ],
)
def test_points_that_are_no_hull(points, message):
    b = wl.ModelBuilder()
    with pytest.raises(wl.ModelError, match=message):
        b.add_hull(b.add_body(), points)


def test_sizes_are_checked():
    b = wl.ModelBuilder()
    body = b.add_body()
    for add in (b.add_cylinder, b.add_cone):
        with pytest.raises(wl.ModelError, match="greater than zero"):
            add(body, 0.0, 1.0)
        with pytest.raises(wl.ModelError, match="greater than zero"):
            add(body, 1.0, -1.0)
