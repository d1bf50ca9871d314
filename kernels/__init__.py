# SPDX-License-Identifier: Apache-2.0
"""Every Warp function and kernel: arithmetic only, no policy and no input or output.

A stage is one file; its cached factory ``make(real)`` builds the kernels for a scalar type (``wp.float32`` or
``wp.float64``). Symbols are the paper's. Arrays have the environment first; their strides are the caller's.
"""
