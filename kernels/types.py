# SPDX-License-Identifier: Apache-2.0
"""Warp types and array bundles for one scalar type, shared by all stages.

A bundle is a struct of arrays, so that a kernel takes a handful of arguments. Parameter arrays have a first axis of 1
or num_envs and are indexed modulo its length: what is not randomised is stored once.

Shapes: E environments, B bodies, S shapes, P pairs, C contact slots (all points the pairs can make), R contacts.
Frames: world axes unless said otherwise. Contact order: n, t1, t2; u = velocity of body b minus that of body a.
"""

import functools
from types import SimpleNamespace

import warp as wp

# Joint types as warp_lcp.model numbers them.
FREE = wp.constant(0)
KINEMATIC = wp.constant(1)
FIXED = wp.constant(2)

# Contact states reported per contact.
OPEN = wp.constant(0)
STICK = wp.constant(1)
SLIDE = wp.constant(2)

# State of a contact while it is solved: bit 0 closed, bits 1-2 axis t1, bits 3-4 axis t2.
CLOSED = wp.constant(1)

# Status bits (warp_lcp.Status).
ITERATION_LIMIT = wp.constant(1)
RAY = wp.constant(2)
NOT_A_NUMBER = wp.constant(4)
OVERFLOW = wp.constant(8)
UNCERTIFIED = wp.constant(16)
RESTITUTION_REDUCED = wp.constant(32)

# Admissible friction of Coulomb's cone (Contacts.directions, kernels/friction.py).
DISC = wp.constant(1)
HELD = wp.constant(-1)  # no friction: three rows that take any impulse (kernels/joint_rows.py)

# Lanes of a block that works on one environment.
LANES = 32

# How a sliding contact is discretised (warp_lcp.Simulator, `sliding`). FACETS keeps the set it sticks with.
REGULARIZED = wp.constant(0)
ALIGNED = wp.constant(1)
FACETS = wp.constant(2)
CONE = wp.constant(3)  # Coulomb's: nothing to discretise

# How the coefficients of two materials become one (warp_lcp.Combine): the mean, or...
MIN = wp.constant(1)
MULTIPLY = wp.constant(2)
MAX = wp.constant(3)


