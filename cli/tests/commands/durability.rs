//! Files appear complete or not at all: a writer that may not write, has no room or is killed leaves the earlier file
//! unchanged and no partial file, and names the file.

use crate::common::{Folder, program, text};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

/// The command of a line in a shell after the commands `before`.
fn after(d: &Folder, before: &str, line: &str) -> Output {
    d.shell(&format!("{before}; exec \"$0\" --quiet --threads 2 \"$@\""), line)
}

/// Checks that `output` is a failure with one line that contains `words`.
fn failed(output: &Output, words: &[&str]) {
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.starts_with("error: ") && said.trim_end().lines().count() == 1, "{said}");
    assert!(words.iter().all(|w| said.contains(w)), "{words:?} are not all in: {said}");
    assert!(!said.contains(".conefield-"), "a temporary name: {said}");
}

/// Every output format: the command before the output's name, and that name.
const WRITERS: [(&str, &str); 10] = [
    ("convert v.npy --force", "out.nii"),
    ("convert v.npy --force", "out.nii.gz"),
    ("convert v.npy --force", "out.mha"),
    ("convert v.npy --force", "out.npy"),
    ("convert scan --to naf --force", "out.pickle"),
    ("convert scan --to r2 --force", "out.r2"),
    ("convert scan --to rtk --force", "out.rtk"),
    ("convert scan --to conefield --force", "out.scan"),
    ("pretrain phantom:head:16 --spec naf --steps 1 --set encoder.log2_table_size=12 --force -o", "out.safetensors"),
    ("evaluate v.npy v.npy --png", "out.png"),
];

/// A folder with what they read.
fn inputs() -> Folder {
    Folder::after(&["simulate phantom:head:24 -o scan --views 4 --detector 24x24", "convert scan/truth.nii.gz v.npy"])
}

#[test]
fn a_disk_without_room_leaves_the_earlier_file_whole() {
    let d = inputs();
    for (line, name) in WRITERS {
        let folder = format!("folder-of-{name}");
        fs::create_dir(d.at(&folder)).unwrap();
        let line = format!("{line} {folder}/{name}");
        // The limit on a file's length (512 or 1024 bytes per block) lets a write fail half-way, like a full disk. Its
        // signal is ignored, so that the write itself fails.
        let no_room = "trap '' XFSZ; ulimit -f 2";
        failed(&after(&d, no_room, &line), &[name, "File too large"]);
        assert_eq!(d.names(&folder), [""; 0], "{name}: a first attempt leaves nothing");
        d.done(&line);
        let before = d.content(&folder);
        failed(&after(&d, no_room, &line), &[name, "File too large"]);
        assert_eq!(d.names(&folder), [name]);
        assert!(d.content(&folder) == before, "{name}");
    }
}

#[test]
fn a_run_without_room_says_so() {
    let d = Folder::after(&["simulate phantom:head:16 -o scan --views 4 --detector 16x16"]);
    let line = "reconstruct scan --spec naf --set encoder.log2_table_size=12 --steps 2 -o run";
    failed(&after(&d, "trap '' XFSZ; ulimit -f 16", line), &["run/", "File too large"]);
    assert!(!d.has("run"), "what came to nothing leaves nothing");
    // Room for the volume but not for a checkpoint: a result needs none.
    let line = "reconstruct scan --spec fista-tv --steps 3 --checkpoint-every 0.001s -o run";
    let output = after(&d, "trap '' XFSZ; ulimit -f 64", line);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(d.has("run/volume.nii.gz") && d.has("run/record.json"));
    // Standard output that is full.
    failed(&after(&d, "exec >/dev/full", "info scan"), &["standard output", "No space left"]);
}

/// What runs a command as a user who may not write the folder `locked`: the superuser ignores permissions.
fn user(d: &Folder, locked: &str) -> Option<&'static str> {
    let probe = d.at(locked).join("probe");
    if fs::write(&probe, "").is_err() {
        return Some("");
    }
    fs::remove_file(probe).unwrap();
    let other = "setpriv --reuid=65534 --regid=65534 --clear-groups ";
    let runs = d.shell(&format!("{other} \"$0\" \"$@\""), "backends").status.success();
    if !runs {
        eprintln!("skipped: this is the superuser, and the command cannot be run as another one");
    }
    runs.then_some(other)
}

