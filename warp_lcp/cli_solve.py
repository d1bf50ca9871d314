# SPDX-License-Identifier: Apache-2.0
"""``warp-lcp solve FILE.npz``: a batch of problems from a file. What kind they are, the names of its arrays say."""

from __future__ import annotations

import argparse
import json
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .cli import _console, _device, _finite, _shown, _start_warp, _status, _table, _writable
from .errors import WarpLcpError


@dataclass(frozen=True)
class Kind:
    """A kind of problem file.

    Attributes:
        keys: arrays that such a file holds.
        optional: arrays that it may hold besides.
        solve: (arrays of the file, options) to an object with Warp arrays ``residual``, ``iterations``, ``status`` [B] and those
            of ``answer``. Options: ``tolerance``, ``device``, and ``method`` where one was asked for.
        answer: what --out gets of the solution, besides residual, iterations and status.
        unit: of the residual.
        tolerance: where none is asked for.
        laws: does it take --formulation and --directions?
    """

    keys: tuple[str, ...]
    optional: tuple[str, ...]
    solve: Callable[..., Any]
    answer: tuple[str, ...]
    unit: str
    tolerance: float
    laws: bool


def _lcp(arrays: dict[str, Any], **options: Any) -> Any:
    from .solve import solve_lcp

    return solve_lcp(**arrays, **options)


def _contact(arrays: dict[str, Any], **options: Any) -> Any:
    from .friction_problem import solve_contact

    return solve_contact(**arrays, **options)


