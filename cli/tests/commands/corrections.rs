//! Corrections requested of `import` and `convert`.

use crate::common::Folder;
use ndarray::Array3;

const SCANNER: &str = "format = \"conefield-scanner\"\nversion = 1\nfiles.projections = \"counts.npy\"\nvalues.i0 = 10000.0\n\
    volume = { shape = [8, 8, 8], spacing = [2.0, 2.0, 2.0] }\n[circle]\ndso = 100.0\ndsd = 150.0\n\
    pixel = { u = 2.0, v = 2.0 }\nrange_deg = 360.0\ndirection = \"counterclockwise\"\n";

/// Counts behind a block, from a tube that is brighter in each view, on pixels with different gains.
fn counts() -> Array3<u16> {
    Array3::from_shape_fn((18, 16, 24), |(v, r, c)| {
        let block = if (4..12).contains(&r) && (6..18).contains(&c) { 0.5 } else { 1.0 };
        let gain = if (r, c) == (7, 11) { 1.1 } else { 1.0 };
        (10000.0 * block * gain * (1.0 + 0.01 * v as f64)) as u16
    })
}

#[test]
fn both_commands_mend_alike_and_keep_what_they_did() {
    let d = Folder::new();
    ndarray_npy::write_npy(d.at("counts.npy"), &counts()).unwrap();
    d.put("s.toml", SCANNER);
    d.done("import s.toml -o whole");
    // Corrections run before a part is selected, because the part's border need not show air.
    let asked = "--correct rings.window=5 --correct flux --rows 5:11 --columns 8:16";
    let found = d.json(&format!("import s.toml -o here --json {asked}"));
    d.done(&format!("convert whole there {asked}"));
    let [here, there] = ["here", "there"].map(|name| conefield_scans::read_scan(d.at(name)).unwrap());
    assert_eq!(here.projections, there.projections);
    assert!(here.projections.iter().all(|a| (a - 2f32.ln()).abs() < 1e-3), "{}", here.projections);
    for (list, name) in [(&found["corrections"], "printed"), (&there.provenance["corrections"], "kept")] {
        let names: Vec<_> = list.as_array().unwrap().iter().map(|c| c["name"].as_str().unwrap()).collect();
        assert_eq!(names, ["flux", "rings"], "{name}");
        assert_eq!(list[1]["settings"]["window"], 5, "{name}");
    }
    for command in ["import s.toml -o none", "convert whole none"] {
        for (asked, words) in [
            ("rings.window=4", "odd"),
            ("scatter.share=0", "above 0"),
            ("'flux={ rows = [5, 11], columns = [7, 17] }'", "in air"),
        ] {
            d.refuses("none", &[(&format!("{command} --correct {asked}"), words)]);
        }
    }
}
