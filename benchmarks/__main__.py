# SPDX-License-Identifier: Apache-2.0
"""python -m benchmarks COMMAND: accuracy, stability, the chart, speed and the rest; --help says what each does."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

import warp as wp

from . import (
    accuracy,
    chart,
    chart_picture,
    dynamics,
    friction,
    goals,
    lcp,
    lcp_picture,
    needs,
    paper,
    paper_picture,
    peers,
    regression,
    report,
    resources,
    robot_speed,
    robust,
    speed,
    stability,
    stability_picture,
    start_up,
    step_floor,
)
from .cases import CASES, case_names
from .peers import compare

#: What `all` does, in this order; together they make every number and picture of README and docs.
EVERYTHING = (
    "start-up",
    "speed",
    "accuracy",
    "stability",
    "chart",
    "friction",
    "lcp",
    "paper",
    "dynamics",
    "robots",
    "robust",
    "resources",
    "needs",
)


def peer_names(text: str, known: Collection[str] = tuple(peers.PEERS)) -> list[str]:
    """'all', 'none' or names with commas between them."""
    names = {"all": list(known), "none": []}.get(text, text.split(","))
    for name in names:
        if name not in known:
            raise argparse.ArgumentTypeError(f"no peer {name!r}; choose from {', '.join(known)}, or all, or none")
    return names


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """What was asked for; `run` is the function that does it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure warp_lcp; results go to a JSON file.")
    out = argparse.ArgumentParser(add_help=False)
    out.add_argument("--out", type=Path, help="folder of the JSON file (default: benchmarks/results, or build/benchmarks of a part)")
    quick = argparse.ArgumentParser(add_help=False)
    quick.add_argument("--quick", action="store_true", help="less of everything, for a look; documents stay as they are")
    place = argparse.ArgumentParser(add_help=False)
    place.add_argument("--dir", type=Path, default=peers.FOLDER, help="folder of the peers' interpreters")
    device = argparse.ArgumentParser(add_help=False)
    device.add_argument("--device", default=None, help="Warp device (default: Warp's); other engines run on the CPU")
    which, few = (argparse.ArgumentParser(add_help=False) for _ in range(2))  # what a parser shares it shares with its defaults
    for parent, usual, said in ((which, list(CASES), "all"), (few, chart.CHARTED, ",".join(chart.CHARTED))):
        parent.add_argument("--cases", type=case_names, default=usual, metavar="all|NAME,...", help=f"with known outcome (default: {said})")
    docs = argparse.ArgumentParser(add_help=False)
    docs.add_argument("--docs", type=Path, help="folder of documents and pictures (default: docs, or none of a part)")
    commands = parser.add_subparsers(dest="what", required=True)

    def command(
        name: str, run: Callable[[argparse.Namespace], None], help: str, *parents: argparse.ArgumentParser
    ) -> argparse.ArgumentParser:
        made = commands.add_parser(name, parents=list(parents), help=help)
        made.set_defaults(run=run)
        return made

    command("accuracy", run_accuracy, "errors of every case against what is known of it, over step sizes", out, quick, which, docs, device)
    sub = command("stability", run_stability, "which cases break which law, method and precision, and why", out, quick, which, docs, device)
    sub.add_argument(
        "--variants", type=stability.chosen, metavar="all|some|NAME;...", help="laws and methods (default: all; with --quick: some)"
    )
    sub.add_argument("--envs", type=int, default=None, help="randomised copies of each case (default 4096; with --quick 64)")
    sub.add_argument("--data", type=Path, nargs="+", metavar="FILE", help="tell and draw what is kept there; several: joined")
    sub = command("chart", run_chart, "speed against accuracy, beside other engines; pictures", out, quick, few, docs, device, place)
    sub.add_argument("--peers", type=peer_names, default=None, metavar="all|none|NAME,...", help="default: all; with --quick: none")
    sub.add_argument("--data", type=Path, nargs="+", metavar="FILE", help="tell and draw what is kept there; several: joined")
    sub = command("speed", run_speed, "env-steps/s of the paper's box, mass ratios, fallback, floors, peers", out, quick, place, device)
    sub.add_argument(
        "--peers", type=peer_names, default=",".join(peers.FAST), metavar="all|none|NAME,...", help="default: %(default)s, where installed"
    )
    sub = command("friction", run_friction, "solve_contact on recorded problems, beside other solvers", out, quick, place, device)
    sub.add_argument("--problems", type=Path, default=friction.PROBLEMS, help="folder of .npz files with W, q, mu")
    sub.add_argument("--siconos", type=Path, default=Path("/usr/bin/python3"), help="Python that has Siconos (default: the system's)")
    sub.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the picture (default: docs)")
    sub = command("lcp", run_lcp, "every method for LCPs on recorded problems", out, quick, docs)
    sub.add_argument("--problems", type=Path, default=Path("../shared/problems/lcp"), help="folder of .npz files with M, q, res")
    sub = command("paper", run_paper, "the paper's own comparison: formulations, lead matrices, Fig. 4", quick)
    sub.add_argument("--out", type=Path, help="folder of all files (default: benchmarks/results; unless --quick, docs as well)")
    command("dynamics", run_dynamics, "kinematics, mass matrix and bias of robots from USD, beside MuJoCo's", out, quick, place)
    sub = command("robots", run_robots, "speed of robots from USD beside other engines, falling and at rest (CPU)", out, quick, place)
    sub.add_argument("names", nargs="*", metavar="ROBOT", help=f"of {', '.join(robot_speed.FILES)} (default: all)")
    known = tuple(robot_speed.VARIANTS)
    sub.add_argument(
        "--peers", type=partial(peer_names, known=known), default=",".join(known), metavar="all|none|NAME,...", help="default: %(default)s"
    )
    sub = command("robust", run_robust, "randomised environments of every shipped scene: what is certified", out, device)
    sub.add_argument("--scenes", type=lambda text: text.split(","), default=robust.scenes(), metavar="NAME,...", help="default: all")
    sub.add_argument("--formulations", type=lambda text: text.split(","), default=["phantom_inertia", "coulomb"], metavar="NAME,...")
    sub.add_argument("--envs", type=int, default=4096, help="environments of each scene (default 4096)")
    sub.add_argument("--seconds", type=float, default=10.0, help="simulated time (default 10)")
    sub = command(
        "start-up",
        run_start_up,
        "from a fresh process to the first step of robots and others, with an empty cache and a full one (CPU)",
        out,
        quick,
        place,
    )
    sub.add_argument(
        "--peers", type=partial(peer_names, known=known), default=",".join(known), metavar="all|none|NAME,...", help="default: %(default)s"
    )
    command("resources", run_resources, "what the kernels take of a GPU", out)
    command("needs", run_needs, "what each scene takes and uses, and what features elsewhere cost it (CPU)", out, quick)
    sub = command("regression", run_regression, "what got worse since the result that was kept last; status 1 if anything did")
    sub.add_argument("new", type=Path, help="JSON file of accuracy, stability, chart, peers, robots or speed")
    sub.add_argument("old", type=Path, nargs="?", help="what to compare with (default: the one kept last in benchmarks/results)")
    command("all", run_all, f"one after the other: {', '.join(EVERYTHING)}; some hours", quick)
    others = commands.add_parser("peers", help="other engines on the same scenes").add_subparsers(dest="action", required=True)
    for action, run, parents, known, what in (
        ("install", run_install, [place], peers.INSTALLABLE, "make the interpreters of the peers, with pip"),
        ("compare", run_compare, [out, quick, place], peers.PEERS, "the peers' table of 'speed' alone"),
    ):
        sub = others.add_parser(action, parents=parents, help=what)
        sub.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(known)} (default: all)")
        sub.set_defaults(known=known, run=run)
    found = parser.parse_args(words)
    if found.what == "peers":
        try:
            found.names = peer_names(",".join(found.names) or "all", found.known)
        except argparse.ArgumentTypeError as error:
            parser.error(str(error))
    return found


