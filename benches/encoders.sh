#!/usr/bin/env bash
# The encoders of conefield/specs/studies/encoders.toml on real volumes, as one study:
#   bash benches/encoders.sh DATA_FOLDER OUT_FOLDER [SECONDS [SEEDS]]
# DATA_FOLDER holds volumes/*.nii.gz. engine_256 and chest_128 are averaged to 64³ voxels, the size that the encoders of the study
# are for, and seen in 50 noisy views of 128² pixels. Every encoder trains for SECONDS (20), so nothing else may run. Each of SEEDS
# ("0, 1, 2") is another noise and another start. OUT_FOLDER/encoders/table.md has PSNR and ssim_2d, mean ± standard deviation, and
# the steps that each made. What is there is not run again.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$(realpath "$1")
mkdir -p "$2"
out=$(realpath "$2")
seconds=${3:-20}
seeds=${4:-0, 1, 2}
volume() { # NAME FACTOR
    echo "{ volume = \"$data/volumes/$1.nii.gz\", name = \"$1\", downsample = $2 }"
}
sed -e "s|^volumes = .*|volumes = [$(volume engine_256 4), $(volume chest_128 2)]|" -e "s|^seeds = .*|seeds = [$seeds]|" \
    -e "s|^seconds = .*|seconds = \"${seconds}s\"|" conefield/specs/studies/encoders.toml >"$out/encoders.toml"
"$bin" study "$out/encoders.toml" -o "$out/encoders" --resume
