#!/usr/bin/env bash
# The benefit of ending a run when the held-out views no longer improve, for the field of balanced at a constant learning rate:
#   bash benches/patience.sh DATA_FOLDER OUT_FOLDER [SECONDS [VOLUMES]]
# DATA_FOLDER holds volumes/*.nii.gz. Every tenth view is held out. A run has SECONDS (90); with patience it ends sooner, and keeps the
# best record. OUT_FOLDER/patience.md has PSNR, ssim_2d and the seconds of the command.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
seconds=${3:-90}
volumes=${4:-engine_256 teapot_256 head_256 chest_128 abdomen_128}
balanced=(--spec balanced --set training.seconds="$seconds" --set training.steps=1000000)
for volume in $volumes; do
    scan=$out/$volume
    published_scan "$data" "$volume" "$scan"
    run() {
        local name=$1
        shift
        "$bin" -q reconstruct "$scan" -o "$out/$volume-$name" --force --reference truth --hold-out every:10 "${balanced[@]}" "$@" >/dev/null
    }
    run falling-rate
    run constant-rate --set 'optimizer.decay="none"'
    run patience --set 'optimizer.decay="none"' --set 'callbacks.1={type="patience",records=5}'
done
python3 benches/spread.py "$out/{column}-{row}/record.json" "falling-rate constant-rate patience" "$volumes" 0 | tee "$out/patience.md"
