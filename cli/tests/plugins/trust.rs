//! Only libraries that the user names, or puts into a plugin folder, are loaded.

use crate::build::{cc, sources};
use crate::common::{Folder, text};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};

fn dense(folder: &Path) -> PathBuf {
    let out = folder.join("dense.so");
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

/// A folder with a stranger's spec next to the library that it names.
fn strange() -> Folder {
    let d = Folder::new();
    dense(&d.at(""));
    d.put("spec.toml", "extends = 'fast'\n[plugins]\npaths = ['dense.so']\n[encoder]\ntype = 'one-grid'\n");
    d
}

#[test]
fn a_spec_loads_nothing_without_leave() {
    let d = strange();
    let err = d.refused(1, "explain spec.toml");
    for words in ["spec.toml:3:10: plugins.paths", "--allow-plugins-from-spec", "dense.so"] {
        assert!(err.contains(words), "{err}");
    }
    let out = d.done("--allow-plugins-from-spec explain spec.toml");
    assert!(out.contains("one grid of 32 nodes") && out.contains("plugin: dense 0.1.0"), "{out}");
    assert!(d.done("--plugin dense.so explain spec.toml").contains("one grid of 32 nodes"));
    // The permission applies to valid plugins only.
    d.put("dense.so", "not a library");
    d.refused_with(1, "--allow-plugins-from-spec explain spec.toml", &["a shared library for this system"]);
}

#[test]
fn the_resolved_spec_names_the_library_wherever_it_is_read() {
    let d = strange();
    let leave = "--allow-plugins-from-spec";
    d.done("simulate phantom:head:16 -o scan --views 6 --detector 16x16");
    d.done(&format!("{leave} reconstruct scan --spec spec.toml -o run --steps 3 --set training.rays=16"));
    assert!(d.done(&format!("{leave} explain run/spec.toml")).contains("one grid of 32 nodes"));
    d.refused_with(1, "export run --voxels 20 -o finer.nii.gz", &[leave]);
    d.done(&format!("{leave} export run --voxels 20 -o finer.nii.gz"));
}

const LIST: &str = "plugins list --json";

/// The plugins that are listed where `home` is that of the user.
fn at_home(d: &Folder, line: &str) -> Value {
    list(d.command(line).env("XDG_DATA_HOME", d.at("home")))["plugins"].clone()
}

#[test]
fn plugins_are_found_where_they_are_looked_for() {
    let d = Folder::new();
    let folder = d.at("home/conefield/plugins");
    fs::create_dir_all(&folder).unwrap();
    let library = text(&dense(&folder));
    // The user's folder, the environment and the command line in turn, each with its origin.
    let found = at_home(&d, LIST);
    assert_eq!(found[0]["place"], "user-folder");
    assert_eq!(found[0]["plugin"]["stages"][0]["type"], "one-grid");
    let found = list(d.command(LIST).env("CONEFIELD_PLUGIN_PATH", &folder));
    assert_eq!(found["plugins"][0]["place"], "environment");
    let found = d.json(&format!("{LIST} --plugin {library}"));
    assert_eq!(found["plugins"][0]["place"], "named");
    assert_eq!(found["plugins"][0]["plugin"]["abi"], "4.0");
    // The same file twice counts as one plugin.
    assert_eq!(at_home(&d, &format!("{LIST} --plugin {library}")).as_array().unwrap().len(), 1);
    // A copy brings types whose names are taken: the error names both owners.
    fs::copy(&library, folder.join("other.so")).unwrap();
    let found = at_home(&d, LIST);
    let why = found[1]["refused"].as_str().unwrap();
    assert!(why.contains("dense.so") && why.contains("other.so") && why.contains("one-grid"), "{why}");
    // A broken file in a folder causes a warning; a broken file that is named causes an error.
    let (fine, _, err) = run(d.loud("explain fast").env("XDG_DATA_HOME", d.at("home")));
    assert!(fine && err.contains("plugin refused"), "{err}");
    d.refused_with(1, "--plugin nowhere.so explain fast", &["nowhere.so"]);
}

#[test]
fn a_copy_that_broke_off_is_refused_and_ends_nothing() {
    let d = Folder::new();
    let folder = d.at("home/conefield/plugins");
    fs::create_dir_all(&folder).unwrap();
    let whole = fs::read(dense(&d.at(""))).unwrap();
    for share in 1..16 {
        fs::write(folder.join("dense.so"), &whole[..whole.len() * share / 16]).unwrap();
        let found = at_home(&d, LIST);
        let why = found[0]["refused"].as_str().unwrap_or_else(|| panic!("{share}: {found}"));
        assert!(why.contains("dense.so") && why.contains("whole"), "{why}");
        let (fine, _, err) = run(d.command("explain fast").env("XDG_DATA_HOME", d.at("home")));
        assert!(fine, "{share}: {err}");
    }
}

#[test]
fn a_plugin_that_never_comes_back_does_not_hang_its_check() {
    let d = Folder::new();
    d.put("hangs.c", "#include <unistd.h>\nconst void *conefield_plugin(void) { for (;;) sleep(1); }\n");
    cc(&d.at("hangs.c"), &d.at("hangs.so"));
    let begin = std::time::Instant::now();
    d.refused_with(1, "plugins check hangs.so --time-limit 2s", &["its entry function did not return within 2"]);
    assert!(begin.elapsed().as_secs() < 60, "{:?}", begin.elapsed());
}

#[test]
fn a_home_that_is_relative_brings_no_code() {
    let d = Folder::new();
    let folder = d.at(".local/share/conefield/plugins");
    fs::create_dir_all(&folder).unwrap();
    dense(&folder);
    let mut command = d.command(LIST);
    command.env_remove("XDG_DATA_HOME").env("HOME", ".");
    assert_eq!(list(&mut command)["plugins"].as_array().unwrap().len(), 0);
    let found = list(command.env("HOME", d.at("")));
    assert_eq!(found["plugins"].as_array().unwrap().len(), 1, "{found}");
}
