//! The simulated scans of a study.

use crate::files;
use crate::memory::Memory;
use crate::parse::{AnglesOption, HoldOut, Values};
use crate::simulation::{self, Changes};
use conefield_core::checksum;
use conefield_core::error::ensure;
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::{Scan, Volume};
use conefield_core::{Error, Result, written};
use conefield_projectors::simulate::Protocol;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Settings of a simulated scan, except the seed of its noise.
pub struct Simulation {
    /// The volume, as written in the study's file.
    pub written: String,
    /// The volume, resolved relative to the study's file.
    pub volume: String,
    /// Meaning of its voxel values.
    pub values: Values,
    /// The same, as written in the study's file.
    pub values_written: String,
    /// Side, in voxels, of the blocks that are averaged first.
    pub downsample: usize,
    /// r2 or a file.
    pub protocol: String,
    /// Changes to the protocol.
    pub changes: Changes,
    /// How the volume was prepared, once it has been read.
    pub preparation: OnceLock<Value>,
}

impl Simulation {
    /// Input files.
    pub fn inputs(&self) -> Vec<PathBuf> {
        let angles = match &self.changes.angles {
            Some(AnglesOption::File(path)) => Some(path.clone()),
            _ => None,
        };
        [&self.volume, &self.protocol].into_iter().map(PathBuf::from).chain(angles).collect()
    }

    /// Refuses a volume that cannot be read or scanned, and held-out views that do not exist.
    pub fn check(&self, hold_out: Option<&HoldOut>) -> Result<()> {
        let volume = self.prepared()?;
        self.preparation.get_or_init(|| self.preparation(&volume));
        let geometry = self.protocol(&volume.grid, 0)?.geometry(&volume.grid)?;
        simulation::check_memory(&volume, &geometry)?;
        let views = geometry.views.len();
        let held = crate::input::held_out(hold_out, views, &self.written, "hold_out")?;
        let strange = held.iter().find(|i| **i >= views);
        let (found, expected) = (strange.copied().unwrap_or(0), format!("an index below {views}, the number of views"));
        ensure(strange.is_none(), &self.written, "hold_out", found, expected)?;
        ensure(held.len() < views, &self.written, "hold_out", "every view", "some views to work with")
    }

    /// Simulates the scan with the noise of `seed` and writes it, with its true volume, to `folder`.
    pub fn make(&self, seed: u64, folder: &Path) -> Result<()> {
        let volume = self.prepared()?;
        let protocol = self.protocol(&volume.grid, seed)?;
        let prepared = self.preparation(&volume);
        let (mut scan, volume) = simulation::scan(volume, self.values, &protocol, &self.written, &|_| {})?;
        if let Some(p) = scan.provenance.as_object_mut() {
            p.insert("prepared".into(), prepared);
        }
        conefield_io::write_scan(folder, &scan, Some(&volume))
    }

    /// Refuses a `scan` at `place` that [`Self::make`] would not have produced with `seed`.
    pub fn check_made(&self, seed: u64, scan: &Scan, place: &Path) -> Result<()> {
        let now = self.protocol(&scan.geometry.volume, seed)?;
        let then = scan.provenance["simulated"]["protocol"].to_string();
        let then: Option<Protocol> = written::read("protocol.json", &then).ok();
        let mut prepared = match self.preparation.get() {
            Some(preparation) => preparation.clone(),
            None => self.preparation(&self.prepared()?),
        };
        if scan.provenance["prepared"]["volume"].is_null() {
            // A scan of an earlier version does not say which voxels it was made of.
            prepared.as_object_mut().map(|how| how.remove("volume"));
        }
        let same = then.as_ref() == Some(&now)
            && scan.provenance["source"] == self.written
            && scan.provenance["prepared"] == prepared;
        let expected = "a scan simulated as this study's file says, from its volume as it is now; --force starts over";
        ensure(
            same,
            &place.display().to_string(),
            "--resume: simulation",
            "a scan that was simulated in another way",
            expected,
        )
    }

