# SPDX-License-Identifier: Apache-2.0
"""RerunLogger: stream a run to Rerun, as a file, to a viewer or to a browser.

Entities (E logged environments, laid out on a grid; world axes of the scene)::

    world/bodies/<shape>     one entity per shape, all environments as instances: InstancePoses3D
    world/static/<shape>     likewise, logged once; planes are drawn as thin tiles, one per environment
    world/contacts/points    contact points, coloured by state
    world/contacts/forces    force on the second body of each contact, on the first where that one moves freely and the
                             second does not; coloured by state
    plots/residual           log10 of the worst and the 99th percentile residual [m/s] over ALL environments
    plots/iterations         mean and largest number of solves, pivots or sweeps a step, over all environments
    plots/contacts           mean and largest number of contacts, over all environments
    plots/status             environments whose status had each bit since the last frame, over all environments
    plots/energy             mechanical energy [J] of the logged environments: mean, least, most of those that are finite
    log                      the first time an environment is not OK, with its status bits

Timelines: ``step`` (number) and ``sim_time`` (duration). Contact points are those at the start of a step, poses those at
its end.
"""

from __future__ import annotations

import math
import os
import socket
import sys
import time
import warnings
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any
from urllib.parse import quote, urlsplit

import numpy as np
import warp as wp

from .errors import MissingExtra, WarpLcpError, whole_number
from .hulls import face_normal
from .kernels import watch
from .model import Hull, JointType, Mesh, Model, ShapeType
from .simulator import INFORMATIVE, Simulator, Status

#: Environments logged unless asked for otherwise: disk and viewer, not the simulator, set this limit.
DEFAULT_ENVS = 64
#: Frames per second of simulated time that are logged unless asked for otherwise.
FRAME_RATE = 60.0
#: Seconds of wall time after which what was logged is written out, so that a killed run keeps it.
FLUSH_SECONDS = 1.0

BODY_COLORS = ((86, 148, 232), (240, 178, 82), (158, 122, 214), (64, 182, 178), (222, 130, 182), (178, 190, 92), (128, 150, 176))
STATIC_COLOR = (88, 95, 105)
#: By contact state: open, stick, slide.
STATE_COLORS = np.array([(150, 150, 150), (60, 210, 100), (255, 70, 60)], dtype=np.uint8)
STATUS_BITS = tuple(bit for bit in Status if bit)
STATUS_COLORS = ((240, 190, 90), (255, 140, 60), (255, 60, 60), (190, 120, 230), (120, 170, 255), (120, 200, 140))
SERIES: dict[str, tuple[tuple[str, tuple[int, int, int]], ...]] = {
    "plots/residual": (("worst", (255, 110, 90)), ("99 %", (120, 170, 255))),
    "plots/iterations": (("iterations, mean", (120, 170, 255)), ("iterations, most", (60, 90, 160))),
    "plots/contacts": (("contacts, mean", (240, 190, 90)), ("contacts, most", (150, 110, 40))),
    "plots/energy": (("mean", (120, 210, 130)), ("least", (70, 110, 80)), ("most", (180, 240, 120))),
    "plots/status": tuple((str(bit.name).lower(), color) for bit, color in zip(STATUS_BITS, STATUS_COLORS, strict=True)),
}


@dataclass(frozen=True)
class Layout:
    """How environments are laid out, so that a run can be looked at. n logged environments; metres, the scene's axes.

    Attributes:
        offsets: [n, 3] added to every position of an environment; their mean is the origin.
        centre: [3] middle of what an environment's bodies are expected to reach, without its offset.
        half: [3] half the extents of the room that an environment gets.
        size: diameter of a typical moving shape, for the lengths of arrows.
    """

    offsets: np.ndarray
    centre: np.ndarray
    half: np.ndarray
    size: float


@dataclass(frozen=True)
class Drawn:
    """What is drawn for each of S shapes: [S, 7] pose in the body's frame, [S, 3] half extents (of a capsule: its size)."""

    pose: np.ndarray
    half: np.ndarray


