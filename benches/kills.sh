#!/usr/bin/env bash
# Kills commands at random moments while they write, 200 times in all, and checks the files: the earlier or the new file is complete
# under its name, a resumed run ends as if it had not been interrupted, and the next command leaves no stray file.
#
#   benches/kills.sh [BINARY] [KILLS] [SEED]
set -euo pipefail
bin=$(realpath "${1:-target/release/conefield}")
kills=${2:-200}
RANDOM=${3:-1}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
cf() { "$bin" --quiet --threads 2 "$@" > out.txt 2> err.txt || { echo "failed: $*"; cat err.txt; return 1; }; }
fail() { echo "LOST: $*"; ls -laR .; exit 1; }

cf simulate phantom:head:24 -o scan --views 8 --detector 24x24
cf simulate phantom:head:96 -o big --views 40 --detector 96x96
small=(--spec fast --set training.rays=64 --steps 400 --checkpoint-every 0.05s)
cf reconstruct scan "${small[@]}" -o whole
cf reconstruct scan "${small[@]}" -o run
cf compare scan --specs fdk,cgls -o all
cf convert big/truth.nii.gz v.npy
cf convert v.npy o.nii.gz
cf simulate phantom:head:64 -o sim --views 30 --detector 64x64
cf pretrain phantom:head:16 --spec fast --steps 20 -o w.safetensors
digest() { find "$1" -type f -not -name 'metrics.jsonl' -not -name 'record.json' -not -name 'table.*' -print0 | sort -z | xargs -0 sha256sum; }
# Names that are there when nothing is left behind.
names() { find . -mindepth 1 \( -name '.*' \) ; }

declare -A took
length() { local t0=$EPOCHREALTIME; "$@"; took[$kind]=$(bc <<< "$EPOCHREALTIME - $t0"); }
# Runs a command and kills it at a random moment of its length.
strike() {
    "$bin" --quiet --threads 2 "$@" > out.txt 2> err.txt &
    local child=$!
    sleep "$(bc <<< "scale=4; ${took[$kind]} * $((RANDOM % 1000)) / 1000")"
    kill -KILL $child 2> /dev/null || true
    wait $child 2> /dev/null || hit=$((hit + 1))
}

each=$((kills / 5))
for kind in reconstruct compare simulate convert pretrain; do
    hit=0; resumed=0
    case $kind in
        reconstruct) args=(reconstruct scan "${small[@]}" -o run) ;;
        compare) args=(compare scan --specs fdk,cgls -o all) ;;
        simulate) args=(simulate phantom:head:64 -o sim --views 30 --detector 64x64) ;;
        convert) args=(convert v.npy o.nii.gz) ;;
        pretrain) args=(pretrain phantom:head:16 --spec fast --steps 20 -o w.safetensors) ;;
    esac
    length cf "${args[@]}" --force
    for ((i = 0; i < each; i++)); do
        case $kind in
            reconstruct)
                strike "${args[@]}" --force
                # The next command: refused where something stands there, and it brings back what has no successor.
                if [[ -e run/checkpoint.safetensors && ! -e run/record.json ]]; then
                    cf "${args[@]}" --resume || cf "${args[@]}" --force; resumed=$((resumed + 1))
                else
                    "$bin" --quiet "${args[@]}" > out.txt 2> err.txt && fail "an earlier run is gone: nothing refused" || true
                    grep -q 'an earlier run' err.txt || { cat err.txt; fail "not refused for the earlier run"; }
                fi
                for f in volume.nii.gz weights.safetensors; do cmp -s run/$f whole/$f || fail "run/$f"; done
                [[ -e run/record.json ]] || fail run/record.json ;;
            compare)
                strike "${args[@]}" --force
                if [[ ! -e all/table.json ]] && compgen -G 'all/*/volume.nii.gz' > /dev/null; then
                    cf "${args[@]}" --resume; resumed=$((resumed + 1))
                else
                    "$bin" --quiet "${args[@]}" > out.txt 2> err.txt && fail "an earlier comparison is gone" || true
                    grep -q 'an earlier comparison' err.txt || { cat err.txt; fail "not refused for the comparison"; }
                fi
                for f in all/table.json all/fdk/record.json all/cgls/volume.nii.gz; do [[ -e $f ]] || fail $f; done ;;
            simulate)
                before=$(digest sim)
                strike "${args[@]}" --force
                [[ $(digest sim) == "$before" ]] || fail sim
                cf info sim
                cf simulate phantom:head:16 -o next --views 2 --detector 8x8 --force ;;
            convert)
                before=$(sha256sum o.nii.gz)
                strike "${args[@]}" --force
                [[ $(sha256sum o.nii.gz) == "$before" ]] || fail o.nii.gz
                cf convert v.npy next.npy --force ;;
            pretrain)
                before=$(sha256sum w.safetensors)
                strike "${args[@]}" --force
                [[ $(sha256sum w.safetensors) == "$before" ]] || fail w.safetensors
                cf convert v.npy next.npy --force ;;
        esac
        left=$(names)
        [[ -z $left ]] || fail "stray after $kind: $left"
    done
    echo "$kind: $each strikes, $hit before the end (of ${took[$kind]} s), $resumed resumed, nothing lost, nothing left"
done