def keep(asked: argparse.Namespace, device: wp.Device, data: dict[str, Any], complete: bool = True) -> None:
    """Write the result, and say what got worse since the last one of its kind."""
    folder = target(asked, complete)
    path = report.path_of(folder, asked.what, device)
    before = path if path.exists() else regression.last(path, report.RESULTS)
    old = regression.read(before) if before and asked.what in regression.KINDS else None  # it may be overwritten
    print(f"\nwritten to {report.write(folder, asked.what, device, data)}")
    if old and complete:
        found = regression.worse(old, regression.read(path))
        print("\n".join([f"{len(found)} worse than in {before}", *found]))


def target(asked: argparse.Namespace, complete: bool) -> Path:
    """Folder of the JSON file: what leaves something out does not stand beside whole results."""
    quick = getattr(asked, "quick", False)
    return asked.out or (report.RESULTS if complete and not quick else report.PARTIAL)


def documents(asked: argparse.Namespace, complete: bool) -> Path | None:
    """Folder of the documents that a run writes; None where it leaves them alone."""
    return asked.docs or (report.DOCS if complete and not asked.quick else None)


def run_accuracy(asked: argparse.Namespace) -> None:
    device, complete = wp.get_device(asked.device), asked.cases == list(CASES)
    rows = accuracy.measure(device, asked.cases, asked.quick)
    print(accuracy.markdown(rows))
    keep(asked, device, {"rows": rows}, complete)
    if folder := documents(asked, complete):
        report.document("accuracy", accuracy.markdown(rows), folder / "accuracy.md")


