//! Writer of TensorBoard's event file: curves and images of a run while it goes on.
//!
//! The file is a sequence of TFRecords (length, masked CRC-32C of it, data, masked CRC-32C of that), each an `Event`
//! encoded as a protocol buffer, of which a few fields suffice. Source: TensorFlow's `record_writer`, `event.proto` and
//! `summary.proto`.

use crate::input::read_up_to;
use conefield_core::{Error, Result};
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Longest event that is kept when a file is opened again, in bytes: far above a picture's size.
const LONGEST: u64 = 1 << 28;

/// An event file open for appending.
pub struct EventFile {
    path: PathBuf,
    file: File,
}

impl EventFile {
    /// Creates the file `path`, replacing an earlier one. TensorBoard reads files whose names contain `tfevents`.
    pub fn create(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref().to_path_buf();
        let file = File::create(&path).map_err(|e| Error::io(&path, e))?;
        let mut new = Self { path, file };
        // Field 3, file_version.
        let version = bytes_field(3, b"brain.Event:2");
        new.write(&[time(), version].concat())?;
        Ok(new)
    }

    /// Opens the file `path` to continue after `step`, with the step of the last event kept. Events of later steps, and
    /// anything after a damaged event are removed. Creates the file if it does not exist or is not an event file.
    pub fn resume(path: impl AsRef<Path>, step: u64) -> Result<(Self, Option<u64>)> {
        let path = path.as_ref();
        let error = |e| Error::io(path, e);
        let file = match File::options().read(true).write(true).open(path) {
            Ok(file) => file,
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok((Self::create(path)?, None)),
            Err(e) => return Err(error(e)),
        };
        let mut reader = BufReader::new(&file);
        let (mut end, mut last) = (0, None);
        while let Some(event) = next(&mut reader) {
            let at = step_of(&event);
            if at.is_some_and(|at| at > step) {
                break;
            }
            last = at.or(last);
            end += 16 + event.len() as u64;
        }
        if end == 0 {
            return Ok((Self::create(path)?, None));
        }
        file.set_len(end).map_err(error)?;
        (&file).seek(SeekFrom::Start(end)).map_err(error)?;
        Ok((Self { path: path.to_path_buf(), file }, last))
    }

    /// Adds the numbers `values` at `step`, each a point on the curve of its name. Values that are not finite are
    /// skipped.
    pub fn scalars<'a>(&mut self, step: u64, values: impl IntoIterator<Item = (&'a str, f64)>) -> Result<()> {
        let value = |(name, x): (&str, f64)| {
            // simple_value is field 2, 32 bits.
            let number = [vec![0x15], (x as f32).to_le_bytes().to_vec()].concat();
            bytes_field(1, &[bytes_field(1, name.as_bytes()), number].concat())
        };
        let summary: Vec<u8> = values.into_iter().filter(|(_, x)| x.is_finite()).flat_map(value).collect();
        if summary.is_empty() { Ok(()) } else { self.summary(step, &summary) }
    }

    /// Adds the image `png`, named `name`, at `step`. Does nothing if it is not a PNG.
    pub fn picture(&mut self, step: u64, name: &str, png: &[u8]) -> Result<()> {
        // Width and height are in the first chunk.
        let number = |at: usize| png.get(at..)?.first_chunk().map(|b| u64::from(u32::from_be_bytes(*b)));
        let (Some(width), Some(height)) = (number(16), number(20)) else { return Ok(()) };
        // Colour space 3 is RGB.
        let image = [number_field(1, height), number_field(2, width), number_field(3, 3), bytes_field(4, png)];
        let value = [bytes_field(1, name.as_bytes()), bytes_field(4, &image.concat())].concat();
        self.summary(step, &bytes_field(1, &value))
    }

    /// Field 2 of an event is the step, field 5 the summary.
    fn summary(&mut self, step: u64, summary: &[u8]) -> Result<()> {
        self.write(&[time(), number_field(2, step), bytes_field(5, summary)].concat())
    }

    fn write(&mut self, event: &[u8]) -> Result<()> {
        let length = (event.len() as u64).to_le_bytes();
        let [head, tail] = [&length[..], event].map(|b| masked(crc32c(b)).to_le_bytes());
        // Written in one piece, so that a reader never sees half a record.
        let record = [&length[..], &head, event, &tail].concat();
        self.file.write_all(&record).map_err(|e| Error::io(&self.path, e))
    }
}

/// The next event of a file; `None` at its end and where it is damaged.
fn next(reader: &mut dyn Read) -> Option<Vec<u8>> {
    let mut head = [0; 12];
    reader.read_exact(&mut head).ok()?;
    let (length, check) = head.split_at(8);
    if check != masked(crc32c(length)).to_le_bytes() {
        return None;
    }
    let length = u64::from_le_bytes(length.try_into().ok()?);
    let event = read_up_to(reader, length.min(LONGEST)).ok()?;
    let mut check = [0; 4];
    reader.read_exact(&mut check).ok()?;
    (event.len() as u64 == length && check == masked(crc32c(&event)).to_le_bytes()).then_some(event)
}

