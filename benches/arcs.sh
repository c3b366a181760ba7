#!/usr/bin/env bash
# Methods on simulated arcs of 60 to 180 degrees:
#   bash benches/arcs.sh DATA_FOLDER OUT_FOLDER [SPECS] [SEEDS]
# DATA_FOLDER holds the five volumes, of 128 or 256 voxels a side; they are reconstructed on 128. 40 views of 256x256 pixels with the published noise; each seed has another noise and another
# start of the arc (0, 60 and 90 degrees), because edges across the middle of an arc are the ones that it does not show. Prints PSNR in
# dB: the mean over the seeds and their standard deviation.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
specs=${3:-os-sart fista-tv smooth-tv limited-angle}
seeds=${4:-0 1 2}
starts=(0 60 90)
arcs="60 90 120 180"
echo "| volume | spec |$(printf ' %s° |' $arcs)"
echo "| --- | --- |$(printf ' --- |%.0s' $arcs)"
for volume in abdomen chest engine head teapot; do
    for spec in $specs; do
        row="| $volume | \`$spec\` |"
        for arc in $arcs; do
            found=()
            for seed in $seeds; do
                scan=$out/$volume-$arc-$seed
                if [[ ! -d $scan ]]; then
                    start=${starts[seed % 3]}
                    if [[ -f $data/volumes/${volume}_128.nii.gz ]]; then from=(128); else from=(256 --downsample 2); fi
                    "$bin" -q simulate "$data/volumes/${volume}_${from[0]}.nii.gz" "${from[@]:1}" -o "$scan" --views 40 \
                        --angles "$start:$arc" --detector 256x256 --noise tigre:1e4,10 --seed "$seed" >/dev/null
                fi
                run=$out/$spec-$volume-$arc-$seed
                [[ -f $run/record.json ]] || "$bin" -q reconstruct "$scan" --spec "$spec" -o "$run" --force >/dev/null
                found+=("$("$bin" -q evaluate "$run/volume.nii.gz" "$scan/truth.nii.gz" | awk '/^psnr/ { print $2 }')")
            done
            row+=$(printf '%s\n' "${found[@]}" | awk '{ n++; s += $1; q += $1 * $1 }
                END { m = s / n; printf " %.2f ± %.2f |", m, sqrt((q / n - m * m > 0 ? q / n - m * m : 0) * n / (n > 1 ? n - 1 : 1)) }')
        done
        echo "$row"
    done
done
