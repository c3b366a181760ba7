//! `compare`: one table in three forms, one picture, and runs that can be used alone.

use crate::common::{conefield, done, json, read, refused, signal, simulated, started, text, times, wait_for, words};
use conefield_evaluation::report::Pixels;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A small scan in a folder of its own.
fn scan() -> (TempDir, PathBuf) {
    simulated(24, 12)
}

fn arguments(scan: &Path, specs: &str, output: &Path, more: &[&str]) -> Vec<String> {
    let (scan, output) = (text(scan), text(output));
    [&["compare", &scan, "--specs", specs, "-o", &output, "--steps", "3"], more]
        .concat()
        .iter()
        .map(|a| a.to_string())
        .collect()
}

/// Cells of the Markdown table, one row per method.
fn markdown(folder: &Path) -> Vec<Vec<String>> {
    let text = fs::read_to_string(folder.join("table.md")).unwrap();
    let rows = text
        .lines()
        .filter(|l| l.starts_with('|'))
        .map(|l| l.trim_matches('|').split('|').map(|c| c.trim().to_owned()).collect::<Vec<_>>());
    rows.filter(|r| !r[0].starts_with("---")).collect()
}

#[test]
fn table_picture_and_records_agree_and_resume_skips_what_is_done() {
    let (dir, scan) = scan();
    let out = dir.path().join("out");
    let all = ["--reference", "truth", "--hold-out", "every:4", "--seed", "3"];
    let line = arguments(&scan, "fdk,sirt,fast", &out, &all);
    let shown = done(&words(&line));
    let table = read(&out.join("table.json"));
    let protocol = &table["protocol"];
    assert_eq!(protocol["scan"]["views"], 12);
    assert_eq!(protocol["scan"]["detector"], serde_json::json!([24, 24]));
    assert_eq!(protocol["scan"]["volume"], serde_json::json!([24, 24, 24]));
    assert_eq!(
        (&protocol["seed"], &protocol["reference"], &protocol["limits"]["steps"]),
        (&3.into(), &"truth".into(), &3.into())
    );
    let rows = markdown(&out);
    let heads = [
        "method", "PSNR dB", "ssim_2d", "ssim_3d", "ssim_skimage", "held-out error", "steps or passes",
        "solve time, s", "total time, s", "peak memory",
    ];
    assert_eq!(rows[0], heads);
    let methods = table["methods"].as_array().unwrap();
    assert_eq!(methods.iter().map(|m| m["name"].as_str().unwrap()).collect::<Vec<_>>(), ["fdk", "sirt", "fast"]);
    for (method, row) in methods.iter().zip(&rows[1..]) {
        let name = method["name"].as_str().unwrap();
        assert_eq!(method["run"], text(&out.join(name)));
        assert_eq!(method["status"], "done");
        let record = read(&out.join(name).join("record.json"));
        for key in
            ["steps", "train_s", "export_s", "total_s", "peak_bytes", "samples_per_s", "loss", "held_out", "scores"]
        {
            assert_eq!(method[key], record[key], "{name}: {key}");
        }
        let number = |key: &str| record["scores"][key].as_f64().unwrap();
        assert_eq!(row[0], name);
        assert_eq!(row[1], format!("{:.2}", number("psnr")));
        for (cell, key) in row[2..5].iter().zip(["ssim_2d", "ssim_3d", "ssim_skimage"]) {
            assert_eq!(*cell, format!("{:.4}", number(key)), "{name}: {key}");
        }
        assert_eq!(row[6], record["steps"].to_string());
        assert!(record["total_s"].as_f64() >= record["train_s"].as_f64());
        // The terminal shows the same cells.
        let printed = shown.lines().find(|l| l.split("  ").next() == Some(name)).unwrap();
        let printed: Vec<&str> = printed.split("  ").map(str::trim).filter(|c| !c.is_empty()).collect();
        assert_eq!(printed, *row);
    }
    // FDK takes no samples and has no loss: both are missing. It predicts held-out views.
    assert_eq!([&methods[0]["samples_per_s"], &methods[0]["loss"]], [&Value::Null; 2]);
    assert!(methods[0]["held_out"].as_f64().is_some_and(|e| e > 0.0) && rows[1][5] != "-");
    assert_eq!([&methods[1]["steps"], &methods[2]["steps"]], [3, 3]);
    let picture = Pixels::open(out.join("compare.png")).unwrap();
    assert!((1000..3000).contains(&picture.width) && (600..3000).contains(&picture.height));

    // A run that was interrupted before its first checkpoint, and an added one; the others stay unchanged.
    let before = times(&out.join("fdk"));
    fs::remove_file(out.join("sirt/record.json")).unwrap();
    let line = arguments(&scan, "fdk,sirt,fast,cgls", &out, &[&all[..], &["--resume", "--json"]].concat());
    let again = json(&words(&line));
    assert_eq!(again, read(&out.join("table.json")));
    assert_eq!(times(&out.join("fdk")), before);
    assert_eq!(again["methods"][0], table["methods"][0]);
    assert_eq!(again["methods"][1]["scores"], table["methods"][1]["scores"]);
    assert_eq!(again["methods"].as_array().unwrap().len(), 4);

    // Existing runs must match the protocol.
    for (more, want) in [
        (&["--reference", "truth", "--hold-out", "every:4", "--seed", "4"][..], "seed"),
        (&["--reference", "truth", "--seed", "3"], "held_out_views"),
        (&["--hold-out", "every:4", "--seed", "3"], "reference"),
        (&["--reference", "truth", "--hold-out", "every:4", "--seed", "3", "--at-most", "9s"], "limits"),
        (&["--reference", "truth", "--hold-out", "every:4", "--seed", "3", "--set", "nonnegative=false"], "spec"),
    ] {
        let line = arguments(&scan, "fdk", &out, &[more, &["--resume"]].concat());
        let said = refused(1, &words(&line));
        assert!(said.contains(&format!("--resume: {want}")), "{said}");
    }
    assert_eq!(times(&out.join("fdk")), before);
    let said = refused(1, &words(&arguments(&scan, "fdk", &out, &all)));
    assert!(said.contains("an earlier comparison") && said.contains("--resume"), "{said}");
    done(&words(&arguments(&scan, "sirt", &out, &["--force"])));
    assert!(!out.join("fdk").exists() && out.join("sirt/record.json").exists());
    // Without reference and held-out views the loss is shown.
    assert_eq!(markdown(&out)[0][1], "loss");
    assert!(read(&out.join("table.json"))["methods"][0]["scores"].is_null());
}

