//! `conefield plugins new`: from a name to a reconstruction, in both languages and for every kind.

use crate::build::{cargo, library, sources};
use crate::common::{Folder, SCAN, text};
use conefield_core::registry::Kind;
use std::fs;
use std::path::Path;
use std::process::Command;

/// The kinds and the specs of their templates, from the list of the contract.
macro_rules! kinds {
    ($($table:ident $field:ident: $($kind:ident $name:ident $code:ident $spec:ident $place:literal),+;)*) => {
        const KINDS: &[(Kind, &str)] = &[$($((Kind::$kind, stringify!($spec)),)+)*];
    };
}

conefield_plugin_abi::kinds! { kinds }

/// Checks the plugin in the folder `new-KIND`, built to `library`, and runs it briefly.
fn use_it(d: &Folder, (kind, spec): (Kind, &str), library: &Path) {
    let (name, library) = (format!("new-{kind}"), text(library));
    let report = d.json(&format!("plugins check {library} --json"));
    assert_eq!(report["passed"], true, "{report:#}");
    let small = if spec == "fista" { "'stop={ passes = 12 }'" } else { "training.rays=32" };
    let run = format!("--spec {name}/spec.toml -o run --force --steps 12 --set {small} --json");
    let record = d.json(&format!("--plugin {library} reconstruct scan {run}"));
    let plugin = &record["plugins"][0];
    assert_eq!([&plugin["name"], &plugin["version"]], [name.as_str(), "0.1.0"]);
    assert_eq!(record["steps"], 12);
    if kind == Kind::Encoder {
        // It says how fine it is: a step of the spec is one cell.
        let balanced = format!("--spec balanced --steps 2 --set encoder.type={name} -o cells --force");
        d.done(&format!("--plugin {library} reconstruct scan {balanced}"));
        // Without its plugin a field cannot be evaluated; the message has the option for it.
        let option = format!("--plugin {}", plugin["path"].as_str().unwrap());
        for line in ["export cells -o export.nii", "features cells -o features.png"] {
            let said = d.refused(1, line);
            assert!(said.contains("record.json") && said.contains(&option), "{said}");
        }
    }
}

/// Makes a plugin of every kind, as one workspace with the profile and the versions of the examples: nothing else is
/// downloaded, and what the examples' builds have compiled is used again.
fn workspace(d: &Folder) {
    let examples = sources().join("plugins/examples");
    for (kind, _) in KINDS {
        let said = d.done(&format!("plugins new new-{kind} --kind {kind} --lang rust"));
        assert!(said.contains("cargo build --release") && said.contains("some minutes"), "{said}");
        let path = format!("new-{kind}/Cargo.toml");
        let manifest = d.text(&path);
        // Paths of this machine would not mean anything on another.
        assert!(manifest.contains("path = \"../"), "{manifest}");
        let (package, alone) = manifest.split_once("# Independent of any enclosing workspace.").unwrap();
        assert_eq!(alone.trim(), "[workspace]");
        d.put(path, package);
    }
    let profile = fs::read_to_string(examples.join("Cargo.toml")).unwrap();
    let profile = &profile[profile.find("[profile.release]").unwrap()..];
    d.put("Cargo.toml", format!("[workspace]\nresolver = \"3\"\nmembers = [\"new-*\"]\n\n{profile}"));
    d.put("Cargo.lock", fs::read(examples.join("Cargo.lock")).unwrap());
}

#[test]
fn in_rust() {
    let d = Folder::after(&[SCAN]);
    workspace(&d);
    cargo(&d.at(""), &["build", "--release"]);
    cargo(&d.at(""), &["test", "--release", "-p", "new-encoder"]);
    KINDS.iter().for_each(|of| use_it(&d, *of, &library(&format!("new-{}", of.0))));
}

#[test]
fn in_c() {
    let d = Folder::after(&[SCAN]);
    for of in KINDS {
        let kind = of.0;
        d.done(&format!("plugins new new-{kind} --kind {kind} --lang c"));
        let folder = d.at(format!("new-{kind}"));
        let made =
            Command::new("make").current_dir(&folder).env("CFLAGS", "-O2 -Wall -Wextra -Werror").output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let library = folder.join(format!("new-{kind}.so"));
        use_it(&d, *of, &library);
        if kind == Kind::Encoder {
            // Its author learns what turns the checks in double precision on.
            let said = d.done(&format!("plugins check {}", text(&library)));
            assert!(said.contains("in C, info leaves double_precision 0"), "{said}");
        }
    }
}

#[test]
fn names_and_folders_are_checked() {
    let d = Folder::new();
    fs::create_dir(d.at("taken")).unwrap();
    for (name, why) in [
        ("Wavelet", "lower-case letters"),
        ("a", "lower-case letters"),
        ("../b", "lower-case letters"),
        ("'wave let'", "lower-case letters"),
        ("-- -wave", "lower-case letters"),
        ("wave-", "lower-case letters"),
        ("fn", "not a Rust keyword"),
        ("self --lang c", "not a Rust keyword"),
        ("hash-grid --lang c", "conefield itself"),
        ("taken", "an existing file or folder"),
        ("mine --sources .", "--sources"),
    ] {
        d.refused_with(1, &format!("plugins new --kind encoder {name}"), &[why]);
        assert_eq!(d.names(""), ["taken"], "{name}");
    }
}

/// The page shows the output of `plugins new`, which must be short.
#[test]
fn the_page_shows_the_encoder_that_is_made() {
    let d = Folder::new();
    d.done("plugins new waves --kind encoder --lang rust");
    let made = d.text("waves/src/lib.rs");
    let read = |path: &str| std::fs::read_to_string(sources().join(path)).unwrap();
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
