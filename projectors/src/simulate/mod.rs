//! Simulation of scans from volumes: phantoms, protocols, line integrals and noise.
//!
//! - [`phantom`], [`phantom_of`]: computed phantoms.
//! - [`Ellipsoid`]: bodies with closed-form scans.
//! - [`downsample`], [`HuMapping`]: preparation of clinical volumes.
//! - [`Protocol`]: geometry, number of views, noise.
//! - [`project`]: line integrals of the trilinear interpolation of a volume.
//! - [`DetectorNoise`]: photon counting statistics.
//! - [`simulate`]: the complete simulation, with a record of its settings.

mod abdomen;
mod ellipsoids;
mod head;
mod noise;
mod paint;
mod phantom;
mod prepare;
mod project;
mod protocol;
mod shape;
#[cfg(test)]
mod tests;

pub use ellipsoids::{Ellipsoid, ellipsoids, scan_ellipsoids};
pub use noise::{DetectorNoise, MIN_COUNT};
pub use phantom::{PhantomKind, phantom, phantom_of};
pub use prepare::{HuMapping, downsample};
pub use project::project;
pub use protocol::{Angles, DetectorExtent, Protocol};

use conefield_core::Result;
use conefield_core::finite::range;
use conefield_core::geometry::Geometry;
use conefield_core::parallel;
use conefield_core::scan::{Scan, Volume};
use serde_json::json;

/// Simulates a scan of `volume` with `protocol`.
///
/// The volume's values are per protocol unit of length (1/mm for the default unit), so that a projection is Σ value ·
/// length in units and has no unit itself.
pub fn simulate(volume: &Volume, protocol: &Protocol) -> Result<Scan> {
    simulate_with(volume, protocol, &|_| {})
}

/// As [`simulate`]; calls `progress` with the share of finished views after each.
pub fn simulate_with(volume: &Volume, protocol: &Protocol, progress: &(dyn Fn(f64) + Sync)) -> Result<Scan> {
    let geometry: Geometry = protocol.geometry(&volume.grid)?;
    let mut projections = project::project_with(volume, &geometry, protocol.samples_per_voxel, progress)?;
    let units_per_mm = (1.0 / protocol.unit.mm) as f32;
    parallel::scale(&mut projections, units_per_mm);
    let largest = range(&projections)[1].max(0.0);
    protocol.noise.add(&mut projections, protocol.seed);
    let provenance = json!({
        "simulated": {
            "protocol": protocol,
            "volume": volume.grid,
            "sampling": "trilinear interpolation of voxel centres, held constant over the outer half voxel and zero \
                         beyond the box; midpoints of equal steps between entry and exit",
            "largest_line_integral": largest,
        }
    });
    let scan = Scan { geometry, projections, unit: protocol.unit.clone(), provenance };
    scan.validate("simulated scan")?;
    Ok(scan)
}
