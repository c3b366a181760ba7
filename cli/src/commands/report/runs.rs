//! The runs in a report.

use crate::run_folder::RunOnDisk;
use conefield::explain::Explanation;
use conefield::study::pictures::score_last;
use conefield::tradeoff::json::read_json;
use conefield::{method, specs};
use conefield_backend_cpu::Cpu;
use conefield_core::error::ensure;
use conefield_core::words::counted;
use conefield_core::{Result, written};
use conefield_evaluation::report::page::{Notice, Page, PageRun, PageSpread};
use conefield_evaluation::report::text::stem;
use serde::Deserialize;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The runs in `folders`: each is a run, or a comparison or a study with several.
pub fn find(folders: &[PathBuf]) -> Result<Vec<RunOnDisk>> {
    let mut found: Vec<RunOnDisk> = vec![];
    for folder in folders {
        for run in of_folder(folder)? {
            let twice = found.iter().any(|r| same_file::is_same_file(&r.folder, &run).unwrap_or(false));
            ensure(!twice, &run.display().to_string(), "run", "a run that is shown already", "each run once")?;
            found.push(RunOnDisk::read(&run)?);
        }
    }
    Ok(found)
}

fn of_folder(folder: &Path) -> Result<Vec<PathBuf>> {
    #[derive(Deserialize)]
    struct Comparison {
        methods: Vec<Method>,
    }
    #[derive(Deserialize)]
    struct Method {
        name: String,
    }
    std::fs::metadata(folder).map_err(|e| conefield_core::Error::io(folder, e))?;
    let place = folder.display().to_string();
    let table = folder.join("table.json");
    if !table.is_file() {
        let expected = "the folder of a run (spec.toml and metrics.jsonl), or of a comparison or a study (table.json)";
        ensure(RunOnDisk::is(folder), &place, "run", "no run", expected)?;
        return Ok(vec![folder.to_path_buf()]);
    }
    let comparison: Comparison = read_json(&table)?;
    let mut runs = vec![];
    for case in cases(folder)? {
        for method in &comparison.methods {
            // The name must be a plain folder name.
            let plain = Path::new(&method.name).components().count() == 1 && !method.name.starts_with('.');
            ensure(plain, &table.display().to_string(), "name", format!("{:?}", method.name), "the name of a folder")?;
            runs.extend(Some(case.join(&method.name)).filter(|run| RunOnDisk::is(run)));
        }
    }
    ensure(!runs.is_empty(), &place, "runs", "none", "a comparison or a study with at least one run")?;
    Ok(runs)
}

/// The folders that hold a run of each method: a comparison itself, those in `runs` of a study.
fn cases(folder: &Path) -> Result<Vec<PathBuf>> {
    let inner = folder.join("runs");
    if !inner.is_dir() || RunOnDisk::is(&inner) {
        return Ok(vec![folder.to_path_buf()]);
    }
    let failed = |e| conefield_core::Error::io(&inner, e);
    let entries = std::fs::read_dir(&inner).map_err(failed)?.map(|entry| Ok(entry.map_err(failed)?.path()));
    let mut found: Vec<PathBuf> = entries.collect::<Result<_>>()?;
    found.sort();
    Ok(found)
}

/// Means and standard deviations over the seeds of the studies in `folders`.
pub fn spreads(folders: &[PathBuf]) -> Result<Vec<PageSpread>> {
    #[derive(Deserialize)]
    struct Study {
        #[serde(default)]
        summary: Vec<Line>,
    }
    #[derive(Deserialize)]
    struct Line {
        case: String,
        method: String,
        figures: Value,
    }
    let tables = folders.iter().map(|f| f.join("table.json")).filter(|t| t.is_file());
    let studies = tables.map(|t| read_json::<Study>(&t)).collect::<Result<Vec<_>>>()?;
    let lines = studies.into_iter().flat_map(|s| s.summary);
    let spread = |l: Line| PageSpread { name: format!("{}/{}", l.case, l.method), figures: l.figures };
    Ok(lines.map(spread).collect())
}

