//! Compression on all cores, into one stream that any reader of gzip (RFC 1952) or zlib (RFC 1950) unpacks.
//!
//! Each block is compressed alone and ends at a whole byte, with an empty stored block (RFC 1951, 3.2.4), so that blocks
//! can follow one another. The bytes do not depend on the number of threads.

use adler2::Adler32;
use conefield_core::parallel;
use flate2::{Compress, Compression, Crc, FlushCompress};
use std::io::{self, Write};

/// Bytes that a thread compresses at once.
const BLOCK: usize = 1 << 17;
/// Bytes that are gathered before all threads compress them.
const ROUND: usize = 16 * BLOCK;

/// Bytes in memory: a round, and the same compressed.
pub(crate) const BYTES: u64 = 2 * ROUND as u64;

/// An empty last block.
const END: [u8; 2] = [3, 0];

/// The checksum of a stream, which follows it.
enum Sum {
    Gzip(Crc),
    Zlib(Adler32),
}

/// Compresses what is written to it. [`Packing::finish`] ends the stream.
pub(crate) struct Packing<'a> {
    to: &'a mut dyn Write,
    gathered: Vec<u8>,
    sum: Sum,
}

impl<'a> Packing<'a> {
    /// A stream of gzip, for which fast compression is noted, and no system and time.
    pub fn gzip(to: &'a mut dyn Write) -> io::Result<Self> {
        Self::new(to, &[0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 4, 255], Sum::Gzip(Crc::new()))
    }

    /// A stream of zlib, for which fast compression is noted.
    pub fn zlib(to: &'a mut dyn Write) -> io::Result<Self> {
        Self::new(to, &[0x78, 0x01], Sum::Zlib(Adler32::new()))
    }

    fn new(to: &'a mut dyn Write, header: &[u8], sum: Sum) -> io::Result<Self> {
        to.write_all(header)?;
        Ok(Self { to, gathered: Vec::with_capacity(ROUND), sum })
    }

    /// Compresses and passes on what is gathered.
    fn pack(&mut self) -> io::Result<()> {
        match &mut self.sum {
            Sum::Gzip(sum) => sum.update(&self.gathered),
            Sum::Zlib(sum) => sum.write_slice(&self.gathered),
        }
        let packed = parallel::map(self.gathered.chunks(BLOCK), |_, block| deflated(block));
        self.gathered.clear();
        packed.into_iter().try_for_each(|packed| self.to.write_all(&packed?))
    }

    /// Writes the rest, the end and the checksum.
    pub fn finish(mut self) -> io::Result<()> {
        self.pack()?;
        self.to.write_all(&END)?;
        match self.sum {
            Sum::Gzip(sum) => self.to.write_all(&[sum.sum(), sum.amount()].map(u32::to_le_bytes).concat()),
            Sum::Zlib(sum) => self.to.write_all(&sum.checksum().to_be_bytes()),
        }?;
        self.to.flush()
    }
}

impl Write for Packing<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let taken = bytes.len().min(ROUND - self.gathered.len());
        self.gathered.extend_from_slice(&bytes[..taken]);
        if self.gathered.len() == ROUND {
            self.pack()?;
        }
        Ok(taken)
    }

    /// Does nothing: a stream is whole after [`Packing::finish`] alone.
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The blocks of a DEFLATE stream that hold `bytes`, up to a whole byte.
fn deflated(bytes: &[u8]) -> io::Result<Vec<u8>> {
    let mut compress = Compress::new(Compression::fast(), false);
    let mut packed = Vec::with_capacity(bytes.len() + bytes.len() / 16 + 64);
    loop {
        let from = compress.total_in() as usize;
        compress.compress_vec(&bytes[from..], &mut packed, FlushCompress::Sync)?;
        // If room is left, all bytes are compressed.
        if packed.len() < packed.capacity() {
            return Ok(packed);
        }
        packed.reserve(BLOCK / 8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::read::{GzDecoder, ZlibDecoder};
    use std::io::Read;

    #[test]
    fn streams_of_any_length_are_unpacked() {
        let noise = |i: usize| ((i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as u8;
        for length in [0, 1, BLOCK - 1, BLOCK, BLOCK + 1, ROUND, 2 * ROUND + 3 * BLOCK + 5] {
            for bytes in [vec![7; length], (0..length).map(noise).collect::<Vec<_>>()] {
                let written = |packing: fn(&mut dyn Write) -> io::Result<Packing<'_>>| {
                    let mut to = vec![];
                    let mut packing = packing(&mut to).unwrap();
                    bytes.chunks(70_001).for_each(|part| packing.write_all(part).unwrap());
                    packing.finish().unwrap();
                    to
                };
                let (gzip, zlib, mut read) = (written(|w| Packing::gzip(w)), written(|w| Packing::zlib(w)), vec![]);
                GzDecoder::new(&gzip[..]).read_to_end(&mut read).unwrap();
                assert!(read == bytes, "gzip of {length} bytes");
                read.clear();
                ZlibDecoder::new(&zlib[..]).read_to_end(&mut read).unwrap();
                assert!(read == bytes, "zlib of {length} bytes");
                // The decoder above does not look behind the end.
                assert_eq!(gzip[gzip.len() - 4..], (length as u32).to_le_bytes());
                assert!(gzip.len() < length + length / 50 + 64, "{length} bytes became {}", gzip.len());
            }
        }
    }

    #[test]
    fn a_failed_write_is_reported() {
        let mut small = [0; 40];
        let mut to = &mut small[..];
        let mut packing = Packing::gzip(&mut to).unwrap();
        packing.write_all(&[1; 10]).unwrap();
        let noise: Vec<u8> = (0..200_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        packing.write_all(&noise).unwrap();
        packing.finish().unwrap_err();
    }
}
