//! `compare`: one table in three forms, one picture, and runs that can be used alone.

use crate::common::{Folder, number};
use conefield_evaluation::report::Pixels;
use serde_json::{Value, json};
use std::fs;

const SCAN: &str = "simulate phantom:head:24 -o scan --views 12 --detector 24x24";

fn compare(specs: &str, more: &str) -> String {
    format!("compare scan --specs {specs} -o out --steps 3 {more}")
}

/// Cells of the Markdown table, one row per method.
fn markdown(d: &Folder) -> Vec<Vec<String>> {
    let text = d.text("out/table.md");
    let cells = |l: &str| l.trim_matches('|').split('|').map(|c| c.trim().to_owned()).collect::<Vec<_>>();
    text.lines().filter(|l| l.starts_with('|')).map(cells).filter(|r| !r[0].starts_with("---")).collect()
}

#[test]
fn table_picture_and_records_agree_and_resume_skips_what_is_done() {
    let d = Folder::after(&[SCAN]);
    let all = "--reference truth --hold-out every:4 --seed 3";
    let shown = d.done(&compare("fdk,sirt,fast", all));
    let table = d.read("out/table.json");
    let protocol = &table["protocol"];
    let scan = ["views", "detector", "volume"].map(|key| protocol["scan"][key].clone());
    assert_eq!(scan, [json!(12), json!([24, 24]), json!([24, 24, 24])]);
    let asked = [&protocol["seed"], &protocol["reference"], &protocol["limits"]["steps"]];
    assert_eq!(asked, [&json!(3), &json!("truth"), &json!(3)]);
    let device = protocol["device"].as_str().unwrap();
    assert!(device.starts_with("cpu, ") && d.text("out/table.md").contains(&format!("; seed 3, {device}, conefield ")));
    let rows = markdown(&d);
    let heads = [
        "method", "PSNR dB", "ssim_2d", "ssim_3d", "ssim_skimage", "held-out error", "steps or passes",
        "solve time, s", "total time, s", "peak memory",
    ];
    assert_eq!(rows[0], heads);
    let methods = table["methods"].as_array().unwrap();
    assert_eq!(methods.iter().map(|m| m["name"].as_str().unwrap()).collect::<Vec<_>>(), ["fdk", "sirt", "fast"]);
    for (method, row) in methods.iter().zip(&rows[1..]) {
        let name = method["name"].as_str().unwrap();
        assert_eq!((&method["run"], &method["status"]), (&json!(format!("out/{name}")), &json!("done")));
        let record = d.read(format!("out/{name}/record.json"));
        for key in
            ["steps", "train_s", "export_s", "total_s", "peak_bytes", "samples_per_s", "loss", "held_out", "scores"]
        {
            assert_eq!(method[key], record[key], "{name}: {key}");
        }
        let score = |key: &str| number(&record["scores"][key]);
        assert_eq!(row[0], name);
        assert_eq!(row[1], format!("{:.2}", score("psnr")));
        for (cell, key) in row[2..5].iter().zip(["ssim_2d", "ssim_3d", "ssim_skimage"]) {
            assert_eq!(*cell, format!("{:.4}", score(key)), "{name}: {key}");
        }
        assert_eq!(row[6], record["steps"].to_string());
        assert!(number(&record["total_s"]) >= number(&record["train_s"]));
        // The terminal shows the same cells.
        let printed = shown.lines().find(|l| l.split("  ").next() == Some(name)).unwrap();
        let printed: Vec<&str> = printed.split("  ").map(str::trim).filter(|c| !c.is_empty()).collect();
        assert_eq!(printed, *row);
    }
    // FDK takes no samples and has no loss: both are missing. It predicts held-out views.
    assert_eq!([&methods[0]["samples_per_s"], &methods[0]["loss"]], [&Value::Null; 2]);
    assert!(number(&methods[0]["held_out"]) > 0.0 && rows[1][5] != "-");
    assert_eq!([&methods[1]["steps"], &methods[2]["steps"]], [3, 3]);
    let picture = Pixels::open(d.at("out/compare.png")).unwrap();
    assert!((1000..3000).contains(&picture.width) && (600..3000).contains(&picture.height));

    // A run that was interrupted before its first checkpoint, and an added one; the others stay unchanged.
    let before = d.times("out/fdk");
    fs::remove_file(d.at("out/sirt/record.json")).unwrap();
    let again = d.json(&compare("fdk,sirt,fast,cgls", &format!("{all} --resume --json")));
    assert_eq!(again, d.read("out/table.json"));
    assert_eq!(d.times("out/fdk"), before);
    assert_eq!(again["methods"][0], table["methods"][0]);
    assert_eq!(again["methods"][1]["scores"], table["methods"][1]["scores"]);
    assert_eq!(again["methods"].as_array().unwrap().len(), 4);

    // Existing runs must match the protocol.
    for (more, want) in [
        ("--reference truth --hold-out every:4 --seed 4", "seed"),
        ("--reference truth --seed 3", "held_out_views"),
        ("--hold-out every:4 --seed 3", "reference"),
        (&format!("{all} --at-most 9s"), "limits"),
        (&format!("{all} --set nonnegative=false"), "spec"),
    ] {
        let said = d.refused(1, &compare("fdk", &format!("{more} --resume")));
        assert!(said.contains(&format!("--resume: {want}")), "{said}");
    }
    assert_eq!(d.times("out/fdk"), before);
    // A run on another backend is another run.
    let record = d.text("out/fdk/record.json");
    d.put("out/fdk/record.json", record.replace("\"backend\": \"cpu, ", "\"backend\": \"wgpu, "));
    d.refused_with(1, &compare("fdk", &format!("{all} --resume")), &["--resume: backend: found cpu, expected wgpu"]);
    d.refused_with(1, &compare("fdk", all), &["an earlier comparison", "--resume"]);
    d.done(&compare("sirt", "--force"));
    assert!(!d.has("out/fdk") && d.has("out/sirt/record.json"));
    // Without reference and held-out views the loss is shown.
    assert_eq!(markdown(&d)[0][1], "loss");
    assert!(d.read("out/table.json")["methods"][0]["scores"].is_null());
}

