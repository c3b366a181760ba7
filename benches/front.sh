#!/usr/bin/env bash
# Measures the front that `reconstruct --budget` chooses from, and writes it:
#   bash benches/front.sh DATA_FOLDER OUT_FOLDER [FRONT]
# DATA_FOLDER holds volumes/*.nii.gz. Every candidate below reconstructs each of five scans (50 noisy views) to its own end, as
# a whole command. FRONT (specs/tradeoff/front.toml) gets those that no other one beats in seconds and in PSNR on all scans.
# What is in OUT_FOLDER is not run again. Nothing else may run on the machine.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$1
out=$2
front=${3:-specs/tradeoff/front.toml}
cargo build --release --quiet -p conefield
bin=${CARGO_TARGET_DIR:-target}/release/conefield
mkdir -p "$out"
volumes="engine_256 head_256 teapot_256 chest_128 abdomen_128"
prior='prior="directional-total-variation"'
cubic() { echo "basis={ type = \"cubic\", spacing = 1, samples = $1 }"; }
names=()
run() {
    local name=$1 spec=$2 sets=() value
    shift 2
    for value in "$@"; do sets+=(--set "$value"); done
    names+=("$name")
    printf '%s\n' "$spec" "$@" >"$out/$name.candidate"
    for volume in $volumes; do
        [[ -f $out/$name-$volume.json ]] && continue
        published_scan "$data" "$volume" "$out/$volume"
        "$bin" backends --json >"$out/$name-$volume.speed"
        "$bin" -q reconstruct "$out/$volume" -o "$out/run" --force --reference truth --spec "$spec" "${sets[@]}" >/dev/null
        cp "$out/run/record.json" "$out/$name-$volume.json"
    done
}
run fdk fdk
run coarse-64 fista-tv "$(cubic 64)" "$prior" bin=4 stop.passes=8
run coarse-96 fista-tv "$(cubic 96)" "$prior" bin=4 stop.passes=8
run coarse-112 fista-tv "$(cubic 112)" "$prior" bin=2 stop.passes=8
run cubic-128 fista-tv "$(cubic 128)" "$prior" stop.passes=8
run smooth-200 smooth-tv methods.1.stop.passes=5 methods.2.stop.passes=3
run smooth-tv smooth-tv
run smooth-long smooth-tv methods.2.stop.passes=30
run cubic-200-long fista-tv "$(cubic 200)" "$prior" 'stop={ passes = 40, change = 2e-4 }'
python3 - "$out" "$front" "$volumes" "${names[@]}" <<'PY'
import json, math, statistics, sys
out, front, volumes, *names = sys.argv[1:]
volumes = volumes.split()
records = {name: [json.load(open(f"{out}/{name}-{volume}.json")) for volume in volumes] for name in names}
# Beaten is what another candidate does no slower and no worse on every scan.
def beats(a, b):
    pairs = list(zip(records[a], records[b]))
    faster = all(x["total_s"] <= y["total_s"] for x, y in pairs)
    better = all(x["scores"]["psnr"] >= y["scores"]["psnr"] for x, y in pairs)
    return faster and better
kept = [b for b in names if not any(beats(a, b) for a in names if a != b)]
first = records[names[0]]
# The machine's speed, again before each run.
speeds = [json.load(open(f"{out}/{name}-{volume}.speed"))["backends"][0]["pass_s"] for name in names for volume in volumes]
lines = ['# Picked from by "conefield reconstruct --budget": the best of what fits, on those of these scans whose volumes are nearest in size.',
         '# bash benches/front.sh makes it (docs/records/methods.md).',
         f'made = "conefield {first[0]["version"]}, {first[0]["threads"]} threads, {first[0]["simd"]}"',
         f"pass_s = {statistics.median(speeds):.4f}"]
for volume, record in zip(volumes, first):
    scan = record["scan"]
    lines += ["", "[[scans]]", f'name = "{volume}"', f'views = {scan["views"]}', f'detector = {scan["detector"]}', f'volume = {scan["volume"]}']
for name in sorted(kept, key=lambda name: sum(r["total_s"] for r in records[name])):
    spec, *sets = open(f"{out}/{name}.candidate").read().splitlines()
    budget = math.ceil(max(r["total_s"] for r in records[name]))
    lines += ["", "[[points]]", f'name = "{name}"', 'kind = "voxels"', f'spec = "{spec}"']
    lines += [f"sets = {json.dumps(sets)}"] if sets else []
    lines += [f"budget_s = {budget}.0"]
    for r in records[name]:
        lines += ["", "[[points.runs]]", f'steps = {r["steps"]}', f'train_s = {r["train_s"]:.2f}', f'total_s = {r["total_s"]:.2f}', f'beside_s = {r["prepare_s"] + r["export_s"]:.2f}',
                  f'peak_bytes = {r["peak_bytes"]}', f'psnr = {r["scores"]["psnr"]:.2f}', f'ssim_2d = {r["scores"]["ssim_2d"]:.4f}']
open(front, "w").write("\n".join(lines) + "\n")
print("| | " + " | ".join(volumes) + " |\n|---" + "|---" * len(volumes) + "|")
for name in names:
    cells = [f'{r["scores"]["psnr"]:.2f} dB, {r["scores"]["ssim_2d"]:.3f}, {r["total_s"]:.1f} s' for r in records[name]]
    print(f"| {name}{'' if name in kept else ' (beaten)'} | " + " | ".join(cells) + " |")
PY
