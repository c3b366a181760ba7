#!/usr/bin/env bash
# What modelling only what a scan has need of is worth: `accurate` with each rule alone, all and none, same seconds each:
#   bash benches/scene.sh DATA_FOLDER OUT_FOLDER [SECONDS [VOLUMES]]
# DATA_FOLDER holds volumes/*.nii.gz. OUT_FOLDER/scene.md has a table a volume: what each ends with, and after how many seconds
# it was where the run with none of the rules ended.
set -euo pipefail
cd "$(dirname "$0")/.."
data=$1
out=$2
seconds=${3:-60}
volumes=${4:-engine_256 teapot_256 head_256 chest_128 abdomen_128}
cargo build --release --quiet -p conefield
cargo build --release --quiet -p conefield-benches --bin reach
bin=${CARGO_TARGET_DIR:-target}/release
mkdir -p "$out"
: >"$out/scene.md"
for volume in $volumes; do
    scan=$out/$volume
    [[ -d $scan ]] || "$bin/conefield" -q simulate "$data/volumes/$volume.nii.gz" -o "$scan" --protocol r2 --views 50 --noise tigre:1e4,10
    runs=()
    run() {
        local name=$1 support=$2 levels=$3
        shift 3
        "$bin/conefield" -q reconstruct "$scan" --spec accurate -o "$out/$volume-$name" --force --reference truth \
            --set solver.seconds="$seconds" --set solver.steps=1000000 --set scene.support="$support" \
            --set scene.levels="$levels" "$@" >/dev/null
        runs+=("$name=$out/$volume-$name")
    }
    # As published: as many samples on every ray.
    count=(--set projector.samples=320 --set solver.rays=1024)
    run none box all "${count[@]}"
    run support carve all "${count[@]}"
    run levels box needed "${count[@]}"
    run samples box all
    run occupancy carve all --set 'scene.occupancy={ refined = {} }'
    run all carve needed
    printf '\n`%s`\n\n' "$volume" >>"$out/scene.md"
    "$bin/reach" "${runs[@]}" | tee -a "$out/scene.md"
done
