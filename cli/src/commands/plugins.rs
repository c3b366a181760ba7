//! `conefield plugins`

mod check;
mod list;
mod new;

use clap::{Args, Subcommand};
use conefield_core::Result;

/// Stages from shared libraries: list them, check them, begin one.
#[derive(Args)]
pub struct Plugins {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// List the plugins that are found, with their stages, or why one was refused.
    List(list::List),
    /// Run the conformance kit on every stage of a plugin.
    Check(check::Check),
    /// Make a folder with the start of a plugin: a stage, its test, and a spec that uses it.
    New(new::New),
}

impl Plugins {
    pub fn run(self) -> Result<()> {
        match self.command {
            Command::List(c) => c.run(),
            Command::Check(c) => c.run(),
            Command::New(c) => c.run(),
        }
    }
}
