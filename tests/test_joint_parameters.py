# SPDX-License-Identifier: Apache-2.0
"""Parameters of joints that differ between environments, against models that have them from the start."""

import numpy as np
import pytest
from conftest import simulator

import warp_lcp as wl
from warp_lcp.model import JointType


def driven_pair(**changed) -> wl.Model:
    """Two links, the first with a drive of unlimited force, the second with one of limited force, limits and dry friction."""
    numbers = {
        "armature": (0.1, 0.2),
        "damping": (0.05, 0.02),
        "joint_friction": (0.0, 0.3),
        "gains": ((20.0, 1.0, np.inf), (15.0, 0.5, 4.0)),
    }
    numbers |= changed
    b = wl.ModelBuilder()
    first, second = (b.add_body(pose=(x, 0, 0, 0, 0, 0, 1), mass=1.0, inertia=0.1 * np.eye(3)) for x in (0.5, 1.5))
    for k, (parent, child, at) in enumerate(((-1, first, 0.0), (first, second, 0.5))):
        b.add_joint(
            JointType.REVOLUTE,
            parent,
            child,
            parent_frame=(at, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)),
            child_frame=(-0.5, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)),
            armature=numbers["armature"][k],
            damping=numbers["damping"][k],
            friction=numbers["joint_friction"][k],
            limit=(-1.0, 1.0) if k else None,
            drive=wl.Drive(*numbers["gains"][k], target=0.4),
        )
    return b.finalize()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("armature", (0.5, 0.0)),
        ("damping", (0.0, 0.4)),
        ("joint_friction", (0.0, 1.5)),
        ("gains", ((60.0, 3.0, np.inf), (5.0, 2.0, 1.0))),
        ("gains", ((0.0, 0.0, np.inf), (0.0, 0.0, 1.0))),
    ],
)
def test_joint_parameters_of_an_environment_are_those_of_a_model_with_them(name, value):
    """To the bit; the environment beside it, which keeps the model's, too."""
    model = driven_pair()
    sim = simulator(model, num_envs=2)
    sim.step(3)
    sim.reset()
    sim.set_parameters(**{name: np.stack([np.array(getattr(model, name)), np.array(value)])})
    sim.step(300)
    for env, changed in enumerate(({}, {name: value})):
        alone = simulator(driven_pair(**changed))
        alone.step(300)
        assert sim.q.numpy()[env].tolist() == alone.q.numpy()[0].tolist()
    assert np.abs(np.diff(sim.q.numpy(), axis=0)).max() > 1e-3


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("armature", (-0.1, 0.0), "armature.*not negative"),
        ("joint_friction", (0.1, 0.1), "neither dry friction"),
        ("gains", ((1.0, 1.0, 5.0), (1.0, 1.0, 5.0)), "infinite just where"),
        ("gains", ((1.0, 1.0, np.inf), (np.inf, 1.0, 5.0)), "finite"),
    ],
)
def test_joint_parameters_that_are_none(name, value, message):
    with pytest.raises(wl.WarpLcpError, match=message):
        simulator(driven_pair()).set_parameters(**{name: np.array(value)})


def test_gains_need_a_drive():
    """A joint without one, whose greatest force is infinite like that of many drives, takes none; zero, which it has, it takes."""
    b = wl.ModelBuilder()
    b.add_joint(JointType.PRISMATIC, -1, b.add_body(mass=1.0, inertia=np.eye(3)), name="slide")
    sim = simulator(b)
    sim.set_parameters(gains=sim.model.gains)
    with pytest.raises(wl.WarpLcpError, match=r"gains\[0, 0, 0\] \(slide\) is 10.*zero without a drive"):
        sim.set_parameters(gains=[[10.0, 1.0, np.inf]])


def test_joint_parameters_need_joints():
    b = wl.ModelBuilder()
    b.add_sphere(b.add_body(), 0.1)
    with pytest.raises(wl.WarpLcpError, match="is of joints, and the model has none"):
        simulator(b).set_parameters(armature=np.zeros(6))
