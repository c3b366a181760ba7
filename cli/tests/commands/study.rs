//! `study`: methods on scans with several seeds, interrupted, shared and repeated.

use crate::common::{conefield, done, json, read, refused, signal, started, text, times, wait_for};
use conefield_evaluation::report::Pixels;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use tempfile::{TempDir, tempdir};

const TINY: &str = "
name = 'tiny'
volumes = [{ volume = 'phantom:head:16', name = 'head' }]
specs = ['fdk', { spec = 'sirt', name = 'SIRT', set = ['stop.passes=2'] }, { spec = 'fast', set = ['encoder.levels=2'] }]
seeds = [0, 1]
views = [6, 8]
baseline = 'fdk'
window = [0.1, 0.9]
[simulate]
detector = '16x16'
noise = 'poisson:1e4'
[protocol]
steps = 3
";

/// A study's file in its own folder.
fn study(text: &str) -> (TempDir, PathBuf) {
    let dir = tempdir().unwrap();
    let path = dir.path().join("tiny.toml");
    fs::write(&path, text).unwrap();
    (dir, path)
}

/// The content of a table except times, memory and paths.
fn results(table: &Value) -> Value {
    let mut table = table.clone();
    let timed = ["train_s", "export_s", "total_s", "samples_per_s", "peak_bytes", "run"];
    for run in table["runs"].as_array_mut().unwrap() {
        timed.iter().for_each(|k| drop(run.as_object_mut().unwrap().remove(*k)));
    }
    for line in table["summary"].as_array_mut().unwrap() {
        for key in ["figures", "difference"] {
            if let Some(figures) = line[key].as_object_mut() {
                timed.iter().for_each(|k| drop(figures.remove(*k)));
            }
        }
    }
    table
}

