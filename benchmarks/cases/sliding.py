# SPDX-License-Identifier: Apache-2.0
"""What slides: the paper's box, launched cubes, slopes, a box that carries balls, plates on many feet, a bar in a groove."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from ..motion import Motion
from ..scenes import GRAVITY, GROUND, WORLD, Scene, Shape, ball_inertia, box_inertia, boxes
from .case import Case, Metric, about_z, constant, creep, heading, lift, linear, moved_by, steps, tilted

BOX_DURATION = 0.8  # s; the continuous motion rests at 0.661 s


def at(*position: float, quaternion: np.ndarray | None = None) -> np.ndarray:
    """A pose [7]."""
    return np.r_[position, [0.0, 0.0, 0.0, 1.0] if quaternion is None else quaternion]


def one_box(
    name: str, half: tuple[float, float, float], mass: float, velocity: tuple[float, ...], mu: float, duration: float, h: float, **options
) -> Scene:
    """A box that lies on the ground, with this velocity [6]."""
    pose, start = at(0, 0, half[2])[None, None], np.array(velocity, dtype=float)[None, None]
    return boxes(name, [half], [mass], pose, start, mu, h, steps(duration, h), **options)


# --------------------------------------------------------------------------------------------------------- the paper's box


@cache
def box_reference() -> np.ndarray:
    """x, y [m], yaw [rad] at rest: benchmarks.paper's planar motion of four equally compliant corners."""
    from ..paper import reference

    return reference(np.array([10.0]))[0]


class Lazy:
    """A reference that is computed when it is first looked at."""

    def __init__(self, function, *columns: int):
        self.function, self.columns = function, list(columns)

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.asarray(self.function()[self.columns], dtype=dtype)


def end(moved: Motion, body: int = 0) -> np.ndarray:
    """Last x, y [m], [E, 2]."""
    return moved.pose[-1, :, body, :2]


def last_heading(moved: Motion) -> np.ndarray:
    """[E] rad."""
    return heading(moved)[-1]


NO_LIFT = Metric("lift", "m", lift, 0.0, constant(1e-6))


def law_bar(h: float) -> float:
    """In m, and in rad."""
    return 0.1 * h if h > 1e-3 else 5e-5


BOX = Case(
    "box",
    "the paper's box slides, turns and stops",
    partial(one_box, "box", (0.5, 0.5, 0.5), 1.0, (0, 5, 0, 0, 0, 2 * np.pi), 1.0, BOX_DURATION),
    (
        # Euler's position is off by h v / 2 and a little more, as the box turns; of the law's share notes on the paper ask for 1 mm
        # at 10 ms and 0.05 mm at 1 ms.
        Metric("rest position", "m", end, Lazy(box_reference, 0, 1), linear(3.0), law_bar),
        Metric("rest angle", "rad", last_heading, Lazy(box_reference, 2), linear(0.51 * 2 * np.pi), law_bar),
        NO_LIFT,
    ),
    "planar ODE of the box on four equally compliant corners, exact isotropic friction",
    fails="facets that stay fixed are 2 cm to 0.4 m off (square for cone); convex laws throw it 0.33 m up",
    charted=True,
    label="paper's box",
)

# ------------------------------------------------------------------------------------------------------------------ launched


def way(moved: Motion) -> np.ndarray:
    """Horizontal distance from start to end, [E]."""
    return np.linalg.norm((moved.pose[-1] - moved.pose[0])[:, 0, :2], axis=-1)


def tilt(moved: Motion) -> np.ndarray:
    """Largest inclination of the first body's z axis [rad], [E]."""
    x, y = moved.pose[:, :, 0, 3], moved.pose[:, :, 0, 4]
    return (2.0 * np.arcsin(np.minimum(np.hypot(x, y), 1.0))).max(axis=0)


