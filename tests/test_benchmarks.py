# SPDX-License-Identifier: Apache-2.0
"""The comparison with other engines: scenes, the job that an adapter gets, what is checked of its answer, absent peers.

A fake peer stands in for the others, run by this interpreter: nothing here reaches a network.
"""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import __main__ as command
from benchmarks import motion, peers, scenes
from benchmarks.motion import Motion
from benchmarks.peers import compare
from benchmarks.peers.session import PeerError, Refused, Task, session

ADAPTERS = Path(peers.__file__).parent / "adapters"
FAKE = f"""
import sys
sys.path.insert(0, {str(ADAPTERS)!r})
import numpy as np, protocol

class Fake(protocol.Engine):  # every body glides on with its velocity
    def __init__(self, job):
        self.job, self.runs, self.fault = job, 0, job.settings.get("fault")
        assert self.fault != "raises", "this engine is broken"
        if self.fault == "refuses":
            raise protocol.Refused("no such thing")
        print("an engine that prints")
        self.reset()
    def reset(self):
        self.pose = self.job.pose.copy() + (0.1 if self.fault == "start" else 0.0)
        self.runs += 1
    def run(self, steps):
        if self.fault == "dies":
            sys.exit("no more")
        for _ in range(steps):
            self.pose[..., :3] += self.job.velocity[..., :3] * self.job.dt
        if self.fault == "nan":
            self.pose[0, 0, 0] = np.nan
        if self.fault == "drift":
            self.pose[0, 0, 0] += 1e-9 * self.runs
    def state(self):
        return self.pose.copy(), self.job.velocity
    def contacts(self):
        return 4.0
    def info(self):
        return {{"overflow": self.fault == "overflow", "runs": self.runs}}

protocol.serve(Fake, ("numpy",))
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    """A folder in which the peer 'fake' is installed."""
    (tmp_path / "fake" / "bin").mkdir(parents=True)
    python = tmp_path / "fake" / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    (tmp_path / "fake" / "installed.txt").write_text("fake==1.0\n")
    (tmp_path / "adapter.py").write_text(FAKE)
    return tmp_path


def fake(folder: Path, **settings) -> peers.Peer:
    """The fake peer with one variant."""
    return peers.Peer("fake", "fake", ("fake==1.0",), {"plain": settings}, folder / "adapter.py")


def scene(name: str = "slide") -> scenes.Scene:
    """A small one."""
    return replace(scenes.scene(name, 3), steps=10)


def do(folder: Path, repetitions: int = 3, **settings) -> Task:
    """What the fake peer did with its job."""
    with session(fake(folder, **settings), folder) as running:
        task = running.make("plain", scene(), 5)
        for _ in range(repetitions):
            task.repeat()
    return task


def test_job_round_trip(folder):
    """The adapter starts where the scene starts, moves for dt times steps, and every repetition is asked for one by one."""
    done = do(folder)
    expected = scene().pose.copy()
    expected[..., 1] += 5.0 * 1e-3 * 10
    assert len(done.seconds) == 3
    assert done.info["runs"] == 5  # made, recorded, timed three times
    assert set(done.session.versions) == {"numpy"}
    assert done.pose.shape == (3, 3, 1, 7)
    np.testing.assert_array_equal(done.pose[0], scene().pose)
    np.testing.assert_array_equal(done.velocity[0], scene().velocity)
    np.testing.assert_allclose(done.pose[1, ..., 1], 0.5 * (scene().pose + expected)[..., 1], rtol=0, atol=1e-15)
    np.testing.assert_allclose(done.pose[2], expected, rtol=0, atol=1e-15)
    assert compare.problems(scene(), done) == []


def test_several_jobs_in_one_process(folder):
    """They take turns, and one that is dropped is gone."""
    with session(fake(folder), folder) as running:
        first, second = running.make("plain", scene()), running.make("plain", scene().copies(2))
        for task in (first, second, first):
            task.repeat()
        assert (len(first.seconds), len(second.seconds)) == (2, 1)
        assert second.pose.shape[1] == 2
        first.drop()
        with pytest.raises(PeerError, match="KeyError"):
            first.repeat()
        second.repeat()


def test_adapter_alone(folder):
    """Orders on stdin, replies on stdout, the engine's own prints on stderr."""
    scene().save(folder / "state.npz")
    job = {"scene": "slide", "dt": 1e-3, "steps": 10, "every": 1, "timed": True}
    job |= {"friction": 1.0, "restitution": 0.0, "settings": {}}
    job |= {"state": str(folder / "state.npz"), "result": str(folder / "result.npz")}
    orders = [{"do": "make", "id": "a", "job": job}, {"do": "run", "id": "a"}, {"do": "drop", "id": "a"}]
    text = "".join(json.dumps(order) + "\n" for order in orders)
    done = subprocess.run([sys.executable, folder / "adapter.py"], input=text, capture_output=True, text=True, check=True)
    started, made, ran, dropped = [json.loads(line) for line in done.stdout.splitlines()]
    assert (set(started), set(made), set(ran), dropped) == ({"versions"}, {"info", "seconds"}, {"seconds", "same", "info"}, {})
    assert "an engine that prints" in done.stderr
    assert (folder / "result.npz").exists()


