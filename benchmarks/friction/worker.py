# SPDX-License-Identifier: Apache-2.0
"""What the workers of the rivals share: a job (JSON) from stdin, one line of JSON to stdout for each case and tolerance.

Runs in the interpreter of a rival, which has none of our packages. Solvers cannot be interrupted and some print a lot, so
each works in a process of its own, silenced, that a timer ends. A worker gives `serve` a function of
(W, q, mu, solver, iterations, storage, tolerance) that makes the problem and returns two more: what is timed, and its answer.
"""

import json
import os
import signal
import sys
import time
import traceback

import numpy as np
import scipy.sparse


def solve(job, prepare, *case):
    """Repeat one solution, each time of a problem made anew; the first is not counted where there are more.

    A time of over a millisecond is the processor's, if less than by the clock: others may take the processor away. That of a
    virtual processor may stand still while it accounts for what was taken: no time at all does not count.
    """
    with np.load(job["path"]) as z:
        n = int(z["n"])
        W = scipy.sparse.csr_matrix((z["W_data"], z["W_indices"], z["W_indptr"]), shape=(n, n))
        q, mu = z["q"].astype(float), np.broadcast_to(z["mu"].astype(float), (n // 3,)).copy()
    prepared, seconds = [], []
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, job["limit_s"])
    while not seconds or (len(seconds) < job["repetitions"] and sum(seconds) < job["budget_s"]):
        begin = time.perf_counter()
        action, answer = prepare(W, q, mu, *case)
        processor, ready = time.process_time(), time.perf_counter()
        action()
        wall, used = time.perf_counter() - ready, time.process_time() - processor
        seconds.append(wall if wall < 1e-3 else min(wall, used or wall))
        prepared.append(ready - begin)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    counted = slice(1, None) if len(seconds) > 1 else slice(None)
    iterations, impulse = answer()
    return {
        "iterations": int(iterations),
        "seconds": seconds[counted],
        "prepare_s": prepared[counted],
        "impulse": impulse.tolist(),
    }


def attempt(job, prepare, *case):
    """`solve` in a silent process of its own: its result, or {"outcome"} saying why there is none."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        try:
            answer = solve(job, prepare, *case)
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


def serve(prepare):
    """Every case of the job."""
    job = json.load(sys.stdin)
    for solver, iterations, storage in job["cases"]:
        for tolerance in job["tolerances"]:  # the loosest first
            answer = attempt(job, prepare, solver, iterations, storage, tolerance)
            print(json.dumps({"solver": solver, "storage": storage, "tolerance": tolerance} | answer), flush=True)
            if answer["outcome"] != "done":
                break
