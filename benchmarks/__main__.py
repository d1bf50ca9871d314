# SPDX-License-Identifier: Apache-2.0
"""python -m benchmarks accuracy|stability|chart|speed|robust|resources|needs|lcp|friction|paper|peers [--help]"""

from __future__ import annotations

import argparse
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import warp as wp

from . import (
    accuracy,
    chart,
    chart_picture,
    friction,
    goals,
    lcp,
    needs,
    paper,
    paper_picture,
    peers,
    report,
    resources,
    robust,
    speed,
    stability,
    step_floor,
)
from .cases import case_names
from .peers import compare


def peer_names(text: str, known: Collection[str] = tuple(peers.PEERS)) -> list[str]:
    """'all', 'none' or names with commas between them."""
    names = {"all": list(known), "none": []}.get(text, text.split(","))
    for name in names:
        if name not in known:
            raise argparse.ArgumentTypeError(f"no peer {name!r}; choose from {', '.join(known)}, or all, or none")
    return names


def arguments() -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure warp_lcp; results go to a JSON file.")
    out = argparse.ArgumentParser(add_help=False)
    out.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder of the JSON file")
    quick = argparse.ArgumentParser(add_help=False)
    quick.add_argument("--quick", action="store_true", help="fewer batch sizes and repetitions")
    place = argparse.ArgumentParser(add_help=False)
    place.add_argument("--dir", type=Path, default=peers.FOLDER, help="folder of the peers' interpreters")
    commands = parser.add_subparsers(dest="what", required=True)

    which = argparse.ArgumentParser(add_help=False)
    which.add_argument("--cases", type=case_names, default="all", metavar="all|NAME,...", help="scenes with known outcome (default: all)")
    which.add_argument("--device", default=None, help="Warp device (default: Warp's)")
    commands.add_parser("accuracy", parents=[out, quick, which], help="errors of every case against what is known of it, over step sizes")
    breaking = commands.add_parser(
        "stability", parents=[out, quick, which], help="which cases break which law, method and precision, and why"
    )
    breaking.add_argument(
        "--variants", type=stability.chosen, default="all", metavar="all|NAME;...", help="laws and methods (default: all)"
    )
    breaking.add_argument("--envs", type=int, default=None, help="randomised copies of each case (default 4096; with --quick 64)")
    charting = commands.add_parser(
        "chart", parents=[out, quick, which, place], help="speed against accuracy, beside other engines; pictures"
    )
    charting.set_defaults(cases=chart.CHARTED)
    charting.add_argument("--peers", type=peer_names, default=None, metavar="all|none|NAME,...", help="default: all; with --quick: none")
    charting.add_argument("--data", type=Path, help="draw from these kept results, measure nothing")
    charting.add_argument("--docs", type=Path, help="folder of the pictures (default: docs; with --quick: that of --out)")
    timing = commands.add_parser(
        "speed", parents=[out, quick, place], help="env-steps/s of the paper's box, start-up, mass ratios, fallback, floors, peers"
    )
    timing.add_argument("--device", default=None, help="Warp device (default: Warp's); peers are compared on the CPU")
    timing.add_argument(
        "--peers", type=peer_names, default=",".join(peers.FAST), metavar="all|none|NAME,...", help="default: %(default)s, where installed"
    )
    recorded = commands.add_parser("lcp", parents=[out, quick], help="every method for LCPs on recorded problems")
    recorded.add_argument("--problems", type=Path, default=Path("../shared/problems/lcp"), help="folder of .npz files with M, q, res")
    cones = commands.add_parser("friction", parents=[out, quick, place], help="solve_contact on recorded problems, beside other solvers")
    cones.add_argument("--problems", type=Path, default=friction.PROBLEMS, help="folder of .npz files with W, q, mu")
    cones.add_argument("--siconos", type=Path, default=Path("/usr/bin/python3"), help="Python that has Siconos (default: the system's)")
    cones.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the picture (default: docs)")
    cones.add_argument("--device", default=None, help="Warp device (default: Warp's)")
    crowd = commands.add_parser("robust", parents=[out], help="randomised environments of every shipped scene: what is certified")
    crowd.add_argument("--scenes", type=lambda text: text.split(","), default=robust.scenes(), metavar="NAME,...", help="default: all")
    crowd.add_argument("--formulations", type=lambda text: text.split(","), default=["phantom_inertia", "coulomb"], metavar="NAME,...")
    crowd.add_argument("--envs", type=int, default=4096, help="environments of each scene (default 4096)")
    crowd.add_argument("--seconds", type=float, default=10.0, help="simulated time (default 10)")
    crowd.add_argument("--device", default=None, help="Warp device (default: Warp's)")
    commands.add_parser("resources", parents=[out], help="what the kernels take of a GPU")
    commands.add_parser("needs", parents=[out, quick], help="what each scene takes and uses, and what features elsewhere cost it (CPU)")
    comparison = commands.add_parser("paper", parents=[quick], help="the paper's own comparison: formulations, lead matrices, Fig. 4")
    comparison.add_argument("--out", type=Path, help="folder of all files (default: benchmarks/results; unless --quick, docs as well)")
    others = commands.add_parser("peers", help="other engines on the same scenes").add_subparsers(dest="action", required=True)
    for action, parents, known, what in (
        ("install", [place], peers.INSTALLABLE, "make the interpreters of the peers, with pip"),
        ("compare", [out, quick, place], peers.PEERS, "the peers' table of 'speed' alone"),
    ):
        sub = others.add_parser(action, parents=parents, help=what)
        sub.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(known)} (default: all)")
        sub.set_defaults(known=known)
    found = parser.parse_args()
    if found.what == "peers":
        try:
            found.names = peer_names(",".join(found.names) or "all", found.known)
        except argparse.ArgumentTypeError as error:
            parser.error(str(error))
    return found


