# SPDX-License-Identifier: Apache-2.0
"""What hangs on joints: a chain, a four-bar, a stop, Painleve's rod, a grip, a wedge between jaws, stick and slip on a belt, robots.

Each is a Model of its own, most of them a shipped scene; the angles of mechanisms are held against integrations in minimal coordinates.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np

import warp_lcp as wl
from warp_lcp.model import Drive, JointType

from ..motion import Motion
from ..scenes import GRAVITY, Scene, of_model
from .case import Case, Metric, about_y, constant, creep, linear, moved_by, steps
from .impacts import PAINLEVE, ROD, ROD_RADIUS, below
from .sliding import Lazy, at

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@cache
def shipped(name: str) -> wl.Model:
    """A scene that comes with warp_lcp."""
    return wl.load_usd(name)


def of_shipped(name: str, duration: float, passive: bool, h: float) -> Scene:
    """The same as a scene of the benchmarks."""
    return of_model(name, shipped(name), h, steps(duration, h), passive=passive)


# --------------------------------------------------------------------------------------------------------------------- chain

CHAIN_TIME = 2.0  # s


@cache
def chain_reference() -> np.ndarray:
    """x, z [m] of the last of ten point masses on massless links."""
    from scipy.integrate import solve_ivp

    number, length = 10, 0.1
    masses = np.r_[np.full(number - 1, 0.1), 100.0]
    carried = np.cumsum(masses[::-1])[::-1]
    pairs = carried[np.maximum.outer(range(number), range(number))] * length**2

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        angle, w = y[:number], y[number:]
        between = angle[:, None] - angle[None, :]
        force = -(pairs * np.sin(between)) @ w**2 - carried * GRAVITY * length * np.sin(angle)
        return np.r_[w, np.linalg.solve(pairs * np.cos(between), force)]

    start = np.r_[np.full(number, np.pi / 2), np.zeros(number)]
    angle = solve_ivp(rate, (0.0, CHAIN_TIME), start, "DOP853", rtol=1e-11, atol=1e-12).y[:number, -1]
    return length * np.array([np.sin(angle).sum(), -np.cos(angle).sum()])


def last_place(moved: Motion) -> np.ndarray:
    """x, z of the last body at the end [m], [E, 2]."""
    return moved.pose[-1, :, -1, [0, 2]].T


CHAIN = Case(
    "chain",
    "ten links of 0.1 kg carry 100 kg, released at a right angle, 2 s",
    partial(of_shipped, "chain", CHAIN_TIME, False),
    (Metric("end", "m", last_place, Lazy(chain_reference, 0, 1), linear(3.0)),),  # swings of 1100 rad/s are resolved from 0.2 ms on
    "angles of the links, DOP853 at 1e-11",
    fails="Gauss-Seidel lets it stretch, explicit steps blow up from 2 ms on",
    charted=True,
    label="chain of ten links, 1000:1",
)

# ------------------------------------------------------------------------------------------------------------------ four-bar

CRANK_TIME = 2.0  # s
GROUND_BAR, BARS, BAR_MASSES = 1.0, np.array([0.3, 0.9, 0.6]), np.array([3.0, 9.0, 6.0])


def bar_angles(crank: float) -> np.ndarray:
    """Of crank, coupler and rocker [rad]: where two circles meet."""
    pin = BARS[0] * np.array([np.cos(crank), np.sin(crank)])
    away = np.array([GROUND_BAR, 0.0]) - pin
    far = np.hypot(*away)
    along = (BARS[1] ** 2 - BARS[2] ** 2 + far**2) / (2 * far)
    meet = pin + along * away / far + np.sqrt(BARS[1] ** 2 - along**2) * np.array([-away[1], away[0]]) / far
    return np.array([crank, np.arctan2(*(meet - pin)[::-1]), np.arctan2(meet[1], meet[0] - GROUND_BAR)])


def inertia_and_potential(crank: float) -> np.ndarray:
    """Of the crank's one degree of freedom: kg m^2, J."""
    a, b, c = bar_angles(crank)
    matrix = np.array([[-BARS[1] * np.sin(b), BARS[2] * np.sin(c)], [BARS[1] * np.cos(b), -BARS[2] * np.cos(c)]])
    wb, wc = np.linalg.solve(matrix, BARS[0] * np.array([np.sin(a), -np.cos(a)]))
    middle = BARS[0] * np.array([-np.sin(a), np.cos(a)]) + 0.5 * BARS[1] * wb * np.array([-np.sin(b), np.cos(b)])
    ends, own = BAR_MASSES * BARS**2 / 3, BAR_MASSES * BARS**2 / 12
    inertia = ends[0] + BAR_MASSES[1] * middle @ middle + own[1] * wb**2 + ends[2] * wc**2
    height = BAR_MASSES @ [0.5 * BARS[0] * np.sin(a), BARS[0] * np.sin(a) + 0.5 * BARS[1] * np.sin(b), 0.5 * BARS[2] * np.sin(c)]
    return np.array([inertia, GRAVITY * height])


