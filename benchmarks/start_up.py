# SPDX-License-Identifier: Apache-2.0
"""From a fresh process to the first step: with a kernel cache that is empty, and with the one that this run has filled (CPU).

Robots beside other engines, one after the other on the same cores: machines differ by more than engines do.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

from . import robots
from .peers import Peer
from .peers.compare import OURS
from .peers.session import Refused, session
from .report import ROOT
from .robot_speed import DT, FILES, VARIANTS

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
    row: dict[str, Any] = {"scene": name, "engine": OURS}
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"WARP_CACHE_PATH": cache, "PYTHONPATH": str(ROOT)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python keeps it by default, and then has it in the second process
        for state in ("cold", "warm"):
            done = subprocess.run([sys.executable, "-c", CODE, str(scene)], env=environment, stdout=subprocess.PIPE, text=True, check=True)
            read, step, modules = done.stdout.split()[-3:]
            row |= {f"{state}_s": float(read) + float(step), "read_s": float(read), "modules": int(modules)}
    return row


def other(name: str, path: Path, peer: Peer, folder: Path) -> dict[str, Any]:
    """Seconds of two processes of another engine, from their start to the end of a robot's first step; 'refused' where it takes none."""
    robot, variant = robots.dropped(name, path, 1, DT, 1), VARIANTS[peer.name][0]
    row: dict[str, Any] = {"scene": name, "engine": f"{peer.name}, {variant}"}
    with tempfile.TemporaryDirectory() as cache:
        for state in ("cold", "warm"):
            begin = time.perf_counter()
            with session(peer, folder, Path(cache)) as running:
                try:
                    running.make(variant, robot, timed=False)
                except Refused as why:
                    return row | {"refused": str(why)}
                row[f"{state}_s"] = time.perf_counter() - begin
    return row


def measure(others: list[Peer], folder: Path, usd: Path = robots.USD) -> list[dict[str, Any]]:
    """Shipped scenes, and robots made by others where their files are, those beside other engines."""
    paths: dict[str, str | Path] = {name: name for name in SHIPPED}
    made = {Path(file).stem: usd / file for file in FILES.values() if (usd / file).exists()}
    rows = []
    for name, path in tqdm((paths | made).items(), desc="start-up", disable=None):
        rows.append(one(name, path))
        if name in made:
            rows += [other(name, made[name], peer, folder) for peer in others]
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    """One line a scene and engine."""
    lines = ["| scene | engine | cold s | warm s | of which import and USD | modules compiled | cold, of ours |", "|" + " --- |" * 7]
    ours = {r["scene"]: r["cold_s"] for r in rows if r["engine"] == OURS}
    for r in rows:
        if "refused" not in r:
            own = f"{r['read_s']:.2f} | {r['modules']}" if "read_s" in r else "- | -"
            times = f"{r['cold_s']:.1f} | {r['warm_s']:.2f} | {own} | {r['cold_s'] / ours[r['scene']]:.1f}"
            lines.append(f"| {r['scene']} | {r['engine']} | {times} |")
    lines += [f"\n{r['scene']}: refused by {r['refused']}" for r in rows if "refused" in r]
    return "\n".join(lines)
