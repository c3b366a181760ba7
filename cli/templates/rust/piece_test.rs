//! Tests the stage with conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::check_@kind@;
use conefield_plugin::prelude::*;

#[test]
fn it_conforms() {
    let report = check_@kind@(Settings::default().build().unwrap().as_ref());
    assert!(report.passed(), "{report}");
}
