#![no_main]

conefield_fuzz::target!("hdf5");