def joined(files: list[Path], what: str, *lists: str) -> tuple[dict[str, list[Any]], dict[str, Any]]:
    """Results of a command that were kept, these lists of theirs one after the other, and what to keep with them of their circumstances."""
    parts = []
    for path in files:
        try:
            parts.append(json.loads(path.read_text()))
            if any(not isinstance(parts[-1][name], list) for name in lists):
                raise ValueError(f"{' or '.join(lists)} is no list")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SystemExit(f"python -m benchmarks: error: {path} holds no data of '{what}': {error}") from error
    headers = [{name: value for name, value in part.items() if name not in lists} for part in parts]
    return {name: [row for part in parts for row in part[name]] for name in lists}, {"parts": headers}


def no_more_than_once(rows: list[dict[str, Any]], *names: str) -> None:
    """Stop where two rows of joined results are of the same thing."""
    seen = Counter(", ".join(str(row[name]) for name in names) for row in rows)
    if again := [one for one, number in seen.items() if number > 1]:
        raise SystemExit(f"python -m benchmarks: error: {len(again)} are in two of these files, the first: {again[0]}")


def run_stability(asked: argparse.Namespace) -> None:
    """Measured and kept after every case, unless data are given; told and drawn. Parts that are joined are kept as one."""
    device = wp.get_device(asked.device)
    rows: list[dict[str, Any]] = []
    crowds: list[dict[str, Any]] = []
    if asked.data:
        data, parts = joined(asked.data, "stability", "rows", "crowds")
        no_more_than_once(data["rows"], "case", "variant", "h")
        order = list(CASES)
        if gone := {row["case"] for row in data["rows"]} - set(order):
            raise SystemExit(f"python -m benchmarks: error: no case {sorted(gone)[0]!r} any more; leave its rows out")
        rows = sorted(data["rows"], key=lambda row: order.index(row["case"]))
        crowds = sorted(data["crowds"], key=lambda row: order.index(row["scene"]))
    else:
        variants = asked.variants or stability.chosen("some" if asked.quick else "all")
        envs, parts = asked.envs or (stability.QUICK_CROWD if asked.quick else stability.CROWD), {}
        for rows in stability.measure(device, asked.cases, variants, asked.quick):
            report.write(asked.out or report.PARTIAL, asked.what, device, {"rows": rows, "crowds": crowds})
        for crowds in stability.crowd(device, asked.cases, envs):
            report.write(asked.out or report.PARTIAL, asked.what, device, {"rows": rows, "crowds": crowds})
    complete = stability.complete(rows, crowds)
    print(stability.markdown(rows, crowds))
    if not asked.data or len(asked.data) > 1:
        keep(asked, device, parts | {"rows": rows, "crowds": crowds}, complete)
    if folder := documents(asked, complete):
        report.document("stability", stability.markdown(rows, crowds), folder / "stability.md")
        stability_picture.draw(rows, folder / "stability")


