#![no_main]

conefield_fuzz::target!("nifti_gz");
