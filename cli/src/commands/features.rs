//! `conefield features`

use super::trained::{OpenedField, Trained};
use crate::boundary::{self, Inputs, refuse_existing};
use crate::out;
use clap::{Args, ValueEnum};
use conefield::tradeoff::statistics::pearson;
use conefield_core::error::{Error, Result};
use conefield_core::geometry::VoxelGrid;
use conefield_core::host;
use conefield_core::parts::Part;
use conefield_core::trained::TrainedField;
use conefield_evaluation::pca::Pca;
use conefield_evaluation::report::MiddleSlices;
use ndarray::Array3;
use serde_json::json;
use std::path::PathBuf;

/// Draw the principal components of the features of a finished run as colours.
///
/// Red, green and blue are the first three principal components of the encoder's features in the three middle slices,
/// within the support of the object. Each is scaled from its 1st to its 99th percentile; signs have no meaning. The
/// reconstruction is shown beside them.
#[derive(Args)]
pub struct FeaturesArgs {
    #[command(flatten)]
    trained: Trained,
    /// The picture to write (PNG).
    #[arg(short, long = "output", visible_alias = "out", value_name = "FILE")]
    output: PathBuf,
    /// Which features: the output of the encoder or of the normalizers.
    #[arg(long, value_enum, default_value = "encoder")]
    after: After,
    /// Replace FILE.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// The stages after which features are taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum After {
    Encoder,
    Normalizers,
}

/// Number of components drawn, one per colour.
const DRAWN: usize = 3;

impl FeaturesArgs {
    pub fn run(self) -> Result<()> {
        refuse_existing(&self.output, self.force)?;
        let opened = self.trained.open(0)?;
        boundary::picture(Some(&self.output), &Inputs::of([&opened.file]))?;
        let planes = planes(&opened.grid);
        let count: u64 = planes.iter().map(|p| p.iter().map(|r| r.len() as u64).product::<u64>()).sum();
        let width = opened.field.model.pipeline.encoder.info().output as u64;
        opened.memory(count * (4 * 3 * width + 64))?;
        let OpenedField { file, field: TrainedField { model, scene, unit_mm }, grid, .. } = opened;
        let voxels: Vec<[usize; 3]> = planes.iter().flat_map(indices).collect();
        let held: Vec<bool> = voxels.iter().map(|v| scene.holds(grid.voxel(*v))).collect();
        let points: Vec<[f32; 3]> =
            voxels.iter().zip(&held).filter(|(_, held)| **held).map(|(v, _)| scene.to_unit(grid.voxel(*v))).collect();
        let n = points.len();
        let place = file.display().to_string();
        if n == 0 {
            let expected = "at least one point where the object can be";
            return Err(Error::invalid(place, "middle slices", "none", expected));
        }
        let (mut exe, _) = self.trained.backend.open()?.compile(&model.pipeline)?;
        let mut features = exe.encode(&model, &points)?;
        let mut attenuation = vec![0.0; n];
        exe.evaluate(&model, &points, &mut attenuation)?;
        if self.after == After::Normalizers {
            features = host::normalize(&model, &features, n)?;
        }
        if let Some(x) = features.iter().chain(&attenuation).find(|x| !x.is_finite()) {
            return Err(Error::invalid(place, "features", x, "finite numbers"));
        }
        let channels = features.len() / n;
        let pca = Pca::of(&features, n);
        let Some(explained) = pca.explained() else {
            let found = format!("{channels} channels that are the same at all {n} points");
            return Err(Error::invalid(place, "features", found, "features that differ"));
        };
        let drawn: Vec<Vec<f32>> = (0..channels.min(DRAWN)).map(|k| pca.component(k, &features, n)).collect();
        let wide = |v: &[f32]| v.iter().copied().map(f64::from).collect::<Vec<_>>();
        let density = wide(&attenuation);
        let follows: Vec<Option<f64>> = drawn.iter().map(|c| pearson(&wide(c), &density)).collect();
        let slices = |values: &[f32], outside: f32| slices(&grid, &planes, &held, values, outside);
        let mut colours: Vec<MiddleSlices> = drawn.iter().map(|c| slices(&stretched(c), f32::NAN)).collect();
        colours.resize_with(DRAWN, || slices(&vec![0.0; n], f32::NAN));
        let scale = (scene.attenuation * unit_mm) as f32;
        attenuation.iter_mut().for_each(|x| *x *= scale);
        conefield_evaluation::report::features_png(
            &self.output,
            &slices(&attenuation, 0.0),
            [&colours[0], &colours[1], &colours[2]],
        )?;
        let shares = &explained[..drawn.len()];
        if self.json {
            return out::json(&json!({
                "picture": self.output, "after": if self.after == After::Encoder { "encoder" } else { "normalizers" },
                "channels": channels, "points": n, "explained": shares, "correlation": follows,
            }));
        }
        let mut rows = vec![["component", "variance", "correlation with attenuation"].map(str::to_owned).to_vec()];
        for ((share, follows), colour) in shares.iter().zip(&follows).zip(["red", "green", "blue"]) {
            let follows = follows.map_or("-".into(), |r| format!("{r:.2}"));
            rows.push(vec![colour.into(), format!("{:.1} %", 100.0 * share), follows]);
        }
        let total = 100.0 * shares.iter().sum::<f64>();
        let (table, picture) = (out::table(&rows, &[1, 2]), self.output.display());
        out::say(&format!("{table}\n{picture}: {total:.1} % of the variance of {channels} channels at {n} points"))
    }
}

