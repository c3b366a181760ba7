//! `study`: methods on scans with several seeds, interrupted, shared and repeated.

use crate::common::{Folder, SCAN, number, signal};
use conefield_evaluation::report::Pixels;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;
use std::process::Command;

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

const STUDY: &str = "study tiny.toml -o out";

/// A folder with a study's file.
fn study(text: &str) -> Folder {
    let d = Folder::new();
    d.put("tiny.toml", text);
    d
}

/// The content of a table except times, memory and paths.
fn results(mut table: Value) -> Value {
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
    let d = study(TINY);
    let shown = d.done(STUDY);
    let table = d.read("out/table.json");
    let runs = table["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 12);
    for run in runs {
        let record = d.read(Path::new(run["run"].as_str().unwrap()).join("record.json"));
        for key in ["steps", "scores", "total_s", "seed", "machine"] {
            assert_eq!(run[key], record[key], "{key}");
        }
        assert_eq!(run["backend"], record["backend"]["backend"]);
        assert_eq!((&run["status"], &record["reference"]), (&"done".into(), &"truth".into()));
        // Noise and method use the cell's seed; the scan has the requested number of views.
        let case = run["case"].as_str().unwrap();
        let scan = d.text(format!("out/scans/{case}-seed{}/scan.toml", run["seed"]));
        assert!(scan.contains(&format!("seed = {}", run["seed"])), "{scan}");
        assert_eq!(record["scan"]["views"], case["head-".len()..].trim_end_matches("views").parse::<u64>().unwrap());
    }
    // Another seed gives other noise.
    let psnr = |case: &str, seed: u64, method: &str| {
        let same = |r: &&Value| r["case"] == case && r["seed"] == seed && r["method"] == method;
        number(&runs.iter().find(same).unwrap()["scores"]["psnr"])
    };
    assert_ne!(psnr("head-6views", 0, "fdk"), psnr("head-6views", 1, "fdk"));
    // Lines of means and paired differences, for each case and for all.
    let line = |case: &str, method: &str| {
        let all = table["summary"].as_array().unwrap();
        all.iter().find(|l| l["case"] == case && l["method"] == method).unwrap().clone()
    };
    let sirt = line("head-8views", "SIRT");
    let [a, b] = [0, 1].map(|seed| psnr("head-8views", seed, "SIRT"));
    assert!((number(&sirt["figures"]["psnr"]["mean"]) - (a + b) / 2.0).abs() < 1e-9, "{sirt}");
    assert!(sirt["difference"]["psnr"]["sd"].is_number() && line("head-8views", "fdk")["difference"].is_null());
    assert!(line("all", "fast")["figures"]["psnr"]["mean"].is_number());
    let cell = format!("{:.2} ± ", (a + b) / 2.0);
    let markdown = d.text("out/table.md");
    assert!(shown.contains(&cell) && markdown.contains(&cell), "{cell}\n{shown}\n{markdown}");
    assert!(markdown.contains("| head-6views-seed1/SIRT |") && markdown.contains("PSNR dB − fdk's"), "{markdown}");
    for picture in ["slices/head-6views.png", "slices/head-8views.png", "curves/head-6views.png"] {
        assert!(Pixels::open(d.at("out").join(picture)).unwrap().width > 500, "{picture}");
    }

    // A run that was interrupted before its first checkpoint, an added seed and an added method; the rest stays
    // unchanged.
    let kept = ["out/runs/head-6views-seed0", "out/scans"];
    let before = kept.map(|folder| d.times(folder));
    fs::remove_dir_all(d.at("out/runs/head-8views-seed1/SIRT")).unwrap();
    d.put("tiny.toml", TINY.replace("[0, 1]", "[0, 1, 2]").replace("['fdk',", "['fdk', 'cgls',"));
    let again = d.json(&format!("{STUDY} --resume --json"));
    let runs = again["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 24);
    for (folder, before) in kept.into_iter().zip(before) {
        let now = d.times(folder);
        assert!(before.iter().all(|(file, time)| now.get(file) == Some(time)), "{folder}");
    }
    let found = runs.iter().find(|r| r["case"] == "head-8views" && r["method"] == "SIRT" && r["seed"] == 1);
    assert_eq!(found.unwrap()["scores"]["psnr"], psnr("head-8views", 1, "SIRT"));

    // Existing content must belong to the study.
    let before = d.times("out");
    for (from, to, want) in [
        ("steps = 3", "steps = 4", "--resume: limits"),
        ("poisson:1e4", "poisson:2e4", "simulated in another way"),
        ("stop.passes=2", "relaxation=1.0", "--resume: spec"),
        ("[protocol]", "[protocol]\nhold_out = 'every:3'", "--resume: held_out_views"),
    ] {
        d.put("tiny.toml", TINY.replace(from, to));
        d.refused_with(1, &format!("{STUDY} --resume"), &[want]);
    }
    d.put("tiny.toml", TINY);
    d.refused_with(1, STUDY, &["an earlier study", "--resume"]);
    d.refused_with(1, "study tiny.toml -o out/scans --force", &["in it, expected a new or empty folder"]);
    assert_eq!(d.times("out"), before);
}

#[test]
fn scans_are_taken_as_they_are_and_a_failed_run_is_a_row() {
    let d = Folder::after(&[SCAN]);
    fs::create_dir(d.at("a")).unwrap();
    fs::rename(d.at("scan"), d.at("a/scan")).unwrap();
    d.put("a/off.toml", "extends = 'sirt'\nname = 'off'\nstart = 'none.nii'\n");
    // Paths are relative to the file, not to the working directory.
    let whole = "scans = ['scan']\nspecs = ['fdk', 'off.toml']\nseeds = [4, 5]\n[protocol]\nsteps = 2\nreference = 'truth'\nhold_out = 'every:4'\n";
    d.put("a/tiny.toml", whole);
    let line = "study a/tiny.toml -o out";
    let output = d.command(line).assert().code(1).get_output().clone();
    let (shown, said) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert!(said.contains("2 of 4 runs failed") && shown.contains("scan-seed4/off failed: "), "{said}\n{shown}");
    let table = d.read("out/table.json");
    let statuses: Vec<&str> = table["runs"].as_array().unwrap().iter().map(|r| r["status"].as_str().unwrap()).collect();
    assert_eq!(statuses, ["done", "failed", "done", "failed"]);
    let off = &table["summary"][1];
    assert_eq!([&off["method"], &off["done"], &off["failed"]], [&json!("off"), &json!(0), &json!(2)]);
    assert!(number(&table["summary"][0]["figures"]["held_out"]["mean"]) > 0.0);
    let markdown = d.text("out/table.md");
    assert!(markdown.contains("| off | 0 of 2 |") && markdown.contains("| scan-seed5/off | failed |"), "{markdown}");
    // Failed runs are repeated; finished ones are not.
    let before = d.times("out/runs/scan-seed4/fdk");
    d.put("a/off.toml", "extends = 'sirt'\nname = 'off'\n");
    let mended = d.json(&format!("{line} --resume --json"));
    assert_eq!(mended["summary"][1]["done"], 2);
    assert_eq!(d.times("out/runs/scan-seed4/fdk"), before);
    assert!(!d.has("out/failed/scan-seed4/off"));
}

#[test]
fn bad_studies_make_no_folder() {
    let d = study(TINY);
    for (from, to, want) in [
        ("encoder.levels=2", "encoder.level=2", ": specs: --set encoder.level=2: encoder.level: found an unknown key"),
        ("steps = 3", "steps = 0", ":13:9: protocol.steps"),
    ] {
        d.put("tiny.toml", TINY.replacen(from, to, 1));
        d.refuses("out", &[(STUDY, want)]);
    }
    // A folder that contains the study's file is refused for its results.
    d.put("tiny.toml", TINY);
    fs::create_dir(d.at("in")).unwrap();
    d.put("in/study.toml", TINY);
    d.refuses("out", &[("study in/study.toml -o in --force", "in it")]);
}

#[cfg(unix)]
#[test]
fn shards_come_to_the_serial_table_whatever_kills_them() {
    let d = study(
        &TINY
            .replace(", { spec = 'fast', set = ['encoder.levels=2'] }", "")
            .replace("stop.passes=2", "nonnegative=true")
            .replace("views = [6, 8]", "views = [6]")
            .replace("steps = 3", "steps = 4000"),
    );
    // Interrupted by Ctrl-C and resumed.
    let begun = || d.filled("serial/runs/head-6views-seed0/SIRT/metrics.jsonl");
    let said = d.interrupted("study tiny.toml -o serial", "INT", &begun);
    let words = "interrupted during head-6views-seed0/SIRT (2 of 4); the same command with --resume";
    assert!(said.contains(words), "{said}");
    let before = d.times("serial/runs/head-6views-seed0/fdk");
    d.done("study tiny.toml -o serial --resume");
    assert_eq!(d.times("serial/runs/head-6views-seed0/fdk"), before);

    // Two processes at a time in one folder; one is killed and restarted.
    let share = |k: u32| d.started(&format!("study tiny.toml -o shared --shard {k}/2"));
    let (one, two) = (share(1), share(2));
    d.wait_for("shared/runs/head-6views-seed0/SIRT/metrics.jsonl");
    // An exclusive user is refused while others share.
    d.refused_with(1, "study tiny.toml -o shared --resume", &["another conefield is writing"]);
    signal(&two, "KILL");
    assert!(!two.wait_with_output().unwrap().status.success());
    let printed = [share(2), one].map(|child| {
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    });
    assert!(printed.iter().any(|t| t.contains("PSNR dB")), "{printed:?}");
    let [a, b] = ["serial", "shared"].map(|f| results(d.read(format!("{f}/table.json"))));
    assert_eq!(a, b);
    let volume = |out: &str| d.bytes(format!("{out}/runs/head-6views-seed0/SIRT/volume.nii.gz"));
    assert!(volume("serial") == volume("shared"));
}

#[test]
fn a_script_for_slurm_names_every_share() {
    let d = study(&TINY.replace("seeds = [0, 1]", "seeds = [0]"));
    d.done(&format!("{STUDY} --slurm s.sh --jobs 3"));
    let written = d.text("s.sh");
    assert!(written.contains("#SBATCH --array=1-3\n"), "{written}");
    // The script runs unchanged in a shell.
    for k in 1..=3 {
        let mut bash = Command::new("bash");
        let output = bash.arg(d.at("s.sh")).env("SLURM_ARRAY_TASK_ID", k.to_string()).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    assert_eq!(d.read("out/table.json")["runs"].as_array().unwrap().len(), 6);
    d.refused_with(1, &format!("{STUDY} --slurm tiny.toml"), &["this command reads"]);
    // A script that is there is replaced only if that is asked for.
    d.put("s.sh", "mine");
    assert!(d.refused(1, &format!("{STUDY} --slurm s.sh")).contains("--force") && d.text("s.sh") == "mine");
    d.done(&format!("{STUDY} --slurm s.sh --force"));
    assert!(d.text("s.sh").contains("#SBATCH"));
}

#[test]
fn shipped_studies_are_studies() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../conefield/specs/studies");
    let d = Folder::new();
    let mut count = 0;
    for entry in fs::read_dir(folder).unwrap() {
        d.done(&format!("study {} -o out --slurm s.sh --force", entry.unwrap().path().display()));
        count += 1;
    }
    assert!(count >= 3);
}
