# SPDX-License-Identifier: Apache-2.0
"""Joints by their names, shapes of contacts, and what is written to drives."""

import numpy as np
import pytest
from conftest import DEVICE, paper_box, simulator
from test_joints import SMALL, slider

import warp_lcp as wl
from warp_lcp.model import Drive, JointType


def arm_and_ball() -> wl.Model:
    """A free body, a ball joint on it, and a joint with three axes of which two have names of their own."""
    builder = wl.ModelBuilder()
    for name in ("base", "upper", "lower"):
        builder.add_body(name, mass=1.0, inertia=SMALL)
    builder.add_joint(JointType.SPHERICAL, 0, 1, name="/robot/left/shoulder")
    builder.add_joint(JointType.D6, 1, 2, axes=("tx", "ry", "rz"), name="/robot/left/wrist", axis_names=("/r/out", "/r/flex", "/l/flex"))
    return builder.finalize()


def test_joints_by_name():
    """Each name moves the coordinates that it says, and no others."""
    model = arm_and_ball()
    found = {
        name: (model.coordinates(name), model.velocities(name)) for name in ("base", "shoulder", "/robot/left/wrist", "out", "/l/flex")
    }
    assert found == {
        "base": (slice(0, 7), slice(0, 6)),
        "shoulder": (slice(7, 11), slice(6, 9)),
        "/robot/left/wrist": (slice(11, 14), slice(9, 12)),
        "out": (slice(11, 12), slice(9, 10)),
        "/l/flex": (slice(13, 14), slice(11, 12)),
    }
    sim = wl.Simulator(model, dt=1e-3, device=DEVICE)
    for name in ("shoulder", "out", "/l/flex"):
        q, v = found[name]
        sim.reset()
        sim.v.assign(np.eye(model.nv)[v.start][None])
        sim.step()
        changed = np.flatnonzero(np.abs(sim.q.numpy()[0] - model.q0) > 1e-4)
        assert set(changed) <= set(range(q.start, q.stop))
        assert len(changed) == 1
    for name, message in (
        ("flex", "flex: there are /r/flex of lower, /l/flex of lower; give a name that one alone has"),
        ("shulder", "did you mean /robot/left/shoulder"),
        ("x", "there are base, "),
    ):
        with pytest.raises(wl.ModelError, match=message):
            model.velocities(name)


def test_names_that_are_not_one_joint():
    """A joint called as a body is, one without coordinates, one that closes a loop, and axes of a ball, which share a quaternion."""
    builder = wl.ModelBuilder()
    for name in ("base", "arm", "plate", "far"):
        builder.add_body(name, mass=1.0, inertia=SMALL)
    builder.add_joint(JointType.SPHERICAL, 0, 1, name="base", axis_names=("a", "b", "c"))
    builder.add_joint(JointType.FIXED, 0, 2, name="weld")
    builder.add_joint(JointType.REVOLUTE, 1, 2, name="last", loop=True)
    builder.add_joint(JointType.REVOLUTE, 0, 3, name="joint5")
    builder.add_joint(JointType.REVOLUTE, 3, 1, loop=True)  # called joint4
    builder.add_joint(JointType.REVOLUTE, 3, 2, loop=True)  # joint5 is taken
    model = builder.finalize()
    assert (model.velocities("b"), model.coordinates("b")) == (slice(7, 8), slice(7, 11))
    assert [loop.name for loop in model.loops] == ["last", "joint4", "joint6"]
    for name, message in (
        ("base", "base: there are base of base, base of arm; give a name"),
        ("weld", "it has no coordinates"),
        ("last", "it has no coordinates"),
    ):
        with pytest.raises(wl.ModelError, match=message):
            model.coordinates(name)


def test_shapes_of_contacts():
    """Two spheres on one body: which of them touches?"""
    builder = wl.ModelBuilder()
    ground = builder.add_plane()
    body = builder.add_body(pose=(0, 0, 0.1, 0, 0, 0, 1))
    builder.add_sphere(body, 0.1, pose=(0, 0, 0.5, 0, 0, 0, 1))
    low = builder.add_sphere(body, 0.1)
    sim = simulator(builder, dt=1e-3)
    sim.step()
    assert sim.contacts.count.numpy()[0] == 1
    assert sim.model.slot_shapes[sim.contacts.slot.numpy()[0, 0]].tolist() == [ground, low]


def test_control_is_checked_where_it_is_set():
    builder = slider(drive=Drive(100.0, 10.0))
    sim = simulator(builder, num_envs=3, dt=1e-3)
    sim.set_control(position=[0.25], force=np.array([[1.0], [2.0], [3.0]]))
    assert sim.control.position.numpy().tolist() == [[0.25]] * 3
    assert sim.control.force.numpy().tolist() == [[1.0], [2.0], [3.0]]
    sim.set_control(force=0.5)
    assert sim.control.force.numpy().tolist() == [[0.5]] * 3
    for values, message in (
        ({"position": [1.0, 2.0]}, r"position has shape \(2,\); give \(1,\) or \(3, 1\)"),
        ({"position": [np.nan]}, "position.* is nan; it must be finite"),
        ({"torque": [1.0]}, "'torque' is nothing of it; choose from position, velocity, force"),
    ):
        with pytest.raises(wl.WarpLcpError, match=message):
            sim.set_control(**values)
    with pytest.raises(wl.WarpLcpError, match="velocity has shape"):
        sim.set_control(position=[0.75], velocity=[1.0, 2.0])
    assert sim.control.position.numpy().tolist() == [[0.25]] * 3  # nothing of it was written
    with pytest.raises(wl.WarpLcpError, match="the model has none"):
        simulator(paper_box(), dt=1e-3).set_control(position=0.0)


@pytest.mark.parametrize("field", ["position", "velocity"])
@pytest.mark.parametrize("most", [5.0, np.inf])
def test_a_target_that_is_no_number_is_flagged(field, most):
    """Also where the force of the drive is limited, to which a comparison would cut what is not a number."""
    sim = simulator(slider(drive=Drive(100.0, 10.0, most)), num_envs=2, dt=1e-3)
    getattr(sim.control, field).assign(np.array([[np.nan], [0.0]]))
    sim.step()
    assert sim.status.numpy().tolist() == [wl.Status.NOT_A_NUMBER, 0]


def test_bodies_that_hang_rigidly_on_each_other_are_as_one_body_to_touch():
    """Two arms welded to a base touch neither it nor each other; a hand on a hinge of one of them passes through all three,
    fingers beyond it do not. Where the base is fixed in the world, the hand touches what it is not joined to itself."""

    def pairs(joint: JointType, collide: bool = False) -> list[list[int]]:
        builder = wl.ModelBuilder()
        for kind in (joint, *(JointType.FREE,) * 4):
            builder.add_sphere(builder.add_body(joint=kind), 0.1)
        builder.add_joint(JointType.FIXED, 0, 1, collide=True)
        builder.add_joint(JointType.FIXED, 0, 2)
        builder.add_joint(JointType.REVOLUTE, 2, 3, collide=collide)
        builder.add_joint(JointType.REVOLUTE, 3, 4)
        model = builder.finalize()
        return sorted(sorted(pair) for pair in model.shape_body[model.pairs].tolist())

    fingers = [[0, 4], [1, 4], [2, 4]]
    assert pairs(JointType.FREE) == fingers
    assert pairs(JointType.FREE, collide=True) == sorted([*fingers, [0, 3], [1, 3], [2, 3]])
    assert pairs(JointType.FIXED) == sorted([*fingers, [0, 3], [1, 3]])