@cache
def crank_reference() -> np.ndarray:
    """[1] rad that the crank has turned: Lagrange's equation, slopes by differences of 1e-10 of error."""
    from scipy.integrate import solve_ivp

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        slope = (inertia_and_potential(y[0] + 1e-5) - inertia_and_potential(y[0] - 1e-5)) / 2e-5
        return np.array([y[1], -(0.5 * slope[0] * y[1] ** 2 + slope[1]) / inertia_and_potential(y[0])[0]])

    return solve_ivp(rate, (0.0, CRANK_TIME), [0.0, 6.0], "DOP853", rtol=1e-9, atol=1e-9).y[:1, -1]


def crank_angle(moved: Motion) -> np.ndarray:
    """[E] rad from x towards z, within half a turn of the reference."""
    x, z = moved.pose[-1, :, 0, 0], moved.pose[-1, :, 0, 2]
    known = crank_reference()[0]
    return known + np.angle(np.exp(1j * (np.arctan2(z, x) - known)))


def opening(moved: Motion) -> np.ndarray:
    """How far the pin of coupler and rocker comes apart at most [m], [E]."""
    loop = moved.scene.model().loops[0]
    ends = [place(moved.pose[:, :, body], frame[:3]) for body, frame in zip(loop.bodies, loop.frames, strict=True)]
    return np.linalg.norm(ends[0] - ends[1], axis=-1).max(axis=0)


