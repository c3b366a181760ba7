//! Bad input of every kind through the real command: it ends in time, in bounded memory, with the documented status and
//! one message that names the place, the problem and the expectation; it leaves nothing behind.
//!
//! The outcome is recorded in `cases.md`. `CONEFIELD_BLESS=1 cargo test --release --workspace --test bad_input` writes it;
//! without that variable the table must match the current behaviour.

#![cfg(target_os = "linux")]

mod case;
mod command;
mod dicom;
mod hdf5;
mod levers;
mod matlab;
mod metaimage;
mod naf;
mod nifti;
mod numpy;
mod page;
mod r2;
mod scan_folder;
mod scanner;
mod small;
mod spec;
mod study;
mod tiff;
mod weights;

use case::{Case, Outcome};
use rayon::prelude::*;

#[test]
fn every_bad_input_ends_as_the_table_says() {
    let sections: Vec<(&str, Vec<Case>)> = vec![
        ("NIfTI", nifti::cases()),
        ("MetaImage", metaimage::cases()),
        ("NumPy: `.npy` and `.npz`", numpy::cases()),
        ("MATLAB: `.mat`", matlab::cases()),
        ("DICOM series", dicom::cases()),
        ("TIFF stacks", tiff::cases()),
        ("HDF5 and Nikon's description", hdf5::cases()),
        ("Scanner descriptions, RTK's geometry, ASTRA's vectors", scanner::cases()),
        ("NAF's pickle", naf::cases()),
        ("R2-Gaussian's folder", r2::cases()),
        ("The project's own scan folder", scan_folder::cases()),
        ("Weights and checkpoints", weights::cases()),
        ("Pipeline specs", spec::cases()),
        ("Levers and fronts", levers::cases()),
        ("Study files", study::cases()),
        ("Small files that claim or unpack to much", small::cases()),
        ("Values on the command line", command::cases()),
    ];
    let count: usize = sections.iter().map(|(_, cases)| cases.len()).sum();
    assert!(count >= 80, "{count} cases");
    let run: Vec<(&str, Vec<Outcome>)> =
        sections.iter().map(|(title, cases)| (*title, cases.par_iter().map(Case::run).collect())).collect();
    let faults: Vec<String> = run.iter().flat_map(|(_, all)| all).flat_map(|o| o.faults.clone()).collect();
    assert!(faults.is_empty(), "{} faults\n{}", faults.len(), faults.join("\n"));
    page::check(&run);
}
