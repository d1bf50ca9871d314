# SPDX-License-Identifier: Apache-2.0
"""``warp-lcp solve``: what it prints and writes, its exit status, and one line for bad input."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_lcp as wl
from warp_lcp.cli import main

#: Solvable, without solution (w = -z - 1), solvable.
BATCH = {"M": np.array([np.eye(2), -np.eye(2), np.eye(2)]), "q": -np.ones((3, 2))}


def problem(tmp_path, **arrays):
    path = tmp_path / "problem.npz"
    np.savez(path, **arrays)
    return path


def run(*arguments):
    return main(["solve", *map(str, arguments), "--device", "cpu"])


def facts(capsys, *arguments, status=0):
    assert run(*arguments, "--json") == status
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


def error_line(capsys, *arguments):
    assert run(*arguments) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith("warp-lcp: error: ")
    return err


def test_one_problem(tmp_path, capsys):
    path, out = problem(tmp_path, M=np.diag([2.0, 1.0]), q=np.array([-1.0, 3.0])), tmp_path / "z.npz"
    found = facts(capsys, path, "--out", out)
    assert (found["kind"], found["problems"], found["solved"], found["unsolved"]) == ("LCP", 1, 1, [])
    assert (found["arrays"], found["precision"], found["out"]) == ({"M": [2, 2], "q": [2]}, "float64", str(out))
    assert (found["residual_worst"], found["iterations_max"]) == (0.0, 2)
    with np.load(out) as answer:
        assert answer["z"].tolist() == [[0.5, 0.0]]
        assert answer["w"].tolist() == [[0.0, 3.0]]
        assert answer["status"].tolist() == [0]
        assert set(answer.files) == {"z", "w", "residual", "iterations", "status"}


def test_some_are_not_solved(tmp_path, capsys):
    path = problem(tmp_path, **BATCH)
    found = facts(capsys, path, "--method", "auto", status=1)
    assert (found["problems"], found["solved"], found["unsolved"]) == (3, 2, [1])
    assert found["residual_worst"] >= 1.0
    assert found["residual_worst_solved"] == 0.0
    assert found["status"]["UNCERTIFIED"] == found["status"]["RAY"] == 1
    assert run(path) == 1
    text = capsys.readouterr().out
    assert "2 of 3 to 1e-08" in text
    assert "1 of 3 problems were not solved: 1" in text


def test_options_reach_the_solver(tmp_path, capsys):
    rng = np.random.default_rng(0)
    M = np.eye(5) + 0.01 * rng.normal(size=(5, 5))
    path = problem(tmp_path, M=M, q=rng.normal(size=5), lower=np.full(5, -np.inf))
    for method in ("pgs", "murty"):
        found = facts(capsys, path, "--method", method, "--tolerance", 1e-6)
        expected = wl.solve_lcp(M, np.load(path)["q"], method, lower=-np.inf, tolerance=1e-6, device="cpu")
        assert found["iterations_max"] == expected.iterations.numpy()[0]
        assert found["tolerance"] == 1e-6
    assert "takes no unknowns without a lower bound" in error_line(capsys, path)  # lemke
    single = problem(tmp_path, M=np.eye(2, dtype=np.float32), q=-np.ones(2, dtype=np.float32))
    assert facts(capsys, single)["precision"] == "float32"


@pytest.mark.parametrize(
    ("arrays", "arguments", "what"),
    [
        ({"W": np.eye(2)}, (), "holds W; a problem file holds M, q (LCP)"),
        ({"M": np.eye(2), "q": np.ones(3)}, (), "M has shape (2, 2) and q (3,)"),
        ({"M": np.diag([np.nan, 1.0]), "q": np.ones(2)}, (), "M[0, 0] is nan"),
        ({"M": np.array([{}]), "q": np.ones(1)}, (), "not a readable .npz file of numbers"),
        (BATCH, ("--method", "magic"), "method is 'magic'; choose one of lemke"),
        (BATCH, ("--tolerance", "-1"), "tolerance is -1.0"),
        (BATCH, ("--tolerance", "tight"), "invalid float value: 'tight'"),
        (BATCH, ("--out", "answer.csv"), "ending in .npz"),
        (BATCH, ("--magic",), "--magic"),
    ],
)
def test_bad_input(tmp_path, capsys, arrays, arguments, what):
    assert what in error_line(capsys, problem(tmp_path, **arrays), *arguments)


def test_bad_files(tmp_path, capsys):
    assert "no such file" in error_line(capsys, tmp_path / "absent.npz")
    path = tmp_path / "text.npz"
    path.write_text("not numbers")
    assert "not a readable .npz file" in error_line(capsys, path)
    np.save(tmp_path / "single.npy", np.eye(2))
    assert "it holds a single array" in error_line(capsys, tmp_path / "single.npy")
    path.write_bytes(problem(tmp_path, **BATCH).read_bytes()[:200])
    assert "not a readable .npz file" in error_line(capsys, path)
    assert main(["solve"]) == 2
    assert "FILE.npz" in capsys.readouterr().err


def test_as_a_process(tmp_path):
    command = [sys.executable, "-m", "warp_lcp", "solve", str(problem(tmp_path, **BATCH)), "--device", "cpu", "--json"]
    done = subprocess.run(command, cwd=Path(__file__).resolve().parents[1], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (1, "")
    assert json.loads(done.stdout)["solved"] == 2
