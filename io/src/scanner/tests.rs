use super::*;
use crate::scan_folder::write_scan;
use crate::testing::{are_views, data, is_integral, npy_bytes, read_scan, read_scanner, says, tiff16};
use crate::{DataSet, r2, rays};
use std::fs;
use std::path::PathBuf;

/// The description of the shared counts, with the geometry of `ellipsoids_50_r2`.
const ELLIPSOIDS: &str = r#"format = "conefield-scanner"
version = 1

[files]
projections = "scan.npz:counts"
flat = "scan.npz:flat"
dark = "scan.npz:dark"

[circle]
dso = 500.0
dsd = 800.0
pixel = { u = 2.0, v = 2.0 }
start_deg = 0.0
step_deg = 14.4
direction = "counterclockwise"

[values]
flat_includes_dark = false

[volume]
shape = [64, 64, 64]
spacing = [1.5625, 1.5625, 1.5625]
"#;

/// The shared counts with an editable description, and the scan with exact projections.
struct Ellipsoids {
    dir: tempfile::TempDir,
    exact: DataSet,
}

impl Ellipsoids {
    fn find() -> Option<Self> {
        let (counts, exact) = (data("interop/ellipsoids_counts.npz")?, data("interop/ellipsoids_50_r2")?);
        let dir = tempfile::tempdir().unwrap();
        fs::copy(counts, dir.path().join("scan.npz")).unwrap();
        Some(Self { dir, exact: r2::read(&exact, true).unwrap() })
    }

    fn changed(&self, changes: &[(&str, &str)]) -> Scan {
        let mut text = ELLIPSOIDS.to_string();
        for (from, to) in changes {
            assert!(text.contains(from), "{from}");
            text = text.replace(from, to);
        }
        let path = self.dir.path().join("scanner.toml");
        fs::write(&path, text).unwrap();
        read_scanner(path, None).unwrap()
    }

    fn agreement(&self, scan: &Scan) -> rays::Agreement {
        rays::agreement(scan, &self.exact.volume.as_ref().unwrap().data).unwrap()
    }
}

#[test]
fn every_wrong_setting_is_measurably_worse() {
    let Some(e) = Ellipsoids::find() else { return };
    let rays::Agreement { ratio, residual: right } = e.agreement(&e.changed(&[]));
    println!("right {right:.4}, ratio {ratio:.4}");
    assert!(right < 0.05 && (ratio - 1.0).abs() < 0.02, "{right} {ratio}");
    let volume = "[volume]";
    let half_u = "offset = { u = 1.0, v = 0.0 }\nstart_deg";
    let half_v = "offset = { u = 0.0, v = -1.0 }\nstart_deg";
    for (what, from, to, times) in [
        ("rows flipped", volume, "[layout]\nflip_rows = true\n[volume]", 3.0),
        ("columns flipped", volume, "[layout]\nflip_columns = true\n[volume]", 3.0),
        ("rows and columns swapped", volume, "[layout]\naxes = [\"view\", \"column\", \"row\"]\n[volume]", 3.0),
        ("turned the other way", "\"counterclockwise\"", "\"clockwise\"", 3.0),
        ("start a quarter turn off", "start_deg = 0.0", "start_deg = 90.0", 3.0),
        ("start a view off", "start_deg = 0.0", "start_deg = 14.4", 2.0),
        ("half a pixel along u", "start_deg", half_u, 1.2),
        ("half a pixel along v", "start_deg", half_v, 1.2),
        ("pixel size", "u = 2.0, v", "u = 2.1, v", 1.2),
        ("source too near", "dso = 500.0", "dso = 450.0", 1.2),
    ] {
        let wrong = e.agreement(&e.changed(&[(from, to)])).residual;
        println!("{what}: {wrong:.4}");
        assert!(wrong > times * right, "{what}: {wrong} against {right}");
    }
}

