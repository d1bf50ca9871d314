# SPDX-License-Identifier: Apache-2.0
"""Masses of UsdPhysics bodies: what is authored, what follows from colliders, and which comes first."""

import math
import sys

import numpy as np
import pytest
from test_usd import BOUND, COLLIDER, MASS, body, bound_cube, cube, load, material, prim, read, refused, xform

import warp_lcp as wl

DENSE = cube(content="float physics:density = 250;", apis=(COLLIDER, MASS))
HEAVY = cube(content="float physics:mass = 7;", apis=(COLLIDER, MASS))
OFF = cube("Off", "bool physics:collisionEnabled = 0; float physics:mass = 50;" + xform(translate="(3, 0, 0)"), (COLLIDER, MASS))


@pytest.mark.parametrize(
    ("content", "inner", "mass"),
    [
        ("", cube(), 1000.0),
        ("float physics:mass = 3;", cube(), 3.0),
        ("float physics:mass = 3;", HEAVY, 3.0),
        ("float physics:mass = 3; float physics:density = 9;", cube(), 3.0),
        ("", HEAVY, 7.0),
        ("float physics:density = 500;", cube(), 500.0),
        ("float physics:density = 500;", DENSE, 250.0),
        ("", bound_cube(), 400.0),
        ("", cube(content=BOUND + "float physics:density = 250;", apis=(COLLIDER, MASS, "MaterialBindingAPI")), 250.0),
        ("float physics:mass = 0;", cube(), 1000.0),
        ("", cube() + OFF, 1000.0),
    ],
    ids=["default", "body", "body-over-child", "mass-over-density", "child", "density", "child-density", "material",
         "density-over-material", "zero-is-unauthored", "disabled"],
)  # fmt: skip
def test_mass_precedence(content, inner, mass):
    model = load(material("float physics:density = 400;"), body(content=content, inner=inner))
    assert model.mass == pytest.approx([mass], rel=1e-6)
    assert model.com[0] == pytest.approx([0, 0, 0], abs=1e-9)
    assert model.inertia[0] == pytest.approx(mass / 6 * np.eye(3), rel=1e-6)


def test_zero_mass_on_a_body_with_collider_is_noted():
    assert any("physics:mass = 0" in n for n in read(body(content="float physics:mass = 0;")).report.notes)


def test_compound_mass_by_the_parallel_axis_theorem():
    inner = cube("Left", xform(translate="(-1, 0, 0)")) + cube("Right", xform(translate="(2, 0, 0)"))
    model = load(body(inner=inner))
    assert model.mass == pytest.approx([2000.0])
    assert model.com[0] == pytest.approx([0.5, 0, 0])
    across = 2 * 1000 / 6 + 2 * 1000 * 1.5**2
    assert model.inertia[0] == pytest.approx(np.diag([2000 / 6, across, across]), rel=1e-5, abs=1e-2)
    scaled = load(body(content="float physics:mass = 10;", inner=inner))
    assert scaled.inertia[0] == pytest.approx(model.inertia[0] / 200, rel=1e-5, abs=1e-4)


def test_authored_centre_of_mass_and_principal_axes():
    content = (
        "float physics:mass = 2; point3f physics:centerOfMass = (0.1, 0.2, 0); float3 physics:diagonalInertia = (1, 2, 2.5);"
        "quatf physics:principalAxes = (0.70710678, 0, 0, 0.70710678);" + xform(scale="(2, 2, 2)")
    )
    model = load(body(content=content))
    assert model.com[0] == pytest.approx([0.2, 0.4, 0])  # the prim's local space, scale included
    assert model.inertia[0] == pytest.approx(np.diag([2, 1, 2.5]), abs=1e-6)  # a quarter turn about z swaps x and y


def test_centre_of_mass_alone_shifts_the_inertia():
    model = load(body(content="float physics:mass = 6; point3f physics:centerOfMass = (0, 0, -0.5);"))
    assert model.com[0] == pytest.approx([0, 0, -0.5])
    assert model.inertia[0] == pytest.approx(np.diag([1 + 1.5, 1 + 1.5, 1]))


def test_mass_without_collider_takes_the_small_sphere_of_usd():
    reading = read(body(content="float physics:mass = 2;", inner=""), cube("Ground"))
    model = reading.builder.finalize(reading.report)
    assert model.inertia[0] == pytest.approx(0.4 * 2 * 0.1**2 * np.eye(3), rel=1e-6)
    assert any("no collider" in n for n in reading.report.notes)


@pytest.mark.parametrize(
    ("content", "inner", "what"),
    [
        ("", "", "mass is zero"),
        ("float physics:mass = 0;", "", "mass is zero"),
        ("", OFF, "mass is zero"),
        ("float physics:mass = -3;", None, "physics:mass is -3"),
        ("float physics:mass = inf;", None, "physics:mass is inf"),
        ("float physics:density = -1;", None, "physics:density is -1"),
        ("", cube(content="float physics:mass = -2;", apis=(COLLIDER, MASS)), "/B/C: physics:mass is -2"),
        ("float3 physics:diagonalInertia = (1, 1, 5);", None, "triangle inequality"),
    ],
)
def test_unusable_mass_is_refused_by_name(content, inner, what):
    message = refused(body(content=content, inner=inner))
    assert "/B" in message
    assert what in message


