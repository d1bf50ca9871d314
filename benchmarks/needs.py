# SPDX-License-Identifier: Apache-2.0
"""No more than a scene needs, measured: what every shipped scene takes and uses, and what features elsewhere add to a scene.

What is added stands on the same ground, FAR away, and never comes near. Then kernels, bytes, rows, time and the motion of the scene
itself should be what they are without it. What moves by itself has a cost of its own: it is measured as a scene alone, and
together both should cost no more than the sum. Everything in float64 on the CPU, which has one thread for all environments.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np
import warp as wp
from warp_lcp.kernels.types import HELD

import warp_lcp as wl
from warp_lcp import scenes as shipped
from warp_lcp.cli import ledger

from . import robust, scenes
from .step_floor import name_of

DEVICE = "cpu"
FAR = 1000.0
#: Ratio of times up to which they count as the same.
NOISE = 1.05

#: Quick or not: steps and repetitions of a scene with features; environments, steps (of robust.DT) and repetitions of a shipped one.
SIZES = {True: (50, 2), False: (200, 3)}
SHIPPED_SIZES = {True: (16, 60, 2), False: (64, 200, 3)}
#: Environments: numbers that no array has for another reason (`allocated`), large enough for launches not to count.
ENVS = {True: {"box": 251, "stack": 37}, False: {"box": 509, "stack": 127}}
#: A repetition is timed in slices of so many seconds at least, each the best of so many passes, by the clock of the processor time: a
#: machine that is shared stops for milliseconds, and what others do on it is not ours.
SLICE, PASSES = 1e-3, 3


# ------------------------------------------------------------------------------------------------------------ what is used


def compiled(sim: wl.Simulator) -> list[str]:
    """Names of the kernels that a simulator has loaded."""
    return [name_of(kernel) for kernel in sim.kernels]


def allocated(sim: wl.Simulator) -> int:
    """Bytes of an environment: every array of a simulator that has a row for each, without the methods' workspaces.

    Arrays are told by their length, so give the simulator more than one environment, and a number that nothing else has.
    """
    found: dict[int, int] = {}

    def visit(values: Sequence[Any]) -> None:
        for value in values:
            if isinstance(value, wp.array) and sim.num_envs in value.shape[:2] and value.size:
                found[value.ptr] = value.capacity
            elif hasattr(value, "_cls") and hasattr(value._cls, "vars"):
                visit([getattr(value, name) for name in value._cls.vars])

    visit(list(vars(sim).values()))
    return sum(found.values()) // sim.num_envs


def rows(sim: wl.Simulator) -> np.ndarray:
    """[E] rows of the LCP of the last step (eq. 39): a contact has one, and two for each of its friction directions; a loop three."""
    count, directions = sim.rows.count.numpy(), sim.rows.directions.numpy()
    sizes = np.where(directions == HELD, 3, 1 + 2 * directions)
    return np.where(np.arange(directions.shape[1]) < count[:, None], sizes, 0).sum(axis=1)


def used(sim: wl.Simulator, steps: int, bodies: int = 0) -> tuple[dict[str, float], np.ndarray]:
    """From the start: contacts and rows of an environment and step, mean and largest, and q, v of the first bodies.

    The latter as [steps, E, 13 bodies].
    """
    sim.reset()
    counts, sizes = np.empty((steps, sim.num_envs)), np.empty((steps, sim.num_envs))
    motion = np.empty((steps, sim.num_envs, 13 * bodies))
    for k in range(steps):
        sim.step()
        counts[k], sizes[k] = sim.contacts.count.numpy(), rows(sim)
        motion[k, :, : 7 * bodies], motion[k, :, 7 * bodies :] = sim.q.numpy()[:, : 7 * bodies], sim.v.numpy()[:, : 6 * bodies]
    numbers = {"contacts_mean": counts.mean(), "contacts_largest": counts.max(), "rows_mean": sizes.mean(), "rows_largest": sizes.max()}
    return {name: float(value) for name, value in numbers.items()}, motion


def times(sims: Sequence[wl.Simulator], steps: int, repetitions: int) -> np.ndarray:
    """[repetitions, simulators] seconds (of the processor) an env-step over so many steps from the start, in turns."""
    slices = []
    for sim in sims:
        sim.step(0)
        sim.reset()
        begin = time.process_time()
        sim.step(steps)  # warms up as well
        cut = min(steps, int(SLICE * steps / (time.process_time() - begin)) + 1)
        slices.append([min(cut, steps - k) for k in range(0, steps, cut)])
    result = np.empty((repetitions, len(sims)))
    for i in range(repetitions):
        best = [np.full(len(parts), np.inf) for parts in slices]
        for _ in range(PASSES):
            for sim, parts, least in zip(sims, slices, best, strict=True):
                sim.reset()
                for k, part in enumerate(parts):
                    begin = time.process_time()
                    sim.step(part)
                    least[k] = min(least[k], time.process_time() - begin)
        result[i] = [least.sum() / (steps * sim.num_envs) for sim, least in zip(sims, best, strict=True)]
    return result


def kernel_times(sims: Sequence[wl.Simulator], steps: int) -> list[dict[str, float]]:
    """Seconds an env-step in every kernel of each simulator, by name, over so many steps from the start, launched one by one."""
    spent: dict[str, np.ndarray] = {}
    step = 0

    def timed(launch: Callable[..., Any]) -> Callable[..., None]:
        def record(kernel: wp.Kernel, *args: Any, **options: Any) -> None:
            command = launch(kernel, *args, **options, record_cmd=True)
            begin = time.process_time()
            command.launch()
            spent.setdefault(name_of(kernel), np.zeros(steps))[step] += time.process_time() - begin

        return record

    best: list[dict[str, np.ndarray]] = [{} for _ in sims]
    for _ in range(PASSES):
        for sim, least in zip(sims, best, strict=True):
            sim.reset()
            spent.clear()
            with mock.patch.object(wp, "launch", timed(wp.launch)), mock.patch.object(wp, "launch_tiled", timed(wp.launch_tiled)):
                for step in range(steps):  # noqa: B007  # where `timed` adds up
                    sim._step_kernels()
            for name, seconds in spent.items():
                least[name] = np.minimum(least.get(name, np.inf), seconds)
    return [
        {name: float(seconds.sum()) / (steps * sim.num_envs) for name, seconds in least.items()}
        for sim, least in zip(sims, best, strict=True)
    ]


# ---------------------------------------------------------------------------------------------------------- shipped scenes


def shipped_scene(name: str, quick: bool) -> dict[str, Any]:
    """The ledger of a shipped scene, and what environments with random starts, masses and friction use of it."""
    envs, steps, repetitions = SHIPPED_SIZES[quick]
    model = wl.load_usd(name)
    sim = wl.Simulator(model, envs, robust.DT, device=DEVICE)
    robust.randomise(sim)
    usage, _ = used(sim, steps)
    seconds = times([sim], steps, repetitions)[:, 0].tolist()
    size = {"q": model.nq, "v": model.nv, "pairs": len(model.pairs)}
    run = {"envs": envs, "steps": steps, "dt": robust.DT, "env_step_s": statistics.median(seconds), "env_step_range_s": _range(seconds)}
    return {"scene": name} | size | ledger(model) | usage | run


def _range(values: Sequence[float]) -> list[float]:
    return [min(values), max(values)]


# ------------------------------------------------------------------------------------------- scenes with features elsewhere


@dataclass(frozen=True)
class Base:
    """Equal boxes on a plane that fall and land. pose [E, B, 7], velocity [E, B, 6]: their starts."""

    name: str
    half: float
    mass: float
    friction: float
    pose: np.ndarray
    velocity: np.ndarray

    @property
    def bodies(self) -> int:
        """Number of boxes."""
        return self.pose.shape[1]


def base(name: str, envs: int) -> Base:
    """The paper's box, thrown, or a stack of three boxes that closes gaps of a centimetre."""
    if name == "box":
        return Base(name, 0.5, 1.0, 1.0, *scenes.paper_box("tumble", envs))
    if name == "stack":
        rng = np.random.default_rng(2)
        pose, velocity = np.zeros((envs, 3, 7)), 0.1 * rng.normal(size=(envs, 3, 6))
        pose[..., 2] = 0.11 + 0.21 * np.arange(3)
        pose[..., 3:6], pose[..., 6] = 0.01 * rng.normal(size=(envs, 3, 3)), 1.0
        pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
        return Base(name, 0.1, 8.0, 0.5, pose, velocity)
    raise ValueError(f"no base {name!r}; choose from {', '.join(BASES)}")