/// The runs of the page, with unique names.
pub fn page_runs(found: &[RunOnDisk], warnings: &mut Vec<Notice>) -> Vec<PageRun> {
    let names = names(found);
    found
        .iter()
        .zip(names)
        .map(|(run, name)| {
            let notice = |found: String| Notice { found: format!("{name}: {found}"), advice: String::new() };
            warnings.extend((!run.is_complete()).then(|| notice(format!("the run is {}", run.status()))));
            if let Some(n) = run.record.as_ref().and_then(|r| r["rollbacks"].as_u64()).filter(|n| *n > 0) {
                warnings.push(notice(format!(
                    "training diverged and was rolled back {}; each rollback halved the learning rate",
                    counted(n, "time")
                )));
            }
            PageRun {
                folder: run.folder.display().to_string(),
                status: run.status().into(),
                spec: run.spec.clone(),
                plan: plan(run).ok(),
                record: run.record.clone(),
                curves: curves(run),
                name,
                ..PageRun::default()
            }
        })
        .collect()
}

/// The lines of the run's metrics; that of the result has the score of the record.
fn curves(run: &RunOnDisk) -> Vec<Value> {
    let mut lines = run.curves.clone();
    if let Some(record) = &run.record {
        score_last(&mut lines, record);
    }
    lines
}

/// Describes what the spec builds. Fails if its plugins are not loaded.
fn plan(run: &RunOnDisk) -> Result<String> {
    let loaded = specs::reread(&run.spec, &run.folder.join("spec.toml").display().to_string())?;
    let plan = method::plan_without_files(&loaded, &Cpu::new())?;
    Ok(Explanation::new(&loaded, plan.as_ref(), None, None)?.text())
}

/// Names of the specs; if these are ambiguous, of the folders, of the folders in their parents as in a study, or else
/// full paths.
fn names(found: &[RunOnDisk]) -> Vec<String> {
    #[derive(Deserialize)]
    struct Named {
        name: String,
    }
    // An unfinished run has no record yet.
    let own = |run: &RunOnDisk| {
        let named = run.spec_name().map(str::to_owned);
        let named = named.or_else(|| written::read("spec.toml", &run.spec).ok().map(|n: Named| n.name));
        named.unwrap_or_else(|| stem(&run.folder.display().to_string()))
    };
    let whole = |run: &RunOnDisk| run.folder.canonicalize().unwrap_or_default();
    let folder = |run: &RunOnDisk| stem(&whole(run).display().to_string());
    let nested = |run: &RunOnDisk| {
        let parent = whole(run).parent().map(|p| stem(&p.display().to_string()));
        format!("{}/{}", parent.unwrap_or_default(), folder(run))
    };
    let path = |run: &RunOnDisk| run.folder.display().to_string();
    let ways: [&dyn Fn(&RunOnDisk) -> String; 4] = [&own, &folder, &nested, &path];
    let distinct = |names: &Vec<String>| names.iter().collect::<BTreeSet<_>>().len() == names.len();
    let all = ways.into_iter().map(|way| found.iter().map(way).collect::<Vec<_>>());
    let last = all.clone().next_back().unwrap_or_default();
    all.into_iter().find(distinct).unwrap_or(last)
}

/// The title of the page.
pub fn title(page: &Page) -> String {
    let scans: Vec<&str> = page.scans.iter().map(|s| &s.name[..]).collect();
    let runs = match &page.runs[..] {
        [one] => one.name.clone(),
        some if some.len() <= 4 => some.iter().map(|r| &r.name[..]).collect::<Vec<_>>().join(", "),
        many => format!("{} runs", many.len()),
    };
    if scans.is_empty() { runs } else { format!("{}: {runs}", scans.join(", ")) }
}
