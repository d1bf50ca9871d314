# SPDX-License-Identifier: Apache-2.0
"""From a fresh process to the first steps: with a kernel cache that is empty, and with one that an earlier process has filled (CPU).

Budgets speak of import, and of what comes after it: import of USD, a file read, a simulator made, two steps. Robots beside other
engines, one after the other on the same cores, and beside a kernel of Warp that does nothing: machines differ by more than engines do.
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
import time
begin = time.perf_counter()
import warp as wp
wp.config.log_level = wp.LOG_WARNING
wp.init()
imported = time.perf_counter()

@wp.kernel(enable_backward=False)
def nothing(x: wp.array(dtype=float)):
    x[wp.tid()] = 1.0

x = wp.empty(1, dtype=float, device="cpu")
wp.launch(nothing, dim=1, inputs=[x], device="cpu")
x.numpy()
print("first:", f"import_s={imported - begin} after_import_s={time.perf_counter() - imported}", flush=True)
"""
SHIPPED = ("box_on_ground", "stack", "quadruped", "humanoid")
CODE = """
import sys, time
from pathlib import Path
begin = time.perf_counter()
from warp_lcp import Simulator, load_usd
import warp as wp
name = sys.argv[1]
if Path(name).is_file():
    from benchmarks.robots import load
    name, load_usd = Path(name), load
wp.config.log_level = wp.LOG_WARNING
imported = time.perf_counter()
model = load_usd(name)
read = time.perf_counter()
sim = Simulator(model, device="cpu")
sim.step()
sim.step()
sim.q.numpy()
after = time.perf_counter() - imported
print("first:", f"import_s={imported - begin} read_s={read - imported} after_import_s={after}", flush=True)
sim.step(0)
print("all:", f"modules={len(list(Path(wp.config.kernel_cache_dir).glob('wp_*')))}", flush=True)
"""


def timed(code: str, *arguments: str) -> dict[str, float]:
    """Seconds from the start of a process until it tells of its first steps (cold_s, warm_s) and of every kernel (cold_all_s,
    warm_all_s), and what it tells of itself: cold_import_s, warm_import_s and so on.

    Medians of so many processes with a cache of their own, and of as many as find one.
    """
    seconds: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "first_steps.py"  # Warp reads the source of kernels
        program.write_text(code)
        command = [sys.executable, str(program), *arguments]
        for state, i in [*(("cold", i) for i in range(COLD)), *(("warm", 0) for _ in range(WARM))]:
            environment = os.environ | {"WARP_CACHE_PATH": str(Path(folder) / f"cache{i}"), "PYTHONPATH": str(ROOT)}
            environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python keeps it by default, and then has it in the next process
            begin = time.perf_counter()
            with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                for line in process.stdout:
                    word, _, told = line.partition(": ")
                    if word in ("first", "all"):
                        seconds.setdefault(f"{state}_s" if word == "first" else f"{state}_all_s", []).append(time.perf_counter() - begin)
                        for name, value in (pair.split("=") for pair in told.split()):
                            seconds.setdefault(f"{state}_{name}", []).append(float(value))
            if process.returncode != 0:
                raise subprocess.CalledProcessError(process.returncode, command)
    return {name: statistics.median(each) for name, each in seconds.items()}


def one(name: str, scene: str | Path) -> dict[str, Any]:
    """Start-up of ours, and when every kernel is loaded as well.

    The first steps wait for the kernels that they need; the others, of methods that come after the first and of pairs that are far
    apart, compile in the background.

    A file that has no ground gets one (robots.load), as other engines are given.
    """
    return {"scene": name, "engine": OURS, **timed(CODE, str(scene))}


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
    rows: list[dict[str, Any]] = [{"scene": "nothing", "engine": WARP, **timed(NOTHING)}]
    for name, path in tqdm(list(paths.items())[: 1 if quick else None], desc="start-up", disable=None):
        rows.append(one(name, path))
        if name in made and others:
            robot = robots.dropped(name, made[name], 1, DT, 1)
            rows += [other(robot, peer, folder) for peer in others]
    return {"rows": rows, "absent": absent}


def markdown(rows: list[dict[str, Any]]) -> str:
    """One line a scene and engine."""
    names = (
        "cold s",
        "warm s",
        "import s",
        "USD import and read s",
        "after import, cold s",
        "warm s",
        "every kernel, cold s",
        "warm s",
        "modules",
    )
    lines = [f"| scene | engine | {' | '.join(names)} | cold, its / ours | cold, its / nothing's |", "|" + " --- |" * 13]
    ours = {r["scene"]: r["cold_s"] for r in rows if r["engine"] == OURS}
    least = next(r["cold_s"] for r in rows if r["engine"] == WARP)
    keys = ("warm_import_s", "warm_read_s", "cold_after_import_s", "warm_after_import_s", "cold_all_s", "warm_all_s", "cold_modules")
    digits = dict(zip(keys, (2, 2, 1, 2, 1, 2, 0), strict=True))
    for r in rows:
        if "refused" not in r:
            own = " | ".join(f"{r[key]:.{digits[key]}f}" if key in r else "-" for key in keys)
            of_ours = f"{r['cold_s'] / ours[r['scene']]:.2g}" if r["scene"] in ours else "-"
            times = f"{r['cold_s']:.1f} | {r['warm_s']:.2f} | {own} | {of_ours} | {r['cold_s'] / least:.2g}"
            lines.append(f"| {r['scene']} | {r['engine']} | {times} |")
    lines += [f"\n{r['scene']}: refused by {r['refused']}" for r in rows if "refused" in r]
    return "\n".join(lines)
