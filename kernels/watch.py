# SPDX-License-Identifier: Apache-2.0
"""Watching a run from outside without reading it back at every step."""

import warp as wp

from .declare import factory, kernel


@factory
def make():
    """Kernel ``collect_status``; launch with dim E."""

    @kernel()
    def collect_status(status: wp.array(dtype=int), seen: wp.array(dtype=int)):
        """Or the status words [E] of a step() call into those seen so far."""
        e = wp.tid()
        seen[e] = seen[e] | status[e]

    return collect_status