BASES = ("box", "stack")


@dataclass(frozen=True)
class Feature:
    """Something that a scene does not ask for.

    Attributes:
        name: for tables.
        add: authors it, far away; also told the shapes that are there already.
        moves: it is a scene of its own, whose cost is added to what is expected.
        beside: name of the feature that it is compared with, together with the base; none: the base alone.
        change: what is done to the simulator.
    """

    name: str
    add: Callable[[wl.ModelBuilder, list[int]], None]
    moves: bool = False
    beside: str = ""
    change: Callable[[wl.Simulator], None] | None = None


BOUNCY = wl.Material(restitution=0.5)


def at(x: float = 0.0, z: float = 0.0) -> tuple[float, ...]:
    """Pose without a turn, x [m] beyond FAR."""
    return (FAR + x, 0.0, z, 0.0, 0.0, 0.0, 1.0)


def static_boxes(number: int, material: wl.Material | None = None) -> Callable[[wl.ModelBuilder, list[int]], None]:
    """Boxes of the world in a line."""

    def add(builder: wl.ModelBuilder, _: list[int]) -> None:
        for k in range(number):
            builder.add_box(-1, (0.5, 0.5, 0.5), pose=at(2.0 * k, 0.5), material=material)

    return add


def static_capsules(builder: wl.ModelBuilder, _: list[int]) -> None:
    """Ten of the world."""
    for k in range(10):
        builder.add_capsule(-1, 0.2, 0.5, pose=at(2.0 * k, 0.7))


