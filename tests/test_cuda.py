# SPDX-License-Identifier: Apache-2.0
"""Every kernel compiles for CUDA on a machine without a GPU; a kernel that the compiler leaves out is a failure."""

import importlib
import pkgutil
from itertools import pairwise
from pathlib import Path

import pytest
import warp_lcp.kernels

from benchmarks import resources


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_every_kernel_compiles_for_sm_90(precision):
    table = resources.measure(precision)
    assert {row.kernel for row in table} == set(resources.kernels(precision))
    assert all(row.registers > 0 for row in table)


def test_the_table_misses_no_kernel():
    """Every @wp.kernel in the sources is among the compiled ones."""
    written = set()
    for info in pkgutil.iter_modules(warp_lcp.kernels.__path__):
        lines = Path(importlib.import_module(f"warp_lcp.kernels.{info.name}").__file__).read_text().splitlines()
        for line, below in pairwise(lines):
            if line.strip().startswith(("@kernel(", "@wp.kernel")):
                written.add(below.strip().removeprefix("def ").split("(")[0])
    found = [resources.kernels(precision) for precision in ("float64", "float32")]
    double, single = ({name.split("[")[0] for name in kernels} for kernels in found)
    assert written == double
    assert written - single == {"pivot", "solve_single"}  # float64 only
    # What a factory's arguments change nothing in is not compiled twice.
    different = {kernel for kernels in found for kernel in kernels.values()}
    for kernel in different:
        kernel.module.get_module_hash()  # a kernel that has not been loaded has no hash yet
    assert len({kernel.hash for kernel in different}) == len(different) > 100
