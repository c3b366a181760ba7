//! `tradeoff`: halving, a front without dominated points, specs that run, and `--resume` without repetition.

use crate::common::{conefield, done, json, read, refused, signal, started, text, words};
use conefield_evaluation::report::Pixels;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::{TempDir, tempdir};

/// Three voxel bases and one field, small enough for budgets of seconds.
const LEVERS: &str = r#"
[[base]]
spec = "fdk"
[base.levers]
cutoff = [0.5]
[[base]]
spec = "os-sart"
[base.levers]
subsets = [2, 4]
[[base]]
spec = "tiny.toml"
"#;
const TINY: &str = "extends = \"fast\"\nname = \"tiny\"\n[encoder]\nlevels = 3\nlog2_table_size = 10\n[projector]\nsamples = 24\n[training]\nrays = 64\n[[priors]]\ntype = \"total-variation\"\nweight = 0.02\nblocks = 4\n";

/// A small scan and levers in a folder.
fn made() -> (TempDir, PathBuf, PathBuf) {
    let dir = tempdir().unwrap();
    let (scan, levers) = (dir.path().join("scan"), dir.path().join("levers.toml"));
    done(&["simulate", "phantom:head:16", "-o", &text(&scan), "--views", "12", "--detector", "16x16"]);
    fs::write(&levers, LEVERS).unwrap();
    fs::write(dir.path().join("tiny.toml"), TINY).unwrap();
    (dir, scan, levers)
}

fn line(scan: &Path, levers: &Path, out: &Path, more: &[&str]) -> Vec<String> {
    let (scan, levers, out) = (text(scan), text(levers), text(out));
    let all = ["tradeoff", &scan, "-o", &out, "--levers", &levers, "--budgets", "2s,3s", "--hold-out", "every:4"];
    [&all[..], &["--candidates", "5"], more].concat().iter().map(|w| w.to_string()).collect()
}

fn names(list: &Value) -> Vec<&str> {
    list.as_array().unwrap().iter().map(|n| n.as_str().unwrap()).collect()
}

/// The trials of a search that is interrupted after two of them.
#[cfg(unix)]
fn interrupted(first: &[String], out: &Path) -> Vec<Value> {
    use std::time::{Duration, Instant};
    let child = started(first);
    let state = out.join("tradeoff.json");
    let until = Instant::now() + Duration::from_secs(60);
    let trials = || if state.is_file() { read(&state)["trials"].as_array().unwrap().clone() } else { vec![] };
    while trials().len() < 2 && Instant::now() < until {
        std::thread::sleep(Duration::from_millis(5));
    }
    signal(&child, "INT");
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(130), "{said}");
    assert!(said.contains("interrupted during") && said.contains("--resume"), "{said}");
    let before = trials();
    assert!((2..8).contains(&before.len()) && !out.join("front.png").exists());
    before
}

#[cfg(not(unix))]
fn interrupted(_: &[String], _: &Path) -> Vec<Value> {
    vec![]
}

