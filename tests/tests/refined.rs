//! Nothing real disappears where steps take no samples in cells that the field has left empty: details as with the rule
//! off, and one that comes up late where a cell was emptied too early.

mod common;

use common::{Heard, Stop, solve, spec, volume};
use conefield_backend_cpu::Cpu;
use conefield_core::arena::Weights;
use conefield_core::scan::{Scan, Volume};
use conefield_core::method::{Job, Solution};
use conefield_projectors::simulate::{DetectorNoise, Protocol, simulate};
use ndarray::Array3;
use serde_json::{Value, json};

const N: usize = 32;

/// A body of attenuation 1 (per half cube side) off the middle, and what `more` adds.
fn object(more: impl Fn([usize; 3]) -> Option<f32>) -> Volume {
    let data = Array3::from_shape_fn((N, N, N), |(x, y, z)| {
        let d = [x as f64 - 13.0, y as f64 - 17.0, (z as f64 - 16.0) * 0.7];
        let body = f32::from(u8::from(d.iter().map(|v| v * v).sum::<f64>() < 49.0));
        more([x, y, z]).unwrap_or(body)
    });
    Volume::centered(data, [2.0 / N as f64; 3])
}

fn scan(volume: &Volume, noise: DetectorNoise) -> Scan {
    let protocol = Protocol::r2(&volume.grid).with_detector([64, 64]).with_views(24).with_noise(noise, 3);
    simulate(volume, &protocol).unwrap()
}

fn noisy() -> DetectorNoise {
    "tigre:1e4,10".parse().unwrap()
}

fn settings(support: &str, occupancy: Value) -> Value {
    json!({
        "scene": {"support": support, "occupancy": occupancy, "attenuation": {"fixed": 1.0}},
        // Of voxels, each with a value of its own, so that nothing but a sample beside it moves it.
        "encoder": {"type": "identity"},
        "field": {"type": "voxel-grid", "resolution": N, "output": "none", "init": 0.0},
        "projector": {"type": "ray-march", "step_voxels": 1.0},
        "solver": {"type": "gradient", "steps": 600, "rays": 512, "lr": 0.05, "eps": 1e-15, "loss": "l2", "pixels": "all",
            "decay": {"exponential": 0.1}, "report_every": 50,
            "tv": {"weight": 0.005, "blocks": 32}},
    })
}

fn refined() -> Value {
    json!({"refined": {"after": 96, "every": 8, "below": 0.1}})
}

fn run(scan: &Scan, settings: &Value) -> (Solution, Volume) {
    let (solution, _) = solve(settings, scan, &Weights::default()).unwrap();
    let volume = volume(&solution);
    (solution, volume)
}

/// Root mean square of the error where `at` says, and mean value there.
fn error(truth: &Volume, found: &Volume, at: impl Fn([usize; 3]) -> bool) -> [f64; 2] {
    let there = truth.data.indexed_iter().filter(|((x, y, z), _)| at([*x, *y, *z]));
    let (mut n, mut squares, mut sum) = (0.0, 0.0, 0.0);
    for ((x, y, z), t) in there {
        let f = f64::from(found.data[[x, y, z]]);
        (n, squares, sum) = (n + 1.0, squares + (f - f64::from(*t)).powi(2), sum + f);
    }
    [(squares / n).sqrt(), sum / n]
}

/// Trains on a scan of `truth` with the rule and without it: the detail is as good, the whole is, and there was less to do.
fn keeps(name: &str, truth: &Volume, noise: DetectorNoise, supports: &[&str], detail: impl Fn([usize; 3]) -> bool) {
    let scan = scan(truth, noise);
    for &support in supports {
        let (off, without) = run(&scan, &settings(support, json!("fixed")));
        let (on, with) = run(&scan, &settings(support, refined()));
        let share = on.samples as f64 / off.samples as f64;
        let [[e_off, m_off], [e_on, m_on]] = [&without, &with].map(|v| error(truth, v, &detail));
        let [whole_off, whole_on] = [&without, &with].map(|v| error(truth, v, |_| true)[0]);
        println!(
            "{name}, {support}: {:.0}% of the samples; detail {m_off:.3} and {m_on:.3}, off by {e_off:.4} and {e_on:.4}; \
             whole off by {whole_off:.4} and {whole_on:.4}",
            100.0 * share
        );
        assert!(m_off > 0.3 * error(truth, truth, &detail)[1], "{name}, {support}: there without the rule");
        assert!(share < if support == "box" { 0.9 } else { 0.97 }, "{name}, {support}: {share}");
        assert!(m_on > 0.9 * m_off && e_on < 1.1 * e_off + 0.005, "{name}, {support}");
        assert!(whole_on < 1.1 * whole_off, "{name}, {support}: {whole_on} {whole_off}");
    }
}