/// The middle slices perpendicular to x, y and z.
fn planes(grid: &VoxelGrid) -> [Part; 3] {
    let (whole, middle) = (|k: usize| 0..grid.shape[k], |k: usize| grid.shape[k] / 2..grid.shape[k] / 2 + 1);
    [0, 1, 2].map(|cut| std::array::from_fn(|k| if k == cut { middle(k) } else { whole(k) }))
}

/// The voxels of a part, in array order.
fn indices([xs, ys, zs]: &Part) -> Vec<[usize; 3]> {
    let row = |x: usize, y: usize| zs.clone().map(move |z| [x, y, z]);
    xs.clone().flat_map(|x| ys.clone().flat_map(move |y| row(x, y))).collect()
}

/// Slices with values at the points in `held`; other points get `outside`.
fn slices(grid: &VoxelGrid, planes: &[Part; 3], held: &[bool], values: &[f32], outside: f32) -> MiddleSlices {
    let mut slices = MiddleSlices::new(*grid);
    let mut values = values.iter();
    let mut held = held.iter();
    for part in planes {
        let shape = [part[0].len(), part[1].len(), part[2].len()];
        // In the order of `indices`, which is array order.
        let plane = Array3::from_shape_simple_fn(shape, || match held.next() {
            Some(true) => values.next().copied().unwrap_or(outside),
            _ => outside,
        });
        slices.gather(part, plane.view());
    }
    slices
}

/// Scales the range from the 1st to the 99th percentile to 0 to 1.
fn stretched(values: &[f32]) -> Vec<f32> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share).round() as usize];
    let (low, high) = (at(0.01), at(0.99));
    let span = if high > low { high - low } else { 1.0 };
    values.iter().map(|x| ((x - low) / span).clamp(0.0, 1.0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_to_their_voxels() {
        let grid = VoxelGrid { shape: [3, 4, 5], spacing: [1.0; 3], center: [0.0; 3] };
        let planes = planes(&grid);
        let value = |[x, y, z]: [usize; 3]| (100 * x + 10 * y + z) as f32;
        let voxels: Vec<[usize; 3]> = planes.iter().flat_map(indices).collect();
        assert_eq!(voxels.len(), 4 * 5 + 3 * 5 + 3 * 4);
        let held: Vec<bool> = voxels.iter().map(|v| v[2] > 0).collect();
        let values: Vec<f32> = voxels.iter().filter(|v| v[2] > 0).map(|v| value(*v)).collect();
        let found = slices(&grid, &planes, &held, &values, -1.0);
        let whole = Array3::from_shape_fn((3, 4, 5), |(x, y, z)| if z > 0 { value([x, y, z]) } else { -1.0 });
        let expected = MiddleSlices::of(&conefield_core::scan::Volume::centered(whole, [1.0; 3]));
        assert_eq!(format!("{found:?}"), format!("{expected:?}"));
    }

    #[test]
    fn colours_fill_their_range() {
        let ramp: Vec<f32> = (0..=100).map(|i| i as f32).collect();
        let s = stretched(&ramp);
        assert_eq!((s[0], s[1], s[50], s[99], s[100]), (0.0, 0.0, 0.5, 1.0, 1.0));
        assert_eq!(stretched(&[4.0; 3]), [0.0; 3]);
    }
}
