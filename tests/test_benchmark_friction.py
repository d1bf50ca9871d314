# SPDX-License-Identifier: Apache-2.0
"""The friction benchmark: what it says of timings (fakes), its natural map, its generator, and the rivals' workers with fake libraries."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import friction, peers
from benchmarks.friction import facets, floor, picture, recorded, rival, stress, summary

FAKE_SICONOS = """
import os, sys, time
import numpy as np
SICONOS_FRICTION_3D_NSGS, SICONOS_FRICTION_3D_PROX, SICONOS_FRICTION_3D_ADMM, SICONOS_FRICTION_3D_VI_EG = 1, 2, 3, 4
SICONOS_DPARAM_TOL = SICONOS_IPARAM_MAX_ITER = 0
SICONOS_IPARAM_ITER_DONE = 1
class SolverOptions:
    def __init__(self, code):
        self.code, self.iparam, self.dparam = code, [0, 0], [0.0]
class FrictionContactProblem:
    def __init__(self, dimension, W, q, mu):
        self.W, self.q = W, q
def SBM_from_csparse(size, W):
    assert size == 3 and W.indices.dtype == np.int64
    return [0, W.toarray()]
def fc3d_driver(problem, impulse, velocity, options):
    print("chatter"); sys.stderr.write("chatter")
    if options.code == 2:
        while True:
            pass
    if options.code == 3:
        os.abort()
    if options.code == 4:
        raise ValueError("broken")
    impulse[:] = -np.linalg.solve(problem.W, problem.q)
    options.iparam[1] = 7
    return 0
"""

FAKE_PINOCCHIO = """
import numpy as np
from types import SimpleNamespace as Some
class Box:
    def __init__(self, *given):
        self.given = given
    def addJoint(self, *joint): pass
    def setFriction(self, mu): self.mu = mu
    def createData(self): return None
class SE3:
    Identity = staticmethod(lambda: None)
class Rules:
    SPECTRAL = "spectral"
class Result:
    iterations = 0
    def retrievePrimalSolution(self, into): into[:] = self.impulse
class Solver:
    def __init__(self, size): self.size = size
    def solve(self, delassus, free, models, data, settings, result):
        assert settings.solve_ncp and len(models) == len(data) == 2 and self.size == 6
        assert models[0].given[0].mu == 0.5
        matrix, = delassus.given
        matrix = matrix if type(matrix) is np.ndarray else matrix.toarray()
        assert (matrix == matrix.T).all() and np.isclose(matrix.trace(), 6.0) and np.isclose(np.linalg.norm(free), 1.0)
        result.impulse, result.iterations = -np.linalg.solve(matrix, free), settings.max_iterations
        assert getattr(settings, "admm_update_rule", "spectral") == "spectral"
        if getattr(settings, "lanczos_size", None) is None:
            raise ValueError("PGS is broken")
