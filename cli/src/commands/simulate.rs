//! `conefield simulate`

use crate::boundary::{Inputs, refuse_existing};
use crate::out;
use crate::progress::Progress;
use clap::Args;
use conefield::files;
use conefield::memory::Memory;
use conefield::parse::{self, AnglesOption, Values};
use conefield::simulation::{self, Changes};
use conefield_core::Result;
use conefield_core::finite::range;
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::Unit;
use conefield_projectors::simulate::{DetectorExtent, DetectorNoise, Protocol};
use serde_json::json;
use std::path::PathBuf;
use std::sync::Mutex;
use tracing::warn;

/// Make a scan of a known volume.
///
/// Projections are line integrals of the trilinearly interpolated volume along a circular orbit. The scan keeps the
/// volume as its truth.
#[derive(Args)]
pub struct SimulateArgs {
    /// The volume: a file, or phantom:head, phantom:abdomen or phantom:random:SEED, each optionally with :SIZE (8 to
    /// 1024 voxels per side) [default: 128].
    volume: String,
    /// The folder for the scan.
    #[arg(short, long = "output", value_name = "SCAN")]
    output: PathBuf,
    /// The geometry: r2, the published synthetic set-up, or a TOML or JSON file (docs/guide/formats.md has its keys).
    #[arg(long, default_value = "r2", value_name = "r2|FILE")]
    protocol: String,
    #[command(flatten)]
    set_up: SetUp,
    /// Number of views [default: the protocol's; else 50].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    views: Option<u32>,
    /// Rows and columns of the detector, with a protocol at its size in mm [default: the protocol's; r2: 512x512].
    #[arg(long, value_name = "ROWSxCOLS", value_parser = parse::detector)]
    detector: Option<[usize; 2]>,
    /// Shift of the detector along v (from row to row) and u (from column to column), in mm.
    #[arg(long, value_name = "V,U", value_parser = parse::offset, allow_hyphen_values = true)]
    offset: Option<[f64; 2]>,
    /// Angles in degrees: evenly from START over RANGE, or a file with one per line.
    #[arg(long, value_name = "START:RANGE|FILE", value_parser = parse::angles, allow_hyphen_values = true)]
    angles: Option<AnglesOption>,
    /// Noise: none, tigre:I0,SIGMA such as tigre:1e4,10 (the published one), or poisson:I0 [default: the protocol's;
    /// else none].
    #[arg(long, value_parser = parse::noise)]
    noise: Option<DetectorNoise>,
    /// Average blocks of N x N x N voxels first.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    downsample: u16,
    /// Meaning of the voxel values: as-is (attenuation per unit of the protocol), hu:MU_WATER (HU, with the attenuation
    /// of water in 1/mm) or clip:LO,HI (LO to HI becomes 0 to 1).
    #[arg(long, default_value = "as-is", value_parser = parse::values)]
    values: Values,
    /// Seed of the noise [default: the protocol's; else 0].
    #[arg(long)]
    seed: Option<u64>,
    /// Replace SCAN.
    #[arg(long)]
    force: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// A set-up in mm, in place of a protocol; voxel values are attenuation in 1/mm.
#[derive(Args)]
struct SetUp {
    /// Distance from the source to the rotation axis in mm; takes the place of a protocol, with --dsd, --pixel and
    /// --detector.
    #[arg(long, value_name = "MM", value_parser = parse::above_zero, conflicts_with = "protocol",
        requires = "dsd", requires = "pixel", requires = "detector")]
    dso: Option<f64>,
    /// Distance from the source to the detector in mm.
    #[arg(long, value_name = "MM", value_parser = parse::above_zero, requires = "dso")]
    dsd: Option<f64>,
    /// Size of a pixel in mm, or along v and u.
    #[arg(long, value_name = "MM|V,U", value_parser = parse::pixel, requires = "dso")]
    pixel: Option<[f64; 2]>,
}

impl SetUp {
    /// The protocol for a volume on `grid`; `None` without a set-up.
    fn protocol(&self, detector: Option<[usize; 2]>, grid: &VoxelGrid) -> Option<Protocol> {
        let (dso, dsd, pixel, detector) = (self.dso?, self.dsd?, self.pixel?, detector?);
        let extent = DetectorExtent::Pixel(pixel);
        Some(Protocol { unit: Unit::default(), dso, dsd, detector, extent, ..Protocol::r2(grid) })
    }
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
        Memory::of_volumes(&[before]).check()?;
        let volume = files::volume(&self.volume)?;
        let volume = simulation::prepared(&self.volume, volume, self.values, self.downsample.into())?;
        let set_up = self.set_up.protocol(self.detector, &volume.grid);
        let changes = Changes {
            views: self.views.map(|n| n as usize),
            detector: self.detector.filter(|_| set_up.is_none()),
            offset: self.offset,
            angles: self.angles.clone(),
            noise: self.noise,
            seed: self.seed,
        };
        let protocol = set_up.map_or_else(|| simulation::protocol(&self.protocol, &volume.grid), Ok)?;
        let protocol = simulation::changed(protocol, &changes, "command line")?;
        let progress = Mutex::new(Progress::new("simulate", None));
        // One thread shows what all have done.
        let reach = |share| progress.try_lock().map_or((), |mut progress| progress.reach(share));
        let (scan, volume) = simulation::scan(volume, self.values, &protocol, &self.volume, &reach)?;
        drop(progress);
        conefield_io::write_scan(&self.output, &scan, Some(&volume))?;
        let g = &scan.geometry;
        if range(&scan.projections) == [0.0; 2] {
            warn!(
                "every line integral is 0: no ray meets the object; lengths of the protocol are in its unit ({} mm)",
                scan.unit.mm
            );
        }
        if self.json {
            return out::json(&json!({
                "scan": self.output, "views": g.views.len(), "detector": g.detector, "volume": g.volume.shape,
                "noise": protocol.noise, "seed": protocol.seed,
            }));
        }
        let ([rows, columns], [x, y, z]) = (g.detector, g.volume.shape);
        out::say(&format!(
            "{}: {} of {rows} x {columns}, of {x} x {y} x {z} voxels, noise {}",
            self.output.display(),
            out::counted(g.views.len(), "view"),
            protocol.noise,
        ))
    }
}
