//! Helpers shared by the whole-program tests.

use assert_cmd::Command;
use serde_json::Value;
use std::path::Path;

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
