#!/usr/bin/env bash
# Scans with RTK's projections (CPU), for benches/budgets.sh to measure:
#   bash benches/peers/rtk_scans.sh DATA_FOLDER OUT_FOLDER PYTHON [SEEDS [VOLUMES [VIEWS]]]
#   bash benches/budgets.sh DATA_FOLDER OUT_FOLDER "10s 20s 60s" best
# PYTHON has itk-rtk, numpy and nibabel.
set -euo pipefail
cd "$(dirname "$0")/../.."
data=$1
out=$2
python=$3
seeds=${4:-0 1 2}
volumes=${5:-engine_256 head_256 teapot_256 chest_128 abdomen_128}
views=${6:-50}
cargo build --release --quiet -p conefield
bin=${CARGO_TARGET_DIR:-target}/release/conefield
mkdir -p "$out"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for volume in $volumes; do
    simulate=("$bin" -q simulate "$data/volumes/$volume.nii.gz" --protocol r2 --views "$views" --force)
    "${simulate[@]}" -o "$work/clean" --noise none >/dev/null
    for seed in $seeds; do
        [[ -d $out/$volume-$views-$seed ]] && continue
        "${simulate[@]}" -o "$work/noisy" --noise tigre:1e4,10 --seed "$seed" >/dev/null
        "$python" benches/peers/rtk_scan.py "$work/noisy" "$work/clean" "$out/$volume-$views-$seed"
    done
done