#[test]
fn changed_files_of_a_finished_run_are_noticed() {
    let convert = "convert scan/truth.nii.gz";
    let d = Folder::after(&[SCAN, &format!("{convert} mask.nii"), &format!("{convert} reference.nii")]);
    let line = compare("sirt", "--reference reference.nii --set 'scene.support={file=\"mask.nii\"}'");
    d.done(&line);
    let line = format!("{line} --resume");
    let before = d.times("out/sirt");
    for (file, want) in [("mask.nii", "file mask.nii"), ("reference.nii", "voxels of the reference")] {
        let whole = d.bytes(file);
        let mut changed = whole.clone();
        let last = changed.len() - 2;
        changed[last] ^= 1;
        d.put(file, &changed);
        d.refused_with(1, &line, &[&format!("--resume: {want}"), "--force starts over"]);
        d.put(file, &whole);
    }
    d.done(&line);
    assert_eq!(d.times("out/sirt"), before);
}

#[test]
fn a_method_that_fails_leaves_the_others_their_rows() {
    let d = Folder::after(&[SCAN]);
    d.put("wild.toml", "extends = \"fast\"\nname = \"wild\"\n[optimizer]\nlr = 1e30\n");
    // Detected only when the method reads it: a missing start volume.
    d.put("off.toml", "extends = \"sirt\"\nname = \"off\"\nstart = \"none.nii\"\n");
    let line = compare("wild.toml,fdk,off.toml", "--reference truth");
    let output = d.command(&line).assert().code(1).get_output().clone();
    let (shown, said) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    let table = d.read("out/table.json");
    let status = |i: usize| table["methods"][i]["status"].as_str().unwrap();
    assert_eq!((status(1), status(2)), ("done", "failed"), "{shown}\n{said}");
    let why = table["methods"][2]["error"].as_str().unwrap();
    assert!(why.contains("none.nii") && !why.contains('\n'), "{why}");
    assert_eq!(&markdown(&d)[3][..2], ["off", "failed"]);
    assert!(shown.contains(&format!("off failed: {why}")), "{shown}");
    assert!(said.contains("methods failed: ") && said.contains("off"), "{said}");
    assert!(Pixels::open(d.at("out/compare.png")).is_ok());
    // Failed runs are repeated, finished ones are not.
    let before = d.times("out/fdk");
    d.command(&format!("{line} --resume")).assert().code(1);
    assert_eq!(d.times("out/fdk"), before);
}

