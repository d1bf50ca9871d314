# SPDX-License-Identifier: Apache-2.0
"""A peer's process, which simulates one scene after another, a repetition at a time, so that all engines can take turns."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ..robots import Robot, of_scene
from ..scenes import Scene
from . import Peer


class PeerError(RuntimeError):
    """An adapter failed; the message holds the end of what it printed."""


class Refused(RuntimeError):
    """A peer cannot do a job; the message is its own, or says that no peer can."""


@dataclass
class Task:
    """One scene with one variant's settings in a peer's process, simulated once.

    Attributes:
        pose, velocity: [T, E, B, 7], [T, E, B, 6] at the start and after every `every` steps.
        before_pose, before_velocity: [T - 1, E, B, ..] one step before each of the later samples.
        contacts: mean number in an environment and a step.
        recorded_s: what the run took that was recorded [s].
        info: of the last run: what the engine allocated, and whether that was enough ('overflow').
        same: whether all timed runs ended where the first one did.
    """

    session: Session
    variant: str
    id: int
    pose: np.ndarray
    velocity: np.ndarray
    before_pose: np.ndarray
    before_velocity: np.ndarray
    contacts: float
    recorded_s: float
    info: dict[str, Any]
    same: bool = True
    seconds: list[float] = field(default_factory=list)

    @property
    def name(self) -> str:
        """As tables show it."""
        return f"{self.session.peer.name}, {self.variant}"

    def repeat(self) -> float:
        """All steps once more, timed [s]."""
        reply = self.session.order({"do": "run", "id": self.id}, self.variant)
        self.seconds.append(reply["seconds"])
        self.same &= reply["same"]
        self.info = reply["info"]
        return self.seconds[-1]

    def drop(self) -> None:
        """Free its memory in the peer's process."""
        self.session.order({"do": "drop", "id": self.id}, self.variant)


@dataclass
class Session:
    """A running adapter.

    Attributes:
        versions: of the packages that matter.
    """

    peer: Peer
    process: subprocess.Popen[str]
    work: Path
    versions: dict[str, str] = field(default_factory=dict)
    ids: Iterator[int] = field(default_factory=count)

    def reply(self, what: str) -> dict[str, Any]:
        """The adapter's next line."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            tail = "\n".join((self.work / "log.txt").read_text(errors="replace").splitlines()[-20:])
            raise PeerError(f"{self.peer.name}, {what}: the adapter ended with status {self.process.wait()}:\n{tail}")
        return json.loads(line)

    def order(self, order: dict[str, Any], what: str) -> dict[str, Any]:
        """Send an order and wait for the reply to it."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(order) + "\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            pass  # reply() says what became of the adapter
        reply = self.reply(what)
        if "refused" in reply:
            raise Refused(f"{self.peer.name}, {what}: {reply['refused']}")
        if "error" in reply:
            raise PeerError(f"{self.peer.name}, {what}: {reply['error']}")
        return reply

    def make(self, variant: str, scene: Scene | Robot, every: int = 1, timed: bool = True) -> Task:
        """Let the peer simulate a scene once, not timed, with a sample after every so many steps; timed: repeat() will be called."""
        if isinstance(scene, Scene) and scene.made is not None:
            try:
                scene = of_scene(scene)
            except ValueError as why:
                raise Refused(f"{self.peer.name}, {why}") from why
        index = next(self.ids)
        state, result = self.work / f"state{index}.npz", self.work / f"result{index}.npz"
        scene.save(state)
        job = {name: getattr(scene, name) for name in ("dt", "steps", "friction", "restitution")}
        job |= {
            "scene": scene.name,
            "every": every,
            "timed": timed,
            "settings": self.peer.variants[variant],
            "state": str(state),
            "result": str(result),
        }
        reply = self.order({"do": "make", "id": index, "job": job}, variant)
        with np.load(result) as arrays:
            states = {name: arrays[name] for name in ("pose", "velocity", "before_pose", "before_velocity")}
            task = Task(self, variant, index, **states, contacts=float(arrays["contacts"]), recorded_s=reply["seconds"], info=reply["info"])
        result.unlink()
        state.unlink()
        return task


@contextmanager
def session(peer: Peer, folder: Path, cache: Path | None = None) -> Iterator[Session]:
    """Start a peer's adapter; its process ends with the context. cache: of kernels, if it is not the peer's own."""
    with tempfile.TemporaryDirectory() as work:
        with Path(work, "log.txt").open("w") as errors:
            process = subprocess.Popen(
                [str(peer.python(folder)), str(peer.adapter)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=peer.environment(folder) | ({} if cache is None else {"WARP_CACHE_PATH": str(cache)}),
            )
        try:
            running = Session(peer, process, Path(work))
            running.versions = running.reply("start")["versions"]
            yield running
        finally:
            process.kill()
            process.communicate()
