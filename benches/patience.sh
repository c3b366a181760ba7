#!/usr/bin/env bash
# The benefit of ending a run when the held-out views no longer improve, for a field (balanced, constant learning rate) and for SART:
#   bash benches/patience.sh DATA_FOLDER OUT_FOLDER [SECONDS [VOLUMES]]
# DATA_FOLDER holds volumes/*.nii.gz. Every tenth view is held out. A field has SECONDS (90), SART ten passes; with patience
# they end sooner, and keep the best record. OUT_FOLDER/patience.md has the result of each.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$1
out=$2
seconds=${3:-90}
volumes=${4:-engine_256 teapot_256 head_256 chest_128 abdomen_128}
cargo build --release --quiet -p conefield
bin=${CARGO_TARGET_DIR:-target}/release/conefield
mkdir -p "$out"
field=(--spec balanced --set training.seconds="$seconds" --set training.steps=1000000)
for volume in $volumes; do
    scan=$out/$volume
    published_scan "$data" "$volume" "$scan"
    run() {
        local name=$1
        shift
        "$bin" -q reconstruct "$scan" -o "$out/$volume-$name" --force --reference truth --hold-out every:10 "$@" >/dev/null
    }
    run field-cosine "${field[@]}"
    run field-constant "${field[@]}" --set 'optimizer.decay="none"'
    run field-patience "${field[@]}" --set 'optimizer.decay="none"' --set 'callbacks.1={type="patience",records=5}'
    run sart-passes --spec sart --set 'stop={passes=10}'
    run sart-patience --spec sart --set 'stop={passes=10,patience=2}'
done
python3 - "$out" $volumes <<'PY' | tee "$out/patience.md"
import json, sys
out, *volumes = sys.argv[1:]
runs = ["field-cosine", "field-constant", "field-patience", "sart-passes", "sart-patience"]
print("| | " + " | ".join(runs) + " |\n|---" + "|---" * len(runs) + "|")
for volume in volumes:
    cells = []
    for run in runs:
        with open(f"{out}/{volume}-{run}/record.json") as file:
            record = json.load(file)
        scores = record["scores"]
        cells.append(f"{scores['psnr']:.2f} dB, {scores['ssim_2d']:.3f}, {record['train_s']:.0f} s, {record['steps']} steps")
    print(f"| {volume} | " + " | ".join(cells) + " |")
PY
