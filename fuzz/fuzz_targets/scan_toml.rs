#![no_main]

conefield_fuzz::target!("scan_toml");
