//! The `conefield` command.

use peak_alloc::PeakAlloc;

/// Counts allocated bytes, so that readers can be limited.
#[global_allocator]
static HEAP: PeakAlloc = PeakAlloc;

fn main() -> std::process::ExitCode {
    conefield_cli::main(|| HEAP.current_usage() as u64)
}
