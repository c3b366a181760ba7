//! FNV-1a checksums, to recognize a scan or a file (G. Fowler, L. C. Noll, K.-P. Vo, 1991; 64 bits, in hexadecimal).

use crate::{Error, Result};
use ndarray::Array3;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;

const START: u64 = 0xcbf2_9ce4_8422_2325;

/// The checksum of a text.
pub fn of_text(text: &str) -> String {
    format!("{:016x}", text.bytes().fold(START, step))
}

/// The checksum of the numbers of `array` in logical order, as little-endian bytes.
pub fn of_numbers(array: &Array3<f32>) -> String {
    format!("{:016x}", array.iter().fold(START, |hash, x| x.to_le_bytes().into_iter().fold(hash, step)))
}

/// The checksum of the bytes of a file.
pub fn of_file(path: &Path) -> Result<String> {
    let at = |e| Error::io(path, e);
    let mut file = BufReader::with_capacity(1 << 16, File::open(path).map_err(at)?);
    let mut hash = START;
    loop {
        let bytes = file.fill_buf().map_err(at)?;
        let n = bytes.len();
        if n == 0 {
            return Ok(format!("{hash:016x}"));
        }
        hash = bytes.iter().copied().fold(hash, step);
        file.consume(n);
    }
}

fn step(hash: u64, byte: u8) -> u64 {
    (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_checksums() {
        assert_eq!(of_text(""), "cbf29ce484222325");
        assert_eq!(of_text("foobar"), "85944171f73967e8");
        let one = Array3::from_elem((1, 1, 1), f32::from_le_bytes(*b"foob"));
        assert_eq!(of_numbers(&one), of_text("foob"));
        let dir = tempfile::tempdir().unwrap();
        let text = "x".repeat(100_000);
        std::fs::write(dir.path().join("x"), &text).unwrap();
        assert_eq!(of_file(&dir.path().join("x")).unwrap(), of_text(&text));
    }
}
