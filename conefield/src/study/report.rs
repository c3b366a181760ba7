//! The results of a study: every run, and means, standard deviations and paired differences over the seeds.

use crate::machine::Machine;
use crate::study::definition::{Cell, Protocol, Source, Study};
use crate::study::layout::{Layout, run_name};
use crate::study::method::Method;
use crate::study::outcome::{COLUMNS, Column, Columns, Outcome};
use crate::study::spread::Spread;
use crate::tradeoff::json::to_json;
use crate::tradeoff::statistics::mean;
use crate::tradeoff::trial::TrialInput;
use conefield_core::Result;
use conefield_core::words::counted;
use conefield_evaluation::report::Table;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;

/// The content of `table.json`.
#[derive(Serialize)]
pub struct StudyReport<'a> {
    version: &'static str,
    /// The commit of the build, if the builder set it.
    commit: Option<&'static str>,
    name: &'a str,
    description: &'a str,
    /// The complete study file.
    study: &'a str,
    seeds: &'a [u64],
    protocol: &'a Protocol,
    baseline: Option<&'a str>,
    methods: &'a [Method],
    cases: Vec<CaseRecord>,
    /// All runs.
    runs: Vec<RunLine>,
    /// Statistics over the seeds for each case and method.
    summary: Vec<Line>,
}

/// The data of a comparison.
#[derive(Serialize)]
pub struct CaseRecord {
    name: String,
    /// The volume, for a simulated case.
    volume: Option<String>,
    /// The noise, for a simulated case, if it differs from the protocol's.
    noise: Option<String>,
    /// The scan, for an existing one.
    scan: Option<String>,
    views: usize,
    detector: [usize; 2],
    shape: [usize; 3],
    reference: Option<String>,
    peak: f64,
    held_out_views: Vec<usize>,
}

impl CaseRecord {
    /// The record of the case `source`, named `name`, with the input of its first scan.
    pub fn new(name: &str, source: &Source, input: &TrialInput) -> Self {
        let (volume, noise, scan, reference) = match source {
            Source::Simulated(s) => {
                (Some(s.written.clone()), s.changes.noise.map(|n| n.to_string()), None, Some("truth".into()))
            }
            Source::Scan { path, reference } => {
                let reference = reference.as_ref().map(|r| r.display().to_string());
                (None, None, Some(path.display().to_string()), reference)
            }
        };
        Self {
            name: name.into(),
            volume,
            noise,
            scan,
            views: input.scan.views,
            detector: input.scan.detector,
            shape: input.scan.volume,
            reference,
            peak: input.peak,
            held_out_views: input.held.clone(),
        }
    }

    fn line(&self) -> String {
        let (views, [rows, columns], [x, y, z]) = (counted(self.views, "view"), self.detector, self.shape);
        let from = self.volume.as_ref().or(self.scan.as_ref()).map_or("", |s| s);
        let reference =
            self.reference.as_ref().map_or(String::new(), |r| format!("; reference {r}, peak {}", self.peak));
        let noise = self.noise.as_ref().map_or(String::new(), |n| format!("; noise {n}"));
        format!("{from}: {views} of {rows} x {columns} pixels, {x} x {y} x {z} voxels{noise}{reference}")
    }
}

/// A run and its outcome.
#[derive(Serialize)]
struct RunLine {
    case: String,
    seed: u64,
    method: String,
    run: String,
    /// The machine of the run.
    machine: Option<Machine>,
    /// The backend, with the instruction set or device.
    backend: Option<String>,
    #[serde(flatten)]
    outcome: Outcome,
}

impl RunLine {
    fn name(&self) -> String {
        run_name(&self.case, self.seed, &self.method)
    }

    /// The machine, and its GPU if that has computed.
    fn computed_on(&self) -> Option<String> {
        let machine = self.machine.as_ref()?.line();
        let gpu = self.backend.as_ref().filter(|b| !b.starts_with("cpu"));
        Some(gpu.map_or(machine.clone(), |gpu| format!("{machine}, {gpu}")))
    }
}

/// A case and a method, over the seeds; the case [`ALL`] is the mean over all cases.
#[derive(Serialize)]
struct Line {
    case: String,
    method: String,
    done: usize,
    failed: usize,
    /// Figures, by their names in `record.json`.
    figures: BTreeMap<&'static str, Spread>,
    /// Differences of the same figures: the method's minus the baseline's on the same scan with the same seed.
    difference: Option<BTreeMap<&'static str, Spread>>,
}

