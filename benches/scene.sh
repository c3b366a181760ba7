#!/usr/bin/env bash
# What it is worth to model only what a scan needs: a field of six levels (benches/six-levels.toml) with each rule alone and
# with all for SECONDS (60), and with none, as published, for 10/3 as long:
#   bash benches/scene.sh DATA_FOLDER OUT_FOLDER [SECONDS [VOLUMES [RUNS]]]
# RUNS ("none support levels channels samples six-levels all") may name fewer.
# DATA_FOLDER holds volumes/*.nii.gz. OUT_FOLDER/scene.md has PSNR, ssim_2d and the seconds of the command.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
seconds=${3:-60}
volumes=${4:-engine_256 teapot_256 head_256 chest_128 abdomen_128}
wanted=${5:-none support levels channels samples six-levels all}
for volume in $volumes; do
    scan=$out/$volume
    published_scan "$data" "$volume" "$scan"
    run() {
        local name=$1 time=$2 support=$3 levels=$4
        shift 4
        [[ " $wanted " == *" $name "* ]] || return 0
        "$bin" -q reconstruct "$scan" --spec benches/six-levels.toml -o "$out/$volume-$name" --force --reference truth \
            --set training.seconds="$time" --set training.steps=1000000 --set scene.support="$support" \
            --set scene.levels="$levels" "$@" >/dev/null
    }
    # As published: as many samples on every ray.
    count=(--set projector.samples=320 --set training.rays=1024)
    run none "$(python3 -c "print($seconds * 10 / 3)")" box all "${count[@]}"
    run support "$seconds" carve all "${count[@]}"
    run levels "$seconds" box needed "${count[@]}"
    run channels "$seconds" box all "${count[@]}" --set 'callbacks=["rollback", { type = "fft-mask", rule = "relative", epoch = 2.0 }]'
    run samples "$seconds" box all
    run six-levels "$seconds" carve all
    run all "$seconds" carve needed
done
python3 benches/spread.py "$out/{column}-{row}/record.json" "$wanted" "$volumes" 0 | tee "$out/scene.md"
