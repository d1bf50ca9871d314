# SPDX-License-Identifier: Apache-2.0
"""The LCP benchmark counts what it says it counts, and trusts no status."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from conftest import DEVICE

import warp_lcp as wl
from benchmarks import lcp, lcp_picture, profiles


@pytest.fixture
def folder(tmp_path):
    """One file with three problems; the second has no solution."""
    M = np.array([np.eye(2), -np.eye(2), np.eye(2)])
    np.savez(tmp_path / "three.npz", M=M, q=-np.ones((3, 2)), res=np.array([0.0, 1.0, 0.0]))
    return tmp_path


def test_every_method_and_precision_is_measured(folder):
    rows = lcp.measure(wp.get_device(DEVICE), folder, quick=True)
    assert {(r["method"], r["precision"]) for r in rows} == {(m, p) for m in lcp.METHODS for p in ("float64", "float32")}
    for row in rows:
        assert (row["problems"], row["known_to_be_solvable"], row["solved"], row["wrong_ok"], row["missed_ok"]) == (3, 2, 2, 0, 0)
    text = lcp.markdown(rows)
    assert text.count("| 2 / 3 |") == len(rows)
    assert text.count("| **2 / 3** |") == len(rows)


def test_a_wrong_ok_is_counted(folder, monkeypatch):
    solve = wl.solve_lcp

    def lying(*arguments, **options):
        solution = solve(*arguments, **options)
        return replace(solution, status=wp.zeros_like(solution.status))

    monkeypatch.setattr(wl, "solve_lcp", lying)
    row = lcp.one(wp.get_device(DEVICE), folder / "three.npz", "lemke", "float64", 1)
    assert (row["solved"], row["wrong_ok"]) == (3, 1)


def test_an_absent_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"{tmp_path.name}/absent: no .npz files"):
        lcp.problems(tmp_path / "absent")


def test_profile():
    ratios = profiles.profile({"a": [1.0, 4.0, math.inf, math.inf], "b": [2.0, 2.0, 3.0, math.inf]})
    assert ratios == {"a": [1.0, 2.0], "b": [1.0, 1.0, 2.0]}


def test_times_are_those_of_problems_solved():
    """A batch's time over its number for every problem that was solved, infinity for those that were not."""
    row = {"precision": "float64", "problem": "a", "seconds_per_problem": 2.0, "right": [True, False, True]}
    other = row | {"method": "murty", "seconds_per_problem": 1.0, "right": [False, False, True]}
    rows = [row | {"method": "lemke"}, other, row | {"method": "lemke", "precision": "float32"}]
    assert lcp.times(rows, "float64") == {"lemke": [2.0, math.inf, 2.0], "murty": [math.inf, math.inf, 1.0]}


def test_picture(folder, tmp_path):
    pytest.importorskip("matplotlib")
    png, svg = lcp_picture.draw(lcp.measure(wp.get_device(DEVICE), folder, quick=True), tmp_path / "drawn" / "lcp_profile")
    assert png.read_bytes()[:4] == b"\x89PNG"
    assert all(method in svg.read_text() for method in lcp.METHODS)
