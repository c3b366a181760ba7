#![no_main]

conefield_fuzz::target!("tiff_volume");
