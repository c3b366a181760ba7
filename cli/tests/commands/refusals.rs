//! Bad input ends with status 1 and one message that names the file, the field, the value found and the value expected.

use crate::common::{refused, text};
use std::fs;
use tempfile::tempdir;

/// Explaining this spec is refused with this message.
fn refused_spec(spec: &str, want: &str) {
    let dir = tempdir().unwrap();
    let path = dir.path().join("mine.toml");
    fs::write(&path, spec).unwrap();
    let said = refused(1, &["explain", &text(&path)]);
    assert!(said.contains(want), "\n{spec}\n{said}\n{want}");
    assert_eq!(said.trim_end().lines().count(), 1, "{said}");
}

#[test]
fn missing_files_are_named() {
    for args in [
        &["info", "nothing.nii.gz"][..],
        &["evaluate", "nothing.nii.gz", "nothing.nii.gz"],
        &["simulate", "nothing.nii.gz", "-o", "scan"],
        &["reconstruct", "nothing.nii.gz", "--spec", "naf", "-o", "run"],
        &["pretrain", "nothing.nii.gz", "--spec", "naf", "-o", "w.safetensors"],
        &["convert", "nothing.nii.gz", "out.nii"],
        &["import", "nothing.nii.gz", "-o", "scan"],
        &["explain", "naf", "--scan", "nothing.nii.gz"],
    ] {
        let said = refused(1, args);
        assert!(said.contains("nothing.nii.gz"), "{args:?}: {said}");
    }
}

#[test]
fn an_unknown_spec_lists_the_shipped_ones() {
    let said = refused(1, &["explain", "ni-nef"]);
    assert!(
        said.contains(
            "\"ni-naf\" (of naf, ni-naf, ni-naf-published, nerf, sax-nerf, dense, accurate, balanced, fast, field-tv, accurate-tv, fdk, "
        ),
        "{said}"
    );
}

#[test]
fn unknown_keys_and_types_are_reported_with_line_and_nearest_name() {
    let base = "extends = \"naf\"\n[encoder]\n";
    refused_spec(
        &format!("{base}level = 8\n"),
        "mine.toml:3:1: encoder.level: found an unknown key, expected \"levels\" (of ",
    );
    refused_spec(
        &format!("{base}type = \"hashgrid\"\n"),
        "mine.toml:3:8: encoder.type: found no encoder type \"hashgrid\", expected \"hash-grid\"",
    );
    refused_spec(&format!("{base}convention = \"naff\"\n"), "encoder.convention: found \"naff\", expected \"naf\"");
    refused_spec("extends = \"naf\"\nfeild = 3\n", "mine.toml:2:1: feild: found an unknown key, expected \"field\"");
    refused_spec("type = \"neural-feild\"\n", "expected \"neural-field\"");
}

#[test]
fn settings_out_of_range_are_reported_with_their_line() {
    refused_spec(
        "extends = \"naf\"\n\n[encoder]\nlevels = 0\n",
        "mine.toml:4:10: encoder.levels: found 0, expected 1 to 32",
    );
    refused_spec(
        "extends = \"naf\"\n[[normalizers]]\ntype = \"layer-norm\"\n[[normalizers]]\ntype = \"layer-norm\"\neps = 3\n",
        "mine.toml:6:7: normalizers.1.eps: found 3",
    );
    refused_spec("extends = \"naf\"\n[scene]\nfill = 2\n[projector]\nsamples = 0\n", "projector.samples");
}

#[test]
fn impossible_widths_are_refused() {
    // A skip layer after the last layer.
    refused_spec("extends = \"naf\"\n[field]\nskips = [9]\n", "field.skips");
}

#[test]
fn circles_of_layers_are_refused() {
    let dir = tempdir().unwrap();
    let path = dir.path().join("a.toml");
    fs::write(&path, "extends = \"b.toml\"\n").unwrap();
    fs::write(dir.path().join("b.toml"), "extends = \"a.toml\"\n").unwrap();
    let said = refused(1, &["explain", &text(&path)]);
    assert!(said.contains("b.toml:1:11: extends") && said.contains("no circle"), "{said}");
}

