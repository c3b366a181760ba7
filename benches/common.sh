# What the scripts beside it share; they source it from the repository's root: their arguments DATA_FOLDER and OUT_FOLDER, and the
# program, built.
data=$1
out=$2
mkdir -p "$out"
# Where there is no cargo, the program is there.
if command -v cargo >/dev/null; then cargo build --release --quiet --bin conefield; fi
bin=${CARGO_TARGET_DIR:-target}/release/conefield

# The scan that published figures are of, 50 noisy views of a volume of DATA_FOLDER, unless it is there already:
#   published_scan DATA_FOLDER VOLUME SCAN [VIEWS [SEED [NOISE]]]
published_scan() {
    [[ -d $3 ]] || "$bin" -q simulate "$1/volumes/$2.nii.gz" -o "$3" \
        --protocol r2 --views "${4:-50}" --seed "${5:-0}" --noise "${6:-tigre:1e4,10}" >/dev/null
}
