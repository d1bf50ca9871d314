# SPDX-License-Identifier: Apache-2.0
"""Kernels in modules of their own, made by factories: a process compiles those that it needs, side by side.

Modules are named by what their factory was called with. (Warp can name a module by a hash of its kernel, module="unique", but reads all
that the kernel calls once more for it: a fifth of a start with a full cache.)
"""

import functools
import inspect
import threading
from typing import Any

import warp as wp

from .types import LANES

# How modules are compiled on the CPU. Products and sums are fused where they can be (4 to 5 % of a step), as on a GPU. The others save
# time of compilation: loops are not vectorised (they run over a few rows or bodies, steps are no slower; 6 %), and in Warp's headers,
# which a thread compiles once for all its modules, templates are instantiated once for all (0.1 s a module) and bfloat16 is left out (1 s).
FLAGS = "-ffp-contract=fast -fno-vectorize -fpch-instantiate-templates -DWP_NO_BFLOAT16="
OPTIONS = {"cpu_compiler_flags": f"{wp.config.cpu_compiler_flags or '-march=native'} {FLAGS}"}
BLOCK_OPTIONS = {**OPTIONS, "block_dim": LANES}  # of kernels whose blocks work on one environment each

_lock = threading.RLock()
_at_work: list[tuple[tuple[Any, ...], set[str]]] = []  # arguments of factories, innermost last, and the modules they have made so far


def factory(make):
    """A factory of kernels that makes each set once, whichever way its arguments are given."""
    signature = inspect.signature(make)
    made: dict[tuple[Any, ...], Any] = {}

    @functools.wraps(make)
    def once(*args, **kwargs):
        given = signature.bind(*args, **kwargs)
        given.apply_defaults()
        key = tuple(given.arguments.values())
        with _lock:
            if key not in made:
                _at_work.append((key, set()))
                try:
                    made[key] = make(*key)
                finally:
                    _at_work.pop()
            return made[key]

    return once


def kernel(options=OPTIONS):
    """A kernel of the factory around it, in a module of its own."""

    def declare(function):
        arguments, names = _at_work[-1]
        key = (argument.__name__ if isinstance(argument, type) else str(argument) for argument in arguments)
        name = ".".join((function.__module__, function.__qualname__.replace(".<locals>", ""), *key))
        if name in names:
            raise NameError(f"there are two kernels {name}")
        names.add(name)
        wp.set_module_options(options, module=(module := wp.get_module(name)))
        return wp.kernel(function, module=module, enable_backward=False)

    return declare
