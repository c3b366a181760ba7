//! Inputs are preserved, outputs are replaced only when the new result is complete, a folder has one writer, and text
//! from files does not reach the terminal unescaped.

use crate::common::{conefield, done, json, refused, signal, started, text, wait_for, words};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};
use std::time::{Duration, Instant};

/// A folder with `scan`, a scan of 8 views.
fn with_scan() -> (tempfile::TempDir, String) {
    let dir = tempfile::tempdir().unwrap();
    let scan = text(&dir.path().join("scan"));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "8", "--detector", "16x16"]);
    (dir, scan)
}

fn fast(scan: &str, output: &str, more: &[&str]) -> Vec<String> {
    let all = ["reconstruct", scan, "--spec", "fast", "--steps", "3", "--set", "training.rays=16", "-o", output];
    all.iter().chain(more).map(|s| (*s).to_owned()).collect()
}

/// Every file below `folder` with its content.
fn standing(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut all = vec![];
    let mut entries: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        if path.is_dir() {
            all.push((path.clone(), vec![]));
            all.extend(standing(&path));
        } else {
            all.push((path.clone(), fs::read(&path).unwrap()));
        }
    }
    all
}

/// Checks that the command is refused with all of `says` and changes nothing in `dir`.
fn refused_whole(dir: &Path, args: &[&str], says: &[&str]) -> String {
    let before = standing(dir);
    let said = refused(1, args);
    assert!(says.iter().all(|s| said.contains(s)), "{args:?}: {says:?} are not all in: {said}");
    // A comparison also prints messages of its runs.
    assert!(args[0] == "compare" || said.trim_end().lines().count() == 1, "{said}");
    let after = standing(dir);
    let names = |all: &[(PathBuf, Vec<u8>)]| all.iter().map(|(p, _)| p.display().to_string()).collect::<Vec<_>>();
    assert_eq!(names(&before), names(&after), "{args:?}");
    assert!(before == after, "{args:?} changed a file");
    said
}

#[test]
fn what_is_replaced_is_not_what_is_read() {
    let (dir, scan) = with_scan();
    let at = |n: &str| text(&dir.path().join(n));
    let (run, fdk) = (at("run"), at("fdk"));
    done(&words(&fast(&scan, &run, &[])));
    done(&["reconstruct", &scan, "--spec", "fdk", "-o", &fdk]);
    let reads = "which this command reads";
    let weights = at("run/weights.safetensors");
    refused_whole(dir.path(), &words(&fast(&scan, &run, &["--init", &weights, "--force"])), &["run", reads]);
    let volume = at("fdk/volume.nii.gz");
    let sirt = ["reconstruct", &scan, "--spec", "sirt", "--init", &volume, "-o", &fdk, "--force"];
    refused_whole(dir.path(), &sirt, &["fdk", reads]);
    // Under another name, and named by the spec.
    std::os::unix::fs::symlink(&run, at("link")).unwrap();
    let through = at("link/weights.safetensors");
    refused_whole(dir.path(), &words(&fast(&scan, &run, &["--init", &through, "--force"])), &[reads]);
    let set = format!("start='{volume}'");
    refused_whole(
        dir.path(),
        &["reconstruct", &scan, "--spec", "sirt", "--set", &set, "-o", &fdk, "--force"],
        &["fdk", reads],
    );
    let spec = at("run/spec.toml");
    refused_whole(dir.path(), &["reconstruct", &scan, "--spec", &spec, "-o", &run, "--force"], &[reads]);
    // A comparison that starts from one of its own runs.
    let all = at("all");
    done(&["compare", &scan, "--specs", "fdk", "-o", &all]);
    let set = format!("start='{}'", at("all/fdk/volume.nii.gz"));
    refused_whole(dir.path(), &["compare", &scan, "--specs", "sirt", "--set", &set, "-o", &all, "--force"], &[reads]);
    // A scan of its own truth.
    let truth = at("scan/truth.nii.gz");
    refused_whole(dir.path(), &["simulate", &truth, "-o", &scan, "--force"], &[reads]);
    refused_whole(dir.path(), &["convert", &scan, &scan, "--force"], &["this command reads"]);
}

