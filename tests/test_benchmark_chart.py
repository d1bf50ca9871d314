# SPDX-License-Identifier: Apache-2.0
"""The chart: points, front, who beats whom, pictures; what counts as worse than before; the command line. A fake engine stands in."""

import json
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_benchmarks import FAKE

from benchmarks import __main__ as command
from benchmarks import accuracy, chart, chart_picture, motion, peers, pictures, regression, report, stability, stability_picture
from benchmarks.cases import CASES

ROOT = Path(__file__).parents[1]


def point(engine="warp_lcp", setting="default", time=1.0, error=1.0, h=1e-2, **more):
    """A row of the chart: time in us per ms."""
    row = {"case": "box", "engine": engine, "setting": setting, "knob": f"{1e3 * h:g} ms", "h": h, "error": error, "unit": "m"}
    row |= {"finite": True, "certified": 1.0 if engine == "warp_lcp" else None, "E_uc": error**2, "residual": None, "energy_rise": 0.0}
    return row | {"per_ms_us": time, "step_s": 1e-3 * time * h, "spread": 0.1} | more


def test_front():
    """From fast to slow, each better than all that are faster; equal in both counts once."""
    rows = [point(time=t, error=e) for t, e in [(3, 1), (1, 5), (2, 5), (2, 3), (4, 2), (5, 0.5), (1, 5)]]
    assert [(row["per_ms_us"], row["error"]) for row in chart.front(rows)] == [(1, 5), (2, 3), (3, 1), (5, 0.5)]


def test_beaten_in_both():
    mine = [point(time=1.0, error=2.0), point(time=3.0, error=1.0)]
    assert chart.beaten(point("mujoco", time=2.0, error=3.0), mine)
    assert not chart.beaten(point("mujoco", time=2.0, error=1.5), mine)
    assert not chart.beaten(point("mujoco", time=0.5, error=9.0), mine)
    assert not chart.beaten(point("mujoco", time=1.0, error=2.0), mine)
    assert not chart.beaten(point("mujoco", time=9.0, error=1e-13), [point(error=1e-15)])  # both are round-off


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"left_out": "slow"}, "slow"),
        ({"finite": False}, "not a number"),
        ({"error": np.nan}, "not a number"),
        ({"problems": ["timed and recorded runs differ"]}, "timed and recorded runs differ"),
        ({"certified": 0.99}, "99 % certified"),
        ({"energy_rise": 30.0}, "blew up: energy rises by 3e+01 of its scale"),
        ({"energy_rise": np.nan}, "blew up"),
    ],
)
def test_what_is_no_point_is_told(more, reason):
    """It is neither drawn nor beaten, and stands in the list with its reason."""
    row = point("mujoco", "elliptic") | more
    assert not chart.counts(row)
    text = chart.markdown([point(), row])
    assert reason in text.partition("Not in the chart:")[2]


def test_table():
    rows = [point(), point("mujoco", "pyramidal", 2.0, 3.0), point("mujoco", "elliptic", 0.5, 3.0), point("mujoco", "stiff", 2.0, 0.3)]
    text = chart.markdown(rows)
    assert "| box | 1 of 3 |" in text
    assert "- box: mujoco elliptic, 10 ms: 0.5 us/ms, 3.0e+00 m; none of ours is faster" in text
    assert "- box: mujoco stiff, 10 ms: 2 us/ms, 3.0e-01 m; our best that is faster: 1.0e+00" in text


def test_lead():
    """Times at the error of the other's best point; the slower of two of ours does not count, nor one that errs more."""
    mine = [point(time=1.0, error=2.0), point(time=2.0, error=0.5), point(time=9.0, error=0.4)]
    theirs = [point("mujoco", time=3.0, error=5.0), point("mujoco", time=10.0, error=0.5)]
    assert chart.lead(theirs, mine) == "5.0e-01: 5 ± 10 %"
    assert chart.lead([point("mujoco", error=0.3)], mine) == "3.0e-01: none"
    assert "| box | 5.0e-01: 5 ± 10 % |" in chart.markdown(mine + theirs)


