//! The result of a search: the front as table, figure and JSON, its specs, and the quality of ranking by held-out
//! views.

use crate::specs;
use crate::study::outcome::Status;
use crate::tradeoff::front::{Front, Point, Reached, Tuned, Unknowns};
use crate::tradeoff::json::to_json;
use crate::tradeoff::levers::Candidate;
use crate::tradeoff::pareto::{Performance, front};
use crate::tradeoff::search::{FILES, FOLDERS, Over, Rung, Search};
use crate::tradeoff::statistics::{mean, spearman};
use crate::tradeoff::trial::Figures;
use conefield_core::spec::load::to_toml;
use conefield_core::words::counted;
use conefield_core::{Error, Result};
use conefield_evaluation::report::text::{bytes, duration, number};
use conefield_evaluation::report::{CurveOptions, Panel, Table, panels_png};
use serde::Serialize;
use serde_json::Value;
use std::fs;
use std::path::Path;

/// The content of `tradeoff.json`.
#[derive(Serialize)]
pub struct TradeoffReport {
    search: Search,
    rungs: Vec<Rung>,
    trials: Vec<Over>,
    /// How well the held-out error ranks methods, if there is a reference.
    ranking: Vec<Ranking>,
    /// Every candidate that ran on all scans, under every budget.
    points: Vec<Mean>,
    /// Names on the overall front, on the front of fields, and on the front of voxel methods.
    front: Vec<String>,
    front_of_fields: Vec<String>,
    front_of_voxels: Vec<String>,
    best: Vec<Best>,
}

/// Spearman's rank correlation of the negative error of held-out views with PSNR: 1 if both order all trials of a
/// budget in the same way.
#[derive(Serialize)]
struct Ranking {
    budget_s: f64,
    scan: String,
    trials: usize,
    spearman: Option<f64>,
}

/// A candidate under a budget: means over the scans, and peak memory.
#[derive(Serialize)]
struct Mean {
    name: String,
    candidate: String,
    kind: Unknowns,
    budget_s: f64,
    steps: f64,
    train_s: f64,
    total_s: f64,
    peak_bytes: Option<u64>,
    psnr: Option<f64>,
    ssim_2d: Option<f64>,
    held_out: Option<f64>,
    #[serde(skip)]
    standing: Performance,
    #[serde(skip)]
    runs: Vec<Figures>,
}

/// The most accurate candidate of a kind under a budget.
#[derive(Serialize)]
struct Best {
    budget_s: f64,
    kind: Unknowns,
    point: String,
}

impl TradeoffReport {
    /// The report on the trials; an error if none has a result.
    pub fn new(search: Search, rungs: Vec<Rung>, trials: Vec<Over>) -> Result<Self> {
        let points = points(&search, &trials);
        if points.is_empty() {
            let why = trials.iter().find_map(|t| t.outcome.error.clone()).unwrap_or_else(|| "there is none".into());
            return Err(Error::unsupported("tradeoff", format!("no trial had a result; the first error: {why}")));
        }
        let of = |kind: Option<Unknowns>| {
            let some: Vec<&Mean> = points.iter().filter(|p| kind.is_none_or(|k| k == p.kind)).collect();
            let all: Vec<Performance> = some.iter().map(|p| p.standing).collect();
            front(&all).into_iter().map(|i| some[i].name.clone()).collect::<Vec<_>>()
        };
        let (all, fields, voxels) = (of(None), of(Some(Unknowns::Field)), of(Some(Unknowns::Voxels)));
        let mut best = vec![];
        for &budget_s in &search.budgets_s {
            for kind in [Unknowns::Field, Unknowns::Voxels] {
                let here = points.iter().filter(|p| p.budget_s == budget_s && p.kind == kind);
                let most = here.max_by(|a, b| a.standing.accuracy.total_cmp(&b.standing.accuracy));
                best.extend(most.map(|p| Best { budget_s, kind, point: p.name.clone() }));
            }
        }
        let ranking = ranking(&search, &trials);
        Ok(Self {
            search,
            rungs,
            trials,
            ranking,
            points,
            front: all,
            front_of_fields: fields,
            front_of_voxels: voxels,
            best,
        })
    }

