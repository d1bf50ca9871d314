# SPDX-License-Identifier: Apache-2.0
"""From a fresh process to the first step: with a kernel cache that is empty, and with the one that this run has filled (CPU)."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tqdm import tqdm

from . import robots
from .report import ROOT
from .robot_speed import FILES

SHIPPED = ("box_on_ground", "stack", "quadruped", "humanoid")
CODE = """
import sys, time
from pathlib import Path
begin = time.perf_counter()
import warp_lcp as wl
import warp as wp
wp.config.log_level = wp.LOG_WARNING
model = wl.load_usd(sys.argv[1])
read = time.perf_counter()
sim = wl.Simulator(model, device="cpu")
sim.step()
sim.q.numpy()
print(read - begin, time.perf_counter() - read, len(list(Path(wp.config.kernel_cache_dir).glob("wp_*"))))
"""


def one(name: str, scene: str | Path) -> dict[str, Any]:
    """Seconds of two processes, one after the other: import and reading of the USD file, and from there to the end of the first step."""
    row: dict[str, Any] = {"scene": name}
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"WARP_CACHE_PATH": cache, "PYTHONPATH": str(ROOT)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python keeps it by default, and then has it in the second process
        for state in ("cold", "warm"):
            done = subprocess.run([sys.executable, "-c", CODE, str(scene)], env=environment, stdout=subprocess.PIPE, text=True, check=True)
            read, step, modules = done.stdout.split()[-3:]
            row |= {f"{state}_s": float(read) + float(step), "read_s": float(read), "modules": int(modules)}
    return row


def measure(usd: Path = robots.USD) -> list[dict[str, Any]]:
    """Shipped scenes, and robots made by others where their files are."""
    paths: dict[str, str | Path] = {name: name for name in SHIPPED}
    paths |= {name: usd / file for name, file in FILES.items() if (usd / file).exists()}
    return [one(name, path) for name, path in tqdm(paths.items(), desc="start-up", disable=None)]


def markdown(rows: list[dict[str, Any]]) -> str:
    """One line a scene."""
    lines = ["| scene | cold s | warm s | of which import and USD | modules compiled |", "| --- | --- | --- | --- | --- |"]
    lines += [f"| {r['scene']} | {r['cold_s']:.1f} | {r['warm_s']:.2f} | {r['read_s']:.2f} | {r['modules']} |" for r in rows]
    return "\n".join(lines)
