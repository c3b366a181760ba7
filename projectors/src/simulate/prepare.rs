//! Prepares a volume for a simulated scan.

use conefield_core::error::{Error, Result, ensure};
use conefield_core::finite::stray;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parallel;
use conefield_core::scan::Volume;
use ndarray::Array3;
use std::fmt;
use std::str::FromStr;

/// Means of `factor³` voxels. Voxels at the upper end that fill no block are dropped; the others keep their world
/// position, so the grid's centre moves by half of what is missing.
pub fn downsample(volume: &Volume, factor: usize) -> Result<Volume> {
    let shape = volume.grid.shape;
    ensure(
        volume.data.shape() == shape,
        "downsample",
        "volume.data",
        format!("{:?}", volume.data.shape()),
        format!("{shape:?}, the shape of its grid"),
    )?;
    ensure(
        factor > 0 && shape.iter().all(|&n| n >= factor),
        "downsample",
        "factor",
        factor,
        format!("a number from 1 to the shortest axis of {shape:?}"),
    )?;
    let to = shape.map(|n| n / factor);
    let mut data = Array3::<f32>::zeros(to);
    parallel::over(data.axis_iter_mut(ndarray::Axis(0)), |i, mut plane| {
        for ((j, k), mean) in plane.indexed_iter_mut() {
            let block = [i, j, k].map(|n| n * factor..(n + 1) * factor);
            let [x, y, z] = block;
            let part = volume.data.slice(ndarray::s![x, y, z]);
            let sum: f64 = part.iter().map(|&v| f64::from(v)).sum();
            *mean = (sum / part.len() as f64) as f32;
        }
    });
    let (old, f) = (&volume.grid, factor as f64);
    let grid = VoxelGrid {
        shape: to,
        spacing: old.spacing.map(|s| s * f),
        center: std::array::from_fn(|k| old.center[k] - old.spacing[k] * (shape[k] - to[k] * factor) as f64 / 2.0),
    };
    // The first new voxel's centre lies in the middle of the first block.
    let affine = volume.affine.map(|mut a| {
        for row in a.iter_mut().take(3) {
            row[3] += (row[0] + row[1] + row[2]) * (f - 1.0) / 2.0;
            row[..3].iter_mut().for_each(|x| *x *= f);
        }
        a
    });
    Ok(Volume { data, grid, affine })
}

/// Mapping of Hounsfield units. Written `mu:0.02` or `clip:-1000,2000`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum HuMapping {
    /// Attenuation in 1/mm, `mu_water·(1 + HU/1000)`, at least 0.
    Mu {
        /// Attenuation of water in 1/mm.
        mu_water: f64,
    },
    /// Maps HU from `low` to `high` to 0 to 1 and clips the rest.
    Clip {
        /// HU mapped to 0.
        low: f64,
        /// HU mapped to 1.
        high: f64,
    },
}

impl HuMapping {
    /// The mapped value.
    pub fn value(&self, hu: f32) -> f32 {
        let hu = f64::from(hu);
        match *self {
            Self::Mu { mu_water } => (mu_water * (1.0 + hu / 1000.0)).max(0.0) as f32,
            Self::Clip { low, high } => ((hu - low) / (high - low)).clamp(0.0, 1.0) as f32,
        }
    }

    /// Maps every voxel. Refuses voxels that are not finite.
    pub fn apply(&self, volume: Volume) -> Result<Volume> {
        if let Some(((i, j, k), x)) = stray(&volume.data) {
            return Err(Error::invalid("HU mapping", format!("volume[{i}, {j}, {k}]"), x, "a finite value in HU"));
        }
        Ok(volume.mapped(|hu| self.value(hu)))
    }
}

impl fmt::Display for HuMapping {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Mu { mu_water } => write!(f, "mu:{mu_water}"),
            Self::Clip { low, high } => write!(f, "clip:{low},{high}"),
        }
    }
}

impl FromStr for HuMapping {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let wrong = |expected: &str| Error::invalid("HU mapping", "value", format!("`{text}`"), expected);
        let forms = "`mu:MU_WATER` in 1/mm (as mu:0.02) or `clip:LOW,HIGH` in HU (as clip:-1000,2000)";
        let number = |s: &str| s.trim().parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(|| wrong(forms));
        match text.trim().split_once(':') {
            Some(("mu", mu)) => {
                let mu_water = number(mu)?;
                if mu_water <= 0.0 {
                    return Err(wrong("a positive attenuation of water in 1/mm"));
                }
                Ok(Self::Mu { mu_water })
            }
            Some(("clip", range)) => {
                let (low, high) = range.split_once(',').ok_or_else(|| wrong(forms))?;
                let (low, high) = (number(low)?, number(high)?);
                if low >= high {
                    return Err(wrong("a lower bound below the upper one"));
                }
                Ok(Self::Clip { low, high })
            }
            _ => Err(wrong(forms)),
        }
    }
}
