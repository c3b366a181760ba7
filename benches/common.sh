# What the scripts beside it share; they source it from the repository's root, after building conefield.

# The scan that published figures are of, 50 noisy views of a volume of DATA_FOLDER, unless it is there already:
#   published_scan DATA_FOLDER VOLUME SCAN [VIEWS [SEED [NOISE]]]
published_scan() {
    [[ -d $3 ]] || "${CARGO_TARGET_DIR:-target}/release/conefield" -q simulate "$1/volumes/$2.nii.gz" -o "$3" \
        --protocol r2 --views "${4:-50}" --seed "${5:-0}" --noise "${6:-tigre:1e4,10}" >/dev/null
}
