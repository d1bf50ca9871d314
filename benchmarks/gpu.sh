#!/usr/bin/env bash
# Everything to check where there is a GPU: the tests on it and its speed.
#   benchmarks/gpu.sh [DEVICE=cuda:0] [OUT=benchmarks/results]
# Results are named after the date and kept in OUT; run from the root of a clone with the packages of extra 'dev'.
set -euo pipefail
cd "$(dirname "$0")/.."
device=${1:-cuda:0} out=${2:-benchmarks/results}
nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
WARP_LCP_DEVICE=$device python3 -m pytest -q tests/test_paper_box.py tests/test_physics.py tests/test_batch.py tests/test_lcp.py tests/test_collide.py
python3 -m benchmarks speed --device "$device" --out "$out"
