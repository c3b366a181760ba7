//! A spec with its plan and memory estimate.

use crate::files;
use crate::memory::{self, Memory};
use conefield_core::backend::Backend;
use conefield_core::input_file::InputFile;
use conefield_core::method::{Context, Plan, StartFile};
use conefield_core::spec::load::Loaded;
use conefield_core::spec::marks::marked;
use conefield_core::{Error, Result};
use std::path::Path;

/// A spec, built, with its memory estimate.
pub struct Planned {
    /// The spec.
    pub loaded: Loaded,
    /// The plan.
    pub plan: Box<dyn Plan>,
    /// The memory estimate.
    pub memory: Memory,
}

/// Builds a spec for `backend`: every stage once. Errors name the line of the spec.
pub fn plan(loaded: &Loaded, backend: &dyn Backend) -> Result<Box<dyn Plan>> {
    let context = Context { weights: &|path| files::read_weights(Path::new(path)), ..Context::new(backend) };
    loaded.spec.method.plan(&context).map_err(|e| loaded.locate(e))
}

/// Builds a spec without reading the weights named in it.
pub fn plan_without_files(loaded: &Loaded, backend: &dyn Backend) -> Result<Box<dyn Plan>> {
    loaded.spec.method.plan(&Context::without_weights(backend)).map_err(|e| loaded.locate(e))
}

/// Reads a spec with overriding settings.
pub type Read<'a> = &'a dyn Fn(&[String]) -> Result<Loaded>;

/// Reads and builds a spec, and refuses one that does not fit into memory, or moves its arrays to the `disk`, which cannot
/// be undone. `run` gives the other memory of the run; `start` is the start file, weights or a volume.
pub fn planned(
    read: Read<'_>,
    sets: &[String],
    start: Option<&Path>,
    backend: &dyn Backend,
    run: &memory::Run,
    disk: bool,
) -> Result<Planned> {
    let mut sets = sets.to_vec();
    if let Some(path) = start {
        if conefield_io::is_volume(path) {
            Memory::of_volumes(&[conefield_io::volume_voxels(path)?]).check()?;
        }
        sets.push(init(&read(&sets)?, path)?);
    }
    let loaded = read(&sets)?;
    let plan = plan(&loaded, backend)?;
    let memory = run.memory(plan.as_ref());
    if !disk && memory.total > memory::limit() {
        return Err(Error::unsupported("memory", format!("needs {}: only the disk holds it", memory.line())));
    }
    memory.check_or(&|available| {
        let mut smaller = smaller_tables(&loaded).into_iter().filter_map(|(bits, set)| {
            let loaded = read(&[&sets[..], &[set]].concat()).ok()?;
            Some((bits, plan_without_files(&loaded, backend).ok()?))
        });
        run.smaller(plan.as_ref(), available, &mut smaller)
    })?;
    Ok(Planned { loaded, plan, memory })
}

/// Settings that reduce the largest tables of an encoder, from the largest below the current size.
fn smaller_tables(loaded: &Loaded) -> Vec<(u32, String)> {
    let sizes = marked(&loaded.tree, &|schema| schema["x-log2-memory"] == true);
    let Some((path, Some(bits))) = sizes.first().map(|(path, bits)| (path, bits.as_u64())) else { return vec![] };
    (10..bits as u32).rev().map(|bits| (bits, format!("{path}={bits}"))).collect()
}