#[test]
fn a_method_that_fails_leaves_the_others_their_rows() {
    let (dir, scan) = scan();
    let out = dir.path().join("out");
    let (spec, off) = (dir.path().join("wild.toml"), dir.path().join("off.toml"));
    fs::write(&spec, "extends = \"fast\"\nname = \"wild\"\n[optimizer]\nlr = 1e30\n").unwrap();
    // Detected only when the method reads it: a missing start volume.
    fs::write(&off, "extends = \"sirt\"\nname = \"off\"\nstart = \"none.nii\"\n").unwrap();
    let specs = format!("{},fdk,{}", text(&spec), text(&off));
    let line = arguments(&scan, &specs, &out, &["--reference", "truth"]);
    let output = conefield(&words(&line)).assert().code(1).get_output().clone();
    let (shown, said) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    let table = read(&out.join("table.json"));
    let status = |i: usize| table["methods"][i]["status"].as_str().unwrap();
    assert_eq!((status(1), status(2)), ("done", "failed"), "{shown}\n{said}");
    let why = table["methods"][2]["error"].as_str().unwrap();
    assert!(why.contains("none.nii") && !why.contains('\n'), "{why}");
    let rows = markdown(&out);
    assert_eq!(&rows[3][..2], ["off", "failed"]);
    assert!(shown.contains(&format!("off failed: {why}")), "{shown}");
    assert!(said.contains("methods failed: ") && said.contains("off"), "{said}");
    assert!(Pixels::open(out.join("compare.png")).is_ok());
    // Failed runs are repeated, finished ones are not.
    let before = times(&out.join("fdk"));
    let line = arguments(&scan, &specs, &out, &["--reference", "truth", "--resume"]);
    conefield(&words(&line)).assert().code(1);
    assert_eq!(times(&out.join("fdk")), before);
}