/// Name of the mean over all cases.
const ALL: &str = "all";

impl<'a> StudyReport<'a> {
    /// The report on the runs in `layout`, which have all ended; `outcomes` are their outcomes.
    pub fn new(study: &'a Study, layout: &Layout<'_>, cases: Vec<CaseRecord>, outcomes: Vec<(Cell, Outcome)>) -> Self {
        let summary = Summary { study, outcomes: &outcomes }.lines();
        let line = |(cell, outcome): (Cell, Outcome)| {
            let (case, method) = (study.cases[cell.case].name.clone(), study.methods[cell.method].name.clone());
            let run = layout.run(&study.run_name(&cell)).display().to_string();
            let figures = outcome.figures.as_ref();
            let machine = figures.and_then(|f| f.machine.clone());
            let backend = figures.and_then(|f| Some(f.backend.as_ref()?.backend.clone()));
            RunLine { case, seed: cell.seed, method, run, machine, backend, outcome }
        };
        Self {
            version: env!("CARGO_PKG_VERSION"),
            commit: option_env!("CONEFIELD_COMMIT"),
            name: &study.name,
            description: &study.description,
            study: &study.text,
            seeds: &study.seeds,
            protocol: &study.protocol,
            baseline: study.baseline.map(|b| &study.methods[b].name[..]),
            methods: &study.methods,
            cases,
            runs: outcomes.into_iter().map(line).collect(),
            summary,
        }
    }

    /// Writes both tables.
    pub fn write(&self, folder: &Path) -> Result<()> {
        conefield_io::write_text_atomic(folder.join(crate::study::layout::TABLE), &self.markdown())?;
        conefield_io::write_text_atomic(folder.join(crate::study::layout::RECORD), &to_json(self)?)
    }

    /// The errors of failed runs, one line each.
    pub fn failures(&self) -> Vec<String> {
        let failed = self.runs.iter().filter_map(|r| Some((r, r.outcome.error.as_ref()?)));
        failed.map(|(r, e)| format!("{} failed: {e}", r.name())).collect()
    }

    /// Text for a terminal: means and failures; `shown` writes a table.
    pub fn text(&self, shown: &dyn Fn(&Table) -> String) -> String {
        let mut parts = vec![self.line()];
        parts.extend(self.tables().into_iter().map(|(case, table)| format!("{case}\n{}", shown(&table))));
        parts.extend(Some(self.failures().join("\n")).filter(|f| !f.is_empty()));
        parts.join("\n\n")
    }

    /// Markdown: means with pictures, then every run.
    fn markdown(&self) -> String {
        let mut text = format!("# {}\n\n", self.name);
        if !self.description.is_empty() {
            text += &format!("{}\n\n", self.description);
        }
        text += &format!("{}\n", self.line());
        for (case, table) in self.tables() {
            text += &format!("\n## {case}\n\n");
            if let Some(record) = self.cases.iter().find(|c| c.name == case) {
                text += &format!("{}\n\n", record.line());
            }
            text += &table.markdown();
        }
        text + &format!("\n## Every run\n\n{}", self.every_run().markdown())
    }

    /// The protocol in one sentence.
    fn line(&self) -> String {
        let seeds: Vec<String> = self.seeds.iter().map(u64::to_string).collect();
        let mut words = self.protocol.words();
        words.push(format!("seeds {}", seeds.join(", ")));
        let mut machines: Vec<String> = vec![];
        for machine in self.runs.iter().filter_map(RunLine::computed_on) {
            if !machines.contains(&machine) {
                machines.push(machine);
            }
        }
        words.extend(machines.iter().cloned());
        let commit = self.commit.map_or(String::new(), |c| format!(" ({c})"));
        words.push(format!("conefield {}{commit}", self.version));
        let mut line = format!("Mean ± standard deviation over the seeds; {}.", words.join("; "));
        if machines.len() > 1 {
            line += " The runs used several machines: their times are not comparable.";
        }
        line
    }

    /// One table per case, and one for their mean if there are several.
    fn tables(&self) -> Vec<(String, Table)> {
        let mut names: Vec<&str> = self.cases.iter().map(|c| &c.name[..]).collect();
        if names.len() > 1 {
            names.push(ALL);
        }
        names.into_iter().map(|n| (n.to_owned(), self.table(n))).collect()
    }

