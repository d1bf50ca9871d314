# SPDX-License-Identifier: Apache-2.0
"""Newton's XPBD on the CPU: two steps with their collision detection captured in a CPU graph."""

from __future__ import annotations

from typing import Any

import newton
import numpy as np
import protocol
import warp as wp

GENEROUS = 16  # contacts for each body in the run that finds how many are needed
GAP = 0.005  # m, of each shape; two of them are more than what a scene's bodies move in a step


class NewtonXPBD:
    """Steps with just the contacts that the scene takes; they are counted in an untimed run first."""

    def __init__(self, job: protocol.Job):
        wp.set_device("cpu")
        self.job = job
        # Coulomb friction alone: no rolling or torsional friction, which the other engines do not have in these scenes.
        surface = newton.ModelBuilder.ShapeConfig(density=0.0, mu=job.friction, mu_torsional=0.0, mu_rolling=0.0, gap=GAP)
        world = newton.ModelBuilder(gravity=(0.0, 0.0, -job.gravity))
        for (x, y, z), mass in zip(job.half.tolist(), job.mass.tolist(), strict=True):
            inertia = wp.mat33(np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) * mass / 3.0)
            world.add_shape_box(world.add_link(mass=mass, inertia=inertia), hx=x, hy=y, hz=z, cfg=surface)
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, -job.gravity))
        builder.replicate(world, job.envs)
        builder.add_ground_plane(cfg=surface)
        self.model = builder.finalize(device="cpu")
        self.solver = newton.solvers.SolverXPBD(self.model, iterations=job.settings["iterations"])
        self.states, self.control = (self.model.state(), self.model.state()), self.model.control()
        self.allocate(job.envs * len(job.mass) * GENEROUS)

    def allocate(self, contacts: int) -> None:
        """A pipeline with room for this many contacts in all environments together, and the graph of two steps."""
        self.capacity = contacts
        self.pipeline = newton.CollisionPipeline(self.model, rigid_contact_max=contacts, broad_phase="explicit")
        self.contacts = self.pipeline.contacts()
        self.reset()
        self.step(*self.states)  # loads the kernels, which a capture cannot
        self.reset()
        with wp.ScopedCapture(device="cpu") as capture:
            self.step(*self.states)
            self.step(*reversed(self.states))
        self.graph = capture.graph
        self.reset()

    def step(self, before: newton.State, after: newton.State) -> None:
        """Collide and step."""
        self.pipeline.collide(before, self.contacts)
        self.solver.step(before, after, self.control, self.contacts, self.job.dt)

    def reset(self) -> None:
        """XPBD keeps nothing from step to step but the state."""
        self.states[0].body_q.assign(self.job.pose.reshape(-1, 7))
        self.states[0].body_qd.assign(self.job.velocity.reshape(-1, 6))

    def run(self) -> None:
        """The CPU's launches are synchronous."""
        for _ in range(self.job.steps // 2):
            wp.capture_launch(self.graph)

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Read back."""
        pose, velocity = self.states[0].body_q.numpy().astype(float), self.states[0].body_qd.numpy().astype(float)
        return pose.reshape(self.job.pose.shape), velocity.reshape(self.job.velocity.shape)

    def record(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Counts contacts and allocates anew what was needed at most."""
        top, contacts = np.array(-np.inf), []
        for _ in range(self.job.steps):
            self.step(*self.states)
            self.states = self.states[::-1]
            top = np.maximum(top, self.state()[0][..., 2])
            contacts.append(int(self.contacts.rigid_contact_count.numpy()[0]))
        if max(contacts) > self.capacity:
            raise RuntimeError(f"{self.capacity} contacts are too few for {self.job.scene}: raise GENEROUS")
        pose = self.state()[0]
        self.allocate(max(contacts))
        return pose, top, float(np.mean(contacts)) / self.job.envs

    def info(self) -> dict[str, Any]:
        """Overflow: seen in the last step; one in an earlier step shows as a motion unlike the recorded one, which had more room."""
        return {"rigid_contact_max": self.capacity, "overflow": int(self.contacts.rigid_contact_count.numpy()[0]) > self.capacity}


if __name__ == "__main__":
    protocol.serve(NewtonXPBD, ("newton", "warp-lang"))
