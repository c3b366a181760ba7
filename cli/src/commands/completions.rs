//! `conefield completions`

use crate::boundary::refuse_existing;
use crate::out;
use clap::{Args, CommandFactory};
use clap_complete::{Shell, generate};
use conefield_core::{Error, Result};
use std::path::PathBuf;

/// Print completions for a shell, or write manual pages.
///
/// For bash: conefield completions bash > ~/.local/share/bash-completion/completions/conefield
#[derive(Args)]
pub struct CompletionsArgs {
    /// The shell.
    #[arg(required_unless_present = "man")]
    shell: Option<Shell>,
    /// Write a manual page for each command to this folder instead, such as ~/.local/share/man/man1.
    #[arg(long, value_name = "FOLDER", conflicts_with = "shell")]
    man: Option<PathBuf>,
    /// Write into a folder that is not empty.
    #[arg(long, requires = "man")]
    force: bool,
}

impl CompletionsArgs {
    pub fn run(self) -> Result<()> {
        let mut command = crate::Cli::command();
        if let Some(folder) = &self.man {
            refuse_existing(folder, self.force)?;
            let io = |e| Error::io(folder, e);
            std::fs::create_dir_all(folder).map_err(io)?;
            command.build();
            return clap_mangen::generate_to(command, folder).map_err(io);
        }
        let mut script = vec![];
        if let Some(shell) = self.shell {
            generate(shell, &mut command, "conefield", &mut script);
        }
        // Written byte for byte, as the reader is a shell.
        out::raw(&script)
    }
}
