//! Runs a reader over damaged bytes and reports its faults.

use super::Parser;
use super::mutate::mutated;
use std::collections::HashSet;
use std::fmt;
use std::fs;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Limits of a reader for an input of a few kilobytes.
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

/// A fault of a reader.
#[derive(Debug, Clone, PartialEq)]
pub enum ReaderFault {
    /// It panicked with this message.
    Panic(String),
    /// It used this many bytes of memory.
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

/// The result of a run over many mutations.
#[derive(Debug, Clone, Default)]
pub struct Seen {
    /// Mutations.
    pub count: u64,
    /// Mutations that were accepted.
    pub accepted: u64,
    /// The most bytes taken at a time.
    pub most_bytes: usize,
    /// The longest time.
    pub longest: Duration,
    /// Each fault with what its input is, and the input, unpacked.
    pub faults: Vec<(String, ReaderFault, Vec<u8>)>,
    /// Inputs whose end differs from those before them, unpacked. They are damaged further.
    pub found: Vec<Vec<u8>>,
}

/// Inputs that are damaged further, at most, and how much longer than the seed they may be.
const MOST_FOUND: usize = 256;
const LONGER: usize = 1024;

/// The end of an input: accepted (`None`), or refused with this message.
pub type End = Option<String>;

/// Runs `read`. Returns the end of its input, the bytes and the time; or the panic.
pub fn once<E: fmt::Display>(
    meter: Meter,
    read: impl FnOnce() -> Result<(), E>,
) -> Result<(End, usize, Duration), ReaderFault> {
    (meter.reset)();
    let before = (meter.current)();
    let start = Instant::now();
    let found = catch_unwind(AssertUnwindSafe(|| read().err().map(|e| e.to_string())));
    let (time, bytes) = (start.elapsed(), (meter.peak)().saturating_sub(before));
    match found {
        Ok(end) => Ok((end, bytes, time)),
        Err(words) => {
            let text = words.downcast_ref::<String>().cloned();
            let text = text.or_else(|| words.downcast_ref::<&str>().map(|s| (*s).to_owned()));
            Err(ReaderFault::Panic(text.unwrap_or_else(|| "something that is no text".into())))
        }
    }
}

/// A refusal without the value found, which differs between inputs, and without numbers.
fn shape(said: &str) -> String {
    let (before, after) = said.split_once(": found ").unwrap_or((said, ""));
    let after = after.rsplit_once(", expected ").map_or("", |(_, expected)| expected);
    let letters = |text: &str| text.chars().filter(|c| !c.is_ascii_digit()).take(80).collect::<String>();
    letters(before) + &letters(after)
}

impl Parser {
    /// The input that the reader takes, in the empty folder `dir`: the bytes that are damaged (unpacked), and their file.
    pub fn prepare(&self, dir: &Path) -> (Vec<u8>, PathBuf) {
        (self.seed)(dir);
        let file = dir.join(self.file);
        let packed = fs::read(&file).expect("the seed's own file");
        ((self.unpack)(packed), file)
    }

    /// Mutation `number` of one of the unpacked inputs `pool`.
    fn damaged(&self, pool: &[Vec<u8>], number: u64) -> Vec<u8> {
        // So that no two readers get the same damage.
        let salt = self.name.bytes().fold(0u64, |h, b| h.wrapping_mul(31).wrapping_add(b.into())) << 40;
        let number = salt | number;
        // The seed itself every second time.
        let which = number.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32;
        let from = &pool[if which.is_multiple_of(2) { 0 } else { (which / 2) as usize % pool.len() }];
        mutated(from, number, std::str::from_utf8(from).is_ok())
    }

    /// Feeds the reader `corpus`, then mutations with these numbers of its seed, of `corpus` and of what it ends
    /// differently on. It must accept the seed as it is. `dir` is an empty folder, best one in memory. The same arguments
    /// give the same inputs.
    pub fn run(&self, dir: &Path, numbers: Range<u64>, corpus: &[Vec<u8>], bounds: Bounds, meter: Meter) -> Seen {
        let (seed, file) = self.prepare(dir);
        if let Err(e) = (self.read)(dir) {
            panic!("{}: the seed itself is refused: {e}", self.name);
        }
        let longest = 2 * seed.len() + LONGER;
        let mut pool = vec![seed];
        pool.extend(corpus.iter().cloned());
        let mut shapes = HashSet::new();
        let mut seen = Seen { count: numbers.end - numbers.start, ..Seen::default() };
        let feed = |seen: &mut Seen, what: String, input: &[u8]| -> Option<End> {
            fs::write(&file, (self.pack)(input.to_vec())).expect("the seed's own file");
            let (end, fault) = match once(meter, || (self.read)(dir)) {
                Err(fault) => (None, Some(fault)),
                Ok((end, bytes, time)) => {
                    seen.most_bytes = seen.most_bytes.max(bytes);
                    seen.longest = seen.longest.max(time);
                    let hoard = (bytes > bounds.bytes).then_some(ReaderFault::Memory(bytes));
                    (Some(end), hoard.or((time > bounds.time).then_some(ReaderFault::Time(time))))
                }
            };
            seen.faults.extend(fault.map(|f| (what, f, input.to_vec())));
            end
        };
        // What is known comes first, so that only what is new counts as found.
        for (i, input) in corpus.iter().enumerate() {
            let end = feed(&mut seen, format!("input {i} of the corpus"), input);
            shapes.extend(end.map(|end| end.as_deref().map(shape)));
        }
        for number in numbers {
            let input = self.damaged(&pool, number);
            let Some(end) = feed(&mut seen, format!("mutation {number}"), &input) else { continue };
            seen.accepted += u64::from(end.is_none());
            let room = pool.len() < MOST_FOUND && input.len() <= longest;
            if room && shapes.insert(end.as_deref().map(shape)) {
                pool.push(input.clone());
                seen.found.push(input);
            }
        }
        seen
    }
}
