//! Pictures in a page: PNG as `data:` URLs.

use crate::report::canvas::{diverging, grey, round_above};
use crate::report::pixels::Pixels;
use crate::report::survey::survey_picture;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use conefield_core::Result;
use conefield_core::geometry::Geometry;
use ndarray::{Array2, ArrayView2, s};

/// Maximum number of pixels along the longer side.
const SIDE: usize = 512;

/// Colour map of values.
#[derive(Debug, Clone, Copy)]
pub enum Scale {
    /// From black to white.
    Grey([f32; 2]),
    /// Blue below, red above, with the deepest colours at this distance from zero.
    Signed(f32),
}

/// `values`, rows from the top, as the URL of a picture. Larger arrays are averaged over blocks.
pub fn picture_url(values: ArrayView2<'_, f32>, scale: Scale) -> Result<String> {
    let by = values.shape().iter().max().map_or(1, |n| n.div_ceil(SIDE)).max(1);
    let shape = [0, 1].map(|k| values.shape()[k].div_ceil(by));
    let block = |i: usize, k: usize| i * by..((i + 1) * by).min(values.shape()[k]);
    let shown = Array2::from_shape_fn(shape, |(row, column)| {
        values.slice(s![block(row, 0), block(column, 1)]).mean().unwrap_or(0.0)
    });
    let bytes: Vec<u8> = shown
        .iter()
        .flat_map(|x| match scale {
            Scale::Grey([low, high]) => grey((x - low) / (high - low)).0,
            Scale::Signed(span) => diverging(x / span).0,
        })
        .collect();
    url(&Pixels { width: shape[1] as u32, height: shape[0] as u32, bytes })
}

/// The picture of [`survey_png`](crate::report::survey_png), as a URL.
pub fn geometry_url(title: &str, geometry: &Geometry) -> Result<String> {
    url(&survey_picture("a picture of the geometry", title, geometry)?)
}

/// A round number that bounds all but half a percent of the `values`.
pub fn spread(values: impl Iterator<Item = f32>) -> f32 {
    round_above(values.map(f32::abs).filter(|x| x.is_finite()).collect())
}

fn url(picture: &Pixels) -> Result<String> {
    let mut png = vec![];
    picture.write_png(&mut png, "a picture in a page".as_ref())?;
    Ok(png_url(&png))
}

/// The bytes of a PNG as a URL.
pub fn png_url(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", STANDARD.encode(png))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_has_the_values_rows_from_the_top() {
        let mut values = Array2::zeros((4, 1030));
        values[(0, 1029)] = 1.0;
        values[(0, 1028)] = 1.0;
        values[(3, 0)] = 9.0;
        let url = picture_url(values.view(), Scale::Grey([0.0, 1.0])).unwrap();
        let bytes = STANDARD.decode(url.strip_prefix("data:image/png;base64,").unwrap()).unwrap();
        let image = Pixels::read_png(std::io::Cursor::new(bytes), "a page".as_ref()).unwrap();
        // Blocks of 3; the last ones are smaller.
        assert_eq!((image.width, image.height), (344, 2));
        assert_eq!(image.get(343, 0).0, [85; 3], "one of three rows");
        assert_eq!(image.get(0, 1).0, [255; 3]);
        assert_eq!(image.get(5, 1).0, [0; 3]);
        assert_eq!(spread([0.1, -2.5, -2.4, f32::NAN].into_iter()), 3.0);
    }
}