    fn table(&self, case: &str) -> Table {
        let lines: Vec<&Line> = self.summary.iter().filter(|l| l.case == case).collect();
        let any = |key: &str| lines.iter().any(|l| l.figures.contains_key(key));
        let scores = any("psnr");
        // Omits figures that no method has.
        let mut columns = Columns::of(scores, any("held_out")).0;
        columns.retain(|c| any(c.key));
        let against = self.baseline;
        let compared = columns.iter().filter(|c| match c.key {
            "psnr" | "ssim_2d" | "total_s" => true,
            key => key == "held_out" && !scores,
        });
        let compared: Vec<&Column> = compared.copied().filter(|_| against.is_some()).collect();
        let mut heads = vec!["method".to_owned(), "runs".into()];
        heads.extend(columns.iter().map(|c| c.head.to_owned()));
        heads.extend(compared.iter().map(|c| format!("{} − {}'s", c.head, against.unwrap_or_default())));
        let mut rows = vec![heads];
        for line in lines {
            let runs = if line.failed == 0 {
                line.done.to_string()
            } else {
                format!("{} of {}", line.done, line.done + line.failed)
            };
            let mut row = vec![line.method.clone(), runs];
            let cell = |s: Option<String>| s.unwrap_or_else(|| "-".into());
            row.extend(columns.iter().map(|c| {
                // Counts of steps and bytes are whole numbers.
                let whole = ["steps", "peak_bytes"].contains(&c.key);
                let shown = |x: &Spread| if whole { (c.shown)(x.mean) } else { x.shown(c.shown) };
                cell(line.figures.get(c.key).map(shown))
            }));
            let difference = |c: &Column| line.difference.as_ref().and_then(|d| d.get(c.key));
            row.extend(compared.iter().map(|c| cell(difference(c).map(|x| x.signed(c.shown)))));
            rows.push(row);
        }
        Table { rows, notes: vec![] }
    }

    fn every_run(&self) -> Table {
        let figures = || self.runs.iter().filter_map(|r| r.outcome.figures.as_ref());
        let columns = Columns::of(figures().any(|f| f.scores.is_some()), figures().any(|f| f.held_out.is_some()));
        let mut rows = vec![columns.heads("run")];
        rows.extend(self.runs.iter().map(|r| columns.cells(&r.name(), &r.outcome)));
        Table { rows, notes: self.failures() }
    }
}

/// Summarizes the runs of a study.
struct Summary<'a> {
    study: &'a Study,
    outcomes: &'a [(Cell, Outcome)],
}