#[test]
fn a_folder_that_may_not_be_moved_leaves_nothing_beside_it() {
    let d = inputs();
    d.done("reconstruct scan --spec fdk -o kept");
    for (name, mode) in [("", 0o777), ("kept", 0o555)] {
        fs::set_permissions(d.at(name), fs::Permissions::from_mode(mode)).unwrap();
    }
    let Some(other) = user(&d, "kept") else { return };
    let before = d.names("");
    let line = "reconstruct scan --spec fdk -o kept --force";
    failed(&d.shell(&format!("exec {other}\"$0\" --quiet \"$@\""), line), &["kept", "Permission denied"]);
    assert_eq!(d.names(""), before);
    fs::set_permissions(d.at("kept"), fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
fn a_folder_that_may_not_be_written_is_named() {
    let d = inputs();
    fs::create_dir(d.at("locked")).unwrap();
    for path in [d.at(""), d.at("locked")] {
        fs::set_permissions(path, fs::Permissions::from_mode(0o555)).unwrap();
    }
    let Some(other) = user(&d, "locked") else { return };
    for (line, name) in WRITERS {
        let path = text(&d.at("locked").join(name));
        let output = d.shell(&format!("exec {other}\"$0\" --quiet \"$@\""), &format!("{line} {path}"));
        failed(&output, &[&path, "Permission denied"]);
        assert_eq!(d.names("locked"), [""; 0], "{name}");
    }
    fs::set_permissions(d.at(""), fs::Permissions::from_mode(0o755)).unwrap();
}

/// A volume that takes a while to compress, as `v.npy`.
fn slow() -> Folder {
    let d = Folder::new();
    let data = ndarray::Array3::from_shape_fn((96, 96, 96), |(x, y, z)| ((x * 7 + y * 13 + z * 31) % 101) as f32);
    ndarray_npy::write_npy(d.at("v.npy"), &data).unwrap();
    d
}

#[test]
fn a_killed_writer_leaves_the_earlier_file_whole() {
    let d = slow();
    d.done("convert v.npy out.nii.gz");
    let before = d.bytes("out.nii.gz");
    let mut caught = 0;
    for _ in 0..20 {
        let mut writer = d.started("convert v.npy out.nii.gz --force");
        // Killed as soon as the unfinished file exists.
        let start = Instant::now();
        let begun = || d.names("").iter().any(|n| n.starts_with(".conefield-"));
        while !begun() && writer.try_wait().unwrap().is_none() && start.elapsed() < Duration::from_secs(20) {
            std::thread::yield_now();
        }
        writer.kill().unwrap();
        writer.wait().unwrap();
        assert_eq!(d.bytes("out.nii.gz"), before);
        caught += u32::from(begun());
        for left in d.names("").iter().filter(|n| conefield_io::is_unfinished(n.as_ref())) {
            fs::remove_file(d.at(left)).unwrap();
        }
    }
    assert_eq!(d.names(""), ["out.nii.gz", "v.npy"], "unfinished files are recognized by their names");
    assert!(caught > 0, "no writer was killed while it wrote");
}

#[test]
fn what_is_written_is_on_the_disk_before_it_gets_its_name() {
    let d = slow();
    let traced = Command::new("strace")
        .current_dir(d.at(""))
        .args(["-f", "-e", "trace=fsync,fdatasync,rename,renameat,renameat2", "-o", "trace"])
        .arg(program())
        .args(["--quiet", "convert", "v.npy", "out.nii"])
        .output();
    if !traced.is_ok_and(|o| o.status.success()) {
        return eprintln!("skipped: strace cannot be run here");
    }
    let log = d.text("trace");
    let calls: Vec<&str> = log.lines().filter_map(|l| l.split_whitespace().nth(1)?.split('(').next()).collect();
    let renamed = calls.iter().position(|c| c.starts_with("rename")).expect("a rename");
    assert!(calls[..renamed].iter().any(|c| c.contains("sync")), "synced before: {log}");
    assert!(calls[renamed..].iter().any(|c| c.contains("sync")), "the folder after: {log}");
}