LAUNCH = Case(
    "launch",
    "a cube of 1 m is launched at 5 m/s, mu = 0.8",
    partial(one_box, "launch", (0.5, 0.5, 0.5), 1.0, (5, 0, 0, 0, 0, 0), 0.8, 0.8),
    (
        Metric("stop distance", "m", way, 25.0 / (2 * 0.8 * GRAVITY), linear(0.51 * 5.0)),
        NO_LIFT,
        Metric("tilt", "rad", tilt, 0.0, constant(1e-6)),
    ),
    "v^2 / (2 mu g); Euler's position is off by h v / 2",
    fails="convex laws lift it by 0.3 m and tumble it",
)

HEADINGS = np.radians(6.0 * np.arange(16))
FAN_SPEED, FAN_MU = 6.0, 0.5


def fan(h: float) -> Scene:
    """Sixteen environments, one heading each."""
    start = np.zeros((16, 1, 6))
    start[:, 0, 0], start[:, 0, 1] = FAN_SPEED * np.cos(HEADINGS), FAN_SPEED * np.sin(HEADINGS)
    pose = np.tile(at(0, 0, 0.05), (16, 1, 1))
    return boxes("fan", np.full((1, 3), 0.05), [1.0], pose, start, FAN_MU, h, steps(1.4, h))


def anisotropy(moved: Motion) -> np.ndarray:
    """Longest over shortest way, less 1: the same for all, [E]."""
    ways = way(moved)
    return np.full(len(ways), ways.max() / ways.min() - 1.0)


def aside(moved: Motion) -> np.ndarray:
    """How far from the line of the launch it ends [m], [E]."""
    ends, velocity = end(moved), moved.velocity[0, :, 0, :2]
    return np.abs(ends[:, 0] * velocity[:, 1] - ends[:, 1] * velocity[:, 0]) / np.linalg.norm(velocity, axis=1)


FAN = Case(
    "fan",
    "a cube of 0.1 m is launched at 6 m/s in 16 headings, mu = 0.5",
    fan,
    (
        Metric("stop distance", "m", way, FAN_SPEED**2 / (2 * FAN_MU * GRAVITY), linear(0.51 * FAN_SPEED)),
        Metric("anisotropy", "-", anisotropy, 0.0, constant(1e-3)),
        Metric("sideways", "m", aside, 0.0, constant(1e-3)),
        NO_LIFT,
    ),
    "v^2 / (2 mu g) in every heading",
    fails="facets: AP with k = 2 stops 41 % too far, facets around the cone 29 % too early; convex laws lift it by 0.3 m",
    charted=True,
    label="launch fan",
)

# ---------------------------------------------------------------------------------------------------------------------- spin

SPIN = Case(
    "spin",
    "the paper's box spins on the spot at 2 pi rad/s, mu = 1",
    partial(one_box, "spin", (0.5, 0.5, 0.5), 1.0, (0, 0, 0, 0, 0, 2 * np.pi), 1.0, 0.3),
    (
        Metric("stop angle", "rad", last_heading, (2 * np.pi) ** 2 / (2 * GRAVITY * np.sqrt(0.5) * 6.0), linear(0.51 * 2 * np.pi)),
        NO_LIFT,
    ),
    "w^2 / (2 a), a = mu g r m / I at four equal contacts",
    fails="AP with axes at 45 degrees stops 41 % late",
)

# -------------------------------------------------------------------------------------------------------------------- slopes

SLOPE_MU, SLOPE_HEADING = 0.5, 30.0
FRICTION_ANGLE = float(np.degrees(np.arctan(SLOPE_MU)))
TURNS = np.radians([0.0, 15.0, 30.0, 45.0])


def slope(over: float, duration: float, h: float) -> Scene:
    """A block on a slope `over` degrees above the friction angle, falling 30 degrees from x, in four headings of the block."""
    pose = np.stack([at(0, 0, 0.1, quaternion=about_z(turn)) for turn in TURNS])[:, None]
    gravity = tilted(FRICTION_ANGLE + over, SLOPE_HEADING)
    return boxes("slope", [(0.1, 0.1, 0.1)], [8.0], pose, np.zeros((4, 1, 6)), SLOPE_MU, h, steps(duration, h), gravity=gravity)


