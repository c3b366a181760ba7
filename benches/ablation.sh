#!/usr/bin/env bash
# The parts of the method one after the other on real volumes, at the published rate (1e-3), with the same steps and rays:
#   bash benches/ablation.sh DATA_FOLDER OUT_FOLDER [STEPS [SEEDS [VOLUMES [BACKEND [VARIANTS]]]]]
# DATA_FOLDER holds volumes/*.nii.gz. Of VARIANTS, NAF is the spec naf: 16 levels, leaky ReLU, sigmoid. The others are ni-naf without
# and with LayerNorm (LN), MCI weights and the FFT mask. MCI weights come from 600 steps on abdomen_128, for the abdomen from chest_128;
# +LN+MCI@VOLUME,VOLUME:STEPS[:RATE] takes others. Each has STEPS (900) of 1024 rays with 192 samples inside the volume. Each of SEEDS
# ("0 1 2") is another noise and another start. OUT_FOLDER/ablation.md has PSNR by steps, mean and half the range over SEEDS; VOLUME.png
# has the curves; the variable PYTHON (python3) names a Python with matplotlib. Steps are counted, not timed: other work on the machine
# changes nothing. BACKEND "wgpu" trains on a GPU. What is there is not run again.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
"${PYTHON:-python3}" -c "import matplotlib" # Before hours of work.
steps=${3:-900}
seeds=${4:-0 1 2}
volumes=${5:-chest_128 head_256 engine_256}
backend=${6:-auto}
read -ra variants <<<"${7:-NAF field +LN +LN+MCI +LN+MCI+mask}"
whole='callbacks=["rollback"]'
published=(--set optimizer.lr=1e-3 --set projector.samples=192)
# MCI weights of volumes, named VOLUME,VOLUME:STEPS[:RATE].
weights() {
    local file=$out/$1.safetensors from steps rate
    IFS=: read -r from steps rate <<<"$1"
    IFS=, read -ra from <<<"$from"
    from=("${from[@]/#/$data/volumes/}")
    [[ -f $file ]] || "$bin" -q pretrain "${from[@]/%/.nii.gz}" --spec ni-naf --set "$whole" "${published[@]}" \
        --set "optimizer.lr=${rate:-1e-3}" --steps "$steps" -o "$file" >/dev/null
    echo "$file"
}
for volume in $volumes; do
    curves=()
    mci=abdomen_128:600
    [[ $volume == abdomen_128 ]] && mci=chest_128:600
    for seed in $seeds; do
        scan=$out/scan-$volume-$seed
        published_scan "$data" "$volume" "$scan" 50 "$seed"
        for variant in "${variants[@]}"; do
            case $variant in
            NAF) set=(--spec naf) ;;
            field) set=(--spec ni-naf --set 'normalizers=[]' --set "$whole") ;;
            +LN) set=(--spec ni-naf --set "$whole") ;;
            +LN+MCI) set=(--spec ni-naf --set "$whole" --init "$(weights "$mci")") ;;
            +LN+MCI@*) set=(--spec ni-naf --set "$whole" --init "$(weights "${variant#*@}")") ;;
            +LN+MCI+mask) set=(--spec ni-naf --init "$(weights "$mci")") ;;
            +LN+mask) set=(--spec ni-naf) ;;
            field+mask) set=(--spec ni-naf --set 'normalizers=[]') ;;
            *) echo "$0: no variant $variant" >&2 && exit 2 ;;
            esac
            run=$out/$volume-$seed-$variant
            curves+=("$variant=$run")
            [[ -f $run/record.json ]] && continue
            "$bin" -q reconstruct "$scan" "${set[@]}" "${published[@]}" -o "$run" --force --seed "$seed" --steps "$steps" \
                --backend "$backend" --reference truth --set training.report_every=50 >/dev/null
            rm -f "$run/volume.nii.gz"
        done
    done
    "${PYTHON:-python3}" benches/curves.py --steps "$out/$volume.png" "$volume, 50 noisy views, one line a seed" "${curves[@]}"
done
python3 - "$out" "$steps" "$seeds" "$volumes" "${variants[@]}" <<'PY' | tee "$out/ablation.md"
import json, statistics, sys
out, steps, seeds, volumes, *variants = sys.argv[1:]
steps, seeds = int(steps), seeds.split()
at = [max(50, steps * k // 30 // 50 * 50) for k in (1, 5, 10, 20, 30)]
print("| | " + " | ".join(map(str, at)) + " | whole volume | ssim_2d |\n|---" + "|---" * (len(at) + 2) + "|")
for volume in volumes.split():
    for variant in variants:
        curves, scores = [], []
        for seed in seeds:
            run = f"{out}/{volume}-{seed}-{variant}"
            curves.append({r["step"]: r["psnr"] for r in map(json.loads, open(f"{run}/metrics.jsonl")) if "psnr" in r})
            scores.append(json.load(open(f"{run}/record.json"))["scores"])
        of = lambda values: f"{statistics.mean(values):.2f} ± {(max(values) - min(values)) / 2:.2f}"
        cells = [of([curve[step] for curve in curves]) for step in at] + [of([s["psnr"] for s in scores])]
        cells.append(f"{statistics.mean(s['ssim_2d'] for s in scores):.3f}")
        print(f"| {volume}, {variant} | " + " | ".join(cells) + " |")
PY
