//! The `conefield` command.

fn main() -> std::process::ExitCode {
    conefield::main()
}