def run_chart(asked: argparse.Namespace) -> None:
    """Measured and kept after every case, unless data are given; told and drawn. Parts that are joined are kept as one."""
    device = wp.get_device(asked.device)
    if asked.data:
        data, parts = joined(asked.data, "chart", "rows")
        no_more_than_once(rows := data["rows"], "case", "engine", "setting", "knob")
        complete = chart.complete(rows)
        if len(asked.data) > 1:
            keep(asked, device, parts | data, complete)
    else:
        names = asked.peers if asked.peers is not None else [] if asked.quick or device.is_cuda else list(peers.PEERS)
        if names and device.is_cuda:
            raise SystemExit("python -m benchmarks: error: other engines run on the CPU: --peers none, or --device cpu")
        present, absent = peers.split(names, asked.dir)
        if absent:
            print(absent)
        for rows in chart.measure(asked.cases, present, asked.dir, device, asked.quick):
            report.write(asked.out or report.PARTIAL, asked.what, device, {"rows": rows})
        complete = chart.complete(rows)
        keep(asked, device, {"rows": rows}, complete)
    print(chart.markdown(rows))
    if folder := documents(asked, complete):
        folder.mkdir(parents=True, exist_ok=True)
        drawn = chart_picture.draw(rows, folder / "chart") + chart_picture.draw(rows, folder / "chart_energy", "E_uc")
        if any(row.get("path") for row in rows):
            drawn += chart_picture.draw_box(rows, folder / "chart_box")
        print(f"\ndrawn: {', '.join(str(file) for file in drawn)}")
        report.document("chart", chart.markdown(rows), folder / "chart.md")


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


def run_speed(asked: argparse.Namespace) -> None:
    device = wp.get_device(asked.device)
    rows = speed.measure(device, quick=asked.quick)
    print(speed.markdown(rows))
    stacks, failures, floors = goals.mass_ratio(asked.quick), goals.fallback(device, asked.quick), step_floor.measure(asked.quick)
    print(f"\n{goals.markdown(stacks, failures)}\n\n{step_floor.markdown(floors)}")
    data = {"rows": rows, "mass_ratio": stacks, "fallback": failures, "step_floor": floors}
    report.write(target(asked, True), asked.what, device, data)  # kept if a peer fails
    keep(asked, device, data | compared(asked.peers, asked.quick, asked.dir))


def run_compare(asked: argparse.Namespace) -> None:
    if data := compared(asked.names, asked.quick, asked.dir):
        keep(asked, wp.get_device("cpu"), data)


def run_install(asked: argparse.Namespace) -> None:
    for name in asked.names:
        peers.INSTALLABLE[name].install(asked.dir)
        print(f"{name}: installed in {peers.INSTALLABLE[name].python(asked.dir).parents[1]}")


def run_friction(asked: argparse.Namespace) -> None:
    device = wp.get_device(asked.device)
    pythons = {"Siconos": asked.siconos, "Pinocchio": peers.SOLVERS["pin"].python(asked.dir)}
    data, text = friction.run(asked.problems, device, pythons, asked.quick)
    print(text)
    if not asked.quick and any(row["rivals"] for row in data.get("recorded", [])):
        print(f"drawn: {', '.join(str(path) for path in friction.picture.draw(data['recorded'], asked.docs))}")
    keep(asked, device, data)


def run_lcp(asked: argparse.Namespace) -> None:
    device = wp.get_device()
    try:
        rows = lcp.measure(device, asked.problems, quick=asked.quick)
    except FileNotFoundError as error:
        raise SystemExit(f"python -m benchmarks: error: {error}") from error
    print(lcp.markdown(rows))
    keep(asked, device, {"rows": rows})
    if folder := documents(asked, True):
        lcp_picture.draw(rows, folder / "lcp_profile")