/// The step of an event as this module writes it, after its time.
fn step_of(event: &[u8]) -> Option<u64> {
    let mut step = 0;
    let varint = event.get(9..).and_then(|rest| rest.strip_prefix(&[0x10]))?;
    for (k, byte) in varint.iter().take(9).enumerate() {
        step |= u64::from(byte & 0x7f) << (7 * k);
        if byte & 0x80 == 0 {
            return Some(step);
        }
    }
    None
}

/// Field 1 of an event, the time in seconds.
fn time() -> Vec<u8> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64());
    [vec![0x09], now.to_le_bytes().to_vec()].concat()
}

/// A field of wire type 0.
fn number_field(field: u8, value: u64) -> Vec<u8> {
    [vec![field << 3], varint(value)].concat()
}

/// A field of wire type 2.
fn bytes_field(field: u8, value: &[u8]) -> Vec<u8> {
    [&[field << 3 | 2][..], &varint(value.len() as u64), value].concat()
}

fn varint(mut value: u64) -> Vec<u8> {
    let mut out = Vec::new();
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
    out
}

/// Castagnoli's CRC, bit by bit (RFC 3720, section 12.1).
fn crc32c(bytes: &[u8]) -> u32 {
    let step = |crc: u32| if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 };
    !bytes.iter().fold(!0, |crc, b| (0..8).fold(crc ^ u32::from(*b), |crc, _| step(crc)))
}

/// Masked as in TFRecords, so that data containing a CRC still has a valid CRC.
fn masked(crc: u32) -> u32 {
    crc.rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_castagnolis() {
        // RFC 3720, B.4, and the usual check value.
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(&[0xff; 32]), 0x62a8_ab43);
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
        assert_eq!([varint(0), varint(127), varint(300)], [vec![0], vec![127], vec![0xac, 2]]);
    }

    #[test]
    fn records_are_whole_and_hold_what_was_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("events.out.tfevents.test");
        let mut file = EventFile::create(&path).unwrap();
        file.scalars(300, [("loss", 0.5), ("nothing", f64::NAN)]).unwrap();
        file.scalars(301, [("nothing", f64::INFINITY)]).unwrap();
        file.picture(302, "slices", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x07\0\0\x01\0rest").unwrap();
        file.picture(303, "slices", b"no picture").unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let mut reader = &bytes[..];
        // The bytes after the time.
        let events: Vec<Vec<u8>> = std::iter::from_fn(|| next(&mut reader)).map(|event| event[9..].to_vec()).collect();
        assert!(reader.is_empty());
        let half = 0.5f32.to_le_bytes();
        let loss = [&[0x10, 0xac, 2, 0x2a, 13, 0x0a, 11, 0x0a, 4][..], b"loss", &[0x15], &half].concat();
        assert_eq!(events[..2], [[&[0x1a, 13][..], b"brain.Event:2"].concat(), loss]);
        assert_eq!(events.len(), 3);
        // Height 256, width 7.
        assert!(events[2].windows(6).any(|w| w == [0x08, 0x80, 2, 0x10, 7, 0x18]), "{:?}", events[2]);
    }

    #[test]
    fn a_resumed_file_keeps_what_comes_before_the_step() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("events.out.tfevents.test");
        assert_eq!(EventFile::resume(&path, 9).unwrap().1, None);
        let mut file = EventFile::create(&path).unwrap();
        file.scalars(3, [("loss", 0.5)]).unwrap();
        file.picture(300, "slices", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x07\0\0\x01\0rest").unwrap();
        let kept = std::fs::read(&path).unwrap();
        file.scalars(301, [("loss", 0.4)]).unwrap();
        let (mut file, last) = EventFile::resume(&path, 300).unwrap();
        assert_eq!((last, std::fs::read(&path).unwrap()), (Some(300), kept.clone()));
        file.scalars(301, [("loss", 0.3)]).unwrap();
        drop(file);
        let whole = std::fs::read(&path).unwrap();
        assert!(whole.starts_with(&kept) && whole.len() > kept.len());
        // Half an event, a wrong checksum, or a length beyond the end of the file ends the events that are kept.
        let (mut short, mut wrong, mut long) = (whole.clone(), whole.clone(), whole.clone());
        short.pop();
        *wrong.last_mut().unwrap() ^= 1;
        long[kept.len() + 3] ^= 1;
        for damaged in [short, wrong, long] {
            std::fs::write(&path, damaged).unwrap();
            assert_eq!(EventFile::resume(&path, u64::MAX).unwrap().1, Some(300));
            assert_eq!(std::fs::read(&path).unwrap(), kept);
        }
        // Another file is replaced.
        std::fs::write(&path, "text").unwrap();
        assert_eq!(EventFile::resume(&path, 5).unwrap().1, None);
        assert_eq!(EventFile::resume(&path, 5).unwrap().1, None);
        assert_eq!(std::fs::metadata(&path).unwrap().len(), 40);
    }
}
