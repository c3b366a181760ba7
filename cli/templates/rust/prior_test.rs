//! Tests the stage with conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::check_prior;
use conefield_plugin::prelude::*;

#[test]
fn it_conforms() {
    let report = check_prior(Settings::default().build().unwrap().as_ref());
    assert!(report.passed(), "{report}");
}
