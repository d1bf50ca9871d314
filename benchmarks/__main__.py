# SPDX-License-Identifier: Apache-2.0
"""python -m benchmarks speed|resources|paper [--quick] [--out DIR]"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import warp as wp

from . import paper, paper_picture, report, resources, speed


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure warp_lcp; results go to a JSON file.")
    parser.add_argument("what", choices=("speed", "resources", "paper"))
    parser.add_argument("--quick", action="store_true", help="less of everything, under 3 minutes")
    parser.add_argument("--device", default=None, help="Warp device (default: Warp's)")
    parser.add_argument("--out", type=Path, help="folder of the results (default: benchmarks/results; a full paper run writes docs too)")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(arguments.device)
    if arguments.what == "speed":
        rows = speed.measure(device, quick=arguments.quick)
        start = speed.start_up()
        text = speed.markdown(rows, start)
        data = {"start_up": start, "rows": rows}
    elif arguments.what == "paper":
        data = paper.measure(device, arguments.quick)
        text = paper.markdown(data)
    else:
        table = [row for precision in ("float64", "float32") for row in resources.measure(precision)]
        text = resources.markdown(table)
        data = {"rows": [vars(row) for row in table]}
    print(text)
    path = report.write(arguments.out or Path("benchmarks/results"), arguments.what, device, json.loads(json.dumps(data)))
    print(f"\nwritten to {path}")
    if arguments.what == "paper" and (arguments.out or not arguments.quick):
        # A quick run, or one that goes elsewhere, leaves the documents of the repository alone.
        picture = path.with_suffix("")
        if arguments.out is None:
            paper.document(text)
            picture = paper.DOCS / "paper_comparison"
        paper_picture.draw(data, picture)
        print(f"drawn in {picture}.png and .svg")


if __name__ == "__main__":
    main()
