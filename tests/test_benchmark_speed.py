# SPDX-License-Identifier: Apache-2.0
"""What `speed` says besides env-steps/s: mass ratios and environments that fail the first method."""

import pytest
import warp as wp

from benchmarks import goals


def test_mass_ratio():
    """1000:1 sinks by its compliance, 1e6:1 by a little more than that; nothing moves sideways, and the goal is said to be reached."""
    light, heavy = goals.stack(1e3, 1), goals.stack(1e6, 1)
    assert light["z_error"] == pytest.approx(light["z_compliance"], rel=1e-3)
    assert heavy["z_error"] == pytest.approx(heavy["z_compliance"], rel=0.05)
    for row in (light, heavy):
        assert row["marked_steps"] == 0
        assert row["lateral_error"] < 1e-9
        assert 0.0 < row["step_best_s"] <= row["step_s"]
    assert "us: reached" in goals.markdown([light | {"step_s": 9e-5}], [])
    assert "us: MISSED" in goals.markdown([light | {"step_s": 2e-4}], [])
    assert "us: MISSED" in goals.markdown([light | {"step_s": 9e-5, "z_error": 3e-5}], [])


def test_one_percent_that_fails_the_first_method():
    """Just those ten are handed on, and the next method solves them."""
    row = goals.failing(wp.get_device("cpu"), "rest", 1)
    assert (row["failing_envs"], row["most_handed_on"], row["marked_envs"]) == (10, 10, 0)
    assert row["ratio"] > 0.0
    assert "1.5: MISSED" in goals.markdown([], [row | {"ratio": 1.6}])
