# SPDX-License-Identifier: Apache-2.0
"""What `speed` says besides env-steps/s: mass ratios, environments that fail the first method, floors of the kernels."""

import inspect

import numpy as np
import pytest
import warp as wp

import warp_lcp as wl
from benchmarks import goals, scenes, start_up, step_floor


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


def every_array(inputs) -> dict[str, wp.array]:
    """Arrays of a launch, by parameter or parameter.field."""
    found = {}
    for name, value in inputs.items():
        if isinstance(value, wp.array):
            found[name] = value
        elif hasattr(value, "_cls"):
            found |= {f"{name}.{field}": getattr(value, field) for field in value._cls.vars}
    return {name: array for name, array in found.items() if isinstance(array, wp.array) and array.size}


def launched(sim: wl.Simulator) -> list:
    """(kernel, repeatable launch, arrays by name) of the next step."""
    with step_floor.caught() as launches:
        sim._step_kernels()
    return [(k, c, every_array(dict(zip(inspect.signature(k.func).parameters, i, strict=True)))) for k, c, i in launches]


def stacked() -> wl.Simulator:
    """Boxes on boxes, that bounce, by the midpoint rule and on the cone."""
    builder = wl.ModelBuilder()
    builder.add_plane(material=wl.Material(restitution=0.5))
    for k in range(3):
        builder.add_box(builder.add_body(pose=(0, 0, 0.12 + 0.21 * k, 0, 0, 0, 1), velocity=(0.2, 0, -1)), (0.1, 0.1, 0.1))
    return wl.Simulator(builder.finalize(), 2, integrator="midpoint", formulation="coulomb", device="cpu")


def other(x: np.ndarray) -> np.ndarray:
    """Numbers that differ everywhere; small ones where they are integers, which may be indices."""
    return (x == 0).astype(x.dtype) if x.dtype.kind in "iub" else np.full_like(x, 77)


@pytest.mark.parametrize("make", [lambda: scenes.scene("slide", 4).simulator(device="cpu"), stacked], ids=["slide", "stacked"])
def test_sources_say_what_kernels_touch(make):
    """Nothing else changes, and numbers that are said not to be read may be anything."""
    sim = make()
    sim.step(30)
    checked = 0
    for kernel, command, arrays in launched(sim):
        read, written = step_floor.touched(kernel.func)
        before = {name: array.numpy().copy() for name, array in arrays.items()}
        command.launch()
        after = {name: array.numpy().copy() for name, array in arrays.items()}
        used = {arrays[name].ptr for name in (read | written) & set(arrays)}
        for name, array in arrays.items():
            array.assign(before[name])
            if array.ptr not in {arrays[w].ptr for w in written & set(arrays)}:
                assert before[name].tobytes() == after[name].tobytes(), f"{step_floor.name_of(kernel)} writes {name}"
            if array.ptr not in used:
                array.assign(other(before[name]))
                checked += 1
        command.launch()
        for name, array in arrays.items():
            if array.ptr in used:
                assert array.numpy().tobytes() == after[name].tobytes(), f"{step_floor.name_of(kernel)} needs more for {name}"
            array.assign(before[name])
        command.launch()
    assert checked > 50


def test_floor_of_a_step():
    """Of the box at rest: every launch has bytes, flops and a time, and floors of a step are those of its launches.

    That a step takes longer than its floors is for `benchmarks speed` to tell: rates measured on a busy machine are no bound.
    """
    data = step_floor.measure(quick=True)
    *launches, total, step = data["rows"]
    assert data["contacts"] == 4.0
    for row in launches:
        assert row["read_bytes"] > 0.0
        assert row["written_bytes"] > 0.0
        assert row["flops"] > 0.0
    assert total["read_bytes"] == sum(row["read_bytes"] for row in launches)
    assert step["ns"] > 0.0
    for floor in ("memory_floor_ns", "arithmetic_floor_ns"):
        assert 0.0 < step[floor] == pytest.approx(sum(row[floor] for row in launches), rel=1e-12)
    assert f"| {launches[0]['kernel']} |" in step_floor.markdown(data)


def test_start_up(monkeypatch):
    """Two processes: the second one finds the modules that the first one has compiled."""
    monkeypatch.setattr(start_up, "COLD", 1)
    monkeypatch.setattr(start_up, "WARM", 1)
    row = start_up.one("box", "box_on_ground")
    assert row["cold_modules"] == row["warm_modules"] > 0
    for state in ("cold", "warm"):
        read, after, whole = row[f"{state}_read_s"], row[f"{state}_after_import_s"], row[f"{state}_s"]
        assert 0.0 < row[f"{state}_import_s"] < whole - after
        assert 0.0 < read < after < whole <= row[f"{state}_all_s"]
    assert row["warm_after_import_s"] < row["cold_after_import_s"]
    nothing = {"scene": "nothing", "engine": start_up.WARP, **start_up.timed(start_up.NOTHING)}
    assert 0.0 < nothing["warm_s"] < nothing["cold_s"] < row["cold_all_s"]  # it compiles one module, a box eleven
    slower = {"scene": "box", "engine": "other", "cold_s": 2.0 * row["cold_s"], "warm_s": 1.0}
    none = {"scene": "box", "engine": "none", "refused": "none: no boxes"}
    _, _, least, ours, other, *refused = start_up.markdown([nothing, row, slower, none]).splitlines()
    assert least.endswith("| - | - | - | - | 1 |")
    assert ours.startswith(f"| box | {row['engine']} | {row['cold_s']:.1f} | {row['warm_s']:.2f} |")
    assert other.endswith(f"| - | - | - | 2 | {2.0 * row['cold_s'] / nothing['cold_s']:.2g} |")
    assert "box: refused by none: no boxes" in refused
