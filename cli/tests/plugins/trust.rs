//! Only libraries that the user names, or puts into a plugin folder, are loaded.

use crate::build::{cc, sources};
use crate::common::{conefield, text};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn dense(dir: &Path) -> PathBuf {
    let out = dir.join("dense.so");
    cc(&sources().join("plugins/examples/dense/dense.c"), &out);
    out
}

fn run(command: &mut assert_cmd::Command) -> (bool, String, String) {
    let output = command.output().unwrap();
    let [out, err] = [output.stdout, output.stderr].map(|b| String::from_utf8(b).unwrap());
    (output.status.success(), out, err)
}

fn list(command: &mut assert_cmd::Command) -> Value {
    let (fine, out, err) = run(command);
    assert!(fine, "{err}");
    serde_json::from_str(&out).unwrap()
}

/// A stranger's spec next to the library that it names.
fn spec(dir: &Path) -> PathBuf {
    let path = dir.join("spec.toml");
    let text = "extends = 'fast'\n[plugins]\npaths = ['dense.so']\n[encoder]\ntype = 'one-grid'\n";
    std::fs::write(&path, text).unwrap();
    path
}

#[test]
fn a_spec_loads_nothing_without_leave() {
    let dir = tempfile::tempdir().unwrap();
    let library = text(&dense(dir.path()));
    let spec = text(&spec(dir.path()));
    let (fine, _, err) = run(&mut conefield(&["explain", &spec]));
    assert!(
        !fine && err.contains("spec.toml:3:10: plugins.paths") && err.contains("--allow-plugins-from-spec"),
        "{err}"
    );
    assert!(err.contains(&library), "{err}");
    let (fine, out, err) = run(&mut conefield(&["--allow-plugins-from-spec", "explain", &spec]));
    assert!(fine && out.contains("one grid of 32 nodes") && out.contains("plugin: dense 0.1.0"), "{out}{err}");
    let (fine, out, err) = run(&mut conefield(&["--plugin", &library, "explain", &spec]));
    assert!(fine && out.contains("one grid of 32 nodes"), "{out}{err}");
    // The permission applies to valid plugins only.
    std::fs::write(dir.path().join("dense.so"), "not a library").unwrap();
    let (fine, _, err) = run(&mut conefield(&["--allow-plugins-from-spec", "explain", &spec]));
    assert!(!fine && err.contains("a shared library for this system"), "{err}");
}

#[test]
fn the_resolved_spec_names_the_library_wherever_it_is_read() {
    let dir = tempfile::tempdir().unwrap();
    dense(dir.path());
    let (spec, scan, out) = (text(&spec(dir.path())), text(&dir.path().join("scan")), text(&dir.path().join("run")));
    let simulate = ["simulate", "phantom:head:16", "-o", &scan, "--views", "6", "--detector", "16x16"];
    assert!(run(&mut conefield(&simulate)).0);
    let steps = ["--steps", "3", "--set", "training.rays=16"];
    let reconstruct = ["--allow-plugins-from-spec", "reconstruct", &scan, "--spec", &spec, "-o", &out];
    let (fine, _, err) = run(&mut conefield(&[&reconstruct[..], &steps].concat()));
    assert!(fine, "{err}");
    let resolved = text(&dir.path().join("run/spec.toml"));
    let (fine, said, err) = run(&mut conefield(&["--allow-plugins-from-spec", "explain", &resolved]));
    assert!(fine && said.contains("one grid of 32 nodes"), "{err}");
    let again = text(&dir.path().join("finer.nii.gz"));
    let (fine, _, err) = run(&mut conefield(&["export", &out, "--voxels", "20", "-o", &again]));
    assert!(!fine && err.contains("--allow-plugins-from-spec"), "{err}");
    let (fine, _, err) =
        run(&mut conefield(&["--allow-plugins-from-spec", "export", &out, "--voxels", "20", "-o", &again]));
    assert!(fine, "{err}");
}

