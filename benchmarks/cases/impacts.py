# SPDX-License-Identifier: Apache-2.0
"""What hits, flies or jams: a bouncing ball, Newton's cradle, a flipping body, a rocking block, thin plates, a Painleve rod, a heap."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from .. import motion
from ..motion import Motion, rotate
from ..scenes import GRAVITY, GROUND, WORLD, Scene, Shape, ball_inertia, box_inertia, boxes
from .case import Case, Metric, about_y, constant, linear, steps
from .sliding import Lazy, at

# ------------------------------------------------------------------------------------------------------------------ bouncing

HEIGHT, BOUNCE, RADIUS = 1.0, 0.8, 0.1
FALL = np.sqrt(2 * HEIGHT / GRAVITY)


def bouncing(h: float) -> Scene:
    """A ball falls by 1 m."""
    mass = np.ones(1)
    shapes = (GROUND, Shape("sphere", 0, (RADIUS, 0.0, 0.0)))
    pose, rest = at(0, 0, RADIUS + HEIGHT)[None, None], np.zeros((1, 1, 6))
    return Scene("bouncing", h, steps(5.0, h), 0.0, shapes, mass, ball_inertia([RADIUS], mass), pose, rest, restitution=BOUNCE)


def peaks(moved: Motion) -> np.ndarray:
    """Height that the energy after the first three impacts would reach [m], [E, 3]: midway between impacts, by the closed form's times."""
    times = FALL * np.array([1 + 2 * sum(BOUNCE**j for j in range(1, k)) + BOUNCE**k for k in (1, 2, 3)])
    index = np.argmin(np.abs(moved.time[:, None] - times), axis=0)
    height, speed = moved.pose[index, :, 0, 2] - RADIUS, moved.velocity[index, :, 0, 2]
    return (height + speed**2 / (2 * GRAVITY)).T


def at_end(moved: Motion) -> np.ndarray:
    """Height above the ground at the end [m], [E]."""
    return moved.pose[-1, :, 0, 2] - RADIUS


BOUNCING = Case(
    "bouncing",
    "a ball falls by 1 m and bounces with e = 0.8 until it rests",
    bouncing,
    (
        # A step more or less of falling, g h on 4.4 m/s at each impact, and Euler's own height h v / 2.
        Metric("peak", "m", peaks, HEIGHT * BOUNCE ** (2 * np.arange(1, 4)), linear(4.0)),
        Metric("rest height", "m", at_end, 0.0, constant(1e-6)),
    ),
    "e^2k H; at rest from 4.064 s on",
    fails="a velocity threshold ends it early, damping in the contact takes energy",
)

# -------------------------------------------------------------------------------------------------------------------- cradle


def cradle(number: int, gap: float, h: float) -> Scene:
    """Balls in a row without weight or friction, the first one thrown at 1 m/s; e = 1."""
    mass = np.ones(number)
    shapes = tuple(Shape("sphere", i, (RADIUS, 0.0, 0.0)) for i in range(number))
    pose = np.stack([at((2 * RADIUS + gap) * i, 0, 0) for i in range(number)])[None]
    velocity = np.zeros((1, number, 6))
    velocity[0, 0, 0] = 1.0
    inertia = ball_inertia(np.full(number, RADIUS), mass)
    return Scene("cradle", h, steps(0.5, h), 0.0, shapes, mass, inertia, pose, velocity, gravity=(0, 0, 0), restitution=1.0)


def along_x(moved: Motion) -> np.ndarray:
    """Final velocities [m/s], [E, B]."""
    return moved.velocity[-1, :, :, 0]


def simultaneous(number: int) -> np.ndarray:
    """Velocities where Newton's law holds at all contacts at once: the first flies back, the others share what that takes."""
    # u+ >= -e u-, p >= 0: only the first contact approaches, so all separate or stay together with the impulses of W p = 2 u.
    jacobian = np.diff(np.eye(number), axis=0)
    before = np.eye(number)[0]
    open_contacts: list[int] = []
    while True:
        closed = [i for i in range(number - 1) if i not in open_contacts]
        rows = jacobian[closed]
        impulse = np.linalg.solve(rows @ rows.T, -2.0 * rows @ before)
        if (impulse >= 0.0).all():
            return before + rows.T @ impulse
        open_contacts += [closed[i] for i in np.flatnonzero(impulse < 0.0)]


def give(h: float) -> float:
    """What Table 1's relaxation takes of the impulses of both contacts of a ball, up to 2 N s each, in a step [m/s]."""
    return 4.0 / (1e8 * h + 1e10 * h * h)