/// The setting that makes the method of `loaded` start from the file `path`, weights or a volume.
pub fn init(loaded: &Loaded, path: &Path) -> Result<String> {
    let place = path.display().to_string();
    let file = InputFile(place.clone());
    let start = if conefield_io::is_volume(path) { StartFile::Volume(file) } else { StartFile::Weights(file) };
    let Some((setting, value)) = loaded.spec.method.start_setting(&start) else {
        let expected = format!("a method that starts from {}; {} does not", start.kind(), loaded.spec.name);
        return Err(Error::invalid(place, "init", start.kind(), expected));
    };
    let value: toml::Value = serde_json::from_value(value)
        .map_err(|e| Error::unsupported("init", format!("the setting cannot be written: {e}")))?;
    Ok(format!("{setting}={value}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::specs;
    use crate::tradeoff::calibrate::{Bench, calibrate};
    use crate::tradeoff::front::{Front, Unknowns};
    use crate::tradeoff::schedule::Budget;
    use crate::tradeoff::speed::pass_s;
    use conefield_backend_cpu::Cpu;
    use conefield_core::method::Job;
    use conefield_core::scan::{Scan, Volume};
    use conefield_projectors::simulate::{PhantomKind, Protocol, phantom_of, simulate};
    use std::time::Instant;

    #[test]
    fn the_shipped_front_loads_and_its_specs_build() {
        let front = Front::shipped().unwrap();
        for point in &front.points {
            let loaded = specs::read(&point.spec, &point.sets).unwrap();
            let plan = plan(&loaded, &Cpu::new()).unwrap();
            assert_eq!(Unknowns::of(plan.as_ref()), point.kind, "{}", point.name);
            assert!(point.accuracy().is_finite() && !point.scores(&front).contains("NaN"));
        }
    }

    #[test]
    fn every_kind_of_solver_is_measured() {
        let (truth, backend) = (phantom_of(PhantomKind::Head, 24), Cpu::new());
        let scan = scan_of(&truth);
        let bench = bench(&scan, &truth, &backend);
        for spec in ["fast", "fdk", "sart", "cgls", "fista-tv", "asd-pocs"] {
            let loaded = specs::read(spec, &[]).unwrap();
            let mut plan = plan(&loaded, &backend).unwrap();
            let costs = calibrate(&bench, plan.as_mut(), 0.05).unwrap();
            let all = [costs.step_s, costs.export_s, costs.score_s];
            assert!(all.iter().all(|s| *s > 0.0 && s.is_finite()) && costs.prepare_s >= 0.0, "{spec}: {costs:?}");
            // Without plots, there is nothing to draw.
            assert_eq!(costs.picture_s > 0.0, cfg!(feature = "plots"), "{spec}: {costs:?}");
        }
    }

    fn scan_of(truth: &Volume) -> Scan {
        simulate(truth, &Protocol::r2(&truth.grid).with_detector([24, 24]).with_views(12)).unwrap()
    }

    fn bench<'a>(scan: &'a Scan, truth: &'a Volume, backend: &'a Cpu) -> Bench<'a> {
        let job = Job { reference: Some(truth), volumes: &files::volume, ..Job::new(scan, backend) };
        Bench { job, cancelled: &|| false }
    }

    /// A front that was measured on a scan of the same size, with a chain of 10 s and FDK.
    #[test]
    fn a_front_of_a_faster_machine_promises_less_here() {
        let (truth, backend) = (phantom_of(PhantomKind::Head, 24), Cpu::new());
        let scan = scan_of(&truth);
        // The fastest of three: other tests run beside it.
        let here = (0..3).map(|_| pass_s(&backend, &|| false).unwrap()).fold(f64::INFINITY, f64::min);
        let dir = tempfile::tempdir().unwrap();
        for (faster, wanted) in [(0.05, "long"), (4.0, "short")] {
            let point = |name: &str, spec: &str, steps: u32, train_s: f64, psnr: u32| {
                format!(
                    "[[points]]\nname = \"{name}\"\nkind = \"voxels\"\nspec = \"{spec}\"\nbudget_s = 20.0\n[[points.runs]]\n\
                     steps = {steps}\ntrain_s = {train_s}\ntotal_s = {train_s}\nbeside_s = 0.01\npsnr = {psnr}\n"
                )
            };
            let text = format!(
                "made = \"test\"\npass_s = {}\n[[scans]]\nname = \"a\"\nviews = 12\ndetector = [24, 24]\nvolume = [24, 24, 24]\n{}{}",
                here / faster,
                point("long", "smooth-tv", 27, 10.0, 30),
                point("short", "fdk", 1, 0.01, 20),
            );
            let file = dir.path().join("front.toml");
            std::fs::write(&file, text).unwrap();
            let front = Front::read(&file).unwrap();
            let build = |spec: &str, sets: &[String]| {
                let loaded = specs::read(spec, sets)?;
                let plan = plan(&loaded, &backend)?;
                Ok(Planned { loaded, plan, memory: Memory::default() })
            };
            let budget = Budget { begin: Instant::now(), seconds: 8.0, spent: 0.0 };
            let (_, schedule) = budget.choose(&bench(&scan, &truth, &backend), &front, build).unwrap();
            assert_eq!(schedule.reason.point.as_deref(), Some(wanted), "{schedule:?}");
        }
    }
}
