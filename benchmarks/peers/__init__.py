# SPDX-License-Identifier: Apache-2.0
"""Other engines on our scenes, each in an interpreter of its own, because their requirements exclude one another.

A peer is an entry of PEERS and a script in adapters/ that its interpreter runs (adapters/protocol.py says what the two sides
tell each other). `python -m benchmarks peers install` makes the interpreters; a peer without one is left out. It makes those of
SOLVERS too, which have no part in the scenes: another benchmark runs them.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / ".peers"


@dataclass(frozen=True)
class Other:
    """Something that needs an interpreter of its own.

    Attributes:
        name: in tables.
        interpreter: folder of its interpreter; those that need the same share it.
        requirements: what pip installs into its interpreter, versions pinned.
    """

    name: str
    interpreter: str
    requirements: tuple[str, ...]

    def python(self, folder: Path) -> Path:
        """Its interpreter."""
        return folder / self.interpreter / ("Scripts/python.exe" if os.name == "nt" else "bin/python")

    def marker(self, folder: Path) -> Path:
        """Written when everything is installed, with the requirements in it."""
        return folder / self.interpreter / "installed.txt"

    def installed(self, folder: Path) -> bool:
        """Whether its interpreter is there, complete and with the versions asked for."""
        marker = self.marker(folder)
        return self.python(folder).exists() and marker.exists() and marker.read_text().split() == list(self.requirements)

    def install(self, folder: Path) -> None:
        """Make its interpreter, unless it is there, with Python's venv and pip as they are configured on this machine."""
        if self.installed(folder):
            return
        self.marker(folder).unlink(missing_ok=True)
        subprocess.run([sys.executable, "-m", "venv", str(folder / self.interpreter)], check=True)
        subprocess.run([str(self.python(folder)), "-m", "pip", "install", "-q", *self.requirements], check=True)
        self.marker(folder).write_text("\n".join(self.requirements) + "\n")

    def environment(self, folder: Path) -> dict[str, str]:
        """Variables of its process: one thread, a kernel cache of its own, nothing of our interpreter."""
        ours = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
        threads = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
        return ours | threads | {"WARP_CACHE_PATH": str(folder / self.interpreter / "warp_cache")}


@dataclass(frozen=True)
class Peer(Other):
    """Another engine; its name is also that of its adapter, adapters/on_<name>.py.

    Attributes:
        variants: settings worth comparing, by the name they have in tables; the adapter reads the settings.
        adapter: the script, if it is elsewhere.
    """

    variants: dict[str, dict[str, Any]]
    adapter: Path = field(default=Path())

    def __post_init__(self) -> None:
        if self.adapter == Path():
            object.__setattr__(self, "adapter", Path(__file__).parent / "adapters" / f"on_{self.name}.py")


