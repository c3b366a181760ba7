#!/usr/bin/env bash
# PSNR at equal step counts beside the published training's curve, over 3 seeds:
#   bash benches/fidelity.sh DATA_FOLDER OUT_FOLDER
# DATA_FOLDER holds volumes/engine_256.nii.gz and reference_curve.csv (columns step and psnr_sub).
set -euo pipefail
cd "$(dirname "$0")/.."
data=$1
out=$2
cargo build --release --quiet -p conefield
bin=${CARGO_TARGET_DIR:-target}/release/conefield
mkdir -p "$out"
[[ -d $out/scan ]] || "$bin" -q simulate "$data/volumes/engine_256.nii.gz" -o "$out/scan" --protocol r2 --views 50 --noise tigre:1e4,10
for seed in 0 1 2; do
    "$bin" -q reconstruct "$out/scan" --spec ni-naf-published -o "$out/seed$seed" --force --steps 480 --seed "$seed" --reference truth
done
python3 - "$data/reference_curve.csv" "$out" <<'PY'
import csv, json, sys
curve = [(int(r["step"]), float(r["psnr_sub"])) for r in csv.DictReader(open(sys.argv[1]))]
def published(step):
    for (a, p), (b, q) in zip(curve, curve[1:]):
        if a <= step <= b:
            return p + (q - p) * (step - a) / (b - a)
runs = [{r["step"]: r["psnr"] for r in map(json.loads, open(f"{sys.argv[2]}/seed{s}/metrics.jsonl"))} for s in range(3)]
print("step  published   seed 0   seed 1   seed 2   (dB, difference to published)")
for step in range(200, 481, 40):
    print(f"{step:4}  {published(step):9.2f}" + "".join(f"  {r[step] - published(step):+7.2f}" for r in runs))
PY
