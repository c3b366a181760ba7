//! A study file in TOML with volumes or scans, methods and seeds.
//!
//! ```toml
//! name = "pairs"
//! volumes = ["phantom:head:64", { volume = "chest.nii.gz", name = "chest" }]
//! specs = ["fdk", { spec = "fast", name = "wide", set = ["field.width=64"] }]
//! seeds = [0, 1, 2]
//! views = [25, 50]
//! baseline = "fdk"
//!
//! [simulate]
//! detector = "128x128"
//! noise = "tigre:1e4,10"
//!
//! [protocol]
//! seconds = "60s"
//! ```
//!
//! Paths are relative to the file. This module validates everything: keys, values, specs, volumes and the geometry of
//! simulated scans.

use crate::parse::{self, AnglesOption};
use crate::simulation::Changes;
use crate::study::layout::run_name;
use crate::study::method::{self, Method};
use crate::study::simulation::Simulation;
pub use crate::study::written::Protocol;
use crate::study::written::{Entry, Written, WrittenScan, WrittenSimulation, WrittenSpec, WrittenVolume};
use conefield_core::backend::Backend;
use conefield_core::error::ensure;
use conefield_core::{Error, Result, written};
use conefield_evaluation::report::text::stem;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use toml::Spanned;

/// Longest study file, in bytes.
const LONGEST: u64 = 1 << 20;
/// More runs than anyone waits for: a typo.
const MOST_CELLS: usize = 100_000;

/// The JSON Schema of a study file.
pub fn schema() -> Value {
    schemars::schema_for!(Written).to_value()
}

/// A validated study.
pub struct Study {
    /// Path of its file, as given.
    pub path: PathBuf,
    /// Content of its file.
    pub text: String,
    /// Its name.
    pub name: String,
    /// Its purpose.
    pub description: String,
    /// Scans, and volumes with a number of views, in the table's order.
    pub cases: Vec<Case>,
    /// The methods, in the table's order.
    pub methods: Vec<Method>,
    /// Every case and method runs with each seed.
    pub seeds: Vec<u64>,
    /// Options of all runs.
    pub protocol: Protocol,
    /// The method with which the others are compared.
    pub baseline: Option<usize>,
}

/// Data for a comparison of methods.
pub struct Case {
    /// Its name, also the prefix of its folders.
    pub name: String,
    /// Source of its scans.
    pub source: Source,
    /// Values shown as black and white in pictures.
    pub window: Option<[f32; 2]>,
}

/// Source of a case's scans.
pub enum Source {
    /// A volume, with a new simulated scan for each seed.
    Simulated(Box<Simulation>),
    /// An existing scan.
    Scan {
        /// The file or folder.
        path: PathBuf,
        /// The reference volume.
        reference: Option<PathBuf>,
    },
}

/// A planned run: indices of a case and a method, and a seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cell {
    /// Index in [`Study::cases`].
    pub case: usize,
    /// Seed of the noise and of the method.
    pub seed: u64,
    /// Index in [`Study::methods`].
    pub method: usize,
}

impl Study {
    /// Reads and validates the study in the file `path`. Its specs are built for the default backend, or for the
    /// file's.
    pub fn read(path: &Path) -> Result<Self> {
        let text = conefield_core::files::read_text(path, LONGEST)?;
        let written: Written = written::read(&path.display().to_string(), &text)?;
        let folder = std::path::absolute(path).map_err(|e| Error::io(path, e))?;
        let folder = folder.parent().unwrap_or(Path::new("")).to_path_buf();
        Reading { path, text: &text, folder }.study(written)
    }

    /// All runs, scan by scan.
    pub fn cells(&self) -> Vec<Cell> {
        let mut cells = vec![];
        for case in 0..self.cases.len() {
            for &seed in &self.seeds {
                cells.extend((0..self.methods.len()).map(|method| Cell { case, seed, method }));
            }
        }
        cells
    }

    /// The name of a run, CASE-seedS/METHOD, which is also its path.
    pub fn run_name(&self, cell: &Cell) -> String {
        run_name(&self.cases[cell.case].name, cell.seed, &self.methods[cell.method].name)
    }

    /// Input files and folders of the study, without its specs.
    pub fn inputs(&self) -> Vec<PathBuf> {
        let mut all = vec![self.path.clone()];
        for case in &self.cases {
            match &case.source {
                Source::Simulated(s) => all.extend(s.inputs()),
                Source::Scan { path, reference } => {
                    all.extend([Some(path), reference.as_ref()].into_iter().flatten().cloned())
                }
            }
        }
        all.extend(self.methods.iter().flat_map(|m| m.init.iter().map(PathBuf::from)));
        all
    }
}

