# SPDX-License-Identifier: Apache-2.0
"""solve_contact on a recorded problem: alone and in a batch of copies, the whole call and the launch that it ends with."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import warp_lcp as wl
from warp_lcp.friction_problem import prepare

from .recorded import Problem, natural_map

METHODS = ("auto", "pgs")
BATCH_S = 0.05  # so long should a batch take
BATCH_BYTES = 2**28  # and so large may its W be
BATCH = 4096


def clock(device: wp.Device, action: Callable[[], Any], repetitions: int, seconds: float) -> tuple[float, float]:
    """Best and median time of an action [s], the first one not counted; repeated until either limit is reached.

    On the CPU a time of over a millisecond is the processor's, if less than by the clock: others may take the processor away.
    Less than that is left to the median, because virtual processors account for what was taken in lumps: their time may stand still,
    and no time at all does not count.
    """
    action()
    wp.synchronize_device(device)
    times: list[float] = []
    finish = time.perf_counter() + seconds
    while not times or (len(times) < repetitions and time.perf_counter() < finish):
        processor, begin = time.process_time(), time.perf_counter()
        action()
        wp.synchronize_device(device)
        wall, used = time.perf_counter() - begin, time.process_time() - processor
        times.append(wall if device.is_cuda or wall < 1e-3 else min(wall, used or wall))
    return min(times), statistics.median(times)


def measure(problem: Problem, method: str, device: wp.Device, quick: bool) -> dict[str, Any]:
    """Times of one method, per problem, and what it reached."""
    limits = (5, 0.2) if quick else (50, 1.0)

    def both(W: np.ndarray, q: np.ndarray) -> tuple[wl.ContactSolution, tuple[float, float], tuple[float, float]]:
        solution, command = prepare(W, q, problem.mu, "coulomb", method, 2, None, device)
        assert command is not None
        kernel = clock(device, command.launch, *limits)
        return solution, kernel, clock(device, lambda: wl.solve_contact(W, q, problem.mu, method=method, device=device), *limits)

    solution, kernel, call = both(problem.W, problem.q)
    batch = max(1, min(BATCH, int(BATCH_S / kernel[0]), BATCH_BYTES // problem.W.nbytes))
    many, many_kernel, many_call = both(np.tile(problem.W, (batch, 1, 1)), np.tile(problem.q, (batch, 1)))
    if not (many.impulse.numpy() == solution.impulse.numpy()).all():
        raise RuntimeError(f"{problem.name}, {method}: answers in a batch of copies differ")
    return {
        "call_best_s": call[0],
        "call_median_s": call[1],
        "kernel_best_s": kernel[0],
        "kernel_median_s": kernel[1],
        "batch": batch,
        "batch_call_best_s": many_call[0] / batch,
        "batch_call_median_s": many_call[1] / batch,
        "batch_kernel_best_s": many_kernel[0] / batch,
        "batch_kernel_median_s": many_kernel[1] / batch,
        "natural_map": natural_map(problem.W, problem.q, problem.mu, solution.impulse.numpy()[0]),
        "reported_natural_map": float(solution.natural_map.numpy()[0]),
        "iterations": int(solution.iterations.numpy()[0]),
        "status": int(solution.status.numpy()[0]),
    }