@pytest.mark.parametrize(
    ("fault", "problem"),
    [
        ("start", "another start pose"),
        ("nan", "state not finite"),
        ("drift", "timed and recorded runs differ"),
        ("overflow", "contacts or rows overflowed"),
    ],
)
def test_what_does_not_count(folder, fault, problem):
    """A peer that did something else than the job is found out."""
    assert problem in compare.problems(scene(), do(folder, fault=fault))


@pytest.mark.parametrize(("fault", "words"), [("raises", "this engine is broken"), ("dies", r"(?s)ended with status 1:.*no more")])
def test_broken_adapter(folder, fault, words):
    """What it said is in the error."""
    with pytest.raises(PeerError, match=words):
        do(folder, fault=fault)


def test_refusal(folder):
    """Is told from a failure."""
    with pytest.raises(Refused, match="fake, plain: no such thing"):
        do(folder, fault="refuses")


def test_table(folder):
    """Ours and the peer in turns: both rates, their ratio, the error against a run of ours at a tenth of the step."""
    straight = replace(scene(), velocity=scene().velocity * [1, 1, 1, 0, 0, 0])
    with session(fake(folder), folder) as running:
        rows = compare.one(straight, [running], 3)
    ours, theirs = rows
    assert ours["engine"] == compare.OURS
    assert ours["marked_envs"] == 0
    assert ours["distance"] < 1e-3
    assert ours["lift"] < 1e-9
    assert len(ours["seconds"]) == len(theirs["seconds"]) == 3
    assert theirs["distance"] == pytest.approx(0.5 * 9.81 * 0.01**2, rel=0.02)  # no friction: mu g t^2 / 2 too far
    assert theirs["ours_over_peer"] == pytest.approx(np.median(np.divide(theirs["seconds"], ours["seconds"])))
    text = compare.markdown(rows)
    assert "fake, plain" in text
    assert "NOT COMPARED" not in text
    theirs["problems"] = ["final state not finite"]
    assert "NOT COMPARED: final state not finite" in compare.markdown(rows)


def test_remarks():
    """Where the motion is another one the table says so, and says nothing where it is not."""
    start = scene()

    def moved(y: float, z: float = 0.0, contacts: float = 4.0) -> Motion:
        return Motion.of(start, np.stack([start.pose, start.pose + np.array([0, y, z, 0, 0, 0, 0])]), start.velocity, contacts)

    ours = moved(0.24)
    assert compare.remarks(start, moved(0.24, contacts=3.9), ours) == []
    assert compare.remarks(start, moved(0.24, contacts=0.2), ours) == ["touches 5% as often as ours"]
    assert compare.remarks(start, moved(0.12), ours) == ["moved 0.120 m, ours 0.240 m"]
    assert compare.remarks(start, moved(0.24, -0.4), ours) == ["a box is in the floor"]


def test_overlap_is_measured_not_reported():
    """Anybody's final poses go through our collision detection."""
    start = scenes.scene("stack10", 2)
    moved = start.pose.copy()
    moved[1, 3:, 2] -= 0.002
    assert motion.penetration(start, start.pose) < 1e-12
    assert motion.penetration(start, moved) == pytest.approx(0.002, abs=1e-9)
    moved[0, 0, 0] = np.nan
    assert np.isnan(motion.penetration(start, moved))