#[test]
fn bad_input_makes_no_folder() {
    let (dir, scan) = scan();
    let out = dir.path().join("out");
    let (small, slash) = (dir.path().join("small.nii"), dir.path().join("slash.toml"));
    done(&["simulate", "phantom:head:16", "-o", &text(&dir.path().join("other")), "--views", "2", "--detector", "8x8"]);
    done(&["convert", &text(&dir.path().join("other/truth.nii.gz")), &text(&small)]);
    fs::write(&slash, "extends = \"fdk\"\nname = \"../fdk\"\n").unwrap();
    let twice = format!(
        "fdk,{}",
        text(&{
            let path = dir.path().join("again.toml");
            fs::write(&path, "extends = \"fdk\"\n").unwrap();
            path
        })
    );
    for (specs, more, want) in [
        ("fdk,fkd", &[][..], "neither a shipped spec nor a file"),
        ("fdk,fdk", &[], "a unique name"),
        (&twice, &[], "a unique name"),
        (&text(&slash), &[], "a name for a folder"),
        ("fdk", &["--reference", "nothing.nii"], "nothing.nii"),
        ("fdk", &["--reference", &text(&small)], "[24, 24, 24], the shape of the scan's volume"),
        ("fdk", &["--hold-out", "12"], "expected an index below 12"),
        ("fdk,sirt", &["--set", "encoder.levels=3"], "encoder"),
    ] {
        let said = refused(1, &words(&arguments(&scan, specs, &out, more)));
        assert!(said.contains(want), "{specs} {more:?}: {said}");
        assert!(!out.exists(), "{specs} {more:?}");
    }
    let said = refused(1, &words(&arguments(Path::new("no-scan"), "fdk", &out, &[])));
    assert!(said.contains("no-scan") && !out.exists(), "{said}");
    // A folder with anything else in it stays unchanged, whatever the options.
    let said = refused(1, &words(&arguments(&scan, "fdk", dir.path(), &["--force"])));
    assert!(said.contains("in it, expected a new or empty folder"), "{said}");
    assert!(scan.join("scan.toml").exists());
}

#[cfg(unix)]
#[test]
fn a_signal_stops_it_and_resume_goes_on_to_the_same_bits() {
    let (dir, scan) = scan();
    let line = |out: &Path, more: &[&str]| {
        let line = arguments(&scan, "fdk,sirt", out, more);
        line.into_iter().map(|w| if w == "3" { "4000".into() } else { w }).collect::<Vec<String>>()
    };
    let whole = dir.path().join("whole");
    done(&words(&line(&whole, &[])));
    let mut out = PathBuf::new();
    for (name, code) in [("INT", 130), ("TERM", 143)] {
        out = dir.path().join(name);
        let child = started(&line(&out, &[]));
        wait_for(&out.join("sirt/metrics.jsonl"));
        // Only to this process: the child notices the end of its input.
        signal(&child, name);
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{said}");
        assert!(said.contains("interrupted during sirt (2 of 2); the same command with --resume"), "{said}");
        assert!(output.stdout.is_empty() && !out.join("table.json").exists());
        assert!(out.join("sirt/checkpoint.safetensors").exists() && out.join("fdk/record.json").exists());
    }
    let said = refused(1, &words(&line(&out, &["--resume", "--seed", "1"])));
    assert!(said.contains("--resume: seed"), "{said}");
    let before = times(&out.join("fdk"));
    done(&words(&line(&out, &["--resume"])));
    assert_eq!(times(&out.join("fdk")), before);
    let volume = |folder: &Path| fs::read(folder.join("sirt/volume.nii.gz")).unwrap();
    assert!(volume(&whole) == volume(&out));
}

#[test]
fn a_cap_on_time_ends_what_a_budget_would_stretch() {
    let (dir, scan) = scan();
    let run = |name: &str, more: &[&str]| {
        let out = text(&dir.path().join(name));
        let scan = text(&scan);
        let line = [&["reconstruct", &scan, "--spec", "sirt", "-o", &out, "--json"], more].concat();
        json(&line)["steps"].as_u64().unwrap()
    };
    assert_eq!(run("whole", &["--at-most", "1h", "--set", "stop.passes=5"]), 5);
    assert!(run("cut", &["--at-most", "1e-9s"]) < 2);
}
