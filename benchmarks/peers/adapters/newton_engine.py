# SPDX-License-Identifier: Apache-2.0
"""What the adapters of Newton's solvers share: the model, its collision pipeline, and steps captured in CPU graphs."""

from __future__ import annotations

from abc import abstractmethod
from itertools import pairwise
from typing import Any

import newton
import numpy as np
import protocol
import warp as wp

GENEROUS = 16  # contacts for each body in the run that finds how many are needed
# warp_lcp.JointType and DofKind
FREE, FIXED, SPHERICAL = 0, 2, 5
LINEAR, ANGULAR = 0, 1
GAP = 0.005  # m, of each shape; or what the fastest body moves in a step, where that is more (Newton's own default is 0.1 m)


class NewtonEngine(protocol.Engine):
    """Two states in turn; a graph of one step in either direction. A solver's adapter says how it is made.

    Attributes:
        knows: what of a joint's "force" limit, dry "friction" and "damping" beside a drive the solver looks at.
    """

    knows: frozenset[str] = frozenset()

    def __init__(self, job: protocol.Job):
        wp.set_device("cpu")
        self.job = job
        if job.restitution:
            raise protocol.Refused("restitution is not compared")
        self.model = self.build()
        self.control = self.model.control()
        self.needed = 0
        self.allocate(job.envs * max(len(job.mass), 1) * GENEROUS)

    @abstractmethod
    def solver(self) -> newton.solvers.SolverBase:
        """The solver with the job's settings; self.model and self.pipeline are there."""

    def register(self, builder: newton.ModelBuilder) -> None:
        """What the solver must tell a builder before bodies are added."""

    def add(self, world: newton.ModelBuilder, **body: Any) -> None:
        """A free body; one whose solver wants no joints is a link."""
        world.add_body(**body)

    def link(self, world: newton.ModelBuilder, **body: Any) -> None:
        """A body whose joint is added apart."""
        world.add_link(**body)

    def joints(self, world: newton.ModelBuilder, tree: protocol.Tree) -> None:
        """All joints of a tree, in the order of its coordinates; dampers are drives without a target."""
        found = []
        for body in np.argsort(tree.q_start, kind="stable").tolist():
            parent, kind = int(tree.body_parent[body]), tree.joint_type[body]
            frames = [wp.transform(*pose[body].tolist()) for pose in (tree.joint_pose, tree.joint_child_pose)]
            where = {"parent": parent, "child": body, "parent_xform": frames[0], "child_xform": frames[1]}
            axes: dict[bool, list[Any]] = {True: [], False: []}
            for i in np.flatnonzero(tree.dof_body == body):
                axes[bool(tree.dof_kind[i] == LINEAR)].append(self.axis(tree, i))
            if kind == FREE:
                found.append(world.add_joint_free(child=body))
            elif kind == FIXED:
                found.append(world.add_joint_fixed(**where))
            elif kind == SPHERICAL:
                raise protocol.Refused("balls are not written for Newton")
            elif len(axes[False]) == 1 and not axes[True]:
                found.append(world.add_joint_revolute(axis=axes[False][0], **where))
            elif len(axes[True]) == 1 and not axes[False]:
                found.append(world.add_joint_prismatic(axis=axes[True][0], **where))
            else:
                found.append(world.add_joint_d6(linear_axes=axes[True], angular_axes=axes[False], **where))
        cut = [0, *self.cuts(tree), len(found)]
        for begin, end in pairwise(cut):
            world.add_articulation(found[begin:end])
        self.close(world, tree)

    @staticmethod
    def cuts(tree: protocol.Tree) -> list[int]:
        """Where in the order of coordinates an articulation ends: neither a joint nor a loop reaches from before to behind."""
        rank = np.argsort(np.argsort(tree.q_start, kind="stable")).tolist()
        pairs = [(body, parent) for body, parent in enumerate(tree.body_parent.tolist())] + tree.loop_bodies.tolist()
        spans = [sorted((rank[a], rank[b])) for a, b in pairs if min(a, b) >= 0]
        return [k for k in range(1, len(rank)) if not any(low < k <= high for low, high in spans)]

    @staticmethod
    def close(world: newton.ModelBuilder, tree: protocol.Tree) -> None:
        """Joints outside every articulation close loops; their child is a body."""
        for i, (bodies, frames) in enumerate(zip(tree.loop_bodies.tolist(), tree.loop_frames, strict=True)):
            (parent, parent_frame), (child, child_frame) = sorted(zip(bodies, frames, strict=True), key=lambda side: side[0] >= 0)
            where = {"parent": parent, "child": child}
            where |= {"parent_xform": wp.transform(*parent_frame.tolist()), "child_xform": wp.transform(*child_frame.tolist())}
            kind = protocol.closure(tree, i)
            if kind == "ball":
                world.add_joint_ball(**where)
            elif kind == "hinge":
                world.add_joint_revolute(axis=wp.vec3(*np.where(tree.loop_turns[i], 0.0, 1.0).tolist()), **where)
            else:
                world.add_joint_fixed(**where)

    def axis(self, tree: protocol.Tree, i: int) -> newton.ModelBuilder.JointDofConfig:
        """A coordinate's limits and drive; a solver that knows no damping has it as a part of the drive, whose target moves slower then."""
        stiffness, damping, force, target, target_velocity = tree.drive[i].tolist()
        asked = {"force": (stiffness or damping) and np.isfinite(force), "friction": tree.joint_friction[i]}
        for name, value in asked.items():
            if value and name not in self.knows:
                raise protocol.Refused(f"this solver has no {'drives of limited force' if name == 'force' else 'dry friction of joints'}")
        passive = float(tree.damping[i])
        if passive and "damping" not in self.knows:
            target_velocity *= damping / (damping + passive)
            damping, passive = damping + passive, 0.0
        limits = {name: float(x) for name, x in zip(("limit_lower", "limit_upper"), tree.limit[i], strict=True) if np.isfinite(x)}
        return newton.ModelBuilder.JointDofConfig(
            axis=wp.vec3(*tree.dof_axis[i].tolist()),
            armature=float(tree.armature[i]),
            target_q=target,
            target_qd=target_velocity,
            target_ke=stiffness,
            target_kd=damping,
            damping=passive,
            friction=float(tree.joint_friction[i]),
            **({"effort_limit": force} if np.isfinite(force) else {}),
            **limits,
        )

    def build(self) -> newton.Model:
        """All environments, one world each; colliders of the world belong to every one of them."""
        job = self.job
        fall = np.linalg.norm(job.gravity) * min(job.steps * job.dt, float(np.sqrt(2.0 * max(job.pose[..., 2].max(), 0.0) / 9.81)))
        way = (float(np.linalg.norm(job.velocity[..., :3], axis=-1).max(initial=0.0)) + fall) * job.dt
        # Coulomb friction alone: no rolling or torsional friction, which the other engines do not have in these scenes.
        surface = newton.ModelBuilder.ShapeConfig(density=0.0, mu=job.friction, mu_torsional=0.0, mu_rolling=0.0, gap=max(GAP, way))
        gravity = tuple(job.gravity.tolist())
        world = newton.ModelBuilder(gravity=gravity)
        self.register(world)
        for b, (pose, mass, inertia) in enumerate(zip(job.pose[0], job.mass.tolist(), job.inertia, strict=True)):
            full = inertia if inertia.ndim == 2 else np.diag(inertia)
            body = {"xform": wp.transform(*pose.tolist()), "mass": mass, "inertia": wp.mat33(full), "lock_inertia": True}
            if job.tree is None:
                self.add(world, **body)
            else:
                self.link(world, com=wp.vec3(*job.tree.com[b].tolist()), **body)
        if job.tree is not None:
            self.joints(world, job.tree)
        builder = newton.ModelBuilder(gravity=gravity)
        self.register(builder)
        for kind, body, size, pose in zip(job.shape_kind, job.shape_body, job.shape_size.tolist(), job.shape_pose, strict=True):
            target, place = (builder if body < 0 else world), {"body": body, "xform": wp.transform(*pose.tolist()), "cfg": surface}
            if kind == "plane":
                target.add_shape_plane(width=0.0, length=0.0, **place)
            elif kind == "box":
                target.add_shape_box(hx=size[0], hy=size[1], hz=size[2], **place)
            elif kind == "sphere":
                target.add_shape_sphere(radius=size[0], **place)
            elif kind == "cylinder":
                target.add_shape_cylinder(radius=size[0], half_height=size[1], **place)
            else:
                target.add_shape_capsule(radius=size[0], half_height=size[1], **place)
        builder.replicate(world, job.envs)
        if job.tree is not None:
            self.filter(builder, job)
        return builder.finalize(device="cpu")

    @staticmethod
    def filter(builder: newton.ModelBuilder, job: protocol.Job) -> None:
        """Shapes that pass through each other. The world's come first, then those of the bodies, once for each environment."""
        touching = {frozenset(pair) for pair in job.tree.pairs.tolist()}
        own = [i for i, body in enumerate(job.shape_body) if body >= 0]
        static = [i for i, body in enumerate(job.shape_body) if body < 0]
        for env in range(job.envs):
            place = {i: k for k, i in enumerate(static)} | {i: len(static) + env * len(own) + k for k, i in enumerate(own)}
            for b, j in enumerate(own):
                for i in static + own[:b]:
                    if frozenset((i, j)) not in touching:
                        builder.add_shape_collision_filter_pair(place[i], place[j])

    def allocate(self, contacts: int) -> None:
        """A pipeline and a solver with room for this many contacts in all environments together, and graphs of their steps."""
        self.capacity = contacts
        self.model.rigid_contact_max = contacts
        self.pipeline = newton.CollisionPipeline(self.model, rigid_contact_max=contacts, broad_phase="explicit")
        self.contact_buffer = self.pipeline.contacts()
        self.engine = self.solver()
        self.states = (self.model.state(), self.model.state())
        self.force = wp.array(np.tile(self.job.wrench.astype(np.float32), (self.job.envs, 1)), dtype=wp.spatial_vector, device="cpu")
        self.reset()
        self.step(*self.states)  # loads the kernels, which a capture cannot
        self.reset()
        self.graphs = []
        for before, after in (self.states, self.states[::-1]):
            with wp.ScopedCapture(device="cpu") as capture:
                self.step(before, after)
            self.graphs.append(capture.graph)
        self.reset()

    def step(self, before: newton.State, after: newton.State) -> None:
        """Collide and step."""
        if self.job.wrench.any():
            wp.copy(before.body_f, self.force)
        self.pipeline.collide(before, self.contact_buffer)
        self.engine.step(before, after, self.control, self.contact_buffer, self.job.dt)

    def reset(self) -> None:
        """The first state is the start."""
        self.steps = 0
        self.states[0].body_q.assign(self.job.pose.reshape(-1, 7))
        self.states[0].body_qd.assign(self.job.velocity.reshape(-1, 6))
        if self.job.tree is not None:  # bodies where the joints have them: a check of the joints that costs no step
            state, tree = self.states[0], self.job.tree
            for array, own in ((state.joint_q, tree.q), (state.joint_qd, tree.v)):  # those of joints that close loops are behind
                values = array.numpy().reshape(self.job.envs, -1).copy()
                values[:, : own.shape[1]] = own
                array.assign(values.reshape(-1))
            newton.eval_fk(self.model, state.joint_q, state.joint_qd, state)

    def run(self, steps: int) -> None:
        """The CPU's launches are synchronous."""
        for _ in range(steps):
            wp.capture_launch(self.graphs[self.steps % 2])
            self.steps += 1

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Read back."""
        now = self.states[self.steps % 2]
        pose, velocity = now.body_q.numpy().astype(float), now.body_qd.numpy().astype(float)
        return pose.reshape(self.job.pose.shape), velocity.reshape(self.job.velocity.shape)

    def contacts(self) -> float:
        """Of the pipeline: near ones count, whether they carry or not."""
        number = int(self.contact_buffer.rigid_contact_count.numpy()[0])
        self.needed = max(self.needed, number)
        return number / self.job.envs

    def settle(self) -> None:
        """Just what was needed at most."""
        if self.needed > self.capacity:
            raise RuntimeError(f"{self.capacity} contacts are too few for {self.job.scene}: raise GENEROUS")
        self.allocate(max(self.needed, 1))

    def info(self) -> dict[str, Any]:
        """Overflow: seen in the last step; one in an earlier step shows as a motion unlike the recorded one, which had more room."""
        return {"rigid_contact_max": self.capacity, "overflow": int(self.contact_buffer.rigid_contact_count.numpy()[0]) > self.capacity}
