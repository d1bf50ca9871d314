# SPDX-License-Identifier: Apache-2.0
"""Solve one problem with Siconos: a job (JSON) from stdin, one line of JSON to stdout for each solver and storage of W.

Runs in the interpreter that has Siconos, which has none of our packages. Solvers cannot be interrupted and print a lot, so
each works in a process of its own, silenced, that a timer ends.
"""

import json
import os
import signal
import sys
import time
import traceback

import numpy as np
import scipy.sparse
import siconos.numerics as sn


def matrix(W, storage):
    """W as one of Siconos' storages: dense, sbm (blocks of 3 x 3), csc."""
    if storage == "dense":
        return np.asfortranarray(W.toarray())
    columns = scipy.sparse.csc_matrix(W)
    columns.indices, columns.indptr = columns.indices.astype(np.int64), columns.indptr.astype(np.int64)
    return sn.SBM_from_csparse(3, columns)[1] if storage == "sbm" else columns


def solve(job, solver, iterations, storage, tolerance):
    """Repeat one solution, each time of a problem made anew; the first is not counted where there are more.

    A time of over a millisecond is the processor's, if less than by the clock: others may take the processor away.
    """
    with np.load(job["path"]) as z:
        n = int(z["n"])
        W = scipy.sparse.csr_matrix((z["W_data"], z["W_indices"], z["W_indptr"]), shape=(n, n))
        q, mu = z["q"].astype(float), np.broadcast_to(z["mu"].astype(float), (n // 3,)).copy()
    prepare, seconds = [], []
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, job["limit_s"])
    while not seconds or (len(seconds) < job["repetitions"] and sum(seconds) < job["budget_s"]):
        begin = time.perf_counter()
        problem = sn.FrictionContactProblem(3, matrix(W, storage), q, mu)
        options = sn.SolverOptions(getattr(sn, "SICONOS_FRICTION_3D_" + solver))
        options.dparam[sn.SICONOS_DPARAM_TOL] = tolerance
        options.iparam[sn.SICONOS_IPARAM_MAX_ITER] = iterations
        impulse, velocity = np.zeros(n), np.zeros(n)
        processor, ready = time.process_time(), time.perf_counter()
        info = sn.fc3d_driver(problem, impulse, velocity, options)
        wall = time.perf_counter() - ready
        seconds.append(wall if wall < 1e-3 else min(wall, time.process_time() - processor))
        prepare.append(ready - begin)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    counted = slice(1, None) if len(seconds) > 1 else slice(None)
    return {
        "info": int(info),
        "iterations": int(options.iparam[sn.SICONOS_IPARAM_ITER_DONE]),
        "seconds": seconds[counted],
        "prepare_s": prepare[counted],
        "impulse": impulse.tolist(),
    }


def attempt(job, *case):
    """`solve` in a silent process of its own: its result, or {"outcome"} saying why there is none."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        try:
            answer = solve(job, *case)
        except Exception:
            answer = {"error": traceback.format_exc()}
        with os.fdopen(writing, "w") as stream:
            json.dump(answer, stream)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as stream:
        text = stream.read()
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return {"outcome": "time" if number == signal.SIGPROF else signal.Signals(number).name}
    answer = json.loads(text)
    if "error" in answer:
        raise RuntimeError(f"{case}: {answer['error']}")
    return answer | {"outcome": "done"}


def main():
    job = json.load(sys.stdin)
    for solver, iterations in job["solvers"].items():
        for storage in job["storages"]:
            for tolerance in job["tolerances"]:  # the loosest first
                answer = attempt(job, solver, iterations, storage, tolerance)
                print(json.dumps({"solver": solver, "storage": storage, "tolerance": tolerance} | answer), flush=True)
                if answer["outcome"] != "done":
                    break


if __name__ == "__main__":
    main()