/// A study file during parsing.
struct Reading<'a> {
    path: &'a Path,
    text: &'a str,
    /// The folder to which its paths are relative.
    folder: PathBuf,
}

impl Reading<'_> {
    fn study(&self, written: Written) -> Result<Study> {
        let Written { name, description, volumes, scans, specs, seeds, views, baseline, window, simulate, protocol } =
            written;
        let place = self.path.display().to_string();
        let seeds = self.distinct("seeds", seeds, vec![0])?;
        let (protocol, at) = match protocol {
            Some(p) => (p.get_ref().clone(), self.at(&p)),
            None => (Protocol::default(), place.clone()),
        };
        let beside = protocol.steps.is_some() || protocol.seconds.is_some() || protocol.at_most.is_some();
        let expected = "budget, or some of steps, seconds and at_most";
        ensure(protocol.budget.is_none() || !beside, &at, "budget", "another end beside it", expected)?;
        let simulated = !volumes.is_empty();
        let written =
            [("views", views.as_ref().map(|v| self.at(v))), ("simulate", simulate.as_ref().map(|s| self.at(s)))];
        if let Some((key, Some(at))) = written.into_iter().find(|(_, at)| at.is_some() && !simulated) {
            return Err(Error::invalid(at, key, "no volumes, which alone are simulated", "volumes beside it"));
        }
        let simulate = simulate.map(Spanned::into_inner).unwrap_or_default();
        ensure(simulated || !scans.is_empty(), &place, "volumes", "neither volumes nor scans", "at least one of them")?;
        let reference = protocol.reference.as_deref();
        if let Some(r) = reference.filter(|r| scans.is_empty() && *r != "truth") {
            let expected = "scans beside it: what is simulated is compared with its truth";
            return Err(Error::invalid(at, "reference", format!("{r:?} and no scans"), expected));
        }
        ensure(!specs.is_empty(), &place, "specs", "none", "at least one")?;
        let window = window.map_or(Ok(None), |w| window_at(&self.at(&w), Some(w.into_inner())))?;
        let views: Vec<Option<usize>> = match views {
            Some(v) => self.distinct("views", Some(v), vec![])?.into_iter().map(|n| Some(n.get())).collect(),
            None => vec![None],
        };

        let mut cases: Vec<Case> = vec![];
        for entry in &volumes {
            let (at, Entry(volume)) = (self.at(entry), entry.get_ref());
            let name = named(&at, volume.name.as_deref(), &volume_name(&volume.volume))?;
            let window = window_at(&at, volume.window)?.or(window);
            for &views in &views {
                let name = views.map_or(name.clone(), |n| format!("{name}-{n}views"));
                let simulation = self.simulation(&at, volume, &simulate, views, &protocol)?;
                let source = Source::Simulated(Box::new(simulation));
                add(&mut cases, &at, Case { name, source, window })?;
            }
        }
        for entry in &scans {
            let (at, Entry(scan)) = (self.at(entry), entry.get_ref());
            let name = named(&at, scan.name.as_deref(), &stem(&scan.scan))?;
            let window = window_at(&at, scan.window)?.or(window);
            let source = self.scan(&at, scan, reference)?;
            add(&mut cases, &at, Case { name, source, window })?;
        }
        let backend = protocol.backend.clone().unwrap_or_default().open_for_run(protocol.budget)?;
        let mut methods: Vec<Method> = vec![];
        for entry in &specs {
            let (at, Entry(spec)) = (self.at(entry), entry.get_ref());
            let method = self.method(&at, spec, &protocol, backend.as_ref())?;
            method.differs(&methods).map_err(|e| placed(&at, "specs", e))?;
            methods.push(method);
        }
        let names: Vec<&str> = methods.iter().map(|m| &m.name[..]).collect();
        let index = |b: Spanned<String>| {
            let expected = || format!("the name of a method: one of {}", names.join(", "));
            let wrong = || Error::invalid(self.at(&b), "baseline", format!("{:?}", b.get_ref()), expected());
            names.iter().position(|n| n == b.get_ref()).ok_or_else(wrong)
        };
        let baseline = baseline.map(index).transpose()?;
        let count = cases.len().saturating_mul(seeds.len()).saturating_mul(methods.len());
        ensure(count <= MOST_CELLS, &place, "study", format!("{count} runs"), format!("at most {MOST_CELLS}"))?;
        let name = name.unwrap_or_else(|| stem(&place));
        let (path, text) = (self.path.to_path_buf(), self.text.to_owned());
        Ok(Study { path, text, name, description, cases, methods, seeds, protocol, baseline })
    }

    fn simulation(
        &self,
        at: &str,
        volume: &WrittenVolume,
        simulate: &WrittenSimulation,
        views: Option<usize>,
        protocol: &Protocol,
    ) -> Result<Simulation> {
        let values = match &volume.values {
            Some(text) => parse::values(text).map_err(|e| {
                let expected = e.strip_prefix("expected ").unwrap_or(&e);
                Error::invalid(at, "values", format!("{text:?}"), expected)
            })?,
            None => parse::Values::AsIs,
        };
        let phantom = volume.volume.starts_with("phantom:");
        let simulation = Simulation {
            written: volume.volume.clone(),
            volume: if phantom { volume.volume.clone() } else { self.beside(&volume.volume) },
            values,
            values_written: volume.values.clone().unwrap_or_else(|| "as-is".into()),
            downsample: volume.downsample.map_or(1, |n| n.get().into()),
            protocol: match simulate.protocol.as_deref() {
                None | Some("r2") => "r2".into(),
                Some(file) => self.beside(file),
            },
            changes: Changes {
                views,
                detector: simulate.detector,
                offset: simulate.offset,
                angles: simulate.angles.clone().map(|a| match a {
                    AnglesOption::File(path) => AnglesOption::File(self.folder.join(path)),
                    even => even,
                }),
                noise: simulate.noise,
                seed: None,
            },
            preparation: OnceLock::new(),
        };
        simulation.check(protocol.hold_out.as_ref()).map_err(|e| placed(at, "volumes", e))?;
        Ok(simulation)
    }

    fn scan(&self, at: &str, scan: &WrittenScan, reference: Option<&str>) -> Result<Source> {
        let path = self.folder.join(&scan.scan);
        ensure(path.exists(), at, "scans", format!("{}, which is not there", path.display()), "a scan")?;
        let reference = scan.reference.as_deref().or(reference).map(|r| match r {
            "truth" => PathBuf::from(r),
            file => self.folder.join(file),
        });
        Ok(Source::Scan { path, reference })
    }

    fn method(&self, at: &str, spec: &WrittenSpec, protocol: &Protocol, backend: &dyn Backend) -> Result<Method> {
        let beside = self.folder.join(&spec.spec);
        // A name that is neither built in nor a file is reported as written, with the nearest valid one.
        let known = crate::specs::names().contains(&&spec.spec[..]);
        let what = if known || !beside.is_file() { spec.spec.clone() } else { self.beside(&spec.spec) };
        let sets = [&protocol.set[..], &spec.set].concat();
        let init = spec.init.as_ref().map(|i| self.beside(i));
        Method::read(&what, spec.name.as_deref(), &sets, init.as_deref(), backend).map_err(|e| placed(at, "specs", e))
    }

    /// A list without duplicates; `default` if it is missing.
    fn distinct<T: Ord + Clone + std::fmt::Display>(
        &self,
        key: &str,
        list: Option<Spanned<Vec<T>>>,
        default: Vec<T>,
    ) -> Result<Vec<T>> {
        let Some(list) = list else { return Ok(default) };
        let mut seen = BTreeSet::new();
        let twice = list.get_ref().iter().find(|x| !seen.insert((*x).clone()));
        if let Some(x) = twice {
            return Err(Error::invalid(self.at(&list), key, format!("{x} twice"), "each once"));
        }
        ensure(!seen.is_empty(), &self.at(&list), key, "none", "at least one")?;
        Ok(list.into_inner())
    }

    /// A path in the file, resolved relative to the study's folder.
    fn beside(&self, path: &str) -> String {
        self.folder.join(path).display().to_string()
    }

    /// The file, line and column at which something begins.
    fn at<T>(&self, what: &Spanned<T>) -> String {
        written::location(&self.path.display().to_string(), self.text, what.span().start)
    }
}

