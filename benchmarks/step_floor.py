# SPDX-License-Identifier: Apache-2.0
"""Where the time of a step goes, and the least that its memory and arithmetic would take on this processor.

The paper's box at rest, on the CPU. The kernels are those that the Simulator launches, caught while it does so. Bytes: every array
that a kernel reads or writes, as its source says, once, for the contacts there are; what all environments share is in the cache and
costs nothing. Flops: counted from the formulas below, stage by stage. A floor is the longer of the two at the rates of this
processor: copying as many bytes as a step moves, and a product of matrices in the cache. What a kernel takes over its floor is its gap.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import warp as wp

import warp_lcp as wl

from . import scenes
from .friction.floor import rates

ENVS = 1024
WARM_UP = 20
#: Arrays that only environments without a certified answer touch: none here.
UNCERTIFIED_ONLY = {"best_impulse", "best_residual", "left"}


# ------------------------------------------------------------------------------------------------------------- launches


@contextmanager
def caught() -> Iterator[list[tuple[wp.Kernel, Any, list[Any]]]]:
    """(kernel, command that repeats the launch, arguments) of every launch made meanwhile."""
    found: list[tuple[wp.Kernel, Any, list[Any]]] = []

    def catching(launch: Any) -> Any:
        def record(kernel: wp.Kernel, *args: Any, **options: Any) -> None:
            command = launch(kernel, *args, **options, record_cmd=True)
            command.launch()
            found.append((kernel, command, options["inputs"]))

        return record

    with mock.patch.object(wp, "launch", catching(wp.launch)), mock.patch.object(wp, "launch_tiled", catching(wp.launch_tiled)):
        yield found


def name_of(kernel: wp.Kernel) -> str:
    """A kernel's name without that of the function that made it."""
    return str(kernel.key.rpartition("__")[2])


# ---------------------------------------------------------------------------------------------------------------- bytes


def touched(function: Any, arguments: list[Any] | None = None) -> tuple[set[str], set[str]]:
    """Arrays that a kernel, or a function it calls, reads and writes: 'parameter' or 'parameter.field', from its source.

    Branches that are decided when the kernel is compiled count if they are taken, all others always. arguments: what the
    parameters of a function are called where it is called from, None = as they are.
    """
    names = inspect.getclosurevars(function)
    known = {**names.globals, **names.nonlocals}
    tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(tree, ast.FunctionDef)
    parameters = [a.arg for a in tree.args.args]
    called = dict(zip(parameters, parameters if arguments is None else arguments, strict=False))
    read: set[str] = set()
    written: set[str] = set()

    def place(node: ast.expr) -> str | None:
        """What an expression refers to, if it is a parameter or a field of one."""
        if isinstance(node, ast.Name):
            return called.get(node.id)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and called.get(node.value.id) and node.attr != "shape":
            return f"{called[node.value.id]}.{node.attr}"
        return None

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.If) and isinstance(node.test, ast.Call) and ast.unparse(node.test.func) == "wp.static":
            taken = eval(ast.unparse(node.test.args[0]), {**known, "wp": wp})
            for child in node.body if taken else node.orelse:
                visit(child)
            return
        if isinstance(node, ast.Subscript) and (array := place(node.value)):
            (written if isinstance(node.ctx, ast.Store) else read).add(array)
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Subscript) and (array := place(node.target.value)):
            read.add(array)
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("wp.atomic_") and (array := place(node.args[0])):
            written.add(array)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and isinstance(known.get(node.func.id), wp.Function):
            inner = touched(known[node.func.id].func, [place(a) for a in node.args])
            read.update(inner[0])
            written.update(inner[1])
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(tree)
    return read, written


def moved(sim: wl.Simulator, kernel: wp.Kernel, inputs: list[Any]) -> tuple[float, float]:
    """Bytes that a launch reads and writes in the mean environment."""
    used = {id(sim.rows): contacts(sim), id(sim.slots): points(sim)}  # of the places for contacts and for points
    values = dict(zip(inspect.signature(kernel.func).parameters, inputs, strict=True))
    totals = []
    for names in touched(kernel.func):
        total = 0.0
        for name in names:
            parameter, _, field = name.partition(".")
            bundle = values[parameter]
            array = getattr(bundle, field) if field else bundle
            if array.shape[0] == sim.num_envs and (field or parameter) not in UNCERTIFIED_ONLY:
                width = int(np.prod(array.shape[1:]))
                total += wp.types.type_size_in_bytes(array.dtype) * min(width, used.get(id(bundle), width))
        totals.append(total)
    return totals[0], totals[1]


def contacts(sim: wl.Simulator) -> float:
    """In the mean environment."""
    return float(sim.contacts.count.numpy().mean())


def points(sim: wl.Simulator) -> float:
    """Slots that hold a point, in the mean environment."""
    return float((sim.slots.gap.numpy() < 1e29).sum(axis=1).mean())


# ---------------------------------------------------------------------------------------------------------------- flops


