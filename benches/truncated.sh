#!/usr/bin/env bash
# A body that is wider than the detector, with and without a look beyond the volume:
#   bash benches/truncated.sh DATA_FOLDER OUT_FOLDER [SECONDS [SPECS]]
# DATA_FOLDER holds volumes/abdomen_128.nii.gz. The detector is half as wide as the published one, the volume to reconstruct the
# 64 x 64 x 128 voxels that all views see. Fields train for SECONDS (60); methods on voxels end by themselves. A row each: PSNR and
# ssim_2d over that volume and the seconds of the command: without and with scene.surround, with all 128 x 128 x 128 voxels (whole), and
# with both.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
seconds=${3:-60}
specs=${4:-fdk os-sart fista-tv balanced}
cat >"$out/protocol.toml" <<'T'
unit = { name = "cube half side", mm = 64.0 }
dso = 5.0
dsd = 7.0
detector = [512, 256]
extent = { side = [4.0, 2.0] }
angles = { even = { views = 50 } }
noise = "tigre:1e4,10"
T
whole=$out/whole
middle=$out/middle
if [[ ! -f $middle/scan.toml ]]; then
    "$bin" -q simulate "$data/volumes/abdomen_128.nii.gz" -o "$whole" --protocol "$out/protocol.toml"
    mkdir -p "$middle"
    cp "$whole/projections.npy" "$middle/"
    sed -e 's/^shape = .*/shape = [64, 64, 128]/' -e '/^truth = /d' "$whole/scan.toml" >"$middle/scan.toml"
fi
cut() { # the middle 64 x 64 columns of a volume
    python3 - "$1" "$2" <<'PY'
import gzip, struct, sys
raw = gzip.open(sys.argv[1]).read()
at = int(struct.unpack_from("<f", raw, 108)[0])
nx, ny, nz = struct.unpack_from("<3h", raw, 42)
head = bytearray(raw[:at])
struct.pack_into("<3h", head, 42, 64, 64, nz)
size = struct.unpack_from("<h", raw, 72)[0] // 8
x0, y0 = (nx - 64) // 2, (ny - 64) // 2
rows = [raw[at + ((z * ny + y) * nx + x0) * size:][:64 * size] for z in range(nz) for y in range(y0, y0 + 64)]
open(sys.argv[2], "wb").write(bytes(head) + b"".join(rows))
PY
}
cut "$whole/truth.nii.gz" "$out/truth.nii"
for spec in $specs; do
    case $spec in naf | ni-naf* | nerf | dense | accurate | balanced | fast) ends=(--seconds "${seconds}s") ;; *) ends=() ;; esac
    for way in without with whole both; do
        scan=$middle
        sets=()
        case $way in with | both) sets=(--set 'scene.surround={ coarse = {} }') ;; esac
        case $way in whole | both) scan=$whole ;; esac
        run=$out/$spec-$way
        "$bin" -q reconstruct "$scan" --spec "$spec" -o "$run" --force "${ends[@]}" "${sets[@]}" >/dev/null
        volume=$run/volume.nii.gz
        [[ $scan != "$whole" ]] || { cut "$volume" "$run/middle.nii" && volume=$run/middle.nii; }
        "$bin" evaluate "$volume" "$out/truth.nii" --json >"$run/scores.json"
        python3 - "$run" <<'PY'
import json, sys
run, = sys.argv[1:]
scores, record = json.load(open(f"{run}/scores.json")), json.load(open(f"{run}/record.json"))
json.dump({"scores": scores, "total_s": record["total_s"]}, open(f"{run}/scored.json", "w"))
PY
    done
done
python3 benches/spread.py "$out/{row}-{column}/scored.json" "$specs" "without with whole both" 0 | tee "$out/truncated.md"
