//! Tests the stage with conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::{Options, check_normalizer};
use conefield_plugin::settings::NormalizerSpec;

#[test]
fn it_conforms() {
    for width in [1, 5, 20] {
        let stage = Settings::default().build(width).unwrap();
        let report = check_normalizer(stage.as_ref(), &Options { params: Some(1.0), ..Options::features() });
        assert!(report.passed(), "{report}");
    }
}