CRADLES = tuple(
    Case(
        f"cradle{number}_{'gaps' if gap else 'touching'}",
        f"one ball hits a row of {number - 1}, {'apart by 5 cm' if gap else 'touching'}; e = 1",
        partial(cradle, number, gap),
        (Metric("velocity", "m/s", along_x, np.eye(number)[-1] if gap else simultaneous(number), give),),
        "one impact after the other: the last one takes it all" if gap else "Newton's law at all contacts at once",
        fails="" if gap else "nothing: sequential and simultaneous impacts are different laws; ours is the simultaneous one",
    )
    for number in (3, 5)
    for gap in (0.0, 0.05)
)

# ---------------------------------------------------------------------------------------------------------------------- flip

FLIP_INERTIA, FLIP_SPIN, FLIP_TIME = np.array([0.1, 0.2, 0.3]), np.array([1e-3, 5.0, 0.0]), 10.0


@cache
def flip_reference() -> np.ndarray:
    """Angular velocity in body axes [rad/s] after FLIP_TIME: Euler's equations."""
    from scipy.integrate import solve_ivp

    def rate(_: float, w: np.ndarray) -> np.ndarray:
        return np.cross(FLIP_INERTIA * w, w) / FLIP_INERTIA

    return solve_ivp(rate, (0.0, FLIP_TIME), FLIP_SPIN, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


def flip(h: float) -> Scene:
    """A free body without weight spins about its middle axis, not quite."""
    pose, velocity = at(0, 0, 0)[None, None], np.r_[0, 0, 0, FLIP_SPIN][None, None]
    return Scene("flip", h, steps(FLIP_TIME, h), 0.0, (), np.ones(1), FLIP_INERTIA[None], pose, velocity, gravity=(0, 0, 0))


def body_spin(moved: Motion) -> np.ndarray:
    """Final angular velocity in body axes [rad/s], [E, 3]."""
    return rotate(moved.pose[-1, :, 0, 3:] * [-1, -1, -1, 1], moved.velocity[-1, :, 0, 3:])


def momentum(moved: Motion) -> np.ndarray:
    """Largest change of the angular momentum over its size, [E]."""
    turn = moved.pose[:, :, 0, 3:]
    spin = rotate(turn * [-1, -1, -1, 1], moved.velocity[:, :, 0, 3:])
    now = rotate(turn, moved.scene.inertia[0] * spin)
    return np.linalg.norm(now - now[0], axis=-1).max(axis=0) / np.linalg.norm(now[0], axis=-1)


FLIP = Case(
    "flip",
    "a free body flips about its middle axis (Dzhanibekov), 10 s",
    flip,
    (
        Metric("angular velocity", "rad/s", body_spin, Lazy(flip_reference, 0, 1, 2), linear(1.0)),
        Metric("angular momentum", "-", momentum, 0.0, linear(2.5)),  # half the turn of a step
    ),
    "Euler's equations, DOP853 at 1e-13",
    fails="explicit gyroscopic terms make energy",
)

# ------------------------------------------------------------------------------------------------------------------- rocking

ROCK_B, ROCK_H, ROCK_DEPTH = 0.1, 0.4, 0.3  # half width, half height, half depth [m]
ALPHA = np.arctan2(ROCK_B, ROCK_H)
HOUSNER = 1.0 - 1.5 * np.sin(ALPHA) ** 2
ROCK_LEAN = 0.5 * ALPHA


def rocking(h: float) -> Scene:
    """A block stands on an edge, leaning, and falls back to its base and on to the other edge."""
    turn = about_y(ROCK_LEAN)  # on its edge at +x
    corner = np.array([ROCK_B, 0.0, -ROCK_H])
    place = np.array([ROCK_B, 0.0, 0.0]) - rotate(turn, corner)
    pose = at(*place, quaternion=turn)[None, None]
    return boxes("rocking", [(ROCK_B, ROCK_DEPTH, ROCK_H)], [1.0], pose, np.zeros((1, 1, 6)), 2.0, h, steps(1.2, h))


def rocking_ratio(moved: Motion) -> np.ndarray:
    """Speed after the first change of edge over that before it, [E]: by how high the block leans on either edge. 1 if it never changes."""
    rise = moved.pose[:, :, 0, 2] - ROCK_H
    leaning = moved.pose[:, :, 0, 4]  # sine of half the inclination: changes its sign with the edge
    over = np.logical_or.accumulate(leaning < 0.0, axis=0)
    second = np.max(np.where(over, rise, 0.0), axis=0)
    return np.where(over.any(axis=0), np.sqrt(np.maximum(second, 0.0) / rise[0]), 1.0)


ROCKING = Case(
    "rocking",
    "a slender block rocks from one edge to the other",
    rocking,
    # Of first order; the factor is as seen (an impact is spread over two steps). At most 3/4 of what tells Housner's ratio from no loss.
    (Metric("ratio of speeds", "-", rocking_ratio, HOUSNER, lambda h: min(12.0 * h, 0.75 * (1.0 - HOUSNER))),),
    "Housner: 1 - 1.5 sin^2 a in one inelastic change of edge",
    fails="soft contacts bounce; the edge slips",
)

# --------------------------------------------------------------------------------------------------------------- thin plates

SPEED, SHEET = 10.0, 0.5e-3  # m/s; half thickness [m]


def thin_plate(h: float) -> Scene:
    """Plates of 1 mm fall flat and tilted on a fixed plate of 1 mm, at 10 m/s, which is 10 cm a step at 10 ms."""
    static = Shape("box", WORLD, (0.5, 0.5, SHEET), (0, 0, -SHEET, 0, 0, 0, 1))
    tilts = np.radians([0.0, 1.0, 10.0, 45.0])
    heights = 0.1 * np.sin(tilts) + SHEET * np.cos(tilts) + 0.237
    pose = np.stack([at(0, 0, z, quaternion=about_y(angle)) for z, angle in zip(heights, tilts, strict=True)])[:, None]
    velocity = np.tile([0, 0, -SPEED, 0, 0, 0], (4, 1, 1)).astype(float)
    return boxes("thin_plate", [(0.1, 0.1, SHEET)], [0.1], pose, velocity, 0.5, h, steps(1.0, h), statics=(static,))


def height(moved: Motion) -> np.ndarray:
    """Of the centre at the end [m], [E]."""
    return moved.pose[-1, :, 0, 2]


THIN_PLATE = Case(
    "thin_plate",
    "plates of 1 mm hit a fixed one of 1 mm at 10 m/s, flat and tilted",
    thin_plate,
    (Metric("height", "m", height, SHEET, constant(1e-6)),),
    "they lie on it: half a thickness over its top",
    fails="contacts found only where bodies overlap already",
)

# ------------------------------------------------------------------------------------------------------------------ Painleve

ROD, ROD_RADIUS = 0.5, 0.01  # half length, radius [m]
ROD_ANGLE = np.arctan(2.0)  # from the ground
ROD_SPEED = 8.0  # m/s
ROD_INERTIA = np.array([[4 / 12, 4 / 12, 1e-3]])  # kg m^2, a uniform rod of 1 kg and 4 ROD^2 / 12


def rod(mu: float, duration: float, h: float) -> Scene:
    """A thin rod slides on its lower end, which leads."""
    inertia = ROD_INERTIA * [[ROD**2, ROD**2, 1.0]]
    turn = about_y(np.pi / 2 - ROD_ANGLE)  # its lower end at -x, where it goes
    place = (0.0, 0.0, ROD * np.sin(ROD_ANGLE) + ROD_RADIUS)
    pose = at(*place, quaternion=turn)[None, None]
    velocity = np.array([-ROD_SPEED, 0, 0, 0, 0, 0])[None, None]
    shapes = (GROUND, Shape("capsule", 0, (ROD_RADIUS, ROD, 0.0)))
    return Scene("rod", h, steps(duration, h), mu, shapes, np.ones(1), inertia, pose, velocity)


ROD_MU, ROD_TIME = 1.0, 0.1  # s, before it stops sliding


@cache
def rod_reference() -> np.ndarray:
    """x, z [m] of the centre and inclination [rad] after ROD_TIME while the end slides (mu = 1: no paradox)."""
    from scipy.integrate import solve_ivp

    inertia = ROD_INERTIA[0, 1] * ROD**2

    def rate(_: float, s: np.ndarray) -> np.ndarray:
        _, angle, vx, vz, w = s[0], s[2], s[3], s[4], s[5]
        # The lower end, ROD behind the centre along the rod and ROD_RADIUS below that: arm of the contact.
        arm = np.array([-ROD * np.cos(angle), -ROD * np.sin(angle) - ROD_RADIUS])
        slip = vx - w * arm[1]
        direction = -np.sign(slip)
        # z of the end's centre is constant: vz + w d/dangle(-ROD sin(angle)) = 0; w counts from x towards z.
        lever = -ROD * np.cos(angle)
        # az + wdot lever + w^2 ROD sin(angle) = 0, az = N - g, wdot = (arm_x N - arm_z mu N direction) / I
        turn = (arm[0] - arm[1] * ROD_MU * direction) / inertia
        normal = (GRAVITY - w * w * ROD * np.sin(angle)) / (1.0 + turn * lever)
        return np.array([vx, vz, w, ROD_MU * normal * direction, normal - GRAVITY, turn * normal])

    start = [0.0, ROD * np.sin(ROD_ANGLE) + ROD_RADIUS, ROD_ANGLE, -ROD_SPEED, 0.0, 0.0]
    return solve_ivp(rate, (0.0, ROD_TIME), start, "DOP853", rtol=1e-12, atol=1e-12).y[:3, -1]


def rod_state(moved: Motion) -> np.ndarray:
    """x, z of the centre [m], inclination [rad], [E, 3]."""
    axis = rotate(moved.pose[-1, :, 0, 3:], np.array([0.0, 0.0, 1.0]))
    return np.column_stack([moved.pose[-1, :, 0, 0], moved.pose[-1, :, 0, 2], np.arctan2(axis[:, 2], axis[:, 0])])


ROD_SLIDES = Case(
    "rod",
    "a rod slides on its end, mu = 1",
    partial(rod, ROD_MU, ROD_TIME),
    # Euler's positions are off by half a step of what velocities change by: 7.3 rad/s.
    (Metric("position", "m, rad", rod_state, Lazy(rod_reference, 0, 1, 2), linear(4.0)),),
    "ODE of the sliding rod, DOP853 at 1e-12",
)


def below(moved: Motion) -> np.ndarray:
    """How far the lower end is below the ground, largest over time [m], [E]."""
    axis = rotate(moved.pose[:, :, 0, 3:], np.array([0.0, 0.0, 1.0]))
    low = moved.pose[:, :, 0, 2] - ROD * np.abs(axis[..., 2]) - ROD_RADIUS
    return np.maximum(0.0, -low.min(axis=0))


PAINLEVE = tuple(
    Case(
        f"painleve{mu:g}",
        f"a rod slides on its leading end with mu = {mu:g}: past 4/3 no acceleration solves it",
        partial(rod, mu, 1.0),
        (Metric("overlap", "m", below, 0.0, constant(1e-4)),),
        "an impulse solves it; nothing sinks in, no energy is made",
        fails="methods on accelerations; Gauss-Seidel diverges",
    )
    for mu in (1.4, 2.0)
)

# ---------------------------------------------------------------------------------------------------------------------- heap


def heap(h: float) -> Scene:
    """Twelve bodies, four each of boxes, balls and capsules, fall on one another in eight environments."""
    rng = np.random.default_rng(7)
    envs, number, size = 8, 12, 0.1
    shapes, mass, inertia = [GROUND], np.full(number, 8.0), np.zeros((number, 3))
    for i in range(number):
        kind = ("box", "sphere", "capsule")[i % 3]
        shapes.append(Shape(kind, i, {"box": (size,) * 3, "sphere": (size, 0.0, 0.0), "capsule": (size / 2, size, 0.0)}[kind]))
        inertia[i] = box_inertia(np.full((1, 3), size), mass[:1])[0] if kind != "sphere" else ball_inertia([size], mass[:1])[0]
    pose, velocity = np.zeros((envs, number, 7)), 0.5 * rng.normal(size=(envs, number, 6))
    turn = rng.normal(size=(envs, number, 4))
    pose[..., :2] = rng.uniform(-0.08, 0.08, (envs, number, 2))
    pose[..., 2] = 0.2 + 0.36 * np.arange(number)
    pose[..., 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    return Scene("heap", h, steps(1.5, h), 0.5, tuple(shapes), mass, inertia, pose, velocity)


def overlap(moved: Motion) -> np.ndarray:
    """Deepest overlap of the last sample [m], the same for all, [E]."""
    return np.full(moved.scene.envs, motion.penetration(moved.scene, moved.pose[-1]))


def sunk_at_all(moved: Motion) -> np.ndarray:
    """Deepest overlap of any sample [m], the same for all, [E]."""
    return np.full(moved.scene.envs, motion.penetration(moved.scene, moved.pose))


HEAP = Case(
    "heap",
    "twelve boxes, balls and capsules fall on one another, 1.5 s",
    heap,
    (
        # A quarter of what the highest, falling at 8 m/s, moves in a step; a tenth of their size at most.
        Metric("overlap", "m", sunk_at_all, 0.0, lambda h: min(2.0 * h, 0.02)),
        Metric("overlap at the end", "m", overlap, 0.0, linear(0.2, 1e-5)),
    ),
    "rigid bodies do not overlap, and energy only falls; where they end is chance",
    fails="soft contacts and few iterations let them sink into one another",
    charted=True,
    label="pile of 12",
    timed_from=0.8,  # before that most of them are in the air
)

CASES = (BOUNCING, *CRADLES, FLIP, ROCKING, THIN_PLATE, ROD_SLIDES, *PAINLEVE, HEAP)
