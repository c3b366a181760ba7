//! Maps the names of files and phantoms to volumes, scans and weights.

use crate::record::History;
use conefield_backend_cpu::Cpu;
use conefield_core::arena::Weights;
use conefield_core::checkpoint::{Checkpoint, Resume, Standing};
use conefield_core::error::ensure;
use conefield_core::pipeline::Model;
use conefield_core::scan::{Scan, Volume};
use conefield_core::trained::{Placement, TrainedField};
use conefield_core::{Error, Result, written};
#[cfg(feature = "plots")]
pub use conefield_evaluation::report::result_png as picture;
pub use conefield_evaluation::report::text::stem;
pub use conefield_io::read_weights;
use conefield_projectors::simulate::{PhantomKind, phantom_of};
use conefield_scans::diagnosis::{Survey, WarningKind, survey};
use std::collections::BTreeMap;
use std::path::Path;

/// The volume named `name`: `phantom:KIND[:SIZE]` or a file.
pub fn volume(name: &str) -> Result<Volume> {
    match phantom(name)? {
        Some((kind, size)) => Ok(phantom_of(kind, size)),
        None => conefield_io::read_volume(Path::new(name)),
    }
}

/// Number of voxels of the volume named `name`, without reading or computing it.
pub fn voxels(name: &str) -> Result<u64> {
    match phantom(name)? {
        Some((_, size)) => Ok((size as u64).pow(3)),
        None => conefield_io::volume_voxels(Path::new(name)),
    }
}

/// The kind and size in `phantom:KIND[:SIZE]`; `None` for a file name.
fn phantom(name: &str) -> Result<Option<(PhantomKind, usize)>> {
    let Some(rest) = name.strip_prefix("phantom:") else { return Ok(None) };
    let (kind, size) = match (rest.parse::<PhantomKind>(), rest.rsplit_once(':')) {
        (Ok(kind), _) => (kind, "128"),
        (_, Some((kind, size))) => (kind.parse()?, size),
        (Err(e), None) => return Err(e),
    };
    match size.parse() {
        Ok(size @ 8..=1024) => Ok(Some((kind, size))),
        _ => Err(Error::invalid(name, "size", size, "a number of voxels from 8 to 1024")),
    }
}

/// Reads a scan and logs warnings about problems for a reconstruction.
pub fn scan(path: &Path) -> Result<Scan> {
    let scan = conefield_scans::read_scan(path)?;
    warn_of(path, &survey(&scan), false);
    Ok(scan)
}

/// Logs warnings about problems for a reconstruction; if `surrounded`, none of an object beyond the volume.
pub fn warn_of(path: &Path, survey: &Survey, surrounded: bool) {
    for warning in survey.warnings.iter().filter(|w| !(surrounded && w.kind == WarningKind::Outside)) {
        tracing::warn!("{}: {warning}", path.display());
    }
}

/// Writes weights with their notes.
pub fn write_weights(path: impl AsRef<Path>, weights: &Weights) -> Result<()> {
    let tensors = weights.tensors.iter().map(|(name, (shape, values))| (&name[..], &shape[..], &values[..]));
    conefield_io::write_weights(path.as_ref(), &tensors.collect::<Vec<_>>(), &weights.notes)
}

/// Whether `path` is one of these folders or files, by name, or an unfinished file.
pub fn is_one_of(path: &Path, folders: &[&str], files: &[&str]) -> bool {
    let name = path.file_name().unwrap_or_default();
    let names = if path.is_dir() { folders } else { files };
    names.iter().any(|own| name == *own) || conefield_io::is_unfinished(name)
}

/// The note with the placement of the field.
const PLACEMENT: &str = "placement";

/// Writes the weights of a trained field; `notes` contain the spec.
pub fn write_field(path: impl AsRef<Path>, field: &TrainedField, mut notes: BTreeMap<String, String>) -> Result<()> {
    let Model { pipeline, arena, .. } = &field.model;
    let blocks = &pipeline.layout().blocks;
    let tensors: Vec<_> = blocks.iter().map(|b| (&b.name[..], &b.shape[..], &arena.params[b.range.clone()])).collect();
    let placement = serde_json::to_string(&field.placement())
        .map_err(|e| Error::unsupported("weights", format!("cannot be written as text: {e}")))?;
    notes.insert(PLACEMENT.into(), placement);
    conefield_io::write_weights(path.as_ref(), &tensors, &notes)
}