#[test]
fn tables_pictures_and_records_agree_and_resume_repeats_nothing() {
    let (dir, file) = study(TINY);
    let out = dir.path().join("out");
    let shown = done(&["study", &text(&file), "-o", &text(&out)]);
    let table = read(&out.join("table.json"));
    let runs = table["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 12);
    for run in runs {
        let folder = PathBuf::from(run["run"].as_str().unwrap());
        let record = read(&folder.join("record.json"));
        for key in ["steps", "scores", "total_s", "seed", "machine"] {
            assert_eq!(run[key], record[key], "{key}");
        }
        assert_eq!((&run["status"], &record["reference"]), (&"done".into(), &"truth".into()));
        // Noise and method use the cell's seed; the scan has the requested number of views.
        let case = run["case"].as_str().unwrap();
        let scan = fs::read_to_string(out.join(format!("scans/{case}-seed{}/scan.toml", run["seed"]))).unwrap();
        assert!(scan.contains(&format!("seed = {}", run["seed"])), "{scan}");
        assert_eq!(record["scan"]["views"], case["head-".len()..].trim_end_matches("views").parse::<u64>().unwrap());
    }
    // Another seed gives other noise.
    let psnr = |case: &str, seed: u64, method: &str| {
        let same = |r: &&Value| r["case"] == case && r["seed"] == seed && r["method"] == method;
        runs.iter().find(same).unwrap()["scores"]["psnr"].as_f64().unwrap()
    };
    assert_ne!(psnr("head-6views", 0, "fdk"), psnr("head-6views", 1, "fdk"));
    // Mean, deviation and paired difference, computed by hand.
    let line = |case: &str, method: &str| {
        let all = table["summary"].as_array().unwrap();
        all.iter().find(|l| l["case"] == case && l["method"] == method).unwrap().clone()
    };
    let of = |method: &str| [0, 1].map(|seed| psnr("head-8views", seed, method));
    let (a, b) = (of("SIRT"), of("fdk"));
    let near = |x: &Value, y: f64| assert!((x.as_f64().unwrap() - y).abs() < 1e-9, "{x} {y}");
    let sirt = line("head-8views", "SIRT");
    near(&sirt["figures"]["psnr"]["mean"], (a[0] + a[1]) / 2.0);
    near(&sirt["figures"]["psnr"]["sd"], (a[0] - a[1]).abs() / 2f64.sqrt());
    let d = [a[0] - b[0], a[1] - b[1]];
    near(&sirt["difference"]["psnr"]["mean"], (d[0] + d[1]) / 2.0);
    near(&sirt["difference"]["psnr"]["sd"], (d[0] - d[1]).abs() / 2f64.sqrt());
    assert!(line("head-8views", "fdk")["difference"].is_null());
    let both = ["head-6views", "head-8views"].map(|c| line(c, "fast")["figures"]["psnr"]["mean"].as_f64().unwrap());
    near(&line("all", "fast")["figures"]["psnr"]["mean"], (both[0] + both[1]) / 2.0);
    let cell = format!("{:.2} ± ", (a[0] + a[1]) / 2.0);
    let markdown = fs::read_to_string(out.join("table.md")).unwrap();
    assert!(shown.contains(&cell) && markdown.contains(&cell), "{cell}\n{shown}\n{markdown}");
    assert!(markdown.contains("| head-6views-seed1/SIRT |") && markdown.contains("PSNR dB − fdk's"), "{markdown}");
    for picture in ["slices/head-6views.png", "slices/head-8views.png", "curves/head-6views.png"] {
        assert!(Pixels::open(out.join(picture)).unwrap().width > 500, "{picture}");
    }

    // A run that was interrupted before its first checkpoint, an added seed and an added method; the rest stays
    // unchanged.
    let before = times(&out.join("runs/head-6views-seed0"));
    let scans = times(&out.join("scans"));
    fs::remove_dir_all(out.join("runs/head-8views-seed1/SIRT")).unwrap();
    let more = TINY.replace("[0, 1]", "[0, 1, 2]").replace("['fdk',", "['fdk', 'cgls',");
    fs::write(&file, more).unwrap();
    let again = json(&["study", &text(&file), "-o", &text(&out), "--resume", "--json"]);
    assert_eq!(again["runs"].as_array().unwrap().len(), 24);
    let now = times(&out.join("runs/head-6views-seed0"));
    assert!(before.iter().all(|b| now.contains(b)));
    assert!(scans.iter().all(|b| times(&out.join("scans")).contains(b)));
    let found = again["runs"]
        .as_array()
        .unwrap()
        .iter()
        .find(|r| r["case"] == "head-8views" && r["method"] == "SIRT" && r["seed"] == 1);
    assert_eq!(found.unwrap()["scores"]["psnr"], psnr("head-8views", 1, "SIRT"));

    // Existing content must belong to the study.
    let before = times(&out);
    for (from, to, want) in [
        ("steps = 3", "steps = 4", "--resume: limits"),
        ("poisson:1e4", "poisson:2e4", "simulated in another way"),
        ("stop.passes=2", "relaxation=1.0", "--resume: spec"),
        ("[protocol]", "[protocol]\nhold_out = 'every:3'", "--resume: held_out_views"),
    ] {
        fs::write(&file, TINY.replace(from, to)).unwrap();
        let said = refused(1, &["study", &text(&file), "-o", &text(&out), "--resume"]);
        assert!(said.contains(want), "{said}");
    }
    fs::write(&file, TINY).unwrap();
    let said = refused(1, &["study", &text(&file), "-o", &text(&out)]);
    assert!(said.contains("an earlier study") && said.contains("--resume"), "{said}");
    let said = refused(1, &["study", &text(&file), "-o", &text(dir.path()), "--force"]);
    assert!(said.contains("in it, expected a new or empty folder"), "{said}");
    assert_eq!(times(&out), before);
}

#[test]
fn scans_are_taken_as_they_are_and_a_failed_run_is_a_row() {
    let (dir, file) = study("");
    let scan = dir.path().join("a/scan");
    fs::create_dir(dir.path().join("a")).unwrap();
    done(&["simulate", "phantom:head:16", "-o", &text(&scan), "--views", "8", "--detector", "16x16"]);
    fs::write(dir.path().join("a/off.toml"), "extends = 'sirt'\nname = 'off'\nstart = 'none.nii'\n").unwrap();
    // Paths are relative to the file, not to the working directory.
    let whole = "scans = ['a/scan']\nspecs = ['fdk', 'a/off.toml']\nseeds = [4, 5]\n[protocol]\nsteps = 2\nreference = 'truth'\nhold_out = 'every:4'\n";
    fs::write(&file, whole).unwrap();
    let out = dir.path().join("out");
    let line = ["study", &text(&file), "-o", &text(&out)];
    let output = conefield(&line).assert().code(1).get_output().clone();
    let (shown, said) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert!(said.contains("2 of 4 runs failed") && shown.contains("scan-seed4/off failed: "), "{said}\n{shown}");
    let table = read(&out.join("table.json"));
    let statuses: Vec<&str> = table["runs"].as_array().unwrap().iter().map(|r| r["status"].as_str().unwrap()).collect();
    assert_eq!(statuses, ["done", "failed", "done", "failed"]);
    let off = &table["summary"][1];
    assert_eq!((&off["method"], &off["done"], &off["failed"]), (&"off".into(), &0.into(), &2.into()));
    assert!(table["summary"][0]["figures"]["held_out"]["mean"].as_f64().unwrap() > 0.0);
    let markdown = fs::read_to_string(out.join("table.md")).unwrap();
    assert!(markdown.contains("| off | 0 of 2 |") && markdown.contains("| scan-seed5/off | failed |"), "{markdown}");
    // Failed runs are repeated; finished ones are not.
    let before = times(&out.join("runs/scan-seed4/fdk"));
    fs::write(dir.path().join("a/off.toml"), "extends = 'sirt'\nname = 'off'\n").unwrap();
    let mended = json(&["study", &text(&file), "-o", &text(&out), "--resume", "--json"]);
    assert_eq!(mended["summary"][1]["done"], 2);
    assert_eq!(times(&out.join("runs/scan-seed4/fdk")), before);
    assert!(!out.join("failed/scan-seed4/off").exists());
}

#[test]
fn bad_studies_make_no_folder() {
    let (dir, file) = study(TINY);
    let out = dir.path().join("out");
    for (from, to, want) in [
        ("seeds", "seed", ":5:1: seed: found a key that is not known here, expected \"seeds\""),
        ("'fdk'", "'fkd'", "fkd: found neither a shipped spec nor a file"),
        ("encoder.levels=2", "encoder.level=2", ": specs: --set encoder.level=2: encoder.level: found an unknown key"),
        ("phantom:head:16", "none.nii", "none.nii"),
        ("steps = 3", "steps = 0", ":13:9: protocol.steps"),
    ] {
        fs::write(&file, TINY.replacen(from, to, 1)).unwrap();
        let said = refused(1, &["study", &text(&file), "-o", &text(&out)]);
        assert!(said.contains(want), "{said}");
        assert!(!out.exists(), "{to}");
    }
    let said = refused(2, &["study", "s", "-o", "r", "--shard", "3/2"]);
    assert!(said.contains("K from 1 to N"), "{said}");
    // A folder that contains the study's file is refused for its results.
    fs::write(&file, TINY).unwrap();
    let said = refused(1, &["study", &text(&file), "-o", &text(dir.path())]);
    assert!(said.contains("in it"), "{said}");
}

fn start(file: &Path, out: &Path, more: &[&str]) -> Child {
    started(&[&["study", &text(file), "-o", &text(out)], more].concat())
}

#[cfg(unix)]
#[test]
fn shards_come_to_the_serial_table_whatever_kills_them() {
    let long = TINY
        .replace(", { spec = 'fast', set = ['encoder.levels=2'] }", "")
        .replace("stop.passes=2", "nonnegative=true")
        .replace("views = [6, 8]", "views = [6]")
        .replace("steps = 3", "steps = 4000");
    let (dir, file) = study(&long);
    let file = &file;
    // Interrupted by Ctrl-C and resumed.
    let serial = dir.path().join("serial");
    let first = start(file, &serial, &[]);
    wait_for(&serial.join("runs/head-6views-seed0/SIRT/metrics.jsonl"));
    signal(&first, "INT");
    let output = first.wait_with_output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(130), "{said}");
    assert!(
        said.contains("interrupted during head-6views-seed0/SIRT (2 of 4); the same command with --resume"),
        "{said}"
    );
    let before = times(&serial.join("runs/head-6views-seed0/fdk"));
    done(&["study", &text(file), "-o", &text(&serial), "--resume"]);
    assert_eq!(times(&serial.join("runs/head-6views-seed0/fdk")), before);

    // Two processes at a time in one folder; one is killed and restarted.
    let shared = dir.path().join("shared");
    let shares = ["1/2", "2/2"].map(|s| start(file, &shared, &["--shard", s]));
    wait_for(&shared.join("runs/head-6views-seed0/SIRT/metrics.jsonl"));
    // An exclusive user is refused while others share.
    let said = refused(1, &["study", &text(file), "-o", &text(&shared), "--resume"]);
    assert!(said.contains("another conefield is writing"), "{said}");
    let [one, two] = shares;
    signal(&two, "KILL");
    assert!(!two.wait_with_output().unwrap().status.success());
    let again = start(file, &shared, &["--shard", "2/2"]).wait_with_output().unwrap();
    assert!(again.status.success(), "{}", String::from_utf8_lossy(&again.stderr));
    let one = one.wait_with_output().unwrap();
    assert!(one.status.success(), "{}", String::from_utf8_lossy(&one.stderr));
    let printed = [one, again].map(|o| String::from_utf8(o.stdout).unwrap());
    assert!(printed.iter().any(|t| t.contains("PSNR dB")), "{printed:?}");
    let [a, b] = [&serial, &shared].map(|f| read(&f.join("table.json")));
    assert_eq!(results(&a), results(&b));
    let volume = |out: &Path| fs::read(out.join("runs/head-6views-seed0/SIRT/volume.nii.gz")).unwrap();
    assert!(volume(&serial) == volume(&shared));
}

