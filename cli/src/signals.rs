//! Ctrl-C and termination: the first asks a run to end after its step, a second one ends the program at once.

use conefield_core::{Error, Result};
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};

static CAUGHT: OnceLock<Arc<AtomicUsize>> = OnceLock::new();

/// Starts to listen. Until then a signal ends the program as the system has it.
pub fn listen() -> Result<()> {
    let caught = CAUGHT.get_or_init(Arc::default);
    let again = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // Actions run in the order of their registration: the first signal still finds `again` down.
        flag::register_conditional_shutdown(signal, 128 + signal, again.clone())
            .and_then(|_| flag::register_usize(signal, caught.clone(), signal as usize))
            .and_then(|_| flag::register(signal, again.clone()))
            .map_err(|e| Error::io(Path::new("signal handlers"), e))?;
    }
    Ok(())
}

/// Takes the end of standard input for a termination: whoever started this run holds the other end.
pub fn follow_input() {
    std::thread::spawn(|| {
        let _ = io::copy(&mut io::stdin().lock(), &mut io::sink());
        note(SIGTERM as u8);
    });
}

/// Goes on as if this signal had come, unless one has.
pub fn note(signal: u8) {
    let caught = CAUGHT.get_or_init(Arc::default);
    let _ = caught.compare_exchange(0, signal.into(), Ordering::Relaxed, Ordering::Relaxed);
}

/// The signal that came, if any did.
pub fn caught() -> Option<u8> {
    let signal = CAUGHT.get()?.load(Ordering::Relaxed);
    u8::try_from(signal).ok().filter(|s| *s > 0)
}