class RerunLogger:
    """Streams a simulation to Rerun. Call :meth:`log` after each ``sim.step()``; it decides whether a frame is due.

    Args:
        sim: the simulation.
        sink: a file ending in .rrd, 'spawn' (a viewer on this machine), 'serve' (a viewer in the browser; the address
            is printed to stderr; it lives until :meth:`close`) or the URL of a viewer, rerun+http://HOST:PORT/proxy.
        envs: environments to show, a number of them from the first or their indices; None = the first 64.
        every: steps between frames; None = 60 frames per second of simulated time.

    Attributes:
        recording: the ``rerun.RecordingStream``, for data of your own.
        envs: [n] indices of the logged environments.
        every: steps between frames.
        layout: where they stand.
        force_scale: length of a force arrow over its force [m/N]; no arrow is longer than ``longest_arrow`` [m].
        address: where the run can be seen, or the file.

    Raises:
        MissingExtra: Rerun is not installed.
        WarpLcpError: for a sink that cannot be written or reached, or environments that do not exist.
    """

    def __init__(self, sim: Simulator, sink: str | os.PathLike[str], envs: int | Sequence[int] | None = None, every: int | None = None):
        self._rr = _import_rerun()
        self.sim, model = sim, sim.model
        self.envs = _chosen(envs, sim.num_envs)
        usual = max(1, math.ceil(1.0 / (FRAME_RATE * sim.dt) - 1e-9))
        self.every = usual if every is None else whole_number("every", every, 1)
        self._ids: Any = None if len(self.envs) == sim.num_envs else wp.array(self.envs, dtype=int, device=sim.device)
        self._seen = wp.zeros(sim.num_envs, dtype=int, device=sim.device)
        self._collect_status = watch.make()
        sim._load([self._collect_status])
        self._warned = np.zeros(sim.num_envs, dtype=bool)
        pose, velocity = self._read(sim.body_pose), self._read(sim.body_velocity)
        self._moving = _moving_shapes(model)
        self._entities = _entity_paths(model, self._moving)
        self.layout = lay_out(model, pose, velocity, self._moving)
        self._drawn = draw(model, pose[0], self.layout)
        self._movable = model.movable[:-1]
        weight = float(model.mass[self._movable].sum()) * (float(np.linalg.norm(model.gravity)) or 9.81)
        stretch = 2.0 * self.layout.size * math.sqrt(max(1, self._movable.sum()))  # many bodies share the weight, each shows its part
        self.force_scale = stretch / weight if weight else 1.0
        self.longest_arrow = stretch
        self.recording = self._rr.RecordingStream("warp_lcp")
        self.recording.set_log_tick_enabled(False)
        self.recording.set_log_time_enabled(False)
        self._is_file, self._last, self._next, self._flushed = False, -1, -1, -math.inf
        self.address = self._open(sink)
        self._streaming = True
        self._finish = weakref.finalize(self, _finish, self.recording)  # at exit too
        self._log_static(pose)

    # ------------------------------------------------------------------------------------------------------ the user's

    def log(self) -> bool:
        """Write a frame if one is due: ``every`` steps after the last one. Returns whether it did."""
        if not self._streaming:
            return False
        sim = self.sim
        sim._launch(self._collect_status, sim.num_envs, [sim.status, self._seen])
        step = round(sim.time / sim.dt)
        due = not self._last <= step < self._next  # a clock set back starts anew
        if due:
            self._last, self._next = step, step - step % self.every + self.every
            self.recording.set_time("step", sequence=step)
            self.recording.set_time("sim_time", duration=sim.time)
            self._log_bodies()
            self._log_contacts()
            if step:  # before the first step nothing was solved
                self._log_solver()
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            self.flush()
        return due

    def flush(self) -> None:
        """Write out what was logged. A viewer that went away is warned about once; the simulation goes on without it."""
        self._flushed = time.monotonic()
        try:
            self.recording.flush(timeout_sec=10.0)
        except RuntimeError as error:
            self._streaming = False
            if self._is_file:
                raise WarpLcpError(f"{self.address}: the recording cannot be written: {error}") from error
            warnings.warn(f"nothing more is streamed to {self.address}: {error}", RuntimeWarning, stacklevel=3)

    def close(self) -> None:
        """Write out what was logged and let go of the sink. Done at exit too; a second time does nothing."""
        if self._streaming:
            self.flush()
            self._streaming = False
        if self._finish.detach():
            self.recording.disconnect()

    def __enter__(self) -> RerunLogger:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    # --------------------------------------------------------------------------------------------------------- frames

    def _read(self, array: Any) -> np.ndarray:
        """Rows of the logged environments on the host: [n, ...] of an array [E, ...]; one copy, gathered on the device."""
        if self._ids is not None:
            array = wp.indexedarray(array, [self._ids] + [None] * (array.ndim - 1))
        return array.numpy()

    def _parameter(self, array: wp.array) -> np.ndarray:
        """Rows of a parameter [1 | E, ...]."""
        return array.numpy() if array.shape[0] == 1 else self._read(array)

    def _log_bodies(self) -> None:
        sim = self.sim
        pose, velocity = self._read(sim.body_pose), self._read(sim.body_velocity)
        self._log_poses(self._moving, pose)
        energy = self._energy(pose, velocity)
        energy = energy[np.isfinite(energy)]  # one environment that is no number must not hide the others
        if len(energy):
            self._scalars("plots/energy", energy.mean(), energy.min(), energy.max())

    def _log_poses(self, shapes: Sequence[int], pose: np.ndarray, static: bool = False) -> None:
        """Poses of shapes, given those of the bodies [n, B, 7]."""
        where = shape_poses(self.sim.model, pose, self._drawn.pose, shapes)
        for i, shape in enumerate(shapes):
            at, turn = where[:, i, :3] + self.layout.offsets, where[:, i, 3:]
            self.recording.log(self._entities[shape], self._rr.InstancePoses3D(translations=at, quaternions=turn), static=static)

    def _energy(self, pose: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """[n] J, kinetic plus potential energy of the bodies that forces move; potential energy is zero at the origin.

        What drives hold and what armatures carry is not counted.
        """
        parameters = self.sim.parameters
        mass, com, gravity = (self._parameter(p) for p in (parameters.mass, parameters.com, parameters.gravity))
        height = pose[..., :3] + rotate(pose[..., 3:], com)
        spin = rotate(pose[..., 3:] * (-1.0, -1.0, -1.0, 1.0), velocity[..., 3:])  # in body axes, as the inertia is
        kinetic = 0.5 * mass * (velocity[..., :3] ** 2).sum(-1)
        kinetic = kinetic + 0.5 * np.einsum("...i,...ij,...j", spin, self._parameter(parameters.inertia), spin)
        potential = -mass * (height * gravity[:, None]).sum(-1)
        return (kinetic + potential)[:, self._movable].sum(-1)

    def _log_contacts(self) -> None:
        sim, rr = self.sim, self._rr
        contacts = sim.contacts
        count = self._read(contacts.count)
        # Entries behind the count are stale. Without contacts empty arrays are logged, else the old ones would stay.
        env, slot = np.nonzero(np.arange(contacts.point.shape[1]) < count[:, None])
        point = self._read(contacts.point)[env, slot] + self.layout.offsets[env]
        force = np.einsum("ci,cij->cj", self._read(contacts.impulse)[env, slot], self._read(contacts.frame)[env, slot]) / sim.dt
        moved = np.append(self._movable, False)[self._read(contacts.bodies)[env, slot]]  # body -1, the world, is the last
        force[moved[:, 0] & ~moved[:, 1]] *= -1.0
        color = STATE_COLORS[self._read(contacts.state)[env, slot]]
        arrow = self.force_scale * force
        length = np.linalg.norm(arrow, axis=-1, keepdims=True)
        arrow *= np.minimum(1.0, self.longest_arrow / np.maximum(length, 1e-300))
        size = self.layout.size
        self.recording.log("world/contacts/points", rr.Points3D(point, colors=color, radii=0.025 * size))
        self.recording.log("world/contacts/forces", rr.Arrows3D(origins=point, vectors=arrow, colors=color, radii=0.03 * size))

    def _log_solver(self) -> None:
        sim = self.sim
        residual, count = sim.residual.numpy(), sim.contacts.count.numpy()
        iterations = sim.iterations.numpy() / max(1, sim.last_count)
        seen = self._seen.numpy().copy()
        self._seen.zero_()
        # A residual of zero has no logarithm; nothing below 1e-17 m/s means anything.
        self._scalars("plots/residual", *np.log10(np.maximum((residual.max(), np.percentile(residual, 99)), 1e-17)))
        self._scalars("plots/iterations", iterations.mean(), iterations.max())
        self._scalars("plots/contacts", count.mean(), count.max())
        self._scalars("plots/status", *(float(np.count_nonzero(seen & bit)) for bit in STATUS_BITS))
        self._warn(seen, residual)

    def _warn(self, seen: np.ndarray, residual: np.ndarray, most: int = 20) -> None:
        """One line for each environment that is not OK for the first time, ``most`` lines in a frame."""
        seen = seen & ~INFORMATIVE
        new = np.flatnonzero((seen != 0) & ~self._warned)
        self._warned[new] = True
        for env in new[:most]:
            bits = " | ".join(str(bit.name) for bit in STATUS_BITS if seen[env] & bit)
            self._text(f"environment {env}: {bits}, residual {residual[env]:.3g} m/s", "WARN")
        if len(new) > most:
            self._text(f"and {len(new) - most} more environments", "WARN")

    def _text(self, text: str, level: str) -> None:
        self.recording.log("log", self._rr.TextLog(text, level=level))

    def _scalars(self, entity: str, *values: float) -> None:
        self.recording.log(entity, self._rr.Scalars(values))

    # --------------------------------------------------------------------------------------------- what is logged once

    def _log_static(self, pose: np.ndarray) -> None:
        """Geometry and colours, the poses of what never moves, and the facts of the simulation."""
        rr, rec, sim, model = self._rr, self.recording, self.sim, self.sim.model
        axes = rr.ViewCoordinates.RIGHT_HAND_Y_UP if model.up_axis == "Y" else rr.ViewCoordinates.RIGHT_HAND_Z_UP
        rec.log("world", axes, static=True)
        for entity, series in SERIES.items():
            rec.log(entity, rr.SeriesLines(names=[n for n, _ in series], colors=[c for _, c in series]), static=True)
        bodies = list(dict.fromkeys(model.shape_body[self._moving]))
        for shape, entity in enumerate(self._entities):
            body = model.shape_body[shape]
            color = BODY_COLORS[bodies.index(body) % len(BODY_COLORS)] if shape in self._moving else STATIC_COLOR
            rec.log(entity, self._geometry(shape, color), static=True)
        still = [s for s in range(model.num_shapes) if s not in self._moving]
        self._log_poses(still, pose, static=True)
        facts = {key: getattr(sim, key) for key in ("num_envs", "dt", "formulation", "method", "sliding", "directions", "precision")}
        facts |= {"every": self.every, "envs": self.envs, "force_scale": self.force_scale, "longest_arrow": self.longest_arrow}
        rec.send_property("simulation", rr.AnyValues(**facts))

    def _geometry(self, shape: int, color: tuple[int, int, int]) -> Any:
        rr, half = self._rr, self._drawn.half[shape]
        kind = self.sim.model.shape_type[shape]
        if kind == ShapeType.SPHERE:
            vertices, triangles, light = ball(half[0])
            colors = np.where(light[:, None], np.array(color), np.array(color) * 0.55).astype(np.uint8)
            return rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, vertex_normals=vertices / half[0], vertex_colors=colors)
        if kind in (ShapeType.CONE, ShapeType.HULL, ShapeType.MESH):
            solid = self.sim.model.shape_hull[shape] or cone_hull(*half[:2])
            if isinstance(solid, Mesh):
                solid = Hull(solid.points, tuple(map(tuple, solid.triangles.tolist())))
            vertices, normals, triangles = flat_faces(solid)
            return rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, vertex_normals=normals, albedo_factor=color)
        see_through = (ShapeType.BOX, ShapeType.CAPSULE, ShapeType.CYLINDER, ShapeType.ELLIPSOID)
        clear = kind in see_through and shape in self._moving  # the forces on it start inside
        mode = rr.components.FillMode.TransparentFillMajorWireframe if clear else rr.components.FillMode.Solid
        if kind == ShapeType.CAPSULE:
            # Rerun's own start at z = 0, and are not repeated for each pose: 0.41 draws as many as there are lengths.
            n = len(self.envs)
            lengths, radii, at = [2.0 * half[1]] * n, [half[0]] * n, [(0.0, 0.0, -half[1])] * n
            return rr.Capsules3D(lengths=lengths, radii=radii, translations=at, colors=[color], fill_mode=mode)
        if kind == ShapeType.ELLIPSOID:
            return rr.Ellipsoids3D(half_sizes=[half], colors=[color], fill_mode=mode)
        if kind == ShapeType.CYLINDER:
            return rr.Cylinders3D(lengths=[2.0 * half[1]], radii=[half[0]], colors=[color], fill_mode=mode)
        return rr.Boxes3D(half_sizes=[half], colors=[color], fill_mode=mode)

    def _open(self, sink: str | os.PathLike[str]) -> str:
        """Connect the recording and return where it can be seen."""
        text, rec, blueprint = os.fspath(sink), self.recording, self._blueprint()
        if text == "spawn":
            _spawn(rec, blueprint)
            return "the Rerun viewer on this machine"
        if text == "serve":
            return _serve(self._rr, rec, blueprint)
        if "://" in text:
            _connect(rec, text, blueprint)
            return text
        if not text.endswith(".rrd"):
            raise WarpLcpError(
                f"{text}: not a place to log to; give a file ending in .rrd, 'spawn', 'serve' or rerun+http://HOST:PORT/proxy"
            )
        try:
            with open(text, "wb"):  # Rerun itself would tell no cause
                pass
        except OSError as error:
            raise WarpLcpError(f"{text}: cannot be written: {error.strerror}; give another file") from error
        rec.save(text, default_blueprint=blueprint)
        self._is_file = True
        return text

    def _blueprint(self) -> Any:
        """3D view from the front right above, plots and log beside it."""
        from rerun import blueprint as rrb

        up = "XYZ".index(self.sim.model.up_axis)
        position, aim = _eye(self.layout, up)
        eye = rrb.EyeControls3D(position=position, look_target=aim, eye_up=np.eye(3)[up])
        scene = rrb.Spatial3DView(origin="/world", name="Scene", eye_controls=eye, line_grid=False, background=[24, 27, 32])
        legend = rrb.PlotLegend("LeftTop")

        def plot(name: str, *entities: str) -> Any:
            return rrb.TimeSeriesView(origin="/plots", contents=[f"$origin/{e}" for e in entities], name=name, plot_legend=legend)

        plots = rrb.Vertical(
            plot("Residual, log10 of m/s", "residual"),
            plot("Energy, J", "energy"),
            plot("Contacts and iterations", "contacts", "iterations"),
            rrb.Tabs(plot("Environments not OK", "status"), rrb.TextLogView(origin="/log", name="Log")),
        )
        panel = rrb.TimePanel(timeline="sim_time", state="collapsed")
        return rrb.Blueprint(rrb.Horizontal(scene, plots, column_shares=[2, 1]), panel, collapse_panels=True)


