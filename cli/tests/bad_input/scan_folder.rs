//! The project's own scan folder.

use crate::case::{Case, End, changed, cut, cut_end, put, replaced, table, then};
use conefield_tests::hostile::seeds::{npy_bytes, scan, scan_json, scan_toml};
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;

const INFO: &str = "info scan";
const RECONSTRUCT: &str = "reconstruct scan --spec fast --steps 1 -o run";
const TOML: &str = "scan/scan.toml";
const PROJECTIONS: &str = "scan/projections.npy";

fn toml(from: &'static str, to: &'static str) -> impl Fn(&Path) + Sync + Send {
    replaced(scan_toml, TOML, from, to)
}

/// Maps every projection value.
fn mapped(map: fn(f32) -> f32) -> impl Fn(&Path) + Sync + Send {
    move |d| {
        scan_toml(d);
        let raw: Vec<u8> = scan().projections.iter().flat_map(|x| map(*x).to_le_bytes()).collect();
        put(d.join(PROJECTIONS), npy_bytes("<f4", "(3, 4, 5)", &raw));
    }
}

pub fn cases() -> Vec<Case> {
    table! {
        "an empty folder", |d| fs::create_dir(d.join("scan")).unwrap(), RECONSTRUCT, ["scan.toml", "meta_data.json"];
        "an empty description", changed(scan_toml, TOML, cut(0)), INFO, ["scan.toml", "format"];
        "both descriptions", then(scan_toml, |d| put(d.join("scan/scan.json"), "{}")),
            INFO, ["both scan.toml and scan.json"];
        "JSON cut in the middle", changed(scan_json, "scan/scan.json", |b| b.truncate(b.len() / 2)),
            INFO, ["scan.json"];
        "a later version", toml("version = 1", "version = 7"), INFO, ["version", "found 7"];
        "a misspelt key", toml("dsd =", "dds ="), RECONSTRUCT, ["scan.toml:21:1: orbit.dds", "\"dsd\""];
        "a missing table", toml("[orbit]", "[provenance.orbit]"), INFO, ["orbit", "nothing"];
        "fewer rows than the projections", toml("rows = 4", "rows = 3"),
            INFO, ["projections.npy", "[3, 4, 5]", "[3, 3, 5]"];
        "rows with a product past 2^64", toml("rows = 4", "rows = 9223372036854775807"),
            INFO, ["18446744073709551615", "no machine"];
        "a volume of NaN", toml("spacing = [0.5", "spacing = [nan"), INFO, ["scan.toml:16:12: volume.spacing.0: found nan"];
        "a unit of zero", toml("mm = 1.0", "mm = 0.0"), INFO, ["unit.mm", "found 0"];
        "more views than there are people", |d| {
            scan_toml(d);
            let text = fs::read_to_string(d.join(TOML)).unwrap();
            let lines =
                text.lines().map(|l| if l.starts_with("angles") { "range = 6.28\ncount = 9000000000" } else { l });
            put(d.join(TOML), lines.collect::<Vec<_>>().join("\n"));
        }, INFO, ["orbit.count", "9000000000"];
        "projections in the folder above", toml("\"projections.npy\"", "\"../projections.npy\""),
            INFO, ["projections", "plain file name"];
        "projections in the system", toml("\"projections.npy\"", "\"/etc/passwd\""),
            RECONSTRUCT, ["projections", "plain file name"];
        "projections behind a link that leads out", |d| {
            scan_toml(d);
            fs::rename(d.join(PROJECTIONS), d.join("out.npy")).unwrap();
            symlink("../out.npy", d.join(PROJECTIONS)).unwrap();
        }, RECONSTRUCT, ["projections", "link out of the folder"];
        "a truth behind a link that leads out", |d| {
            scan_toml(d);
            fs::remove_file(d.join("scan/truth.nii.gz")).unwrap();
            symlink("/etc/hostname", d.join("scan/truth.nii.gz")).unwrap();
        }, INFO, ["truth", "link out of the folder"];
        "projections that are a folder", |d| {
            scan_toml(d);
            fs::remove_file(d.join(PROJECTIONS)).unwrap();
            fs::create_dir(d.join(PROJECTIONS)).unwrap();
        }, INFO, ["projections", "a file"];
        "projections cut by a byte", changed(scan_toml, PROJECTIONS, cut_end(1)),
            RECONSTRUCT, ["projections.npy", "239 bytes", "240 bytes"];
        "a projection that is NaN", mapped(|x| if x == 0.0 { f32::NAN } else { x }),
            RECONSTRUCT, ["projections.npy", "data[0, 0, 0]", "NaN"];
        "a projection that is infinite", mapped(|_| f32::INFINITY), INFO, ["data[0, 0, 0]", "inf"];
        "negative projections", mapped(|x| -1.0 - x), INFO, ["negative"].ends(End::Warned);
        "projections that are counts", mapped(|x| 1000.0 * (2.0 - x)), INFO, ["line integrals"].ends(End::Warned);
        "a truth that is cut", changed(scan_toml, "scan/truth.nii.gz", cut_end(9)),
            "reconstruct scan --spec fast --reference truth -o run", ["truth.nii.gz", "gzip"];
    }
}