TETRAHEDRON = """point3f[] points = [(0,0,0),(1,0,0),(0,1,0),(0,0,1)]; int[] faceVertexCounts = [3, 3, 3, 3];
    int[] faceVertexIndices = [0,2,1, 0,1,3, 0,3,2, 1,2,3];"""


def test_mass_of_cylinders_cones_and_meshes():
    shapes = {
        "Cylinder": ("double radius = 0.5; double height = 2;", math.pi * 0.25 * 2),
        "Cone": ("double radius = 0.5; double height = 2;", math.pi * 0.25 * 2 / 3),
    }
    for kind, (content, volume) in shapes.items():
        model = load(body(inner=prim(kind, "C", (COLLIDER,), content)))
        assert model.mass == pytest.approx([1000 * volume], rel=1e-6)
        assert model.com[0] == pytest.approx([0, 0, -0.5 if kind == "Cone" else 0])
    hull = 'uniform token physics:approximation = "convexHull";'
    model = load(body(inner=prim("Mesh", "C", (COLLIDER, "PhysicsMeshCollisionAPI"), TETRAHEDRON + hull)))
    assert model.mass == pytest.approx([1000 / 6], rel=1e-6)
    assert model.com[0] == pytest.approx([0.25, 0.25, 0.25])
    # Corners at 0 and on the axes: integral of x^2 is 1/60, of x y 1/120.
    about_corner = 1000 * (np.diag([1 / 30] * 3) - (np.ones((3, 3)) - np.eye(3)) / 120)
    expected = about_corner - 1000 / 6 * (3 / 16 * np.eye(3) - np.full((3, 3), 1 / 16))
    assert model.inertia[0] == pytest.approx(expected, rel=1e-6)
    flat = "point3f[] points = [(0,0,0),(1,0,0),(0,1,0)]; int[] faceVertexCounts = [3]; int[] faceVertexIndices = [0,1,2];"
    reading = read(body(inner=prim("Mesh", "C", (COLLIDER,), flat)))
    assert reading.mass is None
    assert [i.path for i in reading.report.unsupported] == ["/B/C"]


def angle_iron() -> str:
    """An L of two arms, 2 m and 1 m wide, as a Mesh that is to be decomposed."""
    profile = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]])
    points = np.vstack([np.c_[profile[:, :1], np.full(6, y), profile[:, 1:]] for y in (0, 1)])
    faces = [(5, 4, 3, 2, 1, 0), (6, 7, 8, 9, 10, 11), *((i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6))]
    # An L is no polygon that may be cut into a fan from any corner: from the inner one it may.
    faces[0], faces[1] = (3, 2, 1, 0, 5, 4), (9, 10, 11, 6, 7, 8)
    text = ", ".join(str(tuple(p)) for p in points.tolist())
    content = f"point3f[] points = [{text}]; int[] faceVertexCounts = [{', '.join(str(len(f)) for f in faces)}];"
    content += f"int[] faceVertexIndices = [{', '.join(str(i) for f in faces for i in f)}];"
    return prim(
        "Mesh", "L", (COLLIDER, "PhysicsMeshCollisionAPI"), content + 'uniform token physics:approximation = "convexDecomposition";'
    )


def test_decomposition_of_what_moves_is_hollow_where_the_mesh_is():
    """An L that stands on the ground holds a ball in its corner, where its convex hull would keep it out.

    CoACD moves corners by 1e-4 of the size, so mass and heights are within a thousandth.
    """
    ball = prim("Sphere", "S", (COLLIDER,), "double radius = 0.3;")
    model = load(
        body("B", inner=angle_iron()), body("Ball", xform(translate="(1.35, 0.5, 1.4)"), inner=ball), prim("Plane", "G", (COLLIDER,))
    )
    assert model.mass[0] == pytest.approx(3000.0, rel=1e-3)
    assert model.com[0] == pytest.approx([5 / 6, 0.5, 5 / 6], abs=2e-3)
    assert [name for name in model.shape_names if "/B/" in name] == ["/B/L[0]", "/B/L[1]"]
    (note,) = [note for note in model.report.notes if "CoACD" in note]
    assert note.startswith("/B/L: 2 convex pieces stand for it")
    sim = wl.Simulator(model, dt=2e-3, device="cpu")
    sim.step(500)
    assert not sim.status.numpy().any()
    assert sim.q.numpy()[0, 9] == pytest.approx(1.3, abs=2e-3)


def test_decomposition_without_coacd(monkeypatch):
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(wl.MissingExtra, match=r"decomposing meshes needs the extra 'mesh'"):
        load(body(inner=angle_iron()))
