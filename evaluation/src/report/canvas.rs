//! A drawing canvas: rectangles, text in DejaVu Sans, and colour maps.

use crate::report::pixels::{Pixels, Rgb};
use ab_glyph::{Font, FontRef, PxScale, ScaleFont, point};
use conefield_core::{Error, Result};
use conefield_io::write_atomic;
use std::path::Path;

/// Alignment of a text along its line.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Align {
    Left,
    Middle,
    Right,
}

/// Pixels and the font.
pub(crate) struct Canvas {
    pub image: Pixels,
    font: FontRef<'static>,
}

impl Canvas {
    /// A picture filled with one colour.
    pub fn new(width: u32, height: u32, colour: Rgb) -> Result<Self> {
        let font = FontRef::try_from_slice(dejavu::sans::regular())
            .map_err(|e| Error::invalid("the embedded font", "DejaVu Sans", e, "a font"))?;
        Ok(Self { image: Pixels::new(width, height, colour), font })
    }

    /// Width of `text` at `size` pixels a line.
    pub fn text_width(&self, text: &str, size: f32) -> f32 {
        let font = self.font.as_scaled(PxScale::from(size));
        let mut last = None;
        let mut x = 0.0;
        for c in text.chars() {
            let id = font.glyph_id(c);
            x += last.map_or(0.0, |l| font.kern(l, id)) + font.h_advance(id);
            last = Some(id);
        }
        x
    }

    /// `text`, shortened with an ellipsis to a width of at most `width`.
    pub fn shortened(&self, text: &str, size: f32, width: f32) -> String {
        if self.text_width(text, size) <= width {
            return text.to_string();
        }
        let mut chars: Vec<char> = text.chars().collect();
        while chars.pop().is_some() {
            let short: String = chars.iter().chain(&['…']).collect();
            if self.text_width(&short, size) <= width {
                return short;
            }
        }
        String::new()
    }

    /// Draws one line of text; `y` is its top.
    pub fn text(&mut self, at: (f32, f32), align: Align, size: f32, colour: Rgb, text: &str) {
        let width = self.text_width(text, size);
        let mut x = match align {
            Align::Left => at.0,
            Align::Middle => at.0 - width / 2.0,
            Align::Right => at.0 - width,
        };
        let font = self.font.clone();
        let font = font.as_scaled(PxScale::from(size));
        let y = at.1 + font.ascent();
        let mut last = None;
        for c in text.chars() {
            let id = font.glyph_id(c);
            x += last.map_or(0.0, |l| font.kern(l, id));
            last = Some(id);
            let glyph = id.with_scale_and_position(PxScale::from(size), point(x, y));
            x += font.h_advance(id);
            let Some(outline) = font.outline_glyph(glyph) else { continue };
            let corner = outline.px_bounds().min;
            outline.draw(|dx, dy, cover| {
                let (px, py) = (corner.x + dx as f32, corner.y + dy as f32);
                if px < 0.0 || py < 0.0 {
                    return;
                }
                let (px, py) = (px as u32, py as u32);
                if px < self.image.width && py < self.image.height {
                    let under = self.image.get(px, py).0;
                    self.image.set(
                        px,
                        py,
                        Rgb(std::array::from_fn(|k| {
                            let (a, b) = (f32::from(under[k]), f32::from(colour.0[k]));
                            (a + (b - a) * cover.clamp(0.0, 1.0)).round() as u8
                        })),
                    );
                }
            });
        }
    }

    /// Fills a rectangle, clipped to the picture.
    pub fn fill(&mut self, x: u32, y: u32, width: u32, height: u32, mut colour: impl FnMut(u32, u32) -> Rgb) {
        for dy in 0..height.min(self.image.height.saturating_sub(y)) {
            for dx in 0..width.min(self.image.width.saturating_sub(x)) {
                self.image.set(x + dx, y + dy, colour(dx, dy));
            }
        }
    }
}

/// Writes a picture as PNG.
pub(crate) fn write_png(path: &Path, picture: &Pixels) -> Result<()> {
    write_atomic(path, &mut |w| picture.write_png(w, path))
}