def fixed_body(builder: wl.ModelBuilder, _: list[int]) -> None:
    """A box with a ball on it."""
    body = builder.add_body("rock", pose=at(), joint=wl.JointType.FIXED)
    builder.add_box(body, (0.5, 0.5, 0.5), pose=(0, 0, 0.5, 0, 0, 0, 1))
    builder.add_sphere(body, 0.5, pose=(0, 0, 1.5, 0, 0, 0, 1))


def filtered(material: wl.Material | None = None) -> Callable[[wl.ModelBuilder, list[int]], None]:
    """A box, a ball and a capsule of the world that nothing touches."""

    def add(builder: wl.ModelBuilder, others: list[int]) -> None:
        for shape in (
            builder.add_box(-1, (0.5, 0.5, 0.5), pose=at(0, 0.5), material=material),
            builder.add_sphere(-1, 0.5, pose=at(2, 0.5), material=material),
            builder.add_capsule(-1, 0.2, 0.5, pose=at(4, 0.7), material=material),
        ):
            for other in others:
                builder.filter_pair(other, shape)

    return add


def belt(builder: wl.ModelBuilder, _: list[int]) -> None:
    """A kinematic body that moves, with a surface that moves on it."""
    body = builder.add_body("belt", pose=at(0, 1.0), velocity=(0, 0.1, 0), joint=wl.JointType.KINEMATIC)
    builder.add_box(body, (1.0, 1.0, 0.1), surface_velocity=(0.5, 0, 0))


def free_ball(material: wl.Material | None = None) -> Callable[[wl.ModelBuilder, list[int]], None]:
    """At rest on the ground."""

    def add(builder: wl.ModelBuilder, _: list[int]) -> None:
        builder.add_sphere(builder.add_body("ball", pose=at(0, 0.1)), 0.1, material=material)

    return add


def free_boxes(builder: wl.ModelBuilder, _: list[int]) -> None:
    """Eight, at rest on the ground: slots grow with the square."""
    for k in range(8):
        builder.add_box(builder.add_body(f"far{k}", pose=at(float(k), 0.1)), (0.1, 0.1, 0.1))


def randomise_last(sim: wl.Simulator) -> None:
    """The mass of the last body, another in every environment."""
    mass = np.tile(sim.model.mass, (sim.num_envs, 1))
    mass[:, -1] *= np.linspace(0.5, 2.0, sim.num_envs)
    sim.set_parameters(mass=mass)


BALL, BOX = "free ball at rest", "1 static box"
FEATURES = (
    Feature("fixed body, 2 shapes", fixed_body),
    Feature(BOX, static_boxes(1)),
    Feature("10 static boxes", static_boxes(10)),
    Feature("100 static boxes", static_boxes(100)),
    Feature("10 static capsules", static_capsules),
    Feature("3 shapes filtered out", filtered()),
    Feature("3 shapes filtered out, e = 0.5", filtered(BOUNCY)),
    Feature("1 static box, e = 0.5", static_boxes(1, BOUNCY), beside=BOX),
    Feature("kinematic belt", belt, moves=True),
    Feature(BALL, free_ball(), moves=True),
    Feature("free ball at rest, e = 0.5", free_ball(BOUNCY), moves=True),
    Feature("its mass randomised", free_ball(), beside=BALL, change=randomise_last),
    Feature("8 free boxes at rest", free_boxes, moves=True),
)
NOTHING = Feature("-", lambda builder, others: None)


