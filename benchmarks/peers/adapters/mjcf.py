# SPDX-License-Identifier: Apache-2.0
"""The scene as MJCF, and states as MuJoCo's qpos and qvel; shared by the adapters of MuJoCo and MuJoCo Warp. Needs numpy alone.

A free joint has here the pose of the body frame for coordinates, and the velocity of the centre of mass and the angular velocity,
both in world axes; MuJoCo takes the velocity of the body frame's origin in world axes and the angular velocity in the body's own. So

    qvel = B(q) v:   v_origin = v_com - w x R c,   w_own = R^T w   (c: centre of mass in the body frame, R: of the body)

and B is the identity elsewhere, but for the axes of a ball. M' and c' of M' dqvel/dt + c' = f' become

    M = B^T M' B,   c = B^T (c' + M' dB/dt v),   dB/dt v = -w x (w x R c) for the velocity of a free body's origin, 0 elsewhere.
"""

from __future__ import annotations

import numpy as np
from protocol import Job, Refused, Tree, closure

#: Settings that are attributes of <option>.
OPTIONS = ("integrator", "cone", "impratio", "iterations", "tolerance", "noslip_iterations", "noslip_tolerance", "solver")
# warp_lcp.JointType and DofKind
FREE, KINEMATIC, SPHERICAL = 0, 1, 5
LINEAR, BALL_ON = 0, 3


def numbers(values: np.ndarray) -> str:
    """For an XML attribute, without loss."""
    return " ".join(repr(float(value)) for value in values)


def place(pose: np.ndarray) -> str:
    """Attributes of a pose."""
    return f'pos="{numbers(pose[:3])}" quat="{numbers(np.roll(pose[3:], 1))}"'


def model(job: Job) -> str:
    """MJCF of one environment. Bodies have the name b<index>, joints come in the order of their coordinates.

    Settings: those of OPTIONS, and time_constant_steps, the time constant of contacts, limits and loops in steps (absent: 20 ms).
    """
    if job.restitution:
        raise Refused("MuJoCo has no coefficient of restitution")
    steps = job.settings.get("time_constant_steps")
    spring = f'solref="{steps * job.dt} 1"' if steps else ""
    surface = f'condim="3" friction="{job.friction} 0.005 0.0001" {spring}'
    stops = f"<default><joint {spring.replace('solref', 'solreflimit')}/></default>" if steps and job.tree is not None else ""
    geoms: dict[int, str] = dict.fromkeys(range(-1, len(job.mass)), "")
    for kind, body, size, pose in zip(job.shape_kind, job.shape_body, job.shape_size, job.shape_pose, strict=True):
        extent = numbers({"plane": np.array([0.0, 0.0, 1.0]), "box": size, "sphere": size[:1]}.get(kind, size[:2]))
        geoms[body] += f'<geom type="{kind}" size="{extent}" {place(pose)} {surface}/>'
    closed = ""
    for i, (kind, bodies, poses) in enumerate([] if job.tree is None else closures(job.tree)):
        for side, body, pose in zip("ab", bodies, poses, strict=True):
            geoms[body] += f'<site name="{side}{i}" {place(pose)}/>'
        closed += f'<{kind} site1="a{i}" site2="b{i}" {spring}/>'
    children: dict[int, list[int]] = {}
    for body in range(len(job.mass)):
        children.setdefault(-1 if job.tree is None else int(job.tree.body_parent[body]), []).append(body)

    def nested(parent: int) -> str:
        return "".join(
            f'<body name="b{body}" {place(rest(job.tree, body))}>{joints(job.tree, body)}{inertial(job, body)}'
            f"{geoms[body]}{nested(body)}</body>"
            for body in children.get(parent, [])
        )

    drives = actuators(job.tree)
    # Actuators' damping is implicit with this rule alone, joints' with Euler's, MuJoCo's default, too.
    rule = {"integrator": "implicitfast"} if drives else {}
    options = " ".join(f'{key}="{value}"' for key, value in (rule | {k: job.settings[k] for k in OPTIONS if k in job.settings}).items())
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{job.dt}" gravity="{numbers(job.gravity)}" {options}>'
        f'<flag filterparent="disable"/></option>{stops}<worldbody>{geoms[-1]}{nested(-1)}</worldbody>{excluded(job)}{drives}'
        + (f"<equality>{closed}</equality></mujoco>" if closed else "</mujoco>")
    )


def rest(tree: Tree | None, body: int) -> np.ndarray:
    """Pose of a body in its parent's frame where its joint's coordinates are zero."""
    if tree is None or tree.joint_type[body] == FREE:
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    on_parent, on_child = tree.joint_pose[body], tree.joint_child_pose[body]
    turn = product(on_parent[3:], on_child[3:] * [-1, -1, -1, 1])
    return np.concatenate([on_parent[:3] - rotate(turn, on_child[:3]), turn])


