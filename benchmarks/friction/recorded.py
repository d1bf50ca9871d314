# SPDX-License-Identifier: Apache-2.0
"""Recorded friction problems (numpy archives: W in CSR, q, mu) and how far impulses are from solving them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Problem:
    """u = W p + q with friction coefficients mu, order (n, t1, t2) in each contact."""

    name: str
    path: Path
    W: np.ndarray
    q: np.ndarray
    mu: np.ndarray

    @property
    def contacts(self) -> int:
        return len(self.mu)

    @cached_property
    def rank(self) -> int:
        """Eigenvalues of the symmetric part of W above 1e-10 of the largest."""
        values = np.linalg.eigvalsh(0.5 * (self.W + self.W.T))
        return int(np.count_nonzero(values > 1e-10 * values[-1]))


def load(path: Path) -> Problem:
    """Read one file."""
    with np.load(path) as z:
        n = int(z["n"])
        W = np.zeros((n, n))
        np.add.at(W, (np.repeat(np.arange(n), np.diff(z["W_indptr"])), z["W_indices"]), z["W_data"])
        mu = np.broadcast_to(z["mu"].astype(float), (n // 3,)).copy()
        return Problem(path.stem, path, W, z["q"].astype(float), mu)


def find(folder: Path) -> list[Problem]:
    """All problems of a folder, fewest contacts first; [] where it has none."""
    return sorted((load(path) for path in folder.glob("*.npz")), key=lambda p: (p.contacts, p.name))


def natural_map(W: np.ndarray, q: np.ndarray, mu: np.ndarray, p: np.ndarray) -> float:
    """|p - P_K(p - u - mu |u_t| n)| / |q|, K the cone |p_t| <= mu p_n: the error measure of Siconos and FCLIB; nan if p is not finite."""
    if not np.isfinite(p).all():
        return float("nan")
    u = (W @ p + q).reshape(-1, 3)
    u[:, 0] += mu * np.linalg.norm(u[:, 1:], axis=1)
    x = p.reshape(-1, 3) - u
    normal, size = x[:, 0], np.linalg.norm(x[:, 1:], axis=1)
    projected = np.where(((size <= mu * normal) & (normal >= 0.0))[:, None], x, 0.0)
    on_cone = (size > mu * normal) & (mu * size > -normal)
    a = (normal + mu * size)[on_cone] / (1.0 + mu[on_cone] ** 2)
    projected[on_cone] = np.column_stack([a, (mu[on_cone] * a / size[on_cone])[:, None] * x[on_cone, 1:]])
    return float(np.linalg.norm(p - projected.ravel()) / np.linalg.norm(q))
