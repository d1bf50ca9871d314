# SPDX-License-Identifier: Apache-2.0
"""Ellipsoids: contacts by certificates that need no solver, and against scipy and balls; motion against closed forms."""

import numpy as np
import pytest
from conftest import GRAVITY, random_quaternions, simulator
from scipy.optimize import minimize
from scipy.spatial import ConvexHull
from test_collide import two
from test_convex import ROCK
from warp_lcp.kernels.collide import NO_POINT

import warp_lcp as wl
from warp_lcp.builder import rotation_matrix

ROUND = 1e-13  # m: of lengths up to 3 m in double precision, with some hundred operations
NAMES = ("point", "normal", "gap", "bend")
HULL = ConvexHull(ROCK)
OTHER = np.array([0.25, 0.1, 0.18])
#: Adds the shape; its support along n, and how far outside of it x is (less than zero inside, zero on its surface).
SHAPES = {
    "sphere": (lambda b, i: b.add_sphere(i, 0.15), lambda n: 0.15 * n, lambda x: np.linalg.norm(x) - 0.15),
    "capsule": (
        lambda b, i: b.add_capsule(i, 0.1, 0.2),
        lambda n: 0.1 * n + [0.0, 0.0, np.copysign(0.2, n[2])],
        lambda x: np.linalg.norm(x - [0.0, 0.0, np.clip(x[2], -0.2, 0.2)]) - 0.1,
    ),
    "box": (
        lambda b, i: b.add_box(i, (0.3, 0.2, 0.1)),
        lambda n: np.copysign([0.3, 0.2, 0.1], n),
        lambda x: (np.abs(x) - [0.3, 0.2, 0.1]).max(),
    ),
    "hull": (
        lambda b, i: b.add_hull(i, ROCK),
        lambda n: ROCK[(ROCK @ n).argmax()],
        lambda x: (HULL.equations[:, :3] @ x + HULL.equations[:, 3]).max(),
    ),
    "cylinder": (
        lambda b, i: b.add_cylinder(i, 0.2, 0.3),
        lambda n: np.r_[0.2 * n[:2] / np.linalg.norm(n[:2]), np.copysign(0.3, n[2])],
        lambda x: max(np.hypot(*x[:2]) - 0.2, abs(x[2]) - 0.3),
    ),
    "cone": (
        lambda b, i: b.add_cone(i, 0.2, 0.3),
        lambda n: max((np.r_[0.2 * n[:2] / np.linalg.norm(n[:2]), -0.3], np.array([0.0, 0.0, 0.3])), key=lambda p: p @ n),
        lambda x: max(-0.3 - x[2], (0.6 * np.hypot(*x[:2]) - 0.2 * (0.3 - x[2])) / np.hypot(0.6, 0.2)),
    ),
    "ellipsoid": (lambda b, i: b.add_ellipsoid(i, OTHER), lambda n: top(OTHER, n), lambda x: beyond(OTHER, x)),
}


def top(axes, n):
    """Point of an ellipsoid furthest along n."""
    return axes**2 * n / np.linalg.norm(axes * n)


def beyond(axes, x):
    """Distance of x from an ellipsoid, to first order near its surface."""
    return (np.linalg.norm(x / axes) - 1.0) / np.linalg.norm(x / axes**2)


class Pair:
    """Contacts of shape 0 with shape 1 at any poses; it looks metres ahead, as the first one is fast."""

    def __init__(self, add, add_other, envs: int, velocity=(50.0, 0.0, 0.0, 0.0, 0.0, 0.0)):
        self.sim = simulator(two(add, add_other), num_envs=envs, dt=0.1)
        self.v = np.zeros((envs, 2, 6))
        self.v[:, 0] = velocity

    def look(self, q: np.ndarray) -> list[np.ndarray]:
        """point, normal [E, 3], gap and bend [E] at poses [E, 2, 7]."""
        self.sim.reset()
        self.sim.q.assign(q.reshape(len(q), -1))
        self.sim.v.assign(self.v.reshape(len(q), -1))
        self.sim.step()
        return [getattr(self.sim.slots, name).numpy()[:, 0] for name in NAMES]


