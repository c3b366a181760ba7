#!/usr/bin/env bash
# Quality against the number of views, classical and neural methods under one protocol:
#   bash benches/views.sh DATA_FOLDER OUT_FOLDER [SECONDS [VIEWS [VOLUME [DOWNSAMPLE [DETECTOR]]]]]
# DATA_FOLDER holds volumes/*.nii.gz. Every neural method trains for SECONDS (300), its learning rate aiming at that end;
# classical ones end by themselves. VIEWS ("10 25 50 75 100") are spread over the full circle, with the published noise.
# DOWNSAMPLE (1) and DETECTOR (512x512) make it small. Leaves OUT_FOLDER/psnr.png, ssim.png (ssim_2d) and views.md;
# an interrupted run goes on where it was.
set -euo pipefail
cd "$(dirname "$0")/.."
data=$1
out=$2
seconds=${3:-300}
views=${4:-10 25 50 75 100}
volume=${5:-abdomen_128}
downsample=${6:-1}
detector=${7:-512x512}
cargo build --release --quiet --bin conefield
cargo build --release --quiet -p conefield-benches --bin views
bin=${CARGO_TARGET_DIR:-target}/release
mkdir -p "$out"
comparisons=()
for n in $views; do
    scan=$out/scan-$n
    [[ -d $scan ]] || "$bin/conefield" -q simulate "$data/volumes/$volume.nii.gz" -o "$scan" --protocol r2 --views "$n" \
        --noise tigre:1e4,10 --downsample "$downsample" --detector "$detector"
    compare() {
        local folder=$out/$n-$1 specs=$2
        shift 2
        local again=()
        [[ ! -d $folder ]] || again=(--resume)
        "$bin/conefield" -q compare "$scan" --specs "$specs" --reference truth -o "$folder" "${again[@]}" "$@"
        comparisons+=("$n=$folder")
    }
    compare classical fdk,sart,fista-tv
    compare neural naf,ni-naf,balanced --seconds "${seconds}s"
done
"$bin/views" "$out" "$volume, noisy views, ${seconds} s a neural method" "${comparisons[@]}"
cat "$out/views.md"
