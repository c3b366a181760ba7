//! R2-Gaussian's folder.

use crate::case::{Case, End, changed, cut, put, replaced, table, then};
use conefield_tests::hostile::seeds::{npy_bytes, r2};
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;

const INFO: &str = "info r2";
const META: &str = "r2/meta_data.json";
const FIRST: &str = "r2/proj_train/proj_train_0000.npy";

fn meta(from: &'static str, to: &'static str) -> impl Fn(&Path) + Sync + Send {
    replaced(r2, META, from, to)
}

pub fn cases() -> Vec<Case> {
    table! {
        "an empty description", changed(r2, META, cut(0)), INFO, ["meta_data.json"];
        "a description cut in the middle", changed(r2, META, |b| b.truncate(b.len() / 2)),
            INFO, ["meta_data.json:3"];
        "no UTF-8", then(r2, |d| put(d.join(META), b"{\"scanner\": \"\xff\"}")), INFO, ["UTF-8"];
        "a rotated detector, which is not read", meta("\"mode\"", "\"rotDetector\": [0, 0.1, 0], \"mode\""),
            INFO, ["not read", "scanner.rotDetector"].ends(End::Warned);
        "a missing key", meta("\"DSO\"", "\"DS0\""), INFO, ["DSO", "nothing"];
        "a beam of another kind", meta("\"cone\"", "\"fan\""), INFO, ["mode", "fan", "cone"];
        "a negative distance", meta("\"DSO\": 500.0", "\"DSO\": -500.0"), INFO, ["scanner.DSO", "-500"];
        "a number past the range", meta("\"DSO\": 500.0", "\"DSO\": 1e999"), INFO, ["meta_data.json:3"];
        "a detector without rows", meta("\"nDetector\": [\n      4", "\"nDetector\": [\n      0"),
            INFO, ["scanner.nDetector", "at least 1"];
        "a detector of 2^64 rows", meta("\"nDetector\": [\n      4", "\"nDetector\": [\n      18446744073709551616"),
            INFO, ["meta_data.json:3"];
        "a detector with a product past 2^64",
            meta("\"nDetector\": [\n      4", "\"nDetector\": [\n      9223372036854775807"),
            INFO, ["18446744073709551615", "no machine"];
        "voxels with a product past 2^64, before anything is read",
            meta("\"nVoxel\": [\n      4", "\"nVoxel\": [\n      9223372036854775807"),
            "reconstruct r2 --spec fast --steps 1 -o run", ["voxels", "no machine"];
        "a view in the folder above", meta("proj_train/proj_train_0000", "../proj_train_0000"),
            INFO, ["proj_train[0].file_path", "without \"..\""];
        "a view in the system", meta("proj_train/proj_train_0000.npy", "/etc/passwd"),
            INFO, ["proj_train[0].file_path", "inside the folder"];
        "a link that leads out", |d| {
            r2(d);
            fs::rename(d.join(FIRST), d.join("out.npy")).unwrap();
            symlink("../../out.npy", d.join(FIRST)).unwrap();
        }, INFO, ["proj_train[0].file_path", "link out of the folder"];
        "a view that is not there", then(r2, |d| fs::remove_file(d.join(FIRST)).unwrap()),
            INFO, ["proj_train[0].file_path", "proj_train_0000.npy"];
        "one view named twice", meta("proj_train_0001", "proj_train_0000"),
            INFO, ["proj_train[1].file_path", "a second time"];
        "a view of another shape", then(r2, |d| put(d.join(FIRST), npy_bytes("<f4", "(2, 2)", &[0; 16]))),
            INFO, ["proj_train_0000.npy", "[2, 2]", "[4, 5]"];
        "a view that is empty", then(r2, |d| put(d.join(FIRST), "")),
            "convert r2 scan", ["proj_train_0000.npy", "end of the file"];
        "no views", |d| {
            r2(d);
            let mut value: serde_json::Value = serde_json::from_slice(&fs::read(d.join(META)).unwrap()).unwrap();
            value["proj_train"] = serde_json::json!([]);
            put(d.join(META), value.to_string());
        }, INFO, ["proj_train", "at least one view"];
    }
}
