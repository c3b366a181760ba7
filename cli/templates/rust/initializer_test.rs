//! Tests the stage with conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::check_initializer;
use conefield_plugin::arena::Weights;
use conefield_plugin::settings::InitializerSpec;

#[test]
fn it_conforms() {
    let report = check_initializer(Settings::default().build(&|_| Ok(Weights::default())).unwrap().as_ref());
    assert!(report.passed(), "{report}");
}
