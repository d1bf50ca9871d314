# SPDX-License-Identifier: Apache-2.0
"""What should stay where it is: heavy on light, towers, a cube pressed to a wall, cards, an arch; what should fall and does not always."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from ..motion import Motion
from ..scenes import GRAVITY, GROUND, WORLD, Scene, Shape, box_inertia, boxes
from .case import Case, Metric, about_y, constant, creep, moved_by, steps
from .sliding import at


def tower(name: str, number: int, mass: list[float], half: float, duration: float, h: float) -> Scene:
    """Cubes on one another."""
    pose = np.stack([at(0, 0, half * (2 * i + 1)) for i in range(number)])[None]
    return boxes(name, np.full((number, 3), half), mass, pose, np.zeros((1, number, 6)), 0.5, h, steps(duration, h))


def sunk(moved: Motion) -> np.ndarray:
    """How far the highest body ends from its start [m], [E]."""
    return np.linalg.norm((moved.pose[-1] - moved.pose[0])[:, -1, :3], axis=-1)


HALF, LIGHT = 0.1, 8.0


def heavy(ratio: float, charted: bool = False) -> Case:
    """A light cube that carries a heavy one."""
    # Table 1's compliance of the light cube's four corners under (ratio, ratio + 1) weights is part of the model.
    compliance = (2 * ratio + 1) * GRAVITY / (4 * 1e10)
    return Case(
        f"heavy{ratio:.0e}".replace("e+0", "e"),
        f"a cube of 8 kg carries one {ratio:g} times as heavy, 2 s",
        partial(tower, "heavy", 2, [LIGHT, LIGHT * ratio], HALF, 2.0),
        (Metric("sunk", "m", sunk, 0.0, constant(max(2e-5, 1.1 * compliance))),),
        "it rests; the bar is 0.02 mm, or what Table 1's springs give where that is more",
        fails="sweeps needed grow as 10 times the ratio: iterative methods let it sink through",
        charted=charted,
        label=f"heavy on light, {ratio:g} : 1",
    )


HEAVY = tuple(heavy(10.0**i, charted=i == 3) for i in range(7))


def tower_case(number: int, charted: bool) -> Case:
    """Equal cubes."""
    return Case(
        f"stack{number}",
        f"a tower of {number} cubes rests for 10 s",
        partial(tower, "stack", number, [LIGHT] * number, HALF, 10.0),
        (
            Metric("moved", "m", moved_by, 0.0, constant(1e-6)),
            Metric("creep", "m/s", creep, 0.0, constant(1e-9)),
        ),
        "it rests",
        fails="Gauss-Seidel: errors wander up and down the tower",
        charted=charted,
        label=f"stack of {number}",
    )


STACK, TOWER = tower_case(10, True), tower_case(20, False)

# --------------------------------------------------------------------------------------------------------------------- press

PRESS_MU, PRESS_MASS = 0.5, 1.0  # at mu = 1 a cube that slides would be about to tip
LEAST = PRESS_MASS * GRAVITY / PRESS_MU  # N


def press(share: float, duration: float, h: float) -> Scene:
    """A cube of 0.1 m pressed against a wall with `share` times the least force that holds it."""
    wall = Shape("box", WORLD, (0.1, 0.5, 0.5), (-0.15, 0, 0, 0, 0, 0, 1))
    wrench = np.array([[-share * LEAST, 0, 0, 0, 0, 0]])
    pose, rest = at(0, 0, 0)[None, None], np.zeros((1, 1, 6))
    return boxes("press", [(0.05, 0.05, 0.05)], [PRESS_MASS], pose, rest, PRESS_MU, h, steps(duration, h), statics=(wall,), wrench=wrench)


PRESS_HOLD = Case(
    "press_hold",
    "a cube of 1 kg is pressed to a wall with 1.05 times the least force, 3 s",
    partial(press, 1.05, 3.0),
    (Metric("creep", "m/s", creep, 0.0, constant(1e-9)), Metric("moved", "m", moved_by, 0.0, constant(1e-6))),
    "it is held from m g / mu on",
    fails="soft contacts creep",
)
PRESS_DROP = Case(
    "press_drop",
    "the same with 0.95 times the least force, 0.2 s",
    partial(press, 0.95, 0.2),
    (Metric("velocity", "m/s", lambda moved: moved.velocity[-1, :, 0, 2], -0.2 * (GRAVITY - PRESS_MU * 0.95 * LEAST), constant(1e-6)),),
    "it falls with g - mu N / m",
    fails="facets around the cone hold it",
)

# --------------------------------------------------------------------------------------------------------------------- cards

LENGTH, THICK, WIDE, LEAN = 0.5, 0.01, 0.3, np.radians(15.0)  # half length, half thickness, half width [m]; lean from upright
#: Least friction at the floor, THICK below the lower ball: moments about that ball, the tops pushing 2 LENGTH cos(LEAN) above it.
CARD_MU = LENGTH * np.sin(LEAN) / (2 * LENGTH * np.cos(LEAN) + THICK)


def card(side: float, x: float = 0.0, floor: float = 0.0) -> np.ndarray:
    """Pose of a card that leans by LEAN towards x from the given side, its upper inner edge over x, its lower inner one on the floor."""
    along, across = np.array([-np.sin(LEAN), np.cos(LEAN)]), np.array([np.cos(LEAN), np.sin(LEAN)])
    top = 2 * LENGTH * np.cos(LEAN)
    centre = np.array([0.0, top]) - LENGTH * along + THICK * across  # the inner upper corner is at (0, top)
    return at(x + side * centre[0], 0.0, floor + centre[1], quaternion=about_y(-side * LEAN))


def frame(mu: float, duration: float, h: float) -> Scene:
    """Two cards lean on each other, with balls for corners: two edges would leave open which way they push."""
    corners = [(y, z) for y in (-WIDE, WIDE) for z in (-LENGTH, LENGTH)]
    balls = tuple(Shape("sphere", body, (THICK, 0.0, 0.0), (0.0, y, z, 0, 0, 0, 1)) for body in (0, 1) for y, z in corners)
    mass = np.ones(2)
    inertia = box_inertia(np.full((2, 3), (THICK, WIDE, LENGTH)), mass)
    x, z = THICK + LENGTH * np.sin(LEAN), THICK + LENGTH * np.cos(LEAN)
    pose = np.stack([at(side * x, 0, z, quaternion=about_y(-side * LEAN)) for side in (1.0, -1.0)])[None]
    return Scene("frame", h, steps(duration, h), mu, (GROUND, *balls), mass, inertia, pose, np.zeros((1, 2, 6)))


def fallen(moved: Motion) -> np.ndarray:
    """1 where the first body has come down by a tenth of the cards' height, [E]."""
    drop = moved.pose[0, :, 0, 2] - moved.pose[-1, :, 0, 2]
    return (drop > 0.1 * LENGTH).astype(float)


