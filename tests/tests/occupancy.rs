//! Samples in cells where the field is empty leave the work: exactly these, with the same bits on any number of threads and
//! after a resumption, and without losing what is there.

mod common;
mod device;

use common::{Heard, Stop, model, scan, solve, solve_on, spec};
use conefield_backend_cpu::Cpu;
use conefield_core::arena::Weights;
use conefield_core::backend::{Backend, Loss, StepStats, TrainRay, Work};
use conefield_core::checkpoint::Resume;
use conefield_core::occupancy::Occupancy;
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::random::mix;
use conefield_core::scan::Scan;
use conefield_core::scene::Scene;
use conefield_core::solver::{Job, Record, Solution};
use conefield_core::stage::{Projector, Samples, UnitRay};
use serde_json::{Value, json};

fn settings() -> Value {
    json!({
        "scene": {"occupancy": {"refined": {"after": 16, "every": 4, "below": 0.1, "probe": 4}}},
        "encoder": {"type": "identity"},
        // Starts with nothing, so that what no ray pulls at stays empty.
        "field": {"type": "voxel-grid", "resolution": 16, "output": "none", "init": 0.0},
        "projector": {"type": "ray-march", "samples": 20},
        "solver": {"type": "gradient", "steps": 60, "rays": 128, "lr": 0.02, "report_every": 5},
    })
}

