#!/usr/bin/env bash
# What a time buys: fronts of engine_256 and head_256, then presets from abdomen_128 and engine_256 together, of fields alone:
#   bash benches/tradeoff.sh DATA_FOLDER OUT_FOLDER [BUDGETS [CANDIDATES [PRESET_BUDGETS [SEARCHES]]]]
# SEARCHES ("engine_256 head_256 tuning") may name fewer. BUDGETS are those of the two fronts; the presets are each the best under one
# of PRESET_BUDGETS, in seconds. HOLD_OUT=every:10 before the command keeps views of the head aside, to see how well they rank.
# DATA_FOLDER holds volumes/*.nii.gz. Each search takes at most the sum of its budgets, every one times the candidates that are
# left (half go on), a scan; it says so and goes on where it was interrupted. Nothing else should run on the machine.
# Leaves OUT_FOLDER/{engine_256,head_256,tuning} and OUT_FOLDER/presets.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$1
out=$2
budgets=${3:-10s,30s,60s,180s,1200s}
candidates=${4:-9}
presets=${5:-30 60 1200}
searches=${6:-engine_256 head_256 tuning}
cargo build --release --quiet --bin conefield
bin=${CARGO_TARGET_DIR:-target}/release/conefield
mkdir -p "$out"
for volume in abdomen_128 engine_256 head_256; do
    scan=$out/scans/$volume
    mkdir -p "$out/scans"
    published_scan "$data" "$volume" "$scan"
done
search() {
    local name=$1 budgets=$2
    shift 2
    [[ " $searches " == *" $name "* ]] || return 0
    local again=()
    [[ ! -d $out/$name ]] || again=(--resume)
    "$bin" tradeoff "$@" --reference truth --budgets "$budgets" --candidates "$candidates" -o "$out/$name" "${again[@]}"
}
search engine_256 "$budgets" "$out/scans/engine_256" --hold-out none
search head_256 "$budgets" "$out/scans/head_256" --hold-out "${HOLD_OUT:-none}"
search tuning "${presets// /s,}s" "$out/scans/abdomen_128" "$out/scans/engine_256" --hold-out none \
    --bases fast,balanced,accurate
[[ " $searches " == *" tuning "* ]] || exit 0
mkdir -p "$out/presets"
names=(fast balanced accurate)
i=0
for seconds in $presets; do
    point=$(python3 - "$out/tuning/tradeoff.json" "$seconds" <<'PY'
import json, sys
best = json.load(open(sys.argv[1]))["best"]
print(next((b["point"] for b in best if b["kind"] == "field" and b["budget_s"] == float(sys.argv[2])), ""))
PY
    )
    if [[ -n $point ]]; then
        sed "s/^name = .*/name = \"${names[$i]}\"/" "$out/tuning/front/$point.toml" >"$out/presets/${names[$i]}.toml"
        echo "${names[$i]}: $point"
    fi
    i=$((i + 1))
done