#[test]
fn an_output_is_no_input() {
    let (dir, scan) = with_scan();
    let at = |n: &str| text(&dir.path().join(n));
    let (run, fdk) = (at("run"), at("fdk"));
    for (spec, output) in [("fdk", &fdk), ("cgls", &run)] {
        done(&["reconstruct", &scan, "--spec", spec, "-o", output]);
    }
    let projections = at("scan/projections.npy");
    refused_whole(dir.path(), &["info", &scan, "--png", &projections], &["projections.npy", ".png"]);
    let [a, b] = [at("run/volume.nii.gz"), at("fdk/volume.nii.gz")];
    refused_whole(dir.path(), &["evaluate", &a, &b, "--png", &a], &["volume.nii.gz", ".png"]);
    // The same file under a valid name.
    std::os::unix::fs::symlink(&a, at("a.png")).unwrap();
    refused_whole(dir.path(), &["evaluate", &a, &b, "--png", &at("a.png")], &["a.png", "this command reads"]);
    let pretrain = ["pretrain", "phantom:head:16", "--spec", "fast", "--steps", "1", "-o"];
    refused_whole(dir.path(), &[&pretrain[..], &[&projections]].concat(), &["projections.npy", ".safetensors"]);
    fs::write(at("w.safetensors"), "mine").unwrap();
    refused_whole(dir.path(), &[&pretrain[..], &[&at("w.safetensors")]].concat(), &["--force"]);
    refused_whole(dir.path(), &["convert", &a, &a, "--force"], &["this command reads"]);
}

#[test]
fn an_input_that_is_unfit_leaves_the_earlier_run() {
    let (dir, scan) = with_scan();
    let at = |n: &str| text(&dir.path().join(n));
    let (run, all, zero) = (at("run"), at("all"), at("zero"));
    done(&words(&fast(&scan, &run, &[])));
    done(&["compare", &scan, "--specs", "fdk,sirt", "-o", &all]);
    // A truncated volume is read only after the run has begun.
    done(&["convert", &at("scan/truth.nii.gz"), &at("v.npy")]);
    let whole = fs::read(at("v.npy")).unwrap();
    fs::write(at("half.npy"), &whole[..whole.len() / 2]).unwrap();
    let empty = ndarray::Array3::<f32>::zeros((16, 16, 16));
    ndarray_npy::write_npy(at("empty.npy"), &empty).unwrap();
    done(&["simulate", &at("empty.npy"), "-o", &zero, "--views", "8", "--detector", "16x16"]);
    refused_whole(dir.path(), &words(&fast(&scan, &run, &["--init", &at("half.npy"), "--force"])), &["half.npy"]);
    refused_whole(dir.path(), &words(&fast(&zero, &run, &["--force"])), &[]);
    refused_whole(dir.path(), &["compare", &zero, "--specs", "fast", "-o", &all, "--force"], &["fast"]);
    // Without --force a refusal leaves nothing behind, so that the next attempt does not need it.
    let new = at("new");
    refused_whole(dir.path(), &words(&fast(&zero, &new, &[])), &[]);
    done(&words(&fast(&scan, &new, &[])));
    // A valid result replaces the earlier one and leaves nothing else behind.
    done(&words(&fast(&scan, &run, &["--force"])));
    done(&["compare", &scan, "--specs", "fdk", "-o", &all, "--force"]);
    assert!(!Path::new(&all).join("sirt").exists());
    let hidden = |d: &Path| fs::read_dir(d).unwrap().any(|e| e.unwrap().file_name().as_bytes().starts_with(b"."));
    assert!(!hidden(dir.path()) && !hidden(Path::new(&run)) && !hidden(Path::new(&all)));
}

/// The command, not quiet, in a shell that redirects its standard error.
fn shell(script: &str, args: &[String]) -> Output {
    let program = assert_cmd::cargo::cargo_bin("conefield");
    Command::new("sh").args(["-c", script]).arg(program).args(args).output().unwrap()
}

#[test]
fn a_log_that_nobody_reads_ends_no_run() {
    let (dir, scan) = with_scan();
    for (name, script) in [
        ("head", "\"$0\" \"$@\" 2>&1 | head -1"),
        ("dead reader", "{ \"$0\" \"$@\"; echo $? >&3; } 3>&1 2>&1 >/dev/null | true"),
        ("closed", "\"$0\" \"$@\" 2>&-"),
        ("full", "\"$0\" \"$@\" 2>/dev/full"),
    ] {
        let run = dir.path().join(name);
        let output = shell(script, &fast(&scan, &text(&run), &["-v"]));
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !said.contains("panicked"), "{name}: {said}");
        assert!(run.join("record.json").exists(), "{name}");
        // A failure has its own status, even if its message cannot be written.
        let output =
            shell(&script.replace(" | true", "").replace(" | head -1", ""), &fast("nowhere", &text(&run), &[]));
        assert!(name == "dead reader" || output.status.code() == Some(1), "{name}: {:?}", output.status);
    }
}