def apart(rng, envs: int, least: float, most: float) -> np.ndarray:
    """Poses [E, 2, 7] with centres so far apart."""
    q = np.zeros((envs, 2, 7))
    away = rng.normal(size=(envs, 3))
    q[:, 1, :3] = away / np.linalg.norm(away, axis=1, keepdims=True) * rng.uniform(least, most, (envs, 1))
    q[:, :, 3:] = random_quaternions(rng, envs, 2)
    return q


@pytest.mark.parametrize("kind", SHAPES)
def test_contact_is_certified_by_the_shapes(kind):
    """Two points, one on each surface, as far apart as the shapes are along the normal: then no others are nearer.

    Where they overlap by less than the least radius of curvature the same two say that they leave along the normal. Axes from a ball's
    to a needle's and a coin's; a normal that is off by x moves the point by its radius of curvature times x, 0.05 m at the least
    where the tolerance is 1e-9 of that.
    """
    add, support, outside = SHAPES[kind]
    rng, envs, compared = np.random.default_rng(7), 40, 0
    for axes in ([0.3, 0.2, 0.12], [0.3, 0.3, 0.03], [0.5, 0.05, 0.05], [0.2, 0.2, 0.2]):
        axes, pair = np.array(axes), Pair(add, lambda b, i, axes=axes: b.add_ellipsoid(i, axes), envs)
        q = apart(rng, envs, 1.3, 2.0)
        for asked in (0.5, 1e-3, 0.0, -1e-6, -0.3 * axes.min() ** 2 / axes.max()):
            for _ in range(2):  # from far to where the gap is the one asked for, along the normal
                point, normal, gap, _ = pair.look(q)
                q[:, 1, :3] += normal * (asked - gap)[:, None]
            point, normal, gap, _ = pair.look(q)
            assert gap == pytest.approx(np.full(envs, asked), abs=ROUND)
            for env in range(envs):
                a, b = (rotation_matrix(pose[3:]) for pose in q[env])
                on_a, on_b = (point[env] + sign * 0.5 * gap[env] * normal[env] for sign in (-1.0, 1.0))
                assert outside(a.T @ (on_a - q[env, 0, :3])) == pytest.approx(0.0, abs=1e-11)
                assert beyond(axes, b.T @ (on_b - q[env, 1, :3])) == pytest.approx(0.0, abs=1e-11)
                n = normal[env]
                furthest = q[env, 0, :3] + a @ support(a.T @ n)
                nearest = q[env, 1, :3] + b @ top(axes, -(b.T @ n))
                assert n @ (nearest - furthest) == pytest.approx(gap[env], abs=ROUND)
                compared += 1
    assert compared == 40 * 5 * 4


def test_gap_on_a_plane():
    """Its centre's height less sqrt(n . R A^2 R^T n); the point half-way to the surface where its normal is that of the plane."""
    rng, axes = np.random.default_rng(1), np.array([0.3, 0.2, 0.1])
    builder = wl.ModelBuilder()
    builder.add_plane(pose=(0.1, 0.2, 0.3, 0.6, 0, 0, 0.8))
    builder.add_ellipsoid(builder.add_body(), axes)
    sim = simulator(builder, num_envs=50)
    q = np.concatenate([rng.uniform(-1, 1, (50, 3)), random_quaternions(rng, 50)], axis=1)
    sim.q.assign(q)
    sim.step()
    n = rotation_matrix(np.array([0.6, 0, 0, 0.8])) @ [0, 0, 1]
    point, normal, gap = (getattr(sim.slots, name).numpy()[:, 0] for name in NAMES[:3])
    for env in range(50):
        turn = rotation_matrix(q[env, 3:])
        height = n @ (q[env, :3] - [0.1, 0.2, 0.3])
        assert normal[env] == pytest.approx(n, abs=ROUND)
        assert gap[env] == pytest.approx(height - np.sqrt(n @ turn @ np.diag(axes**2) @ turn.T @ n), abs=ROUND)
        x = turn.T @ (point[env] + 0.5 * gap[env] * n - q[env, :3])
        assert beyond(axes, x) == pytest.approx(0.0, abs=ROUND)
        assert np.cross(x / axes**2, turn.T @ n) == pytest.approx(np.zeros(3), abs=1e-11)  # gradient, 10 /m, along n


