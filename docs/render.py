# SPDX-License-Identifier: Apache-2.0
"""Render the README's picture without a screen or a GPU: ``python docs/render.py [docs/box_on_ground.png]``.

The paper's box at 0.35 s, sliding and turning. Needs the extras usd and rerun and a Vulkan driver (on Debian: mesa-vulkan-drivers).
"""

import io
import os
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from rerun.experimental import ViewerClient

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # a clone that is not installed

import warp_lcp as wl
from warp_lcp.logger import free_port

TIME = 0.35  # s
ENVS = 1024


def record(path: Path) -> None:
    """Simulate and log the run of the README's first command."""
    sim = wl.Simulator(wl.load_usd("box_on_ground"), ENVS, dt=1e-3, device="cpu")
    with wl.RerunLogger(sim, path) as logger:
        logger.log()
        for _ in range(1000):
            sim.step()
            logger.log()


def render(recording: Path, picture: Path) -> None:
    """Screenshot of the recording at TIME, by a viewer without a window."""
    os.environ.setdefault("RERUN_ANALYTICS", "0")
    rerun = Path(sys.executable).parent / "rerun"
    with ViewerClient.spawn(headless=True, port=free_port(9876), executable_path=str(rerun)) as viewer:
        viewer.open(str(recording))
        time.sleep(2.0)
        viewer.set_time(timeline="sim_time", duration=TIME)
        time.sleep(3.0)
        image = Image.open(io.BytesIO(viewer.take_screenshot())).convert("RGB")
    bars = (0, 40, image.width, image.height)  # without the viewer's own title bar
    image.crop(bars).resize((1280, 720), Image.Resampling.LANCZOS).save(picture, optimize=True)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "box_on_ground.png")
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder) / "box_on_ground.rrd")
        render(Path(folder) / "box_on_ground.rrd", target)