def test_states_of_mujoco(monkeypatch):
    """w first, angular velocity in the body's axes, and back."""
    monkeypatch.syspath_prepend(ADAPTERS)
    import mjcf

    heap = scenes.scene("pile5", 4)
    qpos, qvel = mjcf.to_mujoco(heap.pose, heap.velocity)
    turn = Rotation.from_quat(heap.pose[2, 3, 3:])
    np.testing.assert_allclose(qpos[2].reshape(5, 7)[3, 3:], np.roll(heap.pose[2, 3, 3:], 1))
    np.testing.assert_allclose(qvel[2].reshape(5, 6)[3, 3:], turn.inv().apply(heap.velocity[2, 3, 3:]), atol=1e-12)
    pose, velocity = mjcf.from_mujoco(qpos, qvel)
    np.testing.assert_array_equal(pose, heap.pose)
    np.testing.assert_allclose(velocity, heap.velocity, atol=1e-12)


def test_scenes_start_without_overlap():
    """And no two environments of the pile alike."""
    for name in scenes.STEPS:
        start = scenes.scene(name, 8)
        assert start.steps % 2 == 0
        if name != "tumble":  # some of its boxes start a little inside the plane, as they always have
            assert motion.penetration(start, start.pose) < 1e-12
    heap = scenes.scene("pile5", 8)
    assert len(np.unique(heap.pose[:, 0], axis=0)) == 8


def test_absent_peers_are_one_line(tmp_path, monkeypatch, capsys):
    """And nothing is measured or written."""
    monkeypatch.setattr(sys, "argv", ["benchmarks", "peers", "compare", "--dir", str(tmp_path), "--out", str(tmp_path / "out")])
    command.main()
    (line,) = capsys.readouterr().out.split("\n")[1:-1]
    names = list(peers.PEERS)
    assert line == f"peers not installed: {', '.join(names)} (python -m benchmarks peers install {' '.join(names)})"
    assert not (tmp_path / "out").exists()


def test_other_versions_count_as_absent(folder):
    """The pins of today, or none."""
    known = {"fake": fake(folder)}
    assert peers.split(["fake"], folder, known) == ([known["fake"]], "")
    newer = {"fake": replace(known["fake"], requirements=("fake==2.0",))}
    assert peers.split(["fake"], folder, newer) == ([], "peers not installed: fake (python -m benchmarks peers install fake)")


def test_half_an_installation_is_none(folder, monkeypatch):
    """Where pip fails, what was there before does not count any more."""
    calls = []

    def run(call, check):
        calls.append(call)
        if "pip" in call:
            raise subprocess.CalledProcessError(1, call)

    monkeypatch.setattr(peers, "subprocess", SimpleNamespace(run=run))
    peer = fake(folder)
    assert peer.installed(folder)
    peer.install(folder)  # it is there
    assert calls == []
    peer = replace(peer, requirements=("fake==2.0",))
    with pytest.raises(subprocess.CalledProcessError):
        peer.install(folder)
    assert calls[0][1:] == ["-m", "venv", str(folder / "fake")]
    assert calls[1][1:] == ["-m", "pip", "install", "-q", "fake==2.0"]
    assert not (folder / "fake" / "installed.txt").exists()


def test_catalogue():
    """Every peer has its adapter, at least one variant and pinned versions."""
    for peer in peers.PEERS.values():
        assert peer.adapter.exists()
        assert peer.variants
        assert all("==" in requirement for requirement in peer.requirements)


@pytest.mark.parametrize("text", ["mujoco,bullet", "everything", ""])
def test_unknown_peer(text, monkeypatch, capsys):
    """One line that names those there are."""
    monkeypatch.setattr(sys, "argv", ["benchmarks", "speed", "--peers", text])
    with pytest.raises(SystemExit) as left:
        command.main()
    assert left.value.code == 2
    assert f"choose from {', '.join(peers.PEERS)}, or all, or none" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", peers.PEERS)
def test_real_peer(name):
    """An installed peer rests where the box rests."""
    peer = peers.PEERS[name]
    if not peer.installed(peers.FOLDER):
        pytest.skip(peers.split([name], peers.FOLDER)[1])
    with session(peer, peers.FOLDER) as running:
        rows = compare.one(scene("rest"), [running], 1)
    for row in rows[1:]:
        assert row["problems"] == []
        assert row["remarks"] == []
        assert row["distance"] < 1e-3
