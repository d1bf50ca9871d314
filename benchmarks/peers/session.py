# SPDX-License-Identifier: Apache-2.0
"""A peer's process doing one job, one repetition at a time, so that all engines take turns in the same minutes."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..scenes import GRAVITY, Scene
from . import Peer


class PeerError(RuntimeError):
    """An adapter ended early; the message holds the end of what it printed."""


@dataclass
class Session:
    """One running adapter.

    Attributes:
        peer, variant: what runs.
        answer: the adapter's result, once finish() was called.
        arrays: the arrays it wrote, see adapters/protocol.py.
    """

    peer: Peer
    variant: str
    process: subprocess.Popen[str]
    log: Path
    answer: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """As tables show it."""
        return f"{self.peer.name}, {self.variant}"

    def reply(self) -> str:
        """The adapter's next line."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            tail = "\n".join(self.log.read_text(errors="replace").splitlines()[-20:])
            raise PeerError(f"{self.name}: the adapter ended with status {self.process.wait()}:\n{tail}")
        return line.strip()

    def expect_ready(self) -> None:
        """Wait until the adapter is set up, or done with its last repetition and ready for another."""
        if (line := self.reply()) != "ready":
            raise PeerError(f"{self.name}: the adapter said {line!r} instead of 'ready'")

    def go_on(self) -> None:
        """Let the adapter do what it is ready for."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def repeat(self) -> None:
        """One repetition, from beginning to end."""
        self.go_on()
        self.expect_ready()

    def finish(self) -> None:
        """Read the result, after the last repetition of everyone: an adapter that ends takes the core from the others."""
        self.go_on()
        self.answer = json.loads(self.reply())
        with np.load(self.answer["result"]) as arrays:
            self.arrays = dict(arrays)


@contextmanager
def session(peer: Peer, variant: str, scene: Scene, repetitions: int, folder: Path) -> Iterator[Session]:
    """Start an adapter and wait until it is set up and warm; its process ends with the context."""
    with tempfile.TemporaryDirectory() as work:
        state, log = Path(work, "state.npz"), Path(work, "log.txt")
        scene.save(state)
        job = {
            "scene": scene.name,
            "envs": scene.envs,
            "dt": scene.dt,
            "steps": scene.steps,
            "friction": scene.friction,
            "gravity": GRAVITY,
            "state": str(state),
            "settings": peer.variants[variant],
            "repetitions": repetitions,
            "result": str(Path(work, "result.npz")),
        }
        with log.open("w") as errors:
            process = subprocess.Popen(
                [str(peer.python(folder)), str(peer.adapter)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=peer.environment(folder),
            )
            try:
                assert process.stdin is not None
                process.stdin.write(json.dumps(job) + "\n")
                process.stdin.flush()
                running = Session(peer, variant, process, log)
                running.expect_ready()
                yield running
            finally:
                process.kill()
                process.communicate()
