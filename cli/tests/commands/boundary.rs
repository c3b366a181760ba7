//! Inputs are preserved, outputs are replaced only when the new result is complete, a folder has one writer, and text
//! from files does not reach the terminal unescaped.

use crate::common::{Folder, SCAN, number, signal};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::time::{Duration, Instant};

/// Runs of a few steps, of one pass, and of several methods.
const FAST: &str = "reconstruct scan --spec fast --steps 3 --set training.rays=16 -o run";
const FDK: &str = "reconstruct scan --spec fdk -o fdk";
const ALL: &str = "compare scan --specs fdk,sirt -o all --steps 2";

/// A run with very many steps.
const LONG: &str = "reconstruct scan --spec fast --steps 4000000 --set training.rays=16 -o run";

/// Checks that the command is refused with all of `says` and changes nothing.
fn refused_whole(d: &Folder, line: &str, says: &[&str]) -> String {
    let before = d.content("");
    let said = d.refused(1, line);
    assert!(says.iter().all(|s| said.contains(s)), "{line}: {says:?} are not all in: {said}");
    // A comparison also prints messages of its runs.
    assert!(line.starts_with("compare") || said.trim_end().lines().count() == 1, "{said}");
    let after = d.content("");
    assert!(before.keys().eq(after.keys()), "{line}: {:?} became {:?}", before.keys(), after.keys());
    assert!(before == after, "{line} changed a file");
    said
}

#[test]
fn what_is_replaced_is_not_what_is_read() {
    let d = Folder::after(&[SCAN, FAST, FDK, ALL]);
    // Under another name, too.
    std::os::unix::fs::symlink(d.at("run"), d.at("link")).unwrap();
    for (line, name) in [
        (&format!("{FAST} --init run/weights.safetensors")[..], "run"),
        (&format!("{FAST} --init link/weights.safetensors"), ""),
        ("reconstruct scan --spec sirt --init fdk/volume.nii.gz -o fdk", "fdk"),
        ("reconstruct scan --spec sirt --set start=\"fdk/volume.nii.gz\" -o fdk", "fdk"),
        ("reconstruct scan --spec run/spec.toml -o run", ""),
        // A comparison that starts from one of its own runs, and a scan of its own truth.
        ("compare scan --specs sirt --set start=\"all/fdk/volume.nii.gz\" -o all", ""),
        ("simulate scan/truth.nii.gz -o scan", ""),
        ("convert scan scan", ""),
    ] {
        refused_whole(&d, &format!("{line} --force"), &["this command reads", name]);
    }
}

#[test]
fn an_output_is_no_input() {
    let d = Folder::after(&[SCAN, FAST, FDK]);
    // The same file under a valid name.
    std::os::unix::fs::symlink(d.at("run/volume.nii.gz"), d.at("a.png")).unwrap();
    d.put("w.safetensors", "mine");
    for (line, says) in [
        ("info scan --png scan/projections.npy", ["projections.npy", ".png"]),
        ("evaluate run/volume.nii.gz fdk/volume.nii.gz --png run/volume.nii.gz", ["volume.nii.gz", ".png"]),
        ("evaluate run/volume.nii.gz fdk/volume.nii.gz --png a.png", ["a.png", "this command reads"]),
        ("pretrain phantom:head:16 --spec fast -o scan/projections.npy", ["projections.npy", ".safetensors"]),
        ("pretrain phantom:head:16 --spec fast -o w.safetensors", ["w.safetensors", "--force"]),
        ("convert run/volume.nii.gz run/volume.nii.gz --force", ["volume.nii.gz", "this command reads"]),
    ] {
        refused_whole(&d, line, &says);
    }
}

