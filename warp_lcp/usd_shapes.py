# SPDX-License-Identifier: Apache-2.0
"""Colliders of USD that are no plane, cube, sphere, ellipsoid or capsule: cylinders, cones and meshes, in the prim's own axes.

What is made of a mesh, by its ``physics:approximation``:

- ``convexHull``, and for what moves freely any other: its convex hull (64 corners at most);
- ``boundingCube``, ``boundingSphere``: the box in the prim's axes, the ball, around its bounds;
- ``none``, ``meshSimplification`` and ``convexDecomposition`` of what no force moves: its triangles. So is a flat hull.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import hulls
from .errors import ModelError
from .model import Hull, ShapeType


@dataclass(frozen=True)
class Solid:
    """A collider in the axes of its prim, stage units: what :class:`warp_lcp.ModelBuilder` makes of it.

    Attributes:
        kind: BOX, SPHERE, CYLINDER, CONE, HULL or MESH.
        size: half extents, or radius, or radius and half length. axis: of the prim, along which a cylinder or cone lies.
        centre: [3] of a box or sphere. hull: of a hull. points, triangles: of a mesh.
        notes: what was assumed.
    """

    kind: ShapeType
    size: tuple[float, ...] = ()
    axis: int = 2
    centre: np.ndarray | None = None
    hull: Hull | None = None
    points: np.ndarray | None = None
    triangles: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def round_solid(px: Any, prim: Any, kind: str, scale: np.ndarray) -> Solid:
    """A cylinder or cone; ``scale`` [3] of the prim's axes."""
    schema = px.UsdGeom.Cylinder(prim) if kind == "CylinderShape" else px.UsdGeom.Cone(prim)
    axis = "XYZ".index(str(schema.GetAxisAttr().Get()))
    radius = float(schema.GetRadiusAttr().Get()) * scale[(axis + 1) % 3]
    half = 0.5 * float(schema.GetHeightAttr().Get()) * scale[axis]
    return Solid(ShapeType.CYLINDER if kind == "CylinderShape" else ShapeType.CONE, (radius, half), axis)


def mesh_solid(px: Any, prim: Any, stretch: np.ndarray, moves: bool) -> Solid:
    """What is made of a mesh; ``stretch`` [3, 3] from the prim's points to its axes in stage units.

    Raises:
        ModelError: for a mesh that has no points, or one that moves freely and spans no volume.
        MissingExtra: no scipy is installed.
    """
    path, points = prim.GetPath(), _points(px, prim) @ stretch.T
    approximation = "none"
    if prim.HasAPI(px.UsdPhysics.MeshCollisionAPI):
        approximation = str(px.UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get())
    if not len(points):
        raise ModelError(f"{path}: the mesh has no points")
    low, high = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (low + high)
    if approximation == "boundingCube":
        return Solid(ShapeType.BOX, tuple((0.5 * (high - low)).tolist()), centre=middle)
    if approximation == "boundingSphere":
        return Solid(ShapeType.SPHERE, (float(np.linalg.norm(points - middle, axis=1).max()),), centre=middle)
    notes: tuple[str, ...] = ()
    if moves or approximation == "convexHull":
        if approximation != "convexHull":
            notes = (f"{path}: physics:approximation = {approximation} on what moves freely: its convex hull is taken",)
        flat = not moves and np.linalg.matrix_rank(points - middle, tol=hulls.FLAT * float((high - low).max())) < 3
        if not flat:
            hull, short = hulls.convex_hull(str(path), points)
            if short > 0.0:
                within = short / float((high - low).max())
                notes += (f"{path}: of its convex hull {len(hull.points)} corners are kept, within {within:.2g} of its size",)
            return Solid(ShapeType.HULL, hull=hull, notes=notes)
        notes = (f"{path}: a flat convex hull that does not move: its triangles are taken",)
    elif approximation not in ("none", "meshSimplification"):
        notes = (f"{path}: physics:approximation = {approximation} on what no force moves: its triangles are taken",)
    mesh = hulls.mesh(str(path), points, _triangles(px, prim))
    return Solid(ShapeType.MESH, points=mesh.points, triangles=mesh.triangles, notes=notes)


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