#[test]
fn bad_input_makes_no_folder() {
    let d = Folder::after(&[
        SCAN,
        "simulate phantom:head:16 -o other --views 2 --detector 8x8",
        "convert other/truth.nii.gz small.nii",
    ]);
    d.put("slash.toml", "extends = \"fdk\"\nname = \"../fdk\"\n");
    d.put("again.toml", "extends = \"fdk\"\n");
    for (specs, more, want) in [
        ("fdk,fkd", "", "neither a shipped spec nor a file"),
        ("fdk,fdk", "", "a unique name"),
        ("fdk,again.toml", "", "a unique name"),
        ("slash.toml", "", "a name for a folder"),
        ("fdk", "--reference nothing.nii", "nothing.nii"),
        ("fdk", "--reference small.nii", "[24, 24, 24], the shape of the scan's volume"),
        ("fdk", "--hold-out 12", "expected an index below 12"),
        ("fdk,sirt", "--set encoder.levels=3", "encoder"),
    ] {
        d.refuses("out", &[(&compare(specs, more), want)]);
    }
    d.refuses("out", &[("compare no-scan --specs fdk -o out", "no-scan")]);
    // A folder with anything else in it stays unchanged, whatever the options.
    d.refuses("out", &[("compare scan --specs fdk -o scan --force", "in it, expected a new or empty folder")]);
    assert!(d.has("scan/scan.toml"));
}

#[cfg(unix)]
#[test]
fn a_signal_stops_it_and_resume_goes_on_to_the_same_bits() {
    let d = Folder::after(&[SCAN]);
    let line = |out: &str| format!("compare scan --specs fdk,sirt -o {out} --steps 4000");
    d.done(&line("whole"));
    for out in ["INT", "TERM"] {
        // Only to this process: the child notices the end of its input.
        let said = d.interrupted(&line(out), out, &|| d.filled(&format!("{out}/sirt/metrics.jsonl")));
        assert!(said.contains("interrupted during sirt (2 of 2); the same command with --resume"), "{said}");
        assert!(!d.at(out).join("table.json").exists());
        assert!(d.at(out).join("sirt/checkpoint.safetensors").exists() && d.at(out).join("fdk/record.json").exists());
    }
    let line = format!("{} --resume", line("TERM"));
    d.refused_with(1, &format!("{line} --seed 1"), &["--resume: seed"]);
    let before = d.times("TERM/fdk");
    d.done(&line);
    assert_eq!(d.times("TERM/fdk"), before);
    assert!(d.bytes("whole/sirt/volume.nii.gz") == d.bytes("TERM/sirt/volume.nii.gz"));
}

#[test]
fn a_cap_on_time_ends_what_a_budget_would_stretch() {
    let d = Folder::after(&[SCAN]);
    let steps =
        |more: &str| number(&d.json(&format!("reconstruct scan --spec sirt -o run --force --json {more}"))["steps"]);
    assert_eq!(steps("--at-most 1h --set stop.passes=5"), 5.0);
    assert!(steps("--at-most 1e-9s") < 2.0);
}