    /// Writes everything except the trials. The state is written last: while it has no front, `--resume` creates one.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let [state, table, figure, file] = FILES.map(|f| folder.join(f));
        self.write_specs(&folder.join(FOLDERS[0]))?;
        conefield_io::write_text_atomic(&file, &self.front_file()?)?;
        self.draw(&figure)?;
        conefield_io::write_text_atomic(&table, &self.table().markdown())?;
        conefield_io::write_text_atomic(&state, &to_json(self)?)
    }

    /// Text for people.
    pub fn text(&self, folder: &Path) -> String {
        let at = |name: &str| folder.join(name).display().to_string();
        format!(
            "{}\n\nfigure: {}\nspecs: {}\nfront for \"conefield reconstruct --budget TIME --front\": {}",
            self.table().text(),
            at(FILES[2]),
            at(FOLDERS[0]),
            at(FILES[3])
        )
    }

    /// The points that get a spec: those of all fronts, and the best of each budget.
    fn chosen(&self) -> Vec<&Mean> {
        let lists = [&self.front, &self.front_of_fields, &self.front_of_voxels];
        let named =
            |p: &&Mean| lists.iter().any(|l| l.contains(&p.name)) || self.best.iter().any(|b| b.point == p.name);
        self.points.iter().filter(named).collect()
    }

    fn candidate(&self, point: &Mean) -> Result<&Candidate> {
        let found = self.search.candidates.iter().find(|c| c.name == point.candidate);
        found.ok_or_else(|| Error::unsupported("tradeoff", format!("no candidate {}", point.candidate)))
    }

    /// Writes a complete spec per point, which ends after as many steps or passes as the trial.
    fn write_specs(&self, folder: &Path) -> Result<()> {
        match fs::remove_dir_all(folder) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(Error::io(folder, e)),
            _ => fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?,
        }
        for point in self.chosen() {
            let candidate = self.candidate(point)?;
            let base = specs::read(&candidate.spec, &candidate.sets)?;
            let scans: Vec<String> = self.search.scans.iter().map(|s| s.name()).collect();
            let said = format!(
                "{} in {} on {}, on {}.",
                self.reached(point),
                duration(point.total_s),
                scans.join(", "),
                self.search.device
            );
            let mut sets = candidate.sets.clone();
            let steps = (point.steps.round() as u64).max(1);
            sets.extend(end(&base.tree, steps));
            for (key, value) in [("name", &point.name), ("description", &said)] {
                sets.push(format!("{key}={}", toml::Value::String(value.clone())));
            }
            let text = to_toml(&specs::read(&candidate.spec, &sets)?.spec)?;
            conefield_io::write_text_atomic(folder.join(format!("{}.toml", point.name)), &text)?;
        }
        Ok(())
    }

    fn front_file(&self) -> Result<String> {
        let Search { version, device, .. } = &self.search;
        let tuned = self.search.scans.iter().map(|s| Tuned {
            name: s.name(),
            views: s.views,
            detector: s.detector,
            volume: s.volume,
        });
        let mut points = vec![];
        for point in self.chosen() {
            let candidate = self.candidate(point)?;
            let reached = |f: &Figures| Reached {
                steps: f.steps,
                train_s: f.train_s,
                total_s: f.total_s,
                beside_s: None,
                peak_bytes: f.peak_bytes,
                psnr: f.psnr().filter(|p| p.is_finite()),
                ssim_2d: f.score("ssim_2d"),
                held_out: f.held_out,
            };
            points.push(Point {
                name: point.name.clone(),
                kind: point.kind,
                spec: candidate.spec.clone(),
                sets: candidate.sets.clone(),
                budget_s: point.budget_s,
                runs: point.runs.iter().map(reached).collect(),
            });
        }
        let made = format!("conefield {version}, {device}");
        let front = Front { made, pass_s: None, scans: tuned.collect(), points };
        let text = toml::to_string(&front).map_err(|e| Error::unsupported("front.toml", e.to_string()))?;
        Ok(format!("# Written by \"conefield tradeoff\", read by \"conefield reconstruct --budget --front\".\n{text}"))
    }

    fn by_reference(&self) -> bool {
        !self.search.references.is_empty()
    }

    /// The accuracy of a point, in words.
    fn reached(&self, p: &Mean) -> String {
        match p.psnr {
            Some(psnr) => format!("{psnr:.2} dB"),
            None => format!("A held-out error of {:.4}", p.held_out.unwrap_or(f64::NAN)),
        }
    }

    fn table(&self) -> Table {
        let mut heads = vec!["front", "budget"];
        heads.extend(self.by_reference().then_some(["PSNR dB", "ssim_2d"]).into_iter().flatten());
        heads.extend(["held-out error", "steps or passes", "solve time, s", "total time, s", "peak memory"]);
        let mut rows = vec![heads.iter().map(|h| h.to_string()).collect::<Vec<_>>()];
        for name in &self.front {
            let Some(p) = self.points.iter().find(|p| p.name == *name) else { continue };
            let figure = |x: Option<f64>, digits: usize| x.map_or("-".into(), |x| format!("{x:.digits$}"));
            let mut row = vec![p.candidate.clone(), duration(p.budget_s)];
            if self.by_reference() {
                row.extend([figure(p.psnr, 2), figure(p.ssim_2d, 4)]);
            }
            row.extend([figure(p.held_out, 5), number(p.steps.round() as u64)]);
            row.extend([format!("{:.2}", p.train_s), format!("{:.2}", p.total_s)]);
            row.push(p.peak_bytes.map_or("-".into(), bytes));
            rows.push(row);
        }
        Table { rows, notes: self.notes() }
    }

    fn notes(&self) -> Vec<String> {
        let s = &self.search;
        let mut notes: Vec<String> = s.scans.iter().map(|scan| scan.line()).collect();
        if self.by_reference() {
            let names: Vec<String> = s.references.iter().map(|r| r.display().to_string()).collect();
            notes.push(format!(
                "reference {}, peak {}",
                names.join(", "),
                s.peak.map_or("of its values".to_owned(), |p| p.to_string())
            ));
        }
        notes.extend(s.hold_out.as_ref().map(|h| format!("views held out: {h}")));
        notes.push(format!("seed {}, {}, conefield {}", s.seed, s.device, s.version));
        for rung in &self.rungs {
            let short = self.count(rung.budget_s, Status::TooShort);
            let failed = self.count(rung.budget_s, Status::Failed);
            let mut line =
                format!("{}: {} tried, {} advanced", duration(rung.budget_s), rung.tried.len(), rung.kept.len());
            for (n, what) in [(short, "had too little time"), (failed, "failed")] {
                if n > 0 {
                    line += &format!(", {} {what}", counted(n, "trial"));
                }
            }
            notes.push(line);
        }
        for r in &self.ranking {
            let found = r.spearman.map_or("not defined".into(), |x| format!("{x:.2}"));
            notes.push(format!(
                "held-out error against PSNR at {} on {}: Spearman's rank correlation {found} over {} trials",
                duration(r.budget_s),
                r.scan,
                r.trials
            ));
        }
        notes
    }

    fn count(&self, budget: f64, status: Status) -> usize {
        self.trials.iter().filter(|t| t.budget_s == budget && t.outcome.status == status).count()
    }

    /// Draws every trial as a dot and the front as a line: over time on the left, over memory on the right.
    fn draw(&self, path: &Path) -> Result<()> {
        let (label, value): (_, fn(&Mean) -> f64) = match self.by_reference() {
            true => ("PSNR, dB", |p| p.psnr.unwrap_or(f64::NAN)),
            false => ("held-out error", |p| p.held_out.unwrap_or(f64::NAN)),
        };
        let mut bases: Vec<&str> = vec![];
        for c in &self.search.candidates {
            if !bases.contains(&&c.base[..]) {
                bases.push(&c.base);
            }
        }
        let base_of = |p: &Mean| self.candidate(p).map_or("", |c| &c.base[..]).to_owned();
        let series = |x: fn(&Mean) -> f64, alone: fn(Performance) -> Performance| {
            let standings: Vec<Performance> = self.points.iter().map(|p| alone(p.standing)).collect();
            let line = front(&standings).into_iter().map(|i| &self.points[i]);
            let mut line: Vec<(f64, f64)> = line.map(|p| (x(p), value(p))).collect();
            line.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut all = vec![("front".to_owned(), line)];
            for base in &bases {
                let dots = self.points.iter().filter(|p| base_of(p) == *base);
                // A NaN between every two points turns the line into dots.
                let dots: Vec<_> = dots.flat_map(|p| [(x(p), value(p)), (f64::NAN, f64::NAN)]).collect();
                all.push((base.to_string(), dots));
            }
            all
        };
        let over_time = series(|p| p.total_s, |s| Performance { bytes: 1.0, ..s });
        let over_memory = series(|p| p.standing.bytes / f64::from(1 << 20), |s| Performance { seconds: 1.0, ..s });
        // A logarithmic axis of less than a decade would have no labels.
        let options = |series: &[(String, Vec<(f64, f64)>)]| {
            let all = || series.iter().flat_map(|(_, s)| s).map(|p| p.0).filter(|x| x.is_finite());
            let log_x = all().fold(0.0, f64::max) > 10.0 * all().fold(f64::INFINITY, f64::min);
            CurveOptions { log_x, x_margin: 0.04, size: [1000, 750], ..CurveOptions::default() }
        };
        let [of_time, of_memory] = [options(&over_time), options(&over_memory)];
        let names: Vec<String> = self.search.scans.iter().map(|s| s.name()).collect();
        let title = names.join(", ");
        let panel = |x, series, options| Panel { title: &title, labels: [x, label], series, options };
        let time = panel("seconds of the whole run", &over_time[..], &of_time);
        if self.points.iter().any(|p| p.peak_bytes.is_some()) {
            return panels_png(path, &[time, panel("peak memory, MiB", &over_memory[..], &of_memory)]);
        }
        panels_png(path, &[time])
    }
}