#[test]
fn an_input_that_is_unfit_leaves_the_earlier_run() {
    let d = Folder::after(&[SCAN, FAST, FDK, ALL]);
    // A truncated volume is read only after the run has begun.
    d.done("convert scan/truth.nii.gz v.npy");
    let whole = d.bytes("v.npy");
    d.put("half.npy", &whole[..whole.len() / 2]);
    ndarray_npy::write_npy(d.at("empty.npy"), &ndarray::Array3::<f32>::zeros((16, 16, 16))).unwrap();
    d.done("simulate empty.npy -o zero --views 8 --detector 16x16");
    let zero = FAST.replace("scan", "zero");
    refused_whole(&d, &format!("{FAST} --init half.npy --force"), &["half.npy"]);
    refused_whole(&d, &format!("{zero} --force"), &[]);
    refused_whole(&d, "compare zero --specs fast -o all --force", &["fast"]);
    // Without --force a refusal leaves nothing behind, so that the next attempt does not need it.
    refused_whole(&d, &zero.replace("run", "new"), &[]);
    d.done(&FAST.replace("run", "new"));
    // A valid result replaces the earlier one and leaves nothing else behind.
    d.done(&format!("{FAST} --force"));
    d.done("compare scan --specs fdk -o all --force");
    assert!(!d.has("all/sirt"));
    let hidden = |folder: &str| d.names(folder).iter().any(|name| name.starts_with('.'));
    assert!(!hidden("") && !hidden("run") && !hidden("all"));
}

#[test]
fn a_log_that_nobody_reads_ends_no_run() {
    let d = Folder::after(&[SCAN]);
    for (name, script) in [
        ("head", "\"$0\" \"$@\" 2>&1 | head -1"),
        ("dead-reader", "{ \"$0\" \"$@\"; echo $? >&3; } 3>&1 2>&1 >/dev/null | true"),
        ("closed", "\"$0\" \"$@\" 2>&-"),
        ("full", "\"$0\" \"$@\" 2>/dev/full"),
    ] {
        let run = FAST.replace("run", name);
        let output = d.shell(script, &format!("{run} -v"));
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !said.contains("panicked"), "{name}: {said}");
        assert!(d.at(name).join("record.json").exists(), "{name}");
        // A failure has its own status, even if its message cannot be written.
        let alone = script.replace(" | true", "").replace(" | head -1", "");
        let output = d.shell(&alone, &run.replace("scan", "nowhere"));
        assert!(name == "dead-reader" || output.status.code() == Some(1), "{name}: {:?}", output.status);
    }
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
    let d = Folder::after(&[SCAN]);
    let mut child = d.started(&format!("{LONG} --checkpoint-every 1h"));
    d.wait_for("run/metrics.jsonl");
    std::thread::sleep(Duration::from_millis(300));
    signal(&child, "HUP");
    assert_eq!(child.wait().unwrap().code(), Some(129));
    assert!(d.has("run/checkpoint.safetensors"));
}

#[test]
fn a_run_has_its_folder_alone() {
    let d = Folder::after(&[SCAN]);
    let mut child = d.started(&format!("{LONG} --checkpoint-every 0.05s"));
    d.wait_for("run/checkpoint.safetensors");
    for _ in 0..6 {
        for more in ["--force", "--resume"] {
            d.refused_with(1, &format!("{FAST} {more}"), &["another conefield is writing"]);
        }
    }
    assert!(child.try_wait().unwrap().is_none(), "the run goes on");
    signal(&child, "INT");
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(d.has("run/checkpoint.safetensors"));
}

#[test]
fn a_killed_replacement_gives_back_what_it_replaced() {
    let d = Folder::after(&[SCAN, FAST]);
    let before = d.content("run");
    let mut child = d.started(&format!("{LONG} --force --checkpoint-every 1h"));
    let start = Instant::now();
    while d.has("run/record.json") && start.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(2));
    }
    signal(&child, "KILL");
    child.wait().unwrap();
    assert!(!d.has("run/record.json"), "the new run had begun");
    // The next command, though refused, restores the earlier run.
    d.refused_with(1, FAST, &["an earlier run"]);
    assert!(d.content("run") == before);
    assert_eq!(d.names(""), ["run", "scan"]);
}

