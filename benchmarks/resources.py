# SPDX-License-Identifier: Apache-2.0
"""Registers, spills and shared memory of every kernel, compiled for a GPU on any machine.

Compiles each kernel that a Simulator can create, and those of solve_lcp, rollouts and the logger, for sm_90 without a
driver, counts the entry points in the binaries and reads their resources with cuobjdump (PyPI: nvidia-cuda-cuobjdump).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import warp as wp
from warp_lcp.kernels import articulated, contact_problem, lcp, projection, record, solve_batch, watch

import warp_lcp as wl
from warp_lcp.methods import METHODS
from warp_lcp.stages import PRECISIONS

ARCHITECTURE = 90


@dataclass(frozen=True)
class Resources:
    """What one kernel takes: registers a thread, bytes of stack and local memory (spills), bytes of shared memory."""

    kernel: str
    precision: str
    registers: int
    stack: int
    local: int
    shared: int


def scenes() -> list[wl.Model]:
    """A scene with one movable body, the same with restitution, one in which every pair of shapes can meet, and one with joints."""
    made = []
    for e in (0.0, 0.5):
        single = wl.ModelBuilder()
        single.add_plane(material=wl.Material(restitution=e))
        single.add_box(single.add_body(), (0.1, 0.1, 0.1))
        made.append(single.finalize())
    many = wl.ModelBuilder()
    many.add_plane()
    for _ in range(2):
        many.add_box(many.add_body(), (0.1, 0.1, 0.1))
        many.add_sphere(many.add_body(), 0.1)
        many.add_capsule(many.add_body(), 0.1, 0.1)
        many.add_cylinder(many.add_body(), 0.1, 0.1)
        many.add_ellipsoid(many.add_body(), (0.1, 0.2, 0.3))
    many.add_mesh(-1, [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    joints = wl.ModelBuilder()
    joints.add_plane(material=wl.Material(restitution=0.5))
    joints.add_box(joints.add_body(), (0.1, 0.1, 0.1))
    link = joints.add_body(pose=(0.5, 0, 0, 0, 0, 0, 1))
    joints.add_box(link, (0.1, 0.1, 0.1))
    joints.add_joint(wl.JointType.REVOLUTE, 0, link, limit=(-1.0, 1.0), collide=True)
    joints.add_joint(wl.JointType.SPHERICAL, -1, link, loop=True)
    return [*made, many.finalize(), joints.finalize()]


def kernels(precision: str) -> dict[str, wp.Kernel]:
    """Every kernel of one precision by its name; a kernel's instances after the first as name[what it is built for]."""
    real = PRECISIONS[precision][0]
    found = {"collect_status": watch.make(), "add_seen": record.make_sum(), "solve_contacts": contact_problem.make(real)}
    found |= {name: part for name, part in vars(record.make(real)).items() if isinstance(part, wp.Kernel)}
    found |= {"dynamics": articulated.make(real).dynamics, "project": projection.make(real)}
    found |= {f"solve_batch[{method}]": solve_batch.make(real, method) for method in solve_batch.SOLVERS}
    found |= {f"assembled_lcp[{method}]": lcp.make(real, method) for method in ("lemke", "murty", "judice_pires")}
    generators = ("lemke", "murty", "judice_pires")
    found |= {f"assembled_lcp[{method}, anitescu_potra]": lcp.make(real, method, True) for method in generators}
    for model in scenes():
        bounces = "joints" if model.articulated else "restitution" if model.bounces else ""
        options = [{"method": m} for m in METHODS if precision == "float64" or m != "velocity_pivoting"]
        options.append({"method": "pgs", "integrator": "midpoint"})
        laws = [{"formulation": law} for law in ("coulomb", "hybrid")]
        for option in (*options, *laws):
            sim = wl.Simulator(model, precision=precision, device="cpu", **option)
            sim.step(0)  # modules are compiled for one device at a time
            for kernel in sim.kernels:
                if kernel not in found.values():
                    name, what = kernel.key.split("__")[-1], ", ".join(filter(None, (option.get("formulation"), bounces)))
                    found[f"{name}[{what}]" if name in found else name] = kernel
    return found


def cuobjdump() -> str:
    """The program, from PATH or from PyPI's package."""
    found = shutil.which("cuobjdump")
    if found:
        return found
    import nvidia

    programs = [p for root in nvidia.__path__ for p in Path(root).glob("*/bin/cuobjdump")]
    if not programs:
        raise FileNotFoundError("cuobjdump is missing: python -m pip install nvidia-cuda-cuobjdump")
    return str(programs[0])


def measure(precision: str) -> list[Resources]:
    """Compile every kernel of one precision and read its resources.

    Raises:
        RuntimeError: where a binary does not hold exactly the one entry point that was asked for.
    """
    program = cuobjdump()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:

        def one(name: str, kernel: wp.Kernel) -> Resources:
            (binary,) = wp.compile_aot_module(kernel.module, arch=ARCHITECTURE, module_dir=f"{folder}/{name}", use_ptx=False)
            text = subprocess.run([program, "--dump-resource-usage", str(binary)], capture_output=True, text=True, check=True).stdout
            entries = re.findall(r"Function (\S*_cuda_kernel_forward):\s+(.*)", text)
            if len(entries) != 1:
                raise RuntimeError(f"{name} ({precision}): {len(entries)} entry points in its binary instead of 1")
            use = {key: int(value) for key, value in re.findall(r"([A-Z]+):(\d+)", entries[0][1])}
            return Resources(name, precision, use["REG"], use["STACK"], use["LOCAL"], use["SHARED"])

        found = kernels(precision)
        return list(pool.map(one, found, found.values()))


def markdown(table: list[Resources]) -> str:
    """The table as Markdown."""
    lines = ["| kernel | precision | registers | stack B | local B | shared B |", "| --- | --- | --- | --- | --- | --- |"]
    lines += [f"| {r.kernel} | {r.precision} | {r.registers} | {r.stack} | {r.local} | {r.shared} |" for r in table]
    return "\n".join(lines)