#[test]
fn every_way_to_say_the_geometry_gives_the_same_scan() {
    let Some(e) = Ellipsoids::find() else { return };
    let want = e.changed(&[]);
    let near = |a: &Scan| {
        are_views(&a.geometry.views, &want.geometry.views);
        assert_eq!(a.projections, want.projections);
    };
    near(&e.changed(&[("step_deg = 14.4", "range_deg = 360.0")]));
    let angles: Vec<String> = (0..25).map(|i| format!("{}", -14.4 * i as f64)).collect();
    let list = format!("angles_deg = [{}]", angles.join(", "));
    near(&e.changed(&[("step_deg = 14.4", &list), ("counterclockwise", "clockwise")]));
    let circle = &ELLIPSOIDS[ELLIPSOIDS.find("[circle]").unwrap()..ELLIPSOIDS.find("[values]").unwrap()];
    let row = |v: &View| format!("{:?}", [v.source, v.detector, v.u, v.v].concat());
    let rows: Vec<String> = want.geometry.views.iter().map(row).collect();
    near(&e.changed(&[(circle, &format!("[vectors]\ncone_vec = [{}]\n\n", rows.join(",\n")))]));
    // RTK's rows run up: the stack is flipped for it, and the reader flips it back.
    let xml = e.dir.path().join("geometry.xml");
    assert!(crate::rtk::write_rtk_geometry(&xml, &want.geometry.views).unwrap());
    let rtk = "[rtk]\nfile = \"geometry.xml\"\npixel = { u = 2.0, v = 2.0 }\n[layout]\nflip_rows = true\n\n";
    near(&e.changed(&[(circle, rtk)]));
    // Written as conefield's own folder, the scan is read back unchanged.
    let folder = e.dir.path().join("out");
    write_scan(&folder, &want, None).unwrap();
    near(&read_scan(&folder).unwrap());
}

/// Three views of four rows and six columns in 16-bit TIFFs, with a flat field; counts fall towards the middle.
fn small() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir(dir.path().join("views")).unwrap();
    let image = |path: &str, f: &dyn Fn(usize, usize) -> u16| tiff16(&dir.path().join(path), [4, 6], f);
    for v in 0..3 {
        image(&format!("views/v{v}.tif"), &|r, c| if (1..3).contains(&r) && c == v + 1 { 250 } else { 1000 });
    }
    image("flat.tif", &|_, _| 1000);
    let text = ELLIPSOIDS
        .replace("scan.npz:counts", "views")
        .replace("scan.npz:flat", "flat.tif")
        .replace("dark = \"scan.npz:dark\"\n", "")
        .replace("[values]\nflat_includes_dark = false\n\n", "");
    let path = dir.path().join("s.toml");
    fs::write(&path, text).unwrap();
    (dir, path)
}

#[test]
fn tiffs_become_a_scan() {
    let (_dir, path) = small();
    let scan = read_scanner(&path, None).unwrap();
    assert_eq!(scan.projections.dim(), (3, 4, 6));
    is_integral(&scan, [1, 2, 2], 4f64.ln());
    assert_eq!(scan.projections[[1, 2, 3]], 0.0);
}

#[test]
fn hostile_descriptions_are_refused_in_words() {
    let (_dir, path) = small();
    let text = fs::read_to_string(&path).unwrap();
    let edit = |from: &str, to: &str, words: &[&str]| {
        assert!(text.contains(from), "{from}");
        fs::write(&path, text.replace(from, to)).unwrap();
        says(read_scanner(&path, None), words);
    };
    edit("version = 1", "", &["version", "nothing"]);
    edit("u = 2.0, v", "v", &["u", "nothing"]);
    edit("dsd = 800.0", "dsd = 300.0", &["circle.dsd", "300", "swapped"]);
    edit("direction = \"counterclockwise\"", "", &["direction", "nothing"]);
    edit("\"counterclockwise\"", "\"left\"", &["direction", "left", "clockwise"]);
    edit("step_deg = 14.4", "", &["circle.step_deg", "no angles", "angles_deg"]);
    edit("[volume]", "[layout]\naxes = [\"view\", \"row\", \"row\"]\n[volume]", &["layout.axes", "once"]);
    edit("[volume]", "[layout]\naxes = [\"view\"]\n[volume]", &["layout.axes", "two of them"]);
    edit("[volume]", "[layout]\naxes = [\"view\", \"row\"]\n[volume]", &["shape", "two axes, as layout.axes says"]);
    edit("[volume]", "[values]\ni0 = \"dark\"\n[volume]", &["values.i0: found \"dark\", expected a number of counts"]);
    edit("[volume]", "[values]\ni0 = 7\n[volume]", &["values.i0", "files.flat", "one of them"]);
    edit("[volume]", "[values]\nkind = \"line-integrals\"\n[volume]", &["files.flat", "line-integrals"]);
    edit("[volume]", "[values]\nflat_includes_dark = true\n[volume]", &["values.flat_includes_dark", "files.dark"]);
    edit("flat = \"flat.tif\"", "", &["files.flat", "nothing", "--i0"]);
    edit("\"views\"", "3", &["files.projections: found 3, expected a file name or a list of file names"]);
    let numbers = "circle.angles_deg: found true, expected a list of numbers, or the name of a file with them";
    edit("step_deg = 14.4", "angles_deg = true", &[numbers]);
    edit("step_deg = 14.4", "angles_deg = [[0, 1]]", &["circle.angles_deg[0]: found 2 numbers, expected 1"]);
    edit("\"flat.tif\"", "\"flat.tif:a\"", &["flat.tif: array", "the name \"a\""]);
    let circle = &text[text.find("[circle]").unwrap()..text.find("[volume]").unwrap()];
    edit(circle, "", &["circle", "nothing", "one of [circle]"]);
    let rtk = "[rtk]\nfile = \"../g.xml\"\npixel = { u = 1, v = 1 }\n\n";
    edit(circle, rtk, &["rtk.file", "without \"..\""]);
}

