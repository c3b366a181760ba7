//! `conefield schema`

use crate::out;
use clap::Args;
use conefield_core::{Result, spec::schema};

/// Print the JSON Schema of spec files, for editors.
#[derive(Args)]
pub struct SchemaArgs {}

impl SchemaArgs {
    pub fn run(self) -> Result<()> {
        out::json(&schema::spec())
    }
}
