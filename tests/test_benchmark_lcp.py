# SPDX-License-Identifier: Apache-2.0
"""The LCP benchmark counts what it says it counts, and trusts no status."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from conftest import DEVICE

import warp_lcp as wl
from benchmarks import lcp


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
