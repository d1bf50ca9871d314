# SPDX-License-Identifier: Apache-2.0
"""python -m benchmarks speed|resources|lcp [--quick] [--problems DIR] [--out DIR]"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import warp as wp

from . import lcp, report, resources, speed


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure warp_lcp; results go to a JSON file.")
    parser.add_argument("what", choices=("speed", "resources", "lcp"))
    parser.add_argument("--quick", action="store_true", help="fewer batch sizes and repetitions, under 3 minutes")
    parser.add_argument("--device", default=None, help="Warp device (default: Warp's)")
    parser.add_argument("--problems", type=Path, default=Path("../shared/problems/lcp"), help="lcp: folder of .npz files with M, q, res")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder of the JSON file")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(arguments.device)
    if arguments.what == "speed":
        rows = speed.measure(device, quick=arguments.quick)
        start = speed.start_up()
        text = speed.markdown(rows, start)
        data = {"start_up": start, "rows": rows}
    elif arguments.what == "lcp":
        try:
            rows = lcp.measure(device, arguments.problems, quick=arguments.quick)
        except FileNotFoundError as error:
            parser.exit(2, f"{parser.prog}: error: {error}\n")
        text = lcp.markdown(rows)
        data = {"rows": rows}
    else:
        table = [row for precision in ("float64", "float32") for row in resources.measure(precision)]
        text = resources.markdown(table)
        data = {"rows": [vars(row) for row in table]}
    print(text)
    print(f"\nwritten to {report.write(arguments.out, arguments.what, device, json.loads(json.dumps(data)))}")


if __name__ == "__main__":
    main()