FRAME_STANDS = Case(
    "cards_stand",
    "two cards lean on each other with 1.02 times the least friction, 3 s",
    partial(frame, 1.02 * CARD_MU, 3.0),
    (Metric("moved", "m", moved_by, 0.0, constant(1e-5)), Metric("creep", "m/s", creep, 0.0, constant(1e-9))),
    "they stand from l sin a / (2 l cos a + r) on (lean a, half length l, balls of radius r for corners)",
    fails="residual creep of Gauss-Seidel, facets shift the threshold",
)
FRAME_FALLS = Case(
    "cards_fall",
    "the same with 0.98 times the least friction",
    partial(frame, 0.98 * CARD_MU, 3.0),
    (Metric("fallen", "-", fallen, 1.0, constant(0.0)),),
    "they fall below it",
    fails="facets around the cone hold them",
)


def house(h: float) -> Scene:
    """Two frames side by side, a roof over them, and a frame on the roof."""
    top, apart = 2 * LENGTH * np.cos(LEAN), 4 * LENGTH * np.sin(LEAN) + 0.1
    lower = [card(side, x) for x in (-apart / 2, apart / 2) for side in (1.0, -1.0)]
    summit = top + 2 * THICK * np.sin(LEAN)  # the outer upper edges are the highest
    roof = at(0, 0, summit + THICK)
    upper = [card(side, 0.0, summit + 2 * THICK) for side in (1.0, -1.0)]
    half = np.array([(THICK, WIDE, LENGTH)] * 4 + [(apart, WIDE, THICK)] + [(THICK, WIDE, LENGTH)] * 2)
    pose = np.stack([*lower, roof, *upper])[None]
    return boxes("house", half, [1.0] * 7, pose, np.zeros((1, 7, 6)), 0.6, h, steps(3.0, h))


HOUSE = Case(
    "card_house",
    "seven cards: two frames, a roof, a frame on it; mu = 0.6, 3 s",
    house,
    (Metric("moved", "m", moved_by, 0.0, constant(1e-3)), Metric("creep", "m/s", creep, 0.0, constant(1e-6))),
    "it stands",
    fails="residual creep",
)

# ---------------------------------------------------------------------------------------------------------------------- arch

VOUSSOIRS, RADIUS, ARCH_MU, DEPTH, PLATE = 15, 1.0, 0.7, 0.1, 0.01  # of the middle line, friction, half depth, half thickness of faces [m]


def ring(thickness: float) -> tuple[float, float]:
    """Radius of a voussoir's centroid [m], and its second moment about that for 1 kg [m^2]."""
    inner, outer, half = RADIUS - thickness / 2, RADIUS + thickness / 2, np.pi / (2 * VOUSSOIRS)
    centroid = 2 / 3 * (outer**3 - inner**3) / (outer**2 - inner**2) * np.sin(half) / half
    return float(centroid), float((outer**2 + inner**2) / 2 - centroid**2)


