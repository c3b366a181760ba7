#!/usr/bin/env bash
# A learned prior at the end: a small 3D network learns from two volumes and their own reconstructions what smooth-tv loses, and is
# tested on three others:
#   bash benches/learned.sh DATA_FOLDER OUT_FOLDER PYTHON [INPUTS [STEPS]]
# PYTHON has torch and nibabel. INPUTS ("smooth-tv light fdk") are the volumes that the network sees; light is smooth-tv with a third of
# the prior's weight. It learns in STEPS (2500) steps from 50 noisy views of abdomen_128 and head_256, two seeds of noise each. Prints PSNR
# before and after; OUT_FOLDER/VOLUME.png has the test volumes' slices and errors. What is there is not made again.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
python=$3
inputs=${4:-smooth-tv light fdk}
steps=${5:-2500}
learn="abdomen_128-0 abdomen_128-1 head_256-0 head_256-1"
test="chest_128-0 engine_256-0 teapot_256-0"
weight='={ type = "directional-total-variation", edge = 0.7, weight = { noise = 0.25 } }'
for name in $learn $test; do
    published_scan "$data" "${name%-*}" "$out/$name" 50 "${name#*-}"
    for input in $inputs; do
        run=$out/$name-$input
        [[ -f $run/record.json ]] && continue
        case $input in
            light) set=(--spec smooth-tv --set "methods.1.prior$weight" --set "methods.2.prior$weight") ;;
            *) set=(--spec "$input") ;;
        esac
        "$bin" -q reconstruct "$out/$name" "${set[@]}" -o "$run" --force --reference truth >/dev/null
    done
done
"$python" benches/learned.py "$out" "$steps" "$inputs" "$learn" "$test"
for name in $test; do
    "$bin" -q evaluate "$out/$name.nii.gz" "$out/$name/truth.nii.gz" --png "$out/$name.png" >/dev/null
done