/// A run with very many steps.
fn long(scan: &str, run: &str, more: &[&str]) -> Child {
    let args = ["reconstruct", scan, "--spec", "fast", "--steps", "4000000", "--set", "training.rays=16", "-o", run];
    started(&[&args[..], more].concat())
}

/// Whether this process and its children ignore a closed terminal, as under `nohup`.
fn ignores_hangups() -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|l| u64::from_str_radix(l.strip_prefix("SigIgn:")?.trim(), 16).ok());
    ignored.is_some_and(|signals| signals & 1 == 1)
}

#[test]
fn a_closed_terminal_leaves_a_checkpoint() {
    if ignores_hangups() {
        return eprintln!("SKIPPED: the tests were started so that they outlive their terminal, and so would the run");
    }
    let (dir, scan) = with_scan();
    let run = dir.path().join("run");
    let mut child = long(&scan, &text(&run), &["--checkpoint-every", "1h"]);
    wait_for(&run.join("metrics.jsonl"));
    std::thread::sleep(Duration::from_millis(300));
    signal(&child, "HUP");
    assert_eq!(child.wait().unwrap().code(), Some(129));
    assert!(run.join("checkpoint.safetensors").exists());
}

#[test]
fn a_run_has_its_folder_alone() {
    let (dir, scan) = with_scan();
    let run = dir.path().join("run");
    let mut child = long(&scan, &text(&run), &["--checkpoint-every", "0.05s"]);
    wait_for(&run.join("checkpoint.safetensors"));
    for _ in 0..6 {
        for more in ["--force", "--resume"] {
            let said = refused(1, &words(&fast(&scan, &text(&run), &[more])));
            assert!(said.contains("another conefield is writing"), "{said}");
        }
    }
    assert!(child.try_wait().unwrap().is_none(), "the run goes on");
    signal(&child, "INT");
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(run.join("checkpoint.safetensors").exists());
}

#[test]
fn a_killed_replacement_gives_back_what_it_replaced() {
    let (dir, scan) = with_scan();
    let run = dir.path().join("run");
    done(&words(&fast(&scan, &text(&run), &[])));
    let before = standing(&run);
    let mut child = long(&scan, &text(&run), &["--force", "--checkpoint-every", "1h"]);
    let start = Instant::now();
    while run.join("record.json").exists() && start.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(2));
    }
    signal(&child, "KILL");
    child.wait().unwrap();
    assert!(!run.join("record.json").exists(), "the new run had begun");
    // The next command, though refused, restores the earlier run.
    let said = refused(1, &words(&fast(&scan, &text(&run), &[])));
    assert!(said.contains("an earlier run"), "{said}");
    assert!(standing(&run) == before);
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2, "only the scan and the run");
}

#[test]
fn a_checkpoint_of_which_a_bit_is_changed_is_refused() {
    let (dir, scan) = with_scan();
    let run = dir.path().join("run");
    let mut child = long(&scan, &text(&run), &["--checkpoint-every", "0.05s"]);
    wait_for(&run.join("checkpoint.safetensors"));
    signal(&child, "INT");
    child.wait().unwrap();
    let path = run.join("checkpoint.safetensors");
    let good = fs::read(&path).unwrap();
    let args = ["reconstruct", &scan, "--spec", "fast", "--steps", "4000000", "--set", "training.rays=16", "--resume"];
    let output = text(&run);
    let args = [&args[..], &["-o", &output]].concat();
    let step = b"\\\"step\\\":";
    let at = good.windows(step.len()).position(|w| w == step).unwrap() + step.len();
    let mut bad = good.clone();
    bad[at] ^= 2;
    fs::write(&path, bad).unwrap();
    refused_whole(dir.path(), &args, &["checkpoint.safetensors", "crc32"]);
    // A valid checksum does not make a number a step.
    fs::write(&path, &good).unwrap();
    let mut file = conefield_io::read_checkpoint(&path).unwrap();
    let mut standing: serde_json::Value = serde_json::from_str(&file.notes["standing"]).unwrap();
    standing["step"] = u64::MAX.into();
    file.notes.insert("standing".into(), standing.to_string());
    let tensors: Vec<_> = file.tensors.iter().map(|(name, (shape, values))| (name, shape, &values[..])).collect();
    conefield_io::write_checkpoint(&path, &tensors, &file.notes).unwrap();
    refused_whole(dir.path(), &args, &["step: found 18446744073709551615"]);
}

