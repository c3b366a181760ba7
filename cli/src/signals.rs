//! Ctrl-C, termination and a closed terminal. A command that listens stops after its step at the first signal and
//! immediately at the second; other commands stop immediately. Unfinished files are removed first.

use conefield_core::{Error, Result};
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use tracing::warn;

/// The first signal received, or 0.
static CAUGHT: AtomicU8 = AtomicU8::new(0);
/// Whether the command checks [`caught`].
static LISTENING: AtomicBool = AtomicBool::new(false);

/// Starts to watch for signals.
pub fn watch() -> Result<()> {
    let mut wanted = vec![SIGINT, SIGTERM];
    wanted.extend(hangup());
    let mut signals = Signals::new(wanted).map_err(|e| Error::io(Path::new("signal handlers"), e))?;
    std::thread::spawn(move || {
        for signal in signals.forever() {
            let first = CAUGHT.compare_exchange(0, signal as u8, Ordering::Relaxed, Ordering::Relaxed).is_ok();
            if !(first && LISTENING.load(Ordering::Relaxed)) {
                conefield_io::discard_unfinished();
                std::process::exit(128 + signal);
            }
            warn!("stops after the current step; a second signal stops at once");
        }
    });
    Ok(())
}

/// From now on the command checks [`caught`] and stops by itself.
pub fn listen() {
    LISTENING.store(true, Ordering::Relaxed);
}

/// The signal of a closed terminal, unless the parent process ignores it, as `nohup` does.
fn hangup() -> Option<i32> {
    #[cfg(target_os = "linux")]
    {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        let ignored = status.lines().find_map(|l| l.strip_prefix("SigIgn:"))?;
        let ignored = u64::from_str_radix(ignored.trim(), 16).ok()?;
        let hangup = signal_hook::consts::SIGHUP;
        (ignored & (1 << (hangup - 1)) == 0).then_some(hangup)
    }
    #[cfg(not(target_os = "linux"))]
    None
}

/// Treats the end of standard input as termination: the parent process holds the other end.
pub fn follow_input() {
    std::thread::spawn(|| {
        let _ = io::copy(&mut io::stdin().lock(), &mut io::sink());
        note(SIGTERM as u8);
    });
}

/// Acts as if this signal had been received, unless one was received already.
pub fn note(signal: u8) {
    let _ = CAUGHT.compare_exchange(0, signal, Ordering::Relaxed, Ordering::Relaxed);
}

/// The signal received, if any.
pub fn caught() -> Option<u8> {
    Some(CAUGHT.load(Ordering::Relaxed)).filter(|s| *s > 0)
}