def flops(n: float, p: float, s: float) -> dict[str, float]:
    """Of every stage of one box on a plane, by the kernel that does it: n contacts, p points with a gap, s solves.

    A sum, product, quotient, root, comparison or function of one scalar is one. Parts that come up again: vector sum 3, dot 5,
    cross 9, outer product 9, matrix times vector 15, times matrix 45, inverse 42; quaternion product 28, rotation 33.
    """
    pose = 33 + 3
    mobility = 9 + 15 + 5 + 1  # 1/m + (arm x d) . I^-1 (arm x d)
    # Gyroscopic midpoint, one Newton step where nothing turns: residual, Jacobian, its inverse, their product, the test.
    gyroscopic = (15 + 3 + 15 + 9 + 3 + 3 + 3) + (45 + 9 + 9 + 9) + 42 + 15 + 3 + 6 + 6
    # Frame (slip, along, t1, t2), relaxations, depenetration, shift, load.
    row = 11 + 6 + 11 + 12 + 20 + 9 + 9 + 20 + 14 + 10
    # K and g of a contact that is closed and sticks, its four blocks, its part of the right-hand side.
    assembly = 2 * (3 + 9 + 9 + 6) + (3 + 9 + 9 + 6) + 3 + 3 * 45 + 4 * 9 + 3 + 9 + 3
    update = (3 + 9 + 3) + (15 + 3) + 12 + 25  # J x, u~, impulse, signs
    elimination = sum(1 + 3 * m + 2 * m * m for m in range(6)) + 36
    rows = n * (6 + 3 * (3 + mobility + 1) + row + 15 + 3)
    pivoting = 42 + 1 + s * (n * (assembly + update) + elimination)
    certificate = 18 + 6 + n * ((15 + 3 + 9 + 6) + (3 + 12 + 15 + 3 + 3) + 3 + 25 + 6 + 10 + 9 + 12 + 21)
    return {
        "kinematics": 7 + 1 + 4,
        "free_motion": pose + 1 + 24 + 12 + 2 * 15 + gyroscopic + 15 + 42 + 2 * 45,
        "plane_box": pose + 33 + 6 + 2 * 30 + 24 + 8 * (15 + 3 + 3 + 5 + 1) + p * 7,
        "select_contacts": 9 + p * (3 + 2 * (12 + 6) + 6 + 3),
        "solve_single": rows + pivoting + certificate,
        "integrate": (6 + 1 + 9 + 5) + (3 + 33 + 9 + 28 + 12),
    }


# -------------------------------------------------------------------------------------------------------------- measure


def copy_rate(size: float) -> float:
    """Bytes/s, read and written, of copying so many bytes: where they stay in a cache, of that cache."""
    a = np.ones(max(int(size) // 16, 1))
    b = np.empty_like(a)
    times = []
    for _ in range(30):
        begin = time.perf_counter()
        np.copyto(b, a)
        times.append(time.perf_counter() - begin)
    return 2 * a.nbytes / min(times)


def measure(quick: bool) -> dict[str, Any]:
    """Rates of the processor, one row a launch, and the step as a whole; nanoseconds, bytes and flops of an environment."""
    sim = scenes.scene("rest", ENVS).simulator(device="cpu")
    sim.step(0)
    sim.step(WARM_UP)
    with caught() as launches:
        sim._step_kernels()
    solves = float(sim.iterations.numpy().mean())  # of all steps since the count was cleared
    best, step = [np.inf] * len(launches), np.inf
    for _ in range(60 if quick else 300):  # in turns, so that a busy moment of the machine meets all of them
        for i, (_, command, _) in enumerate(launches):
            begin = time.perf_counter()
            command.launch()
            best[i] = min(best[i], time.perf_counter() - begin)
        begin = time.perf_counter()
        sim.step(5)
        step = min(step, (time.perf_counter() - begin) / 5)
    if sim.status.numpy().any():
        raise RuntimeError("an environment at rest is not OK")

    rows: list[dict[str, Any]] = []
    counted = flops(contacts(sim), points(sim), solves / (WARM_UP + 1))
    for (kernel, _, inputs), seconds in zip(launches, best, strict=True):
        read, written = moved(sim, kernel, inputs)
        row = {"kernel": name_of(kernel), "ns": 1e9 * seconds / ENVS, "read_bytes": read, "written_bytes": written}
        rows.append(row | {"flops": counted[name_of(kernel)]})
    total = {key: sum(row[key] for row in rows) for key in ("ns", "read_bytes", "written_bytes", "flops")}
    total_bytes = total["read_bytes"] + total["written_bytes"]
    rate = rates() | {"copy_bytes_per_s": copy_rate(ENVS * total_bytes), "copied_bytes": ENVS * total_bytes}
    rows += [{"kernel": "sum", **total}, {"kernel": "a step, replayed", **total, "ns": 1e9 * step / ENVS}]
    for row in rows:
        row["memory_floor_ns"] = 1e9 * (row["read_bytes"] + row["written_bytes"]) / rate["copy_bytes_per_s"]
        row["arithmetic_floor_ns"] = 1e9 * row["flops"] / rate["flops_per_s"]
    return {"rates": rate, "envs": ENVS, "contacts": contacts(sim), "rows": rows}


def markdown(data: dict[str, Any]) -> str:
    """One line a launch."""
    rate = data["rates"]
    lines = [
        f"box at rest, {data['envs']} environments, {data['contacts']:.1f} contacts: copies {rate['copied_bytes'] / 1e6:.1f} MB at "
        f"{rate['copy_bytes_per_s'] / 1e9:.1f} GB/s (reads a large array at {rate['bytes_per_s'] / 1e9:.1f}), "
        f"products of matrices {rate['flops_per_s'] / 1e9:.1f} Gflop/s",
        "",
        "| kernel | ns an env-step | bytes read + written | flops | floor of memory, of arithmetic ns | gap |",
        "|" + " --- |" * 6,
    ]
    for r in data["rows"]:
        floors = r["memory_floor_ns"], r["arithmetic_floor_ns"]
        lines.append(
            f"| {r['kernel']} | {r['ns']:.0f} | {r['read_bytes']:.0f} + {r['written_bytes']:.0f} | {r['flops']:.0f} "
            f"| {floors[0]:.0f}, {floors[1]:.0f} | {r['ns'] / max(floors):.1f}x |"
        )
    return "\n".join(lines)
