//! The `conefield` command.

use peak_alloc::PeakAlloc;

/// Counts what is held, so that readers can be kept within what they may take.
#[global_allocator]
static HEAP: PeakAlloc = PeakAlloc;

fn main() -> std::process::ExitCode {
    conefield::main(|| HEAP.current_usage() as u64)
}
