#!/usr/bin/env bash
# How much normalizers and field change under the same features (the callback drift), with and without LayerNorm and MCI:
#   bash benches/drift.sh DATA_FOLDER OUT_FOLDER [STEPS [VOLUME]]
# DATA_FOLDER holds volumes/*.nii.gz. MCI weights come from abdomen alone, for each way with normalizers of its own. Steps
# (1000) end a run, so that the load of the machine does not matter. The learning rate stays as it is, or its fall would
# look like stability; it is five times the published one. Tables, rays and samples are few, so that a run takes a minute.
# Leaves OUT_FOLDER/VOLUME-drift.png (drift against epochs) and VOLUME-psnr.png; the variable PYTHON (python3) names a Python with
# matplotlib. Finished runs are not run again.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
"${PYTHON:-python3}" -c "import matplotlib" # Before hours of work.
steps=${3:-1000}
volume=${4:-chest_128}
scan=$out/$volume
published_scan "$data" "$volume" "$scan"
none='normalizers=[]'
norm='normalizers=["layer-norm"]'
small=(--spec ni-naf --set encoder.log2_table_size=17)
for way in none norm; do
    weights=$out/abdomen-$way.safetensors
    [[ -f $weights ]] || "$bin" -q pretrain "$data/volumes/abdomen_128.nii.gz" "${small[@]}" --set "${!way}" \
        --set pretraining.points=16384 -o "$weights" --steps 400
done
run() {
    local run=$out/$volume-$1
    shift
    [[ -f $run/record.json ]] || "$bin" -q reconstruct "$scan" "${small[@]}" -o "$run" --force --steps "$steps" \
        --reference truth --set training.report_every=25 --set optimizer.lr=5e-3 --set 'optimizer.decay="none"' \
        --set training.rays=512 --set projector.samples=96 --set 'callbacks.1={type="drift",every=1}' "$@"
}
run naf --set "$none"
run mci --set "$none" --init "$out/abdomen-none.safetensors"
run ln --set "$norm"
run ln-mci --set "$norm" --init "$out/abdomen-norm.safetensors"
runs=("NAF=$out/$volume-naf" "NAF+MCI=$out/$volume-mci" "NAF+LN=$out/$volume-ln" "NAF+LN+MCI=$out/$volume-ln-mci")
"${PYTHON:-python3}" benches/curves.py --drift "$out/$volume-drift.png" "$volume, 50 noisy views: drift over one epoch" "${runs[@]}"
"${PYTHON:-python3}" benches/curves.py "$out/$volume-psnr.png" "$volume, 50 noisy views" "${runs[@]}"
