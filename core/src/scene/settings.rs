//! Scene settings of a spec.

use crate::error::{Error, Result, ensure};
use crate::geometry::Vec3;
use crate::input_file::InputFile;
use crate::place::Bounds;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the scan is mapped to the unit cube and to attenuation of order one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SceneSettings {
    /// Share of the unit cube's side filled by the longest side of the volume, in (0, 1]. Published codes leave most of
    /// the cube empty; 1 spends every cell on the volume.
    pub fill: f64,
    /// The attenuation that counts as 1 for the field.
    pub attenuation: AttenuationScale,
    /// Where the object can be inside the volume.
    pub support: SupportRule,
    /// Which of the encoder's channels are computed.
    pub levels: LevelRule,
    /// What lies beyond the volume.
    #[serde(skip_serializing_if = "SurroundRule::is_none")]
    pub surround: SurroundRule,
}

impl Default for SceneSettings {
    fn default() -> Self {
        let (support, levels, surround) = (SupportRule::Box, LevelRule::All, SurroundRule::None);
        Self { fill: 1.0, attenuation: AttenuationScale::Scan, support, levels, surround }
    }
}

impl SceneSettings {
    /// Refuses invalid settings.
    pub fn validate(&self) -> Result<()> {
        // With less, neighbouring positions would coincide in single precision.
        ensure((0.01..=1.0).contains(&self.fill), "spec", "scene.fill", self.fill, "0.01 to 1")?;
        if let AttenuationScale::Fixed(x) | AttenuationScale::Relative(x) = self.attenuation {
            ensure(x.is_finite() && x > 0.0, "spec", "scene.attenuation", x, "a positive finite number")?;
        }
        self.surround.validate()?;
        self.support.validate(&self.surround)
    }
}

/// What lies beyond the volume.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum SurroundRule {
    /// Nothing.
    #[default]
    None,
    /// Coarse cells, if the object reaches the sides of views. Total variation reconstructs them over the whole field
    /// of view first, and their line integrals are subtracted from the measured ones.
    Coarse(CoarseSurround),
}

/// Extent and resolution of the space beyond the volume.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CoarseSurround {
    /// Extent of the cells beyond the volume, as a share of its longest side, along the axes where the object leaves it or
    /// the detector; less if a source is closer.
    pub margin: f64,
    /// Cells along the volume's longest side.
    pub cells: usize,
    /// Passes over the views.
    pub passes: u64,
}

impl Default for CoarseSurround {
    fn default() -> Self {
        Self { margin: 0.75, cells: 64, passes: 16 }
    }
}

impl SurroundRule {
    /// Whether it is `none`.
    pub fn is_none(&self) -> bool {
        *self == Self::None
    }

    /// Refuses invalid settings.
    pub fn validate(&self) -> Result<()> {
        let Self::Coarse(CoarseSurround { margin, cells, passes }) = *self else { return Ok(()) };
        let key = |name: &str| format!("scene.surround.coarse.{name}");
        ensure(margin > 0.0 && margin <= 4.0, "spec", &key("margin"), margin, "a number above 0 and at most 4")?;
        ensure((4..=256).contains(&cells), "spec", &key("cells"), cells, "4 to 256")?;
        ensure((1..=1000).contains(&passes), "spec", &key("passes"), passes, "1 to 1000")
    }
}

/// Which of the encoder's channels are computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LevelRule {
    /// All.
    All,
    /// Without levels finer than the data: finer than a voxel, or than a pixel projected to the centre of the volume.
    /// The coarsest sufficient level stays.
    Needed,
}

/// Where the object can be inside the volume. Iterative methods keep other voxels at 0; for fields, the unit cube is
/// fitted to the region, and rays are sampled inside it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum SupportRule {
    /// Anywhere.
    #[default]
    Box,
    /// Without air: cells through which several views see only air are left out. Truncated views do not count.
    Carve,
    /// In a solid cylinder along z that is fitted to the views: one material with lighter parts inside. Its attenuation
    /// is the upper bound of iterative methods, unless `scene.bounds.high` is given, and beam hardening of its line
    /// integrals is corrected.
    Solid,
    /// In a solid cylinder if the views show one, else as with `carve`.
    SolidOrCarve,
    /// In a cylinder along z.
    Cylinder(CylinderSettings),
    /// In a box.
    Cuboid(CuboidSettings),
    /// In the voxels above 0 of a volume with the voxels of the scan.
    File(InputFile),
}

/// A cylinder along z, in the unit of the scan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CylinderSettings {
    /// x and y of its axis.
    #[serde(default)]
    pub center: [f64; 2],
    /// Its radius.
    pub radius: f64,
}

/// A box along the axes, in the unit of the scan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CuboidSettings {
    /// Its lowest corner.
    pub low: Vec3,
    /// Its highest corner.
    pub high: Vec3,
}

impl SupportRule {
    /// Refuses invalid settings, and a solid beside a surround.
    pub fn validate(&self, surround: &SurroundRule) -> Result<()> {
        match self {
            Self::Box | Self::Carve | Self::File(_) => Ok(()),
            Self::Solid | Self::SolidOrCarve => {
                let found = if surround.is_none() { "none" } else { "coarse" };
                let expected = "\"none\", because scene.support looks for a solid whose whole width is visible";
                ensure(surround.is_none(), "spec", "scene.surround", found, expected)
            }
            Self::Cylinder(CylinderSettings { center, radius }) => {
                let [center_key, radius_key] = ["center", "radius"].map(|k| format!("scene.support.cylinder.{k}"));
                let finite = center.iter().all(|x| x.is_finite());
                ensure(finite, "spec", &center_key, format!("{center:?}"), "finite numbers")?;
                ensure(radius.is_finite() && *radius > 0.0, "spec", &radius_key, radius, "a positive finite number")
            }
            Self::Cuboid(CuboidSettings { low, high }) => {
                let right = (0..3).all(|k| low[k].is_finite() && high[k].is_finite() && low[k] < high[k]);
                let found = format!("{low:?} and {high:?}");
                ensure(right, "spec", "scene.support.cuboid", found, "finite corners low and high, low below high")
            }
        }
    }