INCLINE_STICK = Case(
    "incline_stick",
    "a block on a slope 0.1 degrees below the friction angle, 10 s",
    partial(slope, -0.1, 10.0),
    (Metric("moved", "m", moved_by, 0.0, constant(1e-6)), Metric("creep", "m/s", creep, 0.0, constant(1e-9))),
    "it rests",
    fails="convex and position-based laws creep; memory of the bristles lost",
    charted=True,
    label="incline, 0.1° under the friction angle",
)

SLIDE_OVER = np.radians(FRICTION_ANGLE + 0.1)
SLIDE_SPEED = 2.0 * GRAVITY * (np.sin(SLIDE_OVER) - SLOPE_MU * np.cos(SLIDE_OVER))
DOWN = np.array([np.cos(np.radians(SLOPE_HEADING)), np.sin(np.radians(SLOPE_HEADING))])


def last_velocity(moved: Motion) -> np.ndarray:
    """Of the first body, x and y [m/s], [E, 2]."""
    return moved.velocity[-1, :, 0, :2]


INCLINE_SLIDE = Case(
    "incline_slide",
    "a block on a slope 0.1 degrees above the friction angle, 2 s",
    partial(slope, 0.1, 2.0),
    # Relative 1e-6. Bristles of Table 1 need 1 ms to load, which shorter steps resolve: docs/accuracy.md.
    (Metric("velocity", "m/s", last_velocity, SLIDE_SPEED * DOWN, constant(1e-6 * SLIDE_SPEED)),),
    "g (sin - mu cos) t, downhill",
    fails="facets: it sticks or veers off",
)

# -------------------------------------------------------------------------------------------------------------- rolling test

PUSH, CARRIER, BALLS, BALL, ROLLING_MU = 150.0, 10.0, 25, 1.0, 0.4
ROLLING_A = (PUSH - ROLLING_MU * (CARRIER + BALLS * BALL) * GRAVITY) / (CARRIER + 2 / 7 * BALLS * BALL)
DIAGONAL = np.array([1.0, 1.0]) / np.sqrt(2.0)


def rolling_test(h: float) -> Scene:
    """A plate of 2 x 2 x 0.2 m that carries 5 x 5 balls of 0.2 m."""
    grid = 0.4 * (np.arange(5) - 2)
    half, radius = np.array([1.0, 1.0, 0.1]), 0.1
    spots = [at(x, y, 2 * half[2] + radius) for x in grid for y in grid]
    shapes = (GROUND, Shape("box", 0, tuple(half.tolist())), *(Shape("sphere", i + 1, (radius, 0.0, 0.0)) for i in range(BALLS)))
    mass = np.r_[CARRIER, np.full(BALLS, BALL)]
    inertia = np.vstack([box_inertia(half[None], mass[:1]), ball_inertia(np.full(BALLS, radius), mass[1:])])
    wrench = np.zeros((BALLS + 1, 6))
    wrench[0, :2] = PUSH * DIAGONAL
    pose = np.stack([at(0, 0, half[2]), *spots])[None]
    velocity = np.zeros((1, BALLS + 1, 6))
    return Scene("rolling", h, steps(1.0, h), ROLLING_MU, shapes, mass, inertia, pose, velocity, wrench=wrench)


def all_velocities(moved: Motion) -> np.ndarray:
    """Of every body after 1 s, x and y [m/s], [E, 2 B]."""
    return moved.velocity[-1, :, :, :2].reshape(moved.scene.envs, -1)


ROLLING_TEST = Case(
    "rolling",
    "a plate with 25 balls on it is pushed diagonally (SimBenchmark's rolling test)",
    rolling_test,
    (
        Metric(
            "velocity",
            "m/s",
            all_velocities,
            np.concatenate([ROLLING_A * DIAGONAL, *(BALLS * [2 / 7 * ROLLING_A * DIAGONAL])]),
            constant(1e-3 * ROLLING_A),
        ),
    ),
    "a = (F - mu (M + n m) g) / (M + 2/7 n m), 2/7 a of every ball",
    fails="square friction limits hold it, convex laws jitter",
    charted=True,
    label="rolling test (26 bodies)",
)