/// Candidates that ran on all scans, under each budget.
fn points(search: &Search, trials: &[Over]) -> Vec<Mean> {
    let mut all = vec![];
    for &budget_s in &search.budgets_s {
        for candidate in &search.candidates {
            let here = |scan: usize| {
                trials.iter().find(|t| t.budget_s == budget_s && t.candidate == candidate.name && t.scan == scan)
            };
            let runs: Option<Vec<Figures>> =
                (0..search.scans.len()).map(|s| here(s).and_then(|t| t.outcome.figures.clone())).collect();
            let Some(runs) = runs.filter(|r| !r.is_empty()) else { continue };
            let mean = |of: &dyn Fn(&Figures) -> Option<f64>| mean(runs.iter().map(of));
            let Some(accuracy) = mean(&|f| search.accuracy(f)) else { continue };
            let peak_bytes: Option<u64> = runs.iter().map(|f| f.peak_bytes).max().flatten();
            let total_s = mean(&|f| Some(f.total_s)).unwrap_or(f64::NAN);
            let bytes = peak_bytes.unwrap_or(1) as f64;
            all.push(Mean {
                name: format!("{}_{budget_s}s", candidate.name),
                candidate: candidate.name.clone(),
                kind: candidate.kind,
                budget_s,
                steps: mean(&|f| Some(f.steps as f64)).unwrap_or(0.0),
                train_s: mean(&|f| Some(f.train_s)).unwrap_or(f64::NAN),
                total_s,
                peak_bytes,
                psnr: mean(&Figures::psnr),
                ssim_2d: mean(&|f| f.score("ssim_2d")),
                held_out: mean(&|f| f.held_out),
                standing: Performance { seconds: total_s, bytes, accuracy },
                runs,
            });
        }
    }
    all
}

