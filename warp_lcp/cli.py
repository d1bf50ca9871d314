# SPDX-License-Identifier: Apache-2.0
"""The command line: ``warp-lcp info SCENE`` says what is in a scene, ``run SCENE`` simulates it, ``solve FILE`` solves problems.

Bad input ends with one line on stderr and exit status 2. What is slow to import (warp, USD, rerun, rich) is imported
where it is needed, so that ``--help`` and a mistyped option answer at once.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from .errors import MissingExtra, ModelError, WarpLcpError
from .laws import Law

if TYPE_CHECKING:
    from .logger import RerunLogger
    from .model import Model
    from .simulator import Simulator
    from .usd import SceneReading

#: Samples of residual and contacts that a run takes where nothing else asks for them more often.
SAMPLES = 100


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise WarpLcpError(f"{message} (see {self.prog} --help)")


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit status: 0, 2 for bad input, 130 after Ctrl-C."""
    try:
        arguments = _parser().parse_args(argv)
        return int(arguments.action(arguments))
    except WarpLcpError as error:
        print("warp-lcp: error:", " ".join(str(error).splitlines()), file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of a pipe has seen enough; what is left in the buffer has no reader either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 130


def _parser() -> _Parser:
    parser = _Parser(prog="warp-lcp", description="Contact simulation that is exact and massively batched.", allow_abbrev=False)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    info = commands.add_parser("info", help="say what is in a scene, what is ignored and why", allow_abbrev=False)
    info.set_defaults(action=_info)
    run = commands.add_parser("run", help="simulate a scene", allow_abbrev=False)
    run.set_defaults(action=_run)
    for command in (info, run):
        command.add_argument("scene", metavar="SCENE", help="a USD file or the name of a shipped scene")
        command.add_argument("--json", action="store_true", help="print one JSON object on stdout and nothing else there")
        add = command.add_argument
        add("--formulation", default="phantom_inertia", metavar="F", help="contact law (default phantom_inertia)")
        add(
            "--sliding",
            default="regularized",
            metavar="S",
            help="how phantom_inertia (no other law) slides: regularized (default), aligned or facets",
        )
        add(
            "--directions", type=int, default=2, metavar="K", help="friction directions of a sticking contact (default 2); coulomb has none"
        )
    add = run.add_argument
    add("--envs", type=int, default=1, metavar="N", help="environments, all alike (default 1)")
    add("--dt", type=float, default=1e-3, metavar="S", help="step size in seconds (default 0.001)")
    add("--duration", type=float, default=1.0, metavar="S", help="simulated seconds (default 1)")
    add("--method", default="auto", metavar="M", help="how the contact problem is solved (default auto)")
    add("--rho-scale", type=float, default=1.0, metavar="A", help="scale of the phantom inertia (default 1)")
    add("--precision", default="float64", metavar="P", help="float64 (default) or float32")
    add("--integrator", default="euler", metavar="I", help="euler (default) or midpoint")
    add("--device", metavar="D", help="Warp device, such as cpu or cuda:0 (default: a GPU if there is one)")
    add(
        "--every",
        type=int,
        metavar="N",
        help="steps between rows of --out (default 1) and frames of --rerun (default 60 a simulated second)",
    )
    add("--rerun", metavar="SINK", help="stream to a file ending in .rrd, 'spawn', 'serve' or the URL of a viewer")
    add("--out", metavar="FILE.npz", help="write time, poses, velocities, status, residual and iterations; of joints q and v")
    from .cli_solve import add_arguments

    solve = commands.add_parser("solve", help="solve complementarity problems from a file", allow_abbrev=False)
    solve.set_defaults(action=_solve)
    add_arguments(solve)
    return parser


def _solve(arguments: argparse.Namespace) -> int:
    from .cli_solve import run

    return run(arguments)


# ----------------------------------------------------------------------------------------------------------------- info


def _info(arguments: argparse.Namespace) -> int:
    from .usd import read_usd

    facts = describe(read_usd(arguments.scene), Law(arguments.formulation, arguments.sliding, arguments.directions))
    if arguments.json:
        print(json.dumps(facts))
    else:
        _print_info(facts)
    return 0


def describe(reading: SceneReading, law: Law | None = None) -> dict[str, Any]:
    """What ``warp-lcp info`` says about a scene and what it takes under a contact law, ready for JSON; SI units.

    What depends on the whole model (dofs, pairs, contact slots, bytes) is None where the scene cannot be simulated; the largest
    LCP is also None where the law is none.

    Raises:
        SceneError: there is no physics in the stage.
    """
    if not (reading.bodies or reading.shapes or reading.joints):
        from .usd import load_usd

        load_usd(reading.source)  # raises the error that says so
    report, model, obstacle = reading.report, None, None
    if report.unsupported:
        obstacle = f"{len(report.unsupported)} unsupported item(s)"
    else:
        try:
            model = reading.builder.finalize(report)
            report = model.report
        except ModelError as error:
            obstacle = str(error)
    facts: dict[str, Any] = {"scene": reading.source, "simulable": model is not None, "obstacle": obstacle}
    facts |= {"bodies": [{"name": n, "joint": None, "mass": None, "dofs": None} for n in reading.bodies]}
    facts |= {"joints": [{"name": n, "type": None} for n in reading.joints]}
    facts |= {"shapes": [{"name": n, "type": None, "body": None} for n in reading.shapes]}
    unknown = ("dofs", "pairs", "contact_slots", "max_contacts", "joint_rows", "joint_row_kinds", "largest_lcp", "bytes_per_env", "kernels")
    facts |= dict.fromkeys(unknown)
    if model is not None:
        facts |= _model_facts(model, law or Law())
    facts["friction"] = (law or Law()).friction
    mass = reading.mass if model is None else float(model.mass[model.movable[:-1]].sum())  # less what joints hold to the world
    facts |= {"mass": mass, "gravity": list(reading.gravity), "up_axis": reading.up_axis}
    facts |= {"meters_per_unit": reading.meters_per_unit, "kilograms_per_unit": reading.kilograms_per_unit}
    facts |= {"notes": list(report.notes), "ignored": [asdict(i) for i in report.ignored]}
    return facts | {"unsupported": [asdict(i) for i in report.unsupported]}


def _model_facts(model: Model, law: Law) -> dict[str, Any]:
    import numpy as np

    from . import cli_joints
    from .model import DofKind, JointType, ShapeType

    bodies, shapes = [], []
    own = np.bincount(model.part_of[model.dof_body[model.dof_kind != DofKind.PRESCRIBED]], minlength=model.num_bodies)
    mass = np.bincount(model.part_of, model.mass, model.num_bodies)
    for b in model.scene_bodies:
        joint = JointType(model.joint_type[b]).name.lower()
        weight = float(mass[b]) if model.movable[b] else None
        bodies.append({"name": model.body_names[b], "joint": joint, "mass": weight, "dofs": int(own[b])})
    for name, kind, body in zip(model.shape_names, model.shape_type, model.shape_body, strict=True):
        shapes.append({"name": name, "type": ShapeType(kind).name.lower(), "body": model.body_names[body] if body >= 0 else None})
    pairs = [[model.shape_names[a], model.shape_names[b]] for a, b in model.pairs]
    return ledger(model, law) | {"bodies": bodies, "shapes": shapes, "pairs": pairs, "joints": cli_joints.describe(model)}


def ledger(model: Model, law: Law | None = None) -> dict[str, Any]:
    """What a model takes under a contact law: degrees of freedom, contact slots, contacts, rows of joints and unknowns of the LCP
    at most (None where the law is none), bytes of one more environment, names of the kernels."""
    from . import articulation, cli_joints
    from .methods import LCP_UNKNOWNS
    from .stages import kernel_names

    law = law or Law()
    joint_rows = len(articulation.rows(model)) if model.articulated else 0
    return {
        "dofs": model.dofs,
        "contact_slots": model.num_slots,
        "max_contacts": model.max_contacts,
        "joint_rows": joint_rows,
        "joint_row_kinds": cli_joints.row_kinds(model),
        "largest_lcp": None if law.is_cone else min(model.max_contacts + joint_rows, LCP_UNKNOWNS // law.unknowns) * law.unknowns,
        "bytes_per_env": bytes_per_env(model, law),
        "kernels": kernel_names(model, law=law),
    }


def bytes_per_env(model: Model, law: Law | None = None) -> int:
    """Bytes that one more environment takes, float64: state, contacts and their history, without the method's workspace."""
    import warp as wp

    from . import articulation
    from .kernels import restitution
    from .kernels.types import scalar_types
    from .methods import chosen

    types, law = scalar_types(wp.float64), law or Law()
    rows = model.max_contacts + (len(articulation.rows(model)) if model.articulated else 0)
    widths = {types.Bodies: model.num_bodies, types.Slots: model.num_slots, types.Contacts: rows}
    if model.bounces:
        widths[restitution.make(wp.float64).Bounces] = model.max_contacts
    total = 2 * 8 * (model.nq + model.nv)  # q, q0, v, v0
    total += 2 * model.num_bodies * wp.types.type_size_in_bytes(types.spatial)  # wrench, next velocity
    total += 4 * 4 + 3 * 8  # status, iterations, unsolved, reason; residuals
    methods = [method(model, wp.float64, law) for method in chosen("auto", "float64", law, model.articulated)]
    total += 4 * (len(methods) + any(method.judges for method in methods))  # lists of environments
    total += 4 * (len(model.kind_pairs) + len(model.pairs))  # list of pairs
    if model.articulated:
        total += 2 * 4 + sum(number * wp.types.type_size_in_bytes(dtype) for _, number, dtype in articulation.layout(model, wp.float64))
    for bundle, width in widths.items():
        for name, variable in bundle.vars.items():
            if not isinstance(variable.type, wp.array):  # a number
                continue
            if (name == "slip" and not law.is_cone) or (name in ("hit", "alert") and not model.bodies_meet):
                continue
            if name in ("coefficient", "combine", "again"):  # for all alike
                continue
            number = (len(model.shape_body) if model.bounded else 0) if name == "bounds" else 1 if variable.type.ndim == 1 else width
            total += wp.types.type_size_in_bytes(variable.type.dtype) * number
    return total


def _shown_lcp(facts: dict[str, Any]) -> str:
    if not facts["simulable"]:
        return "?"
    rows = f"{facts['max_contacts']} contacts"
    if facts["joint_rows"]:
        kinds = ", ".join(f"{number} {kind}" for kind, number in facts["joint_row_kinds"].items() if number)
        rows += f", {facts['joint_rows']} of joints: {kinds}"
    if facts["largest_lcp"] is None:
        return f"none, the cone itself ({rows})"
    return f"{facts['largest_lcp']} unknowns ({rows})"


def _print_info(facts: dict[str, Any]) -> None:
    from rich.markup import escape

    console = _console()
    say = partial(console.print, soft_wrap=True, highlight=False)
    say(f"[bold]{escape(facts['scene'])}[/]")
    if not facts["simulable"]:
        say(f"[bold red]cannot be simulated:[/] {escape(facts['obstacle'])}")
    numbers = {
        "free mass": _shown(facts["mass"], " kg"),
        "gravity": f"{' '.join(f'{g:.6g}' for g in facts['gravity'])} m/s², {facts['up_axis']} up",
        "degrees of freedom": _shown(facts["dofs"]),
        "shape pairs": "?" if facts["pairs"] is None else str(len(facts["pairs"])),
        "contact slots": _shown(facts["contact_slots"]),
        "friction": facts["friction"],
        "largest LCP": _shown_lcp(facts),
        "memory": "?"
        if facts["bytes_per_env"] is None
        else f"{facts['bytes_per_env']} bytes an environment, without the method's workspace",
    }
    numbers["kernels"] = "?" if facts["kernels"] is None else ", ".join(facts["kernels"])
    console.print(_table("", ("", ""), numbers.items()))
    bodies = [(b["name"], *(_shown(b[key]) for key in ("joint", "mass", "dofs"))) for b in facts["bodies"]]
    console.print(_table(f"bodies: {len(bodies)}", ("name", "joint", "mass / kg", "dofs"), bodies))
    shapes = [(s["name"], _shown(s["type"]), s["body"] or ("world" if facts["simulable"] else "?")) for s in facts["shapes"]]
    console.print(_table(f"shapes: {len(shapes)}", ("name", "type", "body"), shapes))
    if facts["joints"]:
        from . import cli_joints

        listed = cli_joints.cells(facts["joints"])
        used = [k for k in range(len(cli_joints.HEADER)) if k < 4 or any(row[k] for row in listed)]
        header = tuple(cli_joints.HEADER[k] for k in used)
        console.print(_table(f"joints: {len(facts['joints'])}", header, (tuple(row[k] for k in used) for row in listed)))
    for what in ("unsupported", "ignored"):
        if facts[what]:
            rows = ((i["path"], i["what"], i["why"]) for i in facts[what])
            console.print(_table(f"{what}: {len(facts[what])}", ("prim", "what", "why"), rows))
    for note in facts["notes"]:
        say(f"note: {escape(note)}")


# ------------------------------------------------------------------------------------------------------------------ run


def _run(arguments: argparse.Namespace) -> int:
    steps = _steps(arguments.duration, arguments.dt)
    if arguments.every is not None and arguments.every < 1:
        raise WarpLcpError(f"--every is {arguments.every}; give a whole number of at least 1")
    out = None if arguments.out is None else _writable(arguments.out)
    from .usd import load_usd

    model = load_usd(arguments.scene)
    _start_warp()
    with ExitStack() as stack:
        begin = time.perf_counter()
        sim = _simulator(model, arguments)
        start_up = time.perf_counter() - begin
        logger = _logger(sim, arguments)
        if logger is not None:
            stack.enter_context(logger)
        recorder = None if out is None else Recorder(sim, steps, arguments.every or 1)
        every = 1 if recorder is None else recorder.every
        # Samples fall on recorded rows, so that a row's status and iterations are those of one call of step().
        tally = Tally(sim, every * math.ceil(steps / SAMPLES / every))
        seconds, interrupted = _advance(sim, steps, logger, recorder, tally)
        if out is not None and recorder is not None:
            _save(out, recorder)
        facts = tally.summary()
        facts |= {"scene": model.report.source, "device": str(sim.device), "dt": sim.dt, "method": sim.method, "precision": sim.precision}
        facts |= {"formulation": sim.formulation, "wall_time": seconds, "start_up_time": start_up, "interrupted": interrupted}
        facts["env_steps_per_second"] = facts["env_steps"] / seconds if seconds > 0.0 else None
        facts |= {"out": arguments.out, "rerun": None if logger is None else logger.address}
        if arguments.json:
            print(json.dumps(facts), flush=True)
        else:
            _print_summary(facts)
        if arguments.rerun == "serve" and not interrupted:
            _wait()
    return 130 if interrupted else 0


def _steps(duration: float, dt: float) -> int:
    if not (math.isfinite(dt) and dt > 0.0):
        raise WarpLcpError(f"--dt is {dt} s; it must be finite and greater than zero")
    if not (math.isfinite(duration) and duration > 0.0):
        raise WarpLcpError(f"--duration is {duration} s; it must be finite and greater than zero")
    steps = round(duration / dt)
    if steps < 1:
        raise WarpLcpError(f"--duration {duration:g} s is less than one step of {dt:g} s; give a longer one or a smaller --dt")
    return steps


def _writable(name: str) -> Path:
    """The path, if a file can be written there; found out before the run, not after it."""
    path = Path(name)
    if path.suffix != ".npz":
        raise WarpLcpError(f"--out {name}: give a file ending in .npz")
    existed = path.exists()
    try:
        with path.open("ab"):
            pass
        if not existed:
            path.unlink()
    except OSError as error:
        raise WarpLcpError(f"--out {name}: cannot be written: {error.strerror}; give another file") from error
    return path


def _start_warp() -> None:
    """Initialise Warp without its chatter."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    # Warp's native code writes on file descriptor 2 that there is no CUDA driver. Who asked for a GPU is told otherwise.
    with tempfile.TemporaryFile() as said:
        stderr = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        said.seek(0)
        for line in said.read().decode(errors="replace").splitlines():
            if "Could not find or load the NVIDIA CUDA driver" not in line:
                print(line, file=sys.stderr)


def _device(name: str | None) -> Any:
    """The Warp device of --device."""
    import warp as wp

    aliases = ["cuda"] if wp.get_cuda_device_count() else []  # the current one; asking for it without any makes Warp chatter
    devices = [*(str(d) for d in wp.get_devices()), *aliases]
    if name not in (None, *devices):
        raise WarpLcpError(f"--device {name}: there is no such device; choose from: {', '.join(devices)}")
    return wp.get_device(name)


def _simulator(model: Model, arguments: argparse.Namespace) -> Simulator:
    names = ("dt", "formulation", "method", "sliding", "directions", "rho_scale", "precision", "integrator")
    options = {name: getattr(arguments, name) for name in names}
    device = _device(arguments.device)
    law = Law(arguments.formulation, arguments.sliding, arguments.directions)
    needed, there = arguments.envs * bytes_per_env(model, law), _memory() if device.is_cpu else device.free_memory
    if needed > there:
        raise WarpLcpError(f"--envs {arguments.envs} takes {needed / 1e9:.3g} GB, {device} has {there / 1e9:.3g} GB; give fewer")
    with _status("compiling kernels (first run only)"):
        from .simulator import Simulator

        sim = Simulator(model, arguments.envs, device=device, **options)
        sim.step(0)  # records the step, so that the clock runs over stepping alone
    return sim


def _logger(sim: Simulator, arguments: argparse.Namespace) -> RerunLogger | None:
    if arguments.rerun is None:
        return None
    from .logger import RerunLogger

    try:
        return RerunLogger(sim, arguments.rerun, every=arguments.every)
    except MissingExtra:
        raise
    except WarpLcpError as error:
        raise WarpLcpError(f"--rerun {error}") from error


def _advance(sim: Simulator, steps: int, logger: RerunLogger | None, recorder: Recorder | None, tally: Tally) -> tuple[float, bool]:
    """Take the steps, in calls as long as recording allows; returns wall time [s] and whether Ctrl-C ended it early."""
    import warp as wp
    from tqdm import tqdm

    strides = [tally.stride, *([recorder.every] if recorder else []), *([logger.every] if logger else [])]
    done, interrupted = 0, False
    bar = tqdm(total=steps, unit="step", disable=not sys.stderr.isatty(), leave=False)
    begin = time.perf_counter()
    try:
        if logger is not None:
            logger.log()
        while done < steps:
            count = min(steps, *((done // s + 1) * s for s in strides)) - done
            sim.step(count)
            done += count
            tally.add(count)
            if recorder is not None and done % recorder.every == 0:
                recorder.add()
            if logger is not None:
                logger.log()
            bar.update(count)
        wp.synchronize_device(sim.device)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        bar.close()
    return time.perf_counter() - begin, interrupted


@dataclass
class Tally:
    """Statistics of a run, taken where it stops between two calls of step(); ``stride`` steps apart at most."""

    sim: Simulator
    stride: int
    steps: int = 0
    iterations: int = 0
    seen: Any = 0
    worst: float = 0.0
    residuals: list[np.ndarray] = field(default_factory=list)
    contacts: list[float] = field(default_factory=list)

    def add(self, count: int) -> None:
        """After sim.step(count): status and iterations of all its steps, residual and contacts of the last."""
        self.steps += count
        self.iterations += int(self.sim.iterations.numpy().sum(dtype=np.int64))
        self.seen = self.seen | self.sim.status.numpy()
        residual = self.sim.residual.numpy()
        self.worst = float(np.maximum(self.worst, residual.max()))  # keeps NaN
        if self.steps % self.stride == 0:  # not more often, whatever is recorded: a long run must not fill the memory
            self.residuals.append(residual.copy())
            self.contacts.append(float(self.sim.contacts.count.numpy().mean()))

    def summary(self) -> dict[str, Any]:
        from .simulator import INFORMATIVE, Status

        residual = np.concatenate(self.residuals) if self.residuals else np.full(1, np.nan)
        env_steps = self.steps * self.sim.num_envs
        bits = {str(bit.name): int(np.count_nonzero(self.seen & bit)) for bit in Status if bit}
        return {
            "envs": self.sim.num_envs,
            "steps": self.steps,
            "env_steps": env_steps,
            "simulated_time": self.steps * self.sim.dt,
            "residual_worst": _finite(self.worst),
            "residual_p99": _finite(np.percentile(residual, 99)),
            "residual_samples": len(self.residuals) * self.sim.num_envs,
            "envs_not_ok": int(np.count_nonzero(self.seen & ~INFORMATIVE)),
            "status": bits,
            "contacts_mean": float(np.mean(self.contacts)) if self.contacts else None,
            "iterations_mean": self.iterations / env_steps if env_steps else None,
            "loops_open": self._loops_open(),
        }

    def _loops_open(self) -> dict[str, float | None] | None:
        """How far loops are open at the end, at most."""
        if not self.sim.model.loops:
            return None
        way, turn = self.sim.loop_gaps().max(axis=(0, 1))
        return {"m": _finite(way), "rad": _finite(turn)}


class Recorder:
    """Rows for --out: the state at t = 0 and then every so many steps, on the host, allocated once.

    T rows, E environments, B bodies of the scene: time [T] s, pose [T, E, B, 7] (x y z qx qy qz qw), velocity [T, E, B, 6] (of the
    centre of mass, angular; world axes), status [T, E] and iterations [T, E] of all steps since the row before,
    residual [T, E] m/s of the last of them. With joints also q [T, E, nq] and v [T, E, nv].
    """

    def __init__(self, sim: Simulator, steps: int, every: int):
        self.sim, self.every, self.rows = sim, every, 0
        self.bodies = sim.model.scene_bodies
        total, e, b = steps // every + 1, sim.num_envs, len(self.bodies)
        real = sim.residual.numpy().dtype
        layout = {"time": ((), np.dtype(float)), "pose": ((e, b, 7), real), "velocity": ((e, b, 6), real)}
        layout |= {"status": ((e,), np.dtype(np.int32)), "residual": ((e,), real), "iterations": ((e,), np.dtype(np.int32))}
        if sim.model.articulated:
            layout |= {"q": ((e, sim.model.nq), real), "v": ((e, sim.model.nv), real)}
        size = total * sum(math.prod(shape) * kind.itemsize for shape, kind in layout.values())
        too_large = WarpLcpError(f"--out takes {size / 1e9:.3g} GB of memory for {total} rows of {e} environments; give a larger --every")
        if size > _memory():
            raise too_large
        try:
            self.arrays = {name: np.empty((total, *shape), kind) for name, (shape, kind) in layout.items()}
        except MemoryError as error:
            raise too_large from error
        self.add()

    def add(self) -> None:
        sim = self.sim
        row: dict[str, Any] = {"time": sim.time}
        row |= {"pose": sim.body_pose.numpy()[:, self.bodies], "velocity": sim.body_velocity.numpy()[:, self.bodies]}
        row |= {name: getattr(sim, name).numpy() for name in self.arrays if name in ("status", "residual", "iterations", "q", "v")}
        for name, value in row.items():
            self.arrays[name][self.rows] = value
        self.rows += 1


def _memory() -> float:
    """Bytes of memory that this machine has, where the system says so."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return math.inf


def _save(path: Path, recorder: Recorder) -> None:
    model = recorder.sim.model
    names = {"body_names": np.array(model.body_names, dtype=np.str_)[recorder.bodies]}
    if model.articulated:
        names["dof_names"] = np.array(model.dof_names, dtype=np.str_)
    try:
        with path.open("wb") as file:
            np.savez(file, **names, **{name: a[: recorder.rows] for name, a in recorder.arrays.items()})  # type: ignore[arg-type]
    except OSError as error:
        raise WarpLcpError(f"--out {path}: cannot be written: {error.strerror}") from error


def _print_summary(facts: dict[str, Any]) -> None:
    console = _console()
    rate = facts["env_steps_per_second"]
    rows = {
        "environments x steps": f"{facts['envs']} x {facts['steps']} of {facts['dt']:g} s on {facts['device']}",
        "env-steps a second": f"{rate:,.0f} (start-up and compiling not counted)" if rate else "-",
        "wall time": f"{facts['wall_time']:.3g} s, start-up {facts['start_up_time']:.3g} s",
        "residual, worst": _shown(facts["residual_worst"], " m/s"),
        "residual, 99 %": f"{_shown(facts['residual_p99'], ' m/s')} of {facts['residual_samples']} sampled env-steps",
        "contacts, mean": _shown(facts["contacts_mean"]),
        "iterations, mean": f"{_shown(facts['iterations_mean'])} a step",
    }
    if facts["loops_open"]:
        way, turn = (_shown(facts["loops_open"][unit], f" {unit}") for unit in ("m", "rad"))
        rows["loops, most open"] = f"{way}, {turn} at the end"
    rows |= {f"environments with {bit}": str(count) for bit, count in facts["status"].items() if count}
    rows |= {name: facts[name] for name in ("out", "rerun") if facts[name]}
    console.print(_table("interrupted" if facts["interrupted"] else "", ("", ""), rows.items()))
    if facts["envs_not_ok"]:
        console.print(f"[bold red]{facts['envs_not_ok']} of {facts['envs']} environments were not OK[/]", highlight=False)
        if facts["status"]["UNCERTIFIED"]:
            console.print("[red]An uncertified answer was applied all the same: do not trust these environments without a look.[/]")
    else:
        console.print("every answer certified, every environment OK", highlight=False)


# --------------------------------------------------------------------------------------------------------------- output


def _console() -> Any:
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 160, emoji=False)  # :x: is part of a name


def _table(title: str, header: tuple[str, ...], rows: Any) -> Any:
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title or None, title_justify="left", box=box.SIMPLE_HEAD, show_header=any(header))
    for name in header:
        table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*(escape(str(cell)) for cell in row))
    return table


def _shown(value: Any, unit: str = "") -> str:
    """A number or word of a summary; None is what is not known or no number."""
    if value is None:
        return "?"
    return f"{value:.4g}{unit}" if isinstance(value, float) else f"{value}{unit}"


def _finite(value: float) -> float | None:
    """JSON has no NaN."""
    return float(value) if math.isfinite(value) else None


@contextmanager
def _status(text: str) -> Iterator[None]:
    """A line that stands while something takes long, for those who watch."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(text):
        yield


def _wait() -> None:
    """Keep serving until Ctrl-C: the browser reads the recording from this process."""
    print("serving until Ctrl-C", file=sys.stderr, flush=True)
    try:
        while True:
            time.sleep(3600.0)
    except KeyboardInterrupt:
        return
