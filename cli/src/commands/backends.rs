//! `conefield backends`

use crate::out;
use clap::Args;
use conefield_core::{Result, simd};
use serde_json::json;

/// List what can do the computing here.
#[derive(Args)]
pub struct Backends {
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl Backends {
    pub fn run(self) -> Result<()> {
        let (level, threads) = (simd_level(), rayon::current_num_threads());
        if self.json {
            return out::json(&json!({ "backends": [{ "name": "cpu", "simd": level, "threads": threads }] }));
        }
        out::say(&format!("cpu  {level}, {threads} threads"))
    }
}

/// The instruction set that kernels use on this machine.
pub fn simd_level() -> String {
    let debug = format!("{:?}", simd::level());
    debug.split(['(', ' ', '{']).next().unwrap_or_default().to_owned()
}