/// Reads a file written by [`write_field`].
pub fn read_field(path: &Path) -> Result<TrainedField> {
    let place = path.display().to_string();
    let weights = read_weights(path)?;
    let note = |key: &str| {
        let expected = "weights written by \"conefield reconstruct\"";
        weights.notes.get(key).ok_or_else(|| Error::invalid(&place, key, "no such note", expected))
    };
    let loaded = crate::specs::reread(note("spec")?, &format!("{place}: spec.toml"))?;
    let plan = crate::method::plan_without_files(&loaded, &Cpu::new())?;
    let placement: Placement = written::read(&format!("{place}: {PLACEMENT}.json"), note(PLACEMENT)?)?;
    placement.validate(&place)?;
    // The notes imply the size of the network: the tensors must match before memory is allocated for it. A mask reduces
    // the size.
    if let Some(pipeline) = plan.pipeline().filter(|_| placement.masks.is_empty()) {
        weights.check(&place, pipeline.layout(), |_| true)?;
    }
    plan.restore(&placement, &mut |model| {
        weights.load(&place, model.pipeline.layout(), &mut model.arena.params, |_| true).map(drop)
    })
}

/// More steps than any run takes. Up to here, counting is exact in every number type in use.
const MOST_STEPS: u64 = 1 << 48;

/// The checkpoint text with the run's progress; [`HISTORY`] has its history, and the other texts identify the run.
const STANDING: &str = "standing";
const HISTORY: &str = "history";

/// Writes a checkpoint of the run described by `run`, with this history.
pub fn write_checkpoint(
    path: &Path,
    checkpoint: &Checkpoint<'_>,
    run: &BTreeMap<String, String>,
    history: &History,
) -> Result<()> {
    let failed = |e| Error::unsupported("checkpoint", format!("cannot be written as text: {e}"));
    let mut text = run.clone();
    text.insert(STANDING.into(), serde_json::to_string(&checkpoint.standing).map_err(failed)?);
    text.insert(HISTORY.into(), serde_json::to_string(history).map_err(failed)?);
    let tensors: Vec<_> = checkpoint.tensors.iter().map(|(name, shape, values)| (&name[..], *shape, *values)).collect();
    conefield_io::write_checkpoint(path, &tensors, &text)
}

/// An interrupted run.
pub struct Interrupted {
    /// Its state.
    pub resume: Resume,
    /// What its record keeps.
    pub history: History,
}

/// Reads the checkpoint of the run described by `run`; refuses the checkpoint of another run.
pub fn read_checkpoint(path: &Path, run: &BTreeMap<String, String>) -> Result<Interrupted> {
    let place = path.display().to_string();
    if !path.exists() {
        let expected = "an interrupted run with a checkpoint; other runs must start over";
        return Err(Error::invalid(place, "--resume", "no checkpoint", expected));
    }
    let mut file = conefield_io::read_checkpoint(path)?;
    let [standing, history] = [STANDING, HISTORY].map(|name| file.notes.remove(name));
    same_run(&place, &file.notes, run)?;
    let standing: Standing = written::read(&format!("{place}: {STANDING}.json"), &standing.unwrap_or_default())?;
    let history = history.map(|text| written::read(&format!("{place}: {HISTORY}.json"), &text)).transpose()?;
    let Standing { step, recorded, seconds, .. } = standing;
    ensure(step <= MOST_STEPS, &place, "step", step, format!("at most {MOST_STEPS}"))?;
    ensure(recorded <= step, &place, "recorded", recorded, format!("at most {step}, the steps that are done"))?;
    ensure(seconds.is_finite() && seconds >= 0.0, &place, "seconds", seconds, "a number of seconds")?;
    let resume = Resume::new(place, standing, Weights { tensors: file.tensors, ..Weights::default() });
    Ok(Interrupted { resume, history: history.unwrap_or_default() })
}

/// Refuses to resume a run that differs from `now`; `place` names its file.
pub fn same_run(place: &str, then: &BTreeMap<String, String>, now: &BTreeMap<String, String>) -> Result<()> {
    for (key, now) in now {
        let then = then.get(key).map_or("nothing", String::as_str);
        if then != now {
            // For long texts, shows the first line that differs.
            let (a, b) = (then.lines(), now.lines());
            let pair = a.zip(b).find(|(a, b)| a != b).unwrap_or((then, now));
            let expected = format!("{} as in the earlier run; --force starts over", pair.0);
            return Err(Error::invalid(place, format!("--resume: {key}"), pair.1, expected));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phantoms_have_kind_and_size() {
        assert_eq!(volume("phantom:head:16").unwrap().grid.shape, [16; 3]);
        assert_eq!(volume("phantom:random:3:16").unwrap().grid.shape, [16; 3]);
        for (name, want) in [("phantom:hand", "`hand`"), ("phantom:head:x", "voxels"), ("phantom:head:0", "from 8")] {
            let e = volume(name).unwrap_err().to_string();
            assert!(e.contains(want), "{name}: {e}");
        }
    }
}