    /// Whether the scan decides on the attenuation and hardening of a solid.
    pub fn is_solid(&self) -> bool {
        matches!(self, Self::Solid | Self::SolidOrCarve)
    }
}

/// The attenuation that counts as 1 for the field.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum AttenuationScale {
    /// Four times the mean attenuation of the most absorbing rays over the longest side of the volume. It depends on
    /// the scan only, not on units, and is large enough for a field with values up to 1.
    Scan,
    /// A multiple of the value for `scan`.
    Relative(f64),
    /// A value in the scan's own unit (1/unit).
    Fixed(f64),
}

impl AttenuationScale {
    /// The value in 1/mm, for a scan in units of `mm` millimetres and a volume whose longest side is `longest` mm.
    /// `top` returns the line integral of the most absorbing rays.
    pub fn of(self, mm: f64, longest: f64, top: &dyn Fn() -> Result<f64>) -> Result<f64> {
        Ok(match self {
            Self::Scan => 4.0 * top()? / longest,
            Self::Relative(times) => times * Self::Scan.of(mm, longest, top)?,
            Self::Fixed(x) => x / mm,
        })
    }
}

/// How an iterative method treats the scan.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VoxelScene {
    /// Where the object can be inside the volume.
    pub support: SupportRule,
    /// What lies beyond the volume.
    #[serde(skip_serializing_if = "SurroundRule::is_none")]
    pub surround: SurroundRule,
    /// Bounds of attenuation.
    #[serde(skip_serializing_if = "BoundsSettings::are_default")]
    pub bounds: BoundsSettings,
}

impl VoxelScene {
    /// Refuses invalid settings.
    pub fn validate(&self) -> Result<()> {
        self.surround.validate()?;
        self.support.validate(&self.surround)?;
        let BoundsSettings { low, high, regions } = &self.bounds;
        let low = *low;
        ensure(low.is_finite(), "spec", "scene.bounds.low", low, "a finite number")?;
        if let Some(high) = *high {
            let expected = format!("a finite number above scene.bounds.low, which is {low}");
            ensure(high.is_finite() && high > low, "spec", "scene.bounds.high", high, expected)?;
        }
        regions.iter().enumerate().try_for_each(|(i, region)| region.validate(i))?;
        // Voxels outside the support are 0.
        let free = low == 0.0 || self.support == SupportRule::Box;
        ensure(free, "spec", "scene.bounds.low", low, "0, because voxels outside scene.support are 0")
    }
}

/// Bounds of attenuation, in 1/unit of the scan.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BoundsSettings {
    /// Lowest attenuation. A method with the key `nonnegative` ignores it if that is false.
    pub low: f64,
    /// Highest attenuation: that of the densest material, if it is known. With `scene.support = "solid"` it is fitted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub high: Option<f64>,
    /// Regions with other bounds, such as a part of known material. A later one counts where two overlap; voxels outside
    /// `scene.support` stay 0.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub regions: Vec<RegionSettings>,
}

/// Bounds of attenuation in a region, in 1/unit of the scan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegionSettings {
    /// The region: a cylinder, a cuboid or a file.
    pub within: SupportRule,
    /// Lowest attenuation.
    #[serde(default)]
    pub low: f64,
    /// Highest attenuation. Equal to `low` if the attenuation is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub high: Option<f64>,
}

impl RegionSettings {
    /// Its key in a spec.
    pub fn key(i: usize) -> String {
        format!("scene.bounds.regions.{i}")
    }

    /// Makes an error about `scene.support` one about the region.
    pub fn concern(i: usize, mut e: Error) -> Error {
        if let Error::Invalid { field, .. } = &mut e {
            *field = field.replacen("scene.support", &format!("{}.within", Self::key(i)), 1);
        }
        e
    }

    fn validate(&self, i: usize) -> Result<()> {
        let region = matches!(self.within, SupportRule::Cylinder(_) | SupportRule::Cuboid(_) | SupportRule::File(_));
        let field = format!("{}.within", Self::key(i));
        ensure(region, "spec", &field, "no region", "a cylinder, a cuboid or a file")?;
        self.within.validate(&SurroundRule::None).map_err(|e| Self::concern(i, e))?;
        let (low, high) = (self.low, self.high.unwrap_or(f64::MAX));
        let found = format!("{low} to {high}");
        let right = low.is_finite() && high.is_finite() && high >= low;
        ensure(right, "spec", &Self::key(i), found, "finite numbers low and high, high not below low")
    }

    /// The bounds in 1/mm, for a scan in units of `mm` millimetres.
    pub fn in_mm(&self, mm: f64) -> Bounds {
        BoundsSettings { low: self.low, high: self.high, regions: vec![] }.in_mm(mm)
    }
}

impl BoundsSettings {
    /// Whether they are 0 and no upper bound.
    pub fn are_default(&self) -> bool {
        *self == Self::default()
    }

    /// The bounds in 1/mm, for a scan in units of `mm` millimetres.
    pub fn in_mm(&self, mm: f64) -> Bounds {
        let of = |x: f64| (x / mm) as f32;
        Bounds { low: of(self.low), high: self.high.map_or(f32::INFINITY, of) }
    }
}
