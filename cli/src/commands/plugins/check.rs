//! `conefield plugins check`

use crate::{out, program};
use clap::Args;
use conefield::{parse, plugins};
use conefield_backend_wgpu::Wgpu;
use conefield_conformance::{Options, Report, WIDTHS, With, check_type, tried};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::registry::Kind;
use conefield_core::runner::Runner;
use conefield_plugins::spec::with_defaults;
use conefield_plugins::{Library, Place};
use serde::Serialize;
use serde_json::Value;
use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::sync::OnceLock;
use std::time::Instant;

/// Run the conformance kit on every stage of a plugin: finite differences, shapes, extremes, independence of tiles and
/// threads, guard zones, save and load. The plugin runs in a separate process, so that crashes are reported.
#[derive(Args)]
pub struct Check {
    /// The plugin's library.
    library: PathBuf,
    /// Check only this stage type.
    #[arg(long = "type", value_name = "TYPE")]
    name: Option<String>,
    /// Settings to check, as one JSON object; repeatable [default: the defaults, and the examples in the schema].
    #[arg(long, value_name = "JSON", value_parser = settings)]
    settings: Vec<Value>,
    /// Input channels of a normalizer or a field; repeatable [default: 1, 3, 8 and 20].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    width: Vec<u16>,
    /// Largest allowed difference between single and double precision, as a share of the largest output.
    #[arg(long, value_name = "SHARE", default_value_t = 2e-5)]
    single: f64,
    /// Stop the check after this time.
    #[arg(long, value_name = "TIME", value_parser = parse::seconds, default_value = "10m")]
    time_limit: f64,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    /// Check in this process.
    #[arg(long, hide = true)]
    here: bool,
    /// Only load it, in this process.
    #[arg(long, hide = true)]
    enter: bool,
}

/// Time limit in seconds for loading a library, including its constructors and entry function.
const ENTERED: f64 = 10.0;

fn settings(text: &str) -> std::result::Result<Value, String> {
    let value: Value = serde_json::from_str(text).map_err(|e| e.to_string())?;
    if value.is_object() { Ok(value) } else { Err("expected a JSON object, such as '{\"levels\": 4}'".into()) }
}

/// The report.
#[derive(Serialize)]
struct Checked {
    plugin: String,
    version: String,
    licence: String,
    abi: String,
    path: String,
    stages: Vec<StageReport>,
    passed: bool,
}

/// One stage with one set of settings.
#[derive(Serialize)]
struct StageReport {
    kind: Kind,
    #[serde(rename = "type")]
    name: String,
    settings: Value,
    #[serde(skip_serializing_if = "Option::is_none")]
    width: Option<usize>,
    #[serde(flatten)]
    report: Report,
}

impl Check {
    pub fn run(self) -> Result<()> {
        if self.enter {
            return plugins::with(|plugins| plugins.load(self.library.clone(), Place::Named));
        }
        if self.here {
            return self.check();
        }
        let late = format!("its entry function did not return within {}", out::duration(ENTERED.min(self.time_limit)));
        self.apart("--enter", ENTERED.min(self.time_limit), late)?;
        let late = format!("stopped after {}; --time-limit sets the limit", out::duration(self.time_limit));
        self.apart("--here", self.time_limit, late)
    }

    /// Runs a part of the check in a child process and reports how it ended; `late` if it takes longer than `limit`
    /// seconds.
    fn apart(&self, part: &str, limit: f64, late: String) -> Result<()> {
        let mut command = program::command()?;
        command.args(program::arguments()).arg(part);
        let child = command.stdin(Stdio::null()).stderr(Stdio::piped()).spawn();
        let mut child = child.map_err(|e| Error::io("conefield", e))?;
        let said = program::read(child.stderr.take());
        let (place, begin) = (self.library.display().to_string(), Instant::now());
        let status = program::wait(&mut child, "conefield", &mut || match begin.elapsed().as_secs_f64() > limit {
            true => Err(Error::unsupported(&place, &late)),
            false => Ok(()),
        })?;
        let said = said.join().unwrap_or_default();
        if status.success() {
            return Ok(());
        }
        let line = said.lines().rev().find_map(|l| l.strip_prefix("error: "));
        match (status.code(), line) {
            (Some(1), Some(line)) => {
                let (what, why) = line.split_once(": ").unwrap_or((&place, line));
                Err(Error::unsupported(what, why))
            }
            (Some(2), _) => Err(Error::unsupported("plugins check", said.trim())),
            _ => Err(Error::unsupported(place, format!("crashed the checking process ({})", ending(status)))),
        }
    }

