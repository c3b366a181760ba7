//! The `conefield` command.

use conefield::scratch::Allocator;

/// Keeps arrays beyond the memory limit in files.
#[global_allocator]
static HEAP: Allocator = Allocator;

fn main() -> std::process::ExitCode {
    conefield_cli::main()
}