#[test]
fn what_files_say_does_not_reach_the_terminal_as_it_is() {
    let (dir, scan) = with_scan();
    let at = |n: &str| text(&dir.path().join(n));
    fs::write(at("evil.toml"), "extends = 'fast'\n\"a\\u001b[2Jb\\nerror: forged\" = 1\n").unwrap();
    let said = refused_whole(dir.path(), &["explain", &at("evil.toml")], &["evil.toml:2:1", "an unknown key"]);
    assert!(!said.contains('\u{1b}') && said.contains("\\u{1b}[2Jb\\nerror: forged"), "{said}");
    // The name of a file, too.
    let name = dir.path().join("a\u{1b}]0;b\nerror: c");
    let said = refused_whole(dir.path(), &["info", &text(&name)], &["No such file"]);
    assert!(!said.contains('\u{1b}'), "{said}");
    // A long message loses its middle: the expectation at its end remains.
    let long = format!("extends = 'fast'\n{} = 1\n", "k".repeat(200_000));
    fs::write(at("long.toml"), long).unwrap();
    let said = refused_whole(dir.path(), &["explain", &at("long.toml")], &["long.toml:2:1", "characters left out"]);
    assert!(said.len() < 10_000 && said.contains("an unknown key"), "{}", said.len());
    // Printed results, as text and as JSON.
    let provenance =
        fs::read_to_string(at("scan/scan.toml")).unwrap().replacen("phantom:head:16", "a\\u001b[2J\\u009bb", 1);
    fs::write(at("scan/scan.toml"), provenance).unwrap();
    let said = done(&["info", &scan]);
    let heads: Vec<_> = said.lines().map(|l| l.split_whitespace().next().unwrap_or_default()).take(7).collect();
    assert_eq!(heads, ["views", "source", "arc", "values", "volume", "", "kind"], "{said}");
    assert!(!said.contains(['\u{1b}', '\u{9b}']) && said.contains("a\\u{1b}[2J\\u{9b}b"), "{said}");
    let raw = done(&["info", &scan, "--json"]);
    assert!(!raw.contains(['\u{1b}', '\u{9b}']));
    assert_eq!(json(&["info", &scan, "--json"])["provenance"]["source"], "a\u{1b}[2J\u{9b}b");
}

#[test]
fn a_name_without_utf_8_is_reported_as_such() {
    let (dir, scan) = with_scan();
    let init = dir.path().join(std::ffi::OsStr::from_bytes(b"w\xff.safetensors"));
    fs::write(&init, "x").unwrap();
    let mut command = conefield(&words(&fast(&scan, &text(&dir.path().join("run")), &["--init"])));
    let output = command.arg(&init).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && said.contains("a name in UTF-8"), "{said}");
}

#[test]
fn a_full_disk_is_reported_with_the_requested_name() {
    let (dir, scan) = with_scan();
    for args in [
        vec!["simulate", "phantom:head:16", "-o", &text(&dir.path().join("new"))],
        vec!["convert", &scan, &text(&dir.path().join("new")), "--to", "r2"],
        vec!["convert", &scan, &text(&dir.path().join("new")), "--to", "rtk"],
    ] {
        let args: Vec<String> = args.into_iter().map(str::to_owned).collect();
        let output = shell("trap '' XFSZ; ulimit -f 2; exec \"$0\" --quiet \"$@\"", &args);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(1) && said.contains("new/") && !said.contains(".conefield-"), "{said}");
    }
}