def model(scene: Base | None, feature: Feature) -> wl.Model:
    """The scene, its bodies first, with the feature; without a scene, the feature alone on the ground."""
    builder = wl.ModelBuilder()
    if scene is None:
        feature.add(builder, [builder.add_plane()])
        return builder.finalize()
    material = wl.Material(scene.friction, scene.friction)
    shapes = [builder.add_plane(material=material)]
    for k in range(scene.bodies):
        body = builder.add_body(f"box{k}", pose=scene.pose[0, k], mass=scene.mass)
        shapes.append(builder.add_box(body, (scene.half,) * 3, material=material))
    feature.add(builder, shapes)
    return builder.finalize()


def simulator(scene: Base | None, feature: Feature, envs: int) -> wl.Simulator:
    """Environments of that, at their start."""
    sim = wl.Simulator(model(scene, feature), envs, scenes.DT, device=DEVICE)
    if scene is not None:
        q, v = sim.q0.numpy(), sim.v0.numpy()
        q[:, : 7 * scene.bodies], v[:, : 6 * scene.bodies] = scene.pose.reshape(envs, -1), scene.velocity.reshape(envs, -1)
        sim.q0.assign(q)
        sim.v0.assign(v)
    if feature.change is not None:
        feature.change(sim)
    sim.reset()
    return sim


def compare(scene: Base, feature: Feature, steps: int, repetitions: int) -> dict[str, Any]:
    """A scene with a feature beside what it is compared with: simulators timed in turns, and what one has more than the others."""
    envs = len(scene.pose)
    beside = next((f for f in FEATURES if f.name == feature.beside), NOTHING)
    sim, without = simulator(scene, feature, envs), simulator(scene, beside, envs)
    others = [without] + ([simulator(None, feature, envs)] if feature.moves else [])

    usage, motion = used(sim, steps, scene.bodies)
    plain, plain_motion = used(without, steps, scene.bodies)
    expected = [plain] + [used(other, steps)[0] for other in others[1:]]
    differs = (motion.view(np.uint64) != plain_motion.view(np.uint64)).any(axis=2)  # [steps, E]
    books, other_books = ledger(sim.model), [ledger(other.model) for other in others]
    kernels, needed = set(compiled(sim)), {name for other in others for name in compiled(other)}

    seconds = times([sim, *others], steps, repetitions)
    ratio, ratio_expected = seconds[:, 0] / seconds[:, 1], seconds[:, 0] / seconds[:, 1:].sum(axis=1)
    now, *rest = kernel_times([sim, *others], steps)
    growth = {name: now.get(name, 0.0) - sum(other.get(name, 0.0) for other in rest) for name in set(now).union(*rest)}
    return {
        "base": scene.name,
        "feature": feature.name,
        "beside": feature.beside,
        "alone": feature.moves,
        "pairs": len(sim.model.pairs),
        "slots": books["contact_slots"],
        "max_contacts": books["max_contacts"],
        "max_contacts_expected": sum(book["max_contacts"] for book in other_books),
        "bytes": allocated(sim),
        "bytes_base": allocated(without),
        "bytes_expected": sum(allocated(other) for other in others),
        "kernels_more": sorted(kernels - needed),
        "kernels_less": sorted(needed - kernels),
        "rows_mean": usage["rows_mean"],
        "rows_mean_expected": sum(u["rows_mean"] for u in expected),
        "contacts_mean": usage["contacts_mean"],
        "env_step_s": float(np.median(seconds[:, 0])),
        "base_env_step_s": float(np.median(seconds[:, 1])),
        "ratio": float(np.median(ratio)),
        "ratio_range": _range(ratio.tolist()),
        "ratio_expected": float(np.median(ratio_expected)),
        "ratio_expected_range": _range(ratio_expected.tolist()),
        "first_step_that_differs": int(differs.any(axis=1).argmax()) if differs.any() else None,
        "envs_that_differ": int(differs.any(axis=0).sum()),
        "largest_difference": float(np.abs(motion - plain_motion)[..., : 7 * scene.bodies].max()),
        "kernel_growth_s": dict(sorted(growth.items(), key=lambda item: -abs(item[1]))),
    }


