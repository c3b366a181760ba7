//! A library that ends the process, as Fortran's `stop` does: no run may end as if it were done.

#![allow(unsafe_code)]

use std::cell::Cell;
use std::sync::Once;

thread_local! {
    /// Whether this thread is in a function of a library.
    static INSIDE: Cell<bool> = const { Cell::new(false) };
}

unsafe extern "C" {
    fn atexit(function: extern "C" fn()) -> i32;
    fn _exit(status: i32) -> !;
}

extern "C" fn at_exit() {
    if INSIDE.get() {
        eprintln!("error: a plugin ended the process");
        // SAFETY: it ends the process at once, whatever the other threads do.
        unsafe { _exit(1) }
    }
}

/// Calls a function of a library.
pub(crate) fn inside<T>(call: impl FnOnce() -> T) -> T {
    static WATCH: Once = Once::new();
    // SAFETY: the function lives as long as the process.
    WATCH.call_once(|| _ = unsafe { atexit(at_exit) });
    let before = INSIDE.replace(true);
    let result = call();
    INSIDE.set(before);
    result
}
