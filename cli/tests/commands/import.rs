//! `conefield import`: from files to a scan for the other commands.

use crate::common::{Folder, number};
use conefield_tests::hostile;
use ndarray::Array3;
use serde_json::json;
use std::fs;

#[test]
fn counts_become_a_scan_that_the_other_commands_read() {
    let d = Folder::new();
    let block = |i: usize| (6..10).contains(&(i / 16 % 16)) && (6..10).contains(&(i % 16));
    let counts: Vec<u16> = (0..8 * 256).map(|i| if block(i) { 2500 } else { 10000 }).collect();
    let counts = Array3::from_shape_vec((8, 16, 16), counts).unwrap();
    ndarray_npy::write_npy(d.at("counts.npy"), &counts).unwrap();
    let toml = "format = \"conefield-scanner\"\nversion = 1\nfiles.projections = \"counts.npy\"\n\
        volume = { shape = [8, 8, 8], spacing = [2.0, 2.0, 2.0] }\n[circle]\ndso = 100.0\ndsd = 150.0\n\
        pixel = { u = 2.0, v = 2.0 }\nrange_deg = 360.0\ndirection = \"clockwise\"\n";
    d.put("s.toml", toml);

    // Without an open beam the import is refused, and nothing is left behind.
    let said = d.refused(1, "import s.toml -o scan");
    assert!(said.contains("files.flat") && said.contains("--i0") && !d.has("scan"), "{said}");

    let found = d.json("import s.toml -o scan --i0 10000 --json");
    assert_eq!((&found["views"], &found["source_to_axis_mm"]), (&json!(8), &json!(100.0)));
    assert_eq!(found["counts"]["clamped"], 0.0);
    assert_eq!(found["line_integrals"]["complaints"], json!([]));
    let top = number(&found["line_integrals"]["range"][1]);
    assert!((top - 4f64.ln()).abs() < 1e-5, "{top}");
    let info = d.json("info scan --json");
    assert_eq!((&info["views"], &info["detector"]), (&found["views"], &found["detector"]));

    // A folder stands for its description, as in info, and is kept.
    fs::create_dir(d.at("s")).unwrap();
    fs::rename(d.at("s.toml"), d.at("s/scanner.toml")).unwrap();
    fs::copy(d.at("counts.npy"), d.at("s/counts.npy")).unwrap();
    d.done("import s -o s/scan --i0 10000");
    assert!(d.bytes("s/scan/projections.npy") == d.bytes("scan/projections.npy"));
    for out in ["s", "."] {
        d.refused_with(1, &format!("import s -o {out} --i0 10000 --force"), &["which this command reads"]);
    }
    d.put("s.toml", toml);

    // An existing scan is replaced only with --force; air gives the same open beam as the number.
    assert!(d.refused(1, "import s.toml -o scan --i0 air").contains("--force"));
    let said = d.done("import s.toml -o scan --i0 air --force");
    let [views, source, arc, values, written] = said.trim().lines().collect::<Vec<_>>()[..] else { panic!("{said}") };
    assert!(views.ends_with("8 of 16 x 16 pixels (rows x columns), 2 x 2 mm each"), "{said}");
    assert!(source.ends_with("100 mm to the axis, 150 mm to the detector, magnification 1.5"), "{said}");
    assert!(arc.ends_with("360 degrees from 0 in steps of -45"), "{said}");
    let sums = "line integrals from 0 to 1.38629; open beam 10000, 0 % of the counts raised to 1,";
    assert!(values.contains(sums) && written.contains("scan (conefield info"), "{said}");
    // The rest is printed with -v.
    let output = d.loud("import s.toml -o scan --i0 air --force -v").assert().success().get_output().clone();
    let all = String::from_utf8(output.stdout).unwrap();
    let more = ["source_to_detector_mm", "counts.bad"];
    assert!(all.starts_with(said.trim()) && more.iter().all(|words| all.contains(words)), "{all}");

    // Counts imported as line integrals cause a warning, also when the scan is read later.
    d.put("s.toml", format!("{toml}[values]\nkind = \"line-integrals\"\n"));
    d.done("import s.toml -o scan --force");
    let complaint = "looks like intensities, not line integrals: pass --i0 or flat/dark";
    let printed = d.done("info scan");
    assert!(printed.contains(&format!("warning: {complaint}")), "{printed}");
    let log = d.loud("explain fast --scan scan").output().unwrap().stderr;
    assert!(String::from_utf8(log).unwrap().contains(complaint));
}

/// Files as programs on Windows leave them: Windows-1252, names in capitals, measured angles, a shifted detector.
#[test]
fn files_of_other_programs_come_in_whole() {
    let d = Folder::new();
    hostile::seeds::xtekct(&d.at(""));
    let plain = d.text("bone.xtekct").replace("ObjectOffsetX=0.5\nObjectRoll=0.1\nObjectTilt=0.2\n", "");
    let offset = "DetectorOffsetX=1.5\nDetectorOffsetY=0.75\n";
    d.put("bone.xtekct", [plain.as_bytes(), offset.as_bytes(), b"OperatorID=\xa9 K\xfcndig\n"].concat());
    for i in 1..=3 {
        fs::rename(d.at(format!("bone_000{i}.tif")), d.at(format!("BONE_000{i}.TIF"))).unwrap();
    }
    d.put("_ctdata.txt", b"Projection\tAngle(\xb0)\r\n1\t30\r\n2\t140\r\n3\t270\r\n");
    let found = d.json("info bone.xtekct --json");
    assert_eq!((&found["views"], &found["circle"]), (&json!(3), &json!(true)));
    let near = |found: &serde_json::Value, want: f64| (number(found) - want).abs() < 1e-6;
    assert!(near(&found["offset_mm"][0], -0.75) && near(&found["offset_mm"][1], -1.5), "{found}");
    assert!(near(&found["angles"]["largest_gap_deg"], 130.0), "{found}");
}
