#!/usr/bin/env bash
# Dice of the labels of a real CT, of the methods of table1.sh:
#   bash benches/dice.sh DATA_FOLDER OUT_FOLDER [SEEDS]
# DATA_FOLDER holds clinical/abdomen_ct_hu.nii.gz (122x101x112 voxels of 3 mm), of whose last 30 planes expert labels are known, and
# volumes/chest_128.nii.gz for MCI's weights. The CT becomes [0, 1] and is scanned and reconstructed as table1.sh does it. dice.py
# then segments the 30 planes of each result, and says how. It needs Python with numpy and scipy.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$(realpath "$1")
mkdir -p "$2/data/volumes"
out=$(realpath "$2")
ct=$out/data/volumes/abdomen_ct.nii.gz
[[ -f $ct ]] || "$bin" -q convert "$data/clinical/abdomen_ct_hu.nii.gz" "$ct" --values clip:-1000,2000
ln -sf "$data/volumes/chest_128.nii.gz" "$out/data/volumes/"
bash benches/table1.sh "$out/data" "$out" "${3:-0 1 2}" abdomen_ct
"${PYTHON:-python3}" benches/dice.py "$bin" "$data"/clinical/abdomen_crop_{ct_hu,seg}.nii.gz 82 "$out/abdomen" | tee "$out/dice.md"