def run_paper(asked: argparse.Namespace) -> None:
    device = wp.get_device()
    data = paper.measure(device, asked.quick)
    print(paper.markdown(data))
    if asked.out or not asked.quick:
        if asked.out is None:
            report.document("paper", paper.markdown(data), report.DOCS / "paper.md")
        else:
            asked.out.mkdir(parents=True, exist_ok=True)
        paper_picture.draw(data, (asked.out or report.DOCS) / "paper_comparison")
    keep(asked, device, data)


def run_dynamics(asked: argparse.Namespace) -> None:
    try:
        data = dynamics.measure(asked.quick, asked.dir)
    except FileNotFoundError as error:
        raise SystemExit(f"python -m benchmarks: error: {error}") from error
    print(dynamics.markdown(data))
    keep(asked, wp.get_device("cpu"), data, not data["absent"])
    if any(dynamics.problems(row) for row in data["rows"]):
        raise SystemExit(1)


def run_robots(asked: argparse.Namespace) -> None:
    names = asked.names or list(robot_speed.FILES)
    if unknown := [name for name in names if name not in robot_speed.FILES]:
        raise SystemExit(f"python -m benchmarks: error: no robot {unknown[0]!r}; choose from {', '.join(robot_speed.FILES)}")
    present, absent = peers.split(asked.peers, asked.dir)
    if absent:
        print(absent)
    try:
        data = robot_speed.measure(names, present, asked.quick, asked.dir)
    except FileNotFoundError as error:
        raise SystemExit(f"python -m benchmarks: error: {error}") from error
    print(robot_speed.markdown(data))
    complete = len(names) == len(robot_speed.FILES) and len(present) == len(robot_speed.VARIANTS) and not data["absent"]
    keep(asked, wp.get_device("cpu"), data, complete)


def run_robust(asked: argparse.Namespace) -> None:
    device = wp.get_device(asked.device)
    rows = robust.measure(device, asked.scenes, asked.formulations, asked.envs, asked.seconds)
    print(robust.markdown(rows))
    keep(asked, device, {"rows": rows})


def run_start_up(asked: argparse.Namespace) -> None:
    present, absent = peers.split(asked.peers, asked.dir)
    if absent:
        print(absent)
    data = start_up.measure(present, asked.dir, asked.quick)
    print("\n".join([start_up.markdown(data["rows"]), *(f"left out, not there: {path}" for path in data["absent"])]))
    keep(asked, wp.get_device("cpu"), data, len(present) == len(start_up.VARIANTS) and not data["absent"])


def run_resources(asked: argparse.Namespace) -> None:
    table = [row for precision in ("float64", "float32") for row in resources.measure(precision)]
    print(resources.markdown(table))
    keep(asked, wp.get_device(), {"rows": [vars(row) for row in table]})


def run_needs(asked: argparse.Namespace) -> None:
    data = needs.measure(asked.quick)
    print(needs.markdown(data))
    keep(asked, wp.get_device("cpu"), data)


def run_regression(asked: argparse.Namespace) -> None:
    try:
        before = asked.old or regression.last(asked.new, report.RESULTS)
        if before is None:
            raise ValueError(f"no result of this kind is kept in {report.RESULTS}; name one")
        found = regression.worse(regression.read(before), regression.read(asked.new))
    except ValueError as error:
        raise SystemExit(f"python -m benchmarks: error: {error}") from error
    print("\n".join([f"{len(found)} worse than in {before}", *found]))
    raise SystemExit(1 if found else 0)


def run_all(asked: argparse.Namespace) -> None:
    for name in EVERYTHING:
        print(f"\n# {name}\n", flush=True)
        takes_quick = name not in ("robust", "resources")
        again = arguments([name, *(["--quick"] if asked.quick and takes_quick else [])])
        again.run(again)


def main() -> None:
    asked = arguments()
    wp.config.log_level = wp.LOG_WARNING
    asked.run(asked)


if __name__ == "__main__":
    main()