/// The name of a case, which is the prefix of folders, as `given` at a place of the file.
fn named(at: &str, given: Option<&str>, own: &str) -> Result<String> {
    let name = given.unwrap_or(own);
    method::check_name(name, at, "name")?;
    Ok(name.to_owned())
}

/// Adds a case. Refuses a name that is taken, or that the table needs.
fn add(cases: &mut Vec<Case>, at: &str, case: Case) -> Result<()> {
    let free = cases.iter().all(|c| c.name.to_lowercase() != case.name.to_lowercase());
    let found = format!("{:?}, the name of another one", case.name);
    ensure(free, at, "name", found, "a unique name, for table and folders")?;
    let other = case.name.to_lowercase() != "all";
    ensure(other, at, "name", &case.name, "another name: the table calls the mean of all cases so")?;
    cases.push(case);
    Ok(())
}

/// The window of an entry at a place of the file. Refuses one that is not in order.
fn window_at(at: &str, window: Option<[f32; 2]>) -> Result<Option<[f32; 2]>> {
    if let Some(both @ [low, high]) = window {
        let fits = low.is_finite() && high.is_finite() && low < high;
        ensure(fits, at, "window", format!("{both:?}"), "two finite numbers, the first below the second")?;
    }
    Ok(window)
}

/// The same error, with the line of its entry.
fn placed(at: &str, key: &str, error: Error) -> Error {
    Error::unsupported(format!("{at}: {key}"), error.to_string())
}