#[test]
fn a_thin_wire_stays() {
    let wire = |[x, y, _]: [usize; 3]| x == 26 && y == 6;
    keeps("wire", &object(|at| wire(at).then_some(3.0)), DetectorNoise::None, &["box", "carve"], wire);
}

#[test]
fn a_bright_voxel_at_the_rim_stays() {
    let voxel = |at: [usize; 3]| at == [30, 16, 24];
    keeps("voxel", &object(|at| voxel(at).then_some(8.0)), DetectorNoise::None, &["box"], voxel);
}

#[test]
fn a_faint_block_in_air_stays() {
    let block = |at: [usize; 3]| at.iter().zip([24, 5, 18]).all(|(x, from)| (from..from + 4).contains(x));
    keeps("faint block", &object(|at| block(at).then_some(0.5)), DetectorNoise::None, &["box"], block);
}

#[test]
fn an_insert_of_low_contrast_stays() {
    let insert = |at: [usize; 3]| at.iter().zip([12, 15, 15]).all(|(x, from)| (from..from + 4).contains(x));
    keeps("insert", &object(|at| insert(at).then_some(0.9)), noisy(), &["box"], insert);
}

#[test]
fn a_body_in_heavy_noise_stays() {
    // Some 40 photons through the body, 300 beside it.
    let body = object(|_| None);
    keeps("heavy noise", &body, "poisson:300".parse().unwrap(), &["box"], |[x, y, z]| body.data[[x, y, z]] > 0.0);
}

/// A block that the first steps saw nothing of, in cells that count as empty. The rays that are probes teach the field of it,
/// and with looks its cells are taken up again. Negative control: without either it stays lost.
#[test]
fn what_appears_late_comes_back() {
    let near =
        |at: [usize; 3], by: usize| at.iter().zip([24, 5, 18]).all(|(x, from)| (from - by..from + 4 + by).contains(x));
    let [before, after] = [object(|_| None), object(|at| near(at, 0).then_some(0.8))];
    let [blind, scan] = [&before, &after].map(|v| scan(v, DetectorNoise::None));
    let cpu = Cpu::new();
    let settings = |occupancy: Value| {
        let mut s = settings("box", occupancy);
        s["projector"]["step_voxels"] = json!(1.5);
        s["solver"]["tv"] = Value::Null;
        s["solver"]["steps"] = json!(400);
        spec(&s).unwrap()
    };
    let fixed = settings(json!("fixed"));
    let mut stop = Stop::at(201);
    assert!(fixed.solver.build().unwrap().solve(&Job::new(&blind, &fixed, &cpu), &mut stop).is_err());
    let mut resume = stop.kept.unwrap();
    let cells = (0..N * N * N).map(|i| if near([i / (N * N), i / N % N, i % N], 4) { 0.0 } else { 100.0 });
    resume.weights.tensors.insert("occupancy.highest".into(), (vec![N; 3], cells.collect()));
    let late = |occupancy: Value| {
        let spec = settings(occupancy.clone());
        let mut heard = Heard::default();
        let job = Job { resume: Some(&resume), ..Job::new(&scan, &spec, &cpu) };
        let solution = spec.solver.build().unwrap().solve(&job, &mut heard).unwrap();
        let [_, mean] = error(&after, &volume(&solution), |at| near(at, 0));
        println!("{occupancy}: {mean:.3} of 0.8 in {} samples", solution.samples);
        mean
    };
    // The next look after step 200 would be at step 400, when all is over.
    let rule = |every: u64, probe: u32| json!({"refined": {"after": 1, "every": every, "below": 0.1, "probe": probe}});
    let off = late(json!("fixed"));
    let [both, probes, none] = [late(rule(8, 16)), late(rule(200, 16)), late(rule(200, u32::MAX))];
    assert!(off > 0.4, "{off}");
    assert!(both > 0.8 * off, "{both} with looks and probes, {off} with the rule off");
    assert!(none.abs() < 0.1 && probes > none + 0.1, "{probes} with probes alone, {none} without");
}