    fn check(&self) -> Result<()> {
        let report = plugins::with(|plugins| -> Result<Checked> {
            plugins.load(self.library.clone(), Place::Named)?;
            let gone = || Error::unsupported(self.library.display().to_string(), "the file no longer exists");
            self.report(plugins.get(&self.library).ok_or_else(gone)?)
        })?;
        if self.json {
            out::json(&report)?
        } else {
            out::say(&text(&report))?
        }
        let of = |s: &StageReport| s.report.failed().into_iter().map(|name| format!("{}: {name}", s.name)).collect();
        let failed: Vec<String> = report.stages.iter().flat_map::<Vec<_>, _>(of).collect();
        if failed.is_empty() {
            return Ok(());
        }
        let mut first = failed.clone();
        first.dedup();
        first.truncate(6);
        let more = if failed.len() > first.len() { ", …" } else { "" };
        let many = if failed.len() == 1 { "1 property does".into() } else { format!("{} properties do", failed.len()) };
        let why = format!("{many} not hold: {}{more}", first.join(", "));
        Err(Error::unsupported(self.library.display().to_string(), why))
    }

    /// Checks each stage type with each of its settings, at all sensible widths.
    fn report(&self, library: &Library) -> Result<Checked> {
        // The device for WGSL, opened when the first stage provides WGSL.
        let opened = OnceLock::new();
        let device = || {
            let opened = opened.get_or_init(|| Wgpu::open(None).map_err(|e| e.to_string()));
            opened.as_ref().map(|device| device as &dyn Runner).map_err(String::clone)
        };
        let widths: Vec<usize> = self.width.iter().map(|&width| width.into()).collect();
        let with = With {
            widths: if widths.is_empty() { &WIDTHS } else { &widths },
            options: &|options| Options { single: self.single, ..options },
            device: &device,
        };
        let mut stages = vec![];
        for t in library.types.iter().filter(|t| self.name.as_ref().is_none_or(|n| *n == t.name)) {
            let mut tries: Vec<Value> = self.settings.clone();
            if tries.is_empty() {
                tries = tried(&t.name, &t.schema, serde_json::json!({}))?;
            }
            let expected = "--settings, or examples in its schema: it has settings without a default";
            ensure(!tries.is_empty(), &library.owner(), &t.name, "no settings to check", expected)?;
            for settings in tries {
                let settings = with_defaults(&t.schema, settings);
                let mut table = settings.clone();
                table["type"] = t.name.clone().into();
                for (width, report) in check_type(t.kind, &table, &with)? {
                    let (name, settings) = (t.name.clone(), settings.clone());
                    stages.push(StageReport { kind: t.kind, name, settings, width, report });
                }
            }
        }
        let known: Vec<&str> = library.types.iter().map(|t| &t.name[..]).collect();
        let (name, expected) = (self.name.as_deref().unwrap_or_default(), format!("one of {}", known.join(", ")));
        ensure(!stages.is_empty(), &library.owner(), "--type", name, expected)?;
        Ok(Checked {
            plugin: library.name.clone(),
            version: library.version.clone(),
            licence: library.licence.clone(),
            abi: format!("{}.{}", library.abi.0, library.abi.1),
            path: library.path.display().to_string(),
            passed: stages.iter().all(|s| s.report.passed()),
            stages,
        })
    }
}

fn text(r: &Checked) -> String {
    let mut lines = vec![format!("{} {}, {}, ABI {}: {}", r.plugin, r.version, r.licence, r.abi, r.path)];
    for StageReport { kind, name, settings, width, report } in &r.stages {
        let width = width.map_or(String::new(), |w| format!(", {w} channels in"));
        lines.push(format!("\n{kind} {name} {settings}{width}\n  {}", report.to_string().trim_end()));
    }
    let all = || r.stages.iter().flat_map(|s| s.report.properties());
    let [passed, skipped, failed] =
        ["passed", "skipped", "failed"].map(|word| all().filter(|(_, outcome, _)| *outcome == word).count());
    lines.push(format!("\n{passed} passed, {skipped} skipped, {failed} failed"));
    lines.join("\n")
}

/// How a process ended.
fn ending(status: ExitStatus) -> String {
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&status) {
        return format!("signal {signal}");
    }
    status.to_string()
}