@functools.cache
def scalar_types(real) -> SimpleNamespace:
    """Vector, matrix and bundle types over ``real``."""
    double = real is wp.float64
    vec2 = wp.vec2d if double else wp.vec2f
    vec3 = wp.vec3d if double else wp.vec3f
    mat33 = wp.mat33d if double else wp.mat33f
    quat = wp.quatd if double else wp.quatf
    transform = wp.transformd if double else wp.transformf
    spatial = wp.spatial_vectord if double else wp.spatial_vectorf
    vec4 = wp.vec4d if double else wp.vec4f
    vec5 = wp.types.vector(length=5, dtype=real)

    @wp.struct
    class Parameters:
        mass: wp.array2d(dtype=real)  # [1|E, B] kg
        inertia: wp.array2d(dtype=mat33)  # [1|E, B] about the centre of mass, body axes, kg m^2
        com: wp.array2d(dtype=vec3)  # [1|E, B] centre of mass, body frame, m
        friction: wp.array2d(dtype=vec2)  # [1|E, S] mu_s, mu_k
        contact: wp.array3d(dtype=real)  # [1|E, S, 5] k_n b_n k_t b_t v_s, NaN = Table 1 scaled
        gravity: wp.array(dtype=vec3)  # [1|E] m/s^2
        # What the rows of a pair's contacts are made of, derived from the above when it changes (kernels/contacts.py):
        pair_friction: wp.array2d(dtype=vec2)  # [1|E, P] mu_s, mu_k
        pair_contact: wp.array2d(dtype=vec5)  # [1|E, P] k_n b_n k_t b_t v_s

    @wp.struct
    class Topology:
        joint_type: wp.array(dtype=int)  # [B]
        movable: wp.array(dtype=int)  # [B] do forces move it?
        joint_pose: wp.array(dtype=transform)  # [B]
        q_start: wp.array(dtype=int)  # [B]
        v_start: wp.array(dtype=int)  # [B]
        shape_body: wp.array(dtype=int)  # [S] -1 = world
        shape_pose: wp.array(dtype=transform)  # [S] in the body frame
        shape_size: wp.array(dtype=vec3)  # [S] half extents | radius | semi-axes | capsule: radius, half length along z
        surface_velocity: wp.array(dtype=vec3)  # [S] shape frame, m/s
        pairs: wp.array2d(dtype=int)  # [P, 2]
        pair_body: wp.array(dtype=wp.vec2i)  # [P] bodies of the two shapes, -1 = world
        pair_slots: wp.array(dtype=int)  # [P + 1]
        slot_pair: wp.array(dtype=int)  # [C]

    @wp.struct
    class Bodies:
        pose: wp.array2d(dtype=transform)  # [E, B] body frame
        velocity: wp.array2d(dtype=spatial)  # [E, B] centre of mass, then angular
        com: wp.array2d(dtype=vec3)  # [E, B] centre of mass, world
        inv_mass: wp.array2d(dtype=real)  # [E, B] zero where forces do not move the body
        inv_inertia: wp.array2d(dtype=mat33)  # [E, B] world axes, zero likewise
        free_velocity: wp.array2d(dtype=spatial)  # [E, B] v + h M^-1 (f_a - c)
        bounds: wp.array2d(dtype=spatial)  # [E, S | 0] centre of a shape, reach along each axis (collide.py); 0 without pairs
        # Where no two free bodies can touch neither is there.
        hit: wp.array2d(dtype=real)  # [E, B | 0] speed that the body may take on in the step from what hits it, m/s
        alert: wp.array(dtype=real)  # [E | 0] fastest approach of what hits something in this step or the next, m/s; below 0 not known

    @wp.struct
    class Slots:
        point: wp.array2d(dtype=vec3)  # [E, C] world
        normal: wp.array2d(dtype=vec3)  # [E, C] from shape a to shape b
        gap: wp.array2d(dtype=real)  # [E, C] phi, m; huge where there is no point
        bend: wp.array2d(dtype=real)  # [E, C] gap that the motion ahead leaves, less phi + h u_n, m
        feature: wp.array2d(dtype=int)  # [E, C] which features touch
        # History, one step old:
        last_feature: wp.array2d(dtype=int)  # [E, C] -1 = was not in contact
        last_impulse: wp.array2d(dtype=real)  # [E, C] h lambda_n, N s
        last_bristle: wp.array2d(dtype=vec3)  # [E, C] lambda_t + b_t u_t of eq. 42, world, N

    @wp.struct
    class Contacts:
        room: int  # how many contacts there may be; what follows them are rows of joints
        count: wp.array(dtype=int)  # [E] rows of both
        slot: wp.array2d(dtype=int)  # [E, R] -1 - k: row k of the joints
        body: wp.array2d(dtype=wp.vec2i)  # [E, R] a, b; -1 = world
        point: wp.array2d(dtype=vec3)  # [E, R] world
        gap: wp.array2d(dtype=real)  # [E, R]
        closed: wp.array2d(dtype=int)  # [E, R] 1 where the surfaces touch, 0 where a gap may close within the step
        frame: wp.array2d(dtype=mat33)  # [E, R] rows n, t1, t2
        inv_mass: wp.array2d(dtype=vec3)  # [E, R] diagonal of W = J M^-1 J^T, 1/kg
        relaxation: wp.array2d(dtype=vec3)  # [E, R] epsilon, 1/kg
        shift: wp.array2d(dtype=vec3)  # [E, R] d, m/s
        free: wp.array2d(dtype=vec3)  # [E, R] J v_free + d (+ moving surfaces), m/s
        mu: wp.array2d(dtype=vec2)  # [E, R] friction coefficient along t1, t2
        bound: wp.array2d(dtype=vec2)  # [E, R] part of the friction limit that the normal impulse does not change, N s
        directions: wp.array2d(dtype=int)  # [E, R] admissible friction: 0 none, 1 disc, k facets around it, -k within (friction.py)
        slip: wp.array2d(dtype=vec3)  # [E, R | 0] direction (s_1, s_2) and lateral relaxation of a contact that slides on the cone
        damping: wp.array2d(dtype=real)  # [E, R] b_t, N s/m
        impulse: wp.array2d(dtype=vec3)  # [E, R] h lambda in the contact frame, N s
        best_impulse: wp.array2d(dtype=vec3)  # [E, R] likewise, of the best uncertified answer so far
        velocity: wp.array2d(dtype=vec3)  # [E, R] u+ in the contact frame, m/s
        state: wp.array2d(dtype=int)  # [E, R] open, stick, slide

    return SimpleNamespace(
        real=real,
        vec2=vec2,
        vec3=vec3,
        vec4=vec4,
        vec5=vec5,
        mat33=mat33,
        quat=quat,
        transform=transform,
        spatial=spatial,
        Parameters=Parameters,
        Topology=Topology,
        Bodies=Bodies,
        Slots=Slots,
        Contacts=Contacts,
    )


@wp.func_native(snippet="WP_TILE_SYNC();")
def sync():
    """Barrier of the block that works on one environment."""
    ...
