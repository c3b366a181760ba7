#![no_main]

conefield_fuzz::target!("metaimage_header");
