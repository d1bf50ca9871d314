# SPDX-License-Identifier: Apache-2.0
"""Convex hulls (by Qhull, in scipy) and meshes: checked, their mass, and the arrays that kernels read."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from .errors import MissingExtra, ModelError
from .model import Hull, Mesh, Model, ShapeType

#: Points that a hull may have; of more, those are left out that change it least.
MAX_POINTS = 64
#: Of the size: corners of a face lie in its plane to within this, and what is thinner is flat.
FLAT = 1e-9
#: Sine of the angle by which triangles that go on in one plane may differ, what single precision leaves of a plane.
SEAM = 1e-5
#: A box from -1 to 1: its corners, and its faces counterclockwise from outside.
CORNERS = np.array([[x, y, z] for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
BOX_FACES = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))


def convex_hull(name: str, points: Any) -> tuple[Hull, float]:
    """The hull of points [N, 3] with :data:`MAX_POINTS` corners at most, and how far it falls short of the whole hull [m].

    Raises:
        ModelError: for points that are not finite, too few, or in one plane.
        MissingExtra: no scipy is installed.
    """
    try:
        from scipy.spatial import ConvexHull, QhullError
    except ImportError as error:
        raise MissingExtra("convex hulls", "mesh", error) from error
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1:] != (3,) or not np.isfinite(points).all():
        raise ModelError(f"{name}: points have shape {points.shape}; give [N, 3] finite numbers")
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    try:
        whole = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise ModelError(f"{name}: {len(points)} points span no volume; a hull needs four that are not in one plane") from error
    if whole.volume < FLAT * size**3:
        raise ModelError(f"{name}: its points lie in one plane; a hull needs a volume, give a thin box instead")
    hull, short = whole, 0.0
    if len(whole.vertices) > MAX_POINTS:
        corners = points[whole.vertices]
        chosen = sorted({int(f(corners[:, k])) for k in range(3) for f in (np.argmin, np.argmax)})
        chosen += [k for k in np.linspace(0, len(corners) - 1, 8).astype(int).tolist() if k not in chosen]
        while len(chosen) < MAX_POINTS:
            hull = ConvexHull(corners[chosen])
            beyond = (corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
            chosen.append(int(beyond.argmax()))
        points = corners[chosen]
        hull = ConvexHull(points)
        short = float((corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max())
    place = np.full(len(points), -1)
    place[hull.vertices] = np.arange(len(hull.vertices))
    return Hull(points[hull.vertices], tuple(_faces(points, hull, place, size))), short


def decomposition(name: str, points: np.ndarray, triangles: np.ndarray) -> tuple[list[Hull], float]:
    """Convex pieces that stand for a mesh, by CoACD (Wei et al. 2022), and how far its corners are beyond all of them at most.

    Pieces leave out at most a twentieth of the mesh's size of what is hollow (its ``threshold``), and are the same every time.

    Raises:
        ModelError: for a mesh that is none, or a piece without volume.
        MissingExtra: no coacd or no scipy is installed.
    """
    try:
        import coacd
    except ImportError as error:
        raise MissingExtra("decomposing meshes", "mesh", error) from error
    whole = mesh(name, points, triangles)
    coacd.set_log_level("error")
    pieces = coacd.run_coacd(coacd.Mesh(whole.points, whole.triangles), seed=0)  # the same for a mesh that is inside out
    found = [convex_hull(f"{name}[{i}]", corners)[0] for i, (corners, _) in enumerate(pieces)]
    beyond = np.min([_beyond(hull, whole.points[np.unique(whole.triangles)]) for hull in found], axis=0)
    return found, float(max(beyond.max(), 0.0))


def _beyond(hull: Hull, points: np.ndarray) -> np.ndarray:
    """[N] how far points [N, 3] are beyond the planes of a hull, negative inside."""
    planes = [(face_normal(hull.points, face), hull.points[face[0]]) for face in hull.faces]
    return np.max([(points - on) @ n for n, on in planes], axis=0)


def _faces(points: np.ndarray, hull: Any, place: np.ndarray, size: float) -> list[tuple[int, ...]]:
    """Triangles in one plane are one face: its corners counterclockwise from outside, in the hull's own numbers."""
    left, faces = np.ones(len(hull.simplices), dtype=bool), []
    for k, (*n, c) in enumerate(hull.equations):
        if not left[k]:
            continue
        same = left & (np.abs(points[hull.simplices] @ n + c).max(axis=1) <= 1e3 * FLAT * size) & (hull.equations[:, :3] @ n > 0.0)
        left &= ~same
        corners = np.unique(hull.simplices[same])
        spread = points[corners] - points[corners].mean(axis=0)
        x = spread[np.argmax((spread**2).sum(axis=1))]
        faces.append(tuple(place[corners[np.argsort(np.arctan2(spread @ np.cross(n, x), spread @ x))]].tolist()))
    return faces


