//! Radiative Gaussians, in whole runs.

use crate::common::{Stop, model, plan, psnr, scan, solve, spec};
use conefield_backend_cpu::Cpu;
use conefield_core::arena::Weights;
use conefield_core::checkpoint::Resume;
use conefield_core::method::{Job, Solution};
use serde_json::{Value, json};

fn settings() -> Value {
    json!({
        "type": "gaussians", "most": 1500, "start": {"count": 800, "threshold": 0.1, "sites": "cells"}, "ssim": 0.1,
        "training": {"steps": 60, "report_every": 20}, "optimizer": {"lr": 0.01},
        "priors": [{"type": "total-variation", "weight": 0.01, "blocks": 1, "edge": 6}],
        "density_control": {"every": 10, "pull": 1e-4},
    })
}

fn bits(solution: Solution) -> Vec<u32> {
    let arena = model(solution).arena;
    [&arena.params, &arena.first, &arena.second].into_iter().flat_map(|p| p.iter().map(|x| x.to_bits())).collect()
}

#[test]
fn training_explains_the_views() {
    let mut s = settings();
    s["training"]["steps"] = json!(150);
    let (found, records) = psnr(&s, &Cpu::new());
    let losses: Vec<f64> = records.iter().filter_map(|r| r.loss).collect();
    println!("{found:.2} dB, losses {losses:?}");
    // An empty volume has 10.8 dB.
    assert!(found > 17.0, "{found} dB");
    let largest = losses.iter().fold(0.0f64, |m, l| m.max(*l));
    assert!(losses[losses.len() - 1] < 0.5 * largest, "{losses:?}");
}

#[test]
fn threads_change_no_bit() {
    let run = |threads: usize, s: &Value| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| bits(solve(s, &scan(), &Weights::default()).unwrap().0))
    };
    let mut s = settings();
    let one = run(1, &s);
    assert!(one == run(3, &s));
    s["optimizer"]["lr"] = json!(0.010001);
    assert!(one != run(1, &s));
}

/// Wherever a run is interrupted, also around a change of the number of Gaussians, it goes on to the same bits.
#[test]
fn a_run_resumes_to_the_same_bits() {
    let (scan, backend) = (scan(), Cpu::new());
    let spec = spec(&settings()).unwrap();
    let solve = |resume: Option<&Resume>, at| {
        let mut stop = Stop::at(at);
        let job = Job { seed: 7, resume, ..Job::new(&scan, &backend) };
        let result = plan(&spec, &backend, &Weights::default()).unwrap().run(&job, &mut stop);
        (result, stop)
    };
    let whole = bits(solve(None, u64::MAX).0.unwrap());
    for at in [3, 10, 25] {
        let (_, stopped) = solve(None, at);
        let again = solve(stopped.kept.as_ref(), u64::MAX).0.unwrap();
        assert!(bits(again) == whole, "at {at}");
    }
}

#[test]
fn settings_out_of_range_are_refused() {
    for (key, value, words) in [
        ("most", json!(1), ["most", "8 to"]),
        ("bin", json!(0), ["bin", "1 to 64"]),
        ("ssim", json!(-1.0), ["ssim", "0 or more"]),
        ("rates", json!({"centre": -1.0}), ["rates.centre", "0 or more"]),
        ("start", json!({"count": 0}), ["start.count", "1"]),
        ("loss", json!("noise-weighted"), ["loss", "l1"]),
    ] {
        let mut s = settings();
        s[key] = value;
        let e = spec(&s).and_then(|s| plan(&s, &Cpu::new(), &Weights::default()).map(drop)).unwrap_err().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{key}: {e}");
    }
}
