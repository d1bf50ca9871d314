# SPDX-License-Identifier: Apache-2.0
"""Drake's discrete MultibodyPlant: Simulator.AdvanceTo loops over the steps in C++, the environments go through it one after another.

Contact geometry. Where a box, or a capsule, meets a plane, it does so with points: spheres of no radius at its corners, or its
two end caps, so that it rests on 4 (2) contacts that are where they should be. Drake's own choices are worse there: its point
contact finds the deepest point alone, on which nothing rests, and a hydroelastic box touches the plane at the centroids of a few
polygons inside its face, whose friction is another one, and on which the paper's box takes off, whatever the solver.
Where two boxes meet, they are compliant hydroelastic bodies, which knows edges and faces alike: corners find no edges, and where
boxes are stacked flush, the face nearest to a corner may be the side.
All other pairs have a single deepest point, as Drake's point contact finds it.
"""

from __future__ import annotations

from itertools import product
from typing import Any

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
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

GRAVITY = 9.81
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
        for i, (kind, body, size, pose) in enumerate(zip(job.shape_kind, job.shape_body, job.shape_size, job.shape_pose, strict=True)):
            self.name, self.frame, self.place = f"{kind}{i}", plant.world_body() if body < 0 else bodies[body], transform(pose)
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
        self.groups[group].append(self.plant.RegisterCollisionGeometry(self.frame, where, shape, name, properties))

    def filter(self, scene: SceneGraph) -> None:
        """Every pair of shapes touches once: by corners and caps where a plane is met, a cap lies on a box too, else by the shapes."""
        plane, box, sphere, capsule, corner, cap = (GeometrySet(self.groups[name]) for name in self.groups)
        declaration = CollisionFilterDeclaration()
        for points, others in ((plane, (box, capsule)), (corner, (box, sphere, capsule, cap)), (cap, (sphere, capsule))):
            for other in others:
                declaration.ExcludeBetween(points, other)
        scene.collision_filter_manager().Apply(declaration.ExcludeWithin(corner).ExcludeWithin(cap))


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
            solid = SpatialInertia(mass=mass, p_PScm_E=np.zeros(3), G_SP_E=UnitInertia(*(inertia / mass)))
            bodies.append(self.plant.AddRigidBody(f"body{i}", solid))
        colliders = Colliders(job, self.plant, bodies)
        self.plant.Finalize()
        assert [body.floating_positions_start() for body in bodies] == list(range(0, 7 * len(bodies), 7)), "bodies in our order"
        colliders.filter(scene)
        self.simulator = Simulator(builder.Build())
        self.context = self.plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        if job.wrench.any():
            forces = [self.force(body, wrench) for body, wrench in zip(bodies, job.wrench, strict=True)]
            self.plant.get_applied_spatial_force_input_port().FixValue(self.context, AbstractValue.Make(forces))
        q = np.concatenate([job.pose[..., [6, 3, 4, 5]], job.pose[..., :3]], axis=-1)
        v = np.concatenate([job.velocity[..., 3:], job.velocity[..., :3]], axis=-1)
        self.start = np.concatenate([q.reshape(job.envs, -1), v.reshape(job.envs, -1)], axis=1)
        self.reset()

    @staticmethod
    def force(body: Any, wrench: np.ndarray) -> ExternallyAppliedSpatialForce:
        """At the body's origin, in world axes."""
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = body.index()
        applied.p_BoBq_B = np.zeros(3)
        applied.F_Bq_W = SpatialForce(tau=wrench[3:], f=wrench[:3])
        return applied

    def reset(self) -> None:
        """Positions and velocities of the environments [E, 13 B]."""
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
        q, v = np.split(self.last, [7 * len(self.job.mass)], axis=1)
        q, v = q.reshape(*self.job.pose.shape), v.reshape(*self.job.velocity.shape)
        turn = q[..., :4] / np.linalg.norm(q[..., :4], axis=-1, keepdims=True)
        return np.concatenate([q[..., 4:], turn[..., 1:], turn[..., :1]], axis=-1), np.concatenate([v[..., 3:], v[..., :3]], axis=-1)

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
