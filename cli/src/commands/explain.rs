//! `conefield explain`

use super::BackendChoice;
use crate::memory::{Memory, Run};
use crate::{files, out, specs};
use clap::Args;
use conefield_core::backend::Explain as Compiled;
use conefield_core::pipeline::Pipeline;
use conefield_core::scene::Scene;
use conefield_core::spec::load::Loaded;
use conefield_core::stage::{GradKind, Stage};
use conefield_core::{Error, Result};
use serde::Serialize;
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
    /// Which backend.
    #[arg(long, default_value = "auto")]
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
    fn of(name: &str, kind: &serde_json::Value, stage: &dyn Stage) -> Self {
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
    projector: Plain,
    initializer: Option<Plain>,
    solver: Plain,
    parameters: usize,
    model_bytes: usize,
    macs_per_sample: usize,
    backend: Compiled,
    scan: Option<ForScan>,
}

/// What depends on the scan.
#[derive(Debug, Serialize)]
struct ForScan {
    views: usize,
    detector: [usize; 2],
    volume: [usize; 3],
    attenuation_scale: f64,
    samples_per_ray: usize,
    memory: Memory,
}

impl Explain {
    pub fn run(self) -> Result<()> {
        let loaded = specs::read(&self.spec, &self.sets)?;
        let pipeline = specs::build(&loaded)?;
        let (_, compiled) = self.backend.open().compile(&pipeline)?;
        let scan = match &self.scan {
            Some(path) => Some(for_scan(&loaded, &pipeline, path, &compiled)?),
            None => None,
        };
        let report = report(&loaded, &pipeline, compiled, scan)?;
        if self.json { out::json(&report) } else { out::say(&text(&report)) }
    }
}

fn report(loaded: &Loaded, pipeline: &Pipeline, backend: Compiled, scan: Option<ForScan>) -> Result<Report> {
    let tree = &loaded.tree;
    let mut stages = vec![Row::of("encoder", &tree["encoder"], pipeline.encoder.as_ref())];
    for (i, n) in pipeline.normalizers.iter().enumerate() {
        stages.push(Row::of(&format!("normalizers.{i}"), &tree["normalizers"][i], n.as_ref()));
    }
    stages.push(Row::of("field", &tree["field"], pipeline.field.as_ref()));
    let plain = |key: &str, what: String| {
        let kind = tree[key]["type"].as_str().unwrap_or_default();
        Plain { kind: kind.into(), what: without(kind, what) }
    };
    let parameters = pipeline.layout().len();
    // The weights that an initializer names are not read here: a spec is explained without them.
    let initializer = match &tree["initializer"] {
        serde_json::Value::Object(settings) => {
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
        projector: plain("projector", pipeline.projector.describe()),
        initializer,
        solver: plain("solver", loaded.spec.solver.build().map_err(|e: Error| loaded.locate(e))?.describe()),
        parameters,
        model_bytes: 16 * parameters,
        macs_per_sample: pipeline.macs(),
        backend,
        scan,
    })
}

fn for_scan(loaded: &Loaded, pipeline: &Pipeline, path: &Path, compiled: &Compiled) -> Result<ForScan> {
    let size = conefield_io::scan_size(path)?;
    let solver = loaded.spec.solver.build().map_err(|e| loaded.locate(e))?;
    let run = Run {
        scan: size,
        split: false,
        reference: false,
        field: true,
        parameters: pipeline.layout().len() as u64,
        backend: compiled.scratch_bytes as u64,
        solver: solver.working_memory(size.pixels, size.voxels),
        resume: false,
    };
    let scan = files::scan(path)?;
    let g = &scan.geometry;
    let scene = Scene::new(&scan, &loaded.spec.scene).map_err(|e| loaded.locate(e))?;
    let middle = scene.pixel_ray(g, 0, g.detector[0] / 2, g.detector[1] / 2);
    Ok(ForScan {
        views: g.views.len(),
        detector: g.detector,
        volume: g.volume.shape,
        attenuation_scale: scene.attenuation * scan.unit.mm,
        samples_per_ray: pipeline.projector.max_samples(&middle),
        memory: run.memory(),
    })
}

fn text(r: &Report) -> String {
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
    let mut lines = vec![];
    let shipped = r.source.strip_prefix(&r.spec) == Some(" (shipped)");
    lines.push(if shipped || r.spec.is_empty() { r.source.clone() } else { format!("{} ({})", r.spec, r.source) });
    if !r.description.is_empty() {
        lines.push(r.description.clone());
    }
    lines.push(String::new());
    lines.push(out::table(&rows, &[3, 4, 5]));
    lines.push(String::new());
    let mut rest = vec![vec!["projector".to_owned(), r.projector.kind.clone(), r.projector.what.clone()]];
    if let Some(i) = &r.initializer {
        rest.push(vec!["initializer".into(), i.kind.clone(), i.what.clone()]);
    }
    rest.push(vec!["solver".into(), r.solver.kind.clone(), r.solver.what.clone()]);
    lines.push(out::table(&rest, &[]));
    lines.push(format!("\nbackend: {}", r.backend.backend));
    lines.extend(r.backend.notes.iter().map(|n| format!("  {n}")));
    lines.push(String::new());
    lines.push(format!(
        "memory for the model: {} (parameters {p}, gradients {p}, moments {})",
        out::bytes(r.model_bytes as u64),
        out::bytes(8 * r.parameters as u64),
        p = out::bytes(4 * r.parameters as u64),
    ));
    if let Some(s) = &r.scan {
        let ([rows, columns], [x, y, z]) = (s.detector, s.volume);
        lines.push(format!(
            "this scan: {} views of {rows} x {columns}, volume {x} x {y} x {z}, {} samples on the middle ray",
            s.views, s.samples_per_ray
        ));
        lines.push(format!("memory for this scan: {}", s.memory.line()));
    }
    lines.join("\n")
}
