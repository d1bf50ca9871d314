# SPDX-License-Identifier: Apache-2.0
"""Render the pictures of runs without a screen or a GPU: ``python docs/render.py [box_on_ground trot]``, into this folder.

The paper's box at 0.35 s, sliding and turning (README.md), and the gait of robots.md. Needs the extras usd and rerun and a Vulkan driver
(on Debian: mesa-vulkan-drivers).
"""

import io
import os
import re
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image
from rerun.experimental import ViewerClient

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # a clone that is not installed

import warp_lcp as wl
from warp_lcp.logger import free_port

FOLDER = Path(__file__).resolve().parent


def box_on_ground(path: Path) -> float:
    """Log the run of the README's first command; returns the time of the picture [s]."""
    sim = wl.Simulator(wl.load_usd("box_on_ground"), 1024, dt=1e-3, device="cpu")
    with wl.RerunLogger(sim, path) as logger:
        logger.log()
        for _ in range(1000):
            sim.step()
            logger.log()
    return 0.35


def trot(path: Path) -> float:
    """Log the gait of docs/robots.md in sixteen environments, each at a speed of its own; returns the time of the picture [s]."""
    section = (FOLDER / "robots.md").read_text(encoding="utf-8").split("\n## A gait\n")[1].split("\n## ")[0]
    made: dict = {"np": np, "wl": wl}
    exec("\n".join(re.findall(r"```python\n(.*?)```", section, re.DOTALL)), made)
    plan, dt, envs = made["plan"][:, 0], made["dt"], 16
    rate = np.gradient(plan, dt, axis=0)
    sim = wl.Simulator(made["walker"], envs, dt, device="cpu")
    with wl.RerunLogger(sim, path) as logger:
        logger.log()
        for position, velocity in zip(plan, rate, strict=True):
            part = np.linspace(0.4, 1.0, envs)[:, None]  # of the way from standing to the gait
            sim.set_control(position=plan[0] + part * (position - plan[0]), velocity=part * velocity)
            sim.step()
            logger.log()
    return 1.75


def render(recording: Path, picture: Path, at: float) -> None:
    """Screenshot of the recording at a time [s], by a viewer without a window."""
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    rerun = Path(sys.executable).parent / "rerun"
    with ViewerClient.spawn(headless=True, port=free_port(9876), executable_path=str(rerun)) as viewer:
        viewer.open(str(recording))
        time.sleep(2.0)
        viewer.set_time(timeline="sim_time", duration=at)
        time.sleep(3.0)
        image = Image.open(io.BytesIO(viewer.take_screenshot())).convert("RGB")
    bars = (0, 40, image.width, image.height)  # without the viewer's own title bar
    image.crop(bars).resize((1280, 720), Image.Resampling.LANCZOS).save(picture, optimize=True)


if __name__ == "__main__":
    for name in sys.argv[1:] or ("box_on_ground", "trot"):
        with tempfile.TemporaryDirectory() as folder:
            recording = Path(folder) / f"{name}.rrd"
            render(recording, FOLDER / f"{name}.png", {"box_on_ground": box_on_ground, "trot": trot}[name](recording))
