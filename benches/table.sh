#!/usr/bin/env bash
# Classical and neural methods under one protocol on real volumes (50 views, the published noise), one table a volume:
#   bash benches/table.sh DATA_FOLDER OUT_FOLDER [SECONDS [SPECS [VOLUMES]]]
# DATA_FOLDER holds volumes/*.nii.gz. No method takes more than SECONDS (600) to solve. A table that was interrupted goes
# on where it was. Settings are those of the shipped specs, chosen on abdomen_128. OUT_FOLDER/tables.md has all tables, and
# each volume's folder its picture and runs.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
seconds=${3:-600}
specs=${4:-fdk,sart,os-sart,cgls,asd-pocs,fista-tv,naf,ni-naf}
volumes=${5:-engine_256 teapot_256 head_256 chest_128 abdomen_128}
: >"$out/tables.md"
for volume in $volumes; do
    scan=$out/scan-$volume
    table=$out/$volume
    published_scan "$data" "$volume" "$scan"
    again=()
    [[ ! -d $table ]] || again=(--resume)
    "$bin" -q compare "$scan" --specs "$specs" --reference truth \
        --at-most "${seconds}s" -o "$table" "${again[@]}"
    printf '\n### %s\n\n' "$volume" >>"$out/tables.md"
    cat "$table/table.md" >>"$out/tables.md"
done
