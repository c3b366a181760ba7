#!/usr/bin/env bash
# An encoder from a plugin beside the built-in one in every neural spec, at equal time:
#   bash benches/triplane.sh DATA_FOLDER OUT_FOLDER [BUDGET [SEEDS [VOLUME]]]
# Each of SEEDS ("0 1 2") is another noise of 50 views of VOLUME (abdomen_128) and another start; each run has BUDGET (30s) for the whole
# command. Prints mean and half the range of PSNR. Nothing else may run on the machine.
set -euo pipefail
cd "$(dirname "$0")/.."
data=$1
out=$2
budget=${3:-30s}
seeds=${4:-0 1 2}
volume=${5:-abdomen_128}
specs="balanced accurate ni-naf fast field-tv accurate-tv"
cargo build --release --quiet -p conefield
(cd plugins/examples && cargo build --release --quiet --locked -p triplane)
bin=${CARGO_TARGET_DIR:-target}/release/conefield
plugin=${CARGO_TARGET_DIR:-plugins/examples/target}/release/libtriplane.so
mkdir -p "$out"
for seed in $seeds; do
    scan=$out/$volume-$seed
    [[ -d $scan ]] || "$bin" -q simulate "$data/volumes/$volume.nii.gz" -o "$scan" --protocol r2 --views 50 \
        --noise tigre:1e4,10 --seed "$seed"
    for spec in $specs; do
        key=encoder.type
        [[ $spec == *-tv ]] && key=methods.0.encoder.type
        for encoder in hash-grid triplane; do
            told=$out/$spec-$encoder-$seed.json
            [[ -f $told ]] && continue
            set=()
            [[ $encoder == hash-grid ]] || set=(--set "$key=$encoder")
            "$bin" -q --plugin "$plugin" reconstruct "$scan" -o "$out/run" --force --reference truth --spec "$spec" "${set[@]}" \
                --budget "$budget" --seed "$seed" >/dev/null
            cp "$out/run/record.json" "$told"
        done
    done
done
python3 - "$out" "$seeds" $specs <<'PY'
import json, statistics, sys
out, seeds, *specs = sys.argv[1:]
print("| | hash grid | tri-plane |\n|---|---|---|")
for spec in specs:
    cells = []
    for encoder in ("hash-grid", "triplane"):
        runs = [json.load(open(f"{out}/{spec}-{encoder}-{seed}.json")) for seed in seeds.split()]
        psnr = [run["scores"]["psnr"] for run in runs]
        ssim = statistics.mean(run["scores"]["ssim_2d"] for run in runs)
        cells.append(f"{statistics.mean(psnr):.2f} dB ± {(max(psnr) - min(psnr)) / 2:.2f}, {ssim:.3f}, {max(run['total_s'] for run in runs):.0f} s")
    print(f"| {spec} | " + " | ".join(cells) + " |")
PY