fn built() -> Pipeline {
    let mut s = settings();
    s["encoder"] = json!({"type": "hash-grid", "levels": 3, "base_resolution": 3, "log2_table_size": 8});
    s["normalizers"] = json!([{"type": "layer-norm"}]);
    s["field"] = json!({"type": "mlp", "width": 8, "depth": 3, "skips": [1]});
    Pipeline::build(&spec(&s).unwrap()).unwrap()
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

// ---- a step ----

/// A projector that leaves out samples by a rule of its own.
struct Thinned {
    inner: Box<dyn Projector>,
    keep: Box<dyn Fn([f32; 3], u64) -> bool + Send + Sync>,
}

impl Projector for Thinned {
    fn max_samples(&self, ray: &UnitRay) -> usize {
        self.inner.max_samples(ray)
    }
    fn sample(&self, ray: &UnitRay, seed: Option<u64>, out: &mut Samples) {
        let mut all = Samples::default();
        self.inner.sample(ray, seed, &mut all);
        for (p, w) in all.points.into_iter().zip(all.weights) {
            if (self.keep)(p, seed.unwrap()) {
                out.points.push(p);
                out.weights.push(w);
            }
        }
    }
    fn describe(&self) -> String {
        "thinned".into()
    }
}

/// A chequered cube: 4 cells a side, every other one empty.
fn chequered(probe: u32) -> Occupancy {
    let cells: Vec<bool> = (0..64).map(|i| (i / 16 + i / 4 + i) % 2 == 0).collect();
    Occupancy::new([[0.0; 3], [1.0; 3]], [4; 3], &cells, probe)
}

fn full(p: [f32; 3]) -> bool {
    p.iter().any(|x| !(0.0..1.0).contains(x)) || p.iter().map(|x| (4.0 * x) as u32).sum::<u32>().is_multiple_of(2)
}

fn rays(scan: &Scan) -> Vec<TrainRay> {
    let scene = Scene::new(scan, &conefield_core::spec::SceneSettings::default()).unwrap();
    let ray = |i: usize| scene.pixel_ray(&scan.geometry, i % 8, (i * 5) % 16, (i * 7) % 16);
    (0..90).map(|i| TrainRay { ray: ray(i), target: if i % 2 == 0 { 0.5 } else { 3.0 } }).collect()
}

fn gradients(pipeline: Pipeline, work: &Work<'_>) -> (StepStats, Vec<u32>) {
    let mut model = Model::random(pipeline, 3);
    let stats = Cpu::new().compile(&model.pipeline).unwrap().0.step(&mut model, work).unwrap();
    (stats, bits(&model.arena.grads))
}

#[test]
fn a_step_leaves_out_the_samples_in_empty_cells_and_no_other() {
    let scan = scan();
    let rays = rays(&scan);
    for probe in [0, 3] {
        let occupancy = chequered(probe);
        let work = |occupancy| Work { step: 4, seed: 9, loss: Loss::L2, rays: &rays, points: &[], tv: None, occupancy };
        let (stats, found) = gradients(built(), &work(Some(&occupancy)));
        let thinned = |keep: Box<dyn Fn([f32; 3], u64) -> bool + Send + Sync>| {
            let Pipeline { encoder, normalizers, field, projector, .. } = built();
            let projector = Box::new(Thinned { inner: projector, keep });
            gradients(Pipeline::assemble(encoder, normalizers, field, projector), &work(None))
        };
        let probes = occupancy.clone();
        let (expected, same) = thinned(Box::new(move |p, seed| full(p) || probes.probes(seed)));
        assert!(found == same, "probes {probe}");
        assert_eq!([stats.loss, stats.samples as f64], [expected.loss, expected.samples as f64]);
        // About half of the samples, and those of one ray in three.
        let (whole, all) = gradients(built(), &work(None));
        let share = stats.samples as f64 / whole.samples as f64;
        assert!(if probe == 0 { (0.4..0.6).contains(&share) } else { (0.58..0.78).contains(&share) }, "{share}");
        // Negative controls: all samples; and those of a slab of cells more.
        let (_, other) = thinned(Box::new(|p, _| full(p) || (0.25..0.5).contains(&p[0])));
        assert!(found != all && found != other);
    }
}

/// What is left out counts as 0: a ray's integral is the sum over the rest, and one with nothing left misses all that was
/// measured.
#[test]
fn what_is_left_out_counts_as_nothing() {
    let scan = scan();
    let rays = rays(&scan);
    let nothing = Occupancy::new([[-9.0; 3], [9.0; 3]], [1; 3], &[false], 0);
    for occupancy in [&chequered(0), &nothing] {
        let mut model = Model::random(built(), 3);
        let mut exe = Cpu::new().compile(&model.pipeline).unwrap().0;
        let projector = built().projector;
        let mut loss = 0.0;
        for (i, ray) in rays.iter().enumerate() {
            let mut samples = Samples::default();
            projector.sample(&ray.ray, Some(mix(mix(9, 4), i as u64)), &mut samples);
            let mut mu = vec![0.0; samples.points.len()];
            exe.evaluate(&model, &samples.points, &mut mu).unwrap();
            let terms = samples.points.iter().zip(&samples.weights).zip(&mu);
            let line: f64 =
                terms.filter(|((p, _), _)| occupancy.holds(**p)).map(|((_, w), m)| f64::from(*w) * f64::from(*m)).sum();
            loss += Loss::L1.at(line - f64::from(ray.target)).0 / rays.len() as f64;
        }
        let rays = &rays;
        let work = Work { step: 4, seed: 9, loss: Loss::L1, rays, points: &[], tv: None, occupancy: Some(occupancy) };
        let stats = exe.step(&mut model, &work).unwrap();
        assert!((stats.loss - loss).abs() < 1e-6 * loss, "{} {loss}", stats.loss);
        let whole = exe.step(&mut model, &Work { occupancy: None, ..work }).unwrap();
        assert!((whole.loss - loss).abs() > 1e-3 * loss, "negative control");
    }
}

// ---- runs ----

fn outcome(solution: Solution) -> Vec<u32> {
    let samples = solution.samples;
    let arena = model(solution).arena;
    let parts = [&arena.params, &arena.first, &arena.second];
    parts.into_iter().flat_map(|p| bits(p)).chain([samples as u32]).collect()
}

fn told(records: &[Record]) -> Vec<String> {
    records.iter().flat_map(|r| r.events.iter().filter(|e| e.contains("cells")).cloned()).collect()
}

#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    let run = |threads: usize, s: &Value| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (solution, records) = pool.install(|| solve(s, &scan(), &Weights::default())).unwrap();
        (outcome(solution), told(&records))
    };
    let mut s = settings();
    s["solver"]["rays"] = json!(512);
    let one = run(1, &s);
    assert!(!one.1.is_empty(), "cells were emptied");
    assert!(one == run(2, &s), "two threads");
    assert!(one == run(3, &s), "three threads");
    // Negative control: without the rule, and with other probes.
    s["scene"]["occupancy"]["refined"]["probe"] = json!(5);
    assert!(one.0 != run(1, &s).0);
    s["scene"] = json!({});
    assert!(one.0 != run(1, &s).0);
}

