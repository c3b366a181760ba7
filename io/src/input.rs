//! A file, compressed or not, read sequentially without trust in its claimed length.

use crate::memory;
use crate::number::{ByteOrder, Number};
use conefield_core::{Error, Result, allowance, files};
use flate2::bufread::{MultiGzDecoder, ZlibDecoder};
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::path::{Path, PathBuf};

/// Deflate stores at best 258 bytes in two bits, LZW some 3000 in twelve: no such stream expands to more than this many
/// times its size.
const UNPACKED_LIMIT: u64 = 2048;

/// Longest description of a scan, in bytes: fifty thousand views that are not on a circle.
pub(crate) const LONGEST_TEXT: u64 = 16 << 20;

/// From this many numbers (256 MiB of `f32`) an array's compression ratio is checked too: measured values deflate to a
/// half or a tenth, only empty ones shrink more.
const LARGE: u64 = 1 << 26;
/// Highest plausible compression ratio of a large array of measured values.
const MOST_RATIO: u64 = 100;

/// Values decoded between two checks of the file: the most memory that a wrong header can claim unnoticed.
const CHUNK: usize = 1 << 18;

/// An open file with its name and the bounds on its content.
pub(crate) struct Input {
    path: PathBuf,
    reader: Box<dyn BufRead>,
    /// Bytes on disk.
    size: u64,
    /// The compression, `gzip` or `zlib`.
    packed: Option<&'static str>,
    /// Bytes returned so far, after decompression.
    at: u64,
}

impl Input {
    /// An input over `reader`, of `size` bytes as far as is known, with the name for errors.
    pub fn within(name: PathBuf, reader: impl Read + 'static, size: u64) -> Self {
        Self { path: name, reader: Box::new(BufReader::with_capacity(1 << 16, reader)), size, packed: None, at: 0 }
    }

    /// Opens `path`; decompresses it if it starts with gzip's magic number.
    pub fn open(path: &Path) -> Result<Self> {
        let mut input = Self::open_plain(path)?;
        let start = input.reader.fill_buf().map_err(|e| Error::io(path, e))?;
        Ok(if start.starts_with(&[0x1f, 0x8b]) { input.gunzip() } else { input })
    }

    /// Opens `path` without decompression.
    pub fn open_plain(path: &Path) -> Result<Self> {
        let (file, size) = files::open(path)?;
        let reader = Box::new(BufReader::with_capacity(1 << 18, file));
        Ok(Self { path: path.to_path_buf(), reader, size, packed: None, at: 0 })
    }

    /// Decompresses from here on: the rest of a plain file must be one zlib stream.
    pub fn inflate(self) -> Self {
        self.unpack("zlib", |r| Box::new(WholeZlib(ZlibDecoder::new(r))))
    }

    /// Decompresses from here on: the rest of a plain file must be gzip.
    pub fn gunzip(self) -> Self {
        self.unpack("gzip", |r| Box::new(MultiGzDecoder::new(r)))
    }

    fn unpack(self, packed: &'static str, decoder: impl FnOnce(Box<dyn BufRead>) -> Box<dyn Read>) -> Self {
        let size = self.size.saturating_sub(self.at);
        let reader = Box::new(BufReader::new(decoder(self.reader)));
        Self { path: self.path, reader, size, packed: Some(packed), at: 0 }
    }

    /// Ends after the next `bytes` bytes.
    pub fn part(self, bytes: u64) -> Self {
        let size = if self.packed.is_none() { self.size.min(self.at.saturating_add(bytes)) } else { self.size };
        Self { reader: Box::new(self.reader.take(bytes)), size, ..self }
    }

    /// Remaining bytes of a plain file; `None` for a compressed one, where only decompression shows them.
    pub fn left(&self) -> Option<u64> {
        self.packed.is_none().then(|| self.size.saturating_sub(self.at))
    }

