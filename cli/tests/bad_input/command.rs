//! Values on the command line, and the small files that they may name.

use crate::case::{Case, End, put, refused, table, then};
use conefield_tests::hostile::seeds::{nifti, npy_bytes, scan_toml};
use std::path::Path;

fn none(_: &Path) {}

/// A volume of 4 x 3 x 2 voxels, invalid label maps of it, and an `sh` program that gets `{in}` and `{out}`.
fn segmenter(text: &'static str) -> impl Fn(&Path) + Sync + Send {
    move |d| {
        nifti(d);
        put(d.join("half.npy"), npy_bytes("<f4", "(4, 3, 2)", &0.5f32.to_le_bytes().repeat(24)));
        put(d.join("zero.npy"), npy_bytes("<f4", "(4, 3, 2)", &[0; 96]));
        put(d.join("one.npy"), npy_bytes("<f4", "(1, 1, 1)", &[0; 4]));
        put(d.join("segment"), format!("#!/bin/sh\n{text}\n"));
        #[cfg(unix)]
        std::fs::set_permissions(d.join("segment"), std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    }
}

const SEGMENT: &str = "evaluate a.nii a.nii --segmenter './segment {in} {out}'";

pub fn cases() -> Vec<Case> {
    let wrong = |what, args, says| refused(what, none, args, says).ends(End::WrongUse);
    let mut all = vec![
        wrong("no command", "--quiet", &[]),
        wrong("an unknown command", "recontsruct scan", &["recontsruct"]),
        wrong("no threads", "backends --threads 0", &["--threads"]),
        wrong("5000 threads", "backends --threads 5000", &["--threads", "1024"]),
        wrong("a detector of one number", "simulate phantom:head:16 -o scan --detector 64", &["ROWSxCOLS"]),
        wrong("a detector without rows", "simulate phantom:head:16 -o scan --detector 0x64", &["both above 0"]),
        wrong("no views", "simulate phantom:head:16 -o scan --views 0", &["--views"]),
        wrong("blocks of no voxels", "simulate phantom:head:16 -o scan --downsample 0", &["--downsample"]),
        wrong("an offset of NaN", "simulate phantom:head:16 -o scan --offset nan,0", &["finite"]),
        wrong("angles over no range", "simulate phantom:head:16 -o scan --angles 0:0", &["START:RANGE"]),
        wrong("noise of no photons", "simulate phantom:head:16 -o scan --noise poisson:0", &["poisson"]),
        wrong("a window that is reversed", "convert a.nii b.nii --values clip:3,1", &["LO below HI"]),
        wrong("a peak of zero", "evaluate a.nii b.nii --peak 0", &["above 0"]),
        wrong("label maps with a data range", "evaluate a.nii b.nii --labels --peak 2", &["--peak"]),
        wrong("a segmenter without an output path", "evaluate a.nii b.nii --segmenter 'tool {in}'", &["{out}"]),
        wrong("Hounsfield units that are reversed", "evaluate a.nii b.nii --hu 2000,-1000", &["LO below HI"]),
        wrong(
            "a time of 10^300 seconds",
            "reconstruct scan --spec fast -o run --checkpoint-every 1e300",
            &["100 years"],
        ),
        wrong("a time without end", "reconstruct scan --spec fast -o run --budget inf", &["expected seconds"]),
        wrong("views in a wrong order", "convert scan out --views 9-3", &["--views", "0-719:10"]),
        wrong("every 0th view", "convert scan out --views every:0", &["--views", "every:10"]),
        wrong("rows that are no slice", "convert scan out --rows 5", &["--rows", "FROM:TO"]),
        wrong("pixels of no pixels", "convert scan out --bin 0", &["--bin"]),
        wrong("five quarter turns", "convert scan out --turns 5", &["--turns", "0..=3"]),
        wrong(
            "a distance that no view shows",
            "calibrate scan --parameters dso",
            &["dso", "object's size", "offset-u"],
        ),
        wrong("every view held out", "reconstruct scan --spec fast -o run --hold-out every:1", &["every:10"]),
    ];
    all.extend(table! {
        "a phantom that is not known", none, "simulate phantom:hand -o scan", ["`hand`", "`head`"];
        "a phantom of 10^9 voxels a side", none,
            "simulate phantom:head:1000000000 -o scan", ["1000000000", "8 to 1024"];
        "4 billion views", none,
            "simulate phantom:head:16 -o scan --views 4294967295", ["views", "4294967295", "at most 1000000"];
        "a detector past 2^64", none,
            "simulate phantom:head:16 -o scan --detector 4294967296x4294967296", ["detector", "addressed"];
        "a detector past memory", none,
            "simulate phantom:head:16 -o scan --detector 1000000x1000000", ["memory", "--memory allows 1.0 GiB"];
        "blocks larger than the volume", none,
            "simulate phantom:head:16 -o scan --downsample 65535", ["factor", "65535"];
        "a protocol that is missing", none, "simulate phantom:head:16 -o scan --protocol p.toml", ["p.toml"];
        "a protocol with a misspelt key", |d| put(d.join("p.toml"), "dso = 5.0\nddd = 3.0\n"),
            "simulate phantom:head:16 -o scan --protocol p.toml", ["p.toml:2", "ddd"];
        "a protocol of bytes", |d| put(d.join("p.toml"), [0xff, 0xfe, 0]),
            "simulate phantom:head:16 -o scan --protocol p.toml", ["p.toml", "UTF-8"];
        "angles that are words", |d| put(d.join("angles.txt"), "0\n10\nten\n"),
            "simulate phantom:head:16 -o scan --angles angles.txt", ["angles.txt:3", "ten"];
        "angles that are infinite", |d| put(d.join("angles.txt"), "0\ninf\n"),
            "simulate phantom:head:16 -o scan --angles angles.txt", ["angles.txt:2", "inf"];
        "a list without angles", |d| put(d.join("angles.txt"), "# none\n"),
            "simulate phantom:head:16 -o scan --angles angles.txt", ["angles", "at least one view"];
        "a volume of another shape than the reference",
            then(nifti, |d| put(d.join("b.npy"), npy_bytes("<f4", "(1, 1, 1)", &[0; 4]))),
            "evaluate a.nii b.npy", ["[4, 3, 2]", "[1, 1, 1]"];
        "a label map with halves", segmenter(""),
            "evaluate half.npy half.npy --labels", ["half.npy", "voxel [0, 0, 0]", "0.5", "whole number"];
        "label maps of two shapes", segmenter(""),
            "evaluate one.npy zero.npy --labels", ["one.npy", "[1, 1, 1]", "[4, 3, 2]"];
        "a segmenter that is not there", nifti,
            "evaluate a.nii a.nii --segmenter './segment {in} {out}'", ["segmenter ./segment", "No such file"];
        "a segmenter that fails", segmenter("echo loading >&2; echo no weights here >&2; exit 3"),
            SEGMENT, ["given a.nii", "exit status: 3", "loading | no weights here"];
        "a segmenter that writes nothing", segmenter(""), SEGMENT, ["no file", "{out}", "it printed nothing"];
        "a segmenter that writes text", segmenter("echo hello > $2"), SEGMENT, ["cannot be used", "{out}"];
        "a segmenter that writes another shape", segmenter("cp one.npy $2"),
            SEGMENT, ["the label map of a.nii", "1 voxels", "24"];
        "a segmenter that writes halves", segmenter("cp half.npy $2"),
            SEGMENT, ["the label map of a.nii", "voxel [0, 0, 0]", "0.5"];
        "features of a run that is not there", none, "features run -o f.png", ["run"];
        "a name without a known end to write", nifti, "convert a.nii b.png", ["b.png", ".nii.gz"];
        "a folder that does not exist to write in", nifti, "convert a.nii no/b.nii", ["no/b.nii"];
        "an output that stands there", then(nifti, |d| put(d.join("b.nii"), "mine")),
            "convert a.nii b.nii", ["b.nii", "--force"];
        "patience without held-out views", scan_toml,
            "reconstruct scan --spec fast -o run --set callbacks.1.type=patience",
            ["--set callbacks.1.type=patience", "no held-out views", "--hold-out every:10"];
        "patience of voxels without held-out views", scan_toml,
            "compare scan --specs sirt -o all --set stop={passes=5,patience=3}",
            ["stop.patience", "no held-out views", "--hold-out every:10"];
        "a held-out view that does not exist", scan_toml,
            "reconstruct scan --spec fast -o run --hold-out 3", ["found 3", "below 3"];
        "no step", scan_toml,
            "reconstruct scan --spec fast -o run --set training.steps=0", ["training.steps", "at least 1"];
        "windows of more pixels than a step has rays", scan_toml,
            "reconstruct scan --spec fast -o run --set training.windows={count=100,side=8}",
            ["training.windows.count", "100"];
        "a correction that is not known", scan_toml, "convert scan out --correct ring", ["ring"];
        "a correction with a setting that it does not have", scan_toml,
            "convert scan out --correct rings.size=5", ["size", "window"];
        "a correction with a setting out of range", scan_toml,
            "convert scan out --correct rings.window=4", ["rings.window", "odd"];
        "a correction of a volume", nifti, "convert a.nii out.npy --correct flux", ["--correct"];
        "all views held out", scan_toml, "reconstruct scan --spec fast -o run --hold-out 0,1,2", ["at least one view"];
    });
    all
}
