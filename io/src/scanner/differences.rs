//! The compression of Varian's HND and XIM: the first row and one pixel more as 32-bit integers, then for each pixel
//! what it differs by from its left neighbour, less what the two pixels above differ by. A table gives the number of
//! bytes of each difference: two bits, lowest first, 0 for one byte, 1 for two, 2 for four.
//!
//! Source of the layout: RTK (`HndImageIO`, `XimImageIO`).

use crate::memory;
use conefield_core::error::ensure;
use conefield_core::{Error, Result};

/// Most bytes after the last difference: the table's last byte may count up to three pixels that are not there.
const SPARE: usize = 12;

/// The image of `size` (rows, columns) from the `table` of lengths and the `packed` pixels of the file `place`.
pub(super) fn unpack(place: &str, size: [usize; 2], table: &[u8], packed: &[u8]) -> Result<Vec<f32>> {
    let [rows, columns] = size;
    let shown = format!("{rows} x {columns} pixels");
    ensure(rows > 1 && columns > 0, place, "size", &shown, "at least two rows of a pixel")?;
    let count = rows.checked_mul(columns).filter(|n| *n <= isize::MAX as usize / 4);
    let count = count.ok_or_else(|| Error::invalid(place, "size", &shown, "an image that can be addressed"))?;
    let (whole, differences) = (columns + 1, count - columns - 1);
    // Before memory is taken: a pixel has two bits of the table and at least one byte.
    let expected = format!("at least {} for {shown}", differences.div_ceil(4));
    ensure(table.len() >= differences.div_ceil(4), place, "lookup table", format!("{} bytes", table.len()), expected)?;
    let least = 4 * whole + differences;
    let expected = format!("at least {least} for {shown}");
    ensure(packed.len() >= least, place, "pixels", format!("{} bytes", packed.len()), expected)?;
    let mut values: Vec<i32> = Vec::new();
    memory::grow(&mut values, count, count, place, "pixels")?;
    let (first, mut left) = packed.split_at(4 * whole);
    values.extend(first.as_chunks().0.iter().map(|b| i32::from_le_bytes(*b)));
    for i in 0..differences {
        let code = (table[i / 4] >> (2 * (i % 4))) & 3;
        let (bytes, rest) = left.split_at_checked(1 << code).ok_or_else(|| {
            let found = format!("the end after {} of {count}", values.len());
            Error::invalid(place, "pixels", found, "a difference for each")
        })?;
        let difference = match *bytes {
            [a] => i32::from(a.cast_signed()),
            [a, b] => i32::from(i16::from_le_bytes([a, b])),
            [a, b, c, d] => i32::from_le_bytes([a, b, c, d]),
            _ => {
                let expected = "0, 1 or 2 for one, two or four bytes";
                return Err(Error::invalid(place, "lookup table", "the code 3", expected));
            }
        };
        let [here, above] = [values.len(), values.len() - columns];
        let step = values[above].wrapping_sub(values[above - 1]);
        values.push(values[here - 1].wrapping_add(step).wrapping_add(difference));
        left = rest;
    }
    let expected = "none (the size is wrong, or another file follows)";
    ensure(left.len() <= SPARE, place, "pixels", format!("{} bytes after the last", left.len()), expected)?;
    let mut out: Vec<f32> = Vec::new();
    memory::grow(&mut out, count, count, place, "pixels")?;
    out.extend(values.into_iter().map(|x| x as f32));
    Ok(out)
}

/// A writer for tests.
#[cfg(test)]
pub(super) mod tests {
    /// The table and the packed pixels of `values`, an image with `columns`: each difference in as few bytes as hold it.
    pub fn pack(values: &[i32], columns: usize) -> (Vec<u8>, Vec<u8>) {
        let mut packed: Vec<u8> = values[..=columns].iter().flat_map(|x| x.to_le_bytes()).collect();
        let mut codes = Vec::new();
        for i in columns + 1..values.len() {
            let d = values[i] - values[i - 1] - values[i - columns] + values[i - columns - 1];
            let bytes = d.to_le_bytes();
            let code = if i8::try_from(d).is_ok() {
                0
            } else if i16::try_from(d).is_ok() {
                1
            } else {
                2
            };
            packed.extend(&bytes[..1 << code]);
            codes.push(code);
        }
        (codes.chunks(4).map(|c| c.iter().rev().fold(0, |byte, code| byte << 2 | code)).collect(), packed)
    }

    #[test]
    fn every_length_of_a_difference_comes_back() {
        for (rows, columns) in [(2, 1), (3, 4), (5, 7)] {
            let values: Vec<i32> = (0..rows * columns).map(|i| [3, -5, 40_000, 7, 1_000_000_000, 12][i % 6]).collect();
            let (table, packed) = pack(&values, columns);
            let want: Vec<f32> = values.iter().map(|x| *x as f32).collect();
            assert_eq!(super::unpack("a", [rows, columns], &table, &packed).unwrap(), want);
        }
    }
}
