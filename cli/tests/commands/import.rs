//! `conefield import`: from files to a scan for the other commands.

use crate::common::{done, json, refused, text};
use conefield_tests::hostile;
use ndarray::Array3;
use std::fs;
use tempfile::tempdir;

#[test]
fn counts_become_a_scan_that_the_other_commands_read() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    let block = |i: usize| (6..10).contains(&(i / 16 % 16)) && (6..10).contains(&(i % 16));
    let counts: Vec<u16> = (0..8 * 256).map(|i| if block(i) { 2500 } else { 10000 }).collect();
    let counts = Array3::from_shape_vec((8, 16, 16), counts).unwrap();
    ndarray_npy::write_npy(at("counts.npy"), &counts).unwrap();
    let toml = "format = \"conefield-scanner\"\nversion = 1\nfiles.projections = \"counts.npy\"\n\
        volume = { shape = [8, 8, 8], spacing = [2.0, 2.0, 2.0] }\n[circle]\ndso = 100.0\ndsd = 150.0\n\
        pixel = { u = 2.0, v = 2.0 }\nrange_deg = 360.0\ndirection = \"clockwise\"\n";
    fs::write(at("s.toml"), toml).unwrap();
    let (scanner, out) = (text(&at("s.toml")), text(&at("scan")));

    // Without an open beam the import is refused, and nothing is left behind.
    let said = refused(1, &["import", &scanner, "-o", &out]);
    assert!(said.contains("files.flat") && said.contains("--i0"), "{said}");
    assert!(!at("scan").exists());

    let found = json(&["import", &scanner, "-o", &out, "--i0", "10000", "--json"]);
    assert_eq!(found["views"], 8);
    assert_eq!(found["source_to_axis_mm"], 100.0);
    assert_eq!(found["counts"]["clamped"], 0.0);
    assert_eq!(found["line_integrals"]["complaints"], serde_json::json!([]));
    let top = found["line_integrals"]["range"][1].as_f64().unwrap();
    assert!((top - 4f64.ln()).abs() < 1e-5, "{top}");
    let info = json(&["info", &out, "--json"]);
    assert_eq!((&info["views"], &info["detector"]), (&found["views"], &found["detector"]));

    // An existing scan is replaced only with --force; air gives the same open beam as the number.
    assert!(refused(1, &["import", &scanner, "-o", &out, "--i0", "air"]).contains("--force"));
    let again = ["import", &scanner, "-o", &out, "--i0", "air", "--force"];
    let said = done(&again);
    let [views, source, arc, values, written] = said.trim().lines().collect::<Vec<_>>()[..] else { panic!("{said}") };
    assert!(views.ends_with("8 of 16 x 16 pixels (rows x columns), 2 x 2 mm each"), "{said}");
    assert!(source.ends_with("100 mm to the axis, 150 mm to the detector, magnification 1.5"), "{said}");
    assert!(arc.ends_with("360 degrees from 0 in steps of -45"), "{said}");
    assert!(
        values.contains("line integrals from 0 to 1.38629; open beam 10000, 0 % of the counts raised to 1,"),
        "{said}"
    );
    assert!(written.contains(&out), "{said}");
    // The rest is printed with -v.
    let all = done(&[&again[..], &["-v"]].concat());
    assert!(
        all.starts_with(said.trim()) && all.contains("source_to_detector_mm") && all.contains("counts.bad"),
        "{all}"
    );

    // Counts imported as line integrals cause a warning, also when the scan is read later.
    fs::write(at("s.toml"), format!("{toml}[values]\nkind = \"line-integrals\"\n")).unwrap();
    done(&["import", &scanner, "-o", &out, "--force"]);
    let complaint = "looks like intensities, not line integrals: pass --i0 or flat/dark";
    let printed = done(&["info", &out]);
    assert!(printed.contains(&format!("warning: {complaint}")), "{printed}");
    let log = assert_cmd::Command::cargo_bin("conefield").unwrap();
    let log = { log }.args(["explain", "fast", "--scan", &out]).output().unwrap();
    assert!(String::from_utf8(log.stderr).unwrap().contains(complaint));
}

