//! Arrays beyond the memory limit: the same bits from less memory, clear refusals, and nothing left behind.
#![cfg(target_os = "linux")]

use crate::common::{done, json, refused, started, text};
use crate::memory::scan_of;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::thread::sleep;
use std::time::Duration;

const LIMIT: u64 = 256 << 20;

/// Runs `spec` with and without a limit. Its volume is the same, and the limited run stays below the limit. `explain`
/// says how often what is `read`.
fn the_same_in_less_memory(spec: &str, [views, side, voxels]: [usize; 3], more: &[&str], read: &str) {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    let scan = text(&scan_of(dir.path(), views, side, voxels));
    let run = |name: &str, limit: &[&str]| {
        json(&[&["reconstruct", &scan, "--spec", spec, "-o", &at(name), "--json"], more, limit].concat())
    };
    let (free, limited) = (run("free", &[]), run("limited", &["--memory", "256MiB"]));
    let volume = |name: &str| fs::read(dir.path().join(name).join("volume.nii.gz")).unwrap();
    assert!(volume("free") == volume("limited"), "{spec}: a limit changed the volume");
    let peaks = [&free, &limited].map(|r| r["peak_bytes"].as_u64().unwrap());
    println!("{spec}: {} MiB without a limit, {} MiB with one", peaks[0] >> 20, peaks[1] >> 20);
    assert!(peaks[0] > LIMIT && free["memory"]["total"].as_u64().unwrap() > LIMIT, "{spec} needs no limit: {peaks:?}");
    assert!(peaks[1] <= LIMIT, "{spec}: {peaks:?}");
    let explain = |limit: &str| done(&["explain", spec, "--scan", &scan, "--memory", limit]);
    let (little, enough) = (explain("256MiB"), explain("8GiB"));
    assert!(little.contains("it stays below 256 MiB") && little.contains(read), "{little}");
    assert!(!enough.contains("it stays below") && !enough.contains(read), "{enough}");
}

#[test]
fn an_iterative_method_gives_the_same_bits() {
    the_same_in_less_memory("fista-tv", [6, 48, 272], &["--steps", "1"], "once for each of the 6 subsets");
}

#[test]
fn fdk_gives_the_same_bits_slab_by_slab() {
    the_same_in_less_memory("fdk", [28, 1024, 330], &[], "the views are read 2 times");
}

#[test]
fn a_folder_that_takes_no_files_is_refused_before_the_scan_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let scan = text(&scan_of(dir.path(), 6, 48, 272));
    let run = text(&dir.path().join("run"));
    let args = ["reconstruct", &scan, "--spec", "fista-tv", "-o", &run, "--memory", "256MiB", "--scratch"];
    for (folder, said) in [("/proc", "/proc"), ("/nowhere/at/all", "/nowhere/at/all")] {
        let found = refused(1, &[&args[..], &[folder]].concat());
        assert!(found.contains(said), "{found}");
    }
    // A disk that is too full; here files may not exceed 1 MiB.
    let output = Command::new("sh")
        .args(["-c", "ulimit -f 1024; trap '' XFSZ; exec \"$0\" \"$@\""])
        .arg(assert_cmd::cargo::cargo_bin("conefield"))
        .args(&args[..args.len() - 1])
        .output()
        .unwrap();
    let found = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{found}");
    assert!(found.contains(&text(dir.path())) && found.to_lowercase().contains("large"), "{found}");
    assert!(!Path::new(&run).join("spec.toml").exists(), "nothing was begun");
}

#[test]
fn a_killed_run_leaves_no_scratch_files() {
    let dir = tempfile::tempdir().unwrap();
    let scan = text(&scan_of(dir.path(), 6, 48, 272));
    let (run, scratch) = (dir.path().join("run"), dir.path().join("scratch"));
    fs::create_dir(&scratch).unwrap();
    let args = ["reconstruct", &scan, "--spec", "fista-tv", "-o", &text(&run), "--memory", "256MiB"];
    let mut child = started(&[&args[..], &["--scratch", &text(&scratch)]].concat());
    let maps = format!("/proc/{}/maps", child.id());
    let mut mapped = false;
    for _ in 0..600 {
        mapped |= fs::read_to_string(&maps).unwrap_or_default().contains(&text(&scratch));
        if mapped {
            break;
        }
        sleep(Duration::from_millis(50));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(mapped, "no array went to the folder");
    assert_eq!(fs::read_dir(&scratch).unwrap().count(), 0, "files are left");
    // The run can be started anew.
    done(&["reconstruct", &scan, "--spec", "fdk", "-o", &text(&run), "--force"]);
}
