# SPDX-License-Identifier: Apache-2.0
"""Model and ModelBuilder: mass properties, pairs, coordinates, errors."""

import numpy as np
import pytest
from conftest import paper_box

import warp_lcp as wl


def test_mass_properties_follow_from_shapes():
    """A dumbbell of a box and a sphere: parallel-axis theorem by hand."""
    builder = wl.ModelBuilder()
    body = builder.add_body()
    builder.add_box(body, (0.1, 0.2, 0.3), density=500, pose=(1, 0, 0, 0, 0, 0, 1))
    builder.add_sphere(body, 0.2, density=2000, pose=(-1, 0, 0, 0, 0, 0, 1))
    model = builder.finalize()
    box, ball = 500 * 0.2 * 0.4 * 0.6, 2000 * 4 / 3 * np.pi * 0.2**3
    com = (box - ball) / (box + ball)
    assert model.mass[0] == pytest.approx(box + ball)
    assert model.com[0] == pytest.approx([com, 0, 0])
    around = box * (1 - com) ** 2 + ball * (1 + com) ** 2
    expected = [
        box / 12 * (0.4**2 + 0.6**2) + 0.4 * ball * 0.2**2,
        box / 12 * (0.2**2 + 0.6**2) + 0.4 * ball * 0.2**2 + around,
        box / 12 * (0.2**2 + 0.4**2) + 0.4 * ball * 0.2**2 + around,
    ]
    assert model.inertia[0] == pytest.approx(np.diag(expected), abs=1e-12)


def test_a_capsule_is_solid():
    """Volume and inertia against sums over 400 x 400 rings of its profile: the midpoint rule is good to 1e-5 here."""
    radius, half, n = 0.3, 0.5, 400
    builder = wl.ModelBuilder()
    builder.add_capsule(builder.add_body(), radius, half, density=700)
    model = builder.finalize()
    z = (np.arange(n) + 0.5) / n * (half + radius)  # the upper half; the lower one is its mirror image
    width = np.sqrt(radius**2 - np.maximum(z - half, 0) ** 2)
    r = (np.arange(n)[:, None] + 0.5) / n * width
    mass = 700 * 2 * (2 * np.pi * r) * (width / n) * (half + radius) / n
    assert model.mass[0] == pytest.approx(mass.sum(), rel=1e-5)
    across = (mass * (0.5 * r**2 + z**2)).sum()
    assert model.inertia[0] == pytest.approx(np.diag([across, across, (mass * r**2).sum()]), rel=1e-5, abs=1e-12)
    assert model.com[0] == pytest.approx(np.zeros(3), abs=1e-15)


def test_explicit_mass_scales_the_inertia_and_explicit_inertia_wins():
    def box(**given):
        builder = wl.ModelBuilder()
        builder.add_box(builder.add_body(**given), (0.5, 0.5, 0.5))
        return builder.finalize()

    assert box(mass=3.0).inertia[0] == pytest.approx(np.eye(3) * 3 / 6)
    assert box(mass=3.0, inertia=np.eye(3)).inertia[0] == pytest.approx(np.eye(3))
    assert box(inertia=np.eye(3)).mass[0] == 1000


def test_a_turned_shape_turns_its_inertia():
    builder = wl.ModelBuilder()
    half = np.sqrt(0.5)
    builder.add_box(builder.add_body(mass=12.0), (0.5, 1.0, 1.5), pose=(0, 0, 0, 0, 0, half, half))  # 90 degrees about z
    assert np.diag(builder.finalize().inertia[0]) == pytest.approx([1 + 9, 4 + 9, 1 + 4])


def test_pairs_are_decided_at_load():
    """No pair for the same body, two immovable ones, filtered ones, or shapes that cannot meet."""
    builder = wl.ModelBuilder()
    plane = builder.add_plane()
    wall = builder.add_box(-1, (1, 1, 1))
    belt = builder.add_box(builder.add_body("belt", joint=wl.JointType.KINEMATIC), (1, 1, 1))
    shelf = builder.add_box(builder.add_body("shelf", joint=wl.JointType.FIXED), (1, 1, 1))
    body = builder.add_body("body")
    box, ball = builder.add_box(body, (1, 1, 1)), builder.add_sphere(body, 1.0)
    other = builder.add_sphere(builder.add_body("other"), 1.0)
    builder.filter_pair(other, wall)
    model = builder.finalize()
    expected = {(plane, ball), (plane, other), (plane, box), (ball, other), (other, box), (other, belt), (other, shelf)}
    expected |= {(ball, wall), (ball, belt), (ball, shelf), (wall, box), (belt, box), (shelf, box)}
    assert set(map(tuple, model.pairs)) == expected
    assert model.num_slots == 8 * 4 + 9
    assert model.max_contacts == model.num_slots
    assert (model.nq, model.nv, model.dofs) == (21, 18, 12)