Model = JointModelFreeFlyer = PointContactConstraintModel = ConstraintModel = DelassusOperatorDense = DelassusOperatorSparse = Box
StdVec_ConstraintModel = StdVec_ConstraintData = list
ADMMUpdateRule = Rules
ADMMConstraintSolver = PGSConstraintSolver = Solver
ADMMSolverSettings = PGSSolverSettings = Some
ADMMSolverResult = PGSSolverResult = Result
"""


@pytest.fixture
def problem(tmp_path) -> recorded.Problem:
    """Two contacts that stick, W = 2, in a file."""
    path = tmp_path / "small.npz"
    indices = np.arange(6)
    np.savez(path, W_data=np.full(6, 2.0), W_indices=indices, W_indptr=np.arange(7), n=6, q=np.tile([-1.0, 0.1, 0.0], 2), mu=0.5)
    return recorded.load(path)


def entry(seconds, natural_map=1e-12, solver="NSGS"):
    return {"solver": solver, "storage": "dense", "outcome": "done", "median_s": seconds, "best_s": seconds, "natural_map": natural_map}


def row(call, kernel, siconos, natural_map=1e-12, **others):
    times = {"call_median_s": call, "kernel_median_s": kernel, "batch_call_median_s": kernel, "batch_kernel_median_s": kernel / 2}
    ours = {"natural_map": natural_map, "iterations": 3, **times}
    rivals = ({"Siconos": siconos} if siconos else {}) | others
    return {"problem": "p", "contacts": 2, "rank": 6, "ours": {"auto": ours, "pgs": ours | {"natural_map": 1e-3}}, "rivals": rivals}


def test_best_is_the_fastest_that_solved():
    entries = [
        entry(1.0, 1e-5),
        entry(2.0, math.nan),
        {"solver": "PROX", "storage": "sbm", "outcome": "time"},
        entry(4.0),
        entry(3.0, 1e-8),
    ]
    assert summary.best(entries, 1e-6)["median_s"] == 3.0
    assert summary.best(entries, 1e-10)["median_s"] == 4.0
    assert summary.best(entries, 1e-6, "PROX") is None
    assert summary.best(entries, 1e-13) is None


def test_relevant_entries_say_the_same():
    entries = [entry(1.0, 1e-5), entry(4.0), entry(3.0, 1e-8), entry(9.0), entry(2.0, 1e-3, "PROX"), entry(3.0, 1e-4, "PROX")]
    entries += [{"solver": "ADMM", "storage": "sbm", "outcome": "time"}, entry(7.0, 1e-12, "VI_EG")]
    kept = summary.relevant(entries)
    assert [(e["solver"], e.get("median_s")) for e in kept] == [("NSGS", 3.0), ("NSGS", 4.0), ("PROX", 3.0), ("ADMM", None), ("VI_EG", 7.0)]
    for tolerance in summary.TOLERANCES:
        assert summary.best(kept, tolerance) == summary.best(entries, tolerance)


def test_counts():
    rows = [
        row(5.0, 1.0, [entry(2.0), entry(1.5, 1e-8, "PROX")]),  # a call loses, a launch wins
        row(5.0, 4.0, [entry(3.0)]),  # but for the batch of the prepared it loses
        row(5.0, 4.0, [entry(1.0, 1e-2)]),  # nobody else solves it
        row(1.0, 0.1, [entry(9.0)], natural_map=1e-7),  # fast, but not at 1e-10
    ]
    loose, tight = (summary.counts(rows, tolerance) for tolerance in (1e-6, 1e-10))
    assert loose["solved"] == {"auto": 4, "pgs": 0, "Siconos NSGS": 3, "Siconos PROX": 1, "Siconos, any": 3}
    assert tight["solved"] == {"auto": 3, "pgs": 0, "Siconos NSGS": 3, "Siconos PROX": 0, "Siconos, any": 3}
    times = ("call_median_s", "kernel_median_s", "batch_call_median_s", "batch_kernel_median_s")
    assert loose["faster"] == {"Siconos": dict(zip(times, (2, 3, 3, 4), strict=True))}
    assert tight["faster"] == {"Siconos": dict(zip(times, (1, 2, 2, 3), strict=True))}
    assert loose["recorded"] == {}


def test_counts_of_two_rivals():
    """Each by itself, then the faster of both; a solver of symmetric W by its own problem, and apart by the recorded one."""
    symmetric = entry(1.0, 1e-12, "ADMM") | {"natural_map_recorded": 1e-5}
    exact = entry(4.0, 1e-12, "ADMM") | {"natural_map_recorded": 1e-12}
    rows = [row(3.0, 2.0, [entry(9.0)], Pinocchio=[symmetric]), row(3.0, 2.0, [entry(1.0)], Pinocchio=[exact])]
    found = summary.counts(rows, 1e-6)
    assert found["solved"] == {"auto": 2, "pgs": 0, "Siconos NSGS": 2, "Pinocchio ADMM": 2} | {
        f"{name}, any": 2 for name in ("Siconos", "Pinocchio", summary.ANY)
    }
    assert found["recorded"] == {"Pinocchio ADMM": 1}
    assert [found["faster"][name]["kernel_median_s"] for name in ("Siconos", "Pinocchio", summary.ANY)] == [1, 1, 0]
    text = summary.markdown(rows)
    assert "not its symmetric part: Pinocchio ADMM 1" in text
    assert "| 9e+03 ms NSGS dense | 9e+03 ms NSGS dense | 1e+03 ms ADMM dense |" in text


def test_without_rivals_nothing_is_compared():
    rows = [row(5.0, 1.0, [])]
    assert summary.counts(rows, 1e-6)["faster"] == {}
    assert "best of" not in summary.markdown(rows)


def test_table_names_the_best():
    text = summary.markdown([row(5e-4, 1e-6, [entry(2e-6), entry(1e-6, 1e-8, "PROX")])])
    assert "| 500 us | 1 us |" in text
    assert "| 1 us PROX dense | 2 us NSGS dense |" in text


def test_picture(tmp_path):
    rows = [row(5.0, 1.0, [entry(2.0), entry(9.0, 1e-8, "PROX")], Pinocchio=[entry(2.5, solver="PGS")]), row(5.0, 4.0, [entry(3.0)])]
    pytest.importorskip("matplotlib")
    png, svg = picture.draw(rows, tmp_path)
    assert png.read_bytes()[:4] == b"\x89PNG"
    assert "</svg>" in svg.read_text()


def test_factor_of_facets():
    """Errors of 1 / k fall by 2, one problem under round-off is left out."""
    errors = [1.0 / k for k in facets.DIRECTIONS]
    rows = [
        {"formulation": "phantom_inertia", "full_rank": True, "velocity": e, "work": [x * x for x in errors], "unsolved": 0}
        for e in (errors, [100 * x for x in errors], [*errors[:-1], 1e-12])
    ]
    number, mean = facets.means(rows, "phantom_inertia", True, "velocity")
    assert number == 2
    np.testing.assert_allclose(mean, [10.0 / k for k in facets.DIRECTIONS])
    assert "| 2.00, 2.00, 2.00, 2.00 |" in facets.markdown(rows)
    assert "| 4.00, 4.00, 4.00, 4.00 |" in facets.markdown(rows)


@pytest.mark.parametrize(
    ("q", "mu", "p", "expected"),
    [
        ([-1.0, 0.0, 0.0], 0.5, [1.0, 0.0, 0.0], 0.0),  # rests
        ([-1.0, 2.0, 0.0], 0.5, [1.0, -0.5, 0.0], 0.0),  # slides
        ([1.0, 0.0, 0.0], 0.0, [0.0, 0.0, 0.0], 0.0),  # lifts off without friction
        ([-2.0, 0.0, 0.0], 0.5, [0.0, 0.0, 0.0], 1.0),  # falls through
        ([1.0, 0.0, 0.0], 0.5, [1.0, 0.0, 0.0], 1.0),  # pulled off: u_n = 2, p - P(p - u) = p
        ([-1.0, 2.0, 0.0], 0.5, [math.nan, 0.0, 0.0], math.nan),
    ],
)
def test_natural_map(q, mu, p, expected):
    found = recorded.natural_map(np.eye(3), np.array(q), np.array([mu]), np.array(p))
    assert found == pytest.approx(expected, abs=1e-15, nan_ok=True)


def test_generator():
    """The same seed makes the same problem, W is positive semidefinite and q in its range."""
    for seed in range(20):
        W, q, mu, about = stress.generate(seed)
        np.testing.assert_array_equal(W, stress.generate(seed)[0])
        values, vectors = np.linalg.eigh(W)
        assert values[0] >= -1e-12 * values[-1]
        outside = vectors[:, : len(q) - about["rank"]]
        assert np.linalg.norm(outside.T @ q) < 1e-6 * np.linalg.norm(q)  # eigenvectors of mass ratios up to 1e6
        assert len(mu) == about["contacts"]
    assert len({stress.generate(seed)[3]["layout"] for seed in range(20)}) == len(stress.LAYOUTS)


@pytest.mark.parametrize(
    ("edges", "expected"),
    [([(0, 1), (1, 2), (2, 3)], [1, 1, 1, 0]), ([(0, 1), (1, 2), (2, 3), (3, 0)], [2, 2, 1, 0]), ([(0, 1), (0, 2), (0, 3)], [1, 1, 1, 0])],
)
def test_elimination(edges, expected):
    """Path, ring (whose first step fills in), star."""
    coupled = np.eye(4, dtype=bool)
    for i, j in edges:
        coupled[i, j] = coupled[j, i] = True
    assert floor.degrees(coupled) == expected


def test_rank(problem):
    assert problem.rank == 6
    assert problem.contacts == 2
    W = np.diag([1.0, 1.0, 0.0])
    assert recorded.Problem("", Path(), W, np.zeros(3), np.zeros(1)).rank == 2


def test_absent_rivals_say_how_to_get_them(tmp_path):
    assert "apt install --no-install-recommends python3-siconos" in rival.SICONOS.absent(tmp_path / "python3")
    assert "lacks ['siconos']" in rival.SICONOS.absent(Path(sys.executable))
    line = rival.PINOCCHIO.absent(tmp_path / "python3")
    assert line.endswith("does not exist: Pinocchio is skipped (python -m benchmarks peers install pin)")
    assert "\n" not in line
    assert "pin" in peers.INSTALLABLE
    assert "pin" not in peers.PEERS


def work(of, problem, folder, cases):
    """Run a rival's worker by this interpreter, with fake libraries from a folder."""
    job = {"path": str(problem.path), "cases": cases, "tolerances": [1e-7, 1e-10], "limit_s": 2.0, "budget_s": 10.0, "repetitions": 3}
    environment = os.environ | {"PYTHONPATH": str(folder)}
    return subprocess.run([sys.executable, of.worker], input=json.dumps(job), capture_output=True, text=True, env=environment)


