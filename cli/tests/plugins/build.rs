//! Builds plugins.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, OnceLock};

/// conefield's sources.
pub fn sources() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the package stands in the workspace")
}

/// The build folder of plugins; shared dependencies are compiled once.
pub fn target() -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("plugins")
}

/// One cargo process at a time, so that each reuses what the other has compiled.
static CARGO: Mutex<()> = Mutex::new(());

/// Runs cargo in `folder`; it must succeed.
pub fn cargo(folder: &Path, args: &[&str]) {
    let _one = CARGO.lock().unwrap_or_else(|e| e.into_inner());
    let mut command = Command::new(env!("CARGO"));
    command.current_dir(folder).args(args).env("CARGO_TARGET_DIR", target());
    let output = command.output().expect("cargo starts");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "cargo {args:?} in {}: {said}", folder.display());
}

/// The library built from the package `name`.
pub fn library(name: &str) -> PathBuf {
    let name = name.replace('-', "_");
    target().join("release").join(format!("{}{name}{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX))
}

/// A plugin of the workspace of examples, all of which are built once.
pub fn example(name: &str) -> PathBuf {
    static BUILT: OnceLock<()> = OnceLock::new();
    BUILT
        .get_or_init(|| cargo(&sources().join("plugins/examples"), &["build", "--release", "--locked", "--workspace"]));
    library(name)
}

/// Compiles `source` to the library `out`, as a C author would.
pub fn cc(source: &Path, out: &Path) {
    let mut command = Command::new("cc");
    command.args(["-std=c11", "-O2", "-shared", "-fPIC", "-o"]).arg(out).arg(source);
    command.arg("-I").arg(sources().join("plugins/abi/include"));
    let output = command.arg("-lm").output().expect("cc starts");
    assert!(output.status.success(), "cc {}: {}", source.display(), String::from_utf8_lossy(&output.stderr));
}
