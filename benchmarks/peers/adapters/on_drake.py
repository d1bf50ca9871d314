# SPDX-License-Identifier: Apache-2.0
"""Drake's discrete MultibodyPlant: Simulator.AdvanceTo loops over the steps in C++, the environments go through it one after another.

Contact geometry. Where a box, or a capsule, meets a plane, it does so with points: spheres of no radius at its corners, or its
two end caps, so that it rests on 4 (2) contacts that are where they should be. Drake's own choices are worse there: its point
contact finds the deepest point alone, on which nothing rests, and a hydroelastic box touches the plane at the centroids of a few
polygons inside its face, whose friction is another one, and on which the paper's box takes off, whatever the solver.
Where two boxes meet, they are compliant hydroelastic bodies, which knows edges and faces alike: corners find no edges, and where
boxes are stacked flush, the face nearest to a corner may be the side.
All other pairs have a single deepest point, as Drake's point contact finds it.

Joints. Drake has limits and drives of joints with one coordinate, and no massless bodies to chain such joints with. Loops are closed
by its own constraints, a hinge by two points of its axis.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import mjcf
import numpy as np
import protocol
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    Box,
    Capsule,
    CollisionFilterDeclaration,
    GeometrySet,
    HalfSpace,
    ProximityProperties,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Joint,
    PdControllerGains,
    PlanarJoint,
    PrismaticJoint,
    RevoluteJoint,
    RotationalInertia,
    SpatialInertia,
    UniversalJoint,
    WeldJoint,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

GRAVITY = 9.81
# warp_lcp.JointType and DofKind
FREE, KINEMATIC = 0, 1
LINEAR, ANGULAR = 0, 1
MODULUS = 1e7  # Pa, of geometry::DefaultProximityProperties; what it says of points is the plant's default without our doing


def transform(pose: np.ndarray) -> RigidTransform:
    """Of x y z qx qy qz qw."""
    w_first = np.roll(pose[3:], 1)
    return RigidTransform(Quaternion(w_first / np.linalg.norm(w_first)), pose[:3])


class Colliders:
    """Registers a job's shapes and says which pairs of them touch."""

    def __init__(self, job: protocol.Job, plant: MultibodyPlant, bodies: list[Any]):
        self.plant = plant
        self.friction = CoulombFriction(job.friction, job.friction)
        # With the setting "sag" [m] everything is so stiff that a box sinks about as far under the weight of all bodies (on
        # Earth) together: masses differ by 1000 between scenes, so that no one stiffness is right for all of them.
        self.sag = job.settings.get("sag")
        self.weight = GRAVITY * float(job.mass.sum())
        self.groups: dict[str, list[Any]] = {name: [] for name in ("plane", "box", "sphere", "capsule", "corner", "cap")}
        self.of_shape: list[list[Any]] = []
        self.touching = None if job.tree is None else {frozenset(pair) for pair in job.tree.pairs.tolist()}
        if "cylinder" in job.shape_kind:
            raise protocol.Refused("cylinders are not written for Drake")
        for i, (kind, body, size, pose) in enumerate(zip(job.shape_kind, job.shape_body, job.shape_size, job.shape_pose, strict=True)):
            self.name, self.frame, self.place = f"{kind}{i}", plant.world_body() if body < 0 else bodies[body], transform(pose)
            self.of_shape.append([])
            if kind == "plane":
                self.add(kind, HalfSpace())
            elif kind == "box":
                self.add(kind, Box(*(2.0 * size)), thickness=float(size.min()))
                for signs in product((-1.0, 1.0), repeat=3):
                    self.add("corner", Sphere(0.0), signs * size)
            elif kind == "sphere":
                self.add(kind, Sphere(size[0]))
            else:
                self.add(kind, Capsule(size[0], 2.0 * size[1]))
                for sign in (-1.0, 1.0):
                    self.add("cap", Sphere(size[0]), (0.0, 0.0, sign * size[1]))

    def add(self, group: str, shape: Shape, offset: Any = (0.0, 0.0, 0.0), thickness: float | None = None) -> None:
        """Give the present frame a geometry, hydroelastic if it has a thickness, which is where its pressure reaches the modulus."""
        properties = ProximityProperties()
        properties.AddProperty("material", "coulomb_friction", self.friction)
        modulus = MODULUS
        if self.sag is not None:
            # Two springs in series under 4 corners; 1 / dissipation is the largest speed of a rebound (Hunt and Crossley)
            properties.AddProperty("material", "point_contact_stiffness", self.weight / (2.0 * self.sag))
            properties.AddProperty("material", "hunt_crossley_dissipation", 1000.0)
            modulus = self.weight / (thickness * self.sag) if thickness else MODULUS
        if thickness is not None:
            AddCompliantHydroelasticProperties(thickness, modulus, properties)  # the first is a resolution, which a box ignores
        name = f"{self.name}_{group}{len(self.groups[group])}"
        where = self.place @ RigidTransform(np.asarray(offset))
        geometry = self.plant.RegisterCollisionGeometry(self.frame, where, shape, name, properties)
        self.groups[group].append(geometry)
        self.of_shape[-1].append(geometry)

    def filter(self, scene: SceneGraph) -> None:
        """Every pair of shapes touches once: by corners and caps where a plane is met, a cap lies on a box too, else by the shapes.

        Those of a robot that pass through each other do not touch.
        """
        plane, box, sphere, capsule, corner, cap = (GeometrySet(self.groups[name]) for name in self.groups)
        declaration = CollisionFilterDeclaration()
        for points, others in ((plane, (box, capsule)), (corner, (box, sphere, capsule, cap)), (cap, (sphere, capsule))):
            for other in others:
                declaration.ExcludeBetween(points, other)
        if self.touching is not None:
            for j, other in enumerate(self.of_shape):
                for i, one in enumerate(self.of_shape[:j]):
                    if frozenset((i, j)) not in self.touching:
                        declaration.ExcludeBetween(GeometrySet(one), GeometrySet(other))
        scene.collision_filter_manager().Apply(declaration.ExcludeWithin(corner).ExcludeWithin(cap))


