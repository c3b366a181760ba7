//! NumPy's `.npz`: a ZIP archive of `.npy` files, stored or deflated.

use crate::input::{Input, must_unpack};
use crate::npy;
use conefield_core::{Error, Result, files};
use flate2::Crc;
use flate2::bufread::DeflateDecoder;
use ndarray::ArrayD;
use std::io::{BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::Path;
use zip::{CompressionMethod, ZipArchive};

/// The magic bytes of a ZIP archive that is not empty.
pub(crate) const MAGIC: &[u8] = b"PK\x03\x04";

/// Reads the array `name` of the archive (the only one if `None`) with any of the sets of axes, like [`npy::read`].
pub(crate) fn read(path: &Path, name: Option<&str>, sets: &[&[&str]]) -> Result<ArrayD<f32>> {
    npy::read_counts(&mut open(path, name)?, sets).map(|(array, _)| array)
}

/// Shape and numbers of the small array `name`, like [`npy::read_exact`].
pub(crate) fn read_exact(path: &Path, name: Option<&str>) -> Result<(Vec<usize>, Vec<f64>)> {
    npy::read_exact(&mut open(path, name)?)
}

/// The shape of the array `name`, from its header.
pub(crate) fn shape(path: &Path, name: Option<&str>) -> Result<Vec<usize>> {
    npy::shape(&mut open(path, name)?)
}

fn open(path: &Path, name: Option<&str>) -> Result<Input> {
    let place = path.display().to_string();
    let io = |e| Error::io(path, e);
    let broken = |e: zip::result::ZipError| match e {
        zip::result::ZipError::Io(e) if e.kind() != ErrorKind::UnexpectedEof => io(e),
        e => Error::invalid(&place, "archive", e, "a whole ZIP archive, as NumPy writes .npz"),
    };
    let file = BufReader::new(files::open(path)?.0);
    let mut archive = ZipArchive::new(file).map_err(broken)?;
    let names: Vec<String> = archive.file_names().filter_map(|n| n.ok().map(|n| n.into_owned())).collect();
    let arrays: Vec<&str> = names.iter().filter_map(|n| n.strip_suffix(".npy")).collect();
    let known = || format!("one of its arrays: {}", arrays.join(", "));
    let name = match (name, &arrays[..]) {
        (Some(n), _) if arrays.contains(&n) => n,
        (Some(n), _) => return Err(Error::invalid(&place, "array", format!("no \"{n}\""), known())),
        (None, [only]) => only,
        (None, []) => return Err(Error::invalid(&place, "array", "none", "at least one .npy in the archive")),
        (None, _) => {
            let found = format!("{} of them and no name", arrays.len());
            return Err(Error::invalid(&place, "array", found, format!("FILE.npz:NAME with {}", known())));
        }
    };
    let index = names.iter().position(|n| n.strip_suffix(".npy") == Some(name)).unwrap_or(0);
    let place = format!("{place}: {name}");
    let entry = archive.by_index_raw(index).map_err(broken)?;
    let (size, packed, method, checksum) = (entry.size(), entry.compressed_size(), entry.compression(), entry.crc32());
    if entry.encrypted() {
        return Err(Error::unsupported(place, "it is encrypted; save it without a password"));
    }
    let start = entry.data_start().ok_or_else(|| Error::invalid(&place, "archive", "no data", "where the data starts"));
    let start = start?;
    drop(entry);
    // The type of the numbers is unknown here: one byte, the smallest, allows the most of them.
    must_unpack(packed, size, size).map_err(|expected| {
        Error::invalid(&place, "size", format!("{size} bytes in {packed} packed ones"), expected)
    })?;
    let mut file = archive.into_inner();
    file.seek(SeekFrom::Start(start)).map_err(io)?;
    let raw: Box<dyn BufRead> = Box::new(file.take(packed));
    let reader: Box<dyn Read> = match method {
        CompressionMethod::Stored => raw,
        CompressionMethod::Deflated => Box::new(DeflateDecoder::new(raw)),
        other => {
            return Err(Error::unsupported(place, format!("it is packed as {other}; stored and deflated are read")));
        }
    };
    Ok(Input::within(place.into(), Checked { reader, crc: Crc::new(), want: checksum }, size))
}

/// Verifies the checksum at the end of the data.
struct Checked {
    reader: Box<dyn Read>,
    crc: Crc,
    want: u32,
}

impl Read for Checked {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        let n = self.reader.read(out)?;
        self.crc.update(&out[..n]);
        if n == 0 && !out.is_empty() && self.crc.sum() != self.want {
            return Err(std::io::Error::new(ErrorKind::InvalidData, "the checksum is wrong: the archive is damaged"));
        }
        Ok(n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{npy_bytes, says};
    use std::fs::File;
    use std::io::Write;
    use zip::write::SimpleFileOptions;

    fn archive(path: &Path, entries: &[(&str, &[u8])], method: CompressionMethod) {
        let mut w = zip::ZipWriter::new(File::create(path).unwrap());
        for (name, bytes) in entries {
            w.start_file(*name, SimpleFileOptions::default().compression_method(method)).unwrap();
            w.write_all(bytes).unwrap();
        }
        w.finish().unwrap();
    }

    const ONE: &[&[&str]] = &[&["row", "column"]];

    #[test]
    fn stored_and_deflated_arrays_are_read_and_damage_is_seen() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npz");
        let data: Vec<u8> = (0..6u16).flat_map(|x| (x * 1000).to_le_bytes()).collect();
        let a = npy_bytes("<u2", false, "(2, 3)", &data);
        for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
            archive(&path, &[("a.npy", &a), ("b.npy", &a)], method);
            assert_eq!(read(&path, Some("b"), ONE).unwrap()[[1, 2]], 5000.0);
            says(read(&path, None, ONE), &["a.npz", "a, b"]);
            says(read(&path, Some("c"), ONE), &["no \"c\"", "a, b"]);
            archive(&path, &[("a.npy", &a)], method);
            assert_eq!(read(&path, None, ONE).unwrap()[[0, 1]], 1000.0);
            let whole = std::fs::read(&path).unwrap();
            for cut in [0, 4, 30, whole.len() / 2, whole.len() - 1] {
                std::fs::write(&path, &whole[..cut]).unwrap();
                says(read(&path, None, ONE), &["a.npz"]);
            }
            // Each single changed byte causes an error or has no effect.
            for at in 0..whole.len() {
                let mut bytes = whole.clone();
                bytes[at] ^= 0x41;
                std::fs::write(&path, &bytes).unwrap();
                if let Ok(found) = read(&path, None, ONE) {
                    assert_eq!(found[[1, 1]], 4000.0, "byte {at}");
                }
            }
        }
    }

    #[test]
    fn an_archive_without_arrays_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npz");
        archive(&path, &[("a.txt", b"hello")], CompressionMethod::Stored);
        says(read(&path, None, ONE), &[".npy"]);
    }
}
