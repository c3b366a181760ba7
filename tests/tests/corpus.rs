//! What fuzzing starts from. See `docs/reference/bad-inputs.md`.

use conefield_tests::hostile::{PARSERS, seeds};
use std::path::{Path, PathBuf};

/// The folder that fuzzing starts from: `CONEFIELD_CORPUS=DIR cargo test --release -p conefield-tests --test corpus`
/// writes it.
#[test]
fn the_corpus_for_fuzzing_is_small() {
    let kept = std::env::var_os("CONEFIELD_CORPUS").map(PathBuf::from);
    let dir = tempfile::tempdir().unwrap();
    let mut size = 0;
    for parser in PARSERS {
        let (bytes, _) = parser.prepare(tempfile::tempdir().unwrap().path());
        size += bytes.len();
        let to = kept.as_deref().unwrap_or(dir.path()).join(parser.name);
        std::fs::create_dir_all(&to).unwrap();
        std::fs::write(to.join("seed"), bytes).unwrap();
    }
    assert!(size < 200_000, "{size} bytes");
    assert_eq!(seeds::gunzip(seeds::gzip(vec![7; 9])), [7; 9]);
}

/// The fuzz targets are those of the list.
#[test]
fn every_reader_has_its_fuzz_target() {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz");
    let manifest: toml::Table = toml::from_str(&std::fs::read_to_string(fuzz.join("Cargo.toml")).unwrap()).unwrap();
    let bins = manifest["bin"].as_array().unwrap();
    let names: Vec<&str> = bins.iter().map(|b| b["name"].as_str().unwrap()).collect();
    assert_eq!(names, PARSERS.iter().map(|p| p.name).collect::<Vec<_>>());
    for bin in bins {
        assert!(fuzz.join(bin["path"].as_str().unwrap()).is_file(), "{bin}");
    }
}
