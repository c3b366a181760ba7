//! Files written by h5py (`tests/fixtures/make_formats.py`), intact and damaged.

use crate::testing::{is_integral, is_view, read_scanner, says};
use conefield_core::Result;
use conefield_core::geometry::{Millimetres, Radians, View};
use conefield_core::scan::Scan;
use std::fs;
use std::path::{Path, PathBuf};

const CIRCLE: &str =
    "[circle]\ndso = 500.0\ndsd = 800.0\npixel = { u = 2.0, v = 2.0 }\ndirection = \"counterclockwise\"\n";
const FIXTURES: [&str; 3] = ["dxchange.h5", "nxtomo.nxs", "cil.nxs"];

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

/// Imports a description with `files`, then `rest`, from a folder with all fixtures, of which `change` damages some.
fn import(files: &str, rest: &str, change: &dyn Fn(&str, &mut Vec<u8>)) -> Result<Scan> {
    let dir = tempfile::tempdir().unwrap();
    for name in FIXTURES {
        let mut bytes = fs::read(fixture(name)).unwrap();
        change(name, &mut bytes);
        fs::write(dir.path().join(name), bytes).unwrap();
    }
    let head = "format = \"conefield-scanner\"\nversion = 1\n";
    let volume = "[volume]\nshape = [4, 3, 2]\nspacing = [0.5, 0.75, 2.0]\n";
    let path = dir.path().join("s.toml");
    fs::write(&path, format!("{head}[files]\n{files}\n{rest}\n{volume}")).unwrap();
    read_scanner(&path, None)
}

/// The same with the files as they are.
fn whole(files: &str, rest: &str) -> Result<Scan> {
    import(files, rest, &|_, _| {})
}

fn files(name: &str) -> String {
    ["projections", "flat", "dark"].map(|part| format!("{part} = \"{name}\"")).join("\n")
}

#[test]
fn layouts_give_projections_fields_and_angles() {
    let angles = |name: &str| format!("{CIRCLE}angles_deg = \"{name}\"\n");
    let exchange = whole(&files("dxchange.h5"), &angles("dxchange.h5")).unwrap();
    for (v, r, c) in [(0, 0, 0), (1, 2, 3), (2, 3, 4)] {
        let i = (20 * v + 5 * r + c) as f64;
        let [dark, flat] = [100.0 + i % 20.0 % 7.0, 20010.0 + i % 20.0];
        is_integral(&exchange, [v, r, c], ((flat - dark) / (9000.0 + 97.0 * i - dark)).ln());
    }
    let turned = &exchange.geometry.views[1].source;
    assert!((turned[0] + 250.0).abs() < 1e-9, "{turned:?}");
    let tomo = whole(&files("nxtomo.nxs"), &angles("nxtomo.nxs")).unwrap();
    assert_eq!(tomo.projections, exchange.projections);
    assert!((tomo.geometry.views[2].source[1] - exchange.geometry.views[2].source[1]).abs() < 1e-9);
    // A group and data sets by name.
    let named = "projections = \"nxtomo.nxs:/entry\"\nflat = \"dxchange.h5:exchange/data_white\"\ndark = \"dxchange.h5:/exchange\"";
    let named = whole(named, &angles("dxchange.h5:/exchange/theta")).unwrap();
    assert_eq!(named.projections, exchange.projections);
    // The description gives the axes of a data set.
    let swapped =
        format!("{CIRCLE}range_deg = 360\n[layout]\naxes = [\"view\", \"column\", \"row\"]\n[values]\ni0 = 20000\n");
    let swapped = whole("projections = \"dxchange.h5:/exchange/data\"", &swapped).unwrap();
    assert_eq!(swapped.projections.dim(), (3, 5, 4));
}

#[test]
fn the_geometry_of_cil_is_that_of_its_conversion_to_vectors() {
    let scan =
        whole("projections = \"cil.nxs\"", "[cil]\nfile = \"cil.nxs\"\n[values]\nkind = \"line-integrals\"\n").unwrap();
    is_integral(&scan, [2, 3, 4], 1.4723);
    let mm = Millimetres;
    for (view, angle) in scan.geometry.views.iter().zip([0.0, 120.0, 240.0]) {
        // Source and detector rotate by minus the angle, from below; the axis is shifted by half a millimetre.
        let at = Radians(f64::to_radians(-90.0 - 10.0 - angle));
        let want = View::circular(at, mm(500.0), mm(800.0), [mm(1.5), mm(2.0)], [mm(0.0), mm(-0.5)]);
        let (s, c) = at.0.sin_cos();
        let aside = |p: [f64; 3]| [p[0] + 0.5 * s, p[1] - 0.5 * c, p[2]];
        // Its rows run upwards.
        is_view(view, [aside(want.source), want.detector, want.u, want.v.map(|x| -x)]);
    }
}

#[test]
fn what_is_not_there_or_damaged_is_refused_in_words() {
    let turn = format!("{CIRCLE}range_deg = 360\n[values]\ni0 = 20000\n");
    let projections = "projections = \"dxchange.h5\"";
    let group = format!("{CIRCLE}angles_deg = \"nxtomo.nxs:/entry/sample\"\n");
    says(whole(projections, &group), &["nxtomo.nxs: /entry/sample"]);
    let dark = format!("{projections}\ndark = \"cil.nxs\"");
    says(whole(&dark, &turn), &["cil.nxs", "no image_key", "dark"]);
    let length = fs::read(fixture("dxchange.h5")).unwrap().len();
    for cut in [9, 60, length / 2, length - 1] {
        let cut =
            |name: &str, bytes: &mut Vec<u8>| bytes.truncate(if name == "dxchange.h5" { cut } else { bytes.len() });
        says(import(projections, &turn, &cut), &["dxchange.h5"]);
    }
    for (id, filter) in
        [(32_000u16, "LZF"), (32_008, "bitshuffle"), (32_001, "Blosc"), (32_015, "Zstandard"), (999, "a filter")]
    {
        // The filter's number stands 8 bytes before its name; headers of NXtomo's file have no checksums.
        let packed = |name: &str, bytes: &mut Vec<u8>| {
            let at = bytes.windows(8).position(|w| name == "nxtomo.nxs" && w == b"deflate\0");
            at.into_iter().for_each(|at| bytes[at - 8..at - 6].copy_from_slice(&id.to_le_bytes()));
        };
        let words = ["nxtomo.nxs", &format!("packed by {filter} (filter id {id})"), "h5repack -f NONE"];
        says(import("projections = \"nxtomo.nxs\"", &turn, &packed), &words);
    }
}
