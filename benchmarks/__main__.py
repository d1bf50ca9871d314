# SPDX-License-Identifier: Apache-2.0
"""python -m benchmarks speed|resources|friction [--quick] [--out DIR]"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import warp as wp

from . import friction, report, resources, speed


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure warp_lcp; results go to a JSON file.")
    parser.add_argument("what", choices=("speed", "resources", "friction"))
    parser.add_argument("--quick", action="store_true", help="fewer batch sizes and repetitions, under 3 minutes")
    parser.add_argument("--device", default=None, help="Warp device (default: Warp's)")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder of the JSON file")
    group = parser.add_argument_group("friction")
    group.add_argument(
        "--problems", type=Path, default=friction.PROBLEMS, help=f"folder of recorded problems (default: {friction.PROBLEMS})"
    )
    group.add_argument("--siconos", type=Path, default=Path("/usr/bin/python3"), help="Python that has Siconos (default: the system's)")
    group.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the picture (default: docs)")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    device = wp.get_device(arguments.device)
    if arguments.what == "speed":
        rows = speed.measure(device, quick=arguments.quick)
        start = speed.start_up()
        text = speed.markdown(rows, start)
        data = {"start_up": start, "rows": rows}
    elif arguments.what == "friction":
        data, text = friction.run(arguments.problems, device, arguments.siconos, arguments.quick)
    else:
        table = [row for precision in ("float64", "float32") for row in resources.measure(precision)]
        text = resources.markdown(table)
        data = {"rows": [vars(row) for row in table]}
    print(text)
    print(f"\nwritten to {report.write(arguments.out, arguments.what, device, json.loads(json.dumps(data)))}")
    if arguments.what == "friction" and not arguments.quick and any(row["siconos"] for row in data.get("recorded", [])):
        print(f"drawn: {', '.join(str(path) for path in friction.picture.draw(data['recorded'], arguments.docs))}")


if __name__ == "__main__":
    main()
