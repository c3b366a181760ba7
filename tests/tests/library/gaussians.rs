//! Radiative Gaussians, in whole runs.

use crate::common::{goes_on, model, planned, psnr, scan, solve, state};
use conefield_backend_cpu::Cpu;
use conefield_core::method::{Job, Record};
use serde_json::{Value, json};
use std::sync::LazyLock;

fn settings() -> Value {
    json!({
        "type": "gaussians", "most": 1500, "start": {"count": 800, "threshold": 0.1, "sites": "cells"}, "ssim": 0.1,
        "training": {"steps": 60, "report_every": 20}, "optimizer": {"lr": 0.01},
        "priors": [{"type": "total-variation", "weight": 0.01, "blocks": 1, "edge": 6}],
        "density_control": {"every": 10, "pull": 1e-4},
    })
}

/// A longer run.
pub fn longer() -> Value {
    let mut s = settings();
    s["training"]["steps"] = json!(150);
    s
}

/// What [`longer`] comes to on the CPU: PSNR and records.
pub static ON_CPU: LazyLock<(f64, Vec<Record>)> = LazyLock::new(|| psnr(&longer(), &Cpu::new()));

#[test]
fn training_explains_the_views() {
    let (found, records) = &*ON_CPU;
    let losses: Vec<f64> = records.iter().filter_map(|r| r.loss).collect();
    println!("{found:.2} dB, losses {losses:?}");
    // An empty volume has 10.8 dB.
    assert!(*found > 17.0, "{found} dB");
    let largest = losses.iter().fold(0.0f64, |m, l| m.max(*l));
    assert!(losses[losses.len() - 1] < 0.5 * largest, "{losses:?}");
}

#[test]
fn threads_change_no_bit() {
    let run = |threads: usize, s: &Value| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| state(&model(solve(s, &scan()).unwrap().0).arena))
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
    let mut plan = planned(&settings(), &backend).unwrap();
    let job = Job { seed: 7, ..Job::new(&scan, &backend) };
    goes_on(plan.as_mut(), &job, |_| vec![3, 10, 25], |solution| state(&model(solution.unwrap()).arena));
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
        let e = planned(&s, &Cpu::new()).err().unwrap().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{key}: {e}");
    }
}
