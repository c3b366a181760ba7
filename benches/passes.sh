#!/usr/bin/env bash
# Seconds of a pass of total variation (fista-tv) and of SIRT (Joseph and its adjoint) on 256³ voxels, of this build and another one in
# turn, on an upright and a tilted detector:
#   bash benches/passes.sh DATA_FOLDER OUT_FOLDER OTHER_CONEFIELD [RUNS]
# A pass is an eighth of what 12 passes take longer than 4. OUT_FOLDER/passes.md has medians and ranges over RUNS (5). Nothing else may
# run on the machine.
set -euo pipefail
cd "$(dirname "$0")/.."
source benches/common.sh
data=$1
out=$2
other=$3
runs=${4:-5}
cargo build --release --quiet --bin conefield
bin=${CARGO_TARGET_DIR:-target}/release/conefield
mkdir -p "$out"
published_scan "$data" engine_256 "$out/upright"
[[ -d $out/tilted ]] || python3 benches/misplace.py "$out/upright" "$out/tilted" tilt=2
: >"$out/seconds.txt"
for _ in $(seq "$runs"); do
    for scan in upright tilted; do
        for spec in fista-tv sirt; do
            for passes in 4 12; do
                for build in this other; do
                    program=$bin
                    [[ $build == this ]] || program=$other
                    begin=$EPOCHREALTIME
                    "$program" -q reconstruct "$out/$scan" --spec "$spec" --set "stop.passes=$passes" --set stop.change=1e-12 \
                        -o "$out/run" --force >/dev/null
                    echo "$scan $spec $passes $build $begin $EPOCHREALTIME" >>"$out/seconds.txt"
                done
            done
        done
    done
done
rm -rf "$out/run"
python3 - "$out" <<'PY' | tee "$out/passes.md"
import collections, statistics, sys
taken = collections.defaultdict(list)
for line in open(f"{sys.argv[1]}/seconds.txt"):
    scan, spec, passes, build, begin, end = line.split()
    taken[scan, spec, build, passes].append(float(end) - float(begin))
each = lambda *key: [(b - a) / 8 for a, b in zip(taken[*key, "4"], taken[*key, "12"])]
text = lambda x: f"{statistics.median(x):.2f} s ({min(x):.2f} to {max(x):.2f})"
print("| | this build | the other | factor |\n|---|---|---|---|")
for spec in ("fista-tv", "sirt"):
    for scan in ("upright", "tilted"):
        both = [each(scan, spec, build) for build in ("this", "other")]
        factor = statistics.median(both[1]) / statistics.median(both[0])
        print(f"| {spec}, {scan} | {text(both[0])} | {text(both[1])} | {factor:.2f} |")
PY