    /// The file's name, for errors.
    pub fn place(&self) -> String {
        self.path.display().to_string()
    }

    /// An error about this file.
    pub fn invalid(&self, field: impl ToString, found: impl ToString, expected: impl ToString) -> Error {
        Error::invalid(self.place(), field, found, expected)
    }

    /// An error about this file unless `ok`.
    pub fn ensure(&self, ok: bool, field: &str, found: impl ToString, expected: impl ToString) -> Result<()> {
        if ok { Ok(()) } else { Err(self.invalid(field, found, expected)) }
    }

    /// Reads up to `n` bytes, fewer only at the end of the file.
    pub fn take(&mut self, n: usize) -> Result<Vec<u8>> {
        let out = read_up_to(&mut self.reader, n as u64).map_err(|e| self.broken(e))?;
        self.at += out.len() as u64;
        Ok(out)
    }

    /// Reads one line of at most `most` bytes, including its line feed; the line feed is missing at the end of the file
    /// or at `most`.
    pub fn line(&mut self, most: usize) -> Result<Vec<u8>> {
        let mut out = Vec::new();
        let got = self.reader.by_ref().take(most as u64).read_until(b'\n', &mut out);
        self.at += got.map_err(|e| self.broken(e))? as u64;
        Ok(out)
    }

    /// Reads exactly `n` bytes of `field`.
    pub fn exactly(&mut self, n: usize, field: &str) -> Result<Vec<u8>> {
        let out = self.take(n)?;
        if out.len() < n {
            return Err(self.ended(field, n as u64, out.len() as u64));
        }
        Ok(out)
    }

    /// Skips `n` bytes of `field`.
    pub fn skip(&mut self, n: u64, field: &str) -> Result<()> {
        let got = std::io::copy(&mut self.reader.by_ref().take(n), &mut std::io::sink());
        let got = got.map_err(|e| self.broken(e))?;
        self.at += got;
        if got < n { Err(self.ended(field, n, got)) } else { Ok(()) }
    }

    /// Reads `count` numbers, up to the very end of the file. Refuses more numbers than the file can hold before it
    /// allocates memory, and any byte after the last number.
    pub fn singles(&mut self, field: &str, count: usize, number: Number, order: ByteOrder) -> Result<Vec<f32>> {
        self.numbers(field, count, number, &mut |raw, out| number.singles(order, raw, out))
    }

    /// The same in double precision.
    pub fn doubles(&mut self, field: &str, count: usize, number: Number, order: ByteOrder) -> Result<Vec<f64>> {
        self.numbers(field, count, number, &mut |raw, out| number.doubles(order, raw, out))
    }

    /// The same as `slope·x + intercept`.
    pub fn scaled(
        &mut self,
        field: &str,
        count: usize,
        number: Number,
        order: ByteOrder,
        [slope, intercept]: [f64; 2],
    ) -> Result<Vec<f32>> {
        let mut part = vec![];
        self.numbers(field, count, number, &mut |raw, out| {
            part.clear();
            number.doubles(order, raw, &mut part);
            out.extend(part.iter().map(|x| (slope * x + intercept) as f32));
        })
    }

