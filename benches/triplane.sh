#!/usr/bin/env bash
# An encoder from a plugin beside the built-in one in neural specs, at equal time:
#   bash benches/triplane.sh DATA_FOLDER OUT_FOLDER [BUDGET [SEEDS [VOLUME]]]
# Each of SEEDS ("0 1 2") is another noise of 50 views of VOLUME (abdomen_128) and another start; each run has BUDGET (30s) for the whole
# command. Prints mean and half the range of PSNR. Nothing else may run on the machine.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
budget=${3:-30s}
seeds=${4:-0 1 2}
volume=${5:-abdomen_128}
specs="balanced accurate fast field-tv"
(cd plugins/examples && cargo build --release --quiet --locked -p triplane)
plugin=${CARGO_TARGET_DIR:-plugins/examples/target}/release/libtriplane.so
for seed in $seeds; do
    scan=$out/$volume-$seed
    published_scan "$data" "$volume" "$scan" 50 "$seed"
    for spec in $specs; do
        key=encoder.type
        [[ $spec == *-tv ]] && key=methods.0.encoder.type
        for encoder in hash-grid triplane; do
            record=$out/$spec-$encoder-$seed.json
            [[ -f $record ]] && continue
            set=()
            [[ $encoder == hash-grid ]] || set=(--set "$key=$encoder")
            "$bin" -q --plugin "$plugin" reconstruct "$scan" -o "$out/run" --force --reference truth --spec "$spec" "${set[@]}" \
                --budget "$budget" --seed "$seed" >/dev/null
            cp "$out/run/record.json" "$record"
        done
    done
done
python3 benches/spread.py "$out/{row}-{column}-{seed}.json" "$specs" "hash-grid triplane" "$seeds"