def place(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Of a point of a body [..., 3]."""
    axis, w = pose[..., 3:6], pose[..., 6:]
    return pose[..., :3] + point + 2.0 * np.cross(axis, np.cross(axis, point) + w * point)


FOURBAR = Case(
    "fourbar",
    "a four-bar turns all round, its loop closed by rows, 2 s",
    partial(of_shipped, "fourbar", CRANK_TIME, False),
    (
        Metric("crank", "rad", crank_angle, Lazy(crank_reference, 0), linear(1.0)),
        Metric("opening", "m", opening, 0.0, lambda h: 30.0 * h * h),
    ),
    "Lagrange's equation of its one degree of freedom, DOP853 at 1e-9",
    fails="loops that are held by velocities alone drift apart",
    charted=True,
    label="four-bar, a closed loop",
)

# ---------------------------------------------------------------------------------------------------------------------- stop

STOP, BOB = np.radians(30.0), 1.0  # rad short of hanging; m
BALL_INERTIA = 0.4 * 0.1**2  # kg m^2, radius 0.1 m
FREE_TIME = 0.4  # s, before it hits


@cache
def stop_model() -> wl.Model:
    """A ball of 1 kg on a hinge, level, and a stop 30 degrees before it hangs."""
    builder = wl.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    body = builder.add_body(pose=at(BOB, 0, 0), mass=1.0, inertia=BALL_INERTIA * np.eye(3))
    hinge = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # about y
    frames = {"parent_frame": (0, 0, 0, *hinge), "child_frame": (-BOB, 0, 0, *hinge)}
    builder.add_joint(JointType.REVOLUTE, -1, body, limit=(-np.pi / 2, np.pi / 2 - STOP), **frames)
    return builder.finalize()


@cache
def stop_reference() -> np.ndarray:
    """[1] rad below the level after FREE_TIME."""
    from scipy.integrate import solve_ivp

    pull = GRAVITY * BOB / (BOB**2 + BALL_INERTIA)  # s^-2, of 1 kg
    return solve_ivp(lambda _, y: [y[1], pull * np.cos(y[0])], (0.0, FREE_TIME), [0.0, 0.0], "DOP853", rtol=1e-11, atol=1e-12).y[:1, -1]


def dipped(moved: Motion) -> np.ndarray:
    """Angle below the level [rad], [T, E]."""
    return np.arctan2(-moved.pose[:, :, 0, 2], moved.pose[:, :, 0, 0])


STOP_HIT = Case(
    "stop",
    "a pendulum falls on a stop, 1.5 s",
    lambda h: of_model("stop", stop_model(), h, steps(1.5, h), passive=False),
    (
        Metric("rest angle", "rad", lambda moved: dipped(moved)[-1], np.pi / 2 - STOP, constant(1e-6)),
        Metric("overshoot", "rad", lambda moved: np.maximum(0.0, dipped(moved).max(axis=0) - np.pi / 2 + STOP), 0.0, constant(1e-6)),
        # Half a step of falling at 3.5 rad/s, and what the sample is off.
        Metric("fall", "rad", lambda moved: dipped(moved)[np.argmin(np.abs(moved.time - FREE_TIME))], Lazy(stop_reference, 0), linear(2.5)),
    ),
    "an inelastic stop; the pendulum's equation, DOP853 at 1e-11",
    fails="penalty springs bounce or let it through",
    charted=True,
    label="pendulum on a stop",
    timed_from=0.7,  # it hits at 0.47 s
)

# ------------------------------------------------------------------------------------------------- Painleve's rod, on joints


def planar_rod(free: Case, h: float) -> Scene:
    """The rod of a case, carried by a joint that leaves it the plane it moves in."""
    scene = free.build(h)
    builder, material = wl.ModelBuilder(gravity=scene.gravity), wl.Material(scene.friction, scene.friction)
    builder.add_plane(material=material)
    start = {"pose": scene.pose[0, 0], "velocity": scene.velocity[0, 0, :3]}
    body = builder.add_body(**start, mass=1.0, com=np.zeros(3), inertia=np.diag(scene.inertia[0]))
    builder.add_capsule(body, ROD_RADIUS, ROD, material=material)
    builder.add_joint(JointType.D6, -1, body, axes=("tx", "tz", "ry"))
    return of_model("rod", builder.finalize(), h, scene.steps)


PAINLEVE_ON_JOINTS = tuple(
    Case(
        f"{free.name}_joint",
        f"{free.title}; carried by a joint",
        partial(planar_rod, free),
        (Metric("overlap", "m", below, 0.0, constant(1e-4)),),
        free.source,
        fails=free.fails,
    )
    for free in PAINLEVE
)

# ---------------------------------------------------------------------------------------------------------------------- grip

LEAST_GRIP = 1.0 * GRAVITY / (2 * 0.5)  # N, a finger
CUBE = -1


def grip(share: float, duration: float, h: float) -> Scene:
    """The gripper with so many times the least force on its right finger."""
    model = shipped("gripper")
    drive = model.drive.copy()
    drive[model.v_start[model.body_names.index("/World/RightFinger")], 2] = share * LEAST_GRIP
    return of_model("grip", replace(model, drive=drive), h, steps(duration, h), passive=False)


def held(moved: Motion) -> np.ndarray:
    """Creep [m/s], [E]; the mean speed of all the way where that is over 1 cm, for what was dropped lies still at the end."""
    way = moved_by(moved)
    return np.where(way > 1e-2, way / moved.time[-1], creep(moved))


GRIP_HOLD = Case(
    "grip_hold",
    "two fingers on slides pinch a cube of 1 kg with 1.05 times the least force, 3 s",
    partial(grip, 1.05, 3.0),
    # It slips until the drive has closed what the springs of its other side give: 0.02 mm.
    (Metric("creep", "m/s", held, 0.0, constant(1e-9)), Metric("moved", "m", moved_by, 0.0, constant(2e-4))),
    "it is held from m g / (2 mu) a finger on",
    fails="soft contacts creep",
    charted=True,
    label="grip with 1.05 times the least force",
)
GRIP_DROP = Case(
    "grip_drop",
    "the same with 0.95 times the least force, 0.2 s",
    partial(grip, 0.95, 0.2),
    (Metric("velocity", "m/s", lambda moved: moved.velocity[-1, :, CUBE, 2], -0.2 * 0.05 * GRAVITY, constant(1e-5)),),
    "it falls with g - 2 mu N / m",
    fails="facets around the cone hold it",
)

# --------------------------------------------------------------------------------------------------------------------- wedge

HALF_ANGLE, SQUEEZE, JAW_MASS = np.radians(15.0), 50.0, 1.0  # rad; N and kg of a jaw
WEDGE_MU = float(np.tan(HALF_ANGLE))
WEDGE_TIME = 0.3  # s


@cache
def wedge_model(mu: float) -> wl.Model:
    """A wedge without weight, narrow end down, between two jaws that slide along x."""
    builder, material = wl.ModelBuilder(gravity=(0.0, 0.0, 0.0)), wl.Material(mu, mu)
    thick, middle = 0.01, 0.06
    body = builder.add_body(pose=at(0, 0, 0), mass=1.0, inertia=0.01 * np.eye(3), com=np.zeros(3))
    for side in (1.0, -1.0):
        turn, out = about_y(side * HALF_ANGLE), np.array([side * np.cos(HALF_ANGLE), 0.0, -np.sin(HALF_ANGLE)])
        builder.add_box(body, (thick, 0.05, 0.15), pose=at(side * middle, 0, 0, quaternion=turn), material=material)
        centre = np.array([side * middle, 0.0, 0.0]) + 2.0 * thick * out
        jaw = builder.add_body(pose=at(*centre), mass=JAW_MASS, inertia=0.01 * np.eye(3), com=np.zeros(3))
        builder.add_box(jaw, (thick, 0.05, 0.05), pose=at(0, 0, 0, quaternion=turn), material=material)
        builder.add_joint(JointType.PRISMATIC, -1, jaw, parent_frame=at(*centre), child_frame=IDENTITY)
    return builder.finalize()


def wedge(share: float, h: float) -> Scene:
    """Squeezed, with so many times the friction that jams it."""
    scene = of_model("wedge", wedge_model(share * WEDGE_MU), h, steps(WEDGE_TIME, h))
    return replace(scene, wrench=SQUEEZE * np.array([[0, 0, 0, 0, 0, 0], [-1, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]], dtype=float))


def ejected(mu: float) -> float:
    """Acceleration of the wedge [m/s^2]: N (cos + mu sin) = P - m_jaw a tan, m a = 2 N (sin - mu cos)."""
    sin, cos = np.sin(HALF_ANGLE), np.cos(HALF_ANGLE)
    push = 2.0 * (sin - mu * cos) / (cos + mu * sin)
    return push * SQUEEZE / (1.0 + push * JAW_MASS * np.tan(HALF_ANGLE))


WEDGE_JAMS = Case(
    "wedge_jams",
    "jaws squeeze a wedge with 1.02 times the friction that jams it, 0.3 s",
    partial(wedge, 1.02),
    (Metric("moved", "m", moved_by, 0.0, constant(1e-6)),),
    "it locks from mu = tan a on (half angle a)",
    fails="convex laws eject it, facets shift the threshold",
)
WEDGE_SLIPS = Case(
    "wedge_slips",
    "the same with 0.98 times that friction",
    partial(wedge, 0.98),
    (
        Metric(
            "velocity",
            "m/s",
            lambda moved: moved.velocity[-1, :, 0, 2],
            WEDGE_TIME * ejected(0.98 * WEDGE_MU),
            constant(1e-6 * WEDGE_TIME * ejected(0.98 * WEDGE_MU)),
        ),
    ),
    "m a = 2 N (sin a - mu cos a), N (cos a + mu sin a) = P - m_jaw a tan a",
    fails="facets around the cone hold it",
    charted=True,
    label="wedge between jaws, 2 % short of jamming",
)

# ------------------------------------------------------------------------------------------------------------ stick and slip

SPRING, BELT, MU_STATIC, MU_DYNAMIC = 100.0, 0.1, 0.5, 0.3  # N/m, m/s; a block of 1 kg
#: Friction is static up to this slip [m/s]. At Table 1's 1 mm/s a block takes 14 ms to get there: the period is 2.7 % longer at any step.
#: Bristles as stiff as that asks for: with Table 1's, under a force F on n contacts, F / (n (b_t + h k_t)) would be a slip already.
BREAKAWAY, BRISTLE = 1e-6, {"tangent_stiffness": 1e10, "tangent_damping": 1e7}
OMEGA, EXCESS = np.sqrt(SPRING), (MU_STATIC - MU_DYNAMIC) * GRAVITY / SPRING
PERIOD = 2 * EXCESS / BELT + (2 * np.pi - 2 * np.arctan2(EXCESS * OMEGA, BELT)) / OMEGA
FARTHEST = MU_DYNAMIC * GRAVITY / SPRING + np.hypot(EXCESS, BELT / OMEGA)


@cache
def belt_model() -> wl.Model:
    """A block on a belt, held by a spring."""
    builder, rough = wl.ModelBuilder(), wl.Material(MU_STATIC, MU_DYNAMIC, slip_threshold=BREAKAWAY, **BRISTLE)
    builder.add_box(-1, (2.0, 0.5, 0.1), pose=at(0, 0, -0.1), material=rough, surface_velocity=(BELT, 0, 0))
    body = builder.add_body(pose=at(0, 0, 0.05), velocity=(BELT, 0, 0), mass=1.0)
    builder.add_box(body, (0.05, 0.05, 0.05), material=rough)
    builder.add_joint(JointType.D6, -1, body, parent_frame=at(0, 0, 0.05), axes=("tx", "tz"), drive=[Drive(SPRING), None])
    return builder.finalize()


def period(moved: Motion) -> np.ndarray:
    """Mean time from one slip to the next [s], [E]: where a cubic through places and velocities passes 0.03 m on its way back."""
    from scipy.interpolate import CubicHermiteSpline

    result = np.full(moved.scene.envs, np.nan)
    for env in range(moved.scene.envs):
        x, v = moved.pose[:, env, 0, 0], moved.velocity[:, env, 0, 0]
        if np.isfinite(x).all():
            times = CubicHermiteSpline(moved.time, x, v).solve(0.03, extrapolate=False)
            back = times[CubicHermiteSpline(moved.time, x, v)(times, 1) < 0.0]
            result[env] = np.diff(back).mean() if len(back) > 1 else np.nan
    return result


STICK_SLIP = Case(
    "stick_slip",
    "a block on a belt, held by a spring, sticks and slips, 8 s",
    lambda h: of_model("stick_slip", belt_model(), h, steps(8.0, h), passive=False),
    (
        Metric("period", "s", period, PERIOD, linear(4.0)),
        Metric("farthest", "m", lambda moved: moved.pose[:, :, 0, 0].max(axis=0), FARTHEST, linear(0.05, 5e-5)),
    ),
    "closed form of the limit cycle (mu_s = 0.5, mu_k = 0.3)",
    fails="one coefficient for both; laws that slide from a threshold of speed on, as ours does with Table 1's (2.7 %)",
)

# -------------------------------------------------------------------------------------------------------------------- robots


def lowest_base(moved: Motion) -> np.ndarray:
    """Height of the first body at the end over that at the start, [E]."""
    return moved.pose[-1, :, 0, 2] / moved.pose[0, :, 0, 2]


QUADRUPED = Case(
    "quadruped",
    "a robot on four legs stands under position drives, 10 s",
    partial(of_shipped, "quadruped", 10.0, False),
    (Metric("creep", "m/s", creep, 0.0, constant(1e-9)), Metric("height", "-", lowest_base, 1.0, constant(0.01))),
    "it stands",
    fails="soft contacts and drives that are explicit",
    charted=True,
    label="quadruped that stands",
)


def toppled(h: float) -> Scene:
    """The humanoid, pushed off at 1 m/s."""
    model = shipped("humanoid")
    start = model.v0.copy()
    start[:2] = (1.0, 0.1)
    return of_model("humanoid", replace(model, v0=start), h, steps(8.0, h), passive=False)


HUMANOID = Case(
    "humanoid",
    "a humanoid of 27 degrees of freedom is pushed over and lies still, 8 s",
    toppled,
    (
        Metric("creep", "m/s", creep, 0.0, constant(1e-6)),
        # Its pelvis, a capsule of 9 cm, lies or leans: below a quarter of its height and not in the ground.
        Metric("height", "-", lowest_base, 0.17, constant(0.08)),
    ),
    "it lies still, nothing is in the ground",
    fails="contacts and limits that are not solved together jitter",
    charted=True,
    label="humanoid that lies",
    timed_from=4.0,  # it lies from 2 s on
)

CASES = (
    CHAIN,
    FOURBAR,
    STOP_HIT,
    *PAINLEVE_ON_JOINTS,
    GRIP_HOLD,
    GRIP_DROP,
    WEDGE_JAMS,
    WEDGE_SLIPS,
    STICK_SLIP,
    QUADRUPED,
    HUMANOID,
)
