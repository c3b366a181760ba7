//! Arrays beyond the memory limit: the same bits from less memory, clear refusals, and nothing left behind.
#![cfg(target_os = "linux")]

use crate::common::text;
use crate::memory::scan_of;
use std::fs;
use std::thread::sleep;
use std::time::Duration;

const LIMIT: u64 = 256 << 20;

/// Runs `spec` with and without a limit. Its volume is the same, and the limited run stays below the limit. `explain`
/// says how often what is `read`.
fn the_same_in_less_memory(spec: &str, [views, side, voxels]: [usize; 3], more: &str, read: &str) {
    let d = scan_of(views, side, voxels);
    let run = |name: &str, more: &str| d.json(&format!("reconstruct scan --spec {spec} -o {name} --json {more}"));
    let (free, limited) = (run("free", more), run("limited", &format!("{more} --memory 256MiB")));
    assert!(d.bytes("free/volume.nii.gz") == d.bytes("limited/volume.nii.gz"), "{spec}: a limit changed the volume");
    let peaks = [&free, &limited].map(|r| r["peak_bytes"].as_u64().unwrap());
    println!("{spec}: {} MiB without a limit, {} MiB with one", peaks[0] >> 20, peaks[1] >> 20);
    assert!(peaks[0] > LIMIT && free["memory"]["total"].as_u64().unwrap() > LIMIT, "{spec} needs no limit: {peaks:?}");
    assert!(peaks[1] <= LIMIT, "{spec}: {peaks:?}");
    let explain = |limit: &str| d.done(&format!("explain {spec} --scan scan --memory {limit}"));
    let (little, enough) = (explain("256MiB"), explain("8GiB"));
    assert!(little.contains("it stays below 256 MiB") && little.contains(read), "{little}");
    assert!(!enough.contains("it stays below") && !enough.contains(read), "{enough}");
}

#[test]
fn an_iterative_method_gives_the_same_bits() {
    the_same_in_less_memory("fista-tv", [6, 48, 272], "--steps 1", "once for each of the 6 subsets");
}

#[test]
fn fdk_gives_the_same_bits_slab_by_slab() {
    the_same_in_less_memory("fdk", [28, 1024, 330], "", "the views are read 2 times");
}

/// A run that needs more than its limit.
const RUN: &str = "reconstruct scan --spec fista-tv -o run --memory 256MiB";

#[test]
fn a_folder_that_takes_no_files_is_refused_before_the_scan_is_read() {
    let d = scan_of(6, 48, 272);
    for folder in ["/proc", "/nowhere/at/all"] {
        d.refuses("run/spec.toml", &[(&format!("{RUN} --scratch {folder}"), folder)]);
    }
    // A disk that is too full; here files may not exceed 1 MiB.
    let run = d.at("run");
    let line = RUN.replace("-o run", &format!("-o {}", text(&run)));
    let output = d.shell("ulimit -f 1024; trap '' XFSZ; exec \"$0\" \"$@\"", &line);
    let found = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{found}");
    assert!(found.contains(&text(run.parent().unwrap())) && found.to_lowercase().contains("large"), "{found}");
    assert!(!d.has("run/spec.toml"), "nothing was begun");
}

#[test]
fn a_killed_run_leaves_no_scratch_files() {
    let d = scan_of(6, 48, 272);
    fs::create_dir(d.at("scratch")).unwrap();
    let mut child = d.started(&format!("{RUN} --scratch scratch"));
    let (maps, scratch) = (format!("/proc/{}/maps", child.id()), text(&d.at("scratch").canonicalize().unwrap()));
    let mut mapped = false;
    for _ in 0..600 {
        mapped |= fs::read_to_string(&maps).unwrap_or_default().contains(&scratch);
        if mapped {
            break;
        }
        sleep(Duration::from_millis(50));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(mapped, "no array went to the folder");
    assert_eq!(d.names("scratch"), [""; 0], "files are left");
    // The run can be started anew.
    d.done("reconstruct scan --spec fdk -o run --force");
}
