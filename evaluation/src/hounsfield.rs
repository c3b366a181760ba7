//! Hounsfield units of a volume that is written: `1000·(μ − water)/(water − air)`.
//!
//! [`How`] is what a user asks for; [`How::open`] checks it against a volume; [`Calibration::measure`] finds water and
//! air, and [`Levels::of`] converts voxels on their way to a file.

use conefield_core::error::ensure;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parallel;
use conefield_core::parts::{Part, Voxels};
use conefield_core::scan::{Affine, Unit};
use conefield_core::{Error, Result, written};
use conefield_scans::corrections::WATER;
use conefield_scans::diagnosis::quantiles::median;
use ndarray::{Array3, ArrayViewMut3};
use serde::{Deserialize, Serialize};
use std::fmt::{Display, Formatter};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// The attenuation of water, with its density of 1 g/cm³, in 1/mm at `energy` in keV, between the energies of the table
/// interpolated in the logarithms of both; `None` outside of the table.
pub fn water(energy: f64) -> Option<f64> {
    WATER.windows(2).find(|pair| (pair[0][0]..=pair[1][0]).contains(&energy)).map(|pair| {
        let [[e0, m0], [e1, m1]] = [pair[0], pair[1]];
        let share = (energy / e0).ln() / (e1 / e0).ln();
        0.1 * m0 * (m1 / m0).powf(share)
    })
}

/// How water and air are found.
#[derive(Debug, Clone, PartialEq)]
pub enum How {
    /// Water and air, each given or measured.
    Levels([KnownValue; 2]),
    /// Water at this energy in keV; air is 0.
    Energy(f64),
    /// A file with both.
    File(PathBuf),
    /// The values are Hounsfield units already.
    Already,
}

/// The attenuation of a material.
#[derive(Debug, Clone, PartialEq)]
pub enum KnownValue {
    /// This value, in 1/mm.
    Given(f64),
    /// The median of the voxels in a region.
    Median(Region),
}

/// A region in the coordinates of the written file, in mm, RAS.
#[derive(Debug, Clone, PartialEq)]
pub enum Region {
    /// Voxels at most `radius` from `center`.
    Sphere {
        /// The centre.
        center: [f64; 3],
        /// The radius.
        radius: f64,
    },
    /// Voxels between two corners.
    Box {
        /// The least coordinates.
        low: [f64; 3],
        /// The largest coordinates.
        high: [f64; 3],
    },
}

/// What errors call the conversion.
const FIELD: &str = "Hounsfield units";

/// The forms of [`How`] as text.
const FORMS: &str = "water=MU,air=MU in 1/mm such as water=0.0206,air=0, with sphere:X,Y,Z,R or box:X,Y,Z,X,Y,Z in mm in \
                     place of a MU to measure it, or an energy such as 60keV, a calibration file (.toml) or as-is";

impl FromStr for How {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("expected {FORMS}");
        if text == "as-is" {
            return Ok(Self::Already);
        }
        if let Some(rest) = text.strip_prefix("water=") {
            let (water, air) = rest.split_once(",air=").ok_or_else(wrong)?;
            return Ok(Self::Levels([water.parse()?, air.parse()?]));
        }
        if text.to_ascii_lowercase().ends_with(".toml") {
            return Ok(Self::File(text.into()));
        }
        let number = text.len().checked_sub(3).filter(|at| text.is_char_boundary(*at)).map(|at| text.split_at(at));
        let (number, _) = number.filter(|(_, unit)| unit.eq_ignore_ascii_case("kev")).ok_or_else(wrong)?;
        let energy: f64 = number.trim().parse().map_err(|_| wrong())?;
        water(energy).map(|_| Self::Energy(energy)).ok_or_else(|| {
            format!("expected an energy from {} to {} keV, the range of the table of water", WATER[0][0], WATER[20][0])
        })
    }
}

impl FromStr for KnownValue {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = |list: &str| -> Option<Vec<f64>> {
            list.split(',').map(|x| x.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect()
        };
        let (shape, list) = text.split_once(':').map_or((None, text), |(shape, list)| (Some(shape), list));
        Ok(match (shape, numbers(list).as_deref()) {
            (None, Some(&[mu])) => Self::Given(mu),
            (Some("sphere"), Some(&[x, y, z, radius])) if radius > 0.0 => {
                Self::Median(Region::Sphere { center: [x, y, z], radius })
            }
            (Some("sphere"), _) => return Err("expected sphere:X,Y,Z,R with a radius above 0, in mm".into()),
            (Some("box"), Some(&[a, b, c, d, e, f])) => {
                let (low, high) = ([a.min(d), b.min(e), c.min(f)], [a.max(d), b.max(e), c.max(f)]);
                Self::Median(Region::Box { low, high })
            }
            (Some("box"), _) => return Err("expected box:X,Y,Z,X,Y,Z, two corners in mm".into()),
            _ => return Err(format!("expected {FORMS}")),
        })
    }
}

