#!/usr/bin/env bash
# What each part of smooth-tv is worth, and what similar patches and Gaussians add to it:
#   bash benches/smooth-tv.sh DATA_FOLDER OUT_FOLDER [VARIANTS [SEEDS [VOLUMES [VIEWS [BACKEND]]]]]
# VARIANTS: total-variation along-edges merged shipped three-from-144 three-from-128 (the default: all of these), smooth-patches,
# gaussians, smooth-gaussians. Each runs on VIEWS (50) noisy views of each of VOLUMES; each of SEEDS ("0") is another noise. Prints mean and
# half the range of PSNR, the mean of ssim_2d and the longest time. Passes and steps are counted, not timed: other work on the
# machine changes nothing but the seconds. BACKEND "wgpu" runs on a GPU. An interrupted run continues.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
variants=${3:-total-variation along-edges merged shipped three-from-144 three-from-128}
seeds=${4:-0}
volumes=${5:-engine_256 head_256 teapot_256 chest_128 abdomen_128}
views=${6:-50}
backend=${7:-auto}

level() { # a method of the chain: SAMPLES PASSES
    echo "{ extends = \"fista-tv\", basis = { type = \"cubic\", spacing = 1, samples = $1 }, \
prior = { type = \"directional-total-variation\", edge = 0.7 }, stop = { passes = $2, change = 1e-3 } }"
}
three() { # a spec with the mean of three methods: SAMPLES PASSES of each
    spec=$out/three.toml
    cat >"$spec" <<T
type = "chain"
name = "three"
mean = 3
merge = true
methods = [
    { extends = "fista-tv", basis = { type = "cubic", spacing = 1, samples = 64 }, \
prior = { type = "total-variation", weight = { noise = 0.7 } }, bin = 4, stop = { passes = 10, change = 1e-3 } },
    $(level "$1" "$2"), $(level "$3" "$4"), $(level "$5" "$6"),
]
T
}

for volume in $volumes; do
    for seed in $seeds; do
        scan=$out/$volume-$views-$seed
        published_scan "$data" "$volume" "$scan" "$views" "$seed"
        for variant in $variants; do
            record=$out/$volume-$views-$seed-$variant.json
            [[ -f $record ]] && continue
            spec=smooth-tv
            case $variant in
                total-variation) sets=(merge=false 'methods.1.prior={ type = "total-variation", weight = { noise = 0.7 } }'
                    'methods.2.prior={ type = "total-variation", weight = { noise = 0.7 } }') ;;
                along-edges) sets=(merge=false methods.1.prior.edge=1 methods.2.prior.edge=1) ;;
                merged) sets=(methods.1.prior.edge=1 methods.2.prior.edge=1) ;;
                shipped) sets=() ;;
                three-from-144) sets=() && three 144 7 176 8 208 10 ;;
                three-from-128) sets=() && three 128 8 168 8 208 12 ;;
                smooth-patches | gaussians | smooth-gaussians) sets=() && spec=$variant ;;
                *) echo "$variant: no such variant" >&2 && exit 2 ;;
            esac
            "$bin" -q reconstruct "$scan" -o "$out/run" --force --reference truth --backend "$backend" --spec "$spec" "${sets[@]/#/--set=}" >/dev/null
            cp "$out/run/record.json" "$record"
        done
    done
done
python3 benches/spread.py "$out/{column}-$views-{seed}-{row}.json" "$variants" "$volumes" "$seeds"
