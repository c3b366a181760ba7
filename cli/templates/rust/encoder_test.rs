//! Tests the stage with conefield's conformance kit.

use @crate@::Waves;
use conefield_conformance::{Options, check_encoder};
use conefield_plugin::prelude::*;

#[test]
fn it_conforms() {
    for waves in [1, 6] {
        let stage = Waves { waves, ..Waves::default() }.build().unwrap();
        let report = check_encoder(stage.as_ref(), &Options::encoder());
        assert!(report.passed(), "{report}");
    }
}

#[test]
fn no_waves_are_refused_by_name() {
    let e = Waves { waves: 0, ..Waves::default() }.build().err().unwrap().to_string();
    assert!(e.contains("waves: found 0"), "{e}");
}