/// One search, interrupted and resumed: finished trials keep their measured times, and the result is that of a whole one.
#[test]
fn halving_front_and_specs_agree() {
    let (dir, scan, levers) = made();
    let out = dir.path().join("out");
    let first = line(&scan, &levers, &out, &["--reference", "truth"]);
    let before = interrupted(&first, &out);
    if !before.is_empty() {
        for (more, want) in [(&["--seed", "1"][..], "--resume: "), (&["--peak", "2"], "--resume: peak")] {
            let all = line(&scan, &levers, &out, &[&["--reference", "truth", "--resume"], more].concat());
            let said = refused(1, &words(&all));
            assert!(said.contains(want), "{said}");
        }
        let said = refused(1, &words(&first));
        assert!(said.contains("an earlier search"), "{said}");
    }
    let resumed = line(&scan, &levers, &out, &["--reference", "truth", "--resume", "--json"]);
    let found = json(&words(&resumed));
    assert_eq!(found["trials"].as_array().unwrap()[..before.len()], before[..]);
    // The search is complete: nothing runs again, and the front is the same.
    assert_eq!(json(&words(&resumed)), found);
    assert!(out.join("front.png").exists());
    let all = line(&scan, &levers, dir.path(), &["--force"]);
    let said = refused(1, &words(&all));
    assert!(said.contains("in it, which this command reads") && scan.join("scan.toml").exists(), "{said}");
    assert_eq!(found, read(&out.join("tradeoff.json")));
    let candidates: Vec<_> = found["search"]["candidates"].as_array().unwrap().iter().map(|c| &c["name"]).collect();
    assert_eq!(candidates, ["fdk", "os-sart", "tiny", "fdk-1", "os-sart-1"]);

    // Two of four voxel methods and the one field advance, and so do candidates that had too little time.
    let trials = found["trials"].as_array().unwrap();
    let rungs = found["rungs"].as_array().unwrap();
    let at = |budget: f64| trials.iter().filter(move |t| t["budget_s"] == budget);
    let short = at(2.0).filter(|t| t["status"] == "too-short").count();
    assert!(trials.iter().all(|t| t["status"] != "failed"), "{trials:?}");
    assert_eq!((names(&rungs[0]["tried"]).len(), at(2.0).count()), (5, 5));
    if short == 0 {
        assert_eq!((names(&rungs[0]["kept"]).len(), at(3.0).count(), trials.len()), (3, 3, 8));
        let psnr = |name: &str| {
            let trial = at(2.0).find(|t| t["candidate"] == name).unwrap();
            trial["scores"]["psnr"].as_f64().unwrap()
        };
        let mut voxels = ["fdk", "fdk-1", "os-sart", "os-sart-1"];
        voxels.sort_by(|a, b| psnr(b).total_cmp(&psnr(a)));
        for name in &voxels[..2] {
            assert!(names(&rungs[0]["kept"]).contains(name), "{name}: {rungs:?}");
        }
        assert!(names(&rungs[0]["kept"]).contains(&"tiny"));
    }
    assert_eq!(rungs[1]["tried"], rungs[0]["kept"]);
    assert!(names(&rungs[1]["kept"]).is_empty());

    // No point dominates one of the front, by the reported figures.
    let points = found["points"].as_array().unwrap();
    let number = |p: &Value, key: &str| p[key].as_f64().unwrap();
    for name in names(&found["front"]) {
        let p = points.iter().find(|p| p["name"] == name).unwrap();
        for q in points {
            let costs = ["total_s", "peak_bytes"].map(|key| (number(q, key), number(p, key)));
            let (better, same) = (number(q, "psnr") > number(p, "psnr"), number(q, "psnr") == number(p, "psnr"));
            let no_worse = costs.iter().all(|(q, p)| q <= p) && (better || same);
            assert!(!no_worse || (same && costs.iter().all(|(q, p)| q == p)), "{p} is dominated by {q}");
        }
    }
    // One rank correlation per budget, over trials with both figures.
    let ranking = found["ranking"].as_array().unwrap();
    assert_eq!(ranking.len(), 2);
    for r in ranking {
        let both = at(number(r, "budget_s")).filter(|t| t["held_out"].is_f64() && t["scores"].is_object());
        assert_eq!(r["trials"], both.count());
        assert!(r["spearman"].is_null() || (-1.0..=1.0).contains(&number(r, "spearman")));
    }
    let picture = Pixels::open(out.join("front.png")).unwrap();
    assert_eq!((picture.width, picture.height), (2000, 750));
    let table = fs::read_to_string(out.join("tradeoff.md")).unwrap();
    assert!(table.starts_with("| front | budget | PSNR dB |") && table.contains("rank correlation"), "{table}");

    // Every spec can be read back, and one runs for as many steps as its trial.
    let mut specs = 0;
    for entry in fs::read_dir(out.join("front")).unwrap() {
        let path = entry.unwrap().path();
        let explained = json(&["explain", &text(&path), "--json"]);
        assert_eq!(explained["spec"], path.file_stem().unwrap().to_str().unwrap());
        specs += 1;
    }
    assert!(specs >= names(&found["front"]).len(), "{specs}");
    let best = found["best"].as_array().unwrap().iter().find(|b| b["kind"] == "field").unwrap();
    let best = best["point"].as_str().unwrap();
    let point = points.iter().find(|p| p["name"] == best).unwrap();
    let spec = text(&out.join(format!("front/{best}.toml")));
    let again = json(&["reconstruct", &text(&scan), "--spec", &spec, "-o", &text(&dir.path().join("again")), "--json"]);
    assert_eq!(again["steps"].as_f64(), point["steps"].as_f64());

    // A method is chosen from the front.
    let run = dir.path().join("picked");
    let front = text(&out.join("front.toml"));
    let picked = json(&["reconstruct", &text(&scan), "--budget", "4s", "--front", &front, "-o", &text(&run), "--json"]);
    let chosen = picked["plan"]["point"].as_str().unwrap();
    assert!(points.iter().any(|p| p["name"] == chosen), "{chosen}");
    assert!(out.join(format!("front/{chosen}.toml")).is_file());
}

#[test]
fn without_a_reference_views_rank() {
    let (dir, scan, levers) = made();
    let out = dir.path().join("out");
    let mut all = line(&scan, &levers, &out, &["--json"]);
    all.iter_mut().filter(|w| *w == "2s,3s").for_each(|w| *w = "2s".into());
    let found = json(&words(&all));
    assert!(found["ranking"].as_array().unwrap().is_empty());
    let points = found["points"].as_array().unwrap();
    assert!(points.iter().all(|p| p["psnr"].is_null() && p["held_out"].as_f64().unwrap() > 0.0));
    let least =
        points.iter().min_by(|a, b| a["held_out"].as_f64().unwrap().total_cmp(&b["held_out"].as_f64().unwrap()));
    assert!(names(&found["front"]).contains(&least.unwrap()["name"].as_str().unwrap()));
    assert!(fs::read_to_string(out.join("tradeoff.md")).unwrap().starts_with("| front | budget | held-out error |"));
}

#[test]
fn bad_input_makes_no_folder() {
    let (dir, scan, levers) = made();
    let out = dir.path().join("out");
    for (more, want) in [
        (&["--reference", "nothing.nii"][..], "nothing.nii"),
        (&["--reference", "a.nii", "--reference", "b.nii"], "1, one per scan"),
        (&["--hold-out", "99"], "below 12"),
        (&["--hold-out", "none"], "views to rank by"),
    ] {
        let mut all = line(&scan, &levers, &out, more);
        if more[0] == "--hold-out" {
            let at = all.iter().position(|w| w == "--hold-out").unwrap();
            all.drain(at..at + 2);
        }
        let said = refused(1, &words(&all));
        assert!(said.contains(want) && !out.exists(), "{more:?}: {said}");
    }
    let shown = done(&["tradeoff", "--show-levers"]);
    assert!(shown.contains("[[base]]\nspec = \"fast\""), "{shown}");
    conefield(&["tradeoff", "--show-levers", "s"]).assert().success();
}
