# SPDX-License-Identifier: Apache-2.0
"""Kernels on their way to a device: a process compiles them side by side in the background, those first that somebody waits for."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import warp as wp


class Queue:
    """Modules that are still to be loaded, in turn, and the threads that do. Their exceptions are raised where they are waited for.

    Threads live as long as the process: Warp compiles its headers once for each, which takes as long as ten small kernels.
    """

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="warp_lcp")
        self._lock = threading.Lock()
        self._asked: dict[tuple[Any, str], Future[None]] = {}
        self._turn: list[tuple[Any, str]] = []

    def add(self, kernel: wp.Kernel, device: wp.Device) -> Future[None]:
        """Done once the kernel can be launched without compiling anything."""
        with self._lock:
            key = kernel.module, device.alias
            if key not in self._asked:
                self._asked[key] = Future()
                self._turn.append(key)
                self._threads.submit(self._load_next)
            return self._asked[key]

    def _load_next(self) -> None:
        with self._lock:
            module, device = key = self._turn.pop(0)
            future = self._asked[key]
        problem = None
        try:
            wp.force_load(device, modules=[module], block_dim=module.options["block_dim"])
        except BaseException as error:
            problem = error
        with self._lock:
            if problem is None:
                future.set_result(None)
            else:
                del self._asked[key]  # whoever asks from now on has it tried once more
                future.set_exception(problem)

    def hurry(self, futures: Iterable[Future[None]]) -> None:
        """Load these next, if they have not begun."""
        wanted = set(futures)
        with self._lock:
            self._turn.sort(key=lambda key: self._asked[key] not in wanted)

    def settle(self) -> None:
        """Wait until nothing is left to load."""
        with self._lock:
            asked = tuple(self._asked.values())
        wait(asked)


_queues: dict[int, Queue] = {}


def _queue() -> Queue:
    """That of this process: threads do not survive a fork."""
    process = os.getpid()
    return _queues[process] if process in _queues else _queues.setdefault(process, Queue())


def _settle_before_a_fork() -> None:
    # A thread that loads holds locks of Warp and its compiler, which in the new process nobody would give back.
    if os.getpid() in _queues:
        _queue().settle()


if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(before=_settle_before_a_fork)


class Loading:
    """The kernels of one Simulator that are not known to be loaded."""

    def __init__(self, device: wp.Device):
        self._device = device
        self._begun: dict[wp.Kernel, Future[None]] = {}

    def begin(self, kernel: wp.Kernel) -> None:
        future = _queue().add(kernel, self._device)
        if not future.done() or future.exception() is not None:
            self._begun[kernel] = future

    def __contains__(self, kernel: wp.Kernel) -> bool:
        """Whether nobody has waited for it yet."""
        return kernel in self._begun

    def __bool__(self) -> bool:
        return bool(self._begun)

    def finish(self, kernels: Iterable[wp.Kernel] | None = None) -> None:
        """Wait for some kernels, None: for all; raises what went wrong with them."""
        if not self._begun:
            return
        waited = {k: self._begun[k] for k in (tuple(self._begun) if kernels is None else kernels) if k in self._begun}
        if not all(future.done() for future in waited.values()):
            _queue().hurry(waited.values())
        for kernel, future in waited.items():
            wait([future])
            del self._begun[kernel]  # not before: who interrupts this has to wait for it again
            future.result()

    def forget_loaded(self) -> None:
        """Those that are loaded by now need no more waiting for."""
        self.finish([kernel for kernel, future in self._begun.items() if future.done()])