# --------------------------------------------------------------------------------------------------------------- sinks


def _finish(recording: Any) -> None:
    recording.flush(timeout_sec=10.0)
    recording.disconnect()


def _import_rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise MissingExtra("streaming to Rerun", "rerun", error) from error
    return rerun


def _spawn(rec: Any, blueprint: Any) -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise WarpLcpError("spawn: no display to open a viewer on; log to a file ending in .rrd, or 'serve' it to a browser")
    path = os.environ.get("PATH", "")
    os.environ["PATH"] = os.pathsep.join((path, os.path.dirname(sys.executable)))  # the viewer of an environment not activated
    try:
        rec.spawn(default_blueprint=blueprint)
    except RuntimeError as error:
        raise WarpLcpError(f"spawn: the Rerun viewer does not start: {error}") from error
    finally:
        os.environ["PATH"] = path


def _serve(rr: Any, rec: Any, blueprint: Any) -> str:
    uri = rec.serve_grpc(grpc_port=free_port(9876), default_blueprint=blueprint)
    port = free_port(9090)
    rr.serve_web_viewer(web_port=port, open_browser=False)
    address = f"http://127.0.0.1:{port}/?url={quote(uri, safe='')}"
    print(f"watch at {address} (or: rerun {uri})", file=sys.stderr, flush=True)
    return address


