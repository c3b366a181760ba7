//! Settings of a simulated scan.

use super::noise::DetectorNoise;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::geometry::{Geometry, Radians, VoxelGrid};
use conefield_core::orbit::{Beam, CircularOrbit};
use conefield_core::scan::Unit;
use serde::{Deserialize, Serialize};

/// More views than any scanner takes; readers of scans have the same bound.
const MOST_VIEWS: usize = 1_000_000;

/// A circular orbit with a flat detector. Lengths are in the protocol's own [`Protocol::unit`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Protocol {
    /// Unit of all lengths below, and of the volume's values (per unit).
    #[serde(default)]
    pub unit: Unit,
    /// How the rays run. A parallel beam has neither `dso` nor `dsd`.
    #[serde(default, skip_serializing_if = "Beam::is_cone")]
    pub beam: Beam,
    /// Distance from the source to the rotation axis.
    #[serde(default)]
    pub dso: f64,
    /// Distance from the source to the detector plane.
    #[serde(default)]
    pub dsd: f64,
    /// Detector rows and columns.
    pub detector: [usize; 2],
    /// Size of the detector.
    pub extent: DetectorExtent,
    /// Shift of the detector along v (towards the next row) and u (towards the next column).
    #[serde(default)]
    pub offset: [f64; 2],
    /// Angles of the views.
    pub angles: Angles,
    /// Noise of the detector.
    #[serde(default)]
    pub noise: DetectorNoise,
    /// Seed of the noise.
    #[serde(default)]
    pub seed: u64,
    /// Samples along a ray per smallest voxel side; at least 2.
    #[serde(default = "two")]
    pub samples_per_voxel: f64,
}

fn two() -> f64 {
    2.0
}

/// Size of the detector, along v (rows) and u (columns).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DetectorExtent {
    /// Size of one pixel.
    Pixel([f64; 2]),
    /// Size of the whole detector.
    Side([f64; 2]),
}

/// Angles of the views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Angles {
    /// View `i` of `views` at `start_deg + arc_deg·i/views`: the end of the arc, which closes a full circle, is
    /// excluded.
    Even {
        /// Number of views.
        views: usize,
        /// The first angle in degrees.
        #[serde(default)]
        start_deg: f64,
        /// The arc in degrees.
        #[serde(default = "full_circle")]
        arc_deg: f64,
    },
    /// These angles, in degrees.
    ListDeg(Vec<f64>),
}

fn full_circle() -> f64 {
    360.0
}

impl Angles {
    /// The angle of every view.
    pub fn radians(&self) -> Vec<Radians> {
        match self {
            Self::Even { views, start_deg, arc_deg } => {
                (0..*views).map(|i| Radians((start_deg + arc_deg * i as f64 / *views as f64).to_radians())).collect()
            }
            Self::ListDeg(list) => list.iter().map(|a| Radians(a.to_radians())).collect(),
        }
    }
}

impl Protocol {
    /// The published synthetic setup, scaled to `grid`: the volume's largest side corresponds to a cube of side 2; DSO
    /// 5, DSD 7, detector 512×512 of side 4, 50 evenly spaced views on the circle from angle 0, no noise.
    pub fn r2(grid: &VoxelGrid) -> Self {
        let side = grid.size().into_iter().fold(0.0, f64::max);
        Self {
            unit: Unit { name: "cube half side".into(), mm: side / 2.0 },
            beam: Beam::Cone,
            dso: 5.0,
            dsd: 7.0,
            detector: [512, 512],
            extent: DetectorExtent::Side([4.0, 4.0]),
            offset: [0.0; 2],
            angles: Angles::Even { views: 50, start_deg: 0.0, arc_deg: 360.0 },
            noise: DetectorNoise::None,
            seed: 0,
            samples_per_voxel: two(),
        }
    }

    /// Sets `rows × columns` pixels on a detector of the same size.
    pub fn with_detector(mut self, detector: [usize; 2]) -> Self {
        self.extent = DetectorExtent::Side(self.side());
        self.detector = detector;
        self
    }

    /// Sets `views` evenly spaced views on the circle from angle 0.
    pub fn with_views(mut self, views: usize) -> Self {
        self.angles = Angles::Even { views, start_deg: 0.0, arc_deg: 360.0 };
        self
    }

    /// Sets the noise.
    pub fn with_noise(mut self, noise: DetectorNoise, seed: u64) -> Self {
        (self.noise, self.seed) = (noise, seed);
        self
    }

    /// Size of the whole detector along v and u, in units.
    pub fn side(&self) -> [f64; 2] {
        match self.extent {
            DetectorExtent::Pixel(p) => std::array::from_fn(|k| p[k] * self.detector[k] as f64),
            DetectorExtent::Side(s) => s,
        }
    }

    /// Source, detector and `grid` in mm. Refuses an impossible geometry.
    pub fn geometry(&self, grid: &VoxelGrid) -> Result<Geometry> {
        self.validate()?;
        let mm = |x: f64| x * self.unit.mm;
        let side = self.side();
        let pixel = std::array::from_fn(|k| mm(side[k] / self.detector[k] as f64));
        let (offset, angles) = (self.offset.map(mm), self.angles.radians().into_iter().map(|a| a.0).collect());
        let orbit = CircularOrbit { dso: mm(self.dso), dsd: mm(self.dsd), pixel, offset, angles };
        let views = orbit.with_beam(self.beam, grid).views();
        let geometry = Geometry { detector: self.detector, views, volume: *grid };
        geometry.validate("protocol")?;
        Ok(geometry)
    }

    fn validate(&self) -> Result<()> {
        let positive =
            |field: &str, x: f64| ensure(x.is_finite() && x > 0.0, "protocol", field, x, "a positive finite number");
        positive("unit.mm", self.unit.mm)?;
        if self.beam.is_cone() {
            positive("dso", self.dso)?;
            let expected = format!("a detector beyond the axis (more than dso = {})", self.dso);
            ensure(self.dsd.is_finite() && self.dsd > self.dso, "protocol", "dsd", self.dsd, expected)?;
        }
        let said = [("dso", self.dso), ("dsd", self.dsd)].into_iter().find(|(_, x)| *x != 0.0);
        if let (Beam::Parallel, Some((field, x))) = (self.beam, said) {
            return Err(Error::invalid("protocol", field, x, "no distance: a parallel beam has no source"));
        }
        ensure(
            self.detector.iter().all(|&n| n > 0),
            "protocol",
            "detector",
            format!("{:?}", self.detector),
            "at least one row and one column",
        )?;
        for side in self.side() {
            positive("extent", side)?;
        }
        let finite_offset = self.offset.iter().all(|x| x.is_finite());
        ensure(finite_offset, "protocol", "offset", format!("{:?}", self.offset), "finite numbers")?;
        // Checks the number of views before computing an even orbit's angles.
        if let Angles::Even { views, .. } = self.angles {
            let expected = format!("at most {MOST_VIEWS}");
            ensure(views <= MOST_VIEWS, "protocol", "angles.even.views", views, expected)?;
        }
        let angles = self.angles.radians();
        ensure(!angles.is_empty(), "protocol", "angles", "no view", "at least one view")?;
        ensure(angles.iter().all(|a| a.0.is_finite()), "protocol", "angles", "an angle that is not finite", "degrees")?;
        self.noise.validate("protocol")
    }
}
