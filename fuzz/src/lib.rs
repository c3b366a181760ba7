//! What the fuzz targets share: each feeds libFuzzer's bytes to the reader of its name in
//! [`conefield_tests::hostile::PARSERS`], in place of one file of a valid input.
//!
//! ```sh
//! CONEFIELD_CORPUS=$PWD/fuzz/corpus cargo test --release -p conefield-tests --test corpus   # the seeds
//! cargo +nightly fuzz run nifti
//! ```

use conefield_tests::hostile::{Parser, find};
use std::path::{Path, PathBuf};

#[doc(hidden)]
pub use libfuzzer_sys;

/// A reader with the folder that its input lies in.
pub struct Target {
    parser: &'static Parser,
    dir: tempfile::TempDir,
    file: PathBuf,
}

impl Target {
    /// The reader called `name`, its other files written.
    pub fn new(name: &str) -> Self {
        let parser = find(name).expect("a reader of that name");
        let memory = Path::new("/dev/shm");
        let parent = if memory.is_dir() { memory.to_path_buf() } else { std::env::temp_dir() };
        let dir = tempfile::tempdir_in(parent).expect("a folder for the input");
        let (_, file) = parser.prepare(dir.path());
        Self { parser, dir, file }
    }

    /// Reads `bytes` in place of the file.
    pub fn run(&self, bytes: &[u8]) {
        std::fs::write(&self.file, (self.parser.pack)(bytes.to_vec())).expect("the input's own file");
        let _ = (self.parser.read)(self.dir.path());
    }
}

/// A fuzz target for the reader called `$name`.
#[macro_export]
macro_rules! target {
    ($name:literal) => {
        static TARGET: std::sync::LazyLock<$crate::Target> = std::sync::LazyLock::new(|| $crate::Target::new($name));

        $crate::libfuzzer_sys::fuzz_target!(|bytes: &[u8]| TARGET.run(bytes));
    };
}