# ------------------------------------------------------------------------------------------------------------------ redundant


def plate(number: int, h: float) -> Scene:
    """A plate of 20 kg on number x number spherical feet, pushed off along x at 2 m/s; its corners are the same for all."""
    mass, radius, height = np.array([20.0]), 0.03, 0.1
    spots = np.linspace(-0.4, 0.4, number)
    feet = tuple(Shape("sphere", 0, (radius, 0.0, 0.0), (x, y, radius - height, 0, 0, 0, 1)) for x in spots for y in spots)
    pose, velocity = at(0, 0, height)[None, None], np.array([2.0, 0, 0, 0, 0, 0])[None, None]
    inertia = box_inertia(np.array([[0.5, 0.5, 0.02]]), mass)
    return Scene("plate", h, steps(0.6, h), 0.5, (GROUND, *feet), mass, inertia, pose, velocity)


REDUNDANT = tuple(
    Case(
        f"feet{number * number}",
        f"a plate slides on {number * number} feet",
        partial(plate, number),
        (
            Metric("stop distance", "m", way, 4.0 / (2 * 0.5 * GRAVITY), linear(0.51 * 2.0)),
            Metric("turn", "rad", last_heading, 0.0, constant(1e-6)),
            NO_LIFT,
        ),
        "v^2 / (2 mu g), whatever the number of contacts",
        fails="redundant contacts: pivoting on singular blocks, warm-started Gauss-Seidel drifts",
    )
    for number in (2, 3, 4, 8)
)

# -------------------------------------------------------------------------------------------------------------------- groove

GROOVE_MU, GROOVE_SLOPE = 0.3, 35.0
GROOVE_A = GRAVITY * (np.sin(np.radians(GROOVE_SLOPE)) - GROOVE_MU * np.sqrt(2.0) * np.cos(np.radians(GROOVE_SLOPE)))


def groove(h: float) -> Scene:
    """A square bar with an edge down in a groove of 90 degrees along x, which falls by 35 degrees."""
    half, wall = 0.1, 0.05
    quarter = np.pi / 4
    edge = np.r_[np.sin(quarter / 2), 0.0, 0.0, np.cos(quarter / 2)]  # 45 degrees about x
    # Two slabs meet in the line z = 0 and rise at 45 degrees to either side.
    low = np.sqrt(0.5)
    slabs = tuple(
        Shape("box", WORLD, (10.0, 1.0, wall), (0.0, side * (1.0 + wall) * low, (1.0 - wall) * low, side * edge[0], 0.0, 0.0, edge[3]))
        for side in (1.0, -1.0)
    )
    pose = at(0, 0, half * np.sqrt(2.0), quaternion=edge)[None, None]
    return boxes(
        "groove",
        [(0.3, half, half)],
        [10.0],
        pose,
        np.zeros((1, 1, 6)),
        GROOVE_MU,
        h,
        steps(1.0, h),
        statics=slabs,
        gravity=tilted(GROOVE_SLOPE),
    )


GROOVE = Case(
    "groove",
    "a bar slides down a groove of 90 degrees: its wedging makes friction sqrt(2) times as large",
    groove,
    # 1 %: until a contact is seen to slide it has facets, and the walls' predicted slips point into the groove as well.
    (Metric("velocity", "m/s", last_velocity, np.array([GROOVE_A, 0.0]), constant(1e-2 * GROOVE_A)),),
    "g (sin - mu cos / sin 45 degrees) t",
    fails="normal forces depend on each other through friction: frozen or decoupled limits",
)

CASES = (BOX, LAUNCH, FAN, SPIN, INCLINE_STICK, INCLINE_SLIDE, ROLLING_TEST, *REDUNDANT, GROOVE)