/// Files as programs on Windows leave them: Windows-1252, names in capitals, measured angles, a shifted detector. One
/// directory for all views, as ImageJ writes it above 4 GiB.
#[test]
fn files_of_other_programs_come_in_whole() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    hostile::seeds::xtekct(dir.path());
    let plain = fs::read_to_string(at("bone.xtekct")).unwrap();
    let plain = plain.replace("ObjectOffsetX=0.5\nObjectRoll=0.1\nObjectTilt=0.2\n", "");
    let offset = "DetectorOffsetX=1.5\nDetectorOffsetY=0.75\n";
    fs::write(at("bone.xtekct"), [plain.as_bytes(), offset.as_bytes(), b"OperatorID=\xa9 K\xfcndig\n"].concat())
        .unwrap();
    for i in 1..=3 {
        fs::rename(at(&format!("bone_000{i}.tif")), at(&format!("BONE_000{i}.TIF"))).unwrap();
    }
    fs::write(at("_ctdata.txt"), b"Projection\tAngle(\xb0)\r\n1\t30\r\n2\t140\r\n3\t270\r\n").unwrap();
    let found = json(&["info", &text(&at("bone.xtekct")), "--json"]);
    assert_eq!((&found["views"], &found["circle"]), (&serde_json::json!(3), &serde_json::json!(true)));
    let near = |found: &serde_json::Value, want: f64| (found.as_f64().unwrap() - want).abs() < 1e-6;
    assert!(near(&found["offset_mm"][0], -0.75) && near(&found["offset_mm"][1], -1.5), "{found}");
    assert!(near(&found["angles"]["largest_gap_deg"], 130.0), "{found}");

    let images: Vec<u8> = (0..24 * 6u16).flat_map(|i| (9000 + i).to_be_bytes()).collect();
    fs::write(at("all.tif"), one_directory("ImageJ=1.54f\nimages=24\nslices=24\n", &images)).unwrap();
    let toml = "format = \"conefield-scanner\"\nversion = 1\nfiles.projections = \"all.tif\"\nvalues.i0 = 20000.0\n\
        volume = { shape = [8, 8, 8], spacing = [2.0, 2.0, 2.0] }\n[circle]\ndso = 100.0\ndsd = 150.0\n\
        pixel = { u = 2.0, v = 2.0 }\nangles_deg = \"a.csv:angle\"\ndirection = \"clockwise\"\n";
    fs::write(at("s.toml"), toml).unwrap();
    let angles: String = (0..24).map(|i| format!("{};{i}\r\n", 15 * i)).collect();
    fs::write(at("a.csv"), format!("\u{feff}angle;view\r\n{angles}")).unwrap();
    let found = json(&["import", &text(&at("s.toml")), "-o", &text(&at("scan")), "--json"]);
    assert_eq!(found["views"], 24);
    let scan = conefield_scans::read_scan(at("scan")).unwrap();
    let last = f64::from(scan.projections[[23, 1, 2]]);
    assert!((last - (20000f64 / 9143.0).ln()).abs() < 1e-5, "{last}");
}

/// A big-endian TIFF with one directory of 2 x 3 pixels of 16 bits, `text` and `images`.
fn one_directory(text: &str, images: &[u8]) -> Vec<u8> {
    let entries: [(u16, u16, u32, u32); 9] = [
        (256, 4, 1, 3),
        (257, 4, 1, 2),
        (258, 3, 1, 16 << 16),
        (259, 3, 1, 1 << 16),
        (262, 3, 1, 1 << 16),
        (270, 2, text.len() as u32, 200),
        (273, 4, 1, 300),
        (278, 4, 1, 2),
        (279, 4, 1, 12),
    ];
    let mut bytes = [b"MM\0*\0\0\0\x08".as_slice(), &(entries.len() as u16).to_be_bytes()].concat();
    for (tag, kind, count, value) in entries {
        bytes.extend([tag.to_be_bytes(), kind.to_be_bytes()].concat());
        bytes.extend([count.to_be_bytes(), value.to_be_bytes()].concat());
    }
    bytes.resize(200, 0);
    bytes.extend(text.as_bytes());
    bytes.resize(300, 0);
    bytes.extend(images);
    bytes
}
