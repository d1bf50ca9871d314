# SPDX-License-Identifier: Apache-2.0
"""Speed, accuracy and what the kernels take of a GPU: python -m benchmarks NAME."""
