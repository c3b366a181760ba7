//! Every reader takes damaged input without a panic, a hoard of memory or a hang. See `docs/bad-inputs.md`.

use conefield_tests::hostile::watch::{Bounds, Meter, ReaderFault};
use conefield_tests::hostile::{PARSERS, Parser, find};
use peak_alloc::PeakAlloc;
use std::path::Path;
use std::time::Duration;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

const METER: Meter =
    Meter { current: || MEMORY.current_usage(), peak: || MEMORY.peak_usage(), reset: || MEMORY.reset_peak_usage() };

/// What a reader may take: seeds are below 5 kB. Time is generous, as a loaded machine may stop for a while.
const BOUNDS: Bounds = Bounds { bytes: 16 << 20, time: Duration::from_secs(5) };

/// Mutations a reader.
const COUNT: u64 = 20_000;

/// A folder in memory where the system has one: a file is written for every mutation.
fn folder() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    let parent = if memory.is_dir() { memory.to_path_buf() } else { std::env::temp_dir() };
    tempfile::tempdir_in(parent).unwrap()
}

/// The only test of this program: the allocator counts for the whole process.
#[test]
fn no_mutation_makes_a_reader_panic_hoard_or_hang() {
    let count = std::env::var("CONEFIELD_MUTATIONS").map_or(COUNT, |n| n.parse().unwrap());
    let quiet = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let mut faults = Vec::new();
    let mut total = 0;
    for parser in PARSERS {
        let dir = folder();
        let start = std::time::Instant::now();
        let seen = parser.run(dir.path(), count, BOUNDS, METER);
        total += seen.count;
        println!(
            "{:18} {} mutations, {} accepted, most {} kB, longest {:?}, {:.1?}",
            parser.name,
            seen.count,
            seen.accepted,
            seen.most_bytes / 1000,
            seen.longest,
            start.elapsed()
        );
        let (seed, _) = parser.prepare(folder().path());
        for (number, fault) in seen.faults.iter().take(5) {
            let kept = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{}-{number}", parser.name));
            std::fs::write(&kept, parser.damaged(&seed, *number)).unwrap();
            faults.push(format!("{}: {fault} (the file is kept as {})", parser.name, kept.display()));
        }
    }
    controls(&mut faults);
    std::panic::set_hook(quiet);
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(total >= 200_000 || std::env::var_os("CONEFIELD_MUTATIONS").is_some());
}

/// Readers that do what none may do are told.
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
    let told: [(&str, Parser, Bounds, Is); 3] = [
        ("a panic", panics, BOUNDS, |f| *f == ReaderFault::Panic("on purpose".into())),
        ("a hoard", hoards, BOUNDS, |f| matches!(f, ReaderFault::Memory(n) if *n >= 17 << 20)),
        ("a hang", hangs, quick, |f| matches!(f, ReaderFault::Time(_))),
    ];
    for (what, parser, bounds, is) in told {
        let seen = parser.run(folder().path(), 100, bounds, METER);
        if !seen.faults.iter().any(|(_, f)| is(f)) {
            faults.push(format!("the harness does not tell {what}"));
        }
    }
}