impl Summary<'_> {
    fn lines(&self) -> Vec<Line> {
        let cases = (0..self.study.cases.len()).map(Some);
        // For a single case the mean is that case.
        let all = (self.study.cases.len() > 1).then_some(None);
        let lines = cases.chain(all).flat_map(|case| (0..self.study.methods.len()).map(move |method| (case, method)));
        lines.map(|(case, method)| self.line(case, method)).collect()
    }

    fn line(&self, case: Option<usize>, method: usize) -> Line {
        let here = |c: &Cell| c.method == method && case.is_none_or(|case| case == c.case);
        let runs: Vec<&Outcome> = self.outcomes.iter().filter(|(c, _)| here(c)).map(|(_, o)| o).collect();
        let done = runs.iter().filter(|o| o.figures.is_some()).count();
        let values = |method: usize, column: &Column| self.values(case, method, column);
        let spread = |of: &dyn Fn(&Column) -> Vec<f64>| {
            COLUMNS.iter().filter_map(|column| Some((column.key, Spread::of(&of(column))?))).collect()
        };
        let difference = self.study.baseline.filter(|b| *b != method).map(|baseline| {
            spread(&|column| {
                let pairs = values(method, column).into_iter().zip(values(baseline, column));
                // If both results equal the reference, there is no difference.
                pairs.filter_map(|(a, b)| Some(a? - b?)).filter(|d| !d.is_nan()).collect()
            })
        });
        Line {
            case: case.map_or(ALL.into(), |c| self.study.cases[c].name.clone()),
            method: self.study.methods[method].name.clone(),
            done,
            failed: runs.len() - done,
            figures: spread(&|column| values(method, column).into_iter().flatten().collect()),
            difference,
        }
    }

    /// A figure for every seed: of one case, or its mean over all cases if none is missing.
    fn values(&self, case: Option<usize>, method: usize, column: &Column) -> Vec<Option<f64>> {
        let of = |case: usize, seed: u64| {
            let cell = Cell { case, seed, method };
            let outcome = self.outcomes.iter().find(|(c, _)| *c == cell)?;
            outcome.1.figures.as_ref().and_then(column.of)
        };
        let seeds = self.study.seeds.iter();
        match case {
            Some(case) => seeds.map(|seed| of(case, *seed)).collect(),
            None => seeds.map(|seed| mean((0..self.study.cases.len()).map(|case| of(case, *seed)))).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::study::outcome::Status;
    use crate::tradeoff::trial::Figures;
    use serde_json::json;

    fn study(text: &str) -> Study {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("s.toml");
        std::fs::write(&path, text).unwrap();
        Study::read(&path).unwrap()
    }

    fn reached(psnr: f64, total_s: f64) -> Outcome {
        let scores = json!({ "psnr": psnr, "ssim_2d": psnr / 100.0, "ssim_3d": null, "ssim_skimage": null });
        let figures = Figures { total_s, scores: Some(scores), ..Figures::default() };
        Outcome { status: Status::Done, error: None, figures: Some(figures) }
    }

    #[test]
    fn a_gpu_is_named_beside_its_machine() {
        let study = study("volumes = ['phantom:head:16']\nspecs = ['fdk']\n");
        let cell = study.cells()[0];
        for (backend, named) in [("cpu, avx2, 2 threads", false), ("wgpu, H200 (Vulkan)", true)] {
            let record = json!({ "machine": {}, "backend": { "backend": backend }, "steps": 1, "train_s": 1, "export_s": 0,
                "total_s": 1, "threads": 2, "parameters": 0, "samples": 0 });
            let figures = Some(serde_json::from_value(record).unwrap());
            let outcome = Outcome { status: Status::Done, error: None, figures };
            let report = StudyReport::new(&study, &Layout(Path::new("out")), vec![], vec![(cell, outcome)]);
            assert_eq!(report.line().contains(backend), named, "{}", report.line());
        }
    }

    #[test]
    fn means_spreads_and_pairs_are_as_by_hand() {
        let study = study(
            "volumes = ['phantom:head:16', 'phantom:abdomen:16']\nspecs = ['fdk', 'sirt']\nseeds = [1, 2, 3]\nbaseline = 'fdk'\n",
        );
        // For every seed sirt is better by 1, 2 and 3 dB on the head and by 5 dB on the abdomen, where one run fails.
        let psnr = |c: &Cell| match (c.case, c.method) {
            (0, 0) => 20.0 + 10.0 * c.seed as f64,
            (0, _) => 20.0 + 11.0 * c.seed as f64,
            (_, 0) => 30.0,
            _ => 35.0,
        };
        let failed = Cell { case: 1, seed: 3, method: 1 };
        let all = study
            .cells()
            .into_iter()
            .map(|c| (c, if c == failed { Outcome::failed("no memory".into()) } else { reached(psnr(&c), 2.0) }));
        let outcomes: Vec<_> = all.collect();
        let lines = Summary { study: &study, outcomes: &outcomes }.lines();
        let line = |case: &str, method: &str| lines.iter().find(|l| l.case == case && l.method == method).unwrap();
        assert_eq!(lines.len(), 6);
        let head = line("head-16", "sirt");
        let of = |mean, sd, n| Spread { mean, sd: Some(sd), n };
        assert_eq!(head.figures["psnr"], of(42.0, 11.0, 3));
        // The paired differences spread far less than the seeds.
        assert_eq!(head.difference.as_ref().unwrap()["psnr"], of(2.0, 1.0, 3));
        assert!(line("head-16", "fdk").difference.is_none() && !head.figures.contains_key("held_out"));
        let abdomen = line("abdomen-16", "sirt");
        assert_eq!((abdomen.done, abdomen.failed), (2, 1));
        assert_eq!(abdomen.difference.as_ref().unwrap()["psnr"], of(5.0, 0.0, 2));
        // Over all cases: the mean of both, for the seeds that both have.
        let all = line("all", "sirt");
        assert_eq!(all.difference.as_ref().unwrap()["psnr"], of(3.25, 0.125f64.sqrt(), 2));
        assert_eq!((all.done, all.failed), (5, 1));
    }
}
