//! Tests the regularizer with conefield's conformance kit.

use conefield_conformance::check_regularizer;
use conefield_plugin::prelude::*;
use huber::huber::Huber;

#[test]
fn huber_conforms() {
    // The kit's coefficients are of order one.
    for settings in
        [Huber { threshold: 0.2, ..Huber::default() }, Huber { threshold: 0.05, inner: 1, ..Huber::default() }]
    {
        let report = check_regularizer(settings.build().unwrap().as_ref());
        assert!(report.passed(), "{report}");
    }
}
