#!/usr/bin/env bash
# Priors of smooth-tv, with all else the same:
#   bash benches/priors.sh DATA_FOLDER OUT_FOLDER [PRIORS [SEEDS [VOLUMES [VIEWS]]]]
# The two last methods of the chain get each of PRIORS ("total-variation directional-total-variation") at 0.7 times the noise, on VIEWS (50)
# noisy views of each of VOLUMES. Each of SEEDS ("0 1 2") is another noise. Prints mean and half the range of PSNR, and the mean of ssim_2d.
# Passes are counted, not timed: other work on the machine changes nothing but the seconds.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$1
out=$2
priors=${3:-total-variation directional-total-variation}
seeds=${4:-0 1 2}
volumes=${5:-engine_256 head_256 teapot_256 chest_128 abdomen_128}
views=${6:-50}
cargo build --release --quiet -p conefield
bin=${CARGO_TARGET_DIR:-target}/release/conefield
mkdir -p "$out"
for volume in $volumes; do
    for seed in $seeds; do
        scan=$out/$volume-$views-$seed
        published_scan "$data" "$volume" "$scan" "$views" "$seed"
        for prior in $priors; do
            record=$out/$volume-$views-$seed-$prior.json
            [[ -f $record ]] && continue
            edge=
            [[ $prior == directional-* ]] && edge=", edge = 0.7"
            value="{ type = \"$prior\", weight = { noise = 0.7 }$edge }"
            "$bin" -q reconstruct "$scan" -o "$out/run" --force --reference truth --spec smooth-tv \
                --set "methods.1.prior=$value" --set "methods.2.prior=$value" >/dev/null
            cp "$out/run/record.json" "$record"
        done
    done
done
python3 benches/spread.py "$out/{row}-$views-{seed}-{column}.json" "$volumes" "$priors" "$seeds"