/// The name of a volume: phantom:head:64 becomes head-64, and a file loses its extensions.
fn volume_name(volume: &str) -> String {
    match volume.strip_prefix("phantom:") {
        Some(phantom) => phantom.replace(':', "-"),
        None => {
            let name = stem(volume);
            name.strip_suffix(".nii").unwrap_or(&name).to_owned()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn read(text: &str) -> Result<Study> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("s.toml");
        fs::write(&path, text).unwrap();
        Study::read(&path)
    }

    const TINY: &str =
        "volumes = ['phantom:head:16']\nspecs = ['fdk', { spec = 'sirt', name = 'SIRT', set = ['stop.passes=3'] }]\n";

    #[test]
    fn cells_are_all_combinations_scan_by_scan() {
        let study = read(&format!("views = [4, 6]\nseeds = [3, 5]\nbaseline = 'SIRT'\n{TINY}")).unwrap();
        assert_eq!(study.cases.iter().map(|c| &c.name[..]).collect::<Vec<_>>(), ["head-16-4views", "head-16-6views"]);
        assert_eq!((study.baseline, &study.name[..]), (Some(1), "s"));
        let cells = study.cells();
        assert_eq!(cells.len(), 8);
        assert_eq!(cells[0], Cell { case: 0, seed: 3, method: 0 });
        assert_eq!(cells[3], Cell { case: 0, seed: 5, method: 1 });
        assert_eq!(cells[4], Cell { case: 1, seed: 3, method: 0 });
    }

    /// The tests of bad inputs have others.
    #[test]
    fn mistakes_are_reported_with_their_line() {
        // Lines at the top, then the two lines of TINY, then tables.
        for (top, tables, want) in [
            (
                "",
                "[[scans]]\nscan = 'a'\nreferense = 'truth'\n",
                ":5:1: scans.0.referense: found a key that is not known",
            ),
            ("", "[[scans]]\nscan = 'a'\n", ":3:1: scans: found"),
            ("views = []\n", "", ":1:9: views: found none"),
            ("views = [0]\n", "", ":1:10: views.0: found"),
            ("window = [1.0, 0.5]\n", "", ":1:10: window: found [1.0, 0.5]"),
            ("", "[simulate]\nnoise = 'salt'\n", ":4:9: simulate.noise: found \"salt\", expected"),
            ("", "[simulate]\ndetector = 5\n", ":4:12: simulate.detector: found \"5\", expected ROWSxCOLS"),
            ("", "[simulate]\nprotocol = 'none.toml'\n", ":1:12: volumes: "),
            ("", "[protocol]\nhold_out = '99'\n", ":1:12: volumes: "),
            ("", "[protocol]\nreference = 'a.nii'\n", "found \"a.nii\" and no scans"),
        ] {
            let whole = format!("{top}{TINY}{tables}");
            let e = read(&whole).err().unwrap_or_else(|| panic!("{whole}")).to_string();
            assert!(e.contains(want), "{whole}\n{e}\n{want}");
        }
        for (text, want) in [
            ("volumes = ['phantom:head:16']\nspecs = []\n", "specs: found none"),
            ("volumes = ['phantom:hand']\nspecs = ['fdk']\n", ":1:12: volumes: "),
            ("volumes = ['phantom:head:16', 'phantom:head:16']\nspecs = ['fdk']\n", ":1:31: name: found \"head-16\""),
            ("volumes = ['phantom:head:16']\nspecs = ['fdk', 'fdk']\n", ":2:17: specs: fdk (shipped): name: "),
        ] {
            let e = read(text).err().unwrap_or_else(|| panic!("{text}")).to_string();
            assert!(e.contains(want), "{text}\n{e}\n{want}");
        }
    }
}