class Joints:
    """Joins the bodies of a job, and says where its coordinates are among the plant's."""

    def __init__(self, job: protocol.Job, plant: MultibodyPlant, bodies: list[Any]):
        assert job.tree is not None
        self.job, self.tree, self.plant, self.bodies = job, job.tree, plant, bodies
        self.targets: list[tuple[float, float]] = []
        self.moved: list[tuple[Joint, list[int]]] = []  # with the velocities, in its order, that ours has for it
        if self.tree.joint_friction.any():
            raise protocol.Refused("joints of Drake have no dry friction")
        for body in np.argsort(self.tree.q_start, kind="stable").tolist():
            if self.tree.joint_type[body] != FREE:
                self.join(body)
        for kind, pair, poses in mjcf.closures(self.tree):
            a, b = (plant.world_body() if body < 0 else bodies[body] for body in pair)
            if kind == "weld":
                plant.AddWeldConstraint(a, transform(poses[0]), b, transform(poses[1]))
            else:
                plant.AddBallConstraint(a, poses[0, :3], b, poses[1, :3])

    def join(self, body: int) -> None:
        """The joint above a body."""
        tree, plant = self.tree, self.plant
        own = np.flatnonzero(tree.dof_body == body)
        kinds, axes, name = tree.dof_kind[own].tolist(), tree.dof_axis[own], f"joint{body}"
        turned = np.eye(3)  # axes of Drake's joint in the joint's frame
        if kinds == [LINEAR, LINEAR, ANGULAR] and abs(np.cross(axes[0], axes[1]) @ axes[2]) > 1.0 - 1e-9:
            if np.cross(axes[0], axes[1]) @ axes[2] < 0.0:
                own, axes = own[[1, 0, 2]], axes[[1, 0, 2]]
            turned = axes.T
        elif kinds == [ANGULAR, ANGULAR] and abs(axes[0] @ axes[1]) < 1e-9:
            turned = np.stack([*axes, np.cross(*axes)], axis=1)
        elif len(own) > 1 or tree.joint_type[body] == KINEMATIC:
            raise protocol.Refused("joints of Drake have one coordinate, two angles, or two ways and the angle in their plane")
        if len(own) > 1 and (tree.drive[own, :2].any() or tree.armature[own].any() or np.isfinite(tree.limit[own]).any()):
            raise protocol.Refused("limits, drives and armature are those of joints with one coordinate in Drake")
        parent = int(tree.body_parent[body])
        frames = []
        for side, (frame, pose) in enumerate(
            (
                (plant.world_frame() if parent < 0 else self.bodies[parent].body_frame(), tree.joint_pose[body]),
                (self.bodies[body].body_frame(), tree.joint_child_pose[body]),
            )
        ):
            where = transform(pose) @ RigidTransform(RotationMatrix(turned), np.zeros(3))
            frames.append(plant.AddFrame(FixedOffsetFrame(f"{name}_{side}", frame, where)))
        damping = tree.damping[own]
        if not len(own):
            plant.AddJoint(WeldJoint(name, *frames, RigidTransform()))
            return
        if len(own) == 1:
            made = PrismaticJoint if kinds == [LINEAR] else RevoluteJoint
            joint = plant.AddJoint(made(name, *frames, axes[0], damping=float(damping[0])))
            self.drive(joint, int(own[0]))
        elif len(own) == 2:
            joint = plant.AddJoint(UniversalJoint(name, *frames, damping=float(damping.max())))
        else:
            joint = plant.AddJoint(PlanarJoint(name, *frames, damping=damping))
        self.moved.append((joint, own.tolist()))

    def drive(self, joint: Joint, i: int) -> None:
        """Limits, armature and drive of a coordinate."""
        tree = self.tree
        if np.isfinite(tree.limit[i]).any():
            joint.set_position_limits(tree.limit[i, :1], tree.limit[i, 1:])
        stiffness, damping, force, target, target_velocity = tree.drive[i].tolist()
        if not (stiffness or damping or tree.armature[i]):
            return
        actuator = self.plant.AddJointActuator(f"{joint.name()}_drive", joint, force)
        actuator.set_default_rotor_inertia(float(tree.armature[i]))
        actuator.set_default_gear_ratio(1.0)
        if stiffness or damping:
            actuator.set_controller_gains(PdControllerGains(p=stiffness, d=damping))
            self.targets.append((target, target_velocity))

    def start(self) -> np.ndarray:
        """The plant's positions and velocities [E, ..], once it is final."""
        tree, number = self.tree, self.plant.num_positions()
        found = np.zeros((self.job.envs, number + self.plant.num_velocities()))
        for joint, own in self.moved:
            first = int(tree.q_start[tree.dof_body[own[0]]]) - int(tree.v_start[tree.dof_body[own[0]]])
            for k, i in enumerate(own):
                found[:, joint.position_start() + k] = tree.q[:, first + i]
                found[:, number + joint.velocity_start() + k] = tree.v[:, i]
        for b, body in enumerate(self.bodies):
            if tree.joint_type[b] == FREE:
                pose, velocity = self.job.pose[:, b], self.job.velocity[:, b]
                origin = velocity[:, :3] - np.cross(velocity[:, 3:], mjcf.rotate(pose[:, 3:], tree.com[b]))
                q, v = body.floating_positions_start(), number + body.floating_velocities_start_in_v()
                found[:, q : q + 7] = pose[:, [6, 3, 4, 5, 0, 1, 2]]
                found[:, v : v + 6] = np.concatenate([velocity[:, 3:], origin], axis=1)
        return found