@pytest.fixture
def fake(tmp_path) -> peers.Peer:
    """A peer in tmp_path whose bodies glide on for ever."""
    (tmp_path / "fake" / "bin").mkdir(parents=True)
    python = tmp_path / "fake" / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    (tmp_path / "adapter.py").write_text(FAKE)
    variants = {"plain": {}, "broken": {"fault": "raises"}, "unable": {"fault": "refuses"}, "wild": {"fault": "nan"}}
    return peers.Peer("fake", "fake", ("fake==1.0",), variants, tmp_path / "adapter.py")


def test_measured_points(fake, tmp_path, monkeypatch):
    """Ours and a peer's on the launched cube: errors by hand, times of both, and what the peer could not do."""
    monkeypatch.setattr(chart, "QUICK_STEPS", (1e-2,))
    monkeypatch.setattr(chart, "ENVS", 2)
    (rows,) = chart.measure(["slip_to_roll"], [fake], tmp_path, "cpu", quick=True)
    mine = {row["setting"]: row for row in rows if row["engine"] == "warp_lcp"}
    theirs = {row["setting"]: row for row in rows if row["engine"] == "fake"}
    assert set(mine) == {"default", "midpoint", "coulomb", "float32", "lemke", "pgs"}
    assert {row["envs"] for row in (*mine.values(), theirs["plain"])} == {2}
    assert mine["midpoint"]["error"] < 0.02 * mine["default"]["error"]
    assert mine["coulomb"]["E_uc"] < 1e-12 < theirs["plain"]["E_uc"]
    # It glides at 2 m/s: from the ball that spins backwards it is farthest.
    expected = 2.0 * 0.8 - CASES["slip_to_roll"].metrics[0].reference[1, 0]
    assert theirs["plain"]["error"] == pytest.approx(expected)
    assert theirs["plain"]["problems"] == []
    assert "this engine is broken" in theirs["broken"]["left_out"]
    assert "no such thing" in theirs["unable"]["left_out"]
    assert "state not finite" in theirs["wild"]["problems"]
    for row in (*mine.values(), theirs["plain"]):
        assert row["per_ms_us"] == pytest.approx(1e6 * row["step_s"] / 10.0)
        assert row["step_s"] > 0.0


def test_scenes_with_joints_in_the_chart():
    """The timed part of the stop starts where it lies on it; E_uc is that of free bodies; every curve of ours is there."""
    case = CASES["stop"]
    short = chart.part(case, 1e-2)
    lies = np.arctan2(-short.pose[0, 0, 2], short.pose[0, 0, 0])
    assert lies == pytest.approx(np.pi / 3, abs=1e-6)
    moved = motion.simulate(replace(short, steps=5), device="cpu")
    assert np.abs(moved.pose - short.pose[0]).max() < 1e-6
    assert chart.energy_errors(moved) == {"E_uc": None}
    rows, clocks = chart.ours_at(case, 1e-2, "cpu")
    assert [row["setting"] for row in rows if "left_out" in row] == []
    assert len(clocks) == len(rows)


def test_no_panel_without_a_number(tmp_path):
    """Of a case that has no E_uc."""
    pytest.importorskip("matplotlib")
    rows = [point(), point("drake", "sap"), point(case="stop", E_uc=None), point("drake", "sap", case="stop", E_uc=None)]
    for key, points in (("error", 4), ("E_uc", 2)):
        _, svg = chart_picture.draw(rows, tmp_path / key, key)
        assert len([1 for element in ElementTree.parse(svg).iter(f"{{{pictures.SVG}}}title") if "us/ms" in (element.text or "")]) == points


