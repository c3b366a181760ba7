#!/usr/bin/env bash
# The methods of NI-NeRF's first table on real volumes, with total variation beside them, as one study:
#   bash benches/table1.sh DATA_FOLDER OUT_FOLDER [SEEDS [VOLUMES]]
# DATA_FOLDER holds volumes/*.nii.gz. 50 noisy views of 512² pixels, the published protocol. Neural methods have the published
# sizes and rate (1e-3) and 192 samples a ray inside the volume. They end after the numbers of steps below, in about half a minute each
# on two cores, not at convergence. MCI weights are those of abdomen_128, and of chest_128 where an abdomen is the scan.
# Steps are counted, not timed: other work on the machine changes the seconds only. OUT_FOLDER/ct/table.md and
# OUT_FOLDER/abdomen/table.md have PSNR and ssim_2d, mean ± standard deviation over SEEDS ("0 1 2"). What is there is not run again.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$(realpath "$1")
mkdir -p "$2"
out=$(realpath "$2")
seeds=${3:-0 1 2}
volumes=${4:-chest_128 head_256 engine_256 abdomen_128}
published='"optimizer.lr=1e-3", "projector.samples=192"'
steps=600 lines=150 gaussians=600

# study NAME WEIGHTS_VOLUME VOLUME…
study() {
    local name=$1 weights=$out/mci-$2.safetensors
    [[ -f $weights ]] || "$bin" -q pretrain "$data/volumes/$2.nii.gz" --spec ni-naf --set 'callbacks=["rollback"]' \
        --set optimizer.lr=1e-3 --set projector.samples=192 --steps 600 -o "$weights"
    shift 2
    {
        echo "name = \"ni-nerf-table1-$name\""
        echo "volumes = [$(printf "\"$data/volumes/%s.nii.gz\", " "$@")]"
        echo "seeds = [${seeds// /, }]"
        echo 'views = [50]'
        echo 'baseline = "NAF"'
        echo 'simulate = { noise = "tigre:1e4,10" }'
        method FDK fdk
        method SART os-sart
        method R2-Gaussian gaussians "\"training.steps=$gaussians\""
        method SAX-NeRF sax-nerf "$published, \"training.steps=$lines\", \"training.rays=512\", \"training.windows.count=4\""
        method NAF naf "$published, \"training.steps=$steps\""
        method NAF+LN ni-naf "$published, \"training.steps=$steps\", 'callbacks=[\"rollback\"]'"
        method NAF+LN+MCI ni-naf "$published, \"training.steps=$steps\", 'callbacks=[\"rollback\"]'"
        echo "init = \"$weights\""
        method NI-NeRF ni-naf "$published, \"training.steps=$steps\""
        echo "init = \"$weights\""
        method TV smooth-tv
    } >"$out/$name.toml"
    "$bin" study "$out/$name.toml" -o "$out/$name" --resume
}

# method NAME SPEC [SETTINGS]
method() {
    printf '\n[[specs]]\nname = "%s"\nspec = "%s"\nset = [%s]\n' "$1" "$2" "${3:-}"
}

abdomens=() others=()
for volume in $volumes; do
    case $volume in abdomen*) abdomens+=("$volume") ;; *) others+=("$volume") ;; esac
done
[[ -z ${others[*]:-} ]] || study ct abdomen_128 "${others[@]}"
[[ -z ${abdomens[*]:-} ]] || study abdomen chest_128 "${abdomens[@]}"
