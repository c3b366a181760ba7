//! Explains a spec: stages, widths, parameters, memory, operations.

use crate::memory::{self, Memory};
use crate::{plugins, scratch};
use conefield_core::Result;
use conefield_core::backend::Backend;
use conefield_core::method::{Findings, Line, Outline, Plan};
use conefield_core::scan::Scan;
use conefield_core::spec::load::Loaded;
use conefield_core::words::counted;
use conefield_evaluation::report::text::{bytes, number, table};
use serde::Serialize;

/// The explanation of a spec.
#[derive(Debug, Serialize)]
pub struct Explanation {
    spec: String,
    source: String,
    /// The other specs and files that the spec is made of.
    extends: Vec<String>,
    description: String,
    #[serde(flatten)]
    outline: Outline,
    /// The backend of the plan.
    #[serde(skip_serializing_if = "Option::is_none")]
    backend: Option<String>,
    parameters: usize,
    model_bytes: usize,
    /// The plugins whose stages the spec uses.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    plugins: Vec<plugins::Used>,
    scan: Option<ForScan>,
}

/// The part that depends on the scan.
#[derive(Debug, Serialize)]
struct ForScan {
    views: usize,
    detector: [usize; 2],
    volume: [usize; 3],
    #[serde(flatten)]
    findings: Findings,
    memory: Memory,
    /// How often views and volume are read if the memory is too small.
    reads: Vec<String>,
}

impl Explanation {
    /// Explains a spec and its plan for `backend`; with a scan, also its requirements in such a `run`.
    pub fn new(
        loaded: &Loaded,
        plan: &dyn Plan,
        backend: Option<&dyn Backend>,
        scan: Option<(&Scan, memory::Run)>,
    ) -> Result<Self> {
        let for_scan = |(scan, run): (&Scan, memory::Run)| {
            let g = &scan.geometry;
            Ok(ForScan {
                views: g.views.len(),
                detector: g.detector,
                volume: g.volume.shape,
                findings: plan.inspect(scan).map_err(|e| loaded.locate(e))?,
                memory: run.memory(plan),
                reads: plan.reads(&scan.header(), scratch::room(memory::limit())),
            })
        };
        let scan = scan.map(for_scan).transpose()?;
        let outline = plan.outline();
        let parameters = outline.parameters();
        Ok(Self {
            spec: loaded.spec.name.clone(),
            source: loaded.source.clone(),
            extends: loaded.sources().into_iter().filter(|s| *s != loaded.source).collect(),
            description: loaded.spec.description.clone(),
            outline,
            backend: backend.map(Backend::describe),
            parameters,
            model_bytes: 16 * parameters,
            plugins: plugins::used(&loaded.tree),
            scan,
        })
    }

    /// Text for people.
    pub fn text(&self) -> String {
        let mut lines = vec![];
        let shipped = self.source.strip_prefix(&self.spec) == Some(" (shipped)");
        let name = format!("{} ({})", self.spec, self.source);
        lines.push(if shipped || self.spec.is_empty() { self.source.clone() } else { name });
        if !self.extends.is_empty() {
            lines.push(format!("extends {}", self.extends.join(", ")));
        }
        if !self.description.is_empty() {
            lines.push(self.description.clone());
        }
        lines.push(String::new());
        outlined(&self.outline, &mut lines);
        // That of a field is listed with what it compiled.
        let backend = self.backend.iter().filter(|_| self.outline.backend().backend.is_empty());
        lines.extend(backend.map(|backend| format!("\nbackend: {backend}")));
        lines.extend(self.plugins.iter().map(|plugin| format!("\nplugin: {}", plugin.line())));
        if self.parameters > 0 || self.scan.is_some() {
            lines.push(String::new());
        }
        if self.parameters > 0 {
            lines.push(format!(
                "memory for the model: {} (parameters {p}, gradients {p}, moments {})",
                bytes(self.model_bytes as u64),
                bytes(8 * self.parameters as u64),
                p = bytes(4 * self.parameters as u64),
            ));
        }
        if let Some(s) = &self.scan {
            let ([rows, columns], [x, y, z], views) = (s.detector, s.volume, s.views);
            let on_ray = |n| format!(", {} on the middle ray", counted(n, "sample"));
            let samples = s.findings.samples.map_or(String::new(), on_ray);
            let views = counted(views, "view");
            lines.push(format!("this scan: {views} of {rows} x {columns}, volume {x} x {y} x {z}{samples}"));
            lines.extend(s.findings.lines.iter().map(|line| format!("  {line}")));
            lines.push(format!("memory for this scan: {}", s.memory.line()));
            let limit = memory::limit();
            if let Some(beside) = s.memory.beside(limit) {
                let (limit, beside) = (bytes(limit), bytes(beside));
                lines.push(format!(
                    "it stays below {limit}, with scratch files of up to {beside} on the disk of the output"
                ));
                lines.extend(s.reads.iter().map(|line| format!("  {line}")));
            }
        }
        lines.join("\n")
    }
}

/// The parts of a method; for a chain, the parts of each of its methods.
fn outlined(o: &Outline, lines: &mut Vec<String>) {
    if !o.stages.is_empty() {
        lines.push(stages(o));
        lines.push(String::new());
    }
    let row = |l: &Line| vec![l.stage.clone(), l.kind.clone(), l.what.clone()];
    let rest: Vec<Vec<String>> = o.beside.iter().chain([&o.method]).map(row).collect();
    lines.push(table(&rest, &[]));
    if let Some(backend) = &o.compiled {
        lines.push(format!("\nbackend: {}", backend.backend));
        lines.extend(backend.notes.iter().map(|n| format!("  {n}")));
    }
    for link in &o.links {
        lines.push(String::new());
        outlined(link, lines);
    }
}

/// A field's stages as a table.
fn stages(o: &Outline) -> String {
    let heads = ["stage", "type", "in -> out", "parameters", "bytes", "MACs/sample", "gradient", "what"];
    let mut rows = vec![heads.map(str::to_owned).to_vec()];
    let row = |names: [String; 3], [parameters, size, macs]: [usize; 3]| {
        let [stage, kind, widths] = names;
        vec![stage, kind, widths, number(parameters as u64), bytes(size as u64), number(macs as u64)]
    };
    let mut total = [0; 3];
    for s in &o.stages {
        let counts = [s.parameters, s.parameter_bytes, s.macs_per_sample];
        total = std::array::from_fn(|k| total[k] + counts[k]);
        let mut cells = row([s.stage.clone(), s.kind.clone(), format!("{} -> {}", s.input, s.output)], counts);
        let left_out = if s.left_out { " (no work)" } else { "" };
        let on_cpu = if s.wgsl { "" } else { " (CPU only: it has no WGSL)" };
        cells.extend([format!("{:?}", s.gradient).to_lowercase(), format!("{}{left_out}{on_cpu}", s.what)]);
        rows.push(cells);
    }
    rows.push(row(["total".into(), String::new(), String::new()], total));
    table(&rows, &[3, 4, 5])
}