#[test]
fn a_checkpoint_of_which_a_bit_is_changed_is_refused() {
    let d = Folder::after(&[SCAN]);
    let saved = || d.filled("run/checkpoint.safetensors");
    d.interrupted(&format!("{LONG} --checkpoint-every 0.05s"), "INT", &saved);
    let (path, resume) = (d.at("run/checkpoint.safetensors"), format!("{LONG} --resume"));
    let good = d.bytes(&path);
    let step = b"\\\"step\\\":";
    let at = good.windows(step.len()).position(|w| w == step).unwrap() + step.len();
    let mut bad = good.clone();
    bad[at] ^= 2;
    d.put(&path, bad);
    refused_whole(&d, &resume, &["checkpoint.safetensors", "crc32"]);
    // A valid checksum does not make a number a step.
    d.put(&path, &good);
    let mut file = conefield_io::read_checkpoint(&path).unwrap();
    let mut standing: serde_json::Value = serde_json::from_str(&file.notes["standing"]).unwrap();
    standing["step"] = u64::MAX.into();
    file.notes.insert("standing".into(), standing.to_string());
    let tensors = file.tensors.iter().map(|(name, (shape, values))| (&name[..], &shape[..], &values[..]));
    conefield_io::write_checkpoint(&path, &tensors.collect::<Vec<_>>(), &file.notes).unwrap();
    refused_whole(&d, &resume, &["step: found 18446744073709551615"]);
}

#[test]
fn what_files_say_does_not_reach_the_terminal_as_it_is() {
    let d = Folder::after(&[SCAN]);
    d.put("evil.toml", "extends = 'fast'\n\"a\\u001b[2Jb\\nerror: forged\" = 1\n");
    let said = refused_whole(&d, "explain evil.toml", &["evil.toml:2:1", "an unknown key"]);
    assert!(!said.contains('\u{1b}') && said.contains("\\u{1b}[2Jb\\nerror: forged"), "{said}");
    // The name of a file, too.
    let said = refused_whole(&d, "info 'a\u{1b}]0;b\nerror: c'", &["No such file"]);
    assert!(!said.contains('\u{1b}'), "{said}");
    // A long message loses its middle: the expectation at its end remains.
    d.put("long.toml", format!("extends = 'fast'\n{} = 1\n", "k".repeat(200_000)));
    let said = refused_whole(&d, "explain long.toml", &["long.toml:2:1", "characters left out"]);
    assert!(said.len() < 10_000 && said.contains("an unknown key"), "{}", said.len());
    // Printed results, as text and as JSON.
    d.put("scan/scan.toml", d.text("scan/scan.toml").replacen("phantom:head:16", "a\\u001b[2J\\u009bb", 1));
    let said = d.done("info scan");
    let heads: Vec<_> = said.lines().map(|l| l.split_whitespace().next().unwrap_or_default()).take(7).collect();
    assert_eq!(heads, ["views", "source", "arc", "values", "volume", "", "kind"], "{said}");
    assert!(!said.contains(['\u{1b}', '\u{9b}']) && said.contains("a\\u{1b}[2J\\u{9b}b"), "{said}");
    let raw = d.done("info scan --json");
    assert!(!raw.contains(['\u{1b}', '\u{9b}']));
    let found: serde_json::Value = serde_json::from_str(&raw).unwrap();
    assert_eq!(found["provenance"]["source"], "a\u{1b}[2J\u{9b}b");
}

#[test]
fn a_field_in_trouble_is_a_warning() {
    let d = Folder::after(&[SCAN]);
    let output = d.loud(&FAST.replace("--steps 3", "--steps 30 --set optimizer.lr=30")).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.lines().any(|line| line.contains("WARN") && line.contains("rolled back to step")), "{said}");
}

#[test]
fn a_name_without_utf_8_is_reported_as_such() {
    let d = Folder::after(&[SCAN]);
    let init = std::ffi::OsStr::from_bytes(b"w\xff.safetensors");
    d.put(init, "x");
    let output = d.command(&format!("{FAST} --init")).arg(init).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && said.contains("a name in UTF-8"), "{said}");
}

