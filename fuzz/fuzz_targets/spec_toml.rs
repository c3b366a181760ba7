#![no_main]

conefield_fuzz::target!("spec_toml");