/// A calibration file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CalibrationFile {
    /// In 1/mm, as is `air`.
    water: f64,
    air: f64,
    /// For the header only.
    energy_kev: Option<f64>,
}

/// Longest calibration file, in bytes.
const LONGEST: u64 = 1 << 16;

/// Water and air, found or to be measured.
#[derive(Debug)]
pub struct Calibration {
    /// `None`: the values are Hounsfield units already.
    levels: Option<[KnownValue; 2]>,
    unit: Option<Unit>,
    place: String,
    /// What the header adds, e.g. the energy.
    remark: String,
}

/// Where the voxels are.
fn at(grid: &VoxelGrid, affine: Option<&Affine>, voxel: [usize; 3]) -> [f64; 3] {
    affine.map_or_else(
        || grid.voxel(voxel),
        |a| std::array::from_fn(|i| a[i][3] + (0..3).map(|k| a[i][k] * voxel[k] as f64).sum::<f64>()),
    )
}

impl Display for Region {
    fn fmt(&self, to: &mut Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Sphere { center: [x, y, z], radius } => write!(to, "sphere:{x},{y},{z},{radius}"),
            Self::Box { low: [a, b, c], high: [d, e, f] } => write!(to, "box:{a},{b},{c},{d},{e},{f}"),
        }
    }
}

impl Region {
    fn holds(&self, p: [f64; 3]) -> bool {
        match self {
            Self::Sphere { center, radius } => {
                (0..3).map(|k| (p[k] - center[k]).powi(2)).sum::<f64>() <= radius * radius
            }
            Self::Box { low, high } => (0..3).all(|k| (low[k]..=high[k]).contains(&p[k])),
        }
    }
}

/// The voxels of a plane across z.
fn plane(grid: &VoxelGrid, z: usize) -> impl Iterator<Item = [usize; 3]> + use<> {
    let [nx, ny, _] = grid.shape;
    (0..nx).flat_map(move |x| (0..ny).map(move |y| [x, y, z]))
}

impl How {
    /// The file that it names.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::File(path) => Some(path),
            _ => None,
        }
    }

    /// Reads what it names and checks it for voxels at `grid` and `affine` in 1/`unit`; without a unit they are in 1/mm.
    /// `place` names the volume in errors. Refuses given attenuation, which is in 1/mm, for a relative unit, and regions
    /// without voxels.
    pub fn open(
        &self,
        place: &str,
        unit: Option<&Unit>,
        grid: &VoxelGrid,
        affine: Option<&Affine>,
    ) -> Result<Calibration> {
        let mut remark = String::new();
        let levels = match self {
            Self::Already => None,
            Self::Levels(levels) => Some(levels.clone()),
            Self::Energy(energy) => {
                remark = format!(" at {energy} keV");
                let expected = format!("{} to {} keV", WATER[0][0], WATER[20][0]);
                let water = water(*energy).ok_or_else(|| Error::invalid(FIELD, "energy", energy, expected))?;
                Some([water, 0.0].map(KnownValue::Given))
            }
            Self::File(path) => {
                let text = conefield_core::files::read_text(path, LONGEST)?;
                let CalibrationFile { water, air, energy_kev } = written::read(&path.display().to_string(), &text)?;
                remark = energy_kev.map_or(String::new(), |e| format!(" at {e} keV"));
                Some([water, air].map(KnownValue::Given))
            }
        };
        for level in levels.iter().flatten() {
            match level {
                KnownValue::Given(_) => {
                    let relative = unit.filter(|u| !u.is_length());
                    let expected =
                        "a unit of length, such as mm (or water and air both measured in regions, which need none)";
                    let found = relative.map_or("", |u| &u.name);
                    ensure(relative.is_none(), place, "unit", format!("\"{found}\""), expected)?;
                }
                KnownValue::Median(region) => {
                    let mut all = (0..grid.shape[2]).flat_map(|z| plane(grid, z));
                    let some = all.any(|v| region.holds(at(grid, affine, v)));
                    let last = grid.shape.map(|n| n - 1);
                    let [a, b] = [[0; 3], last].map(|v| at(grid, affine, v));
                    let expected = format!("a region with voxels, whose centres lie from {a:.3?} to {b:.3?} mm");
                    ensure(some, place, FIELD, format!("{region} without a voxel"), expected)?;
                }
            }
        }
        Ok(Calibration { levels, unit: unit.cloned(), place: place.to_owned(), remark })
    }
}

