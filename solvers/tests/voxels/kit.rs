//! Shared helpers of these tests: jobs, an observer that keeps its reports, measures of a volume.

use conefield_backend_cpu::Cpu;
use conefield_core::arena::Weights;
use conefield_core::checkpoint::{Checkpoint, Resume};
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_core::method::{Context, Job, Limits, Observer, Reconstruction, Record, Solution};
use conefield_core::scan::{Scan, Volume};
use conefield_core::spec::Spec;
use conefield_core::spec::load::parse;
use conefield_core::{Error, Result};
use conefield_projectors::simulate::Ellipsoid;

// Stage types register themselves when their crate is linked.
use conefield_encoders as _;
use conefield_fields as _;

/// A view of a circular orbit; lengths in mm, `pixel` and `offset` along v and u.
pub fn view(angle: f64, distances: [f64; 2], pixel: [f64; 2], offset: [f64; 2]) -> View {
    let mm = Millimetres;
    View::circular(Radians(angle), mm(distances[0]), mm(distances[1]), pixel.map(mm), offset.map(mm))
}

/// A job with only the settings that tests vary.
pub struct Case<'a> {
    pub scan: &'a Scan,
    pub held_out: Option<&'a Scan>,
    pub reference: Option<&'a Volume>,
    pub limits: Limits,
    /// Content of every volume file that the spec names.
    pub file: Option<&'a Volume>,
    /// Start volume of the job itself.
    pub start: Option<&'a Volume>,
    pub resume: Option<&'a Resume>,
}

impl<'a> Case<'a> {
    pub fn of(scan: &'a Scan) -> Self {
        Self { scan, held_out: None, reference: None, limits: Limits::default(), file: None, start: None, resume: None }
    }

    /// Runs the method of the spec `text`.
    pub fn run(&self, text: &str, heard: &mut Heard) -> Result<Solution> {
        let spec = spec(text)?;
        let backend = Cpu::new();
        let job = Job {
            held_out: self.held_out,
            reference: self.reference,
            seed: 3,
            limits: self.limits,
            volumes: &|path| self.file.cloned().ok_or_else(|| Error::invalid(path, "file", "nothing", "a volume")),
            start: self.start,
            resume: self.resume,
            ..Job::new(self.scan, &backend)
        };
        spec.method.plan(&Context::new(&backend))?.run(&job, heard)
    }

    /// The resulting volume and the reports.
    pub fn volume(&self, text: &str) -> (Volume, Heard) {
        let mut heard = Heard::default();
        let solution = self.run(text, &mut heard).unwrap();
        (volume(solution), heard)
    }
}

pub fn spec(text: &str) -> Result<Spec> {
    parse(text, "test.toml", &[], &[]).map(|l| l.spec)
}

/// A spec like the shipped one of this name, or of a type, with `settings` replacing its own.
pub fn method(name: &str, settings: &str) -> String {
    let (kind, own) = match name {
        "os-sart" => ("sart", &["subsets = 10", "relaxation = 1.0", "stop = { passes = 20 }"][..]),
        "sirt" => ("sart", &["subsets = 1", "relaxation = 1.9", "decay = 1.0", "stop = { passes = 60 }"][..]),
        "fista-tv" => ("fista", &["prior.type = \"total-variation\""][..]),
        _ => (name, &[][..]),
    };
    let key = |line: &str| line.split('=').next().unwrap_or_default().trim().to_owned();
    let own = own.iter().filter(|own| settings.lines().all(|line| key(line) != key(own)));
    let own: String = own.map(|line| format!("{line}\n")).collect();
    format!("type = \"{kind}\"\n{own}{settings}\n")
}

pub fn volume(solution: Solution) -> Volume {
    match solution.result {
        Reconstruction::Volume(v) => v,
        _ => panic!("a field came out of a method on voxels"),
    }
}

