#![no_main]

conefield_fuzz::target!("scanner_toml");
