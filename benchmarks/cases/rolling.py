# SPDX-License-Identifier: Apache-2.0
"""Spheres that slip until they roll, and roll down a slope."""

from __future__ import annotations

from functools import partial

import numpy as np

from ..motion import Motion
from ..scenes import GRAVITY, GROUND, Scene, Shape, ball_inertia
from .case import Case, Metric, constant, linear, steps, tilted
from .sliding import at, last_velocity

RADIUS, MASS = 0.1, 1.0


def ball(velocity: np.ndarray, mu: float, duration: float, h: float, **options) -> Scene:
    """A ball on the ground in as many environments as there are velocities [E, 6]."""
    envs = len(velocity)
    shapes = (GROUND, Shape("sphere", 0, (RADIUS, 0.0, 0.0)))
    mass = np.array([MASS])
    pose = np.tile(at(0, 0, RADIUS), (envs, 1, 1))
    return Scene("ball", h, steps(duration, h), mu, shapes, mass, ball_inertia([RADIUS], mass), pose, velocity[:, None], **options)


SPEED, MU = 2.0, 0.3
#: Forward spin w0 [rad/s] of the two environments: none, and so much backwards that it comes to rest rolling slowly.
SPINS = np.array([0.0, -30.0])
ROLLING = (5.0 * SPEED + 2.0 * RADIUS * SPINS) / 7.0  # m/s
SLIP_TIME = np.abs(SPEED - RADIUS * SPINS) * 2.0 / (7.0 * MU * GRAVITY)
DURATION = 0.8


def slip_to_roll(h: float) -> Scene:
    """Two environments."""
    velocity = np.zeros((2, 6))
    velocity[:, 0], velocity[:, 4] = SPEED, SPINS
    return ball(velocity, MU, DURATION, h)


def travelled(moved: Motion) -> np.ndarray:
    """Along x [m], [E]."""
    return moved.pose[-1, :, 0, 0]


def slip(moved: Motion) -> np.ndarray:
    """Speed of the surface over the ground at the end [m/s], [E]."""
    return moved.velocity[-1, :, 0, 0] - RADIUS * moved.velocity[-1, :, 0, 4]


SLIP_TO_ROLL = Case(
    "slip_to_roll",
    "a ball thrown at 2 m/s slips until it rolls; another one with back-spin",
    slip_to_roll,
    (
        Metric(
            "position",
            "m",
            travelled,
            (0.5 * (SPEED + ROLLING) * SLIP_TIME + ROLLING * (DURATION - SLIP_TIME))[:, None],
            linear(0.51 * (SPEED - ROLLING.min())),
        ),
        Metric("speed", "m/s", lambda moved: moved.velocity[-1, :, 0, 0], ROLLING[:, None], constant(1e-6)),
        Metric("slip", "m/s", slip, 0.0, constant(1e-6)),
    ),
    "(5 v0 + 2 R w0) / 7 from the time 2 |v0 - R w0| / (7 mu g) on",
    fails="explicit friction chatters where slipping ends",
    charted=True,
    label="slip to roll",
)

SLOPE, SLOPE_HEADING = 20.0, 30.0
DOWN = np.array([np.cos(np.radians(SLOPE_HEADING)), np.sin(np.radians(SLOPE_HEADING))])

ROLLING_INCLINE = Case(
    "rolling_incline",
    "a ball rolls down a slope of 20 degrees, mu = 0.3",
    partial(ball, np.zeros((1, 6)), MU, 1.0, gravity=tilted(SLOPE, SLOPE_HEADING)),
    (Metric("velocity", "m/s", last_velocity, 5 / 7 * GRAVITY * np.sin(np.radians(SLOPE)) * DOWN, constant(1e-6)),),
    "5/7 g sin t, downhill",
    fails="facets that stay fixed slow it by their direction",
)

CASES = (SLIP_TO_ROLL, ROLLING_INCLINE)