def test_picture(tmp_path):
    """The same rows give the same file, other rows another; every point has its title."""
    pytest.importorskip("matplotlib")
    rows = [point(), point(setting="midpoint", time=2.0, error=0.1), point("mujoco", "elliptic", 3.0, 0.0)]
    way = {"time": [0, 1], "x": [0, 1], "y": [0, 2], "z": [0.5, 0.8]}
    for key in ("error", "E_uc"):
        png, svg = chart_picture.draw(rows, tmp_path / key, key)
        first = svg.read_bytes()
        assert chart_picture.draw(rows, tmp_path / key, key)[1].read_bytes() == first
        titles = [element.text for element in ElementTree.parse(svg).iter(f"{{{pictures.SVG}}}title")]
        assert len([text for text in titles if text.startswith("warp_lcp")]) == 2
        assert "mujoco, elliptic, 10 ms: 0.00e+00 m, 3 us/ms, 30 us a step (spread 10 %), E_uc 0.0e+00 J" in titles
        assert png.stat().st_size > 20_000
        moved = [*rows[:2], rows[2] | {"per_ms_us": 4.0}]
        assert chart_picture.draw(moved, tmp_path / key, key)[1].read_bytes() != first
    files = chart_picture.draw_box(
        [point(path=way), point("mujoco", "pyramidal", path=way), point("drake", "sap", path=way)], tmp_path / "box"
    )
    assert all(file.stat().st_size > 5_000 for file in files)


def test_picture_of_stability(tmp_path):
    """The largest step up to which all are survived: a later success does not count, refusals are apart."""
    pytest.importorskip("matplotlib")
    verdicts = {"a": ("survived", "survived", "wrong"), "b": ("drifted", "survived", "survived"), "c": ("refused",) * 3}
    rows = [
        {"case": "box", "variant": name, "h": h, "verdict": verdict, "reason": ""}
        for name, found in verdicts.items()
        for h, verdict in zip((1e-3, 5e-3, 1e-2), found, strict=True)
    ]
    assert stability_picture.survived_to(rows) == {("a", "box"): 5e-3, ("b", "box"): 0.0, ("c", "box"): None}
    png, svg = stability_picture.draw(rows, tmp_path / "stability")
    assert png.stat().st_size > 5_000
    assert svg.stat().st_size > 5_000


# ---------------------------------------------------------------------------------------------------------------------- regression


def kept_accuracy(**more) -> dict:
    row = {"case": "box", "law": "default", "metric": "x", "unit": "m", "h": [1e-2, 1e-3], "total": [1e-2, 1e-3], "model": [1e-4, 0.0]}
    return {"rows": [row | {"within": [True, True], "certified": [1.0, 1.0], "energy_rise": [0.0, 0.0]} | more]}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"total": [0.9e-2, 1e-3]}, []),
        ({"energy_rise": [1e-9, 0.0]}, []),
        ({"total": [1e-2, 1.2e-3]}, ["at 1 ms: off by 1.20e-03 m, was 1.00e-03"]),
        ({"total": [np.nan, 1e-3]}, ["at 10 ms: off by nan m, was 1.00e-02"]),
        ({"model": [7e-3, 0.0]}, ["at 10 ms: the law off by 7.00e-03 m, was 1.00e-04"]),
        ({"within": [True, False]}, ["at 1 ms: over its bar"]),
        ({"certified": [0.5, 1.0]}, ["at 10 ms: 50 % certified, was 100 %"]),
        ({"energy_rise": [0.5, 0.0]}, ["at 10 ms: energy up by 5.0e-01, was 0.0e+00"]),
    ],
)
def test_worse_accuracy(more, said):
    assert regression.accuracy(kept_accuracy(), kept_accuracy(**more)) == [f"box, default, x {words}" for words in said]


def test_rows_that_are_gone_are_worse():
    assert len(regression.accuracy(kept_accuracy(), {"rows": []})) == 2
    assert regression.chart({"rows": [point()]}, {"rows": []}) == ["box, warp_lcp, default, 10 ms: no point any more"]
    row = {"case": "box", "variant": "pgs", "h": 1e-2, "verdict": "drifted", "reason": "creep"}
    assert regression.stability({"rows": [row]}, {"rows": []}) == ["box, pgs at 10 ms: not run any more"]


