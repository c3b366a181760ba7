//! Tests both stages with conefield's conformance kit.

use conefield_conformance::{Options, check_field, check_normalizer};
use conefield_plugin::settings::{FieldSpec, NormalizerSpec};
use siren::sine::Siren;
use siren::smooth::RaySmooth;

#[test]
fn siren_conforms() {
    for (settings, width) in [(Siren::default(), 20), (Siren { width: 5, depth: 3, omega: 1.0 }, 3)] {
        let report = check_field(settings.build(width).unwrap().as_ref(), &Options::features());
        assert!(report.passed(), "{report}");
    }
}

#[test]
fn ray_smooth_conforms() {
    for strength in [0.0, 0.25, 0.9] {
        let report = check_normalizer(RaySmooth { strength }.build(7).unwrap().as_ref(), &Options::features());
        assert!(report.passed(), "{report}");
    }
}
