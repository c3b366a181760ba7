#!/usr/bin/env bash
# What the volume of a field holds that the volume of total variation lacks:
#   bash benches/mix.sh DATA_FOLDER OUT_FOLDER PYTHON [FIELD [STEPS [TV [VOLUMES]]]]
# FIELD (balanced) makes STEPS (2500) and TV (smooth-tv) runs as it is on 50 noisy views of each of VOLUMES. Prints what mix.py says of
# each pair: A is TV, B is FIELD. PYTHON has numpy and nibabel. Steps are counted, not timed. What is there is not run again.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$1
out=$2
python=$3
field=${4:-balanced}
steps=${5:-2500}
tv=${6:-smooth-tv}
volumes=${7:-engine_256 head_256 teapot_256 chest_128 abdomen_128}
cargo build --release --quiet -p conefield
bin=${CARGO_TARGET_DIR:-target}/release/conefield
mkdir -p "$out"
rows=()
for volume in $volumes; do
    scan=$out/$volume
    published_scan "$data" "$volume" "$scan"
    run() { # NAME OPTIONS...
        local name=$out/$volume-$1
        [[ -f $name/record.json ]] || "$bin" -q reconstruct "$scan" -o "$name" --force "${@:2}" >/dev/null
    }
    run "$tv" --spec "$tv"
    run "$field" --spec "$field" --steps "$steps"
    rows+=("$volume=$out/$volume-$tv/volume.nii.gz=$out/$volume-$field/volume.nii.gz=$scan/truth.nii.gz")
done
"$python" benches/mix.py "${rows[@]}"
