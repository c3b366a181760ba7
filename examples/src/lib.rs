//! Numbered examples, one idea each: `cargo run --release -p conefield-examples --example 01_reconstruct`.
