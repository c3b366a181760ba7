#![no_main]

conefield_fuzz::target!("r2");
