//! Damage to bytes: the same seed gives the same damage.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Numbers at which lengths, counts and signs go wrong.
const EDGES: [u64; 14] = [
    0,
    1,
    2,
    0x7f,
    0x80,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    1 << 62,
    i64::MAX as u64,
    u64::MAX,
];

/// What a number in a text may become.
const WORDS: [&str; 12] = [
    "0", "-1", "nan", "inf", "1e999", "-1e-320", "18446744073709551616", "4611686018427387904", "\"\"", "[]", "{}", "x",
];

/// One to four changes to `seed`, of what `number` chooses; `text` adds those that keep a text readable.
pub fn mutated(seed: &[u8], number: u64, text: bool) -> Vec<u8> {
    let mut rng = ChaCha8Rng::seed_from_u64(number);
    let mut bytes = seed.to_vec();
    for _ in 0..rng.random_range(1..=4) {
        change(&mut bytes, &mut rng, text);
    }
    bytes
}

fn change(bytes: &mut Vec<u8>, rng: &mut impl Rng, text: bool) {
    if bytes.is_empty() {
        bytes.push(rng.random());
        return;
    }
    let at = rng.random_range(0..bytes.len());
    let piece = at..(at + rng.random_range(1..=16)).min(bytes.len());
    match rng.random_range(0..if text { 14 } else { 10 }) {
        0 => bytes[at] ^= 1 << rng.random_range(0..8),
        1 => bytes[at] = rng.random(),
        2 => bytes.truncate(at),
        3 => drop(bytes.drain(piece)),
        4 => {
            let again = bytes[piece].to_vec();
            bytes.splice(at..at, again);
        }
        5 => {
            let from = bytes[piece].to_vec();
            let to = rng.random_range(0..bytes.len());
            let end = (to + from.len()).min(bytes.len());
            bytes.splice(to..end, from);
        }
        6 => bytes.insert(at, rng.random()),
        7..10 => edge(bytes, at, rng),
        10 | 11 => word(bytes, at, rng),
        12 => drop(bytes.drain(line(bytes, at))),
        _ => {
            let again = bytes[line(bytes, at)].to_vec();
            bytes.splice(at..at, again);
        }
    }
}

/// A number of one to eight bytes, of either order, at the edge of what it can say.
fn edge(bytes: &mut [u8], at: usize, rng: &mut impl Rng) {
    let size = [1, 2, 4, 8][rng.random_range(0..4)];
    let value = EDGES[rng.random_range(0..EDGES.len())];
    let mut raw = value.to_le_bytes()[..size].to_vec();
    if rng.random() {
        raw.reverse();
    }
    for (to, from) in bytes[at..].iter_mut().zip(raw) {
        *to = from;
    }
}

/// Another value in place of the number that starts behind `at`.
fn word(bytes: &mut Vec<u8>, at: usize, rng: &mut impl Rng) {
    let digit = |b: &u8| b.is_ascii_digit() || matches!(b, b'.' | b'-');
    let start = at + bytes[at..].iter().position(digit).unwrap_or(0);
    let end = start + bytes[start..].iter().take_while(|b| digit(b)).count();
    bytes.splice(start..end, WORDS[rng.random_range(0..WORDS.len())].bytes());
}

/// The line around `at`, with its end.
fn line(bytes: &[u8], at: usize) -> std::ops::Range<usize> {
    let start = bytes[..at].iter().rposition(|b| *b == b'\n').map_or(0, |i| i + 1);
    let end = bytes[at..].iter().position(|b| *b == b'\n').map_or(bytes.len(), |i| at + i + 1);
    start..end
}