#: MuJoCo's default contact is a spring with a time constant of 20 ms; the stiffest that it allows has two steps.
STIFF = {"time_constant_steps": 2}
# Drake's contacts are springs of 1e6 N/m, or 1e7 Pa where boxes meet. This is how far [m] a box may sink under the weight of all;
# a fifth of it, and "lagged" throws the paper's box up.
SAG = 5e-6
NEWTON = ("newton==1.8.0", "warp-lang==1.19.0")
KAMINO = Path(__file__).parent / "adapters" / "on_newton_kamino.py"
PEERS = {
    peer.name: peer
    for peer in (
        Peer(
            "mujoco",
            "mujoco",
            ("mujoco==4.0.0",),
            {
                "pyramidal": {"cone": "pyramidal"},
                "elliptic": {"cone": "elliptic"},
                "elliptic, noslip": {"cone": "elliptic", "noslip_iterations": 10},
                "elliptic, stiff": {"cone": "elliptic"} | STIFF,
                "elliptic, stiff, noslip": {"cone": "elliptic", **STIFF, "noslip_iterations": 10},
                "elliptic, stiff, RK4": {"cone": "elliptic", **STIFF, "integrator": "RK4"},
            },
        ),
        Peer(
            "mujoco_warp",
            "mujoco_warp",
            ("mujoco-warp==4.0.0", "mujoco==4.0.0", "warp-lang==1.19.0"),
            {
                "pyramidal": {"cone": "pyramidal"},
                "elliptic": {"cone": "elliptic"},
                "elliptic, stiff": {"cone": "elliptic"} | STIFF,
                "elliptic, stiff, RK4": {"cone": "elliptic", **STIFF, "integrator": "RK4"},
            },
        ),
        Peer(
            "drake",
            "drake",
            ("drake==1.51.1",),
            {
                # Drake's default, and the one named after its solver; its third, "similar", moves as "sap" does, and stiffer it fails.
                "lagged": {"approximation": "lagged"},
                "lagged, stiff": {"approximation": "lagged", "sag": SAG},
                "sap": {"approximation": "sap"},
                "sap, stiff": {"approximation": "sap", "sag": SAG},
            },
        ),
        # Its default are 2 iterations; newton's examples take 10 and 20.
        Peer("newton_xpbd", "newton", NEWTON, {f"{n} iterations": {"iterations": n} for n in (2, 10, 20, 100)}),
        # Its defaults are 200 iterations and nine tenths of the last impulses to start with. A heavy body on a light one uses all of
        # them; from all of the last impulses it goes on where it stopped, and 500 sink less than 2000 do from nine tenths.
        Peer(
            "newton_padmm",
            "newton",
            NEWTON,
            {
                "200 iterations": {"backend": "padmm"},
                "500 iterations, full warm start": {"backend": "padmm", "max_iterations": 500, "warmstart_scale": 1.0},
            },
            KAMINO,
        ),
        # Its defaults are 16 iterations and a tolerance of 1e-5 m/s, which in steps of 1 ms is 0.01 m/s^2 of sliding bodies and
        # stops before iterations run out. The finer one costs little from the velocity that the last impulses predict.
        Peer(
            "newton_lox",
            "newton",
            NEWTON,
            {
                "16 iterations": {"backend": "lox"},
                "200 iterations": {"backend": "lox", "max_iterations": 200},
                "200 iterations, 1e-6 m/s": {
                    "backend": "lox",
                    "max_iterations": 200,
                    "velocity_tolerance": 1e-6,
                    "inertial_warmstart_fraction": 1.0,
                },
            },
            KAMINO,
        ),
        # Its default friction acts at two anchors of a patch, from which the paper's box ends half a metre off, however many sweeps.
        # With point friction, at every contact, it ends where it should, but a heavy body on a light one drifts more.
        Peer(
            "newton_steel",
            "newton",
            NEWTON,
            {
                "12 sweeps": {},
                "200 sweeps": {"iterations": 200},
                "200 sweeps, point friction": {"iterations": 200, "friction_anchor_beta": 0.0},
            },
        ),
    )
}
#: Run by `python -m benchmarks friction`.
SOLVERS = {"pin": Other("pin", "pin", ("pin==4.1.0", "scipy==1.17.1"))}
INSTALLABLE: dict[str, Other] = {**PEERS, **SOLVERS}


#: Those whose steps take microseconds: what `speed` compares with. The others' take up to a thousand times as long.
FAST = ("mujoco", "mujoco_warp", "newton_xpbd")


def split(names: list[str], folder: Path, peers: dict[str, Peer] | None = None) -> tuple[list[Peer], str]:
    """The installed ones of the named peers, and one line about the others ('' if there are none)."""
    chosen = [(PEERS if peers is None else peers)[name] for name in names]
    absent = [peer.name for peer in chosen if not peer.installed(folder)]
    line = f"peers not installed: {', '.join(absent)} (python -m benchmarks peers install {' '.join(absent)})" if absent else ""
    return [peer for peer in chosen if peer.name not in absent], line
