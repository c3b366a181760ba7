//! The stage through conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::{Options, check_encoder};
use conefield_plugin::spec::EncoderSpec;

#[test]
fn it_conforms() {
    for bands in [1, 6] {
        let report = check_encoder(Settings { bands }.build().unwrap().as_ref(), &Options::encoder());
        assert!(report.passed(), "{report}");
    }
}

#[test]
fn no_bands_are_refused_by_name() {
    let e = Settings { bands: 0 }.build().err().unwrap().to_string();
    assert!(e.contains("encoder.bands: found 0"), "{e}");
}
