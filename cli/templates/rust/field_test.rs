//! Tests the stage with conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::{Options, check_field};
use conefield_plugin::settings::FieldSpec;

#[test]
fn it_conforms() {
    for width in [1, 5, 20] {
        let report = check_field(Settings::default().build(width).unwrap().as_ref(), &Options::features());
        assert!(report.passed(), "{report}");
    }
}