class Drake(protocol.Engine):
    """One diagram and one context; the contact solver keeps nothing from step to step, so that q and v are the whole state."""

    def __init__(self, job: protocol.Job):
        if job.restitution:
            raise protocol.Refused("contacts of Drake have dissipation, not Newton's restitution")
        self.job = job
        # The solver's tolerances and SAP's regularisation of friction are out of Python's reach. SAP softens contacts by the bodies'
        # masses (a box sinks through another of 1/1000 of its mass) unless the threshold is 0; the others slip at up to the stiction
        # tolerance where they should stick, 1e-4 m/s by default, and below 1e-6 m/s nothing gets better.
        stiff = {"sap_near_rigid_threshold": 0.0, "stiction_tolerance": 1e-6} if "sag" in job.settings else {}
        config = MultibodyPlantConfig(time_step=job.dt, discrete_contact_approximation=job.settings["approximation"], **stiff)
        builder = DiagramBuilder()
        self.plant, scene = AddMultibodyPlant(config, builder)
        self.plant.mutable_gravity_field().set_gravity_vector(job.gravity)
        bodies = []
        for i, (mass, inertia) in enumerate(zip(job.mass, job.inertia, strict=True)):
            full = np.diag(inertia) if inertia.ndim == 1 else inertia
            about = RotationalInertia(*np.diag(full), full[0, 1], full[0, 2], full[1, 2])
            solid = SpatialInertia.MakeFromCentralInertia(mass, self.com(i), about)
            bodies.append(self.plant.AddRigidBody(f"body{i}", solid))
        joints = None if job.tree is None else Joints(job, self.plant, bodies)
        colliders = Colliders(job, self.plant, bodies)
        self.plant.set_adjacent_bodies_collision_filters(joints is None)
        self.plant.Finalize()
        self.bodies = bodies
        colliders.filter(scene)
        self.simulator = Simulator(builder.Build())
        self.context = self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        if job.wrench.any():
            forces = [self.force(body, self.com(i), wrench) for i, (body, wrench) in enumerate(zip(bodies, job.wrench, strict=True))]
            self.plant.get_applied_spatial_force_input_port().FixValue(self.context, AbstractValue.Make(forces))
        if joints is not None:
            self.start, self.scratch = joints.start(), self.plant.CreateDefaultContext()
            if joints.targets:
                port = self.plant.get_desired_state_input_port(bodies[0].model_instance())
                port.FixValue(self.context, np.array(joints.targets).T.ravel())
            self.reset()
            return
        assert [body.floating_positions_start() for body in bodies] == list(range(0, 7 * len(bodies), 7)), "bodies in our order"
        q = np.concatenate([job.pose[..., [6, 3, 4, 5]], job.pose[..., :3]], axis=-1)
        v = np.concatenate([job.velocity[..., 3:], job.velocity[..., :3]], axis=-1)
        self.start = np.concatenate([q.reshape(job.envs, -1), v.reshape(job.envs, -1)], axis=1)
        self.reset()

    def com(self, body: int) -> np.ndarray:
        """Centre of mass in the body's frame."""
        return np.zeros(3) if self.job.tree is None else self.job.tree.com[body]

    @staticmethod
    def force(body: Any, com: np.ndarray, wrench: np.ndarray) -> ExternallyAppliedSpatialForce:
        """At the centre of mass, in world axes."""
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = body.index()
        applied.p_BoBq_B = com
        applied.F_Bq_W = SpatialForce(tau=wrench[3:], f=wrench[:3])
        return applied

    def reset(self) -> None:
        """Positions and velocities of the environments, [E, 13 B] where all bodies are free."""
        self.last = self.start.copy()

    def enter(self, env: int) -> None:
        """Put an environment into the context."""
        self.simulator.get_mutable_context().SetTime(0.0)
        self.plant.SetPositionsAndVelocities(self.context, self.last[env])
        self.simulator.Initialize()

    def advance(self, steps: int) -> None:
        """Until so many steps since enter(): one each at the times 0, dt, ..., so that half a step later rounding cannot matter."""
        self.simulator.AdvanceTo((steps - 0.5) * self.job.dt)

    def run(self, steps: int) -> None:
        """A call an environment."""
        for env in range(self.job.envs):
            self.enter(env)
            self.advance(steps)
            self.last[env] = self.plant.GetPositionsAndVelocities(self.context)

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Drake never normalises its quaternions; it divides by their norm wherever it uses them, and so does this."""
        if self.job.tree is not None:
            return self.of_joints()
        q, v = np.split(self.last, [7 * len(self.job.mass)], axis=1)
        q, v = q.reshape(*self.job.pose.shape), v.reshape(*self.job.velocity.shape)
        turn = q[..., :4] / np.linalg.norm(q[..., :4], axis=-1, keepdims=True)
        return np.concatenate([q[..., 4:], turn[..., 1:], turn[..., :1]], axis=-1), np.concatenate([v[..., 3:], v[..., :3]], axis=-1)

    def of_joints(self) -> protocol.State:
        """By Drake's kinematics."""
        pose, velocity = np.empty(self.job.pose.shape), np.empty(self.job.velocity.shape)
        for env, state in enumerate(self.last):
            self.plant.SetPositionsAndVelocities(self.scratch, state)
            for b, body in enumerate(self.bodies):
                where = self.plant.EvalBodyPoseInWorld(self.scratch, body)
                moving = self.plant.EvalBodySpatialVelocityInWorld(self.scratch, body)
                pose[env, b] = np.concatenate([where.translation(), np.roll(where.rotation().ToQuaternion().wxyz(), -1)])
                spin = moving.rotational()
                velocity[env, b] = np.concatenate([moving.translational() + np.cross(spin, where.rotation() @ self.com(b)), spin])
        return pose, velocity

    def contacts(self) -> float:
        """Of the environment in the context: pairs of points, and polygons of surfaces; a contact of the solver each."""
        found = self.plant.get_contact_results_output_port().Eval(self.context)
        surfaces = (found.hydroelastic_contact_info(i).contact_surface() for i in range(found.num_hydroelastic_contacts()))
        return found.num_point_pair_contacts() + sum(surface.num_faces() for surface in surfaces)

    def record(self) -> dict[str, Any]:
        """One environment after another, as in run(), but a step at a time."""
        self.reset()
        path, contacts = np.empty((self.job.steps + 1, *self.last.shape)), 0.0
        path[0] = self.start
        for env in range(self.job.envs):
            self.enter(env)
            for i in range(1, self.job.steps + 1):
                self.advance(i)
                contacts += self.contacts()
                path[i, env] = self.plant.GetPositionsAndVelocities(self.context)

        def states(indices: range) -> list[protocol.State]:
            found = []
            for i in indices:
                self.last = path[i]
                found.append(self.state())
            return found

        every, end = self.job.every, self.job.steps + 1
        samples, before = states(range(0, end, every)), states(range(every - 1, end - 1, every))
        self.last = path[-1]
        return self.result(samples, before, contacts / (self.job.envs * self.job.steps))


if __name__ == "__main__":
    protocol.serve(Drake, ("drake",))