def mesh(name: str, points: Any, triangles: Any) -> Mesh:
    """A checked mesh, without triangles that have no area.

    Raises:
        ModelError: for points that are not finite, corners that are none, or no triangle with an area.
    """
    points, corners = np.asarray(points, dtype=float), np.asarray(triangles)
    if points.ndim != 2 or points.shape[1:] != (3,) or not np.isfinite(points).all():
        raise ModelError(f"{name}: points have shape {points.shape}; give [V, 3] finite numbers")
    if corners.ndim != 2 or corners.shape[1:] != (3,) or corners.dtype.kind not in "iu":
        raise ModelError(f"{name}: triangles have shape {corners.shape} of {corners.dtype}; give [T, 3] whole numbers")
    if corners.size and (corners.min() < 0 or corners.max() >= len(points)):
        raise ModelError(f"{name}: a triangle has corner {corners.min() if corners.min() < 0 else corners.max()} of {len(points)} points")
    p = points[corners]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    longest = np.ptp(p, axis=1).max(axis=1) if len(p) else np.zeros(0)
    corners = corners[area > FLAT * longest**2]
    if not len(corners):
        raise ModelError(f"{name}: no triangle has an area")
    return Mesh(points, corners.astype(np.int32))


def solid(hull: Hull) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centre of mass and inertia [3, 3] per unit mass about it, by tetrahedra from one of its points."""
    triangles = [(face[0], face[k], face[k + 1]) for face in hull.faces for k in range(1, len(face) - 1)]
    origin = hull.points.mean(axis=0)
    p = hull.points[np.array(triangles)] - origin  # [T, 3, 3]
    volumes = np.linalg.det(p) / 6.0
    volume = float(volumes.sum())
    total = p.sum(axis=1)
    centre = (volumes[:, None] * total).sum(axis=0) / (4.0 * volume)
    # Integral of x x^T over a tetrahedron with one corner at the origin: V / 20 (sum of p p^T over corners + s s^T).
    second = np.einsum("t,tij,tik->jk", volumes, p, p) + np.einsum("t,tj,tk->jk", volumes, total, total)
    second = second / (20.0 * volume) - np.outer(centre, centre)
    return volume, origin + centre, np.trace(second) * np.eye(3) - second


def arrays(model: Model, sim: Any) -> tuple[Any, list[wp.Mesh]]:
    """``shapes.Hulls`` of a Simulator, and the trees of triangles that it refers to: boxes are hulls in it, and so are triangles."""
    from .kernels import shapes

    hulls, pieces, trees = [], [], []
    for kind, size, shape in zip(model.shape_type, model.shape_size, model.shape_hull, strict=True):
        corners = shape.points[shape.triangles] if isinstance(shape, Mesh) else np.zeros((0, 3, 3))
        pieces.append(corners)
        trees.append(_tree(shape, sim.device) if isinstance(shape, Mesh) else None)
        empty = Hull(np.zeros((0, 3)), ())
        hulls.append(Hull(CORNERS * size, BOX_FACES) if kind == ShapeType.BOX else shape if isinstance(shape, Hull) else empty)
    centres = np.concatenate(pieces).mean(axis=1)
    sides = ((0, 1, 2), (2, 1, 0))
    hulls += [Hull(corners - corners.mean(axis=0), sides) for corners in np.concatenate(pieces)]
    vec3, result = sim._types.vec3, shapes.functions(sim.real).Hulls()
    first_point = np.cumsum([0, *(len(hull.points) for hull in hulls)])
    faces = [(hull.points, face, start) for hull, start in zip(hulls, first_point, strict=False) for face in hull.faces]
    result.kind = sim.ints([*model.shape_type, *([shapes.PIECE] * len(centres))])
    result.first_point, result.first_face = sim.ints(first_point), sim.ints(np.cumsum([0, *(len(hull.faces) for hull in hulls)]))
    result.point = sim._constant(np.concatenate([hull.points for hull in hulls]), vec3)
    result.normal = sim._constant(np.array([face_normal(points, face) for points, face, _ in faces]).reshape(-1, 3), vec3)
    result.first_corner = sim.ints(np.cumsum([0, *(len(face) for _, face, _ in faces)]))
    result.corner = sim.ints([start + k for _, face, start in faces for k in face])
    seams = [_seams(shape) for shape in model.shape_hull if isinstance(shape, Mesh)]
    result.seam = sim.ints(np.concatenate([np.zeros(len(faces) - 2 * len(centres)), *seams]))
    result.mesh = wp.array([tree.id if tree else 0 for tree in trees], dtype=wp.uint64, device=sim.device)
    result.first_piece = sim.ints(np.cumsum([0, *map(len, pieces)]))
    result.centre = sim._constant(centres, vec3)
    result.radius = sim._constant(np.array([np.linalg.norm(hull.points, axis=1).max() for hull in hulls[model.num_shapes :]]), sim.real)
    return result, [tree for tree in trees if tree]


def _seams(mesh: Mesh) -> np.ndarray:
    """[2 T] bits of the sides beyond which a triangle goes on in another one, in the same plane: of its front, then of its back."""
    p = mesh.points[mesh.triangles]
    normals = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    _, same = np.unique(mesh.points, axis=0, return_inverse=True)  # files repeat points where faces meet
    corners = same.reshape(-1)[mesh.triangles]
    ends = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1), axis=-1).reshape(
        -1, 2
    )  # [3 T, 2], side k of triangle t at 3 t + k
    _, edge, uses = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    shared = np.argsort(edge, kind="stable")[np.repeat(uses == 2, uses)].reshape(-1, 2)  # of two triangles
    (a, i), (b, j) = (divmod(shared[:, side], 3) for side in (0, 1))
    along = p[a, (i + 1) % 3] - p[a, i]
    off = [p[t, (k + 2) % 3] - p[a, i] for t, k in ((a, i), (b, j))]
    apart = (np.cross(along, off[0]) * np.cross(along, off[1])).sum(axis=1) < 0.0  # on either side of it, not folded onto each other
    flat = apart & (np.abs((normals[a] * normals[b]).sum(axis=1)) > 1.0 - 0.5 * SEAM**2)
    t, k = divmod(shared[flat].reshape(-1), 3)
    seams = np.zeros((len(p), 2), dtype=np.int32)
    np.bitwise_or.at(seams[:, 0], t, 1 << k)
    np.bitwise_or.at(seams[:, 1], t, 1 << (1 - k) % 3)  # the back has corners 2, 1, 0
    return seams.reshape(-1)


def _tree(mesh: Mesh, device: Any) -> wp.Mesh:
    """Warp's tree of bounds; it is in single precision, so the ball that is looked for is a little larger."""
    return wp.Mesh(
        points=wp.array(mesh.points.astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(mesh.triangles.ravel(), dtype=int, device=device),
    )


def face_normal(points: np.ndarray, face: tuple[int, ...]) -> np.ndarray:
    """Outward unit normal [3]: of all its corners together, so that a short side spoils none."""
    corners = points[list(face)] - points[list(face)].mean(axis=0)
    n = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    return n / np.linalg.norm(n)
