# SPDX-License-Identifier: Apache-2.0
"""What the colliders of UsdPhysics are, in the axes of their prims.

What is made of a mesh, by its ``physics:approximation``:

- ``convexHull``, and for what moves freely ``none`` and ``meshSimplification``: its convex hull (64 corners at most);
- ``convexDecomposition`` of what moves freely: convex pieces, found by CoACD;
- ``boundingCube``, ``boundingSphere``: the box in the prim's axes, the ball, around its bounds;
- ``none``, ``meshSimplification`` and ``convexDecomposition`` of what no force moves: its triangles. So is a flat hull.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from . import hulls
from .builder import ModelBuilder, solid
from .errors import ModelError
from .model import Hull, ShapeType

COLLIDERS = ("PlaneShape", "CubeShape", "SphereShape", "CapsuleShape", "CylinderShape", "ConeShape", "MeshShape")
UNIFORM = 1e-4  # relative: scales closer than this are equal, axes closer than this are perpendicular


@dataclass(frozen=True)
class Solid:
    """A collider as :class:`warp_lcp.ModelBuilder` has it, stage units.

    Attributes:
        kind: its type. size: half extents, semi-axes, radius, or radius and half length; none of a plane, hull or mesh.
        turn: [3, 3] its axes in those of the prim. centre: [3] its origin there.
        hull: of a hull. points, triangles: of a mesh.
        notes: what was assumed.
    """

    kind: ShapeType
    size: tuple[float, ...] = ()
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    hull: Hull | None = None
    points: np.ndarray | None = None
    triangles: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    def add(self, builder: ModelBuilder, body: int, length: float, options: dict[str, Any]) -> int:
        """The index of the shape that it becomes; ``length`` is that of the stage's unit [m], ``options`` are ModelBuilder's.

        Raises:
            ModelError: for sizes that are none.
        """
        size = [length * x for x in self.size]
        if self.kind is ShapeType.HULL:
            assert self.hull is not None
            return builder.place_hull(body, Hull(length * self.hull.points, self.hull.faces), **options)
        if self.kind is ShapeType.MESH:
            return builder.add_mesh(body, length * np.asarray(self.points), self.triangles, **options)
        if self.kind is ShapeType.PLANE:
            return builder.add_plane(body, **options)
        if self.kind is ShapeType.SPHERE:
            return builder.add_sphere(body, size[0], **options)
        if self.kind in (ShapeType.BOX, ShapeType.ELLIPSOID):
            add = builder.add_box if self.kind is ShapeType.BOX else builder.add_ellipsoid
            return add(body, size, **options)
        if self.kind is ShapeType.CAPSULE:
            return builder.add_capsule(body, size[0], size[1], **options)
        add_round = builder.add_cylinder if self.kind is ShapeType.CYLINDER else builder.add_cone
        return add_round(body, size[0], size[1], **options)

    def volume(self) -> tuple[float, np.ndarray, np.ndarray] | None:
        """Volume, centre [3] and inertia [3, 3] per unit mass about it, in the prim's axes; None where it has none."""
        if self.kind in (ShapeType.PLANE, ShapeType.MESH):
            return None
        volume, centre, inertia = solid(self.kind, np.array([*self.size, 0.0, 0.0][:3]), self.hull)
        return volume, self.centre + self.turn @ centre, self.turn @ inertia @ self.turn.T


def solids(px: Any, prim: Any, desc: Any, frame: Any, moves: bool) -> tuple[Solid, ...]:
    """What a collider is made of; ``desc`` is USD's own reading of it, ``frame`` its place (usd.py), ``moves`` whether forces move it.

    Raises:
        ModelError: for a mesh that has no points, or one that moves freely and spans no volume; for an axis that is none.
        MissingExtra: no scipy, or no coacd, is installed.
    """
    kind = str(desc.type).rpartition(".")[2]
    if kind == "MeshShape":
        return _mesh(px, prim, frame.rotation.T @ frame.linear, moves)
    if kind == "CubeShape":
        half = 0.5 * float(px.UsdGeom.Cube(prim).GetSizeAttr().Get()) * frame.scale
        return (Solid(ShapeType.BOX, tuple(half.tolist())),)
    if kind == "SphereShape":
        return (_ball(float(px.UsdGeom.Sphere(prim).GetRadiusAttr().Get()), frame),)
    schema = {
        "PlaneShape": px.UsdGeom.Plane,
        "CapsuleShape": px.UsdGeom.Capsule,
        "CylinderShape": px.UsdGeom.Cylinder,
        "ConeShape": px.UsdGeom.Cone,
    }[kind](prim)
    written = str(schema.GetAxisAttr().Get())
    if written not in ("X", "Y", "Z"):
        raise ModelError(f"{prim.GetPath()}: its axis is {written!r}; give one of X, Y, Z")
    axis = "XYZ".index(written)
    if kind == "PlaneShape":
        return (Solid(ShapeType.PLANE, turn=frame.rotation.T @ _plane_axes(axis, frame)),)
    turn = np.roll(np.eye(3), 2 - axis, axis=1)  # the prim's axis becomes the shape's z
    radius, height = float(schema.GetRadiusAttr().Get()), float(schema.GetHeightAttr().Get())
    if kind == "CapsuleShape":
        scale = frame.scale.max()
        return (Solid(ShapeType.CAPSULE, (radius * scale, 0.5 * height * scale), turn),)
    size = (radius * frame.scale[(axis + 1) % 3], 0.5 * height * frame.scale[axis])
    if frame.sign < 0.0:  # a mirrored cone has its tip on the other side
        turn = turn * [1.0, -1.0, -1.0]
    return (Solid(ShapeType.CYLINDER if kind == "CylinderShape" else ShapeType.CONE, size, turn),)


