//! Tests the stage with conefield's conformance kit.

use conefield_conformance::{Options, check_encoder};
use conefield_plugin::settings::EncoderSpec;
use triplane::planes::Triplane;

#[test]
fn triplane_conforms() {
    for (levels, resolution, features) in [(1, 2, 1), (1, 5, 3), (2, 9, 2), (3, 64, 2)] {
        let stage = Triplane { levels, resolution, features }.build().unwrap();
        let report = check_encoder(stage.as_ref(), &Options { single: 5e-5, ..Options::encoder() });
        assert!(report.passed(), "{report}");
    }
}