/// Keeps its reports; interrupts after some records and keeps the checkpoint.
#[derive(Default)]
pub struct Heard {
    pub records: Vec<Record>,
    /// Finished shares of the run.
    pub shares: Vec<f64>,
    /// Messages and warnings.
    pub notes: Vec<String>,
    pub warnings: Vec<String>,
    pub interrupt_after: Option<usize>,
    pub kept: Option<Resume>,
}

impl Heard {
    pub fn interrupting_after(records: usize) -> Self {
        Self { interrupt_after: Some(records), ..Self::default() }
    }

    pub fn losses(&self) -> Vec<f64> {
        self.records.iter().map(|r| r.loss.unwrap()).collect()
    }

    pub fn said(&self, words: &str) -> bool {
        self.notes.iter().any(|n| n.contains(words))
    }
}

impl Observer for Heard {
    fn progress(&mut self, _: u64, share: f64, seconds_left: f64) {
        assert!((0.0..=1.0).contains(&share) && seconds_left >= 0.0, "{share} and {seconds_left}");
        self.shares.push(share);
    }
    fn record(&mut self, record: &Record) {
        self.records.push(record.clone());
    }
    fn note(&mut self, text: &str) {
        self.notes.push(text.into());
    }
    fn warn(&mut self, text: &str) {
        self.warnings.push(text.into());
        self.note(text);
    }
    fn cancelled(&self) -> bool {
        self.interrupt_after.is_some_and(|n| self.records.len() >= n)
    }
    /// Like a file: numbers of the standing pass through JSON.
    fn checkpoint(&mut self, c: &Checkpoint<'_>) -> Result<()> {
        let standing = serde_json::from_str(&serde_json::to_string(&c.standing).unwrap()).unwrap();
        let tensors = c.tensors.iter().map(|(n, shape, x)| (n.clone(), (shape.to_vec(), x.to_vec()))).collect();
        let weights = Weights { tensors, ..Weights::default() };
        self.kept = Some(Resume::new("checkpoint".into(), standing, weights));
        Ok(())
    }
}

/// Mean of the voxels whose centres satisfy `within`; at least 20 of them.
pub fn mean(volume: &Volume, within: impl Fn([f64; 3]) -> bool) -> f64 {
    let found = volume.data.indexed_iter().filter(|((x, y, z), _)| within(volume.grid.voxel([*x, *y, *z])));
    let (sum, count) = found.fold((0.0, 0), |(s, n), (_, v)| (s + f64::from(*v), n + 1));
    assert!(count >= 20, "{count} voxels say little");
    sum / f64::from(count)
}

/// PSNR in dB over all voxels, against the reference's largest value.
pub fn psnr(volume: &Volume, reference: &Volume) -> f64 {
    let square = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
    let mse = volume.data.iter().zip(&reference.data).map(square).sum::<f64>() / volume.data.len() as f64;
    let top = reference.data.iter().fold(0.0f64, |m, &x| m.max(f64::from(x)));
    10.0 * (top * top / mse).log10()
}

/// Some ellipsoids in a cube of 24³ voxels of 2 mm.
pub fn bodies() -> Vec<Ellipsoid> {
    vec![
        Ellipsoid { center: [1.0, -1.0, 0.5], axes: [18.0, 15.0, 17.0], value: 0.02 },
        Ellipsoid { center: [-6.0, 3.0, 1.0], axes: [5.0, 4.0, 8.0], value: 0.02 },
        Ellipsoid { center: [7.0, -4.0, -3.0], axes: [4.0, 6.0, 5.0], value: -0.015 },
    ]
}

/// `views` views of that cube on a full circle.
pub fn geometry(views: usize) -> Geometry {
    let turn = |i: usize| std::f64::consts::TAU * i as f64 / views as f64;
    Geometry {
        detector: [32, 36],
        views: (0..views).map(|i| view(0.1 + turn(i), [150.0, 220.0], [2.8, 2.8], [0.0, 0.0])).collect(),
        volume: VoxelGrid { shape: [24; 3], spacing: [2.0; 3], center: [0.0; 3] },
    }
}
