//! Weights of the volumes in a chain's mean.

use crate::fdk::filter::{Ramp, Window};
use conefield_core::error::{Error, Result};
use conefield_core::method::Job;
use conefield_core::voxel::VoxelProjector;
use conefield_projectors::voxel::Joseph;
use ndarray::{Array3, Axis, Zip};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Weights of the volumes in the mean.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Weighting {
    /// Equal weights.
    #[default]
    Equal,
    /// Weights between 0 and 1 with which the mean predicts the held-out views best, fitted one volume at a time.
    HeldOut,
}

/// The `w` in [0, 1] for which `mean + w·(volume − mean)` explains the held-out views of `job` best.
///
/// With `A` the projector, `y` the held-out line integrals, `d = A(volume − mean)` and `R` the ramp filter along detector
/// rows, `w = ⟨d, R(y − A·mean)⟩ / ⟨d, R·d⟩` minimizes `⟨e, R·e⟩` over `e = y − A(mean + w·(volume − mean))`. By the Fourier
/// slice theorem (Kak and Slaney, eq. 3.34 for parallel beams) the ramp makes the energy of line integrals that of the
/// volume; without it, low frequencies dominate, in which good volumes hardly differ. Neither volume has seen the noise of
/// `y`, so it does not bias `w`.
pub(super) fn fitted(mean: &Array3<f32>, volume: &Array3<f32>, job: &Job<'_>) -> Result<f32> {
    let none = || Error::invalid("spec", "weighting", "no held-out views", "held-out views");
    let scan = job.held_out.ok_or_else(none)?;
    let geometry = &scan.geometry;
    // Volumes are in 1/unit, geometry is in mm.
    let scale = 1.0 / scan.unit.mm as f32;
    let projector: Arc<dyn VoxelProjector> = Arc::new(Joseph {});
    let projector = job.backend.place(Box::new(projector))?;
    let operator = projector.operator();
    let [rows, columns] = geometry.detector;
    let ramp = Ramp::new(columns, 1.0, Window::Ramp, 1.0);
    let view = || Array3::<f32>::zeros((1, rows, columns));
    let (mut residual, mut change, mut filtered) = (view(), view(), view());
    let (mut explained, mut energy) = (0.0, 0.0);
    for i in 0..geometry.views.len() {
        operator.forward(geometry, &[i], mean.view(), residual.view_mut());
        operator.forward(geometry, &[i], volume.view(), change.view_mut());
        Zip::from(&mut change).and(&residual).for_each(|a, b| *a = scale * (*a - b));
        Zip::from(residual.index_axis_mut(Axis(0), 0)).and(scan.view(i)).for_each(|a, y| *a = y - scale * *a);
        filtered.assign(&change);
        for (image, sum) in [(&mut residual, &mut explained), (&mut filtered, &mut energy)] {
            let rows = image.as_slice_mut().unwrap_or_else(|| unreachable!("a new array is contiguous"));
            ramp.filter(rows, columns);
            *sum += image.iter().zip(&change).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
        }
    }
    operator.fault()?;
    Ok(if energy > 0.0 { (explained / energy).clamp(0.0, 1.0) as f32 } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_backend_cpu::Cpu;
    use conefield_core::scan::{Scan, Volume};
    use conefield_projectors::simulate::{Protocol, simulate};
    use serde_json::json;

    /// A ball with ripples of some strength, 16³ voxels of 10 mm.
    fn volume(ripples: f32) -> Array3<f32> {
        Array3::from_shape_fn((16, 16, 16), |(x, y, z)| {
            let d = [x, y, z].map(|i| i as f32 - 7.5);
            let ball = d.iter().map(|v| v * v).sum::<f32>() < 40.0;
            0.01 * f32::from(u8::from(ball)) + ripples * (d[0] * 1.7 + d[1] * 0.9).sin() * (d[2] * 0.8).cos()
        })
    }

    /// Two views of the ball without ripples.
    fn held_out() -> Scan {
        let protocol: Protocol = serde_json::from_value(json!({
            "dso": 500.0, "dsd": 750.0, "detector": [24, 24], "extent": {"side": [280.0, 280.0]},
            "angles": {"even": {"views": 2}},
        }))
        .unwrap();
        simulate(&Volume::centered(volume(0.0), [10.0; 3]), &protocol).unwrap()
    }

    #[test]
    fn a_fit_finds_the_weight_that_cancels_errors() {
        let (mut scan, cpu) = (held_out(), Cpu::new());
        let fit = |scan: &Scan, mean, other| {
            let job = Job { held_out: Some(scan), ..Job::new(scan, &cpu) };
            fitted(&mean, &other, &job).unwrap()
        };
        for (mean, other, want) in
            [(1.0, -0.5, 2.0 / 3.0), (0.2, -0.6, 0.25), (1.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 2.0, 0.0)]
        {
            let got = fit(&scan, volume(0.001 * mean), volume(0.001 * other));
            assert!((got - want).abs() < 1e-3, "{mean} and {other}: {got}, not {want}");
        }
        assert_eq!(fit(&scan, volume(0.001), volume(0.001)), 0.0);
        // Volumes of a scan whose unit is not a millimetre.
        scan.unit.mm = 50.0;
        let got = fit(&scan, volume(0.001) * 50.0, volume(-0.0005) * 50.0);
        assert!((got - 2.0 / 3.0).abs() < 1e-3, "{got}");
    }

    #[test]
    fn without_held_out_views_there_is_no_fit() {
        let (scan, cpu) = (held_out(), Cpu::new());
        let e = fitted(&volume(0.0), &volume(0.1), &Job::new(&scan, &cpu)).unwrap_err().to_string();
        assert!(e.contains("weighting") && e.contains("held-out"), "{e}");
    }
}