#[test]
fn a_resumed_run_goes_on_to_the_same_bits() {
    let (scan, settings) = (scan(), settings());
    let spec = spec(&settings).unwrap();
    let solver = spec.solver.build().unwrap();
    let (whole, records) = solve(&settings, &scan, &Weights::default()).unwrap();
    let (samples, whole, told_whole) = (whole.samples, outcome(whole), told(&records));
    assert!(!told_whole.is_empty());
    // Before the first look, between looks, and where one is due.
    for at in [2, 8, 9, 16, 17, 24, 31, 59] {
        let mut stop = Stop::at(at);
        let stopped = solver.solve(&Job { seed: 7, ..Job::new(&scan, &spec, &Cpu::new()) }, &mut stop);
        assert!(stopped.is_err());
        let resume = stop.kept.unwrap();
        let go_on = |resume: &Resume| {
            let mut heard = Heard::default();
            let cpu = Cpu::new();
            let job = Job { seed: 7, resume: Some(resume), ..Job::new(&scan, &spec, &cpu) };
            solver.solve(&job, &mut heard).map(|s| (s.samples, outcome(s), told(&heard.0)))
        };
        let (n, found, events) = go_on(&resume).unwrap();
        assert!(n == samples && found == whole, "resumed at {at}");
        assert_eq!([told(&stop.heard), events].concat(), told_whole, "resumed at {at}");
        // Negative control: cells that are remembered otherwise.
        let mut other = resume.clone();
        let cells = other.weights.tensors.get_mut("occupancy.highest").unwrap();
        cells.1.fill(50.0);
        assert!(go_on(&other).unwrap().1 != whole, "at {at}");
        other.weights.tensors.get_mut("occupancy.highest").unwrap().0 = vec![1, 2, 3];
        let e = go_on(&other).err().unwrap().to_string();
        assert!(e.contains("occupancy.highest") && e.contains("[16, 16, 16]"), "{e}");
        other.weights.tensors.remove("occupancy.highest");
        assert!(go_on(&other).err().unwrap().to_string().contains("nothing"));
    }
}

#[test]
fn a_run_on_a_device_ends_where_the_cpu_does() {
    let run = |backend: &dyn Backend| {
        let (solution, records) = solve_on(backend, &settings(), &scan(), &Weights::default()).unwrap();
        (solution.samples as f64, records.last().unwrap().loss.unwrap(), told(&records))
    };
    let (samples, loss, events) = run(&Cpu::new());
    assert!(!events.is_empty());
    for (name, backend) in device::backends("a run with empty cells").into_iter().take(1) {
        let found = run(&backend);
        println!("{name}: {found:?}; CPU {samples} {loss} {events:?}");
        assert!((found.0 - samples).abs() < 0.03 * samples && (found.1 - loss).abs() < 0.1 * loss);
    }
}

#[test]
fn settings_that_mean_nothing_are_refused() {
    for (key, value) in
        [("after", json!(0)), ("every", json!(0)), ("below", json!(0.0)), ("below", json!(1.5)), ("probe", json!(0))]
    {
        let mut s = settings();
        s["scene"]["occupancy"]["refined"][key] = value;
        let e = solve(&s, &scan(), &Weights::default()).err().unwrap().to_string();
        assert!(e.contains(&format!("scene.occupancy.refined.{key}")), "{e}");
    }
}
