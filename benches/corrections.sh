#!/usr/bin/env bash
# What each correction mends, and what it costs where there is nothing to mend:
#   bash benches/corrections.sh DATA_FOLDER OUT_FOLDER [VOLUMES [SEEDS [PASSES]]]
# DATA_FOLDER holds volumes/*_256.nii.gz. Volumes of 128^3 whose line integrals reach about 2 (head) and 4 (engine), 50 views of
# 128 x 128 pixels, 3e4 photons (100 for low-counts), PASSES (10) of fista-tv. Needs numpy. A row each: PSNR with the fault, with
# the fault mended, without fault, and the same with the correction asked for all the same; means over the seeds, then the
# smallest gain and the largest loss of any.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
volumes=${3:-head engine}
seeds=${4:-0 1 2}
passes=${5:-10}
python=${PYTHON:-python3}

# The options of each correction for scans with its fault and, after a bar, without it (if an option is the size of the fault).
rows=(
    "rings:rings"
    "rings:rings.method=sorting"
    "pixels:pixels"
    "flux:flux"
    "low-counts:low-counts.photons=100|low-counts.photons=3e4"
    "scatter:scatter={ share = 0.1, width = 0.2 }"
    "hardening:hardening.water={ kvp = 110, aluminium = 3.0 }"
    "hardening:hardening.water={ kvp = 100, aluminium = 2.0 }"
)

psnr() { # of the scan $1, which is reconstructed into $2
    [[ -f $2/record.json ]] || "$bin" -q reconstruct "$1" --spec fista-tv --set stop.passes="$passes" \
        --reference "$exact/truth.nii.gz" -o "$2" --force >/dev/null
    "$python" -c 'import json, sys; print(json.load(open(sys.argv[1]))["scores"]["psnr"])' "$2/record.json"
}

for volume in $volumes; do
    exact=$out/$volume-exact
    if [[ ! -d $exact ]]; then
        "$bin" -q convert "$data/volumes/${volume}_256.nii.gz" "$out/$volume.npy" --force >/dev/null
        "$python" benches/faults.py 3 "$out/$volume.npy" "$out/$volume-3.npy"
        "$bin" -q simulate "$out/$volume-3.npy" -o "$exact" --protocol r2 --downsample 2 --detector 128x128 --views 50 >/dev/null
    fi
    for seed in $seeds; do
        at=$out/$volume-$seed
        for row in "${rows[@]}" "none:"; do
            fault=${row%%:*}
            [[ -d $at-$fault ]] || "$python" benches/faults.py "$fault" "$seed" "$exact" "$at-$fault"
        done
        for i in "${!rows[@]}"; do
            fault=${rows[$i]%%:*}
            asked=${rows[$i]#*:}
            there=${asked%%|*}
            absent=${asked##*|}
            # A test with a bar of its own: the names of folders are numbers.
            [[ -d $at-with-$i ]] || "$bin" -q convert "$at-$fault" "$at-with-$i" --correct "$there" >/dev/null
            [[ -d $at-absent-$i ]] || "$bin" -q convert "$at-none" "$at-absent-$i" --correct "$absent" >/dev/null
            echo "$volume|$there|$(psnr "$at-$fault" "$at-$fault-run")|$(psnr "$at-with-$i" "$at-with-$i-run")|$(psnr "$at-none" \
                "$at-none-run")|$(psnr "$at-absent-$i" "$at-absent-$i-run")"
        done
    done
done >"$out/corrections.txt"

"$python" - "$out/corrections.txt" <<'PY' | tee "$out/corrections.md"
import collections, statistics, sys
cells = collections.OrderedDict()
for line in open(sys.argv[1]):
    volume, asked, *numbers = line.strip().split("|")
    cells.setdefault((volume, asked), []).append([float(x) for x in numbers])
print("| volume | `--correct` | fault | fault, corrected | no fault | no fault, corrected | least gain | most loss |")
print("|---|---|---|---|---|---|---|---|")
for (volume, asked), runs in cells.items():
    means = " | ".join(f"{statistics.mean(column):.2f} dB" for column in zip(*runs))
    gain, loss = min(r[1] - r[0] for r in runs), max(r[2] - r[3] for r in runs)
    print(f"| {volume} | `{asked}` | {means} | {gain:+.2f} | {loss:.2f} |")
PY