    /// The volume to scan.
    fn prepared(&self) -> Result<Volume> {
        Memory::of_volumes(&[files::voxels(&self.volume)?]).check()?;
        simulation::prepared(&self.volume, files::volume(&self.volume)?, self.values, self.downsample)
    }

    fn protocol(&self, grid: &VoxelGrid, seed: u64) -> Result<Protocol> {
        let changes = Changes { seed: Some(seed), ..self.changes.clone() };
        let protocol = simulation::protocol(&self.protocol, grid)?;
        simulation::changed(protocol, &changes, "study").map_err(|e| match e {
            // Errors name the options of the command line.
            Error::Invalid { place, field, found, .. } if field == "--views" => {
                Error::invalid(place, "views", found, "views, or angles from a file, which determines the number")
            }
            other => other,
        })
    }

    /// How `volume` was prepared. A phantom is known by its name.
    fn preparation(&self, volume: &Volume) -> Value {
        let mut how = json!({ "values": self.values_written, "downsample": self.downsample });
        if !self.volume.starts_with("phantom:") {
            let voxels = format!("{} {:?}", checksum::of_numbers(&volume.data), volume.grid.spacing);
            how["volume"] = json!(checksum::of_text(&voxels));
        }
        how
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(volume: &str, views: usize) -> Simulation {
        Simulation {
            written: volume.into(),
            volume: volume.into(),
            values: Values::AsIs,
            values_written: "as-is".into(),
            downsample: 2,
            protocol: "r2".into(),
            changes: Changes {
                views: Some(views),
                detector: Some([8, 8]),
                noise: "tigre:1e4,10".parse().ok(),
                ..Changes::default()
            },
            preparation: OnceLock::new(),
        }
    }

    #[test]
    fn a_scan_is_known_again() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("scan");
        let simulation = of("phantom:head:16", 5);
        simulation.make(7, &folder).unwrap();
        let scan = conefield_scans::read_scan(&folder).unwrap();
        assert_eq!((scan.geometry.views.len(), scan.geometry.volume.shape), (5, [8; 3]));
        simulation.check_made(7, &scan, &folder).unwrap();
        let other_values = Simulation { values_written: "clip:0,1".into(), ..of("phantom:head:16", 5) };
        for (other, seed) in [
            (&of("phantom:head:16", 5), 8),
            (&of("phantom:head:16", 6), 7),
            (&of("phantom:abdomen:16", 5), 7),
            (&other_values, 7),
        ] {
            let e = other.check_made(seed, &scan, &folder).unwrap_err().to_string();
            assert!(e.contains("simulated in another way"), "{e}");
        }
    }

    #[test]
    fn a_changed_volume_is_noticed() {
        let dir = tempfile::tempdir().unwrap();
        let (file, folder) = (dir.path().join("volume.nii.gz"), dir.path().join("scan"));
        let mut volume = files::volume("phantom:head:16").unwrap();
        conefield_io::write_volume(&file, &volume).unwrap();
        let file_name = file.to_str().unwrap();
        of(file_name, 5).make(7, &folder).unwrap();
        let mut scan = conefield_scans::read_scan(&folder).unwrap();
        of(file_name, 5).check_made(7, &scan, &folder).unwrap();
        volume.data[[8, 8, 8]] += 0.25;
        conefield_io::write_volume(&file, &volume).unwrap();
        let changed = of(file_name, 5);
        changed.check(None).unwrap();
        let e = changed.check_made(7, &scan, &folder).unwrap_err().to_string();
        assert!(e.contains("simulated in another way"), "{e}");
        // A scan of an earlier version.
        scan.provenance["prepared"].as_object_mut().unwrap().remove("volume").unwrap();
        changed.check_made(7, &scan, &folder).unwrap();
    }

    #[test]
    fn views_to_keep_aside_must_be_there() {
        let s = of("phantom:head:16", 5);
        s.check(Some(&HoldOut::Every(3))).unwrap();
        for (held, want) in [(vec![5], "found 5, expected an index below 5"), (vec![0, 1, 2, 3, 4], "every view")] {
            let e = s.check(Some(&HoldOut::Views(held))).unwrap_err().to_string();
            assert!(e.contains(want), "{e}");
        }
    }
}
