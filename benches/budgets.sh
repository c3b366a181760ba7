#!/usr/bin/env bash
# What a time buys, whole commands, as a user gives them:
#   bash benches/budgets.sh DATA_FOLDER OUT_FOLDER [BUDGETS [METHODS [SEEDS [VOLUMES [VIEWS]]]]]
# DATA_FOLDER holds volumes/*.nii.gz. Each seed is another noise of VIEWS (50) views. Each of METHODS ("best fista-tv") has each of
# BUDGETS ("5s 10s 20s 60s 180s"): a spec, or "best" for the one that the program chooses for that time. OUT_FOLDER/budgets.md has
# mean and spread over SEEDS ("0 1 2") of PSNR and ssim_2d, and the longest that a command took. What is there is not run again.
# Nothing else may run on the machine.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
budgets=${3:-5s 10s 20s 60s 180s}
methods=${4:-best fista-tv}
seeds=${5:-0 1 2}
volumes=${6:-engine_256 head_256 teapot_256 chest_128 abdomen_128}
views=${7:-50}
for volume in $volumes; do
    for seed in $seeds; do
        scan=$out/$volume-$views-$seed
        published_scan "$data" "$volume" "$scan" "$views" "$seed"
        for method in $methods; do
            spec=()
            [[ $method == best ]] || spec=(--spec "$method")
            for budget in $budgets; do
                run=$scan.$method.$budget
                [[ -f $run.json ]] && continue
                begin=$EPOCHREALTIME
                # A budget that is too short for a method is refused; the table says so.
                "$bin" -q reconstruct "$scan" -o "$run" --force --budget "$budget" "${spec[@]}" >/dev/null 2>"$run.err" || true
                end=$EPOCHREALTIME
                # Scores are not part of the time.
                [[ ! -f $run/volume.nii.gz ]] ||
                    "$bin" -q evaluate "$run/volume.nii.gz" "$scan/truth.nii.gz" --json >"$run/scores.json"
                python3 - "$run" "$begin" "$end" <<'PY'
import json, pathlib, sys
run, begin, end = sys.argv[1:]
record = pathlib.Path(run) / "record.json"
result = {"seconds": float(end) - float(begin)}
if record.exists():
    record = json.loads(record.read_text())
    point = (record.get("plan") or {}).get("point") or record["spec"]
    scores = json.loads((pathlib.Path(run) / "scores.json").read_text())
    result |= {"point": point, **{key: scores[key] for key in ("psnr", "ssim_2d")}}
pathlib.Path(run + ".json").write_text(json.dumps(result))
PY
                rm -rf "$run"
            done
        done
    done
done
python3 - "$out" "$views" "$budgets" "$methods" "$seeds" "$volumes" <<'PY' | tee "$out/budgets.md"
import json, statistics, sys
out, views, *lists = sys.argv[1:]
budgets, methods, seeds, volumes = (x.split() for x in lists)
print("| | | " + " | ".join(budgets) + " |\n|---|---" + "|---" * len(budgets) + "|")
for volume in volumes:
    for method in methods:
        cells = []
        for budget in budgets:
            runs = []
            for seed in seeds:
                with open(f"{out}/{volume}-{views}-{seed}.{method}.{budget}.json") as file:
                    runs.append(json.load(file))
            if not all("psnr" in run for run in runs):
                cells.append("too short")
                continue
            of = lambda key: [run[key] for run in runs]
            spread = max(of("psnr")) - min(of("psnr"))
            names = sorted(set(of("point"))) if method == "best" else []
            cells.append(f"{statistics.mean(of('psnr')):.2f} dB ± {spread / 2:.2f}, {statistics.mean(of('ssim_2d')):.3f}, "
                         f"{max(of('seconds')):.0f} s" + "".join(f", {name}" for name in names))
        print(f"| {volume} | {method} | " + " | ".join(cells) + " |")
PY
