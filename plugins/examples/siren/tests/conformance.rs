//! Tests the plugin's stages with conefield's conformance kit.

// Links the stages, which register themselves.
use siren as _;

#[test]
fn they_conform() {
    for report in conefield_conformance::check_package("siren").unwrap() {
        assert!(report.passed(), "{report}");
    }
}