def _ball(radius: float, frame: Any) -> Solid:
    """A Sphere, which is an ellipsoid where it is scaled unevenly.

    So is a slanted one; its axes are then the principal ones of what turns the ball into it.
    """
    stretch = frame.stretch
    if stretch[0] - stretch[2] <= UNIFORM * stretch[0]:
        return Solid(ShapeType.SPHERE, (radius * frame.scale.max(),))
    if not frame.sheared:
        return Solid(ShapeType.ELLIPSOID, tuple((radius * frame.scale).tolist()))
    axes, _, _ = np.linalg.svd(frame.linear)
    return Solid(ShapeType.ELLIPSOID, tuple((radius * stretch).tolist()), frame.rotation.T @ (axes * [1.0, 1.0, np.linalg.det(axes)]))


def _plane_axes(k: int, frame: Any) -> np.ndarray:
    """World axes of a plane: z = the side to which the prim's axis k points, x and y in the plane."""
    a, b = frame.linear[:, (k + 1) % 3], frame.linear[:, (k + 2) % 3]
    normal = frame.sign * np.cross(a, b)
    normal, a = normal / np.linalg.norm(normal), a / np.linalg.norm(a)
    return np.stack([a, np.cross(normal, a), normal], axis=1)


def _mesh(px: Any, prim: Any, stretch: np.ndarray, moves: bool) -> tuple[Solid, ...]:
    """What is made of a mesh; ``stretch`` [3, 3] from the prim's points to its axes in stage units."""
    path, points = prim.GetPath(), _points(px, prim) @ stretch.T
    approximation = "none"
    if prim.HasAPI(px.UsdPhysics.MeshCollisionAPI):
        approximation = str(px.UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get())
    if not len(points):
        raise ModelError(f"{path}: the mesh has no points")
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = 0.5 * (low + high), float((high - low).max())
    if approximation == "boundingCube":
        return (Solid(ShapeType.BOX, tuple((0.5 * (high - low)).tolist()), centre=middle),)
    if approximation == "boundingSphere":
        return (Solid(ShapeType.SPHERE, (float(np.linalg.norm(points - middle, axis=1).max()),), centre=middle),)
    if moves and approximation == "convexDecomposition":
        pieces, short = hulls.decomposition(str(path), points, _triangles(px, prim))
        note = f"{path}: {len(pieces)} convex pieces stand for it, found by CoACD; its corners are within {short / extent:.2g} of its size"
        return tuple(Solid(ShapeType.HULL, hull=hull, notes=() if i else (note,)) for i, hull in enumerate(pieces))
    notes: tuple[str, ...] = ()
    if moves or approximation == "convexHull":
        if approximation != "convexHull":
            notes = (f"{path}: physics:approximation = {approximation} on what moves freely: its convex hull is taken",)
        flat = not moves and np.linalg.matrix_rank(points - middle, tol=hulls.FLAT * extent) < 3
        if not flat:
            hull, short = hulls.convex_hull(str(path), points)
            if short > 0.0:
                notes += (f"{path}: of its convex hull {len(hull.points)} corners are kept, within {short / extent:.2g} of its size",)
            return (Solid(ShapeType.HULL, hull=hull, notes=notes),)
        notes = (f"{path}: a flat convex hull that does not move: its triangles are taken",)
    elif approximation not in ("none", "meshSimplification"):
        notes = (f"{path}: physics:approximation = {approximation} on what no force moves: its triangles are taken",)
    mesh = hulls.mesh(str(path), points, _triangles(px, prim))
    return (Solid(ShapeType.MESH, points=mesh.points, triangles=mesh.triangles, notes=notes),)


def _points(px: Any, prim: Any) -> np.ndarray:
    """[V, 3], the decimals that an author wrote: USD keeps single precision."""
    values = px.UsdGeom.Mesh(prim).GetPointsAttr().Get()
    return np.array(values if values is not None else [], dtype=np.float32).reshape(-1, 3).astype(str).astype(float)


def _triangles(px: Any, prim: Any) -> np.ndarray:
    """[T, 3] of the mesh's polygons, holes left out; a fan of each, as USD has them convex."""
    mesh, fans = px.UsdGeom.Mesh(prim), []
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], dtype=int)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [], dtype=int)
    if counts.sum() != len(corners):
        raise ModelError(f"{prim.GetPath()}: faceVertexCounts ask for {counts.sum()} corners, faceVertexIndices has {len(corners)}")
    holes, first = set(mesh.GetHoleIndicesAttr().Get() or []), np.cumsum([0, *counts])
    turned = mesh.GetOrientationAttr().Get() == px.UsdGeom.Tokens.leftHanded
    for face, (start, count) in enumerate(zip(first, counts, strict=False)):
        if face not in holes:
            fans += [(corners[start], corners[start + k], corners[start + k + 1]) for k in range(1, count - 1)]
    triangles = np.array(fans, dtype=int).reshape(-1, 3)
    return triangles[:, ::-1] if turned else triangles
