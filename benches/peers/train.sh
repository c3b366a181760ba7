#!/usr/bin/env bash
# The published training step, ours and PyTorch's, one after the other on this machine: `bash benches/peers/train.sh`.
# PyTorch is installed into a virtual environment in target/; COMPILE=1 also measures torch.compile (needs a C++ compiler).
set -euo pipefail
cd "$(dirname "$0")/../.."
venv=target/peers
if [[ ! -x $venv/bin/python ]]; then
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet torch numpy
fi
cargo bench --quiet -p conefield-benches --bench training
"$venv/bin/python" benches/peers/train.py
if [[ ${COMPILE:-} == 1 ]]; then
    "$venv/bin/python" benches/peers/train.py --compile
fi