#[test]
fn a_script_for_slurm_names_every_share() {
    let (dir, file) = study(TINY);
    let (out, script) = (dir.path().join("out"), dir.path().join("study.sh"));
    done(&["study", &text(&file), "-o", &text(&out), "--slurm", &text(&script), "--jobs", "3"]);
    let written = fs::read_to_string(&script).unwrap();
    assert!(written.contains("#SBATCH --array=1-3\n"), "{written}");
    // The script runs unchanged in a shell.
    for k in 1..=3 {
        let status = Command::new("bash").arg(&script).env("SLURM_ARRAY_TASK_ID", k.to_string()).output().unwrap();
        assert!(status.status.success(), "{}", String::from_utf8_lossy(&status.stderr));
    }
    assert_eq!(read(&out.join("table.json"))["runs"].as_array().unwrap().len(), 12);
    let said = refused(1, &["study", &text(&file), "-o", &text(&out), "--slurm", &text(&file)]);
    assert!(said.contains("this command reads"), "{said}");
    // A script that is there is replaced only if that is asked for.
    fs::write(&script, "mine").unwrap();
    let again = ["study", &text(&file), "-o", &text(&out), "--slurm", &text(&script)];
    assert!(refused(1, &again).contains("--force") && fs::read_to_string(&script).unwrap() == "mine");
    done(&[&again[..], &["--force"]].concat());
    assert!(fs::read_to_string(&script).unwrap().contains("#SBATCH"));
}

#[test]
fn shipped_studies_are_studies() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../conefield/specs/studies");
    let dir = tempdir().unwrap();
    let mut count = 0;
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let (out, script) = (text(&dir.path().join("out")), text(&dir.path().join("s.sh")));
        done(&["study", &text(&path), "-o", &out, "--slurm", &script, "--force"]);
        count += 1;
    }
    assert!(count >= 3);
}
