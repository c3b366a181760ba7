//! Helpers shared by the whole-program tests.

use assert_cmd::Command;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::{Duration, Instant, SystemTime};
use tempfile::TempDir;

/// The command with `args`, quiet, without the plugins of the user who runs the tests.
pub fn conefield(args: &[&str]) -> Command {
    let mut c = Command::cargo_bin("conefield").expect("the command is built with its tests");
    c.env_remove("CONEFIELD_PLUGIN_PATH").env("XDG_DATA_HOME", env!("CARGO_TARGET_TMPDIR"));
    c.arg("--quiet").args(args);
    c
}

/// Runs to success; returns the output.
#[allow(dead_code)]
pub fn done(args: &[&str]) -> String {
    let out = conefield(args).assert().success().get_output().stdout.clone();
    String::from_utf8(out).expect("UTF-8")
}

/// Runs to success; returns the printed JSON object.
#[allow(dead_code)]
pub fn json(args: &[&str]) -> Value {
    serde_json::from_str(&done(args)).expect("one JSON object on standard output")
}

/// Runs to the exit status `code`; returns standard error. Standard output must be empty.
#[allow(dead_code)]
pub fn refused(code: i32, args: &[&str]) -> String {
    let output = conefield(args).assert().code(code).get_output().clone();
    assert!(output.stdout.is_empty(), "{args:?}");
    let text = String::from_utf8(output.stderr).expect("UTF-8");
    assert!(text.starts_with("error: "), "{args:?}: {text}");
    text
}

/// The path as text.
#[allow(dead_code)]
pub fn text(path: &Path) -> String {
    path.display().to_string()
}

/// A new folder, and in it a scan of `views` views of `size`² pixels of a head of `size`³ voxels.
#[allow(dead_code)]
pub fn simulated(size: usize, views: usize) -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scan");
    let (phantom, views, detector) = (format!("phantom:head:{size}"), views.to_string(), format!("{size}x{size}"));
    done(&["simulate", &phantom, "-o", &text(&path), "--views", &views, "--detector", &detector]);
    (dir, path)
}

/// A file of JSON.
#[allow(dead_code)]
pub fn read(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

/// The words of a command line.
#[allow(dead_code)]
pub fn words(line: &[String]) -> Vec<&str> {
    line.iter().map(String::as_str).collect()
}

/// Modification time of every file below `folder`.
#[allow(dead_code)]
pub fn times(folder: &Path) -> Vec<(PathBuf, SystemTime)> {
    let mut all = vec![];
    for entry in std::fs::read_dir(folder).unwrap().map(|e| e.unwrap()) {
        match entry.path().is_dir() {
            true => all.extend(times(&entry.path())),
            false => all.push((entry.path(), entry.metadata().unwrap().modified().unwrap())),
        }
    }
    all.sort();
    all
}

/// The command with `args`, running; its output can be read at its end.
#[allow(dead_code)]
pub fn started<A: AsRef<std::ffi::OsStr>>(args: &[A]) -> Child {
    let mut command = std::process::Command::new(assert_cmd::cargo::cargo_bin("conefield"));
    command.env_remove("CONEFIELD_PLUGIN_PATH").env("XDG_DATA_HOME", env!("CARGO_TARGET_TMPDIR"));
    command.arg("--quiet").args(args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Waits until the file has content.
#[allow(dead_code)]
pub fn wait_for(file: &Path) {
    let until = Instant::now() + Duration::from_secs(60);
    while std::fs::metadata(file).map_or(0, |m| m.len()) == 0 {
        assert!(Instant::now() < until, "{} never came", file.display());
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Sends a signal, such as INT, to a process that is still running.
#[allow(dead_code)]
pub fn signal(child: &Child, name: &str) {
    let (name, id) = (format!("-{name}"), child.id().to_string());
    assert!(std::process::Command::new("kill").args([name, id]).status().unwrap().success());
}
