//! FNV-1a checksums, to recognize a scan (G. Fowler, L. C. Noll, K.-P. Vo, 1991; 64 bits, in hexadecimal).

use ndarray::Array3;

const START: u64 = 0xcbf2_9ce4_8422_2325;

/// The checksum of a text.
pub fn of_text(text: &str) -> String {
    format!("{:016x}", text.bytes().fold(START, step))
}

/// The checksum of the numbers of `array` in logical order, as little-endian bytes.
pub fn of_numbers(array: &Array3<f32>) -> String {
    format!("{:016x}", array.iter().fold(START, |hash, x| x.to_le_bytes().into_iter().fold(hash, step)))
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
    }
}
