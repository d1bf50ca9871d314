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
from .peers.session import PeerError, Refused, session
from .report import ROOT
from .robot_speed import DT, FILES, VARIANTS
from .robots import Robot

SHIPPED = ("box_on_ground", "stack", "quadruped", "humanoid")
CODE = """
import sys, time
from pathlib import Path
begin = time.perf_counter()
import warp_lcp as wl
import warp as wp
wp.config.log_level = wp.LOG_WARNING
name = sys.argv[1]
if Path(name).is_file():
    from benchmarks.robots import load
    model = load(Path(name))
else:
    model = wl.load_usd(name)
read = time.perf_counter() - begin
sim = wl.Simulator(model, device="cpu")
sim.step()
sim.q.numpy()
print("first step:", read, len(list(Path(wp.config.kernel_cache_dir).glob("wp_*"))), flush=True)
"""


def one(name: str, scene: str | Path) -> dict[str, Any]:
    """Seconds of two processes, from their start to the end of the first step, and of import and reading of the USD file in the second.

    A file that has no ground gets one (robots.load), as other engines are given.
    """
    row: dict[str, Any] = {"scene": name, "engine": OURS}
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"WARP_CACHE_PATH": cache, "PYTHONPATH": str(ROOT)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python keeps it by default, and then has it in the second process
        for state in ("cold", "warm"):
            begin = time.perf_counter()
            command = [sys.executable, "-c", CODE, str(scene)]
            with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                for line in process.stdout:
                    if line.startswith("first step:"):
                        row[f"{state}_s"] = time.perf_counter() - begin
                        read, modules = line.split()[-2:]
                        row |= {"read_s": float(read), "modules": int(modules)}
            if process.returncode != 0:
                raise subprocess.CalledProcessError(process.returncode, command)
    return row


def other(robot: Robot, peer: Peer, folder: Path) -> dict[str, Any]:
    """Seconds of two processes of another engine, from their start to the end of a robot's first step; 'refused' where there is none.

    Read no USD: they are told of our Model.
    """
    variant = VARIANTS[peer.name][0]
    row: dict[str, Any] = {"scene": robot.name, "engine": f"{peer.name}, {variant}"}
    with tempfile.TemporaryDirectory() as cache:
        try:
            for state in ("cold", "warm"):
                begin = time.perf_counter()
                with session(peer, folder, Path(cache)) as running:
                    running.make(variant, robot, timed=False)
                    row[f"{state}_s"] = time.perf_counter() - begin
        except (Refused, PeerError) as why:
            return row | {"refused": str(why)}
    return row


def measure(others: list[Peer], folder: Path, quick: bool, usd: Path = robots.USD) -> dict[str, Any]:
    """Shipped scenes, and robots made by others, beside other engines; quick: the first scene alone. 'absent': files that are not there."""
    made = {Path(file).stem: usd / file for file in FILES.values()}
    absent = [str(path) for path in made.values() if not path.exists()]
    paths: dict[str, str | Path] = {name: name for name in SHIPPED} | {name: path for name, path in made.items() if path.exists()}
    rows = []
    for name, path in tqdm(list(paths.items())[: 1 if quick else None], desc="start-up", disable=None):
        rows.append(one(name, path))
        if name in made and others:
            robot = robots.dropped(name, made[name], 1, DT, 1)
            rows += [other(robot, peer, folder) for peer in others]
    return {"rows": rows, "absent": absent}


def markdown(rows: list[dict[str, Any]]) -> str:
    """One line a scene and engine."""
    lines = ["| scene | engine | cold s | warm s | of which import and USD | modules compiled | cold, its / ours |", "|" + " --- |" * 7]
    ours = {r["scene"]: r["cold_s"] for r in rows if r["engine"] == OURS}
    for r in rows:
        if "refused" not in r:
            own = f"{r['read_s']:.2f} | {r['modules']}" if "read_s" in r else "- | -"
            times = f"{r['cold_s']:.1f} | {r['warm_s']:.2f} | {own} | {r['cold_s'] / ours[r['scene']]:.2g}"
            lines.append(f"| {r['scene']} | {r['engine']} | {times} |")
    lines += [f"\n{r['scene']}: refused by {r['refused']}" for r in rows if "refused" in r]
    return "\n".join(lines)