def test_worse_stability():
    row = {"case": "box", "variant": "pgs", "h": 1e-2, "verdict": "drifted", "reason": "creep"}
    crowd = {"scene": "box", "envs": 64, "status": {"UNCERTIFIED": 1, "NOT_A_NUMBER": 0}, "spoilt_envs": 1, "not_finite": 0}
    old = {"rows": [row], "crowds": [crowd]}
    assert regression.stability(old, old) == []
    assert regression.stability(old, {"rows": [row | {"verdict": "survived"}]}) == []
    assert regression.stability(old, {"rows": [row | {"verdict": "wrong"}]}) == ["box, pgs at 10 ms: wrong, was drifted: creep"]
    assert len(regression.stability(old, {"rows": [row | {"verdict": "too slow"}]})) == 1
    assert len(regression.stability({"rows": [row | {"verdict": "too slow"}]}, {"rows": [row]})) == 0
    lost = crowd | {"status": {"UNCERTIFIED": 1, "NOT_A_NUMBER": 2}, "spoilt_envs": 3}
    assert regression.stability(old, {"rows": [row], "crowds": [lost]}) == [
        "box, randomised: 2 NOT_A_NUMBER, was 0",
        "box, randomised: 3 spoilt_envs, was 1",
    ]
    assert regression.stability(old, {"rows": [row], "crowds": [lost | {"envs": 4096}]}) == []


def test_worse_chart():
    """Times count as ratios in a run: a machine of half the speed is not worse."""
    rows = [point(), point(setting="coulomb", time=2.0), point("mujoco", time=4.0), point(setting="AP", time=8.0, knob="k = 2")]
    old = {"rows": rows}

    def worse(*changed) -> list[str]:
        return regression.chart(old, {"rows": [row | changed[i] if i < len(changed) else row for i, row in enumerate(rows)]})

    assert worse(*({"step_s": 2 * row["step_s"]} for row in rows)) == []
    assert worse({}, {}, {}, {"step_s": 2 * rows[3]["step_s"]}) == [
        "box, warp_lcp, AP, k = 2: time over that of our default 16.00, was 8.00"
    ]
    slow = worse({"step_s": 2 * rows[0]["step_s"]})
    assert slow == [
        "box, warp_lcp, default, 10 ms: time over that of our coulomb 1.00, was 0.50",
        "box, mujoco, default, 10 ms: time over that of our default 2.00, was 4.00",
    ]
    assert worse({"error": 1.2}) == ["box, warp_lcp, default, 10 ms: error 1.20e+00 m, was 1.00e+00"]
    assert worse({"certified": 0.0}) == ["box, warp_lcp, default, 10 ms: 0 % certified, was 100 %"]


def test_worse_peers():
    row = {"scene": "rest", "engine": "mujoco", "ours_over_peer": 5.0, "ours_over_peer_range": [4.5, 5.5]}
    old = {"peers": [row]}
    assert regression.peers(old, {"peers": [row | {"ours_over_peer": 4.0, "ours_over_peer_range": [3.5, 4.6]}]}) == []
    less = {"peers": [row | {"ours_over_peer": 3.0, "ours_over_peer_range": [2.5, 3.5]}]}
    assert regression.peers(old, less) == ["rest, mujoco: 3.00 times as fast, was 5.00"]


def test_regression_command(tmp_path, monkeypatch, capsys):
    """Against the last kept result of the same kind; status 1 where something is worse; one line for what cannot be compared."""
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    new = tmp_path / "2026-02-01-accuracy-cpu.json"
    new.write_text(json.dumps({"what": "accuracy"} | kept_accuracy(total=[2e-2, 1e-3])))

    def run(*words: str) -> object:
        monkeypatch.setattr(sys, "argv", ["benchmarks", "regression", *words])
        with pytest.raises(SystemExit) as left:
            command.main()
        return left.value.code

    assert "no result of this kind" in run(str(new))
    (tmp_path / "2026-01-01-accuracy-cpu.json").write_text(json.dumps({"what": "accuracy"} | kept_accuracy()))
    (tmp_path / "2026-03-01-accuracy-cpu.json").write_text("{}")  # a later one is not what was before
    (tmp_path / "2026-01-09-stability-cpu.json").write_text(json.dumps({"what": "stability", "rows": []}))
    assert run(str(new)) == 1
    assert "1 worse than in" in capsys.readouterr().out
    assert run(str(new), str(new)) == 0
    assert "compare the same" in run(str(new), str(tmp_path / "2026-01-09-stability-cpu.json"))
    assert "is no result of" in run(str(tmp_path / "2026-03-01-accuracy-cpu.json"), str(new))
    assert "is not called" in run(str(tmp_path / "result.json"))