#[test]
fn plugins_are_found_where_they_are_looked_for() {
    let dir = tempfile::tempdir().unwrap();
    let home = dir.path().join("home");
    let folder = home.join("conefield/plugins");
    std::fs::create_dir_all(&folder).unwrap();
    let library = dense(&folder);
    // The user's folder, the environment and the command line in turn, each with its origin.
    let found = list(conefield(&["plugins", "list", "--json"]).env("XDG_DATA_HOME", &home));
    assert_eq!(found["plugins"][0]["place"], "user-folder");
    assert_eq!(found["plugins"][0]["plugin"]["stages"][0]["type"], "one-grid");
    let found = list(conefield(&["plugins", "list", "--json"]).env("CONEFIELD_PLUGIN_PATH", &folder));
    assert_eq!(found["plugins"][0]["place"], "environment");
    let found = list(conefield(&["plugins", "list", "--json", "--plugin"]).arg(&library));
    assert_eq!(found["plugins"][0]["place"], "named");
    assert_eq!(found["plugins"][0]["plugin"]["abi"], "4.0");
    // The same file twice counts as one plugin.
    let found =
        list(conefield(&["plugins", "list", "--json"]).env("XDG_DATA_HOME", &home).arg("--plugin").arg(&library));
    assert_eq!(found["plugins"].as_array().unwrap().len(), 1);
    // A copy brings types whose names are taken: the error names both owners.
    std::fs::copy(&library, folder.join("other.so")).unwrap();
    let found = list(conefield(&["plugins", "list", "--json"]).env("XDG_DATA_HOME", &home));
    let why = found["plugins"][1]["refused"].as_str().unwrap();
    assert!(why.contains("dense.so") && why.contains("other.so") && why.contains("one-grid"), "{why}");
    // A broken file in a folder causes a warning; a broken file that is named causes an error.
    let (fine, _, _) = run(conefield(&["explain", "fast"]).env("XDG_DATA_HOME", &home));
    assert!(fine);
    let output = assert_cmd::Command::cargo_bin("conefield")
        .unwrap()
        .args(["explain", "fast"])
        .env("XDG_DATA_HOME", &home)
        .output()
        .unwrap();
    assert!(output.status.success() && String::from_utf8_lossy(&output.stderr).contains("plugin refused"));
    let (fine, _, err) = run(&mut conefield(&["--plugin", "nowhere.so", "explain", "fast"]));
    assert!(!fine && err.contains("nowhere.so"), "{err}");
}

#[test]
fn a_copy_that_broke_off_is_refused_and_ends_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let home = dir.path().join("home");
    let folder = home.join("conefield/plugins");
    std::fs::create_dir_all(&folder).unwrap();
    let whole = std::fs::read(dense(dir.path())).unwrap();
    for share in 1..16 {
        std::fs::write(folder.join("dense.so"), &whole[..whole.len() * share / 16]).unwrap();
        let found = list(conefield(&["plugins", "list", "--json"]).env("XDG_DATA_HOME", &home));
        let why = found["plugins"][0]["refused"].as_str().unwrap_or_else(|| panic!("{share}: {found}"));
        assert!(why.contains("dense.so") && why.contains("whole"), "{why}");
        let (fine, _, err) = run(conefield(&["explain", "fast"]).env("XDG_DATA_HOME", &home));
        assert!(fine, "{share}: {err}");
    }
}

#[test]
fn a_plugin_that_never_comes_back_does_not_hang_its_check() {
    let dir = tempfile::tempdir().unwrap();
    let (source, library) = (dir.path().join("hangs.c"), dir.path().join("hangs.so"));
    std::fs::write(&source, "#include <unistd.h>\nconst void *conefield_plugin(void) { for (;;) sleep(1); }\n")
        .unwrap();
    cc(&source, &library);
    let begin = std::time::Instant::now();
    let (fine, _, err) = run(&mut conefield(&["plugins", "check", &text(&library)]));
    assert!(!fine && err.contains("its entry function did not return within 10"), "{err}");
    assert!(begin.elapsed().as_secs() < 60, "{:?}", begin.elapsed());
}

#[test]
fn a_home_that_is_relative_brings_no_code() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join(".local/share/conefield/plugins");
    std::fs::create_dir_all(&folder).unwrap();
    dense(&folder);
    let mut command = conefield(&["plugins", "list", "--json"]);
    command.env_remove("XDG_DATA_HOME").env("HOME", ".").current_dir(dir.path());
    assert_eq!(list(&mut command)["plugins"].as_array().unwrap().len(), 0);
    let found = list(command.env("HOME", dir.path()));
    assert_eq!(found["plugins"].as_array().unwrap().len(), 1, "{found}");
}