def _connect(rec: Any, url: str, blueprint: Any) -> None:
    wanted = "give rerun+http://HOST:PORT/proxy"
    try:
        place = urlsplit(url)
        if place.scheme not in ("rerun", "rerun+http", "rerun+https") or not place.hostname:
            raise WarpLcpError(f"{url}: not the address of a viewer; {wanted}")
        port = place.port or (9876 if place.scheme == "rerun+http" else 443)
        socket.create_connection((place.hostname, port), timeout=5.0).close()  # Rerun itself would keep trying in silence
        rec.connect_grpc(url, default_blueprint=blueprint)
    except OSError as error:
        cause = error.strerror or error
        raise WarpLcpError(f"{url}: no viewer answers there ({cause}); start one with: rerun --bind HOST --port PORT") from error
    except RuntimeError as error:
        raise WarpLcpError(f"{url}: not the address of a viewer ({error}); {wanted}") from error


def free_port(wanted: int) -> int:
    """``wanted``, or where another program has it, one that is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("0.0.0.0", wanted))
        except OSError:
            probe.bind(("0.0.0.0", 0))
        return int(probe.getsockname()[1])


# ------------------------------------------------------------------------------------------------------------ geometry


def rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] turned by unit quaternions [..., 4] (x y z w)."""
    xyz, w = quat[..., :3], quat[..., 3:]
    twice = 2.0 * np.cross(xyz, vector)
    return vector + w * twice + np.cross(xyz, twice)


