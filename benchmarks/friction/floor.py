# SPDX-License-Identifier: Apache-2.0
"""Where the time of one launch goes, and the least that its memory and arithmetic would take on this processor.

W is read once (it is dense, and its pattern and asymmetry are not known before). Newton's method factorises matrices whose
blocks follow from the order of elimination, which is worked out here anew. Gauss-Seidel reads every block in a sweep.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_lcp.friction_problem import METHODS, prepare

from .ours import clock
from .recorded import Problem


def rates() -> dict[str, float]:
    """Bytes/s of reading memory and flop/s of a product of matrices in the cache, by processor time: of one core however many work."""
    large, a = np.ones(2**25), np.ones((100, 100))  # larger ones wake threads whose waiting would count

    def best(action: Any) -> float:
        times = []
        for _ in range(10):
            begin = time.process_time()
            action()
            times.append(time.process_time() - begin)
        return min(times)

    return {"bytes_per_s": large.nbytes / best(large.max), "flops_per_s": 2.0 * len(a) ** 3 / best(lambda: a @ a)}


def degrees(coupled: np.ndarray) -> list[int]:
    """Neighbours that every node has when its turn to be eliminated comes, least first, ties by number."""
    neighbours = {i: set(np.flatnonzero(row).tolist()) - {i} for i, row in enumerate(coupled)}
    result = []
    while neighbours:
        node = min(neighbours, key=lambda i: len(neighbours[i]))
        around = neighbours.pop(node)
        for j in around:
            neighbours[j] = (neighbours[j] | around) - {j, node}
        result.append(len(around))
    return result


def work(problem: Problem) -> dict[str, float]:
    """Blocks of W, blocks of a factor, flops of one factorisation with its solution and product, flops of a sweep."""
    n = problem.contacts
    blocks = np.abs(problem.W).reshape(n, 3, n, 3).max(axis=(1, 3)) > 0.0
    coupled, own = int((blocks & ~np.eye(n, dtype=bool)).sum()), degrees(blocks | blocks.T)
    factorise = sum(90 + 54 * d + 54 * d + 2 * 54 * d * (d - 1) // 2 for d in own)
    assemble = 54 * (coupled + n)
    substitute = 2 * 18 * sum(own) + 18 * n
    product = 18 * (coupled + n)
    return {"blocks": coupled + n, "fill": sum(own), "newton_flops": factorise + assemble + substitute + product, "sweep_flops": product}


def measure(problem: Problem, device: wp.Device) -> dict[str, Any]:
    """Best times of launches that only read and certify, that sweep too, and that do everything."""
    solution, command = prepare(problem.W, problem.q, problem.mu, "coulomb", "auto", 2, None, device)
    assert command is not None
    sweeps, limit = METHODS["auto"]
    seconds, steps = [], []
    for some_sweeps, some_limit in ((0, 0), (sweeps, 0), (sweeps, limit)):
        command.set_param_by_name("sweeps", some_sweeps)
        command.set_param_by_name("newton_limit", some_limit)
        seconds.append(clock(device, command.launch, 50, 1.0)[0])
        steps.append(int(solution.iterations.numpy()[0]))
    return {
        "problem": problem.name,
        "contacts": problem.contacts,
        **work(problem),
        "W_bytes": problem.W.nbytes,
        "read_and_certify_s": seconds[0],
        "sweeps_s": seconds[1] - seconds[0],
        "newton_s": seconds[2] - seconds[1],
        "sweeps": steps[1],
        "factorisations": steps[2] - steps[1],
    }


def markdown(rows: Sequence[dict[str, Any]], rate: dict[str, float]) -> str:
    """Stages with their floors, and how many times the floor each takes."""
    lines = [f"read {rate['bytes_per_s'] / 1e9:.1f} GB/s, products of matrices {rate['flops_per_s'] / 1e9:.1f} Gflop/s", ""]
    lines.append("| problem | contacts, blocks, fill | read and certify (gap) | sweeps (gap) | Newton (gap) | factorisations |")
    lines.append("|" + " --- |" * 6)
    for row in rows:
        floors = (
            row["W_bytes"] / rate["bytes_per_s"],
            row["sweeps"] * row["sweep_flops"] / rate["flops_per_s"],
            row["factorisations"] * row["newton_flops"] / rate["flops_per_s"],
        )
        stages = [row[key] for key in ("read_and_certify_s", "sweeps_s", "newton_s")]
        cells = [f"{1e3 * s:.3f} ms ({s / max(f, 1e-12):.1f}x of {1e3 * f:.3f})" for s, f in zip(stages, floors, strict=True)]
        lines.append(
            f"| {row['problem']} | {row['contacts']}, {row['blocks']}, {row['fill']} | {' | '.join(cells)} | {row['factorisations']} |"
        )
    return "\n".join(lines)
