//! Numerical extremes, a table of cases, and how errors of single precision grow.
//!
//! The outcome is kept in `cases.md`. The ordinary cases run with the other tests; the long ones with
//! `cargo test --release -p conefield-tests --test extremes -- --ignored`. With `CONEFIELD_BLESS=1` each part writes its
//! table anew; otherwise all but the figures is compared.

#[path = "../common/mod.rs"]
#[allow(dead_code)]
mod common;

mod case;
mod growth;
mod page;
mod scans;
mod stages;
mod training;

use case::Case;

/// Runs cases, holds them against what they must come to, and keeps them on the page.
fn all(part: &str, groups: Vec<(&'static str, Vec<Case>)>) {
    let mut faults = vec![];
    let mut text = String::new();
    for (title, cases) in groups {
        text += &page::head(title);
        for case in cases {
            let row = case.run();
            println!("{title}: {}", row.line());
            faults.extend(row.fault.clone().map(|f| format!("{title}: {}: {f}", row.what)));
            text += &row.line();
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    page::keep(part, &text);
}

#[test]
fn extremes_end_as_they_should() {
    all(
        "cases",
        vec![
            ("Units", scans::units()),
            ("What is scanned", scans::objects()),
            ("Photons", scans::photons()),
            ("Views", scans::views()),
            ("Detectors and volumes", scans::sizes()),
            ("Source and detector", scans::distances()),
            ("Encoders and fields", stages::sizes()),
            ("Samples", stages::samples()),
            ("LayerNorm", stages::layer_norm()),
            ("Masks", stages::masks()),
            ("Learning rates", training::rates()),
        ],
    );
}

#[test]
#[ignore = "minutes; see the head of this file"]
fn long_extremes_end_as_they_should() {
    all("long", vec![("Large tables", stages::large()), ("Long runs", training::long())]);
}

#[test]
fn errors_of_single_precision_grow_as_the_page_says() {
    growth::check();
}
