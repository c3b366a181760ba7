//! `conefield plugins`

mod check;
mod list;
mod new;

use clap::{Args, Subcommand};
use conefield_core::Result;

/// List, check or create plugins: shared libraries with stages.
#[derive(Args)]
pub struct PluginsArgs {
    #[command(subcommand)]
    command: PluginsCommand,
}

#[derive(Subcommand)]
enum PluginsCommand {
    /// List the plugins with their stages, or why one was refused.
    List(list::List),
    /// Run the conformance kit on every stage of a plugin.
    Check(check::Check),
    /// Create a plugin: a stage, its test, and a spec that uses it.
    New(new::New),
}

impl PluginsArgs {
    /// Whether this is `plugins check`.
    pub fn is_check(&self) -> bool {
        matches!(self.command, PluginsCommand::Check(_))
    }

    pub fn run(self) -> Result<()> {
        match self.command {
            PluginsCommand::List(c) => c.run(),
            PluginsCommand::Check(c) => c.run(),
            PluginsCommand::New(c) => c.run(),
        }
    }
}
