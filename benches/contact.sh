#!/usr/bin/env bash
# One folder that says in ten minutes what a GPU does with conefield:
#   bash benches/contact.sh FOLDER [DATA_FOLDER]
#   FOLDER/contact [--adapter N] [--software] [--out FILE] [STAGE...]
# The second command needs a driver and nothing else: no cargo, no registry, no Python. It prints one JSON line a finding, writes the
# same to FILE (findings.jsonl) at once, and gives each stage a time limit of its own. FOLDER holds the command, parity tests and a
# scan: engine_256 of DATA_FOLDER (volumes/*.nii.gz) at half its resolution, or a phantom without it. Both are 50 noisy views.
# FOLDER.tar.xz is the folder in one file.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=${1%/}
data=${2:-}
mkdir -p "$folder"
target=${CARGO_TARGET_DIR:-target}/release
cargo build --release --quiet --bin conefield
cargo build --release --quiet -p conefield-benches --bin contact
# Cargo says where it puts the test programs.
cargo test --release --no-run -p conefield-tests --test stages --test library --message-format=json |
    sed -n 's/.*"name":"\(stages\|library\)".*"executable":"\([^"]*\)".*/\1 \2/p' >"$folder/tests.txt"
while read -r name path; do
    cp "$path" "$folder/parity-$name"
done <"$folder/tests.txt"
rm "$folder/tests.txt"
cp "$target/conefield" "$target/contact" "$folder"
strip "$folder"/{conefield,contact,parity-stages,parity-library}
volume=phantom:head:128
size=()
if [[ -n $data ]]; then
    volume=$data/volumes/engine_256.nii.gz
    size=(--downsample 2)
fi
[[ -d $folder/scan ]] || "$target/conefield" -q simulate "$volume" -o "$folder/scan" --protocol r2 --views 50 --seed 0 \
    --noise tigre:1e4,10 --detector 256x256 "${size[@]}"
XZ_OPT=-T0 tar -C "$folder/.." -cJf "$folder.tar.xz" "$(basename "$folder")"
du -sh "$folder" "$folder.tar.xz"
