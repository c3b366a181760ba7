#!/usr/bin/env bash
# The attenuation that stages see as 1, as a share of what the scan takes by itself:
#   bash benches/scale.sh DATA_FOLDER OUT_FOLDER [SPEC [STEPS [SHARES [SEEDS [VOLUMES]]]]]
# SPEC (balanced) makes STEPS (800) on 50 noisy views of each of VOLUMES, for each of SHARES ("1 0.5 0.25 0.12"); each of SEEDS ("0") is
# another noise and another start. Prints mean and half the range of PSNR, and the mean of ssim_2d. Steps are counted, not timed:
# other work on the machine changes nothing.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
spec=${3:-balanced}
steps=${4:-800}
shares=${5:-1 0.5 0.25 0.12}
seeds=${6:-0}
volumes=${7:-engine_256 head_256 teapot_256 chest_128 abdomen_128}
for volume in $volumes; do
    for seed in $seeds; do
        scan=$out/$volume-$seed
        published_scan "$data" "$volume" "$scan" 50 "$seed"
        for share in $shares; do
            record=$out/$spec-$steps-$volume-$seed-$share.json
            [[ -f $record ]] && continue
            "$bin" -q reconstruct "$scan" -o "$out/run" --force --reference truth --spec "$spec" --steps "$steps" --seed "$seed" \
                --set "scene.attenuation={ relative = $share }" >/dev/null
            cp "$out/run/record.json" "$record"
        done
    done
done
python3 benches/spread.py "$out/$spec-$steps-{row}-{seed}-{column}.json" "$volumes" "$shares" "$seeds"
