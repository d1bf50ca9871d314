# SPDX-License-Identifier: Apache-2.0
"""From a fresh process to the first step: with a kernel cache that is empty, and with one that an earlier process has filled (CPU).

Robots beside other engines, one after the other on the same cores, and beside a kernel of Warp that does nothing: machines differ by more
than engines do.
"""

from __future__ import annotations

import os
import statistics
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

# Processes of ours that are timed, with an empty cache and with a full one; of others, which take minutes, there is one of each.
COLD, WARM = 3, 5
WARP = "Warp"
# The measure of a machine: import of Warp, its headers and its compiler.
NOTHING = """
import warp as wp
wp.config.log_level = wp.LOG_WARNING

@wp.kernel(enable_backward=False)
def nothing(x: wp.array(dtype=float)):
    x[wp.tid()] = 1.0

x = wp.empty(1, dtype=float, device="cpu")
wp.launch(nothing, dim=1, inputs=[x], device="cpu")
x.numpy()
print("first step:", flush=True)
"""
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
print("first step:", flush=True)
sim.step(0)
print("every kernel:", read, len(list(Path(wp.config.kernel_cache_dir).glob("wp_*"))), flush=True)
"""


def timed(code: str, *arguments: str) -> tuple[dict[str, float], list[str]]:
    """Seconds from the start of a process until it tells of its first step and of every kernel, and what one tells.

    Medians of so many processes with a cache of their own, and of as many as find one.
    """
    seconds: dict[str, list[float]] = {}
    told: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "first_step.py"  # Warp reads the source of kernels
        program.write_text(code)
        command = [sys.executable, str(program), *arguments]
        for state, i in [*(("cold", i) for i in range(COLD)), *(("warm", 0) for _ in range(WARM))]:
            environment = os.environ | {"WARP_CACHE_PATH": str(Path(folder) / f"cache{i}"), "PYTHONPATH": str(ROOT)}
            environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python keeps it by default, and then has it in the next process
            begin = time.perf_counter()
            with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                for line in process.stdout:
                    for words, name in (("first step:", f"{state}_s"), ("every kernel:", f"{state}_all_s")):
                        if line.startswith(words):
                            seconds.setdefault(name, []).append(time.perf_counter() - begin)
                            told = line.split()[2:]
            if process.returncode != 0:
                raise subprocess.CalledProcessError(process.returncode, command)
    return {name: statistics.median(each) for name, each in seconds.items()}, told


def one(name: str, scene: str | Path) -> dict[str, Any]:
    """Start-up of ours, and of it import and reading of the USD file with a full cache; when every kernel is loaded as well.

    The first step waits for the kernels that it needs; the others, of methods that come after the first and of pairs that are far
    apart, compile in the background.

    A file that has no ground gets one (robots.load), as other engines are given.
    """
    seconds, (read, modules) = timed(CODE, str(scene))
    return {"scene": name, "engine": OURS, **seconds, "read_s": float(read), "modules": int(modules)}


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
    rows: list[dict[str, Any]] = [{"scene": "nothing", "engine": WARP, **timed(NOTHING)[0]}]
    for name, path in tqdm(list(paths.items())[: 1 if quick else None], desc="start-up", disable=None):
        rows.append(one(name, path))
        if name in made and others:
            robot = robots.dropped(name, made[name], 1, DT, 1)
            rows += [other(robot, peer, folder) for peer in others]
    return {"rows": rows, "absent": absent}


def markdown(rows: list[dict[str, Any]]) -> str:
    """One line a scene and engine."""
    names = (
        "scene",
        "engine",
        "cold s",
        "warm s",
        "every kernel cold s",
        "every kernel warm s",
        "of which import and USD",
        "modules compiled",
    )
    lines = [f"| {' | '.join(names)} | cold, its / ours | cold, its / nothing's |", "|" + " --- |" * 10]
    ours = {r["scene"]: r["cold_s"] for r in rows if r["engine"] == OURS}
    least = next(r["cold_s"] for r in rows if r["engine"] == WARP)
    for r in rows:
        if "refused" not in r:
            own = "- | - | - | -"
            if "read_s" in r:
                own = f"{r['cold_all_s']:.1f} | {r['warm_all_s']:.2f} | {r['read_s']:.2f} | {r['modules']}"
            of_ours = f"{r['cold_s'] / ours[r['scene']]:.2g}" if r["scene"] in ours else "-"
            times = f"{r['cold_s']:.1f} | {r['warm_s']:.2f} | {own} | {of_ours} | {r['cold_s'] / least:.2g}"
            lines.append(f"| {r['scene']} | {r['engine']} | {times} |")
    lines += [f"\n{r['scene']}: refused by {r['refused']}" for r in rows if "refused" in r]
    return "\n".join(lines)
