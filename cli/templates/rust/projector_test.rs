//! Tests the stage with conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::check_projector;
use conefield_plugin::settings::ProjectorSpec;

#[test]
fn it_conforms() {
    for random in [false, true] {
        let report = check_projector(Settings { samples: 50, random }.build().unwrap().as_ref());
        assert!(report.passed(), "{report}");
    }
}