def inertial(job: Job, body: int) -> str:
    """A body's mass, centre of mass and inertia."""
    mass, inertia = float(job.mass[body]), job.inertia[body]
    if inertia.ndim == 1:
        return f'<inertial pos="0 0 0" mass="{mass!r}" diaginertia="{numbers(inertia)}"/>'
    assert job.tree is not None
    # Principal axes found here: MuJoCo's own, of a full matrix, are off by up to 1e-10 of it.
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    where = place(np.concatenate([job.tree.com[body], quaternion(axes)]))
    return f'<inertial {where} mass="{mass!r}" diaginertia="{numbers(moments)}"/>'


def joints(tree: Tree | None, body: int) -> str:
    """The joint above a body: one of MuJoCo's for each of its coordinates. Drives are springs and dampers, or actuators."""
    if tree is None or tree.joint_type[body] == FREE:
        return "<freejoint/>"
    if tree.joint_type[body] == KINEMATIC:
        raise Refused("kinematic bodies are not written")
    found, frame = "", tree.joint_child_pose[body]
    for i in np.flatnonzero(tree.dof_body == body):
        if tree.dof_kind[i] == BALL_ON:
            continue
        stiffness, damping, _, target, _ = tree.drive[i].tolist() if is_spring(tree.drive[i]) else (0.0, 0.0, 0.0, 0.0, 0.0)
        kind = "ball" if tree.joint_type[body] == SPHERICAL else "slide" if tree.dof_kind[i] == LINEAR else "hinge"
        if kind == "ball" and any(np.ptp(values[i : i + 3]) for values in (tree.armature, tree.damping, tree.joint_friction)):
            raise Refused("a ball has one armature, damping and friction for all its axes")
        values = {"armature": tree.armature[i], "damping": tree.damping[i] + damping, "frictionloss": tree.joint_friction[i]}
        found += f'<joint name="j{i}" type="{kind}" pos="{numbers(frame[:3])}" '
        if kind != "ball":
            values |= {"stiffness": stiffness, "springref": target}
            found += f'axis="{numbers(rotate(frame[3:], tree.dof_axis[i]))}" '
            if np.isfinite(tree.limit[i]).any():
                ends = np.clip(tree.limit[i], -1e9, 1e9) + (tree.limit[i, 0] == tree.limit[i, 1]) * np.array([-1e-9, 1e-9])
                found += f'limited="true" range="{numbers(ends)}" '  # of some width: MuJoCo takes no other
        found += " ".join(f'{name}="{float(value)!r}"' for name, value in values.items()) + "/>"
    return found


def is_spring(drive: np.ndarray) -> bool:
    """Is a drive (stiffness, damping, force, target, target velocity) a spring and a damper, to be had with the joint?"""
    return bool(np.isinf(drive[2]) and not drive[4])


def actuators(tree: Tree | None) -> str:
    """Drives of limited force, or with a target velocity: of a constant, the coordinate and its rate; none reads a control."""
    lines = ""
    for i, drive in enumerate([] if tree is None else tree.drive):
        stiffness, damping, force, target, target_velocity = drive.tolist()
        if (stiffness or damping) and not is_spring(drive):
            limited = f'forcelimited="true" forcerange="{-force!r} {force!r}"' if np.isfinite(force) else ""
            bias = numbers(np.array([stiffness * target + damping * target_velocity, -stiffness, -damping]))
            lines += f'<general joint="j{i}" gaintype="fixed" gainprm="0" biastype="affine" biasprm="{bias}" {limited}/>'
    return f"<actuator>{lines}</actuator>" if lines else ""


def closures(tree: Tree) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """What closes a tree's loops: connect or weld, the bodies [2] and the poses [2, 7] in them that are held together.

    A hinge is a ball at either end of a piece of its axis, as long as its second body's centre of mass is away: there is none besides.
    """
    found = []
    for i, (bodies, frames) in enumerate(zip(tree.loop_bodies, tree.loop_frames, strict=True)):
        kind = closure(tree, i)
        if kind != "hinge":
            found.append(("weld" if kind == "weld" else "connect", bodies, frames))
            continue
        reach = np.linalg.norm(frames[1, :3] - (tree.com[bodies[1]] if bodies[1] >= 0 else 0.0)) or 0.1
        axis = np.where(tree.loop_turns[i], 0.0, 0.5 * reach)
        for side in (1.0, -1.0):
            ends = frames.copy()
            ends[:, :3] += side * rotate(frames[:, 3:], axis)
            found.append(("connect", bodies, ends))
    return found


def excluded(job: Job) -> str:
    """The bodies of a tree that pass through each other. MuJoCo's own rule, that parents and children do, is off."""
    if job.tree is None:
        return ""
    own, touching = job.shape_body, {frozenset(pair) for pair in job.tree.pairs.tolist()}
    may: dict[tuple[int, int], set[bool]] = {}
    for j in range(len(own)):
        for i in range(j):
            if own[i] != own[j]:
                a, b = sorted((own[i], own[j]))
                may.setdefault((a, b), set()).add(frozenset((i, j)) in touching)
    if any(len(found) > 1 for found in may.values()):
        raise Refused("two bodies touch with some of their shapes and not with others")
    names = {-1: "world"} | {b: f"b{b}" for b in range(len(job.mass))}
    lines = "".join(f'<exclude body1="{names[a]}" body2="{names[b]}"/>' for (a, b), found in may.items() if found == {False})
    return f"<contact>{lines}</contact>"


