#!/usr/bin/env bash
# The accuracy of `conefield calibrate` on scans with a wrong geometry, and its effect on a reconstruction:
#   bash benches/calibration.sh DATA_FOLDER OUT_FOLDER [SCANS [SEEDS [ERRORS]]]
# DATA_FOLDER holds volumes/*_256.nii.gz and, for the scan `counts`, interop/ellipsoids_*. head and engine: volumes of 128^3, 50 views
# of 128 x 128 pixels with the published noise. counts: 25 views of raw counts with flat and dark fields, 96 x 96 pixels. ERRORS are
# those of misplace.py. A row each: the result, then held-out error and PSNR of 30 passes of sirt, before and after correction.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
scans=${3:-head engine counts}
seeds=${4:-0}
errors=${5:-offset-u=0 offset-u=0.1 offset-u=0.5 offset-u=2 offset-u=20 rotation=1 tilt=1 tilt=2 slant=2 distance=2 distance=-2 step=0.1 step=-0.1 step=1 offset-v=2 jitter=0 jitter=0.5 jitter=2}
python=${PYTHON:-python3}

psnr() { # of the scan $1
    "$bin" -q reconstruct "$1" --spec sirt --set stop.passes=30 --reference "$truth" -o "$1-run" --force >/dev/null
    "$python" -c 'import json, sys; print(f"""{json.load(open(sys.argv[1]))["scores"]["psnr"]:.2f}""")' "$1-run/record.json"
}

for scan in $scans; do
    for seed in $seeds; do
        at=$out/$scan-$seed
        mkdir -p "$at"
        truth=$at/right/truth.nii.gz
        if [[ $scan == counts ]]; then
            # The counts exist for one seed only.
            [[ $seed == "${seeds%% *}" ]] || continue
            truth=$at/exact/truth.nii.gz
            if [[ ! -d $at/right ]]; then
                "$bin" -q convert "$data/interop/ellipsoids_50_r2" "$at/exact" >/dev/null
                cp "$data/interop/ellipsoids_counts.npz" "$at/counts.npz"
                cat >"$at/scanner.toml" <<'T'
format = "conefield-scanner"
version = 1
[files]
projections = "counts.npz:counts"
flat = "counts.npz:flat"
dark = "counts.npz:dark"
[circle]
dso = 500.0
dsd = 800.0
pixel = { u = 2.0, v = 2.0 }
step_deg = 14.4
direction = "counterclockwise"
[values]
flat_includes_dark = false
[volume]
shape = [64, 64, 64]
spacing = [1.5625, 1.5625, 1.5625]
T
                "$bin" -q import "$at/scanner.toml" -o "$at/right" >/dev/null
            fi
        elif [[ ! -d $at/right ]]; then
            "$bin" -q simulate "$data/volumes/${scan}_256.nii.gz" -o "$at/right" --protocol r2 --downsample 2 --detector 128x128 \
                --views 50 --noise tigre:1e4,10 --seed "$seed" >/dev/null
        fi
        for error in $errors; do
            wrong=$at/$error-wrong
            corrected=$at/$error-corrected
            "$python" benches/misplace.py "$at/right" "$wrong" "$error"
            # The parameters that the command estimates by default, and the wrong one.
            case $error in
            offset-u=* | rotation=*) parameters=(--parameters offset-u,rotation) ;;
            jitter=*) parameters=(--jitter) ;;
            *) parameters=(--parameters "offset-u,rotation,${error%%=*}") ;;
            esac
            "$bin" -q calibrate "$wrong" -o "$corrected" --force "${parameters[@]}" --json >"$at/$error.json"
            "$python" - "$scan" "$error" "$at/$error.json" "$(psnr "$wrong")" "$(psnr "$corrected")" <<'PY'
import json, sys
scan, error, file, before, after = sys.argv[1:]
found = json.load(open(file))
key = error.split("=")[0]
def text(p):
    if p["verdict"] == "not-determined":
        return f"{p['parameter']} not determined"
    end = {"corrected": "", "kept": " kept"}[p["verdict"]]
    return f"{p['parameter']} {p['change']:.3f} ± {p['uncertainty']:.3f} {p['unit']}, {p['pixels'][0]:.2f} ± {p['pixels'][1]:.2f} pixels{end}"
asked = [text(p) for p in found["parameters"] if p["parameter"] == key or p["verdict"] == "corrected"]
held = found["held_out"]
if j := found["jitter"]:
    rms = [f"{x:.2f} ± {d:.2f}" for x, d in zip(j["pixels"], j["uncertainty"])]
    asked.append(f"jitter {rms[1]} pixels along u, {rms[0]} along v, {j['verdict']}")
    held = {"before": held["before"], "after": j["held_out"][1 if j["verdict"] == "corrected" else 0]}
print(f"| {scan} | {error} | {'; '.join(asked)} | {held['before']:.4f}, {held['after']:.4f} | {before} dB | {after} dB |")
PY
        done
    done
done | tee "$out/calibration.txt"