#[test]
fn an_output_without_utf_8_gets_its_table() {
    let d = Folder::after(&[SCAN]);
    d.put("study.toml", "scans = ['scan']\nspecs = ['fdk', 'sirt']\n[protocol]\nsteps = 2\n");
    for (line, out) in
        [("compare scan --specs fdk,sirt --steps 2 -o", b"compared\xff"), ("study study.toml -o", b"studied_\xff")]
    {
        let out = std::ffi::OsStr::from_bytes(out);
        let output = d.command(line).arg(out).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(d.at(out).join("table.json").is_file(), "{line}");
    }
}

#[test]
fn a_signal_leaves_no_unfinished_file() {
    let d = Folder::new();
    let data = ndarray::Array3::from_shape_fn((128, 128, 128), |(x, y, z)| ((x * 7 + y * 13 + z * 31) % 101) as f32);
    ndarray_npy::write_npy(d.at("v.npy"), &data).unwrap();
    let mut caught = 0;
    for (name, status) in [("INT", 130), ("TERM", 143), ("INT", 130)] {
        let mut child = d.started("convert v.npy o.nii.gz");
        let start = Instant::now();
        while d.names("").len() < 2 && start.elapsed() < Duration::from_secs(30) {
            std::thread::sleep(Duration::from_millis(1));
        }
        signal(&child, name);
        let ended = child.wait().unwrap();
        caught += u32::from(ended.code() == Some(status));
        if ended.success() {
            fs::remove_file(d.at("o.nii.gz")).unwrap();
        }
        assert_eq!(d.names(""), ["v.npy"], "{ended}");
    }
    assert!(caught > 0, "no command was interrupted while it wrote");
}

#[test]
fn axes_that_a_format_cannot_hold_are_refused_before_the_work() {
    let d = Folder::after(&[SCAN, FAST]);
    let start = Instant::now();
    refused_whole(&d, "export run --voxels 40000 -o o.nii", &["at most 32767 voxels"]);
    assert!(start.elapsed() < Duration::from_secs(20));
}

#[test]
fn the_folder_of_a_run_is_described() {
    let d = Folder::after(&[SCAN, FAST]);
    let found = d.json("info run --json");
    assert_eq!((found["kind"].as_str(), found["status"].as_str()), (Some("run"), Some("complete")));
    assert!(number(&found["record"]["loss"]) > 0.0, "{found:#}");
    let said = d.done("info run");
    assert!(said.contains("record.loss") && said.contains("volume.nii.gz"), "{said}");
    fs::remove_file(d.at("run/record.json")).unwrap();
    assert!(d.done("info run").contains("before its record was written"));
}

#[test]
fn the_log_has_times_and_hears_its_variable() {
    let d = Folder::after(&[SCAN]);
    let output = d.shell("RUST_LOG=trace \"$0\" \"$@\"", &format!("{FAST} --checkpoint-every 1h"));
    let said = String::from_utf8_lossy(&output.stderr);
    let line = said.lines().find(|l| l.contains("memory: ")).unwrap_or_else(|| panic!("{said}"));
    assert!(line.starts_with("20") && line.contains("Z  INFO memory"), "{line}");
    let output = d.shell("RUST_LOG=error \"$0\" \"$@\"", &format!("{FAST} --force"));
    assert!(output.status.success() && output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn what_a_killed_comparison_had_started_is_waited_for() {
    let d = Folder::after(&[SCAN]);
    // Steps of about a second: the run, which ends with the step when its comparison is gone, outlives it. It has a checkpoint,
    // without which it would take its folder away.
    let slow = "--set training.rays=5000 --set projector.samples=800 --steps 3 --checkpoint-every 0.05s";
    let line = format!("compare scan --specs fast -o all {slow}");
    let mut child = d.started(&line);
    d.wait_for("all/fast/checkpoint.safetensors");
    signal(&child, "KILL");
    child.wait().unwrap();
    let folder = fs::File::open(d.at("all/fast")).unwrap();
    assert!(folder.try_lock().is_err(), "the run is over already: nothing to wait for");
    drop(folder);
    d.done(&format!("{line} --resume"));
    assert!(d.has("all/table.json") && d.has("all/fast/record.json"));
}
