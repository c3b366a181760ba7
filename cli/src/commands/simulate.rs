//! `conefield simulate`

use crate::boundary::{Inputs, refuse_existing};
use crate::memory::Memory;
use crate::parse::{self, AnglesOption, Values};
use crate::{files, out};
use clap::Args;
use conefield_core::files::{read_text, toml_line};
use conefield_core::scan::Volume;
use conefield_core::{Error, Result};
use conefield_projectors::simulate::{Angles, DetectorNoise, HuMapping, Protocol, downsample, simulate};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Longest protocol or list of angles, in bytes.
const LONGEST: u64 = 16 << 20;

/// Make a scan of a known volume.
///
/// Projections are line integrals of the volume's trilinear interpolation along a circular orbit. The scan keeps the
/// volume as its truth.
#[derive(Args)]
pub struct SimulateArgs {
    /// The volume: a file, or one that the program makes: phantom:head, phantom:abdomen or phantom:random:SEED, each also
    /// with :SIZE (8 to 1024 voxels a side) [default: 128].
    volume: String,
    /// The folder for the scan.
    #[arg(short, long = "output", value_name = "SCAN")]
    output: PathBuf,
    /// Where source and detector stand: r2, the published synthetic set-up, or a TOML or JSON file (docs/geometry.md has its
    /// keys).
    #[arg(long, default_value = "r2", value_name = "r2|FILE")]
    protocol: String,
    /// Number of views [default: the protocol's; r2: 50].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    views: Option<u32>,
    /// Rows and columns of the detector, whose size stays [default: the protocol's; r2: 512x512].
    #[arg(long, value_name = "ROWSxCOLS", value_parser = parse::detector)]
    detector: Option<[usize; 2]>,
    /// Shift of the detector along its rows' and its columns' direction, in mm.
    #[arg(long, value_name = "V,U", value_parser = parse::offset, allow_hyphen_values = true)]
    offset: Option<[f64; 2]>,
    /// Angles in degrees: evenly from START over RANGE, or a file with one a line.
    #[arg(long, value_name = "START:RANGE|FILE", value_parser = parse::angles, allow_hyphen_values = true)]
    angles: Option<AnglesOption>,
    /// Noise: none, tigre:I0,SIGMA such as tigre:1e4,10 (the published one), or poisson:I0 [default: the protocol's;
    /// r2: none].
    #[arg(long, value_parser = parse::noise)]
    noise: Option<DetectorNoise>,
    /// Average blocks of N x N x N voxels first.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    downsample: u16,
    /// What voxel values mean: as-is (attenuation a unit of the protocol), hu:MU_WATER (HU, with the attenuation of
    /// water in 1/mm) or clip:LO,HI (LO to HI becomes 0 to 1).
    #[arg(long, default_value = "as-is", value_parser = parse::values)]
    values: Values,
    /// Seed of the noise [default: the protocol's; r2: 0].
    #[arg(long)]
    seed: Option<u64>,
    /// Replace SCAN.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl SimulateArgs {
    pub fn run(self) -> Result<()> {
        refuse_existing(&self.output, self.force)?;
        let angles = match &self.angles {
            Some(AnglesOption::File(path)) => Some(path),
            _ => None,
        };
        Inputs::of([&self.volume, &self.protocol]).and(angles).spare_folder(&self.output)?;
        let before = files::voxels(&self.volume)?;
        Memory::of_volumes(&[before]).check(|_| vec![])?;
        let mut volume = self.values.apply(files::volume(&self.volume)?)?;
        // A scan's volume stands on the rotation axis.
        volume.grid.center = [0.0; 3];
        if self.downsample > 1 {
            volume = downsample(&volume, self.downsample.into())?;
            volume.grid.center = [0.0; 3];
        }
        let protocol = self.protocol(&volume)?;
        self.memory(&volume, &protocol)?;
        if let Values::Hu(HuMapping::Mu { .. }) = self.values {
            // From 1/mm to the protocol's unit.
            let per_unit = protocol.unit.mm as f32;
            volume = volume.mapped(|x| x * per_unit);
        }
        let mut scan = simulate(&volume, &protocol)?;
        if let Some(p) = scan.provenance.as_object_mut() {
            p.insert("source".into(), json!(self.volume));
        }
        conefield_io::write_scan(&self.output, &scan, Some(&volume))?;
        let g = &scan.geometry;
        if self.json {
            return out::json(&json!({
                "scan": self.output, "views": g.views.len(), "detector": g.detector, "volume": g.volume.shape,
                "noise": protocol.noise, "seed": protocol.seed,
            }));
        }
        let ([rows, columns], [x, y, z]) = (g.detector, g.volume.shape);
        out::say(&format!(
            "{}: {} views of {rows} x {columns}, of {x} x {y} x {z} voxels, noise {}",
            self.output.display(),
            g.views.len(),
            protocol.noise,
        ))
    }