#[test]
fn sets_are_checked() {
    for (set, want) in [
        ("encoder.level=8", "--set encoder.level=8: encoder.level: found an unknown key, expected \"levels\""),
        ("encoder.levels=lots", "expected a whole number"),
        ("encoder.levels.x=1", "which is 16"),
        ("encoder.levels=0", "--set encoder.levels=0: encoder.levels: found 0"),
    ] {
        let said = refused(1, &["explain", "naf", "--set", set]);
        assert!(said.contains(want), "{set}: {said}");
    }
}

#[test]
fn a_run_is_not_mixed_with_other_files() {
    let dir = tempdir().unwrap();
    let (scan, run) = (text(&dir.path().join("scan")), dir.path().join("run"));
    crate::common::done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "4", "--detector", "8x8"]);
    fs::create_dir(&run).unwrap();
    fs::write(run.join("letter.txt"), "mine").unwrap();
    let args = ["reconstruct", &scan, "--spec", "naf", "-o", &text(&run), "--steps", "1", "--force"];
    let said = refused(1, &args);
    assert!(said.contains("letter.txt") && said.contains("a new or empty folder"), "{said}");
    assert_eq!(fs::read_to_string(run.join("letter.txt")).unwrap(), "mine");
    let said = refused(1, &["simulate", "phantom:head:16", "-o", &scan]);
    assert!(said.contains("--force"), "{said}");
}

/// Another command may be about to finish a file there.
#[test]
fn a_folder_that_is_refused_is_left_as_it_is() {
    let dir = tempdir().unwrap();
    let (scan, other) = (dir.path().join("scan"), dir.path().join("other"));
    crate::common::done(&["simulate", "phantom:head:16", "-o", &text(&scan), "--views", "4", "--detector", "8x8"]);
    fs::create_dir(&other).unwrap();
    fs::write(other.join("notes.txt"), "mine").unwrap();
    fs::write(other.join(".conefield-0.tmp"), "under way").unwrap();
    let said = refused(1, &["reconstruct", &text(&scan), "--spec", "fdk", "-o", &text(&other)]);
    assert!(said.contains("notes.txt"), "{said}");
    assert!(other.join(".conefield-0.tmp").exists());
    fs::remove_file(other.join("notes.txt")).unwrap();
    crate::common::done(&["reconstruct", &text(&scan), "--spec", "fdk", "-o", &text(&other)]);
    assert!(!other.join(".conefield-0.tmp").exists());
}

#[test]
fn views_that_are_not_there_are_refused() {
    let dir = tempdir().unwrap();
    let (scan, run) = (text(&dir.path().join("scan")), text(&dir.path().join("run")));
    crate::common::done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "4", "--detector", "8x8"]);
    let said = refused(1, &["reconstruct", &scan, "--spec", "naf", "-o", &run, "--hold-out", "every:100"]);
    assert!(said.contains("--hold-out: found every:100, which selects none of 4 views"), "{said}");
    let said = refused(1, &["reconstruct", &scan, "--spec", "naf", "-o", &run, "--init", "no.safetensors"]);
    assert!(said.contains("no.safetensors"), "{said}");
    assert!(!dir.path().join("run").exists(), "nothing is made before the input is known to be good");
}

/// Each of them would do the whole work and write to the same folder.
#[test]
fn several_processes_without_mpi_are_refused() {
    let dir = tempdir().unwrap();
    let (scan, run) = (text(&dir.path().join("scan")), text(&dir.path().join("run")));
    crate::common::done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "4", "--detector", "8x8"]);
    let of = |count: &str| {
        let mut command = crate::common::conefield(&["reconstruct", &scan, "--spec", "fdk", "-o", &run]);
        command.env("OMPI_COMM_WORLD_SIZE", count).assert().get_output().clone()
    };
    let said = String::from_utf8(of("4").stderr).unwrap();
    assert!(said.starts_with("error: ") && said.contains("feature `mpi`"), "{said}");
    assert!(!dir.path().join("run").exists());
    assert!(of("1").status.success());
}
