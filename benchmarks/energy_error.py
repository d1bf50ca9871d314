# SPDX-License-Identifier: Apache-2.0
"""By how much energy a step of any engine misses Newton's law and the exact Coulomb cone together.

Engines differ in what they report of their contacts, and many report nothing; what all have is the state before and after
a step. So the impulses are those that make the step look best: the smallest found, over all contact impulses r, of

    1/2 |v+ - v_free - M^-1 J^T r|_M^2  +  E_uc(u+, r),      u+ = J v+

in J, where E_uc is the unit-consistent error of Enzenhoefer, Peiret and others (a sum of 1/2 m_n min(u_n, r_n / m_n)^2 and
1/2 m_t |(r_t - P_disc(r_t - m_t u_t)) / m_t|^2 with the contacts' effective masses m_n, m_t). It is zero for a step that obeys both
laws, and for no other; it needs no impulse of the engine's own. A local search from two starts finds it: an upper bound. Contacts are
those that our collision detection finds at the state before the step; an open one has u_n + gap / h for u_n, as it may close.
There is no restitution in it, and no joint: it is defined for free bodies alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from .motion import Motion
from .scenes import Scene

FIRST, SPREAD = 6, 10  # steps: the first ones, where convex laws throw a body that slides, and others over the motion


def defined(scene: Scene) -> bool:
    """Are there free bodies alone, without restitution?"""
    return scene.made is None and not scene.restitution


@dataclass(frozen=True)
class Step:
    """One step: C contacts of bodies with V velocity components.

    Attributes:
        root: [V, V], M = root root^T. jacobian: [3 C, V], rows n, t1, t2 of each contact. free: [V] v_free. after: [V] v+.
        gap: [C] m over h, where it is open. mu: friction coefficient.
        start: [3 C] impulses to begin with.
    """

    root: np.ndarray
    jacobian: np.ndarray
    free: np.ndarray
    after: np.ndarray
    gap: np.ndarray
    mu: float
    start: np.ndarray

    def energy(self) -> float:
        """The smallest energy by which the step misses the laws [J]."""
        inverse = np.linalg.inv(self.root)
        effect = inverse @ self.jacobian.T  # of impulses on root^T v
        missing = self.root.T @ (self.after - self.free)
        if not len(self.gap):
            return float(0.5 * missing @ missing)
        diagonal = (effect**2).sum(axis=0).reshape(-1, 3)
        m_n, m_t = 1.0 / diagonal[:, 0], 2.0 / (diagonal[:, 1] + diagonal[:, 2])
        u = (self.jacobian @ self.after).reshape(-1, 3)
        normal = u[:, 0] + self.gap

        def laws(impulse: np.ndarray) -> np.ndarray:
            r = impulse.reshape(-1, 3)
            apart = np.sqrt(0.5 * m_n) * np.minimum(normal, r[:, 0] / m_n)
            pushed = r[:, 1:] - m_t[:, None] * u[:, 1:]
            limit, size = self.mu * np.maximum(r[:, 0], 0.0), np.linalg.norm(pushed, axis=1)
            held = pushed * (np.minimum(limit, size) / np.maximum(size, 1e-300))[:, None]
            slip = np.sqrt(0.5 * m_t)[:, None] * (r[:, 1:] - held) / m_t[:, None]
            return np.r_[np.sqrt(0.5) * (missing - effect @ impulse), apart, slip.ravel()]

        by_momentum = np.linalg.lstsq(effect, missing, rcond=None)[0]
        scale = np.repeat(m_n, 3) * max(np.abs(self.after).max(), np.abs(self.free).max(), 1e-9)

        def search(start: np.ndarray) -> float:
            asked = {"x_scale": scale, "ftol": 1e-12, "xtol": 1e-12}
            try:
                return 2.0 * least_squares(laws, start, max_nfev=60, gtol=None, **asked).cost
            except np.linalg.LinAlgError:  # LAPACK's SVD gives up on some finite matrices; this method has none, but takes longer
                return 2.0 * least_squares(laws, start, method="lm", max_nfev=15 * (len(start) + 1), **asked).cost

        return float(min(search(self.start), search(by_momentum)))


def steps(moved: Motion) -> list[Step]:
    """Some of the steps of a motion that is sampled at every step, or else of those before its samples."""
    assert moved.before is not None
    scene, (before_pose, before_velocity) = moved.scene, moved.before
    last = len(before_pose) - 1
    chosen = np.unique(np.r_[np.arange(min(FIRST, last + 1)), np.linspace(0, last, SPREAD).astype(int)])
    # One environment of each sample, another one every time.
    envs = np.arange(len(chosen)) % scene.envs
    first: Scene = replace(scene, pose=before_pose[chosen, envs], velocity=before_velocity[chosen, envs])
    after = moved.velocity[chosen + 1, envs].reshape(len(chosen), -1)
    sim = first.simulator(device="cpu", formulation="coulomb")
    sim.step()
    c = sim.contacts
    count, bodies, point, gap, frame, impulse = (array.numpy() for array in (c.count, c.bodies, c.point, c.gap, c.frame, c.impulse))
    free = sim.bodies.free_velocity.numpy().reshape(len(chosen), -1)
    inverse = sim.bodies.inv_inertia.numpy()
    found = []
    for i, number in enumerate(count):
        mass = np.zeros((free.shape[1],) * 2)
        for b, m in enumerate(scene.mass):
            mass[6 * b : 6 * b + 3, 6 * b : 6 * b + 3] = m * np.eye(3)
            mass[6 * b + 3 : 6 * b + 6, 6 * b + 3 : 6 * b + 6] = np.linalg.inv(inverse[i, b])
        jacobian = np.zeros((3 * number, free.shape[1]))
        for k in range(number):
            axes = frame[i, k].reshape(3, 3)
            for body, sign in zip(bodies[i, k], (-1.0, 1.0), strict=True):
                if body >= 0:
                    arm = point[i, k] - first.pose[i, body, :3]
                    jacobian[3 * k : 3 * k + 3, 6 * body : 6 * body + 3] = sign * axes
                    jacobian[3 * k : 3 * k + 3, 6 * body + 3 : 6 * body + 6] = sign * np.cross(arm, axes)
        closing = np.maximum(gap[i, :number], 0.0) / scene.dt
        root = np.linalg.cholesky(mass)
        found.append(Step(root, jacobian, free[i], after[i], closing, scene.friction, impulse[i, :number].reshape(-1)))
    return found


def largest(moved: Motion) -> float:
    """Over the chosen steps [J]; NaN where a state is not a number."""
    return float(np.max([step.energy() for step in steps(moved)])) if moved.finite else float("nan")