# ----------------------------------------------------------------------------------------------------------------- command and documents


def test_quick_commands(tmp_path, monkeypatch, capsys):
    """Run, write their JSON, leave the documents alone."""
    documents = {path: path.read_bytes() for path in (ROOT / "docs").glob("*")}
    for words in (
        ["accuracy", "--cases", "spin,press_drop"],
        ["stability", "--cases", "spin", "--variants", "default; AP, k = 2", "--envs", "8"],
        ["chart", "--cases", "slip_to_roll"],
    ):
        monkeypatch.setattr(sys, "argv", ["benchmarks", *words, "--quick", "--out", str(tmp_path)])
        command.main()
        assert "spin" in capsys.readouterr().out or words[0] == "chart"
        (kept,) = tmp_path.glob(f"*-{words[0]}-*.json")
        assert json.loads(kept.read_text())["rows"]
    monkeypatch.setattr(sys, "argv", ["benchmarks", "chart", "--data", str(kept), "--docs", str(tmp_path / "drawn")])
    pytest.importorskip("matplotlib")
    command.main()
    assert (tmp_path / "drawn" / "chart.svg").exists()
    assert documents == {path: path.read_bytes() for path in (ROOT / "docs").glob("*")}


def test_a_part_does_not_stand_beside_whole_results(tmp_path, monkeypatch):
    """Neither its JSON nor its documents; where it should go is asked for by name."""
    monkeypatch.setattr(report, "PARTIAL", tmp_path / "parts")
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(report, "DOCS", tmp_path / "docs")
    for words in (["accuracy", "--cases", "spin"], ["stability", "--cases", "spin", "--variants", "default", "--envs", "4"]):
        monkeypatch.setattr(sys, "argv", ["benchmarks", *words])
        monkeypatch.setattr(accuracy, "STEPS", (1e-2, 5e-3))
        monkeypatch.setattr(stability, "STEPS", (1e-2,))
        command.main()
        assert len(list((tmp_path / "parts").glob(f"*-{words[0]}-*.json"))) == 1
    assert not (tmp_path / "results").exists()
    assert not (tmp_path / "docs").exists()


@pytest.mark.parametrize("what", ["chart", "stability"])
def test_no_data(what, tmp_path, monkeypatch):
    (tmp_path / "x.json").write_text("{}")
    monkeypatch.setattr(sys, "argv", ["benchmarks", what, "--data", str(tmp_path / "x.json")])
    with pytest.raises(SystemExit, match=f"holds no data of '{what}'"):
        command.main()


def test_parts_of_a_chart_are_joined(tmp_path, monkeypatch, capsys):
    """They become a whole result where every case, step and engine is there, and a part beside it where not."""
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(report, "PARTIAL", tmp_path / "parts")
    monkeypatch.setattr(chart_picture, "draw", lambda *_: [])
    settings = [("warp_lcp", curve.name) for curve in chart.OURS]
    settings += [(name, variant) for name, peer in peers.PEERS.items() for variant in peer.variants]
    rows = [point(*setting, h=h, case=case, versions={}) for case in chart.CHARTED for setting in settings for h in chart.STEPS]
    assert chart.complete(rows)
    assert not chart.complete([row for row in rows if row["setting"] != "lagged"])
    assert not chart.complete([row for row in rows if row["h"] != 5e-4 or row["setting"] != "midpoint"])

    def join(first: list[dict], second: list[dict]) -> list[dict]:
        files = [tmp_path / "a.json", tmp_path / "b.json"]
        for file, part in zip(files, (first, second), strict=True):
            file.write_text(json.dumps({"device": file.stem, "rows": part}))
        monkeypatch.setattr(sys, "argv", ["benchmarks", "chart", "--data", *map(str, files), "--docs", str(tmp_path / "docs")])
        command.main()
        (kept,) = (tmp_path / ("results" if len(first + second) == len(rows) else "parts")).glob("*-chart-cpu.json")
        data = json.loads(kept.read_text())
        assert [part["device"] for part in data["parts"]] == ["a", "b"]
        return data["rows"]

    assert join(rows[:5], rows[5:]) == rows
    assert join(rows[:5], rows[9:]) == rows[:5] + rows[9:]
    with pytest.raises(SystemExit, match=r"1 are in two of these files, the first: box, warp_lcp, default, 0\.1 ms"):
        join(rows[:7], rows[6:])


