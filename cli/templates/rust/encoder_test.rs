//! Tests the stage with conefield's conformance kit.

use @crate@::Settings;
use conefield_conformance::{Options, check_encoder};
use conefield_plugin::prelude::*;

#[test]
fn it_conforms() {
    for waves in [1, 6] {
        let stage = Settings { waves, ..Settings::default() }.build().unwrap();
        let report = check_encoder(stage.as_ref(), &Options::encoder());
        assert!(report.passed(), "{report}");
    }
}

#[test]
fn no_waves_are_refused_by_name() {
    let e = Settings { waves: 0, ..Settings::default() }.build().err().unwrap().to_string();
    assert!(e.contains("waves: found 0"), "{e}");
}
