//! NAF's pickle as input and output of the command.

use crate::common::{done, json, refused, text};
use std::fs;
use tempfile::tempdir;

#[test]
fn a_pickle_is_recognized_by_its_content_and_converted_both_ways() {
    let dir = tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    let (scan, pickle, folder) = (at("scan"), at("scan.data"), at("r2"));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "8", "--detector", "12x16"]);
    done(&["convert", &scan, &pickle, "--to", "naf"]);
    assert!(refused(1, &["convert", &scan, &pickle, "--to", "naf"]).contains("--force"));

    let (own, naf) = (json(&["info", &scan, "--json"]), json(&["info", &pickle, "--json"]));
    assert_eq!(naf["provenance"]["format"], "naf");
    assert_eq!(naf["provenance"]["unit_from"], "the file");
    for key in ["kind", "views", "detector", "unit", "line_integrals", "truth"] {
        assert_eq!(naf[key], own[key], "{key}");
    }
    assert_eq!(naf["volume"]["shape"], own["volume"]["shape"]);
    let printed = done(&["info", &pickle]);
    assert!(printed.contains("unit.name") && printed.contains("provenance.unit_from"), "{printed}");

    done(&["convert", &pickle, &folder, "--to", "r2"]);
    let r2 = json(&["info", &folder, "--json"]);
    assert_eq!((&r2["line_integrals"], &r2["truth"]), (&own["line_integrals"], &own["truth"]));

    // A truncated file is refused with the position in the file.
    let bytes = fs::read(&pickle).unwrap();
    fs::write(&pickle, &bytes[..bytes.len() / 2]).unwrap();
    let said = refused(1, &["info", &pickle]);
    assert!(said.contains("scan.data: byte ") && said.contains("end of the file"), "{said}");
    fs::write(&pickle, b"\x80\x02cos\nsystem\nX\x02\x00\x00\x00id\x85R.").unwrap();
    let said = refused(1, &["info", &pickle]);
    assert!(said.contains("the name os.system"), "{said}");
}
