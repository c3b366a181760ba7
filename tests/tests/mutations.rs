//! Every reader takes damaged input without a panic, a hoard of memory or a hang. See `docs/reference/bad-inputs.md`.

use conefield_tests::hostile::watch::{Bounds, Meter, ReaderFault};
use conefield_tests::hostile::{PARSERS, Parser, find};
use peak_alloc::PeakAlloc;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

const METER: Meter =
    Meter { current: || MEMORY.current_usage(), peak: || MEMORY.peak_usage(), reset: || MEMORY.reset_peak_usage() };

/// What a reader may take: seeds are below 5 kB. Time is generous, as a loaded machine may stop for a while.
const BOUNDS: Bounds = Bounds { bytes: 16 << 20, time: Duration::from_secs(5) };

/// Mutations a reader, whose seed is no longer than [`USUAL`] bytes.
const COUNT: u64 = 10_000;
const USUAL: usize = 5000;

/// A folder in memory where the system has one: a file is written for every mutation.
fn folder() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    let parent = if memory.is_dir() { memory.to_path_buf() } else { std::env::temp_dir() };
    tempfile::tempdir_in(parent).unwrap()
}

/// A number from the environment.
fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).map_or(otherwise, |n| n.parse().unwrap())
}

/// What earlier hunts found for `parser`, unpacked, in the order of the files' names.
fn corpus(parser: &Parser) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(parser.name);
    let Ok(entries) = std::fs::read_dir(folder) else { return vec![] };
    let mut files: Vec<_> = entries.map(|e| e.unwrap().path()).collect();
    files.sort();
    files.iter().map(|f| std::fs::read(f).unwrap()).collect()
}

/// Processes among which the readers are divided: the allocator counts for a whole process.
const PARTS: usize = 2;

/// Runs this program once for each part of the readers.
fn parts() {
    let part = |k: usize| {
        let mut program = Command::new(std::env::current_exe().unwrap());
        program.arg("--nocapture").env("CONEFIELD_PART", k.to_string());
        program.spawn().unwrap()
    };
    let started: Vec<_> = (0..PARTS).map(part).collect();
    let ended: Vec<_> = started.into_iter().map(|mut part| part.wait().unwrap()).collect();
    assert!(ended.iter().all(|status| status.success()), "see above: {ended:?}");
}

/// The only test of this program: the allocator counts for the whole process.
///
/// `CONEFIELD_MUTATIONS=N` makes N mutations a reader, `CONEFIELD_FROM=N` begins with another number than 0, so that a long
/// hunt can go on in pieces; `CONEFIELD_KEEP=DIR` keeps the smallest inputs that ended in a way of their own.
#[test]
fn no_mutation_makes_a_reader_panic_hoard_or_hang() {
    let Ok(part) = std::env::var("CONEFIELD_PART") else { return parts() };
    let part: usize = part.parse().unwrap();
    let (from, count) = (number("CONEFIELD_FROM", 0), number("CONEFIELD_MUTATIONS", COUNT));
    let keep = std::env::var_os("CONEFIELD_KEEP").map(PathBuf::from);
    let quiet = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let mut faults = Vec::new();
    let (mut total, mut replayed) = (0, 0);
    for parser in PARSERS.iter().skip(part).step_by(PARTS) {
        let dir = folder();
        let corpus = corpus(parser);
        replayed += corpus.len();
        // A mutation of a long seed costs more: there are as many fewer.
        let long = parser.prepare(folder().path()).0.len();
        let count = count * USUAL.min(long) as u64 / long as u64;
        let start = std::time::Instant::now();
        let seen = parser.run(dir.path(), from..from + count, &corpus, BOUNDS, METER);
        total += seen.count;
        println!(
            "{:18} {} mutations, {} accepted, {} found, most {} kB, longest {:?}, {:.1?}",
            parser.name,
            seen.count,
            seen.accepted,
            seen.found.len(),
            seen.most_bytes / 1000,
            seen.longest,
            start.elapsed()
        );
        for (what, fault, input) in seen.faults.iter().take(5) {
            let name = format!("{}-{}", parser.name, what.replace(' ', "-"));
            let kept = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
            std::fs::write(&kept, input).unwrap();
            faults.push(format!("{}: {fault}, {what} (kept, unpacked, as {})", parser.name, kept.display()));
        }
        if let Some(keep) = &keep {
            let to = keep.join(parser.name);
            std::fs::create_dir_all(&to).unwrap();
            let mut found = seen.found;
            found.sort_by_key(Vec::len);
            for input in found.iter().take(KEPT) {
                std::fs::write(to.join(format!("{:016x}", fnv(input))), input).unwrap();
            }
        }
    }
    controls(&mut faults);
    std::panic::set_hook(quiet);
    println!("{total} mutations, {replayed} inputs of the corpus");
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(total >= 200_000 / PARTS as u64 || std::env::var_os("CONEFIELD_MUTATIONS").is_some());
    assert!(replayed > 0 || keep.is_some(), "the corpus is gone");
}

/// Inputs of a reader that are kept of a hunt.
const KEPT: usize = 8;

/// FNV-1a, to name an input by what it holds.
fn fnv(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3))
}

/// Checks that the harness reports faulty readers.
fn controls(faults: &mut Vec<String>) {
    fn damaged(dir: &Path) -> bool {
        std::fs::read(dir.join("a.npy")).unwrap().len() < 100
    }
    let bad = |read| Parser { read, ..*find("npy").unwrap() };
    let panics = bad(|dir| if damaged(dir) { panic!("on purpose") } else { Ok(()) });
    let hoards = bad(|dir| {
        let size = if damaged(dir) { 17 << 20 } else { 0 };
        std::hint::black_box(Vec::<u8>::with_capacity(size));
        Ok(())
    });
    let hangs = bad(|dir| {
        std::thread::sleep(Duration::from_millis(if damaged(dir) { 2 } else { 0 }));
        Ok(())
    });
    let quick = Bounds { time: Duration::from_millis(1), ..BOUNDS };
    type Is = fn(&ReaderFault) -> bool;
    let cases: [(&str, Parser, Bounds, Is); 3] = [
        ("a panic", panics, BOUNDS, |f| *f == ReaderFault::Panic("on purpose".into())),
        ("a hoard", hoards, BOUNDS, |f| matches!(f, ReaderFault::Memory(n) if *n >= 17 << 20)),
        ("a hang", hangs, quick, |f| matches!(f, ReaderFault::Time(_))),
    ];
    for (what, parser, bounds, is) in cases {
        let seen = parser.run(folder().path(), 0..100, &[], bounds, METER);
        if !seen.faults.iter().any(|(_, f, _)| is(f)) {
            faults.push(format!("the harness does not report {what}"));
        }
    }
}