    fn numbers<T>(
        &mut self,
        field: &str,
        count: usize,
        number: Number,
        append: &mut dyn FnMut(&[u8], &mut Vec<T>),
    ) -> Result<Vec<T>> {
        let want = (count as u64)
            .checked_mul(number.bytes() as u64)
            .ok_or_else(|| self.invalid(field, format!("{count} values"), "a length that can be addressed"))?;
        if let Some(packed) = self.packed {
            must_unpack(self.size, want, count as u64).map_err(|expected| {
                let found = format!("a header that claims {want} bytes in a {packed} stream of {} bytes", self.size);
                self.invalid(field, found, expected)
            })?;
        } else {
            let left = self.size.saturating_sub(self.at);
            let expected = format!("{want} bytes ({count} values of {} bytes, as the header says)", number.bytes());
            self.ensure(left == want, field, format!("{left} bytes of data in the file"), expected)?;
        }
        let mut out: Vec<T> = Vec::new();
        // A plain file has just been measured; a compressed one must prove its claim piece by piece. Each growth draws
        // from the allowance, so a false claim has no effect.
        let mut left = count;
        while left > 0 {
            let n = left.min(CHUNK);
            let raw = self.exactly(n * number.bytes(), field)?;
            let more = if self.packed.is_none() { left } else { n };
            memory::grow(&mut out, more, count, &self.place(), field)?;
            append(&raw, &mut out);
            left -= n;
        }
        // Reading to the end also makes gzip verify its checksum.
        if !self.take(1)?.is_empty() {
            return Err(self.invalid(field, "more data", format!("the end of the file after {want} bytes")));
        }
        Ok(out)
    }

    fn ended(&self, field: &str, want: u64, got: u64) -> Error {
        self.invalid(field, format!("the end of the file after {got} bytes"), format!("{want} bytes"))
    }

    fn broken(&self, e: std::io::Error) -> Error {
        let damaged = matches!(e.kind(), ErrorKind::InvalidInput | ErrorKind::InvalidData | ErrorKind::UnexpectedEof);
        match self.packed {
            Some(packed) if damaged => self.invalid(format!("{packed} stream"), e, format!("a whole {packed} stream")),
            None if damaged => self.invalid("data", e, "data that is not damaged"),
            _ => Error::io(&self.path, e),
        }
    }
}

/// The first bytes of a regular file, at most `most`.
pub(crate) fn start_of(path: &Path, most: u64) -> Result<Vec<u8>> {
    read_up_to(&mut files::open(path)?.0, most).map_err(|e| Error::io(path, e))
}

/// Reads at most `most` bytes, fewer only at the end. It is compiled once for all readers.
pub(crate) fn read_up_to(reader: &mut dyn Read, most: u64) -> std::io::Result<Vec<u8>> {
    let mut out = Vec::with_capacity(most.min(1 << 16) as usize);
    reader.take(most).read_to_end(&mut out)?;
    Ok(out)
}

/// Reads a regular file completely.
pub(crate) fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    let (file, size) = files::open(path)?;
    allowance::memory(&path.display().to_string(), "file size", size)?;
    let mut bytes = Vec::new();
    if !usize::try_from(size).is_ok_and(|n| bytes.try_reserve_exact(n).is_ok()) {
        let place = path.display().to_string();
        return Err(Error::invalid(place, "file size", format!("{size} bytes"), "a file that fits in memory"));
    }
    file.take(size).read_to_end(&mut bytes).map_err(|e| Error::io(path, e))?;
    Ok(bytes)
}

/// Whether `packed` bytes can hold `count` numbers of `unpacked` bytes in total; the error says how many they can hold.
pub(crate) fn must_unpack(packed: u64, unpacked: u64, count: u64) -> Result<(), String> {
    if unpacked > packed.saturating_mul(UNPACKED_LIMIT) {
        let most = packed.saturating_mul(UNPACKED_LIMIT);
        return Err(format!("at most {most} bytes, which is all that such a stream can unpack to"));
    }
    if count > LARGE && unpacked > packed.saturating_mul(MOST_RATIO) {
        return Err(format!(
            "at most {MOST_RATIO} times the packed size, which measured values stay far below (if it is right, give \
             the file unpacked)"
        ));
    }
    Ok(())
}

/// A zlib stream that must end with the file.
struct WholeZlib(ZlibDecoder<Box<dyn BufRead>>);

impl Read for WholeZlib {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        let n = self.0.read(out)?;
        if n == 0 && !out.is_empty() && !self.0.get_mut().fill_buf()?.is_empty() {
            return Err(std::io::Error::new(ErrorKind::InvalidData, "bytes after the end of the stream"));
        }
        Ok(n)
    }
}
