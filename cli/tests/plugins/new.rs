//! `conefield plugins new`: from a name to a reconstruction, in both languages and for every kind.

use crate::build::{cargo, library, sources};
use crate::common::{done, json, refused, text};
use std::path::{Path, PathBuf};
use std::process::Command;

const KINDS: [&str; 10] = [
    "encoder", "normalizer", "field", "projector", "initializer", "loss", "prior", "regularizer", "data-term", "basis",
];

/// Kinds that are parts of iterative methods.
const PIECES: [&str; 3] = ["regularizer", "data-term", "basis"];

/// A scan small enough for seconds.
fn scan(dir: &Path) -> PathBuf {
    let path = dir.join("scan");
    done(&["simulate", "phantom:head:16", "-o", &text(&path), "--views", "8", "--detector", "16x16"]);
    path
}

/// Checks the plugin in `folder`, built to `library`, and runs it briefly; returns the run's record.
fn use_it(kind: &str, folder: &Path, library: &Path, scan: &Path) -> serde_json::Value {
    let library = text(library);
    let report = json(&["plugins", "check", &library, "--json"]);
    assert_eq!(report["passed"], true, "{report:#}");
    let spec = text(&folder.join("spec.toml"));
    let run = text(&folder.join("run"));
    let small = if PIECES.contains(&kind) { "stop={ passes = 12 }" } else { "training.rays=32" };
    let small = ["--steps", "12", "--set", small, "--json"];
    let record =
        json(&[&["--plugin", &library, "reconstruct", &text(scan), "--spec", &spec, "-o", &run][..], &small].concat());
    if kind == "encoder" {
        // It says how fine it is: a step of the spec is one cell.
        let (scan, run, encoder) = (text(scan), text(&folder.join("cells")), format!("encoder.type=new-{kind}"));
        let balanced = ["--spec", "balanced", "--steps", "2", "--set", &encoder, "-o", &run];
        done(&[&["--plugin", &library, "reconstruct", &scan][..], &balanced].concat());
        // Without its plugin a field cannot be evaluated; the message has the option for it.
        let path = record["plugins"][0]["path"].as_str().unwrap();
        for (command, output) in [("export", "export.nii"), ("features", "features.png")] {
            let said = refused(1, &[command, &run, "-o", &text(&folder.join(output))]);
            assert!(said.contains("record.json") && said.contains(&format!("--plugin {path}")), "{said}");
        }
    }
    record
}

/// Makes a plugin of every kind in `dir`, as one workspace with the profile and the versions of the examples: nothing else
/// is downloaded, and what the examples' builds have compiled is used again.
fn workspace(dir: &Path) {
    let examples = sources().join("plugins/examples");
    for kind in KINDS {
        let name = format!("new-{kind}");
        let said = done(&["plugins", "new", &name, "--kind", kind, "--lang", "rust", "--into", &text(dir)]);
        assert!(said.contains("cargo build --release") && said.contains("some minutes"), "{said}");
        let path = dir.join(&name).join("Cargo.toml");
        let manifest = std::fs::read_to_string(&path).unwrap();
        // Paths of this machine would not mean anything on another.
        assert!(manifest.contains("path = \"../"), "{manifest}");
        let (package, alone) = manifest.split_once("# Independent of any enclosing workspace.").unwrap();
        assert_eq!(alone.trim(), "[workspace]");
        std::fs::write(path, package).unwrap();
    }
    let profile = std::fs::read_to_string(examples.join("Cargo.toml")).unwrap();
    let profile = &profile[profile.find("[profile.release]").unwrap()..];
    let workspace = format!("[workspace]\nresolver = \"3\"\nmembers = [\"new-*\"]\n\n{profile}");
    std::fs::write(dir.join("Cargo.toml"), workspace).unwrap();
    std::fs::copy(examples.join("Cargo.lock"), dir.join("Cargo.lock")).unwrap();
}

#[test]
fn in_rust() {
    let dir = tempfile::tempdir().unwrap();
    let scan = scan(dir.path());
    workspace(dir.path());
    cargo(dir.path(), &["build", "--release"]);
    cargo(dir.path(), &["test", "--release", "-p", "new-encoder"]);
    for kind in KINDS {
        let name = format!("new-{kind}");
        let record = use_it(kind, &dir.path().join(&name), &library(&name), &scan);
        assert_eq!(record["plugins"][0]["name"], name.as_str());
        assert_eq!(record["plugins"][0]["version"], "0.1.0");
        assert_eq!(record["steps"], 12);
    }
}

#[test]
fn in_c() {
    let dir = tempfile::tempdir().unwrap();
    let scan = scan(dir.path());
    for kind in KINDS {
        let name = format!("new-{kind}");
        done(&["plugins", "new", &name, "--kind", kind, "--lang", "c", "--into", &text(dir.path())]);
        let folder = dir.path().join(&name);
        let made =
            Command::new("make").current_dir(&folder).env("CFLAGS", "-O2 -Wall -Wextra -Werror").output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let library = folder.join(format!("{name}.so"));
        let record = use_it(kind, &folder, &library, &scan);
        assert_eq!(record["plugins"][0]["name"], name.as_str());
        if kind == "encoder" {
            // Its author learns what turns the checks in double precision on.
            let said = done(&["plugins", "check", &text(&library)]);
            assert!(said.contains("in C, info leaves double_precision 0"), "{said}");
        }
    }
}

#[test]
fn names_and_folders_are_checked() {
    let dir = tempfile::tempdir().unwrap();
    let into = text(dir.path());
    for name in ["Wavelet", "a", "../b", "wave let", "-wave", "wave-"] {
        let e = refused(1, &["plugins", "new", "--kind", "encoder", "--into", &into, "--", name]);
        assert!(e.contains("lower-case letters"), "{e}");
    }
    for lang in ["rust", "c"] {
        for (name, why) in
            [("fn", "not a Rust keyword"), ("self", "not a Rust keyword"), ("hash-grid", "conefield itself")]
        {
            let e = refused(1, &["plugins", "new", name, "--kind", "encoder", "--lang", lang, "--into", &into]);
            assert!(e.contains(why) && !dir.path().join(name).exists(), "{e}");
        }
    }
    std::fs::create_dir(dir.path().join("taken")).unwrap();
    let e = refused(1, &["plugins", "new", "taken", "--kind", "encoder", "--into", &into]);
    assert!(e.contains("an existing file or folder"), "{e}");
    let e = refused(1, &["plugins", "new", "mine", "--kind", "encoder", "--into", &into, "--sources", &into]);
    assert!(e.contains("--sources"), "{e}");
    assert!(!dir.path().join("mine").exists());
}

/// The page shows the output of `plugins new`, which must be short.
#[test]
fn the_page_shows_the_encoder_that_is_made() {
    let read = |path: &str| std::fs::read_to_string(sources().join(path)).unwrap();
    let made = read("cli/templates/rust/encoder.rs").replace("@name@", "waves");
    let page = read("docs/guide/writing-stages.md");
    let shown = page.split_once("```rust\n").and_then(|(_, rest)| rest.split_once("```")).map(|(code, _)| code);
    assert_eq!(shown, Some(&made[..]));
    let example = read("examples/02_an_encoder.rs");
    let own = example.split("fn main()").next().and_then(|text| text.split_once("stage_type!")).unwrap().1;
    for (what, text) in [("plugin", &made[..]), ("example", own)] {
        let code = |line: &&str| !line.trim().is_empty() && !line.trim().starts_with("//");
        let lines = text.lines().filter(code).count();
        assert!(lines <= 60, "{what}: {lines} lines of code");
    }
}