#: Kinds by name; a file is of the first one whose keys it holds all.
KINDS = {
    "LCP": Kind(keys=("M", "q"), optional=("lower", "upper"), solve=_lcp, answer=("z", "w"), unit="", tolerance=1e-8, laws=False),
    "contact problem": Kind(
        keys=("W", "q", "mu"),
        optional=(),
        solve=_contact,
        answer=("impulse", "velocity", "natural_map"),
        unit="m/s",
        tolerance=1e-10,
        laws=True,
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    files = "; ".join(f"{name}: {', '.join(kind.keys)}" for name, kind in KINDS.items())
    add = parser.add_argument
    add("file", metavar="FILE.npz", help=f"one problem or a batch, by the names of its arrays ({files})")
    add("--method", metavar="M", help="solution method (default: lemke for an LCP, auto for a contact problem)")
    add("--formulation", metavar="F", help="contact problem: coulomb (default), phantom_inertia or anitescu_potra")
    add("--directions", type=int, metavar="K", help="contact problem: k of the facets (default 2); coulomb has none")
    add(
        "--tolerance",
        type=float,
        metavar="T",
        help="largest residual of an answer that counts as solved (default 1e-8 for an LCP; 1e-10 of max |q| for a contact problem)",
    )
    add("--device", metavar="D", help="Warp device, such as cpu or cuda:0 (default: a GPU if there is one)")
    add("--json", action="store_true", help="print one JSON object on stdout and nothing else there")
    add("--out", metavar="FILE.npz", help="write the solution, residual, iterations and status")


def run(arguments: argparse.Namespace) -> int:
    """Exit status 0 where every problem was solved, 1 where some were not.

    Raises:
        WarpLcpError: for a file, method, tolerance or device that cannot be used.
    """
    name, arrays = read(arguments.file)
    kind = KINDS[name]
    out = None if arguments.out is None else _writable(arguments.out)
    _start_warp()
    device = _device(arguments.device)
    tolerance = kind.tolerance if arguments.tolerance is None else arguments.tolerance
    options: dict[str, Any] = {"tolerance": tolerance, "device": device}
    for option in ("method", "formulation", "directions"):
        value = getattr(arguments, option)
        if value is not None:
            if option != "method" and not kind.laws:
                raise WarpLcpError(f"--{option}: {arguments.file} holds an {name}; only a contact problem (W, q, mu) takes it")
            options[option] = value
    begin = time.perf_counter()
    try:
        with _status("compiling kernels (first run only)"):
            solution = kind.solve(arrays, **options)
            residual, iterations, status = (getattr(solution, key).numpy() for key in ("residual", "iterations", "status"))
    except WarpLcpError as error:
        raise WarpLcpError(f"{arguments.file}: {error}") from error
    seconds = time.perf_counter() - begin
    if out is not None:
        found = {key: getattr(solution, key).numpy() for key in kind.answer}
        try:
            with out.open("wb") as file:
                np.savez(file, residual=residual, iterations=iterations, status=status, **found)
        except OSError as error:
            raise WarpLcpError(f"--out {out}: cannot be written: {error.strerror}") from error
    facts = {"file": arguments.file, "kind": name, "arrays": {key: list(array.shape) for key, array in arrays.items()}}
    facts |= {"device": str(device), "precision": str(residual.dtype), "tolerance": tolerance}
    facts |= summary(residual, iterations, status) | {"wall_time": seconds, "out": arguments.out}
    if arguments.json:
        print(json.dumps(facts), flush=True)
    else:
        _print(facts, kind.unit)
    return 0 if facts["solved"] == facts["problems"] else 1


def read(file: str) -> tuple[str, dict[str, np.ndarray]]:
    """Kind and arrays of a problem file.

    Raises:
        WarpLcpError: there is no such file, it is not an .npz, or it holds no problem.
    """
    kinds = " or ".join(f"{', '.join(kind.keys)} ({name})" for name, kind in KINDS.items())
    path = Path(file)
    if not path.is_file():
        raise WarpLcpError(f"{file}: no such file; give an .npz file with {kinds}")
    try:
        with path.open("rb") as stream:  # np.load leaves a file open that it cannot read
            stored = np.load(stream)
            if not isinstance(stored, np.lib.npyio.NpzFile):
                raise ValueError("it holds a single array")
            for name, kind in KINDS.items():
                if set(kind.keys) <= set(stored.files):
                    return name, {key: stored[key] for key in (*kind.keys, *kind.optional) if key in stored.files}
            held = ", ".join(stored.files) or "nothing"
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise WarpLcpError(f"{file}: not a readable .npz file of numbers: {error}") from error
    raise WarpLcpError(f"{file}: holds {held}; a problem file holds {kinds}")


def summary(residual: np.ndarray, iterations: np.ndarray, status: np.ndarray) -> dict[str, Any]:
    """Counts over a batch [B]; what is not a number is None."""
    from .simulator import Status

    solved = status == Status.OK
    worst = float(np.max(residual, initial=0.0))
    return {
        "problems": len(status),
        "solved": int(np.count_nonzero(solved)),
        "unsolved": np.flatnonzero(~solved).tolist(),
        "residual_worst": _finite(worst),
        "residual_worst_solved": float(np.max(residual[solved], initial=0.0)),
        "iterations_median": float(np.median(iterations)) if len(iterations) else None,
        "iterations_max": int(np.max(iterations, initial=0)),
        "status": {str(bit.name): int(np.count_nonzero(status & bit)) for bit in Status if bit},
    }


def _print(facts: dict[str, Any], unit: str) -> None:
    console = _console()
    shapes = ", ".join(f"{key} {'x'.join(map(str, shape))}" for key, shape in facts["arrays"].items())
    rows = {
        "problem": f"{facts['kind']}: {shapes}",
        "solved": f"{facts['solved']} of {facts['problems']} to {facts['tolerance']:g}{unit}",
        "residual, worst solved": _shown(facts["residual_worst_solved"], unit),
        "residual, worst": _shown(facts["residual_worst"], unit),
        "iterations": f"{_shown(facts['iterations_median'])} (median), {facts['iterations_max']} (largest)",
        "wall time": f"{facts['wall_time']:.3g} s on {facts['device']}, {facts['precision']}, compiling included",
    }
    rows |= {f"problems with {bit}": str(count) for bit, count in facts["status"].items() if count}
    if facts["out"]:
        rows["out"] = facts["out"]
    console.print(_table("", ("", ""), rows.items()))
    unsolved = facts["unsolved"]
    if unsolved:
        which = ", ".join(map(str, unsolved[:10])) + (", ..." if len(unsolved) > 10 else "")
        console.print(f"[bold red]{len(unsolved)} of {facts['problems']} problems were not solved:[/] {which}", highlight=False)
