#!/usr/bin/env bash
# The projectors and FDK, ours and RTK's (CPU), in turn on this machine, on scans of one size, and FDK's PSNR on one scan:
#   bash benches/peers/classical.sh VOLUME.nii.gz OUT_FOLDER [ROUNDS]
# 50 views of 512 × 512 of a volume of 256³. RTK is installed into a virtual environment in target/.
set -euo pipefail
cd "$(dirname "$0")/../.."
source benches/common.sh
volume=$1
venv=target/rtk
if [[ ! -x $venv/bin/python ]]; then
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet itk-rtk numpy nibabel
fi
cargo bench --quiet -p conefield-benches --bench projectors --no-run
scan=$out/scan
[[ -d $scan ]] || "$bin" -q simulate "$volume" -o "$scan" --protocol r2 --views 50 --noise tigre:1e4,10
# In turn, so that a change of the machine's speed shows.
for _ in $(seq "${3:-2}"); do
    cargo bench --quiet -p conefield-benches --bench projectors
    "$venv/bin/python" benches/peers/rtk.py "$scan" "$volume"
done
for window in ramp hann; do
    "$bin" -q reconstruct "$scan" --spec fdk --set "window=$window" --set nonnegative=false -o "$out/fdk-$window" \
        --force --reference truth
done