/// A circle and vectors of a parallel beam describe the same rays; what a cone needs is refused, and the reverse.
#[test]
fn parallel_beams_have_no_distances() {
    let dir = tempfile::tempdir().unwrap();
    let values: Vec<u8> = (0..2 * 3 * 4).flat_map(|i| (i as f32).to_le_bytes()).collect();
    fs::write(dir.path().join("p.npy"), npy_bytes("<f4", false, "(2, 3, 4)", &values)).unwrap();
    let read = |geometry: &str| {
        let text = format!(
            "format = \"conefield-scanner\"\nversion = 1\n[files]\nprojections = \"p.npy\"\n{geometry}\n\
             [values]\nkind = \"line-integrals\"\n[volume]\nshape = [6, 5, 4]\nspacing = [1.0, 1.0, 1.0]\n"
        );
        let path = dir.path().join("scanner.toml");
        fs::write(&path, text).unwrap();
        read_scanner(path, None)
    };
    let circle = "[circle]\nbeam = \"parallel\"\npixel = { u = 2.0, v = 0.5 }\noffset = { u = 0.25, v = 0.0 }\n\
                  step_deg = 90.0\ndirection = \"counterclockwise\"\n";
    let scan = read(circle).unwrap();
    // Directions of the rays, detector centres, u and v, as ASTRA has them.
    let vectors = "[vectors]\nparallel_vec = [[-3, 0, 0, 0, 0.25, 0, 0, 2, 0, 0, 0, -0.5],\n\
                   [0, -1, 0, -0.25, 0, 0, -2, 0, 0, 0, 0, -0.5]]\n";
    let same = read(vectors).unwrap();
    for (view, row, column) in [(0, 0, 0), (0, 2, 3), (1, 1, 2)] {
        let [a, b] = [&scan, &same].map(|s| s.geometry.ray(view, row, column));
        let off = norm([0, 1, 2].map(|k| a.direction[k] - b.direction[k]));
        // Both through the same point before the volume, on lines of the same direction.
        let along = (0..3).map(|k| (b.origin[k] - a.origin[k]) * a.direction[k]).sum::<f64>();
        let apart = norm([0, 1, 2].map(|k| b.origin[k] - a.origin[k] - along * a.direction[k]));
        assert!(off < 2e-5 && apart < 1e-3, "{view} {row} {column}: {off} {apart}");
        assert!(scan.geometry.is_parallel(view) && same.geometry.is_parallel(view));
    }
    let refused = |geometry: String, all: &[&str]| says(read(&geometry), all);
    refused(circle.replace("step_deg", "dso = 100.0\nstep_deg"), &["circle.dso", "found 100", "no source"]);
    refused(circle.replace("beam = \"parallel\"\n", ""), &["circle.dso", "found nothing", "beam = \"parallel\""]);
    refused(circle.replace("\"parallel\"", "\"fan\""), &["scanner.toml", "fan", "parallel"]);
    refused(vectors.replace("[-3, 0, 0,", "[0, 0, 0,"), &["parallel_vec[0]", "a direction"]);
    refused(vectors.replace("parallel_vec", "cone_vec"), &["views[1]", "a source at"]);
    refused("[vectors]\n".into(), &["vectors", "found nothing", "one of cone_vec and parallel_vec"]);
}
