#!/usr/bin/env bash
# Methods on the arcs of 30 to 90 degrees of a real detector, against masks from the full scans:
#   bash benches/limited-angle.sh DATA_FOLDER OUT_FOLDER [SPECS]
# DATA_FOLDER holds measured/htc2022_*. Needs numpy and pillow. Prints a table: the Matthews correlation of the volume, divided at Otsu's
# threshold, with the mask, and the seconds of the whole command.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
specs=${3:-fdk os-sart fista-tv smooth-tv limited-angle}
python=${PYTHON:-python3}
scans="ta_30 td_30 tb_60 tb_90"
"$python" benches/limited-angle.py "$data" "$out"
for scan in $scans; do
    [[ -d $out/$scan ]] || "$bin" -q import "$out/$scan.toml" -o "$out/$scan" >/dev/null 2>&1
done

echo "| spec | ta 30° | td 30° | tb 60° | tb 90° |"
echo "| --- | --- | --- | --- | --- |"
for spec in $specs; do
    row="| $spec |"
    for scan in $scans; do
        run=$out/$scan-$spec
        from=$(date +%s.%N)
        "$bin" -q reconstruct "$out/$scan" --spec "$spec" -o "$run" --force >/dev/null 2>&1
        seconds=$(awk "BEGIN { print $(date +%s.%N) - $from }")
        mcc=$("$bin" -q evaluate "$run/volume.nii.gz" "$out/$scan-mask.npy" --threshold otsu | awk '/^mcc/ { print $2 }')
        row+=$(printf ' %.3f, %.1f s |' "$mcc" "$seconds")
    done
    echo "$row"
done
