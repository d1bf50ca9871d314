# SPDX-License-Identifier: Apache-2.0
"""From v+ to q+: semi-implicit Euler (eq. 23), or the midpoint rule where no contact is in the way.

The midpoint rule moves a body with the mean (v + v+) / 2, which is of second order. A body that has just hit something
must not: v still holds the approach, and half of it would carry the body into what it hit. ``guard`` finds those bodies
and leaves them to Euler for this step.
"""

from types import SimpleNamespace

import warp as wp

from . import rigid
from .contacts import ELASTIC_RANGE
from .declare import factory, kernel
from .types import FIXED, FREE, scalar_types


@factory
def make(real) -> SimpleNamespace:
    """Kernels ``integrate`` and ``integrate_midpoint`` (dim E, B), and ``guard`` (dim E), which goes before the latter."""
    t = scalar_types(real)
    vec3, spatial = t.vec3, t.spatial
    Bodies, Contacts, Parameters, Topology = t.Bodies, t.Contacts, t.Parameters, t.Topology
    f = rigid.functions(real)
    point_velocity, rotation_by, moved = f.point_velocity, f.rotation_by, f.moved

    @kernel()
    def integrate(
        topology: Topology,
        bodies: Bodies,
        next_velocity: wp.array2d(dtype=spatial),
        h: real,
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        stride: int,
    ):
        """q+ = q + h Gamma(q) v+ (eq. 23)."""
        start, b = wp.tid()
        for env in range(start, q.shape[0], stride):
            if topology.joint_type[b] == FIXED:
                continue
            i = topology.q_start[b]
            j = topology.v_start[b]
            velocity = next_velocity[env, b]
            turn = rotation_by(wp.spatial_bottom(velocity), h)
            pose = moved(bodies.pose[env, b], bodies.com[env, b], wp.spatial_top(velocity), turn, h)
            for k in range(7):
                q[env, i + k] = pose[k]
            for k in range(6):
                v[env, j + k] = velocity[k]

    @kernel()
    def guard(
        parameters: Parameters,
        bodies: Bodies,
        contacts: Contacts,
        next_velocity: wp.array2d(dtype=spatial),
        h: real,
        tolerance: real,
        rounding: real,
        stride: int,
    ):
        """Bodies whose mean velocity would drive a contact further closed than v+ does get v = v+, which is Euler's step.

        What is left of a gap after h v+ may be used up; beyond it the surfaces may approach by what their compliance gives
        under load (a few nanometres with Table 1; without it the corners of a sliding box, which take turns in carrying it,
        would stop the midpoint rule in most steps), by the tolerance of the answer [m/s], and by a gap's round-off, the part
        `rounding` of a coordinate. To stop one body may make another run into it, so the search goes on until nobody does:
        each round stops a body, and with all stopped there is nothing to find.
        """
        start, _ = wp.tid()
        for env in range(start, contacts.count.shape[0], stride):
            fall = h * wp.length(parameters.gravity[env % parameters.gravity.shape[0]])
            searching = bool(True)
            while searching:
                searching = bool(False)
                for i in range(contacts.count[env]):
                    frame = contacts.frame[env, i]
                    n = vec3(frame[0, 0], frame[0, 1], frame[0, 2])
                    closing = real(0.0)
                    allowed = tolerance
                    for side in range(2):
                        b = contacts.body[env, i][side]
                        if b >= 0:
                            extra = real(0.5) * (bodies.velocity[env, b] - next_velocity[env, b])
                            com = bodies.com[env, b]
                            arm = contacts.point[env, i] - com
                            allowed += rounding * wp.length(com) / h
                            closing += real(1 - 2 * side) * wp.dot(n, point_velocity(extra, arm))
                    speed_to_close = contacts.shift[env, i][0]  # of an open gap, with what bends it
                    if contacts.closed[env, i] != 0:
                        speed_to_close = contacts.gap[env, i] / h
                    allowed += wp.max(speed_to_close + contacts.velocity[env, i][0], real(0.0))
                    load = fall / contacts.inv_mass[env, i][0] + contacts.impulse[env, i][0]
                    allowed += real(ELASTIC_RANGE) * contacts.relaxation[env, i][0] * load
                    if closing > allowed:
                        searching = bool(True)
                        for side in range(2):
                            b = contacts.body[env, i][side]
                            if b >= 0:
                                bodies.velocity[env, b] = next_velocity[env, b]

    @kernel()
    def integrate_midpoint(
        topology: Topology,
        parameters: Parameters,
        bodies: Bodies,
        next_velocity: wp.array2d(dtype=spatial),
        wrench: wp.array2d(dtype=spatial),
        h: real,
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        stride: int,
    ):
        """q+ = q + h Gamma(q) (v + v+) / 2, and w+ in the world axes of the new attitude.

        v+ comes in axes that have not turned yet. Euler turns the body about w+ itself, which leaves w+ as it is; the mean
        does not: what the gyroscopic term has done belongs to the body's axes and turns along, what torques and contacts have done
        belongs to the world and turns by half on average. A sphere is left as it is.
        """
        start, b = wp.tid()
        for env in range(start, q.shape[0], stride):
            if topology.joint_type[b] == FIXED:
                continue
            i = topology.q_start[b]
            j = topology.v_start[b]
            velocity = next_velocity[env, b]
            pose = bodies.pose[env, b]
            mean = real(0.5) * (bodies.velocity[env, b] + velocity)
            turn = rotation_by(wp.spatial_bottom(mean), h)
            w = wp.spatial_bottom(velocity)
            averaged = wp.length_sq(wp.spatial_bottom(mean) - w) > real(0.0)
            if averaged and topology.joint_type[b] == FREE:
                rotation = wp.transform_get_rotation(pose)
                inertia = parameters.inertia[env % parameters.inertia.shape[0], b]
                by_contacts = w - wp.spatial_bottom(bodies.free_velocity[env, b])
                kick = wp.quat_rotate(rotation, inertia * wp.quat_rotate_inv(rotation, by_contacts))
                kick += h * wp.spatial_bottom(wrench[env, b])
                w = wp.quat_rotate(turn, w) - real(0.5) * (bodies.inv_inertia[env, b] * (wp.quat_rotate(turn, kick) - kick))
            pose = moved(pose, bodies.com[env, b], wp.spatial_top(mean), turn, h)
            for k in range(7):
                q[env, i + k] = pose[k]
            for k in range(3):
                v[env, j + k] = velocity[k]
                v[env, j + 3 + k] = w[k]

    return SimpleNamespace(integrate=integrate, guard=guard, integrate_midpoint=integrate_midpoint)