    /// Refuses what does not fit: projecting takes a copy of the volume with a rim.
    fn memory(&self, volume: &Volume, protocol: &Protocol) -> Result<()> {
        let g = protocol.geometry(&volume.grid)?;
        let rim = g.volume.shape.iter().map(|&n| n as u64 + 2).product::<u64>();
        let need = |views: usize, share: u64| {
            let pixels = (views * g.detector[0] * g.detector[1]) as u64 / share;
            let volume = 4 * (volume.data.len() as u64 + rim);
            Memory::most(&[Memory { scan: 4 * pixels, volume, ..Memory::default() }])
        };
        need(g.views.len(), 1).check(|available| {
            let fits = |m: Memory| m.total <= available;
            let views = (1..=g.views.len()).rev().find(|&n| fits(need(n, 1)));
            let detector = (1..5).find(|k| fits(need(g.views.len(), 1 << (2 * k))));
            let views = views.map(|n| format!("{n} views"));
            let detector = detector.map(|k| format!("a detector of {}x{}", g.detector[0] >> k, g.detector[1] >> k));
            views.into_iter().chain(detector).collect()
        })
    }

    fn protocol(&self, volume: &Volume) -> Result<Protocol> {
        let mut p = match self.protocol.as_str() {
            "r2" => Protocol::r2(&volume.grid),
            path => read_protocol(Path::new(path))?,
        };
        if let Some(d) = self.detector {
            p = p.with_detector(d);
        }
        if let Some(n) = self.noise {
            p.noise = n;
        }
        if let Some(seed) = self.seed {
            p.seed = seed;
        }
        if let Some(mm) = self.offset {
            p.offset = mm.map(|x| x / p.unit.mm);
        }
        match &self.angles {
            Some(AnglesOption::File(path)) => {
                if self.views.is_some() {
                    let expected = "--views or --angles FILE, which says how many there are";
                    return Err(Error::invalid("command line", "--views", "both", expected));
                }
                p.angles = Angles::ListDeg(read_angles(path)?);
            }
            Some(AnglesOption::Even { start, range }) => {
                let views = self.views.map_or(p.angles.radians().len(), |n| n as usize);
                p.angles = Angles::Even { views, start_deg: *start, arc_deg: *range };
            }
            None => {
                if let Some(n) = self.views {
                    let views = n as usize;
                    p.angles = match p.angles {
                        Angles::Even { start_deg, arc_deg, .. } => Angles::Even { views, start_deg, arc_deg },
                        Angles::ListDeg(_) => Angles::Even { views, start_deg: 0.0, arc_deg: 360.0 },
                    };
                }
            }
        }
        Ok(p)
    }
}

fn read_protocol(path: &Path) -> Result<Protocol> {
    let text = read_text(path, LONGEST)?;
    let place = path.display();
    if text.trim_start().starts_with('{') {
        return serde_json::from_str(&text)
            .map_err(|e| Error::invalid(format!("{place}:{}:{}", e.line(), e.column()), "protocol", e, "a protocol"));
    }
    toml::from_str(&text).map_err(|e| {
        let line = toml_line(&text, &e).unwrap_or(1);
        Error::invalid(format!("{place}:{line}"), "protocol", e.message(), "a protocol")
    })
}

fn read_angles(path: &Path) -> Result<Vec<f64>> {
    let text = read_text(path, LONGEST)?;
    let lines = text.lines().map(|l| l.split('#').next().unwrap_or_default().trim()).enumerate();
    let angles = lines.filter(|(_, l)| !l.is_empty()).map(|(i, l)| match l.parse::<f64>() {
        Ok(a) if a.is_finite() => Ok(a),
        _ => Err(Error::invalid(format!("{}:{}", path.display(), i + 1), "angle", l, "a number of degrees")),
    });
    angles.collect()
}