# --------------------------------------------------------------------------------------------------------------- states


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors turned by unit quaternions (x y z w)."""
    axis, w = quaternion[..., :3], quaternion[..., 3:]
    return vector + 2.0 * np.cross(axis, np.cross(axis, vector) + w * vector)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of quaternions (x y z w)."""
    vector = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    return np.concatenate([vector, a[..., 3:] * b[..., 3:] - (a[..., :3] * b[..., :3]).sum(axis=-1, keepdims=True)], axis=-1)


def matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3]."""
    return np.stack([rotate(quaternion, axis) for axis in np.eye(3)], axis=-1)


def quaternion(turn: np.ndarray) -> np.ndarray:
    """(x y z w) of a rotation matrix [3, 3]: the eigenvector of 1 of a 4 x 4 matrix that is linear in it (Bar-Itzhack 2000)."""
    skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    form = np.block([[turn + turn.T - np.trace(turn) * np.eye(3), skew[:, None]], [skew[None], np.array([[np.trace(turn)]])]]) / 3.0
    return np.linalg.eigh(form)[1][:, -1]


def to_mujoco(pose: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """qpos [E, 7 B] with the quaternion's w first, and qvel [E, 6 B] with the angular velocity in the body's own axes."""
    inverse = pose[..., 3:] * [-1, -1, -1, 1]
    qpos = np.concatenate([pose[..., :3], pose[..., 6:], pose[..., 3:6]], axis=-1)
    qvel = np.concatenate([velocity[..., :3], rotate(inverse, velocity[..., 3:])], axis=-1)
    return qpos.reshape(len(pose), -1), qvel.reshape(len(pose), -1)


def from_mujoco(qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose [..., B, 7] and velocity [..., B, 6] of arrays like to_mujoco's, [..., 7 B] and [..., 6 B]."""
    qpos, qvel = qpos.reshape(*qpos.shape[:-1], -1, 7), qvel.reshape(*qvel.shape[:-1], -1, 6)
    pose = np.concatenate([qpos[..., :3], qpos[..., 4:], qpos[..., 3:4]], axis=-1)
    return pose, np.concatenate([qvel[..., :3], rotate(pose[..., 3:], qvel[..., 3:])], axis=-1)


def depth_first(tree: Tree) -> list[int]:
    """Bodies in the order of MuJoCo's, which is that of the file."""
    order, stack = [], [-1]
    while stack:
        body = stack.pop()
        order.append(body)
        stack += np.flatnonzero(tree.body_parent == body)[::-1].tolist()
    return order[1:]


def coordinates(tree: Tree, q: np.ndarray) -> np.ndarray:
    """qpos [E, nq] of q [E, nq]."""
    parts = []
    for body in depth_first(tree):
        at, kind = tree.q_start[body], tree.joint_type[body]
        if kind == FREE:
            parts += [q[:, at : at + 3], np.roll(q[:, at + 3 : at + 7], 1, axis=1)]
        elif kind == SPHERICAL:  # MuJoCo's turns about the body's axes
            frame = tree.joint_child_pose[body, 3:]
            parts += [np.roll(product(product(frame, q[:, at : at + 4]), frame * [-1, -1, -1, 1]), 1, axis=1)]
        else:
            parts += [q[:, at : at + int(np.count_nonzero(tree.dof_body == body))]]
    return np.concatenate(parts, axis=1)


def velocity_map(tree: Tree, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """B [E, nv, nv] with qvel = B v, and dB/dt v [E, nv]."""
    jacobian, rate, row = np.zeros((*v.shape, v.shape[1])), np.zeros_like(v), 0
    for body in depth_first(tree):
        own, kind = np.flatnonzero(tree.dof_body == body), tree.joint_type[body]
        rows = row + np.arange(len(own))
        row += len(own)
        jacobian[:, rows, own] = 1.0
        if kind == FREE:
            turn = q[:, tree.q_start[body] + 3 : tree.q_start[body] + 7]
            arm, w = rotate(turn, tree.com[body]), v[:, own[3:]]
            jacobian[:, rows[:3, None], own[3:]] = np.cross(arm[:, None], np.eye(3)).swapaxes(1, 2)  # -w x arm, column by column
            jacobian[:, rows[3:, None], own[3:]] = matrix(turn).swapaxes(1, 2)
            rate[:, rows[:3]] = -np.cross(w, np.cross(w, arm))
        elif kind == SPHERICAL:
            jacobian[:, rows[:, None], own] = matrix(tree.joint_child_pose[body, 3:])
    return jacobian, rate
