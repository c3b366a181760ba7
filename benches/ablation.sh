#!/usr/bin/env bash
# The parts of the method one after the other (NAF, + LayerNorm, + MCI, + FFT mask) on real volumes, same seconds each:
#   bash benches/ablation.sh DATA_FOLDER OUT_FOLDER [SECONDS]
# DATA_FOLDER holds volumes/*.nii.gz. MCI weights come from abdomen alone. Writes a curve a volume and scores.txt.
# All variants learn five times faster than published and take 192 samples inside the volume, so that a short run says
# something; NAF with its published rate stays at its first plateau that long.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$1
out=$2
seconds=${3:-120}
cargo build --release --quiet -p conefield
cargo build --release --quiet -p conefield-benches --bin curves
bin=${CARGO_TARGET_DIR:-target}/release
mkdir -p "$out"
none='normalizers=[]'
norm='normalizers=["layer-norm"]'
whole='callbacks=["rollback"]'
weights=$out/abdomen.safetensors
[[ -f $weights ]] || "$bin/conefield" -q pretrain "$data/volumes/abdomen_128.nii.gz" --spec ni-naf --set "$norm" -o "$weights"
: >"$out/scores.txt"
for volume in engine_256 head_256 chest_128; do
    scan=$out/$volume
    published_scan "$data" "$volume" "$scan"
    run() {
        local name=$1
        shift
        echo "== $volume $name" | tee -a "$out/scores.txt"
        "$bin/conefield" -q reconstruct "$scan" --spec ni-naf -o "$out/$volume-$name" --force --seconds "${seconds}" \
            --reference truth --set training.report_every=25 --set optimizer.lr=5e-3 --set projector.samples=192 "$@" | tee -a "$out/scores.txt"
    }
    run naf --set "$none" --set "$whole"
    run ln --set "$norm" --set "$whole"
    run ln-mci --set "$norm" --set "$whole" --init "$weights"
    run ln-mci-mask --set "$norm" --init "$weights"
    "$bin/curves" "$out/$volume.png" "$volume, 50 noisy views" "NAF=$out/$volume-naf" "NAF+LN=$out/$volume-ln" \
        "NAF+LN+MCI=$out/$volume-ln-mci" "NAF+LN+MCI+mask=$out/$volume-ln-mci-mask"
done
