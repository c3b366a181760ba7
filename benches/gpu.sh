#!/usr/bin/env bash
# Everything about a GPU: parity with the CPU first, then speed beside what the device can do, then a real scan:
#   bash benches/gpu.sh [ADAPTER] [DATA_FOLDER] [OUT_FOLDER]
# ADAPTER is a number from `conefield backends` (default 0). DATA_FOLDER holds volumes/engine_256.nii.gz; without it the
# real scan is left out. Where python3 has PyTorch with CUDA, the same training step runs there too. A software device does
# less work of each.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
adapter=${1:-0}
data=${2:-}
out=${3:-gpu-out}
bin=${CARGO_TARGET_DIR:-target}/release/conefield
cargo build --release --quiet -p conefield
"$bin" backends
echo "== parity"
cargo test --release --quiet -p conefield-tests --test stages --test wgpu --test wgpu_voxels
echo "== speed"
cargo bench --quiet -p conefield-benches --bench gpu -- "$adapter"
if python3 -c 'import sys, torch; sys.exit(not torch.cuda.is_available())' 2>/dev/null; then
    echo "== the same step in PyTorch with CUDA"
    python3 benches/peers/train.py --device cuda
fi
software=$("$bin" backends --json | python3 -c "import json, sys; print(json.load(sys.stdin)['backends'][1]['adapters'][$adapter]['software'])")
if [[ -n $data ]]; then
    echo "== seconds to PSNR on engine_256, 50 noisy views"
    mkdir -p "$out"
    published_scan "$data" engine_256 "$out/scan"
    small=()
    budget=300s
    if [[ $software == True ]]; then
        small=(--set training.rays=64 --set projector.samples=64)
        budget=60s
    fi
    for spec in ni-naf balanced; do
        "$bin" -q reconstruct "$out/scan" --spec "$spec" -o "$out/$spec" --force --backend "wgpu:$adapter" --seconds "$budget" \
            --reference truth --set training.report_every=25 "${small[@]}"
        python3 - "$out/$spec/metrics.jsonl" "$spec" <<'PY'
import json, sys
records = [json.loads(line) for line in open(sys.argv[1])]
marks = {}
for r in records:
    for mark in (20, 25, 28, 30, 32, 34, 36):
        if (r.get("psnr") or 0) >= mark:
            marks.setdefault(mark, r["seconds"])
print(sys.argv[2], ", ".join(f"{m} dB after {t:.1f} s" for m, t in marks.items()) or "no mark reached")
PY
    done
    "$bin" -q compare "$out/scan" --specs fdk,sart --reference truth -o "$out/classical" --force --backend "wgpu:$adapter" --at-most "$budget"
fi