#[test]
fn a_signal_leaves_no_unfinished_file() {
    let dir = tempfile::tempdir().unwrap();
    let data = ndarray::Array3::from_shape_fn((128, 128, 128), |(x, y, z)| ((x * 7 + y * 13 + z * 31) % 101) as f32);
    ndarray_npy::write_npy(dir.path().join("v.npy"), &data).unwrap();
    let program = assert_cmd::cargo::cargo_bin("conefield");
    let names = || {
        let mut all: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        all.sort();
        all
    };
    let mut caught = 0;
    for (name, status) in [("INT", 130), ("TERM", 143), ("INT", 130)] {
        let mut child = Command::new(&program)
            .args(["--quiet", "convert", &text(&dir.path().join("v.npy")), &text(&dir.path().join("o.nii.gz"))])
            .spawn()
            .unwrap();
        let start = Instant::now();
        while names().len() < 2 && start.elapsed() < Duration::from_secs(30) {
            std::thread::sleep(Duration::from_millis(1));
        }
        signal(&child, name);
        let ended = child.wait().unwrap();
        caught += u32::from(ended.code() == Some(status));
        if ended.success() {
            fs::remove_file(dir.path().join("o.nii.gz")).unwrap();
        }
        assert_eq!(names(), ["v.npy"], "{ended}");
    }
    assert!(caught > 0, "no command was interrupted while it wrote");
}

#[test]
fn axes_that_a_format_cannot_hold_are_refused_before_the_work() {
    let (dir, scan) = with_scan();
    let run = text(&dir.path().join("run"));
    done(&words(&fast(&scan, &run, &[])));
    let start = Instant::now();
    let args = ["export", &run, "--voxels", "40000", "-o", &text(&dir.path().join("o.nii"))];
    refused_whole(dir.path(), &args, &["at most 32767 voxels"]);
    let kept = fs::read_to_string(dir.path().join("scan/scan.toml")).unwrap();
    assert!(start.elapsed() < Duration::from_secs(20) && !kept.is_empty());
}

#[test]
fn a_bare_command_proposes_what_to_say() {
    let (dir, scan) = with_scan();
    let said = refused(2, &["reconstruct", &scan, "-o", &text(&dir.path().join("x"))]);
    assert!(said.contains("--budget 60s") && said.contains("--spec"), "{said}");
}

#[test]
fn the_folder_of_a_run_is_described() {
    let (dir, scan) = with_scan();
    let run = text(&dir.path().join("run"));
    done(&words(&fast(&scan, &run, &["--reference", "truth"])));
    let found = json(&["info", &run, "--json"]);
    assert_eq!((found["kind"].as_str(), found["status"].as_str()), (Some("run"), Some("complete")));
    assert!(found["record"]["scores"]["psnr"].is_number(), "{found:#}");
    let said = done(&["info", &run]);
    assert!(said.contains("record.scores.psnr") && said.contains("volume.nii.gz"), "{said}");
    fs::remove_file(Path::new(&run).join("record.json")).unwrap();
    assert!(done(&["info", &run]).contains("before its record was written"));
}

#[test]
fn the_log_has_times_and_hears_its_variable() {
    let (dir, scan) = with_scan();
    let run = dir.path().join("run");
    let output = shell("RUST_LOG=trace \"$0\" \"$@\"", &fast(&scan, &text(&run), &["--checkpoint-every", "1h"]));
    let said = String::from_utf8_lossy(&output.stderr);
    let line = said.lines().find(|l| l.contains("memory: ")).unwrap_or_else(|| panic!("{said}"));
    assert!(line.starts_with("20") && line.contains("Z  INFO memory"), "{line}");
    let output = shell("RUST_LOG=error \"$0\" \"$@\"", &fast(&scan, &text(&run), &["--force"]));
    assert!(output.status.success() && output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn what_a_killed_comparison_had_started_is_waited_for() {
    let (dir, scan) = with_scan();
    let all = dir.path().join("all");
    // Steps of about a second: the run, which ends with the step when its comparison is gone, outlives it. It has a checkpoint,
    // without which it would take its folder away.
    let sets = ["--set", "training.rays=5000", "--set", "projector.samples=800", "--steps", "3"];
    let begin = ["compare", &scan, "--specs", "fast", "-o", &text(&all), "--checkpoint-every", "0.05s"];
    let args = [&begin[..], &sets].concat();
    let mut child = started(&args);
    wait_for(&all.join("fast/checkpoint.safetensors"));
    signal(&child, "KILL");
    child.wait().unwrap();
    let folder = fs::File::open(all.join("fast")).unwrap();
    assert!(folder.try_lock().is_err(), "the run is over already: nothing to wait for");
    drop(folder);
    done(&[&args[..], &["--resume"]].concat());
    assert!(all.join("table.json").exists() && all.join("fast/record.json").exists());
}
