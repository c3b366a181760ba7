//! Tests the stage with conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::check_regularizer;
use conefield_plugin::prelude::*;

#[test]
fn it_conforms() {
    let report = check_regularizer(Settings::default().build().unwrap().as_ref());
    assert!(report.passed(), "{report}");
}
