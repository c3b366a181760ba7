//! Pictures in memory, to and from PNG.

use conefield_core::{Error, Result};
use std::io::{BufRead, Seek, Write};
use std::path::Path;

/// A colour: red, green, blue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rgb(pub [u8; 3]);

/// An RGB picture with 8 bits a channel, rows from the top.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pixels {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Three bytes a pixel, row by row.
    pub bytes: Vec<u8>,
}

impl Pixels {
    /// A picture of one colour.
    pub fn new(width: u32, height: u32, colour: Rgb) -> Self {
        Self { width, height, bytes: colour.0.repeat(width as usize * height as usize) }
    }

    fn at(&self, x: u32, y: u32) -> usize {
        assert!(x < self.width && y < self.height, "({x}, {y}) lies outside {} x {}", self.width, self.height);
        3 * (y as usize * self.width as usize + x as usize)
    }

    /// The colour in column `x` of row `y`, which are inside the picture.
    pub fn get(&self, x: u32, y: u32) -> Rgb {
        let at = self.at(x, y);
        Rgb([0, 1, 2].map(|k| self.bytes[at + k]))
    }

    /// Sets the colour in column `x` of row `y`, which are inside the picture.
    pub fn set(&mut self, x: u32, y: u32, colour: Rgb) {
        let at = self.at(x, y);
        self.bytes[at..at + 3].copy_from_slice(&colour.0);
    }

    /// All colours, row by row.
    pub fn colours(&self) -> impl Iterator<Item = Rgb> + '_ {
        self.bytes.chunks_exact(3).map(|p| Rgb([p[0], p[1], p[2]]))
    }

    /// A picture of half the width and height: the means of blocks of 2 × 2 pixels.
    pub fn halved(&self) -> Self {
        let mut small = Self::new(self.width / 2, self.height / 2, Rgb([0; 3]));
        for y in 0..small.height {
            for x in 0..small.width {
                let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| self.get(2 * x + i, 2 * y + j).0);
                let mean = |k: usize| (four.iter().map(|c| u16::from(c[k])).sum::<u16>() + 2) / 4;
                small.set(x, y, Rgb([0, 1, 2].map(|k| mean(k) as u8)));
            }
        }
        small
    }

    /// Writes a PNG; `place` is the name in errors.
    pub fn write_png(&self, out: impl Write, place: &Path) -> Result<()> {
        let mut encoder = png::Encoder::new(out, self.width, self.height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let written =
            encoder.write_header().and_then(|mut w| w.write_image_data(&self.bytes).and_then(|()| w.finish()));
        written.map_err(|e| match e {
            png::EncodingError::IoError(e) => Error::io(place, e),
            e => Error::invalid(place.display().to_string(), "picture", e, "pixels that PNG can hold"),
        })
    }

    /// Reads a PNG as [`Pixels::write_png`] writes it; `place` is the name in errors.
    pub fn read_png(from: impl BufRead + Seek, place: &Path) -> Result<Self> {
        let wrong = |e: String| Error::invalid(place.display().to_string(), "picture", e, "a PNG with 8 bits of RGB");
        let mut reader = png::Decoder::new(from).read_info().map_err(|e| wrong(e.to_string()))?;
        let info = reader.info();
        let (width, height) = (info.width, info.height);
        if (info.color_type, info.bit_depth) != (png::ColorType::Rgb, png::BitDepth::Eight) {
            return Err(wrong(format!("{:?} of {:?} bits", info.color_type, info.bit_depth)));
        }
        let size = reader.output_buffer_size().ok_or_else(|| wrong(format!("{width} x {height} pixels")))?;
        let mut bytes = vec![0; size];
        reader.next_frame(&mut bytes).map_err(|e| wrong(e.to_string()))?;
        Ok(Self { width, height, bytes })
    }

    /// The PNG file at `path`.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let file = std::fs::File::open(path).map_err(|e| Error::io(path, e))?;
        Self::read_png(std::io::BufReader::new(file), path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_halved_written_and_read() {
        let mut picture = Pixels::new(4, 2, Rgb([10, 20, 30]));
        picture.set(3, 1, Rgb([50, 20, 31]));
        let small = picture.halved();
        assert_eq!((small.width, small.height), (2, 1));
        assert_eq!([small.get(0, 0), small.get(1, 0)], [Rgb([10, 20, 30]), Rgb([20, 20, 30])]);
        let mut file = vec![];
        picture.write_png(&mut file, "here".as_ref()).unwrap();
        assert_eq!(Pixels::read_png(std::io::Cursor::new(&file), "here".as_ref()).unwrap(), picture);
        file.truncate(file.len() / 2);
        let e = Pixels::read_png(std::io::Cursor::new(&file), "here".as_ref()).unwrap_err().to_string();
        assert!(e.contains("here") && e.contains("PNG"), "{e}");
    }
}
