//! Fields that bring line integrals of their own, in whole runs.

use crate::common::{Stop, model, plan, psnr, scan, solve, spec, truth};
use conefield_backend_cpu::Cpu;
use conefield_core::arena::Weights;
use conefield_core::backend::{Backend, Executable, TrainRay, Work};
use conefield_core::checkpoint::Resume;
use conefield_core::method::Job;
use conefield_core::pipeline::Model;
use conefield_core::scene::{Scene, SceneSettings};
use conefield_solvers::losses::L2;
use serde_json::{Value, json};

fn settings() -> Value {
    json!({
        "field": {"type": "voxels-joseph", "resolution": 16},
        "type": "line-field", "loss": "l2", "training": {"steps": 300, "rays": 256, "pixels": "all", "report_every": 25}, "optimizer": {"lr": 0.02},
    })
}

/// PSNR of a volume of zeros.
fn empty() -> f64 {
    let truth = truth();
    let mse = truth.data.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / truth.data.len() as f64;
    10.0 * (0.02f64.powi(2) / mse).log10()
}

#[test]
fn a_phantom_is_reconstructed() {
    let (found, records) = psnr(&settings(), &Cpu::new());
    println!("{found:.2} dB, an empty volume {:.2} dB", empty());
    assert!(found > empty() + 8.0, "{found} dB");
    let loss = |i: usize| records[i].loss.unwrap();
    assert!(loss(records.len() - 1) < 0.05 * loss(0), "{records:?}");
    // A prior on blocks of points works on such a field, too: in a field without details it leaves fewer of them.
    let mut smooth = settings();
    smooth["priors"] = json!([{"type": "total-variation", "weight": 3.0, "blocks": 8, "edge": 4}]);
    let (other, records) = psnr(&smooth, &Cpu::new());
    assert!(records.iter().all(|r| r.prior.is_some()) && other < found - 3.0, "{other} dB");
}

fn bits(solution: conefield_core::method::Solution) -> Vec<u32> {
    let arena = model(solution).arena;
    [&arena.params, &arena.first, &arena.second].into_iter().flat_map(|p| p.iter().map(|x| x.to_bits())).collect()
}

#[test]
fn threads_change_no_bit() {
    let mut s = settings();
    s["training"]["steps"] = json!(20);
    // Several ranges of voxels.
    s["field"]["resolution"] = json!(40);
    s["priors"] = json!([{"type": "total-variation", "weight": 0.01, "blocks": 4, "edge": 4}]);
    let run = |threads: usize, s: &Value| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| bits(solve(s, &scan(), &Weights::default()).unwrap().0))
    };
    let one = run(1, &s);
    assert!(one == run(2, &s) && one == run(3, &s));
    s["optimizer"]["lr"] = json!(0.020001);
    assert!(one != run(1, &s));
}

#[test]
fn an_interrupted_run_goes_on_to_the_same_bits() {
    let (scan, spec, cpu) = (scan(), spec(&settings()).unwrap(), Cpu::new());
    let mut plan = plan(&spec, &cpu, &Weights::default()).unwrap();
    let mut solve = |resume: Option<&Resume>, at| {
        let mut stop = Stop::at(at);
        let job = Job { seed: 7, resume, ..Job::new(&scan, &cpu) };
        (plan.run(&job, &mut stop).map(bits).map_err(|e| e.to_string()), stop)
    };
    let whole = solve(None, u64::MAX).0;
    let (stopped, first) = solve(None, 130);
    assert!(stopped.unwrap_err().contains("interrupted"));
    assert!(whole == solve(first.kept.as_ref(), u64::MAX).0);
}

/// The gradients of a step are those of its loss.
#[test]
fn a_step_s_gradients_are_those_of_its_loss() {
    let (scan, spec) = (scan(), spec(&settings()).unwrap());
    let scene = Scene::new(&scan, &SceneSettings::default()).unwrap();
    let mut model = Model::random(crate::common::pipeline(&spec), 3);
    model.arena.params.iter_mut().enumerate().for_each(|(i, p)| *p = (i as f32 * 0.37).sin().abs());
    let mut exe = Cpu::new().compile(&model.pipeline).unwrap().0;
    let ray = |i: usize| TrainRay { ray: scene.pixel_ray(&scan.geometry, i % 8, 4 + i % 7, 5 + i % 5), target: 0.2 };
    let rays: Vec<TrainRay> = (0..60).map(ray).collect();
    let work = Work { step: 0, seed: 0, loss: &L2 {}, rays: &rays, points: &[], priors: &[] };
    let found = exe.step(&mut model, &work).unwrap();
    assert_eq!(found.samples, 60);
    let grads = model.arena.grads.to_vec();
    // Along the gradient, where the change of the loss is largest against rounding.
    let largest = grads.iter().fold(0.0f32, |m, g| m.max(g.abs()));
    let direction: Vec<f32> = grads.iter().map(|g| g / largest).collect();
    let want: f64 = grads.iter().zip(&direction).map(|(g, d)| f64::from(g * d)).sum();
    let start = model.arena.params.clone();
    let mut at = |exe: &mut Box<dyn Executable>, t: f32| {
        for ((p, s), d) in model.arena.params.iter_mut().zip(start.iter()).zip(&direction) {
            *p = s + t * d;
        }
        exe.renew();
        exe.step(&mut model, &work).unwrap().loss
    };
    let slope = (at(&mut exe, 0.05) - at(&mut exe, -0.05)) / 0.1;
    assert!((slope - want).abs() < 1e-3 * want.abs(), "{slope} {want}");
}

#[test]
fn what_such_a_field_has_no_use_for_is_refused() {
    for (key, stage) in [
        ("encoder", json!({"type": "identity"})),
        ("normalizers", json!([{"type": "layer-norm"}])),
        ("projector", json!({"type": "ray-march"})),
    ] {
        let mut s = settings();
        s[key] = stage;
        let e = solve(&s, &scan(), &Weights::default()).err().unwrap().to_string();
        assert!(e.contains(&format!("{key}: found an unknown key")), "{e}");
    }
    let mut s = settings();
    s["field"]["resolution"] = json!(0);
    let e = solve(&s, &scan(), &Weights::default()).err().unwrap().to_string();
    assert!(e.contains("field.resolution"), "{e}");
}

#[test]
fn a_device_refuses_it_in_words() {
    for (name, backend) in crate::device::backends("a field with line integrals of its own") {
        let pipeline = crate::common::pipeline(&spec(&settings()).unwrap());
        let e = backend.compile(&pipeline).err().unwrap().to_string();
        assert!(e.contains("voxels-joseph") && e.contains("--backend cpu"), "{name}: {e}");
    }
}
