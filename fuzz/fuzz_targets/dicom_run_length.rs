#![no_main]

conefield_fuzz::target!("dicom_run_length");