def test_worker(problem, tmp_path):
    """Answers come back without the chatter; a solver that hangs or dies is told apart; one that raises ends the benchmark."""
    (tmp_path / "siconos").mkdir()
    (tmp_path / "siconos" / "numerics.py").write_text(FAKE_SICONOS)

    def run(solvers):
        return work(rival.SICONOS, problem, tmp_path, [(solver, 10, storage) for solver in solvers for storage in ("dense", "sbm")])

    done = run(["NSGS", "PROX", "ADMM"])
    assert done.returncode == 0, done.stderr
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(a["solver"], a["outcome"]) for a in answers] == [("NSGS", "done")] * 4 + [("PROX", "time")] * 2 + [("ADMM", "SIGABRT")] * 2
    assert [a["tolerance"] for a in answers[:4]] == [1e-7, 1e-10] * 2
    for answer in answers[:4]:
        np.testing.assert_allclose(answer["impulse"], np.tile([0.5, -0.05, 0.0], 2))
        assert answer["iterations"] == 7
        assert len(answer["seconds"]) == 2  # of three, the first not counted
    broken = run(["VI_EG"])
    assert broken.returncode != 0
    assert "ValueError: broken" in broken.stderr


def test_pinocchio_worker(problem, tmp_path):
    """W and q without units and in its order of axes; impulses come back in ours."""
    (tmp_path / "pinocchio.py").write_text(FAKE_PINOCCHIO)
    done = work(rival.PINOCCHIO, problem, tmp_path, [("ADMM", 7, "sparse"), ("ADMM spectral", 7, "dense")])
    assert done.returncode == 0, done.stderr
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(a["solver"], a["storage"]) for a in answers] == [("ADMM", "sparse")] * 2 + [("ADMM spectral", "dense")] * 2
    for answer in answers:
        np.testing.assert_allclose(answer["impulse"], np.tile([0.5, -0.05, 0.0], 2))
        assert answer["iterations"] == 7
    broken = work(rival.PINOCCHIO, problem, tmp_path, [("PGS", 7, "dense")])
    assert "ValueError: PGS is broken" in broken.stderr