impl Calibration {
    /// Water and air in the unit of `voxels`, whose regions are evaluated. Refuses water that does not attenuate more
    /// than air.
    pub fn measure(&self, voxels: &mut dyn Voxels) -> Result<Levels> {
        let Some(levels) = &self.levels else {
            return Ok(Levels::already("HU, as read".into()));
        };
        let mm = self.unit.as_ref().map_or(1.0, |u| u.mm);
        let mut found = [0.0; 2];
        for (found, level) in found.iter_mut().zip(levels) {
            *found = match level {
                KnownValue::Given(mu) => mu * mm,
                KnownValue::Median(region) => median_in(voxels, region)?,
            };
        }
        let [water, air] = found;
        let good = water.is_finite() && air.is_finite() && water > air;
        let expected = "water that attenuates more than air";
        ensure(good, &self.place, FIELD, format!("water {water} and air {air}"), expected)?;
        let unit = self.unit.as_ref().map_or("mm", |u| &u.name);
        let measured = levels.iter().any(|l| matches!(l, KnownValue::Median(_)));
        let unit = if measured && self.unit.is_none() { String::new() } else { format!(" per {unit}") };
        let (short, remark) = (|x: f64| x as f32, &self.remark);
        Ok(Levels { water, air, note: format!("HU: water {}, air {}{unit}{remark}", short(water), short(air)) })
    }
}

/// The median of the voxels in `region`, one plane at a time: a streak or a bubble does not shift it as it does a mean.
fn median_in(voxels: &mut dyn Voxels, region: &Region) -> Result<f64> {
    let (grid, affine) = (voxels.grid(), voxels.affine());
    let [nx, ny, nz] = grid.shape;
    let mut read = Array3::zeros([nx, ny, 1]);
    let mut values = vec![];
    for z in 0..nz {
        let inside = plane(&grid, z).filter(|v| region.holds(at(&grid, affine.as_ref(), *v)));
        let inside: Vec<[usize; 3]> = inside.collect();
        if !inside.is_empty() {
            voxels.fill(&[0..nx, 0..ny, z..z + 1], read.view_mut())?;
            values.extend(inside.iter().map(|[x, y, _]| read[[*x, *y, 0]]));
        }
    }
    Ok(f64::from(median(&mut values).unwrap_or(f32::NAN)))
}

/// Water and air of a volume, in its unit.
#[derive(Debug, Clone, Serialize)]
pub struct Levels {
    /// Attenuation of water.
    pub water: f64,
    /// Attenuation of air.
    pub air: f64,
    /// Text for headers.
    pub note: String,
}

impl Levels {
    /// Of values that are Hounsfield units already.
    pub fn already(note: String) -> Self {
        Self { water: 0.0, air: -1000.0, note }
    }

    /// `voxels` in Hounsfield units.
    pub fn of<'a>(&'a self, voxels: &'a mut dyn Voxels) -> HounsfieldVoxels<'a> {
        HounsfieldVoxels { voxels, levels: self }
    }

    /// The Hounsfield units of `value`.
    pub fn value(&self, value: f32) -> f32 {
        (1000.0 * (f64::from(value) - self.water) / (self.water - self.air)) as f32
    }
}

/// Voxels in Hounsfield units, computed on demand.
pub struct HounsfieldVoxels<'a> {
    voxels: &'a mut dyn Voxels,
    levels: &'a Levels,
}

