#![no_main]

conefield_fuzz::target!("zarr");