def test_distance_of_two_ellipsoids_against_scipy():
    """The least |x - y| between points of both, by SLSQP: to 1e-8 m, the square of what it leaves of their places."""
    rng, axes = np.random.default_rng(2), np.array([0.3, 0.2, 0.12])
    q = apart(rng, 8, 0.6, 1.0)
    _, _, gap, _ = Pair(SHAPES["ellipsoid"][0], lambda b, i: b.add_ellipsoid(i, axes), 8).look(q)
    for env in range(8):
        a, b = (rotation_matrix(pose[3:]) for pose in q[env])

        def between(z, env=env, a=a, b=b):
            return q[env, 1, :3] + b @ (axes * z[3:]) - a @ (OTHER * z[:3])

        inside = [{"type": "ineq", "fun": lambda z, k=k: 1.0 - z[k : k + 3] @ z[k : k + 3]} for k in (0, 3)]
        found = minimize(lambda z: between(z) @ between(z), np.zeros(6), method="SLSQP", constraints=inside, options={"ftol": 1e-16})
        assert gap[env] == pytest.approx(np.sqrt(found.fun), abs=1e-8)


def test_least_overlap_of_two_ellipsoids():
    """No direction of 4000, and none near the normal, has less overlap, up to a tenth of the smallest axis."""
    rng, axes = np.random.default_rng(3), np.array([0.3, 0.2, 0.12])
    pair = Pair(SHAPES["ellipsoid"][0], lambda b, i: b.add_ellipsoid(i, axes), 20)
    q = apart(rng, 20, 1.0, 1.2)
    for _ in range(2):
        _, normal, gap, _ = pair.look(q)
        q[:, 1, :3] -= normal * (0.012 + gap)[:, None]
    _, normal, gap, _ = pair.look(q)
    for env in range(20):
        n = rng.normal(size=(8000, 3))
        n[4000:] = normal[env] + 1e-3 * n[4000:]
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        a, b = (rotation_matrix(pose[3:]) for pose in q[env])
        separation = n @ q[env, 1, :3] - np.linalg.norm(n @ a * OTHER, axis=1) - np.linalg.norm(n @ b * axes, axis=1)
        assert separation.max() <= gap[env] + ROUND


def test_deep_inside_it_leaves_over_a_short_axis():
    """With centres in one place no direction is its own; it must be a finite one of little overlap, 10 % more than the least at most."""
    rng, axes = np.random.default_rng(4), np.array([0.3, 0.2, 0.12])
    for kind in ("box", "hull", "cylinder", "ellipsoid", "sphere"):
        add, support, _ = SHAPES[kind]
        q = apart(rng, 10, 0.0, 0.0)
        _, normal, gap, _ = Pair(add, lambda b, i: b.add_ellipsoid(i, axes), 10).look(q)
        n = rng.normal(size=(500, 3))
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        for env in range(10):
            a, b = (rotation_matrix(pose[3:]) for pose in q[env])
            least = min(x @ a @ support(a.T @ x) + np.linalg.norm(axes * (b.T @ x)) for x in n)
            assert np.linalg.norm(normal[env]) == pytest.approx(1.0)
            assert 0.0 < -gap[env] <= 1.1 * least


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule", "hull", "cylinder", "cone", "ellipsoid"])
def test_with_equal_axes_it_is_a_ball(kind):
    """Also where shapes move and turn: to round-off against closed forms, to what GJK leaves of the others, 1e-7 of the size."""
    rng, envs = np.random.default_rng(5), 60
    velocity = np.c_[rng.uniform(-2, 2, (envs, 3)), rng.uniform(-5, 5, (envs, 3))]
    add = (lambda b, i: b.add_ellipsoid(i, (0.15,) * 3)) if kind == "ellipsoid" else SHAPES[kind][0]
    like = SHAPES["sphere"][0] if kind == "ellipsoid" else add
    q = apart(rng, envs, 0.2, 0.7)
    egg = Pair(add, lambda b, i: b.add_ellipsoid(i, (0.2,) * 3), envs, velocity).look(q)
    ball = Pair(like, lambda b, i: b.add_sphere(i, 0.2), envs, velocity).look(q)
    exact = kind in ("sphere", "box", "capsule", "ellipsoid")
    sign = 1.0 if kind in ("sphere", "ellipsoid") else -1.0  # normals point to the higher type: an ellipsoid, but not a ball
    outside = ball[2] > -0.19  # with its centre inside a ball leaves by another rule
    seen = outside & (egg[2] < NO_POINT) & (ball[2] < NO_POINT)
    assert seen.sum() > 20
    for name, one, other in zip(NAMES, egg, ball, strict=True):
        scale = sign if name == "normal" else 1.0
        assert one[seen] == pytest.approx(scale * other[seen], abs=ROUND if exact else 1e-6), name


