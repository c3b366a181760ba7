//! The one fuzz target: it feeds libFuzzer's bytes to the reader of [`conefield_tests::hostile::PARSERS`] that the
//! program is called after, in place of one file of a valid input.
//!
//! ```sh
//! CONEFIELD_CORPUS=$PWD/fuzz/corpus cargo test --release -p conefield-tests --test corpus   # the seeds
//! cargo +nightly fuzz run nifti
//! ```

#![no_main]

use conefield_tests::hostile::{Parser, find};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// The reader with the folder that its input lies in.
struct Target {
    parser: &'static Parser,
    dir: tempfile::TempDir,
    file: PathBuf,
}

/// The reader, its other files written.
static TARGET: LazyLock<Target> = LazyLock::new(|| {
    let parser = find(env!("CARGO_BIN_NAME")).expect("a reader of that name");
    let memory = Path::new("/dev/shm");
    let parent = if memory.is_dir() { memory.to_path_buf() } else { std::env::temp_dir() };
    let dir = tempfile::tempdir_in(parent).expect("a folder for the input");
    let (_, file) = parser.prepare(dir.path());
    Target { parser, dir, file }
});

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    std::fs::write(&TARGET.file, (TARGET.parser.pack)(bytes.to_vec())).expect("the input's own file");
    let _ = (TARGET.parser.read)(TARGET.dir.path());
});