def changed(row: dict[str, Any]) -> list[str]:
    """What a feature changes that it should not: more than the scene and what it is compared with have together."""
    found = []
    if row["kernels_more"]:
        found.append("kernels")
    if row["bytes"] > row["bytes_expected"]:
        found.append("bytes")
    if abs(row["rows_mean"] - row["rows_mean_expected"]) > 1e-9 * row["rows_mean_expected"]:
        found.append("rows")
    if row["ratio_expected"] > NOISE:
        found.append("time")
    if row["envs_that_differ"]:
        found.append("motion")
    return found


# ----------------------------------------------------------------------------------------------------------------- measure


def measure(quick: bool) -> dict[str, Any]:
    """Both tables."""
    steps, repetitions = SIZES[quick]
    bases = [base(name, ENVS[quick][name]) for name in BASES]
    return {
        "scenes": [shipped_scene(name, quick) for name in shipped.names()],
        "envs": ENVS[quick],
        "steps": steps,
        "repetitions": repetitions,
        "features": [compare(scene, feature, steps, repetitions) for scene in bases for feature in FEATURES],
    }


def markdown(data: dict[str, Any]) -> str:
    """Both tables."""
    run = data["scenes"][0]
    lines = [
        f"Shipped scenes; used: mean (largest) of an environment and step of {run['envs']} with random starts, "
        f"{run['steps'] * run['dt']:g} s at {1e3 * run['dt']:g} ms",
        "",
        "| scene | q, v (dofs) | pairs | slots | contacts at most | LCP rows at most | bytes an env | contacts used | rows used "
        "| us an env-step (range) | kernels |",
        "|" + " --- |" * 11,
    ]
    for r in data["scenes"]:
        low, high = r["env_step_range_s"]
        lines.append(
            f"| {r['scene']} | {r['q']}, {r['v']} ({r['dofs']}) | {r['pairs']} | {r['contact_slots']} | {r['max_contacts']} "
            f"| {r['largest_lcp']} | {r['bytes_per_env']} | {r['contacts_mean']:.1f} ({r['contacts_largest']:.0f}) "
            f"| {r['rows_mean']:.1f} ({r['rows_largest']:.0f}) | {1e6 * r['env_step_s']:.2f} ({1e6 * low:.2f} to {1e6 * high:.2f}) "
            f"| {len(r['kernels'])}: {', '.join(r['kernels'])} |"
        )
    lines += [
        "",
        f"Features far away: {' and '.join(f'{n} x {name}' for name, n in data['envs'].items())} that land, {data['steps']} steps, "
        f"{data['repetitions']} repetitions in turns. Should be: the base, with the feature named by 'beside'; where what is added "
        "moves by itself, the sum of both scenes alone",
        "",
        "| base | far away | us an env-step: base, with | times the base (range) | times what it should be (range) "
        "| bytes: base, with, should be | kernels more, less | rows used (contacts at most): with, should be | base bodies | changed "
        "| kernels that grew, ns an env-step |",
        "|" + " --- |" * 11,
    ]
    for r in data["features"]:
        names = ", ".join(["+" + n for n in r["kernels_more"]] + ["-" + n for n in r["kernels_less"]]) or "same"
        same = "bit-identical" if not r["envs_that_differ"] else f"{r['envs_that_differ']} envs differ, {r['largest_difference']:.1e} m"
        grown = ", ".join(f"{n} {1e9 * s:+.0f}" for n, s in list(r["kernel_growth_s"].items())[:4] if abs(s) > 5e-9)
        against = f" (beside {r['beside']})" if r["beside"] else " (+ alone)" if r["alone"] else ""
        lines.append(
            f"| {r['base']} | {r['feature']}{against} | {1e6 * r['base_env_step_s']:.2f}, {1e6 * r['env_step_s']:.2f} "
            f"| {_spread(r, 'ratio')} | {_spread(r, 'ratio_expected')} | {r['bytes_base']}, {r['bytes']}, {r['bytes_expected']} "
            f"| {names} | {r['rows_mean']:.2f} ({r['max_contacts']}), {r['rows_mean_expected']:.2f} ({r['max_contacts_expected']}) "
            f"| {same} | {('NOT UNCHANGED: ' + ', '.join(changed(r))) if changed(r) else 'unchanged'} | {grown or '-'} |"
        )
    return "\n".join(lines)


def _spread(row: dict[str, Any], name: str) -> str:
    low, high = row[f"{name}_range"]
    return f"{row[name]:.2f} ({low:.2f} to {high:.2f})"
