#!/usr/bin/env bash
# Quality against the number of views, classical and neural methods under one protocol:
#   bash benches/views.sh DATA_FOLDER OUT_FOLDER [SECONDS [VIEWS [VOLUME [DOWNSAMPLE [DETECTOR]]]]]
# DATA_FOLDER holds volumes/*.nii.gz. Every neural method trains for SECONDS (300), its learning rate aiming at that end;
# classical ones end by themselves. VIEWS ("10 25 50 75 100") are spread over the full circle, with the published noise.
# DOWNSAMPLE (1) and DETECTOR (512x512) make it small. The variable PYTHON (python3) names a Python with matplotlib. Leaves OUT_FOLDER/psnr.png, ssim.png (ssim_2d)
# and views.md; an interrupted run goes on where it was.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
"${PYTHON:-python3}" -c "import matplotlib" # Before hours of work.
seconds=${3:-300}
views=${4:-10 25 50 75 100}
volume=${5:-abdomen_128}
downsample=${6:-1}
detector=${7:-512x512}
comparisons=()
for n in $views; do
    scan=$out/scan-$n
    [[ -d $scan ]] || "$bin" -q simulate "$data/volumes/$volume.nii.gz" -o "$scan" --protocol r2 --views "$n" \
        --noise tigre:1e4,10 --downsample "$downsample" --detector "$detector"
    compare() {
        local folder=$out/$n-$1 specs=$2
        shift 2
        local again=()
        [[ ! -d $folder ]] || again=(--resume)
        "$bin" -q compare "$scan" --specs "$specs" --reference truth -o "$folder" "${again[@]}" "$@"
        comparisons+=("$n=$folder")
    }
    compare classical fdk,sart,fista-tv
    compare neural naf,ni-naf,balanced --seconds "${seconds}s"
done
"${PYTHON:-python3}" - "$out" "$volume, noisy views, ${seconds} s a neural method" "${comparisons[@]}" <<'PY' | tee "$out/views.md"
import json, sys
import matplotlib
matplotlib.use("Agg")
import matplotlib.pyplot as plt
out, title, *comparisons = sys.argv[1:]
found, views = {}, []
for comparison in comparisons:
    n, folder = comparison.split("=", 1)
    views += [] if int(n) in views else [int(n)]
    for method in json.load(open(f"{folder}/table.json"))["methods"]:
        found.setdefault(method["name"], {})[int(n)] = method.get("scores")
views.sort()
for key, picture, label in [("psnr", "psnr.png", "PSNR, dB"), ("ssim_2d", "ssim.png", "ssim_2d")]:
    figure, panel = plt.subplots(figsize=(12, 8))
    for name, by_views in found.items():
        at = [n for n in views if by_views.get(n)]
        panel.plot(at, [by_views[n][key] for n in at], label=name)
    panel.set(title=title, xlabel="views", ylabel=label)
    panel.legend()
    figure.savefig(f"{out}/{picture}")
print("PSNR in dB / ssim_2d\n\n| method | " + " | ".join(f"{n} views" for n in views) + " |\n| --- |" + " ---: |" * len(views))
for name, by_views in found.items():
    cells = (by_views.get(n) for n in views)
    print(f"| {name} | " + " | ".join(f"{s['psnr']:.2f} / {s['ssim_2d']:.4f}" if s else "-" for s in cells) + " |")
PY
