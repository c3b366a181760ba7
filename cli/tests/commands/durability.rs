//! Files appear complete or not at all: a writer that may not write, has no room or is killed leaves the earlier file
//! unchanged and no partial file, and names the file.

use crate::common::{done, text};
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

fn program() -> PathBuf {
    assert_cmd::cargo::cargo_bin("conefield")
}

/// Names below `folder`, sorted.
fn names(folder: &Path) -> Vec<String> {
    let mut all: Vec<String> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    all.sort();
    all
}

/// The command in a shell after the commands `before`.
fn after(before: &str, args: &[&str]) -> Output {
    let script = format!("{before}; exec \"$0\" --quiet --threads 2 \"$@\"");
    Command::new("sh").args(["-c", &script]).arg(program()).args(args).output().unwrap()
}

/// Checks that `output` is a failure with one line that contains `words`.
fn failed(output: &Output, words: &[&str]) {
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.starts_with("error: ") && said.trim_end().lines().count() == 1, "{said}");
    assert!(words.iter().all(|w| said.contains(w)), "{words:?} are not all in: {said}");
}

/// Every output format: the arguments before the output's name, and that name.
fn writers(dir: &Path) -> Vec<(Vec<String>, &'static str)> {
    let at = |n: &str| text(&dir.join(n));
    done(&["simulate", "phantom:head:24", "-o", &at("scan"), "--views", "4", "--detector", "24x24"]);
    done(&["convert", &at("scan/truth.nii.gz"), &at("v.npy")]);
    let words = |w: &[&str]| w.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>();
    let mut all: Vec<_> = ["out.nii", "out.nii.gz", "out.mha", "out.npy"]
        .map(|name| (words(&["convert", &at("v.npy"), "--force"]), name))
        .into();
    all.push((words(&["convert", &at("scan"), "--to", "naf", "--force"]), "out.pickle"));
    all.push((words(&["convert", &at("scan"), "--to", "r2", "--force"]), "out.r2"));
    all.push((words(&["convert", &at("scan"), "--to", "conefield", "--force"]), "out.scan"));
    let weights = [
        "pretrain", "phantom:head:16", "--spec", "naf", "--steps", "1", "--set", "encoder.log2_table_size=12",
        "--force", "-o",
    ];
    all.push((words(&weights), "out.safetensors"));
    all.push((words(&["evaluate", &at("v.npy"), &at("v.npy"), "--png"]), "out.png"));
    all
}

/// All files below `path` with their content.
fn content(path: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    if path.is_file() {
        return vec![(path.to_path_buf(), fs::read(path).unwrap())];
    }
    names(path).iter().flat_map(|n| content(&path.join(n))).collect()
}

#[test]
fn a_disk_without_room_leaves_the_earlier_file_whole() {
    let dir = tempfile::tempdir().unwrap();
    for (args, name) in writers(dir.path()) {
        let folder = dir.path().join(format!("folder of {name}"));
        fs::create_dir(&folder).unwrap();
        let path = text(&folder.join(name));
        let args: Vec<&str> = args.iter().map(String::as_str).chain([path.as_str()]).collect();
        // The limit on a file's length (512 or 1024 bytes per block) lets a write fail half-way, like a full disk. Its
        // signal is ignored, so that the write itself fails.
        let no_room = "trap '' XFSZ; ulimit -f 2";
        failed(&after(no_room, &args), &["File too large"]);
        assert_eq!(names(&folder), [""; 0], "{name}: a first attempt leaves nothing");
        done(&args);
        let before = content(&folder);
        failed(&after(no_room, &args), &["File too large"]);
        assert_eq!((names(&folder), content(&folder)), (vec![name.to_owned()], before), "{name}");
    }
}

#[test]
fn a_run_without_room_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let (scan, run) = (text(&dir.path().join("scan")), dir.path().join("run"));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "4", "--detector", "16x16"]);
    let to = text(&run);
    let args =
        ["reconstruct", &scan, "--spec", "naf", "--set", "encoder.log2_table_size=12", "--steps", "2", "-o", &to];
    failed(&after("trap '' XFSZ; ulimit -f 16", &args), &["run/", "File too large"]);
    assert!(!run.exists(), "what came to nothing leaves nothing");
    // Room for the volume but not for a checkpoint: a result needs none.
    let args = ["reconstruct", &scan, "--spec", "fista-tv", "--steps", "3", "--checkpoint-every", "0.001s", "-o", &to];
    let output = after("trap '' XFSZ; ulimit -f 64", &args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(run.join("volume.nii.gz").is_file() && run.join("record.json").is_file());
    // Standard output that is full.
    failed(&after("exec >/dev/full", &["info", &scan]), &["standard output", "No space left"]);
}