def spheroid(axes, tilt: float, ground: str = "plane", mu: float = 1.0, **body) -> wl.ModelBuilder:
    """An ellipsoid of 1000 kg/m^3, turned about y by `tilt`, that touches the ground, z = 0."""
    builder, material = wl.ModelBuilder(), wl.Material(mu, mu)
    corners = np.array([[x, y, z] for x in (-2.0, 2.0) for y in (-2.0, 2.0) for z in (-1.0, 0.0)])
    if ground == "plane":
        builder.add_plane(material=material)
    elif ground == "box":
        builder.add_box(-1, (2, 2, 0.5), pose=(0, 0, -0.5, 0, 0, 0, 1), material=material)
    elif ground == "hull":
        builder.add_hull(-1, corners, material=material)
    else:
        builder.add_mesh(-1, corners[1::2], [(0, 2, 3), (0, 3, 1)], material=material)
    height = np.hypot(axes[0] * np.sin(tilt), axes[2] * np.cos(tilt))
    index = builder.add_body("egg", pose=(0, 0, height, 0, np.sin(tilt / 2), 0, np.cos(tilt / 2)), **body)
    builder.add_ellipsoid(index, axes, material=material)
    return builder


def test_rocking_period():
    """A spheroid rolls about the pole on which it rests, where its radius of curvature is r = a^2 / c.

    Turned by w its centre is over the foot by c + (r - c) w^2 / 2, and it turns about the foot: (I + m c^2) w'' = -m g (r - c) w.
    The amplitude of 2 mrad adds 9e-6 of the period (100 times as much at ten times the amplitude). What else is missing falls with h^2,
    as poses are read between steps.
    """
    a, c, tilt, errors = 0.3, 0.15, 2e-3, []
    inertia = (a**2 + c**2) / 5.0  # per unit mass
    exact = 2.0 * np.pi * np.sqrt((inertia + c**2) / (GRAVITY * (a**2 / c - c))) * (1.0 + 9.2e-6)
    for h in (4e-3, 2e-3, 1e-3):
        q = simulator(spheroid((a, a, c), tilt), dt=h).rollout(round(4.0 / h), record=("q",)).q.numpy()[:, 0]
        angle = 2.0 * np.arcsin(q[:, 4])
        k = np.flatnonzero((angle[:-1] > 0.0) != (angle[1:] > 0.0))
        zeros = h * (k + angle[k] / (angle[k] - angle[k + 1]))
        errors.append(2.0 * np.diff(zeros).mean() / exact - 1.0)
        assert np.abs(angle[len(angle) // 2 :]).max() == pytest.approx(tilt, rel=1e-3)  # neither fed nor damped
    assert np.abs(errors).max() < 1e-4
    assert abs(errors[2]) < abs(errors[0]) / 8.0


def test_rolling_end_over_end():
    """Its energy keeps within what symplectic Euler leaves, of first order in h, and it does not hop: 0.1 mm in and 0.02 mm over."""
    axes, spin, gains = (0.2, 0.3, 0.15), 8.0, []
    for h in (4e-3, 2e-3):
        builder = spheroid(axes, 0.0, velocity=(spin * axes[2], 0, 0), angular_velocity=(0, spin, 0))
        model = builder.finalize()
        run = simulator(model, dt=h).rollout(round(2.0 / h), record=("q", "v", "status"))
        q, v = run.q.numpy()[:, 0], run.v.numpy()[:, 0]
        assert not run.status.numpy().any()
        kinetic = 0.5 * model.mass[0] * (v[:, :3] ** 2).sum(axis=1) + 0.5 * model.inertia[0, 1, 1] * v[:, 4] ** 2
        energy = kinetic + model.mass[0] * GRAVITY * q[:, 2]
        gains.append(energy.max() / energy[0] - 1.0)
        turn = 2.0 * np.arctan2(q[:, 4], q[:, 6])
        gap = q[:, 2] - np.hypot(axes[0] * np.sin(turn), axes[2] * np.cos(turn))
        assert gap.min() > -1e-4 * h / 4e-3
        assert gap.max() < 2e-5
        assert q[-1, 0] > 2.0  # it went over its ends
    assert gains[0] < 5e-3
    assert gains[1] < 0.6 * gains[0]


def test_rolls_down_a_slope_like_a_ball():
    """A prolate spheroid about its long axis: a = 5/7 g sin(slope), as 2/5 m b^2 is its inertia, whatever its length."""
    slope, b = 0.2, 0.1
    down = np.array([np.sin(slope), 0.0, -np.cos(slope)]) * GRAVITY
    builder, material = wl.ModelBuilder(gravity=down), wl.Material(0.8, 0.8)
    builder.add_plane(material=material)
    builder.add_ellipsoid(builder.add_body(pose=(0, 0, b, 0, 0, 0, 1)), (b, 0.4, b), material=material)
    sim = simulator(builder, dt=2e-3, integrator="midpoint")
    v = sim.rollout(500, record=("v",)).v.numpy()[-1, 0]
    x = sim.q.numpy()[0, 0]
    speed = 5.0 / 7.0 * GRAVITY * np.sin(slope)
    assert v[0] == pytest.approx(speed, rel=1e-5)  # bristles take up 1e-5 of it before it rolls
    assert v[[1, 3, 5]] == pytest.approx(np.zeros(3), abs=1e-9)
    assert x == pytest.approx(speed / 2.0, rel=1e-4)


@pytest.mark.parametrize("ground", ["plane", "box", "hull", "mesh"])
def test_rests_without_drift(ground):
    """Two seconds on its flat pole: nothing pushes it sideways, and it sinks by what Table 1's stiffness yields, m g / k = 1e-9 m."""
    sim = simulator(spheroid((0.3, 0.2, 0.1), 0.0, ground), dt=2e-3)
    status = sim.rollout(1000, record=("status",)).status.numpy()
    assert not status.any()
    assert sim.q.numpy()[0] == pytest.approx([0, 0, 0.1, 0, 0, 0, 1], abs=2e-8)
    assert sim.v.numpy()[0] == pytest.approx(np.zeros(6), abs=1e-7)


def test_seams_of_a_mesh_do_not_matter():
    """Rolling end over end over twenty triangles it moves as on a plane, to 1e-4 of the way: what touches at a seam counts once."""
    axes, spin, ends = (0.2, 0.3, 0.15), 6.0, []
    for ground in ("plane", "mesh"):
        builder = wl.ModelBuilder()
        if ground == "plane":
            builder.add_plane(material=wl.Material(1, 1))
        else:
            points = np.array([[x, y, 0.0] for x in np.linspace(-2, 3, 11) for y in (-2.0, 2.0)])
            triangles = [t for k in range(0, 20, 2) for t in ((k, k + 2, k + 3), (k, k + 3, k + 1))]
            builder.add_mesh(-1, points, triangles, material=wl.Material(1, 1))
        body = builder.add_body(pose=(0, 0, 0.15, 0, 0, 0, 1), velocity=(spin * 0.15, 0, 0), angular_velocity=(0, spin, 0))
        builder.add_ellipsoid(body, axes, material=wl.Material(1, 1))
        sim = simulator(builder, dt=2e-3)
        sim.step(1000)
        ends.append(sim.q.numpy()[0])
    assert ends[1] == pytest.approx(ends[0], abs=1e-4)


def test_a_heap_of_everything_comes_down():
    """Ellipsoids, coins and needles among other shapes that fall 6 m: every step is certified and nothing is left in anything.

    At 10 m/s and 2 ms what spins fast overlaps by 2.5 mm for a step or two, less than cylinders and boxes in the same heap do (17 mm).
    """
    builder = wl.ModelBuilder()
    builder.add_box(-1, (30, 30, 0.5), pose=(0, 0, -0.5, 0, 0, 0, 1))
    rng = np.random.default_rng(6)
    adds = [SHAPES[kind][0] for kind in ("sphere", "capsule", "box", "cylinder", "cone", "ellipsoid")]
    adds += [lambda b, i, s=s: b.add_ellipsoid(i, s) for s in ((0.3, 0.3, 0.1), (0.4, 0.1, 0.1), (0.2, 0.2, 0.2))]
    for k, add in enumerate(adds):
        where = (*rng.uniform(-0.2, 0.2, 2), 0.6 + 0.65 * k)
        add(builder, builder.add_body(pose=(*where, *random_quaternions(rng))))
    model = builder.finalize()
    sim = simulator(model, dt=2e-3)
    height = (model.mass * sim.q0.numpy()[0].reshape(-1, 7)[:, 2]).sum()
    worst, uncertified = 0.0, 0
    pair_of = np.repeat(np.arange(len(model.pairs)), np.diff(model.pair_slots))
    round_ones = (model.shape_type[model.pairs] == wl.ShapeType.ELLIPSOID).any(axis=1)[pair_of]
    for _ in range(40):
        run = sim.rollout(50, record=("status",))
        uncertified += np.count_nonzero(run.status.numpy() & int(wl.Status.UNCERTIFIED))
        worst = min(worst, sim.slots.gap.numpy()[0, round_ones].min())
    assert uncertified == 0
    assert worst > -4e-3
    assert sim.slots.gap.numpy().min() > -1e-4
    q = sim.q.numpy()[0].reshape(-1, 7)
    assert (model.mass * q[:, 2]).sum() < 0.5 * height
    assert (q[:, 2] > 0.05).all()


def test_single_precision_agrees():
    """Distances of half a metre to the six digits that are left."""
    rng, axes = np.random.default_rng(8), np.array([0.3, 0.2, 0.12])
    q = apart(rng, 20, 0.6, 0.8)
    for kind in ("box", "ellipsoid"):
        found = []
        for precision in ("float64", "float32"):
            sim = simulator(two(SHAPES[kind][0], lambda b, i: b.add_ellipsoid(i, axes)), 20, 0.1, precision=precision)
            sim.q.assign(q.reshape(20, -1))
            v = np.zeros((20, 2, 6))
            v[:, 0, 0] = 50.0
            sim.v.assign(v.reshape(20, -1))
            sim.step()
            found.append(sim.slots.gap.numpy()[:, 0])
        assert found[1] == pytest.approx(found[0], abs=5e-6)


def test_mass_and_bad_axes():
    builder = wl.ModelBuilder()
    body = builder.add_body()
    builder.add_ellipsoid(body, (0.1, 0.2, 0.3), density=500.0)
    model = builder.finalize()
    mass = 500.0 * 4.0 / 3.0 * np.pi * 0.006
    assert model.mass[0] == pytest.approx(mass)
    assert model.inertia[0] == pytest.approx(mass / 5.0 * np.diag([0.13, 0.10, 0.05]))
    with pytest.raises(wl.ModelError, match=r"ellipsoid: semi-axis is 0\.0 m"):
        builder.add_ellipsoid(body, (0.1, 0.0, 0.1))
    with pytest.raises(wl.ModelError, match="ellipsoid: semi-axis is nan m"):
        builder.add_ellipsoid(body, (0.1, float("nan"), 0.1))
    with pytest.raises(wl.ModelError, match="ellipsoid: semi_axes has 2 numbers; give 3"):
        builder.add_ellipsoid(body, (0.1, 0.2))