/// How well held-out views rank the trials of every budget on every scan.
fn ranking(search: &Search, trials: &[Over]) -> Vec<Ranking> {
    let mut all = vec![];
    if search.references.is_empty() || search.hold_out.is_none() {
        return all;
    }
    for &budget_s in &search.budgets_s {
        for (i, scan) in search.scans.iter().enumerate() {
            let here = trials.iter().filter(|t| t.budget_s == budget_s && t.scan == i);
            let pairs: Vec<(f64, f64)> = here
                .filter_map(|t| t.outcome.figures.as_ref())
                .filter_map(|f| Some((-f.held_out?, f.psnr()?)))
                .collect();
            let (errors, psnr): (Vec<f64>, Vec<f64>) = pairs.iter().copied().unzip();
            let spearman = spearman(&errors, &psnr);
            all.push(Ranking { budget_s, scan: scan.name(), trials: pairs.len(), spearman });
        }
    }
    all
}

/// The setting that ends a method after `steps` steps or passes. FDK has no such setting. The steps of a chain include
/// the passes of its later methods.
pub fn end(method: &Value, steps: u64) -> Option<String> {
    if let Some([first, later @ ..]) = method["methods"].as_array().map(|all| &all[..]) {
        let passes: u64 = later.iter().filter_map(|m| m["stop"]["passes"].as_u64()).sum();
        return end(first, steps.saturating_sub(passes).max(1)).map(|set| format!("methods.0.{set}"));
    }
    let keys = [("stop", "stop.passes"), ("training", "training.steps")];
    let key = keys.into_iter().find(|(key, _)| method.get(key).is_some());
    key.map(|(_, key)| format!("{key}={steps}"))
}
