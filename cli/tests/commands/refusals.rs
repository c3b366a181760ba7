//! Bad input ends with status 1 and one message that names the file, the field, the value found and the value expected;
//! see also `bad_input` and the tests of `conefield_core::spec`.

use crate::common::Folder;
use std::fs;

const SCAN: &str = "simulate phantom:head:16 -o scan --views 4 --detector 8x8";

#[test]
fn missing_files_are_named() {
    let d = Folder::new();
    for line in [
        "info nothing.nii.gz",
        "evaluate nothing.nii.gz nothing.nii.gz",
        "simulate nothing.nii.gz -o out",
        "reconstruct nothing.nii.gz --spec naf -o out",
        "pretrain nothing.nii.gz --spec naf -o w.safetensors",
        "convert nothing.nii.gz out",
        "import nothing.nii.gz -o out",
        "explain naf --scan nothing.nii.gz",
    ] {
        d.refuses("out", &[(line, "nothing.nii.gz")]);
    }
}

#[test]
fn settings_are_checked_where_they_stand() {
    let d = Folder::new();
    for (spec, want) in [
        ("[encoder]\nconvention = \"naff\"\n", "encoder.convention: found \"naff\", expected \"naf\""),
        (
            "[[normalizers]]\ntype = \"layer-norm\"\n[[normalizers]]\ntype = \"layer-norm\"\neps = 3\n",
            "mine.toml:6:7: normalizers.1.eps: found 3",
        ),
        // A skip layer after the last layer.
        ("[field]\nskips = [9]\n", "field.skips"),
    ] {
        d.put("mine.toml", format!("extends = \"naf\"\n{spec}"));
        d.refuses("out", &[("explain mine.toml", want)]);
    }
    d.refuses("out", &[("explain naf --set encoder.levels.x=1", "which is 16")]);
}

#[test]
fn a_scan_is_not_written_under_the_name_of_a_volume() {
    let d = Folder::after(&[SCAN]);
    for out in ["out.nii", "out.nii.gz", "out.TIF", "out.zarr"] {
        for to in ["", " --to r2", " --to naf"] {
            d.refuses(out, &[(&format!("convert scan {out}{to}"), "OUT: found the end of a volume's name")]);
        }
    }
    d.done("convert scan out.pickle --to naf");
}

/// Another command may be about to finish a file there.
#[test]
fn a_folder_with_other_files_is_left_as_it_is() {
    let d = Folder::after(&[SCAN]);
    fs::create_dir(d.at("other")).unwrap();
    d.put("other/notes.txt", "mine");
    d.put("other/.conefield-0.tmp", "under way");
    for more in ["", "--force"] {
        d.refused_with(
            1,
            &format!("reconstruct scan --spec fdk -o other {more}"),
            &["notes.txt", "a new or empty folder"],
        );
        assert_eq!(d.names("other"), [".conefield-0.tmp", "notes.txt"]);
    }
    fs::remove_file(d.at("other/notes.txt")).unwrap();
    d.done("reconstruct scan --spec fdk -o other");
    assert!(!d.has("other/.conefield-0.tmp"));
    d.refused_with(1, "simulate phantom:head:16 -o scan", &["--force"]);
}

#[test]
fn views_and_weights_that_are_not_there_are_refused() {
    let d = Folder::after(&[SCAN]);
    let found = "--hold-out: found every:100, which selects none of 4 views";
    d.refuses(
        "run",
        &[
            ("reconstruct scan --spec naf -o run --hold-out every:100", found),
            ("reconstruct scan --spec naf -o run --init no.safetensors", "no.safetensors"),
        ],
    );
}

/// Each of them would do the whole work and write to the same folder.
#[test]
fn several_processes_without_mpi_are_refused() {
    let d = Folder::after(&[SCAN]);
    let of = |count: &str| {
        let mut command = d.command("reconstruct scan --spec fdk -o run");
        command.env("OMPI_COMM_WORLD_SIZE", count).assert().get_output().clone()
    };
    let said = String::from_utf8(of("4").stderr).unwrap();
    assert!(said.starts_with("error: ") && said.contains("feature `mpi`"), "{said}");
    assert!(!d.has("run"));
    assert!(of("1").status.success());
}
