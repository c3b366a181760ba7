#!/usr/bin/env bash
# PSNR at equal step counts beside the published training's curve, over 3 seeds:
#   bash benches/fidelity.sh DATA_FOLDER OUT_FOLDER [PYTHON]
# DATA_FOLDER holds volumes/engine_256.nii.gz and reference_curve.csv (columns step and psnr_sub). With a PYTHON that has torch
# and safetensors also from the published code's initial weights (benches/peers/initial.py); seeds then choose views and rays alone.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
python=${3:-}
published_scan "$data" engine_256 "$out/scan"
run() {
    local name=$1
    shift
    "$bin" -q reconstruct "$out/scan" --spec ni-naf-published -o "$out/$name" --force --reference truth "$@" >/dev/null
}
names=()
seeds() {
    local from=$1
    shift
    for seed in 0 1 2; do
        run "$from-$seed" --steps 480 --seed "$seed" "$@"
        names+=("$from-$seed")
    done
}
seeds own
if [[ -n $python ]]; then
    initial=$(realpath "$out")/initial.safetensors
    run one-step --steps 1
    "$python" benches/peers/initial.py "$out/one-step/weights.safetensors" "$initial"
    seeds same --set "initializer={ type = \"checkpoint\", weights = \"$initial\" }"
fi
python3 - "$data/reference_curve.csv" "$out" "${names[@]}" <<'PY'
import csv, json, sys
file, out, *names = sys.argv[1:]
curve = [(int(r["step"]), float(r["psnr_sub"])) for r in csv.DictReader(open(file))]
def published(step):
    for (a, p), (b, q) in zip(curve, curve[1:]):
        if a <= step <= b:
            return p + (q - p) * (step - a) / (b - a)
runs = [{r["step"]: r["psnr"] for r in map(json.loads, open(f"{out}/{name}/metrics.jsonl"))} for name in names]
print("dB, and difference to published\nstep  published" + "".join(f"  {name:>14}" for name in names))
for step in [140, 160] + list(range(200, 481, 40)):
    p = published(step)
    print(f"{step:4}  {p:9.2f}" + "".join(f"  {r[step]:6.2f} ({r[step] - p:+.2f})" for r in runs))
PY
