# SPDX-License-Identifier: Apache-2.0
"""Shared by all tests: the device, the reference data beside the repository, and the scenes that several tests use."""

import os
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl

wp.config.log_level = wp.LOG_WARNING
DEVICE = os.environ.get("WARP_LCP_DEVICE", "cpu")
SHARED = Path(__file__).resolve().parents[2] / "shared"
GRAVITY = 9.81


@pytest.fixture(scope="session")
def device() -> str:
    """Device under test; set WARP_LCP_DEVICE=cuda to test a GPU."""
    return DEVICE


@pytest.fixture(scope="session")
def shared() -> Path:
    """Reference data beside the repository; tests that need it skip where it does not exist."""
    if not SHARED.is_dir():
        pytest.skip("reference data beside the repository are absent")
    return SHARED


def simulator(model: wl.Model | wl.ModelBuilder, num_envs: int = 1, dt: float = 1e-3, **options) -> wl.Simulator:
    """Simulator on the device under test."""
    if isinstance(model, wl.ModelBuilder):
        model = model.finalize()
    return wl.Simulator(model, num_envs, dt, device=DEVICE, **options)


def paper_box(velocity=(0.0, 5.0, 0.0), spin=2 * np.pi) -> wl.Model:
    """The paper's box (Table 1): 1 kg, 1 m, mu = 1, flat on the plane z = 0."""
    builder = wl.ModelBuilder()
    rough = wl.Material(1.0, 1.0)
    builder.add_plane(material=rough)
    body = builder.add_body("box", pose=(0, 0, 0.5, 0, 0, 0, 1), velocity=velocity, angular_velocity=(0, 0, spin), mass=1.0)
    builder.add_box(body, (0.5, 0.5, 0.5), material=rough)
    return builder.finalize()


def block_on_plane(mu: float = 0.5, gravity=(0.0, 0.0, -GRAVITY), half=(0.1, 0.1, 0.1), **body) -> wl.ModelBuilder:
    """A block of 1000 kg/m^3 at rest on the plane z = 0."""
    builder = wl.ModelBuilder(gravity=gravity)
    material = wl.Material(mu, mu)
    builder.add_plane(material=material)
    index = builder.add_body("block", pose=(0, 0, half[2], 0, 0, 0, 1), **body)
    builder.add_box(index, half, material=material)
    return builder


def yaw(q: np.ndarray) -> float:
    """Turn about z [rad] of a pose that has turned about z alone."""
    return 2 * np.arctan2(q[5], q[6])


def random_quaternions(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Uniformly distributed unit quaternions (x y z w)."""
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)