def compared(names: list[str], quick: bool, folder: Path) -> dict[str, Any]:
    """The comparison with those of the named peers that are installed, printed; {} if none is."""
    present, absent = peers.split(names, folder)
    if absent:
        print(f"\n{absent}")
    if not present:
        return {}
    rows = compare.measure(present, quick, folder)
    print(f"\n{compare.markdown(rows)}")
    return {"peers": rows, "peers_device": report.processor()}


def charted(asked: argparse.Namespace, device: wp.Device) -> None:
    """The chart: measured, unless its data are given, kept after every case, told and drawn."""
    if asked.data:
        try:
            rows = json.loads(asked.data.read_text())["rows"]
        except (OSError, ValueError, KeyError) as error:
            raise SystemExit(f"python -m benchmarks: error: {asked.data} holds no data of a chart: {error}") from error
    else:
        names = asked.peers if asked.peers is not None else [] if asked.quick else list(peers.PEERS)
        present, absent = peers.split(names, asked.dir)
        if absent:
            print(absent)
        for rows in chart.measure(asked.cases, present, asked.dir, device, asked.quick):
            kept = report.write(asked.out, asked.what, device, {"rows": rows})
        print(f"written to {kept}")
    print(chart.markdown(rows))
    folder = asked.docs or (asked.out if asked.quick else Path("docs"))
    folder.mkdir(parents=True, exist_ok=True)
    drawn = chart_picture.draw(rows, folder / "chart") + chart_picture.draw(rows, folder / "chart_energy", "E_uc")
    if any(row.get("path") for row in rows):
        drawn += chart_picture.draw_box(rows, folder / "chart_box")
    print(f"\ndrawn: {', '.join(str(file) for file in drawn)}")


def main() -> None:
    asked = arguments()
    wp.config.log_level = wp.LOG_WARNING
    if asked.what == "peers" and asked.action == "install":
        for name in asked.names:
            peers.INSTALLABLE[name].install(asked.dir)
            print(f"{name}: installed in {asked.dir / name}")
        return
    device = wp.get_device("cpu" if asked.what in ("peers", "needs") else getattr(asked, "device", None))
    if asked.what == "chart":
        charted(asked, device)
        return
    if asked.what == "speed":
        rows = speed.measure(device, quick=asked.quick)
        start = speed.start_up()
        print(speed.markdown(rows, start))
        stacks, failures, floors = goals.mass_ratio(asked.quick), goals.fallback(device, asked.quick), step_floor.measure(asked.quick)
        print(f"\n{goals.markdown(stacks, failures)}\n\n{step_floor.markdown(floors)}")
        data = {"start_up": start, "rows": rows, "mass_ratio": stacks, "fallback": failures, "step_floor": floors}
        report.write(asked.out, asked.what, device, data)  # kept if a peer fails
        data |= compared(asked.peers, asked.quick, asked.dir)
    elif asked.what == "peers":
        data = compared(asked.names, asked.quick, asked.dir)
        if not data:
            return
    elif asked.what == "accuracy":
        rows = accuracy.measure(device, asked.cases, asked.quick)
        print(accuracy.markdown(rows))
        data = {"rows": rows}
    elif asked.what == "stability":
        rows = stability.measure(device, asked.cases, asked.variants, asked.quick)
        crowds = stability.crowd(device, asked.cases, asked.envs or (64 if asked.quick else 4096))
        print(stability.markdown(rows, crowds))
        data = {"rows": rows, "crowds": crowds}
    elif asked.what == "paper":
        data = paper.measure(device, asked.quick)
        print(paper.markdown(data))
        if asked.out or not asked.quick:  # a quick run leaves the documents of the repository alone
            if asked.out is None:
                paper.document(paper.markdown(data))
            else:
                asked.out.mkdir(parents=True, exist_ok=True)
            paper_picture.draw(data, (asked.out or paper.DOCS) / "paper_comparison")
        asked.out = asked.out or Path("benchmarks/results")
    elif asked.what == "robust":
        rows = robust.measure(device, asked.scenes, asked.formulations, asked.envs, asked.seconds)
        print(robust.markdown(rows))
        data = {"rows": rows}
    elif asked.what == "needs":
        data = needs.measure(asked.quick)
        print(needs.markdown(data))
    elif asked.what == "lcp":
        try:
            rows = lcp.measure(device, asked.problems, quick=asked.quick)
        except FileNotFoundError as error:
            raise SystemExit(f"python -m benchmarks: error: {error}") from error
        print(lcp.markdown(rows))
        data = {"rows": rows}
    elif asked.what == "friction":
        pythons = {"Siconos": asked.siconos, "Pinocchio": peers.SOLVERS["pin"].python(asked.dir)}
        data, text = friction.run(asked.problems, device, pythons, asked.quick)
        print(text)
        if not asked.quick and any(row["rivals"] for row in data.get("recorded", [])):
            print(f"drawn: {', '.join(str(path) for path in friction.picture.draw(data['recorded'], asked.docs))}")
    else:
        table = [row for precision in ("float64", "float32") for row in resources.measure(precision)]
        print(resources.markdown(table))
        data = {"rows": [vars(row) for row in table]}
    print(f"\nwritten to {report.write(asked.out, asked.what, device, data)}")


if __name__ == "__main__":
    main()
