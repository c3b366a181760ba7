//! `conefield explain`

use crate::backend::{self, BackendChoice};
use crate::memory::Memory;
use crate::method::Parts;
use crate::{files, out, plugins, specs};
use clap::Args;
use conefield_core::Result;
use conefield_core::backend::Explain as Compiled;
use conefield_core::pipeline::Pipeline;
use conefield_core::spec::load::Loaded;
use conefield_core::stage::{GradKind, Stage};
use conefield_solvers::fit::{fit, support};
use conefield_solvers::surround::told;
use serde::Serialize;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Show what a spec builds: stages, widths, parameters, memory, work.
#[derive(Args)]
pub struct Explain {
    #[arg(help = specs::help())]
    spec: String,
    /// Change a setting, such as encoder.levels=8.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Also the memory that this scan takes.
    #[arg(long)]
    scan: Option<PathBuf>,
    #[arg(long, value_name = "BACKEND", default_value_t, help = backend::HELP)]
    backend: BackendChoice,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// A stage's line.
#[derive(Debug, Serialize)]
struct Row {
    stage: String,
    #[serde(rename = "type")]
    kind: String,
    what: String,
    input: usize,
    output: usize,
    parameters: usize,
    parameter_bytes: usize,
    gradient_bytes: usize,
    moment_bytes: usize,
    tape_bytes_per_sample: usize,
    macs_per_sample: usize,
    gradient: GradKind,
    left_out: bool,
}

impl Row {
    fn of(name: &str, kind: &Value, stage: &dyn Stage) -> Self {
        let i = stage.info();
        let kind = kind["type"].as_str().unwrap_or_default();
        Self {
            stage: name.into(),
            kind: kind.into(),
            what: without(kind, stage.describe()),
            input: i.input,
            output: i.output,
            parameters: i.params,
            parameter_bytes: 4 * i.params,
            gradient_bytes: 4 * i.params,
            moment_bytes: 8 * i.params,
            tape_bytes_per_sample: 4 * i.tape,
            macs_per_sample: i.macs,
            gradient: i.grads,
            left_out: i.identity,
        }
    }
}

/// A description without its type's name, which has a column of its own.
fn without(kind: &str, what: String) -> String {
    what.strip_prefix(kind).map_or(what.clone(), |rest| rest.trim_start_matches([':', ',', ' ']).to_owned())
}

/// A line without channels.
#[derive(Debug, Serialize)]
struct Plain {
    #[serde(rename = "type")]
    kind: String,
    what: String,
}

/// All that is said of a pipeline.
#[derive(Debug, Serialize)]
struct Report {
    spec: String,
    source: String,
    description: String,
    stages: Vec<Row>,
    projector: Option<Plain>,
    initializer: Option<Plain>,
    solver: Plain,
    parameters: usize,
    model_bytes: usize,
    macs_per_sample: usize,
    /// Whose stages the spec names.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    plugins: Vec<plugins::Used>,
    /// Of a field.
    backend: Option<Compiled>,
    scan: Option<ForScan>,
}

/// What depends on the scan.
#[derive(Debug, Serialize)]
struct ForScan {
    views: usize,
    detector: [usize; 2],
    volume: [usize; 3],
    /// Of a field.
    attenuation_scale: Option<f64>,
    /// Of a field.
    samples_per_ray: Option<usize>,
    /// What the solver will do with it.
    plan: Vec<String>,
    memory: Memory,
}

impl Explain {
    pub fn run(self) -> Result<()> {
        let loaded = specs::read(&self.spec, &self.sets)?;
        let mut parts = Parts::of(&loaded, self.backend.open()?.as_ref())?;
        let scan = self.scan.as_ref().map(|path| for_scan(&loaded, &mut parts, path)).transpose()?;
        let report = report(&loaded, parts, scan)?;
        if self.json { out::json(&report) } else { out::say(&text(&report)) }
    }
}

fn report(loaded: &Loaded, parts: Parts, scan: Option<ForScan>) -> Result<Report> {
    let tree = &loaded.tree;
    let Parts { solver, pipeline, compiled, .. } = parts;
    let backend = pipeline.is_some().then_some(compiled);
    let stages = pipeline.as_ref().map(|p| rows(tree, p)).unwrap_or_default();
    let plain = |key: &str, what: String| {
        let kind = tree[key]["type"].as_str().unwrap_or_default();
        Plain { kind: kind.into(), what: without(kind, what) }
    };
    let parameters = pipeline.as_ref().map_or(0, |p| p.layout().len());
    let projector = match &pipeline {
        Some(p) => Some(plain("projector", p.projector.describe())),
        None => solver.stages().into_iter().find(|s| s.0 == "projector").map(|(key, what)| {
            let kind = tree["solver"][key]["type"].as_str().unwrap_or_default();
            Plain { kind: kind.into(), what: without(kind, what) }
        }),
    };
    // The weights that an initializer names are not read here: a spec is explained without them.
    let initializer = match &tree["initializer"] {
        Value::Object(settings) => {
            let shown = settings.iter().filter(|(k, v)| *k != "type" && !v.is_null());
            Some(plain("initializer", shown.map(|(k, v)| format!("{k} {v}")).collect::<Vec<_>>().join(", ")))
        }
        _ => None,
    };
    Ok(Report {
        spec: loaded.spec.name.clone(),
        source: loaded.source.clone(),
        description: loaded.spec.description.clone(),
        stages,
        projector,
        initializer,
        solver: plain("solver", solver.describe()),
        parameters,
        model_bytes: 16 * parameters,
        macs_per_sample: pipeline.as_ref().map_or(0, Pipeline::macs),
        plugins: plugins::used(tree),
        backend,
        scan,
    })
}

/// A field's stages, in order.
fn rows(tree: &Value, pipeline: &Pipeline) -> Vec<Row> {
    let mut stages = vec![Row::of("encoder", &tree["encoder"], pipeline.encoder.as_ref())];
    for (i, n) in pipeline.normalizers.iter().enumerate() {
        stages.push(Row::of(&format!("normalizers.{i}"), &tree["normalizers"][i], n.as_ref()));
    }
    stages.push(Row::of("field", &tree["field"], pipeline.field.as_ref()));
    stages
}

fn for_scan(loaded: &Loaded, parts: &mut Parts, path: &Path) -> Result<ForScan> {
    let size = conefield_io::scan_size(path)?;
    Memory::of_views(&size).check(|_| vec![])?;
    let run = parts.run(size);
    let scan = files::scan(path)?;
    let g = &scan.geometry;
    let mut found: Vec<String> =
        told(&scan, &loaded.spec.scene)?.map(|s| format!("surround: {s}")).into_iter().collect();
    let seen = match &mut parts.pipeline {
        Some(pipeline) => {
            let fitted = fit(&scan, &loaded.spec.scene, pipeline).map_err(|e| loaded.locate(e))?;
            let scene = fitted.scene;
            found.extend(fitted.found);
            let middle = scene.pixel_ray(g, 0, g.detector[0] / 2, g.detector[1] / 2);
            Some((scene.attenuation * scan.unit.mm, pipeline.projector.max_samples(&middle)))
        }
        None => {
            found.extend(support(&scan, &loaded.spec.scene).1);
            None
        }
    };
    Ok(ForScan {
        views: g.views.len(),
        detector: g.detector,
        volume: g.volume.shape,
        attenuation_scale: seen.map(|s| s.0),
        samples_per_ray: seen.map(|s| s.1),
        plan: found.into_iter().chain(parts.solver.plan(&scan)).collect(),
        memory: run.memory(),
    })
}

fn text(r: &Report) -> String {
    let mut lines = vec![];
    let shipped = r.source.strip_prefix(&r.spec) == Some(" (shipped)");
    lines.push(if shipped || r.spec.is_empty() { r.source.clone() } else { format!("{} ({})", r.spec, r.source) });
    if !r.description.is_empty() {
        lines.push(r.description.clone());
    }
    lines.push(String::new());
    if !r.stages.is_empty() {
        lines.push(stages(r));
        lines.push(String::new());
    }
    let named =
        [("projector", r.projector.as_ref()), ("initializer", r.initializer.as_ref()), ("solver", Some(&r.solver))];
    let rest = named.iter().filter_map(|(stage, p)| p.map(|p| vec![stage.to_string(), p.kind.clone(), p.what.clone()]));
    lines.push(out::table(&rest.collect::<Vec<_>>(), &[]));
    for plugin in &r.plugins {
        lines.push(format!("\nplugin: {}", plugin.line()));
    }
    if let Some(backend) = &r.backend {
        lines.push(format!("\nbackend: {}", backend.backend));
        lines.extend(backend.notes.iter().map(|n| format!("  {n}")));
        lines.push(String::new());
        lines.push(format!(
            "memory for the model: {} (parameters {p}, gradients {p}, moments {})",
            out::bytes(r.model_bytes as u64),
            out::bytes(8 * r.parameters as u64),
            p = out::bytes(4 * r.parameters as u64),
        ));
    }
    if let Some(s) = &r.scan {
        if r.backend.is_none() {
            lines.push(String::new());
        }
        let ([rows, columns], [x, y, z]) = (s.detector, s.volume);
        let samples = s.samples_per_ray.map_or(String::new(), |n| format!(", {n} samples on the middle ray"));
        let views = s.views;
        lines.push(format!("this scan: {views} views of {rows} x {columns}, volume {x} x {y} x {z}{samples}"));
        lines.extend(s.plan.iter().map(|line| format!("  {line}")));
        lines.push(format!("memory for this scan: {}", s.memory.line()));
    }
    lines.join("\n")
}

/// A field's stages as a table.
fn stages(r: &Report) -> String {
    let heads = ["stage", "type", "in -> out", "parameters", "bytes", "MACs/sample", "gradient", "what"];
    let mut rows = vec![heads.map(str::to_owned).to_vec()];
    for s in &r.stages {
        let gradient = format!("{:?}", s.gradient).to_lowercase();
        rows.push(vec![
            s.stage.clone(),
            s.kind.clone(),
            format!("{} -> {}", s.input, s.output),
            out::number(s.parameters as u64),
            out::bytes(s.parameter_bytes as u64),
            out::number(s.macs_per_sample as u64),
            gradient,
            if s.left_out { format!("{} (no work)", s.what) } else { s.what.clone() },
        ]);
    }
    rows.push(vec![
        "total".into(),
        String::new(),
        String::new(),
        out::number(r.parameters as u64),
        out::bytes(4 * r.parameters as u64),
        out::number(r.macs_per_sample as u64),
    ]);
    out::table(&rows, &[3, 4, 5])
}
