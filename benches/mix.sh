#!/usr/bin/env bash
# What a field adds to total variation:
#   bash benches/mix.sh DATA_FOLDER OUT_FOLDER PYTHON [FIELD [STEPS [TV [VOLUMES]]]]
# Runs the specs TV (smooth-tv) and FIELD (balanced, STEPS = 2500) on 50 noisy views of each of VOLUMES, then prints the tables of mix.py,
# with TV as A and FIELD as B. PYTHON has numpy and nibabel. Steps are counted, not timed. What is there is not run again.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
python=$3
field=${4:-balanced}
steps=${5:-2500}
tv=${6:-smooth-tv}
volumes=${7:-engine_256 head_256 teapot_256 chest_128 abdomen_128}
run() { # VOLUME SPEC OPTIONS...
    local name=$out/$1-$2
    [[ -f $name/record.json ]] || "$bin" -q reconstruct "$out/$1" --spec "$2" -o "$name" --force "${@:3}" >/dev/null
}
rows=()
for volume in $volumes; do
    scan=$out/$volume
    published_scan "$data" "$volume" "$scan"
    run "$volume" "$tv"
    run "$volume" "$field" --steps "$steps"
    rows+=("$volume=$out/$volume-$tv/volume.nii.gz=$out/$volume-$field/volume.nii.gz=$scan/truth.nii.gz")
done
"$python" benches/mix.py "${rows[@]}"
