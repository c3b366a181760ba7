//! Simulated scans of known volumes.

use crate::memory::Memory;
use crate::parse::{AnglesOption, Values};
use conefield_core::files::read_text;
use conefield_core::finite::range;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_core::words::counted;
use conefield_core::{Error, Result, written};
use conefield_projectors::simulate::{Angles, DetectorNoise, HuMapping, Protocol, downsample, project, simulate_with};
use serde_json::json;
use std::path::Path;

/// Line integrals that no measurement reaches: exp(−50) of the light is left.
const OPAQUE: f32 = 50.0;

/// Longest protocol or list of angles, in bytes.
const LONGEST: u64 = 16 << 20;

/// Changes to a protocol.
#[derive(Debug, Clone, Default)]
pub struct Changes {
    /// Number of views.
    pub views: Option<usize>,
    /// Rows and columns of the detector; its size stays the same.
    pub detector: Option<[usize; 2]>,
    /// Shift of the detector along v and u, mm.
    pub offset: Option<[f64; 2]>,
    /// Angles of the views.
    pub angles: Option<AnglesOption>,
    /// Noise of the detector.
    pub noise: Option<DetectorNoise>,
    /// Seed of the noise.
    pub seed: Option<u64>,
}

/// The volume `name` centred on the rotation axis, in attenuation, with blocks of `size`³ voxels averaged.
pub fn prepared(name: &str, volume: Volume, values: Values, size: usize) -> Result<Volume> {
    let mut volume = values.attenuation(name, volume)?;
    // A scan's volume is centred on the rotation axis.
    volume.grid.center = [0.0; 3];
    if size > 1 {
        volume = downsample(&volume, size)?;
        volume.grid.center = [0.0; 3];
    }
    Ok(volume)
}

/// The protocol named `name` for a volume on `grid`: r2, or a TOML or JSON file.
pub fn protocol(name: &str, grid: &VoxelGrid) -> Result<Protocol> {
    match name {
        "r2" => Ok(Protocol::r2(grid)),
        path => written::read(path, &read_text(Path::new(path), LONGEST)?),
    }
}

/// Applies changes to a protocol. The error about both a number of views and a list of angles names `place`.
pub fn changed(mut p: Protocol, changes: &Changes, place: &str) -> Result<Protocol> {
    if let Some(d) = changes.detector {
        p = p.with_detector(d);
    }
    if let Some(n) = changes.noise {
        p.noise = n;
    }
    if let Some(seed) = changes.seed {
        p.seed = seed;
    }
    if let Some(mm) = changes.offset {
        p.offset = mm.map(|x| x / p.unit.mm);
    }
    p.angles = match (&changes.angles, changes.views, p.angles) {
        (Some(AnglesOption::File(path)), None, _) => Angles::ListDeg(read_angles(path)?),
        (Some(AnglesOption::File(_)), Some(_), _) => {
            let expected = "--views or --angles FILE, which determines the number";
            return Err(Error::invalid(place, "--views", "both", expected));
        }
        (Some(AnglesOption::Even { start, range }), views, before) => {
            let views = views.unwrap_or_else(|| before.radians().len());
            Angles::Even { views, start_deg: *start, arc_deg: *range }
        }
        (None, Some(views), Angles::Even { start_deg, arc_deg, .. }) => Angles::Even { views, start_deg, arc_deg },
        (None, Some(views), Angles::ListDeg(_)) => {
            let expected = "--angles, or no --views: the protocol lists its angles";
            return Err(Error::invalid(place, "--views", format!("--views {views}"), expected));
        }
        (None, None, before) => before,
    };
    Ok(p)
}

/// Simulates a scan of `volume`, after [`prepared`], with `protocol`; returns the scan and its true volume. Calls
/// `progress` with the share of finished views after each. Refuses a scan that does not fit into memory.
pub fn scan(
    mut volume: Volume,
    values: Values,
    protocol: &Protocol,
    source: &str,
    progress: &(dyn Fn(f64) + Sync),
) -> Result<(Scan, Volume)> {
    check_memory(&volume, &protocol.geometry(&volume.grid)?)?;
    if let Values::Hu(HuMapping::Mu { .. }) = values {
        // Converts 1/mm to the protocol's unit.
        let per_unit = protocol.unit.mm as f32;
        volume = volume.mapped(|x| x * per_unit);
    }
    let mut scan = simulate_with(&volume, protocol, progress)?;
    let most = range(&scan.projections)[1];
    if most > OPAQUE {
        tracing::warn!(
            "line integrals up to {most}: nothing passes such an object; voxel values are attenuation per {} (--values)",
            protocol.unit.name
        );
    }
    if let Some(p) = scan.provenance.as_object_mut() {
        p.insert("source".into(), json!(source));
    }
    Ok((scan, volume))
}

/// Simulates a scan of a volume in 1/mm, at its own position, in any geometry.
pub fn scan_in(volume: &Volume, geometry: Geometry, noise: DetectorNoise, seed: u64) -> Result<Scan> {
    check_memory(volume, &geometry)?;
    let mut projections = project(volume, &geometry, 2.0)?;
    noise.add(&mut projections, seed);
    let provenance = json!({ "simulated": { "noise": noise, "seed": seed, "volume": volume.grid } });
    let scan = Scan { geometry, projections, unit: Unit::default(), provenance };
    scan.validate("simulated scan")?;
    Ok(scan)
}

/// Refuses a scan that does not fit into memory: the projection takes a padded copy of the volume.
pub fn check_memory(volume: &Volume, g: &Geometry) -> Result<()> {
    let rim = volume.grid.shape.iter().map(|&n| n as u64 + 2).product::<u64>();
    let need = |views: usize, share: u64| {
        let pixels = (views * g.detector[0] * g.detector[1]) as u64 / share;
        let volume = 4 * (volume.data.len() as u64 + rim);
        Memory::most(&[Memory { scan: 4 * pixels, volume, ..Memory::default() }])
    };
    need(g.views.len(), 1).check_or(&|available| {
        let fits = |m: Memory| m.total <= available;
        let views = (1..=g.views.len()).rev().find(|&n| fits(need(n, 1)));
        let detector = (1..5).find(|k| fits(need(g.views.len(), 1 << (2 * k))));
        let views = views.map(|n| counted(n, "view"));
        let detector = detector.map(|k| format!("a detector of {}x{}", g.detector[0] >> k, g.detector[1] >> k));
        views.into_iter().chain(detector).collect()
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