def test_judge(problem):
    """Who takes W to be symmetric is judged by its symmetric part, and by the recorded W beside; a nan by neither."""
    problem.W[0, 3] = 1e-3
    impulse = -np.linalg.solve(0.5 * (problem.W + problem.W.T), problem.q)
    answer = {"solver": "ADMM", "storage": "dense", "tolerance": 1e-7, "outcome": "done", "iterations": 3}
    answer |= {"seconds": [2.0, 1.0, 4.0], "prepare_s": [1.0]}
    found = rival.PINOCCHIO.judge(problem, answer | {"impulse": impulse.tolist()})
    assert (found["best_s"], found["median_s"]) == (1.0, 2.0)
    assert found["natural_map"] < 1e-15
    assert found["natural_map_recorded"] > 1e-5
    assert rival.SICONOS.judge(problem, answer | {"impulse": impulse.tolist()})["natural_map"] == found["natural_map_recorded"]
    assert "natural_map" not in rival.PINOCCHIO.judge(problem, answer | {"impulse": [math.nan] * 6})
    assert rival.SICONOS.judge(problem, answer | {"outcome": "time"})["outcome"] == "time"


def test_no_recorded_problems_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stress, "QUICK_COUNT", 2)
    monkeypatch.setattr(stress, "WORST", ())
    import warp as wp

    data, text = friction.run(tmp_path, wp.get_device("cpu"), {"Siconos": Path(sys.executable)}, quick=True)
    assert list(data) == ["stress"]
    assert data["stress"]["problems"] == 2
    assert text.startswith("2 of 2 random problems certified")
    assert [line for line in capsys.readouterr().err.splitlines() if "no recorded problems" in line] == [
        f"{tmp_path} holds no recorded problems (*.npz): only the random ones are solved"
    ]
