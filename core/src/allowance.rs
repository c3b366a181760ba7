//! Limits of what reading may use: memory for the whole process, work for each input.
//!
//! Readers charge what they really allocate and process, not what a header or a packed size claims. Memory need not be
//! given back: the process's own allocation count is authoritative.

use crate::error::{Error, Result};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

/// The byte limit of the process.
static MOST: AtomicU64 = AtomicU64::new(u64::MAX);

/// The function that returns the current allocation of the process.
static HELD: OnceLock<fn() -> u64> = OnceLock::new();

/// Bytes that may be at work at once.
static ROOM: AtomicU64 = AtomicU64::new(u64::MAX);

/// Gives pages of arrays on the disk back, if the process holds too many.
static TRIM: OnceLock<fn()> = OnceLock::new();

/// Limits the process to `most` bytes; `held` returns its current allocation. Without it there is no limit.
pub fn set_memory(most: u64, held: fn() -> u64) {
    MOST.store(most, Ordering::Relaxed);
    let _ = HELD.set(held);
}

/// Sets the bytes of arrays that memory holds at once; the other arrays are on the disk. `trim` frees their pages if the
/// process holds too many.
pub fn set_room(bytes: u64, trim: fn()) {
    ROOM.store(bytes, Ordering::Relaxed);
    let _ = TRIM.set(trim);
}

/// For loops through large arrays, once per part: gives pages back if the process holds too many. On a busy machine, the
/// thread that also does so may come late.
pub fn trim() {
    if let Some(trim) = TRIM.get() {
        trim();
    }
}

/// Bytes of an array that may be at work at once. A method that passes through a larger one many times does so part by
/// part.
pub fn room() -> u64 {
    ROOM.load(Ordering::Relaxed)
}

/// `bytes` for an error message.
pub(crate) fn mib(bytes: u64) -> String {
    if bytes < 1 << 20 { format!("{bytes} B") } else { format!("{} MiB", bytes.div_ceil(1 << 20)) }
}

/// Checks that `bytes` more may be allocated for `field` of the file `place`. This is a check, not a reservation: a
/// single thread reads.
pub fn memory(place: &str, field: &str, bytes: u64) -> Result<()> {
    let Some(held) = HELD.get() else { return Ok(()) };
    let (held, most) = (held(), MOST.load(Ordering::Relaxed));
    if held.saturating_add(bytes) <= most {
        return Ok(());
    }
    let found = format!("{} more, with {} already held", mib(bytes), mib(held));
    Err(Error::invalid(place, field, found, format!("at most {} in total, set by --memory or the system", mib(most))))
}

/// The same check for `count` 32-bit numbers.
pub fn numbers(place: &str, field: &str, count: usize) -> Result<()> {
    memory(place, field, (count as u64).saturating_mul(4))
}

/// A budget of work for one input: bytes, items or steps, in units of similar cost.
#[derive(Debug)]
pub struct Work {
    most: u64,
    left: u64,
}

impl Work {
    /// A budget of `most` units.
    pub fn new(most: u64) -> Self {
        Self { most, left: most }
    }

    /// Spends `units` on `what`.
    pub fn spend(&mut self, place: &str, what: &str, units: u64) -> Result<()> {
        let Some(left) = self.left.checked_sub(units) else {
            let expected = format!("at most {} in total, far more than any valid file needs", self.most);
            return Err(Error::invalid(place, what, format!("more than {}", self.most), expected));
        };
        self.left = left;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_spent_is_gone() {
        let mut work = Work::new(10);
        work.spend("a", "steps", 4).unwrap();
        work.spend("a", "steps", 6).unwrap();
        let e = work.spend("a.toml", "steps", 1).unwrap_err().to_string();
        assert!(e.contains("a.toml") && e.contains("steps") && e.contains("10"), "{e}");
    }

    #[test]
    fn memory_is_asked_for_beside_what_is_held() {
        // No other unit test of this crate reads a file of a gigabyte.
        memory("a", "data", u64::MAX).unwrap();
        set_memory(3 << 30, || 2 << 30);
        memory("a", "data", 1 << 30).unwrap();
        let e = numbers("a.nii", "data", (1 << 28) + 1).unwrap_err().to_string();
        for want in ["a.nii", "data", "1025 MiB", "2048 MiB", "3072 MiB", "--memory"] {
            assert!(e.contains(want), "{want}: {e}");
        }
        assert_eq!([1, 1 << 20, (1 << 20) + 1].map(mib), ["1 B", "1 MiB", "2 MiB"]);
    }
}
