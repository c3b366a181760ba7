#![no_main]

conefield_fuzz::target!("dicom_jpeg_2000");