#[test]
fn a_folder_that_may_not_be_written_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let locked = dir.path().join("locked");
    let all = writers(dir.path());
    fs::create_dir(&locked).unwrap();
    for path in [dir.path(), &locked] {
        fs::set_permissions(path, fs::Permissions::from_mode(0o555)).unwrap();
    }
    // The superuser ignores permissions: the command then runs as another user.
    let mut other = vec![];
    if fs::write(locked.join("probe"), "").is_ok() {
        fs::remove_file(locked.join("probe")).unwrap();
        other = vec!["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"];
        let can = Command::new(other[0]).args(&other[1..]).arg(program()).arg("backends").output();
        if !can.is_ok_and(|o| o.status.success()) {
            return eprintln!("skipped: this is the superuser, and the command cannot be run as another one");
        }
    }
    for (args, name) in all {
        let path = text(&locked.join(name));
        let program = text(&program());
        let words = other.iter().copied().chain([program.as_str(), "--quiet"]);
        let words: Vec<&str> = words.chain(args.iter().map(String::as_str)).chain([path.as_str()]).collect();
        let output = Command::new(words[0]).args(&words[1..]).output().unwrap();
        failed(&output, &[&path, "Permission denied"]);
        assert_eq!(names(&locked), [""; 0], "{name}");
    }
    fs::set_permissions(dir.path(), fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
fn a_killed_writer_leaves_the_earlier_file_whole() {
    let dir = tempfile::tempdir().unwrap();
    let at = |n: &str| text(&dir.path().join(n));
    done(&["convert", &at_phantom(dir.path()), &at("out.nii.gz")]);
    let before = fs::read(at("out.nii.gz")).unwrap();
    let mut caught = 0;
    for _ in 0..20 {
        let mut writer = Command::new(program())
            .args(["--quiet", "convert", &at("v.npy"), &at("out.nii.gz"), "--force"])
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        // Killed as soon as the unfinished file exists.
        let start = Instant::now();
        let begun = || names(dir.path()).iter().any(|n| n.starts_with(".conefield-"));
        while !begun() && writer.try_wait().unwrap().is_none() && start.elapsed() < Duration::from_secs(20) {
            std::thread::yield_now();
        }
        writer.kill().unwrap();
        writer.wait().unwrap();
        assert_eq!(fs::read(at("out.nii.gz")).unwrap(), before);
        caught += u32::from(begun());
        for left in names(dir.path()).iter().filter(|n| conefield_io::is_unfinished(n.as_ref())) {
            fs::remove_file(dir.path().join(left)).unwrap();
        }
    }
    assert_eq!(names(dir.path()), ["out.nii.gz", "v.npy"], "unfinished files are recognized by their names");
    assert!(caught > 0, "no writer was killed while it wrote");
}

/// A volume that takes a while to compress, as `v.npy`.
fn at_phantom(dir: &Path) -> String {
    let data = ndarray::Array3::from_shape_fn((96, 96, 96), |(x, y, z)| ((x * 7 + y * 13 + z * 31) % 101) as f32);
    let path = dir.join("v.npy");
    ndarray_npy::write_npy(&path, &data).unwrap();
    text(&path)
}

#[test]
fn what_is_written_is_on_the_disk_before_it_gets_its_name() {
    let dir = tempfile::tempdir().unwrap();
    let trace = dir.path().join("trace");
    let log = text(&trace);
    let from = at_phantom(dir.path());
    let traced = Command::new("strace")
        .args(["-f", "-e", "trace=fsync,fdatasync,rename,renameat,renameat2", "-o", &log])
        .arg(program())
        .args(["--quiet", "convert", &from, &text(&dir.path().join("out.nii"))])
        .output();
    if !traced.is_ok_and(|o| o.status.success()) {
        return eprintln!("skipped: strace cannot be run here");
    }
    let log = fs::read_to_string(trace).unwrap();
    let calls: Vec<&str> = log.lines().filter_map(|l| l.split_whitespace().nth(1)?.split('(').next()).collect();
    let renamed = calls.iter().position(|c| c.starts_with("rename")).expect("a rename");
    assert!(calls[..renamed].iter().any(|c| c.contains("sync")), "synced before: {log}");
    assert!(calls[renamed..].iter().any(|c| c.contains("sync")), "the folder after: {log}");
}
