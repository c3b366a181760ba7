//! Tests the stage with conefield's conformance kit.

// Links the stage, which registers itself.
use @crate@ as _;

#[test]
fn it_conforms() {
    for report in conefield_conformance::check_package("@name@").unwrap() {
        assert!(report.passed(), "{report}");
    }
}
