# SPDX-License-Identifier: Apache-2.0
"""Kinematics, mass matrix M and bias c of robots read from USD, beside MuJoCo's at the same states.

MuJoCo gets the robot as MJCF written from our Model, so that what agrees are the kernels; that the Model is what the file says
is compared with what others read in it: bodies, degrees of freedom and total mass.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

import warp_lcp as wl

from . import peers, robots

STATES = 100
#: Largest difference that counts as agreement, as a part of the norm of what is compared.
AGREES = 1e-10
#: Bodies, degrees of freedom and total mass [kg] in these files as Newton reads them (README of shared/usd), freedom by joint types.
KNOWN = {
    "converted/go1/go1.usda": (13, 18, 12.74),
    "converted/gym_ant/ant.usda": (13, 14, 0.9109),
    "converted/quadruped_urdf/quadruped.usda": (13, 12, 30.7),  # its base is fixed
    "newton/ex_ant.usda": (9, 14, 0.1822),
    "newton/ex_humanoid.usda": (16, 27, 40.84),
}
MUJOCO = Path(peers.__file__).parent / "adapters" / "mujoco_dynamics.py"


def theirs(robot: robots.Robot, peer: peers.Peer, folder: Path) -> dict[str, np.ndarray]:
    """What MuJoCo makes of a robot's states: see adapters/mujoco_dynamics.py."""
    with tempfile.TemporaryDirectory() as work:
        job, result = Path(work, "job.npz"), Path(work, "result.npz")
        robot.save(job)
        subprocess.run([str(peer.python(folder)), str(MUJOCO), str(job), str(result)], check=True, env=peer.environment(folder))
        with np.load(result) as arrays:
            return dict(arrays)


def ours(robot: robots.Robot) -> dict[str, np.ndarray]:
    """The same by a Simulator, in float64."""
    sim = robot.simulator(device="cpu")
    mass, bias = sim.mass_matrix().numpy(), sim.bias().numpy()
    return {"pose": sim.body_pose.numpy(), "velocity": sim.body_velocity.numpy(), "mass": mass, "bias": bias}


def differences(mine: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest over the states, each a part of the norm of what it should be in that state.

    Of all positions [m], turns (unit quaternions, up to their sign), velocities of bodies [m/s and rad/s], M_ij over the root of
    M_ii M_jj, and c_i over the root of M_ii, so that neither units nor heavy bodies hide anything.
    """
    sign = np.sign((mine["pose"][..., 3:] * other["pose"][..., 3:]).sum(axis=-1, keepdims=True))
    scale = 1.0 / np.sqrt(np.diagonal(other["mass"], axis1=1, axis2=2))
    square = scale[:, :, None] * scale[:, None, :]
    pairs = {
        "position": (mine["pose"][..., :3], other["pose"][..., :3]),
        "turn": (mine["pose"][..., 3:], sign * other["pose"][..., 3:]),
        "velocity": (mine["velocity"], other["velocity"]),
        "mass_matrix": (square * mine["mass"], square * other["mass"]),
        "bias": (scale * mine["bias"], scale * other["bias"]),
    }
    found = {}
    for name, (a, b) in pairs.items():
        a, b = a.reshape(len(a), -1), b.reshape(len(b), -1)
        found[name] = float((np.linalg.norm(a - b, axis=1) / np.linalg.norm(b, axis=1)).max())
    return found


def measure(quick: bool, folder: Path, usd: Path = robots.USD, names: Collection[str] = tuple(KNOWN)) -> dict[str, Any]:
    """A row for each of these files that loads, and why the others do not.

    Raises:
        FileNotFoundError: without the files or without MuJoCo's interpreter.
    """
    peer, rows, absent = peers.PEERS["mujoco"], [], {}
    if not usd.is_dir():
        raise FileNotFoundError(f"no robots: {usd} does not exist")
    if not peer.installed(folder):
        raise FileNotFoundError(peers.split([peer.name], folder)[1])
    for name in names:
        bodies, dofs, mass = KNOWN[name]
        try:
            model = robots.load(usd / name)
        except wl.SceneError as error:
            absent[name] = str(error).replace(str(usd / name), name)
            continue
        states = robots.random_states(model, 10 if quick else STATES, seed=0)
        robot = robots.Robot(name, model, 1e-3, 0, *states)
        other = theirs(robot, peer, folder)
        rows.append(
            {
                "file": name,
                "states": robot.envs,
                "mujoco": str(other["version"]),
                "bodies": model.num_bodies,
                "dofs": model.dofs,
                "mass": float(model.mass.sum()),
                "known": {"bodies": bodies, "dofs": dofs, "mass": mass},
                "mass_mujoco": float(other["total_mass"]),
                "condition": float(np.linalg.cond(other["mass"]).max()),
                **differences(ours(robot), other),
            }
        )
    return {"rows": rows, "absent": absent}


def problems(row: dict[str, Any]) -> list[str]:
    """What does not agree."""
    known = row["known"]
    found = [f"{name} {row[name]:.1e}" for name in ("position", "turn", "velocity", "mass_matrix", "bias") if not row[name] < AGREES]
    found += [f"{name} {row[name]}, known: {known[name]}" for name in ("bodies", "dofs") if row[name] != known[name]]
    if abs(row["mass"] / known["mass"] - 1.0) > 1e-3:
        found.append(f"mass {row['mass']:.5g} kg, known: {known['mass']} kg")
    return found


def markdown(data: dict[str, Any]) -> str:
    """One line for each robot, then the files that do not load."""
    lines = [
        "| robot | bodies, dofs, kg (known) | states | position | turn | velocity | M | c | cond M | agrees to 1e-10 |",
        "|" + " --- |" * 10,
    ]
    for row in data["rows"]:
        known, found = row["known"], problems(row)
        parts = " | ".join(f"{row[name]:.1e}" for name in ("position", "turn", "velocity", "mass_matrix", "bias"))
        lines.append(
            f"| {row['file']} | {row['bodies']}, {row['dofs']}, {row['mass']:.5g} ({known['bodies']}, {known['dofs']}, {known['mass']}) "
            f"| {row['states']} | {parts} | {row['condition']:.1e} | {'NO: ' + '; '.join(found) if found else 'yes'} |"
        )
    return "\n".join(lines + [f"\nleft out: {why.splitlines()[0][:200]}" for why in data["absent"].values()])
