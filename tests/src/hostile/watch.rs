//! Runs a reader over damaged bytes, and tells what no reader may do.

use super::Parser;
use super::mutate::mutated;
use std::fmt;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// What a reader may take for an input of a few kilobytes.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// Bytes of memory at a time, beyond those held before.
    pub bytes: usize,
    /// Time.
    pub time: Duration,
}

/// Looks at the allocator: bytes in use, and the most since the last `reset`.
#[derive(Clone, Copy)]
pub struct Meter {
    /// Bytes in use now.
    pub current: fn() -> usize,
    /// The most bytes in use since `reset`.
    pub peak: fn() -> usize,
    /// Starts anew.
    pub reset: fn(),
}

/// What a reader did that none may do.
#[derive(Debug, Clone, PartialEq)]
pub enum ReaderFault {
    /// It panicked with these words.
    Panic(String),
    /// It took this many bytes.
    Memory(usize),
    /// It took this long.
    Time(Duration),
}

impl fmt::Display for ReaderFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Panic(words) => write!(f, "panicked: {words}"),
            Self::Memory(bytes) => write!(f, "took {bytes} bytes of memory"),
            Self::Time(time) => write!(f, "took {time:?}"),
        }
    }
}

/// What a run over many mutations saw.
#[derive(Debug, Clone, Default)]
pub struct Seen {
    /// Mutations.
    pub count: u64,
    /// Those that were read all the same.
    pub accepted: u64,
    /// The most bytes taken at a time.
    pub most_bytes: usize,
    /// The longest time.
    pub longest: Duration,
    /// Each fault with the number of its mutation.
    pub faults: Vec<(u64, ReaderFault)>,
}

/// Runs `read` and tells whether it accepted its input, and what it took; or the panic.
pub fn once<E>(meter: Meter, read: impl FnOnce() -> Result<(), E>) -> Result<(bool, usize, Duration), ReaderFault> {
    (meter.reset)();
    let before = (meter.current)();
    let start = Instant::now();
    let found = catch_unwind(AssertUnwindSafe(|| read().is_ok()));
    let (time, bytes) = (start.elapsed(), (meter.peak)().saturating_sub(before));
    match found {
        Ok(accepted) => Ok((accepted, bytes, time)),
        Err(words) => {
            let text = words.downcast_ref::<String>().cloned();
            let text = text.or_else(|| words.downcast_ref::<&str>().map(|s| (*s).to_owned()));
            Err(ReaderFault::Panic(text.unwrap_or_else(|| "something that is no text".into())))
        }
    }
}

impl Parser {
    /// The input that the reader takes, in the empty folder `dir`: the bytes that are damaged (unpacked), and their file.
    pub fn prepare(&self, dir: &Path) -> (Vec<u8>, PathBuf) {
        (self.seed)(dir);
        let file = dir.join(self.file);
        let packed = fs::read(&file).expect("the seed's own file");
        ((self.unpack)(packed), file)
    }

    /// The file's content with mutation `number` of the unpacked `seed`.
    pub fn damaged(&self, seed: &[u8], number: u64) -> Vec<u8> {
        // So that no two readers get the same damage.
        let salt = self.name.bytes().fold(0u64, |h, b| h.wrapping_mul(31).wrapping_add(b.into())) << 32;
        (self.pack)(mutated(seed, salt | number, std::str::from_utf8(seed).is_ok()))
    }

    /// Feeds the reader `count` mutations of its seed, which it must accept as it is. `dir` is an empty folder, best
    /// one in memory.
    pub fn run(&self, dir: &Path, count: u64, bounds: Bounds, meter: Meter) -> Seen {
        let (seed, file) = self.prepare(dir);
        if let Err(e) = (self.read)(dir) {
            panic!("{}: the seed itself is refused: {e}", self.name);
        }
        let mut seen = Seen { count, ..Seen::default() };
        for number in 0..count {
            fs::write(&file, self.damaged(&seed, number)).expect("the seed's own file");
            let fault = match once(meter, || (self.read)(dir)) {
                Err(fault) => Some(fault),
                Ok((accepted, bytes, time)) => {
                    seen.accepted += u64::from(accepted);
                    seen.most_bytes = seen.most_bytes.max(bytes);
                    seen.longest = seen.longest.max(time);
                    let hoard = (bytes > bounds.bytes).then_some(ReaderFault::Memory(bytes));
                    hoard.or((time > bounds.time).then_some(ReaderFault::Time(time)))
                }
            };
            seen.faults.extend(fault.map(|f| (number, f)));
        }
        seen
    }
}
