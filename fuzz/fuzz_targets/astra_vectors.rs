#![no_main]

conefield_fuzz::target!("astra_vectors");
