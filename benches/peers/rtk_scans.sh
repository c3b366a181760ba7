#!/usr/bin/env bash
# Scans with RTK's projections (CPU), for benches/budgets.sh to measure:
#   bash benches/peers/rtk_scans.sh DATA_FOLDER OUT_FOLDER PYTHON [SEEDS [VOLUMES [VIEWS]]]
#   bash benches/budgets.sh DATA_FOLDER OUT_FOLDER "10s 20s 60s" best
# PYTHON has itk-rtk, numpy and nibabel.
set -euo pipefail
cd "$(dirname "$0")/../.."
source benches/common.sh
python=$3
seeds=${4:-0 1 2}
volumes=${5:-engine_256 head_256 teapot_256 chest_128 abdomen_128}
views=${6:-50}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
for volume in $volumes; do
    pairs=()
    for seed in $seeds; do
        scan=$volume-$views-$seed
        [[ -d $out/$scan ]] && continue
        published_scan "$data" "$volume" "$work/$scan" "$views" "$seed"
        pairs+=("$work/$scan=$out/$scan")
    done
    [[ ${#pairs[@]} -gt 0 ]] || continue
    published_scan "$data" "$volume" "$work/$volume" "$views" 0 none
    "$python" benches/peers/rtk_scan.py "$work/$volume" "${pairs[@]}"
done