def test_only_the_kernels_that_a_scene_needs():
    """A box on a plane compiles no box against box, no sphere, no capsule, and no solver for several bodies."""
    from warp_lcp.stages import kernel_names

    names = kernel_names(paper_box())
    assert "plane_box" in names
    assert "solve_single" in names
    assert not {"box_box", "plane_sphere", "sphere_box", "sphere_sphere", "pivot", "contact_rows"} & set(names)
    assert not any("capsule" in name for name in names)


def test_capsules_meet_every_shape():
    """Pairs of a capsule put it second; each kind has its slots, and only kinds that are there get a kernel."""
    from warp_lcp.stages import kernel_names

    builder = wl.ModelBuilder()
    capsule = builder.add_capsule(builder.add_body(), 0.1, 0.2)
    plane, box = builder.add_plane(), builder.add_box(-1, (1, 1, 1))
    ball = builder.add_sphere(builder.add_body(), 0.1)
    other = builder.add_capsule(-1, 0.1, 0.2)
    builder.filter_pair(ball, plane)
    builder.filter_pair(ball, box)
    model = builder.finalize()
    slots = dict(zip(map(tuple, model.pairs.tolist()), np.diff(model.pair_slots).tolist(), strict=True))
    assert slots == {(plane, capsule): 2, (ball, capsule): 1, (ball, other): 1, (box, capsule): 3, (capsule, other): 3}
    pairs = {"plane_capsule", "sphere_capsule", "box_capsule", "capsule_capsule"}
    assert {name for name in kernel_names(model) if "capsule" in name or "sphere" in name or "box" in name} == pairs


def test_a_model_cannot_be_changed():
    model = paper_box()
    with pytest.raises(ValueError, match="read-only"):
        model.mass[0] = 2
    with pytest.raises(AttributeError):
        model.mass = np.ones(1)


@pytest.mark.parametrize(
    ("author", "message"),
    [
        (lambda b: (b.add_body("a", mass=0.0), b.finalize()), "a: mass is 0 kg; only what hangs on a joint"),
        (lambda b: b.add_body("a", mass=-1.0), "a: mass is -1.0 kg; it must be finite and greater than zero"),
        (lambda b: b.add_body("a", velocity=(np.nan, 0, 0)), "a: velocity is .* every number must be finite"),
        (lambda b: b.add_body("a", pose=(0, 0, 0, 0, 0, 0, 2)), "a: the quaternion .* has length 2; give a unit quaternion"),
        (lambda b: b.add_body("a", pose=(0, 0, 0)), r"a: pose has shape \(3,\); give 7 numbers"),
        (lambda b: b.add_body("a", inertia=np.diag([1, 1, 3])), "a: principal moments .* break the triangle inequality"),
        (lambda b: b.add_body("a", inertia=np.diag([1, 1, -1])), "a: principal moments .* must be greater than zero"),
        (lambda b: (b.add_body("a"), b.add_body("a")), "a: a body of this name exists already"),
        (lambda b: b.add_box(0, (1, 1, 1)), "body 0 does not exist"),
        (lambda b: b.add_box(-1, (1, 1)), "half_extents has 2 numbers; give 3"),
        (lambda b: b.add_sphere(-1, -1.0), "sphere: radius is -1.0 m"),
        (lambda b: b.add_capsule(-1, 0.0, 1.0), "capsule: radius is 0.0 m"),
        (lambda b: b.add_capsule(-1, 1.0, np.inf), "capsule: half length is inf m"),
        (lambda b: b.add_plane(b.add_body("a")), "a plane is infinite and cannot move freely"),
        (lambda b: b.add_box(-1, (1, 1, 1), material=wl.Material(0.1, 0.5)), "dynamic friction 0.5 exceeds static friction 0.1"),
        (lambda b: b.add_box(-1, (1, 1, 1), material=wl.Material(normal_damping=0.0)), "normal_damping is 0.0"),
        (lambda b: (b.add_body("a"), b.finalize()), "a: mass is unknown"),
        (lambda b: (b.add_plane(), b.finalize()), "nothing can move"),
    ],
)
def test_bad_input_names_the_culprit(author, message):
    with pytest.raises(wl.ModelError, match=message):
        author(wl.ModelBuilder())