def test_parts_of_stability_are_joined(tmp_path, monkeypatch):
    """Whole where every case is there under every variant and step, and in thousands of copies; in the order of the cases."""
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(report, "PARTIAL", tmp_path / "parts")
    monkeypatch.setattr(stability, "VARIANTS", stability.chosen("default; pgs"))
    monkeypatch.setattr(stability, "markdown", lambda rows, crowds: "")
    monkeypatch.setattr(stability_picture, "draw", lambda *_: [])
    monkeypatch.setattr(report, "document", lambda *_: None)

    def part(names: list[str], envs: int = 4096) -> dict:
        rows = [
            {"case": case, "variant": variant.name, "h": h, "verdict": "survived", "reason": ""}
            for case in names
            for variant in stability.VARIANTS
            for h in stability.STEPS
        ]
        return {"rows": rows, "crowds": [{"scene": case, "envs": envs} for case in names]}

    def join(*parts: dict) -> None:
        files = [tmp_path / f"{i}.json" for i in range(len(parts))]
        for file, data in zip(files, parts, strict=True):
            file.write_text(json.dumps({"device": file.stem} | data))
        monkeypatch.setattr(sys, "argv", ["benchmarks", "stability", "--data", *map(str, files)])
        command.main()

    names = list(CASES)
    join(part(names[7:]), part(names[:7]))
    (kept,) = (tmp_path / "results").glob("*-stability-cpu.json")
    assert json.loads(kept.read_text())["rows"] == part(names)["rows"]
    assert [row["scene"] for row in json.loads(kept.read_text())["crowds"]] == names
    assert not (tmp_path / "parts").exists()
    for fewer in (part(names[1:7]), part(names[:7], envs=4000)):
        join(part(names[7:]), fewer)
        (kept,) = (tmp_path / "parts").glob("*-stability-cpu.json")
        kept.unlink()
    with pytest.raises(SystemExit, match=f"10 are in two of these files, the first: {names[6]}, default, 0.001"):
        join(part(names[6:]), part(names[:7]))
    with pytest.raises(SystemExit, match="no case 'forgotten' any more"):
        join(part(names), part(["forgotten"]))


TABLES = {
    "accuracy": lambda data: accuracy.markdown(data["rows"]),
    "stability": lambda data: stability.markdown(data["rows"], data["crowds"]),
    "chart": lambda data: chart.markdown(data["rows"]),
}


def kept(what: str) -> dict | None:
    """The result that was kept last."""
    files = sorted((ROOT / "benchmarks" / "results").glob(f"*-{what}-cpu.json"))
    return json.loads(files[-1].read_text()) if files else None


@pytest.mark.parametrize("what", TABLES)
def test_the_document_holds_the_tables_of_the_results(what):
    """And none where none are kept."""
    data = kept(what)
    assert report.tables(what, ROOT / "docs" / f"{what}.md") == (TABLES[what](data) if data else "")


@pytest.mark.parametrize(("name", "key"), [("chart", "error"), ("chart_energy", "E_uc")])
def test_the_pictures_hold_the_points_of_the_results(name, key):
    """All of them and no other, by their titles; there is none where none are kept."""
    data, picture = kept("chart"), ROOT / "docs" / f"{name}.svg"
    assert picture.exists() == (data is not None)
    if data is not None:
        rows = [row for row in data["rows"] if chart.counts(row) and row.get(key) is not None]
        titles = [element.text for element in ElementTree.parse(picture).iter(f"{{{pictures.SVG}}}title")]
        assert sorted(titles) == sorted(chart_picture.title(row) for row in rows)


def test_cases_that_are_taken_without_being_named():
    """All of them, but for the chart."""
    assert command.arguments(["accuracy"]).cases == command.arguments(["stability"]).cases == list(CASES)
    assert command.arguments(["chart"]).cases == chart.CHARTED
