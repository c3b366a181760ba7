//! Tests the stage with conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::{Options, check_field};
use conefield_plugin::prelude::*;

#[test]
fn it_conforms() {
    let report = check_field(Settings::default().build().unwrap().as_ref(), &Options::encoder());
    assert!(report.passed(), "{report}");
}
