# What the scripts beside it share; they source it from the repository's root, after building conefield.

# The scan that published figures are of, 50 noisy views of a volume of DATA_FOLDER, unless it is there already:
#   published_scan DATA_FOLDER VOLUME SCAN
published_scan() {
    [[ -d $3 ]] || "${CARGO_TARGET_DIR:-target}/release/conefield" -q simulate "$1/volumes/$2.nii.gz" -o "$3" \
        --protocol r2 --views 50 --noise tigre:1e4,10
}