def thrust_fits(thickness: float) -> bool:
    """Are there forces at the inner and outer ends of all joints that carry a semicircular arch? A linear programme."""
    from scipy.optimize import linprog

    number, (centroid, _) = VOUSSOIRS, ring(thickness)
    angles = np.pi * np.arange(number + 1) / number
    balance = np.zeros((3 * number, 3 * (number + 1)))  # of each voussoir along x, along z, of moments; forces (inner, outer, friction)
    weight = np.zeros(3 * number)
    for k in range(number):
        middle = (angles[k] + angles[k + 1]) / 2
        centre = centroid * np.array([np.cos(middle), np.sin(middle)])
        weight[3 * k + 1] = 1.0
        for joint, side in ((k, 1.0), (k + 1, -1.0)):
            out = np.array([np.cos(angles[joint]), np.sin(angles[joint])])
            along = side * np.array([-out[1], out[0]])  # into the voussoir
            forces = (along, along, side * out)
            for column, (force, radius) in enumerate(zip(forces, (RADIUS - thickness / 2, RADIUS + thickness / 2, RADIUS), strict=True)):
                arm = radius * out - centre
                balance[3 * k : 3 * k + 3, 3 * joint + column] += [*force, arm[0] * force[1] - arm[1] * force[0]]
    cone = np.zeros((2 * (number + 1), 3 * (number + 1)))
    for joint in range(number + 1):
        for row, sign in enumerate((1.0, -1.0)):
            cone[2 * joint + row, 3 * joint : 3 * joint + 3] = [-ARCH_MU, -ARCH_MU, sign]
    bounds = [(0, None), (0, None), (None, None)] * (number + 1)
    return bool(linprog(np.zeros(cone.shape[1]), cone, np.zeros(len(cone)), balance, weight, bounds).status == 0)


@cache
def least_thickness() -> float:
    """Of the arch [m]: 0.1075 of the radius with joints everywhere (Couplet, Heyman), a little less where they are few."""
    low, high = 0.02, 0.3
    while high - low > 1e-7:
        middle = (low + high) / 2
        low, high = (low, middle) if thrust_fits(middle) else (middle, high)
    return high


def arch(share: float, duration: float, h: float) -> Scene:
    """A semicircular arch with so many times the least thickness; each voussoir is the two faces it touches others with."""
    thickness = share * least_thickness()
    centroid, polar = ring(thickness)
    mass, across = np.ones(VOUSSOIRS), thickness**2 / 12
    inertia = np.tile([polar - across + DEPTH**2 / 3, polar, across + DEPTH**2 / 3], (VOUSSOIRS, 1))
    angles = np.pi * np.arange(VOUSSOIRS + 1) / VOUSSOIRS
    shapes, pose = [GROUND], []
    for k in range(VOUSSOIRS):
        middle = (angles[k] + angles[k + 1]) / 2
        pose.append(at(centroid * np.cos(middle), 0, centroid * np.sin(middle), quaternion=about_y(-middle)))  # its x is outwards
        for angle, side in ((angles[k], 1.0), (angles[k + 1], -1.0)):
            turn = angle - middle
            x, z = RADIUS * np.cos(turn) - side * PLATE * np.sin(turn) - centroid, RADIUS * np.sin(turn) + side * PLATE * np.cos(turn)
            face = tuple(float(value) for value in at(x, 0, z, quaternion=about_y(-turn)))
            shapes.append(Shape("box", k, (thickness / 2, DEPTH, PLATE), face))
    rest = np.zeros((1, VOUSSOIRS, 6))
    return Scene("arch", h, steps(duration, h), ARCH_MU, tuple(shapes), mass, inertia, np.stack(pose)[None], rest)


def crown_fallen(moved: Motion) -> np.ndarray:
    """1 where the highest voussoir has come down by a tenth of the radius, [E]."""
    drop = moved.pose[0, :, VOUSSOIRS // 2, 2] - moved.pose[-1, :, VOUSSOIRS // 2, 2]
    return (drop > 0.1 * RADIUS).astype(float)


ARCH_STANDS = Case(
    "arch_stands",
    "a semicircular arch of 15 voussoirs with 1.01 times the least thickness, 3 s",
    partial(arch, 1.01, 3.0),
    (Metric("moved", "m", moved_by, 0.0, constant(1e-5)), Metric("creep", "m/s", creep, 0.0, constant(1e-9))),
    "a line of thrust fits into it (linear programme over its joints)",
    fails="sweeps that do not carry the thrust around",
)
ARCH_FALLS = Case(
    "arch_falls",
    "the same with 0.99 times the least thickness",
    partial(arch, 0.99, 3.0),
    (Metric("fallen", "-", crown_fallen, 1.0, constant(0.0)),),
    "none fits: it folds at five joints",
    fails="soft contacts hold a little more or less",
)

CASES = (*HEAVY, STACK, TOWER, PRESS_HOLD, PRESS_DROP, FRAME_STANDS, FRAME_FALLS, HOUSE, ARCH_STANDS, ARCH_FALLS)