/// A round number that bounds all but half a percent of `sizes`.
pub(crate) fn round_above(mut sizes: Vec<f32>) -> f32 {
    if sizes.is_empty() {
        return 1.0;
    }
    let at = (sizes.len() - 1) * 995 / 1000;
    let x = f64::from(*sizes.select_nth_unstable_by(at, f32::total_cmp).1);
    if x <= 0.0 {
        return 1.0;
    }
    let power = 10f64.powf(x.log10().floor());
    let round = [1.0, 2.0, 3.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|m| *m >= x * (1.0 - 1e-9));
    (round.unwrap_or(x) as f32).max(f32::MIN_POSITIVE)
}

/// Black at 0, white at 1.
pub(crate) fn grey(x: f32) -> Rgb {
    Rgb([(x.clamp(0.0, 1.0) * 255.0).round() as u8; 3])
}

/// Blue at −1, white at 0, red at 1, so that equality and sign are easy to see.
pub(crate) fn diverging(x: f32) -> Rgb {
    const ENDS: [[f32; 3]; 5] =
        [[10.0, 40.0, 110.0], [67.0, 140.0, 195.0], [250.0, 250.0, 250.0], [225.0, 110.0, 80.0], [110.0, 5.0, 30.0]];
    between(&ENDS, (x.clamp(-1.0, 1.0) + 1.0) / 2.0)
}

/// From dark violet at 0 over blue and green to yellow at 1, with lightness increasing with the value (after viridis).
pub(crate) fn sequential(x: f32) -> Rgb {
    const ENDS: [[f32; 3]; 5] =
        [[68.0, 1.0, 84.0], [59.0, 82.0, 139.0], [33.0, 145.0, 140.0], [94.0, 201.0, 98.0], [253.0, 231.0, 37.0]];
    between(&ENDS, x.clamp(0.0, 1.0))
}

/// The colour at `x`, from 0 to 1, interpolated between equidistant colours.
fn between(ends: &[[f32; 3]; 5], x: f32) -> Rgb {
    let at = x * 4.0;
    let low = (at as usize).min(3);
    let part = at - low as f32;
    Rgb(std::array::from_fn(|k| (ends[low][k] + (ends[low + 1][k] - ends[low][k]) * part).round() as u8))
}

/// A number with as few characters as distinguish it from its neighbours.
pub(crate) fn number(x: f64) -> String {
    let size = x.abs();
    if x == 0.0 {
        "0".into()
    } else if !(1e-3..1e5).contains(&size) {
        format!("{x:.1e}").replace('-', "−")
    } else {
        let digits = (2 - size.log10().floor() as i32).clamp(0, 6) as usize;
        let text = format!("{x:.digits$}");
        let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
        text.replace('-', "−")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_symmetric_about_white() {
        assert_eq!(diverging(0.0), Rgb([250; 3]));
        assert_eq!((diverging(-9.0), diverging(9.0)), (Rgb([10, 40, 110]), Rgb([110, 5, 30])));
        assert_eq!((sequential(-1.0), sequential(2.0)), (Rgb([68, 1, 84]), Rgb([253, 231, 37])));
        assert_eq!((grey(-1.0), grey(2.0), grey(f32::NAN)), (Rgb([0; 3]), Rgb([255; 3]), Rgb([0; 3])));
    }

    #[test]
    fn numbers_are_short() {
        for (x, want) in
            [(0.0, "0"), (1.0, "1"), (-0.05, "−0.05"), (1234.0, "1234"), (0.0333, "0.0333"), (1e-5, "1.0e−5")]
        {
            assert_eq!(number(x), want);
        }
    }

    #[test]
    fn text_is_drawn_and_cut() {
        let mut c = Canvas::new(200, 30, Rgb([255; 3])).unwrap();
        c.text((-20.0, 2.0), Align::Left, 20.0, Rgb([0; 3]), "outside µ −1.5 and further than the picture is wide");
        assert!(c.image.colours().any(|p| p.0[0] < 60));
        let short = c.shortened("a very long caption", 20.0, 60.0);
        assert!(short.ends_with('…') && c.text_width(&short, 20.0) <= 60.0, "{short}");
    }
}