impl Voxels for HounsfieldVoxels<'_> {
    fn grid(&self) -> VoxelGrid {
        self.voxels.grid()
    }

    fn affine(&self) -> Option<Affine> {
        self.voxels.affine()
    }

    fn hounsfield(&self) -> Option<&str> {
        Some(&self.levels.note)
    }

    fn fill(&mut self, part: &Part, mut out: ArrayViewMut3<'_, f32>) -> Result<()> {
        self.voxels.fill(part, out.view_mut())?;
        parallel::over(out.outer_iter_mut(), |_, mut plane| plane.mapv_inplace(|x| self.levels.value(x)));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::scan::Volume;

    /// 4 × 3 × 2 voxels of 2 mm: air (0.001) for x < 2, water (0.021) beyond.
    fn volume() -> Volume {
        Volume::centered(Array3::from_shape_fn((4, 3, 2), |(x, _, _)| if x < 2 { 0.001 } else { 0.021 }), [2.0; 3])
    }

    fn converted(how: &str, unit: Option<Unit>) -> Result<(Volume, String)> {
        let volume = volume();
        let how: How = how.parse().unwrap();
        let calibration = how.open("a.nii", unit.as_ref(), &volume.grid, None)?;
        let levels = calibration.measure(&mut &volume)?;
        let converted = Volume::collect(&mut levels.of(&mut &volume))?;
        Ok((converted, levels.note))
    }

    #[test]
    fn water_is_the_table_and_between_its_energies() {
        assert_eq!((water(4.9), water(f64::NAN)), (None, None));
        assert!((water(60.0).unwrap() - 0.02059).abs() < 1e-12);
        let between = water((60.0f64 * 80.0).sqrt()).unwrap();
        assert!((between - 0.1 * (0.2059f64 * 0.1837).sqrt()).abs() < 1e-12, "{between}");
        assert!(WATER.windows(2).all(|p| p[0][0] < p[1][0] && p[0][1] > p[1][1]));
    }

    #[test]
    fn given_and_measured_levels_give_hounsfield_units() {
        let ends = |v: &Volume| [v.data[[0, 0, 0]], v.data[[3, 2, 1]]];
        let near = |v: &Volume| ends(v).iter().zip([-1000.0, 0.0]).all(|(a, b)| (a - b).abs() < 1e-3);
        let (v, note) = converted("water=0.021,air=0.001", None).unwrap();
        assert!(near(&v), "{v:?}");
        assert_eq!(note, "HU: water 0.021, air 0.001 per mm");
        // Voxels lie at x = -3, -1, 1 and 3 mm.
        let (v, note) = converted("water=sphere:3,0,1,2.5,air=box:0,-2,-1,-9,2,1", None).unwrap();
        assert!(near(&v), "{v:?}");
        assert_eq!(note, "HU: water 0.021, air 0.001");
        let cm = Unit { name: "cm".into(), mm: 10.0 };
        assert!(near(&converted("water=0.0021,air=0.0001", Some(cm.clone())).unwrap().0));
        assert_eq!(converted("60keV", Some(cm)).unwrap().1, "HU: water 0.2059, air 0 per cm at 60 keV");
        assert_eq!(ends(&converted("as-is", None).unwrap().0), [0.001, 0.021]);
    }

    #[test]
    fn a_streak_and_a_bubble_in_a_region_do_not_shift_it() {
        let mut volume = volume();
        (volume.data[[0, 1, 1]], volume.data[[3, 1, 1]]) = (0.4, 0.0);
        let how: How = "water=box:1,-2,-1,3,2,1,air=box:-3,-2,-1,-1,2,1".parse().unwrap();
        let levels = how.open("a.nii", None, &volume.grid, None).unwrap().measure(&mut &volume).unwrap();
        assert_eq!([levels.water as f32, levels.air as f32], [0.021, 0.001]);
    }

    #[test]
    fn the_median_of_an_even_number_lies_between_the_middle_two() {
        let (_, note) = converted("water=box:-3,-2,-1,3,2,1,air=0", None).unwrap();
        assert_eq!(note, "HU: water 0.011, air 0");
    }

    #[test]
    fn a_relative_unit_needs_regions() {
        let cube = Some(Unit { name: "cube half side".into(), mm: 4.0 });
        let said = converted("60keV", cube.clone()).unwrap_err().to_string();
        assert!(said.contains("a.nii: unit: found \"cube half side\"") && said.contains("regions"), "{said}");
        assert!(converted("water=sphere:3,0,1,2.5,air=box:0,-2,-1,-9,2,1", cube).is_ok());
        let said = converted("water=sphere:30,0,1,2,air=0", None).unwrap_err().to_string();
        assert!(said.contains(FIELD) && said.contains("without a voxel") && said.contains("3.000"), "{said}");
        let said = converted("water=0.001,air=0.02", None).unwrap_err().to_string();
        assert!(said.contains("water 0.001 and air 0.02"), "{said}");
    }

    #[test]
    fn a_file_calibrates_and_bad_forms_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.toml");
        std::fs::write(&path, "water = 0.021\nair = 0.001\nenergy_kev = 62.5\n").unwrap();
        let how = path.display().to_string();
        assert_eq!(converted(&how, None).unwrap().1, "HU: water 0.021, air 0.001 per mm at 62.5 keV");
        std::fs::write(&path, "water = 0.021\nare = 0.001\n").unwrap();
        let said = converted(&how, None).unwrap_err().to_string();
        assert!(said.contains("a.toml:2:1: are") && said.contains("\"air\" (of water, air, energy_kev)"), "{said}");
        for bad in ["", "60", "keV", "€V", "water=1", "water=a,air=0", "air=0,water=1", "water=sphere:1,air=0"] {
            assert!(bad.parse::<How>().is_err(), "{bad}");
        }
        assert!("2keV".parse::<How>().unwrap_err().contains("5 to 1250 keV"));
        assert!("water=sphere:0,0,0,-1,air=0".parse::<How>().unwrap_err().contains("radius above 0"));
    }
}
