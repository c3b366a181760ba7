//! The stage through conefield's conformance kit.

use conefield_conformance::{Options, check_encoder};
use conefield_plugin::spec::EncoderSpec;
use triplane::planes::Triplane;

#[test]
fn triplane_conforms() {
    for (resolution, features) in [(2, 1), (5, 3), (64, 2)] {
        let stage = Triplane { resolution, features }.build().unwrap();
        let report = check_encoder(stage.as_ref(), &Options { single: 5e-5, ..Options::encoder() });
        assert!(report.passed(), "{report}");
    }
}