def compose(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Poses [..., 7] (x y z qx qy qz qw): inner, given in the frame outer, in the frame that outer is given in."""
    a, b = outer[..., 3:], inner[..., 3:]
    w = a[..., 3:] * b[..., 3:] - (a[..., :3] * b[..., :3]).sum(-1, keepdims=True)
    xyz = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    return np.concatenate([outer[..., :3] + rotate(a, inner[..., :3]), xyz, w], axis=-1)


def shape_poses(model: Model, pose: np.ndarray, local: np.ndarray, shapes: Sequence[int] | np.ndarray) -> np.ndarray:
    """[n, s, 7] world poses of s shapes, given poses of the bodies [n, B, 7] and of all shapes in their bodies [S, 7]."""
    world = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(pose), 1, 1))
    return compose(np.concatenate([pose, world], axis=1)[:, model.shape_body[shapes]], local[shapes])  # body -1 is the last


def lay_out(model: Model, pose: np.ndarray, velocity: np.ndarray, moving: Sequence[int]) -> Layout:
    """Room for each of n environments, from where bodies are, how large they are, and how far they will slide.

    Args:
        model: the scene.
        pose: [n, B, 7]. velocity: [n, B, 6].
        moving: shapes that can move; they may turn as well, so their bounding spheres count.
    """
    up, shapes = "XYZ".index(model.up_axis), np.flatnonzero(model.shape_type != ShapeType.PLANE)
    where = shape_poses(model, pose, model.shape_pose, shapes)
    half, turns = model.shape_size[shapes], np.isin(shapes, moving)
    around = np.linalg.norm(half, axis=-1)  # radius of the bounding sphere: a sphere has its radius alone there
    kind = model.shape_type[shapes]
    around = np.where(kind == ShapeType.CAPSULE, half[:, 0] + half[:, 1], around)
    around = np.where(kind == ShapeType.ELLIPSOID, half.max(axis=-1), around)
    long = np.where(kind == ShapeType.CAPSULE, around, half[:, 1])
    turned = np.isin(kind, (ShapeType.CAPSULE, ShapeType.CYLINDER, ShapeType.CONE))  # radius, half length -> half extents
    half = np.where(turned[:, None], np.stack([half[:, 0], half[:, 0], long], axis=-1), half)
    size = 2.0 * float(np.median(around[turns])) if turns.any() else 1.0
    axes = np.stack([rotate(where[..., 3:], half[:, i, None] * np.eye(3)[i]) for i in range(3)])
    whole = turns | (model.shape_type[shapes] == ShapeType.SPHERE)
    reach = np.where(whole[:, None], around[:, None], np.abs(axes).sum(0))
    counts = turns | (around < 15.0 * size)  # a larger static shape is ground, on which all environments may stand
    low, high = (
        np.concatenate([pose[..., :3], where[:, counts, :3] + sign * reach[:, counts]], axis=1).reshape(-1, 3) for sign in (-1.0, 1.0)
    )
    low, high = low.min(0), high.max(0)
    along = velocity[..., :3] * (np.arange(3) != up)
    speed = np.linalg.norm(along, axis=-1, keepdims=True)
    brake = float(model.friction[:, 1].mean() if model.num_shapes else 0.0) * float(np.linalg.norm(model.gravity))
    # Spinning bodies brake more slowly: 1.3. What hardly brakes is followed for a second.
    seconds = np.minimum(1.0, 1.3 * speed / (2.0 * brake)) if brake > 0.0 else 1.0
    slide = (along * seconds).reshape(-1, 3)
    low, high = low + np.minimum(slide.min(0), 0.0), high + np.maximum(slide.max(0), 0.0)
    room = 1.1 * (high - low) + 0.2 * size
    first, second = (axis for axis in range(3) if axis != up)
    n = len(pose)
    columns = min(n, max(1, round(math.sqrt(n * room[second] / room[first]))))
    offsets = np.zeros((n, 3))
    offsets[:, first], offsets[:, second] = np.arange(n) % columns * room[first], np.arange(n) // columns * room[second]
    middle = 0.5 * (offsets.min(0) + offsets.max(0))
    return Layout(offsets - middle, 0.5 * (low + high), 0.5 * room, size)


def draw(model: Model, pose: np.ndarray, layout: Layout) -> Drawn:
    """Half extents of all shapes; planes as tiles that fill an environment's room, given body poses [B, 7]."""
    local, half = model.shape_pose.copy(), model.shape_size.copy()
    thick = 0.01 * layout.size
    axis = [a for a in range(3) if a != "XYZ".index(model.up_axis)]
    for s in np.flatnonzero(model.shape_type == ShapeType.PLANE).tolist():
        plane = shape_poses(model, pose[None], model.shape_pose, [s])[0, 0]
        normal = rotate(plane[3:], np.array((0.0, 0.0, 1.0)))
        flat = np.eye(3)[min(axis, key=lambda a: abs(normal[a]))]
        x = flat - normal * (flat @ normal)
        x /= np.linalg.norm(x)
        frame = np.stack([x, np.cross(normal, x), normal])
        middle = layout.centre - normal * (normal @ (layout.centre - plane[:3]) + thick)
        reach = [layout.half[j] / abs(t[j]) for t in frame[:2] for j in [int(np.argmax(abs(t)))]]
        half[s] = 0.985 * reach[0], 0.985 * reach[1], thick  # a seam between neighbours
        turn = np.array(wp.quat_from_matrix(wp.mat33d(*frame.T.ravel())))  # type: ignore[call-overload]
        owner = shape_poses(model, pose[None], np.tile([0, 0, 0, 0, 0, 0, 1.0], (len(local), 1)), [s])[0, 0]
        back = owner[3:] * (-1.0, -1.0, -1.0, 1.0)
        inverse = np.concatenate([-rotate(back, owner[:3]), back])
        local[s] = compose(inverse, np.concatenate([middle, turn]))
    return Drawn(local, half)


def ball(radius: float, rings: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sphere as a mesh of eight octants in two shades, so that it is seen to roll: vertices, triangles, light or dark."""
    theta, phi = np.meshgrid(np.linspace(0, 0.5 * np.pi, rings + 1), np.linspace(0, 0.5 * np.pi, rings + 1), indexing="ij")
    octant = radius * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rings), np.arange(rings), indexing="ij"))
    a, b = i * (rings + 1) + j, (i + 1) * (rings + 1) + j
    faces = np.concatenate([np.stack([a, b, b + 1], -1), np.stack([a, b + 1, a + 1], -1)])
    signs = np.array(np.meshgrid([1, -1], [1, -1], [1, -1], indexing="ij")).reshape(3, -1).T
    even = signs.prod(1) > 0
    vertices = np.concatenate([octant * s for s in signs])
    triangles = np.concatenate([(faces if e else faces[:, ::-1]) + k * len(octant) for k, e in enumerate(even)])
    return vertices, triangles, np.repeat(even, len(octant))


def cone_hull(radius: float, half: float, sides: int = 48) -> Hull:
    """A cone as it is drawn."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, -half)], axis=1)
    side = [(k, (k + 1) % sides, sides) for k in range(sides)]
    return Hull(np.vstack([ring, [[0.0, 0.0, half]]]), (*side, tuple(range(sides))[::-1]))


def flat_faces(hull: Hull) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A hull as a mesh whose faces are seen to be flat: vertices and normals, those of each face its own, and triangles."""
    first = np.cumsum([0, *(len(face) for face in hull.faces)])
    triangles = [(a, a + k, a + k + 1) for face, a in zip(hull.faces, first, strict=False) for k in range(1, len(face) - 1)]
    normals = [np.tile(face_normal(hull.points, face), (len(face), 1)) for face in hull.faces]
    return hull.points[[k for face in hull.faces for k in face]], np.vstack(normals), np.array(triangles)


def _eye(layout: Layout, up: int) -> tuple[np.ndarray, np.ndarray]:
    """Position of an eye that sees all environments from the front right above, and what it looks at."""
    half = 0.5 * np.ptp(layout.offsets, axis=0) + layout.half
    back = np.array((0.28, -0.75, 0.6) if up == 2 else (0.28, 0.6, 0.75))
    back /= np.linalg.norm(back)
    right = np.cross(np.eye(3)[up], back)
    right /= np.linalg.norm(right)
    nearer = 0.22 * np.linalg.norm(half) * back * (np.arange(3) != up)  # what is near takes more of the picture
    corners = -nearer + half * np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).reshape(3, -1).T
    # Half the viewer's field of view has the tangent 0.52 upright; views are wider than high.
    needed = [np.abs(corners @ axis) / tangent for axis, tangent in ((right, 0.68), (np.cross(back, right), 0.5))]
    aim = layout.centre + nearer
    return aim + float((np.maximum(*needed) + corners @ back).max()) * back, aim


def _entity_paths(model: Model, moving: Sequence[int]) -> list[str]:
    """Path of each shape below world/bodies or world/static; a name taken twice gets its number."""
    from rerun import new_entity_path

    paths: list[str] = []
    for shape, name in enumerate(model.shape_names):
        parts = ["world", "bodies" if shape in moving else "static", *(p for p in name.split("/") if p)]
        path = new_entity_path(parts)
        paths.append(path if path not in paths else f"{path}_{shape}")
    return paths


def _moving_shapes(model: Model) -> list[int]:
    """Shapes of bodies that are not fixed to the world."""
    fixed = [j == JointType.FIXED and p < 0 for j, p in zip(model.joint_type, model.body_parent, strict=True)]
    return [s for s, body in enumerate(model.shape_body) if body >= 0 and not fixed[body]]


def _chosen(envs: int | Sequence[int] | None, num_envs: int) -> np.ndarray:
    """Indices of the logged environments."""
    if envs is None:
        return np.arange(min(DEFAULT_ENVS, num_envs))
    if isinstance(envs, (int, np.integer)):
        envs = range(int(envs))
    chosen = np.asarray(envs)
    if chosen.ndim != 1 or not len(chosen) or not np.issubdtype(chosen.dtype, np.integer) or len(set(chosen.tolist())) != len(chosen):
        raise WarpLcpError("envs: give the number of environments to log, at least 1, or their indices, each once")
    if chosen.min() < 0 or chosen.max() >= num_envs:
        raise WarpLcpError(
            f"envs: {chosen.max() if chosen.min() >= 0 else chosen.min()} is not there; the simulation has 0 ... {num_envs - 1}"
        )
    return chosen
