#!/usr/bin/env bash
# Everything to check where there is a GPU: the tests on it, its speed, and 4096 randomised environments of every shipped scene.
#   benchmarks/gpu.sh [DEVICE=cuda:0] [OUT=benchmarks/results]
# Results are named after the date and kept in OUT; run from the root of a clone with the packages of extra 'dev'.
set -euo pipefail
cd "$(dirname "$0")/.."
device=${1:-cuda:0} out=${2:-benchmarks/results}
nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
export WARP_LCP_DEVICE=$device
python3 -m pytest -q tests/test_{paper_box,physics,batch,lcp,collide,restitution,rollout}.py
python3 -m pytest -q tests/test_{joints,joint_parameters,joint_scenes,loops}.py
python3 -m pytest -q -m slow tests/test_joint_scenes.py # 4096 quadrupeds
python3 -m benchmarks speed --device "$device" --out "$out"
python3 -m benchmarks robust --device "$device" --out "$out" # every shipped scene, robots among them
