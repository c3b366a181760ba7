//! Training at the edge: learning rates, and very long runs.

use crate::case::{Case, Ends, Seen};
use crate::common::{model, pipeline, scan, solve};
use crate::scans::with;
use conefield_backend_cpu::Cpu;
use conefield_core::backend::{Adam, Backend, Work};
use conefield_core::pipeline::Model;
use conefield_solvers::losses::L1;
use serde_json::{Value, json};
use std::time::Instant;

pub fn rates() -> Vec<Case> {
    let case = |lr: f64, ends: Ends| {
        let set = move |v: &mut Value| {
            v["optimizer"]["lr"] = json!(lr);
            v["training"]["steps"] = json!(300);
        };
        let expected = match ends {
            Ends::Refused(_) => "refused after 8 rollbacks",
            Ends::Recovered => "goes back to a rate that it can bear",
            Ends::Warned | Ends::Any => "finite, said to be for nothing",
            Ends::Right => "better than nothing, no rollback",
        };
        Case::right(format!("learning rate {lr:e}"), expected, move || with(set)).ends(ends)
    };
    vec![
        case(1e-8, Ends::Warned),
        case(1e-4, Ends::Warned),
        case(1e-2, Ends::Right),
        case(1.0, Ends::Recovered),
        case(10.0, Ends::Warned),
        case(1e2, Ends::Refused(&["training diverged", "after 8 rollbacks", "optimizer.lr"])),
        case(1e30, Ends::Refused(&["training diverged", "after 8 rollbacks", "optimizer.lr"])),
    ]
}

/// Numbers that are neither 0 nor normal.
fn denormals<'a>(values: impl IntoIterator<Item = &'a f32>) -> usize {
    values.into_iter().filter(|x| x.is_subnormal()).count()
}

pub fn long() -> Vec<Case> {
    let million = Case::right("10^6 steps of 8 rays", "loss no higher than after 10^5, no denormal", || {
        let run = |steps: u64| {
            let value = json!({
                "encoder": {"type": "hash-grid", "levels": 2, "base_resolution": 3, "log2_table_size": 6},
                "normalizers": [{"type": "layer-norm"}],
                "field": {"type": "mlp", "width": 4, "depth": 2, "skips": []},
                "projector": {"type": "ray-march", "samples": 4},
                "type": "neural-field", "training": {"steps": steps, "rays": 8, "report_every": steps / 10}, "optimizer": {"lr": 2e-3, "decay": "none"},
            });
            solve(&value, &scan())
        };
        let (_, first) = run(100_000)?;
        let (solution, records) = run(1_000_000)?;
        let (early, late) = (&records[0], &records[9]);
        let rollbacks = solution.rollbacks;
        let arena = model(solution).arena;
        let found = denormals(arena.params.iter().chain(arena.first.iter()).chain(arena.second.iter()));
        let speed = late.samples_per_s.unwrap_or(0.0) / early.samples_per_s.unwrap_or(f64::MAX);
        let (loss, before) = (late.loss.unwrap_or(f64::NAN), first[9].loss.unwrap_or(f64::NAN));
        let fine = loss <= 1.1 * before && found == 0 && speed > 0.5;
        let figure =
            format!("loss {loss:.3e}, {found} denormals, last tenth at {:.0} % of the first's speed", 100.0 * speed);
        let reference = format!("loss {before:.3e} after 10^5");
        Ok(Seen { figure, reference, wrong: (!fine).then(|| "drift".to_owned()), rollbacks, ..Seen::default() })
    });
    let moments = Case::right("moments of 10^6 updates without gradient", "end at 0, as fast as with one", || {
        let (model, slow) = updates(0.0);
        let (_, plain) = updates(1e-3);
        let left = model.arena.first.iter().chain(model.arena.second.iter()).filter(|x| **x != 0.0).count();
        let ratio = slow / plain;
        let wrong = (left > 0 || ratio > 2.0).then(|| format!("{left} moments left"));
        let figure = format!("{left} moments left, {ratio:.2} of the time");
        Ok(Seen { figure, reference: "gradients of 1e-3".into(), wrong, ..Seen::default() })
    });
    let field = Case::right("outputs among the denormals", "less than 3 times as slow", || {
        // A softplus of −95 is 5.5e-42.
        let (tiny, plain) = (steps(-95.0), steps(0.0));
        let wrong = (tiny > 3.0 * plain).then(|| "slow".to_owned());
        let figure = format!("{:.2} of the time", tiny / plain);
        Ok(Seen { figure, reference: "outputs of order 1".into(), wrong, ..Seen::default() })
    });
    vec![million, moments, field]
}

fn softplus() -> Value {
    let mut value = crate::scans::field();
    value["field"]["output"] = json!("softplus");
    value
}

/// A million updates, the first of them with gradients of 1, the others with `gradient`; and the seconds that they took.
fn updates(gradient: f32) -> (Model, f64) {
    let mut model = Model::random(pipeline(&softplus()), 1);
    let (mut exe, _) = Cpu::new().compile(&model.pipeline).unwrap();
    let begun = Instant::now();
    for step in 1..=1_000_000 {
        model.arena.grads.fill(if step == 1 { 1.0 } else { gradient });
        exe.update(&mut model, &Adam { lr: 1e-9, beta1: 0.9, beta2: 0.999, eps: 1e-8, step }).unwrap();
    }
    (model, begun.elapsed().as_secs_f64())
}

/// Seconds of some steps of a field whose last bias is `bias`.
fn steps(bias: f32) -> f64 {
    let mut model = Model::random(pipeline(&softplus()), 1);
    let last = model.arena.params.len() - 1;
    model.arena.params[last] = bias;
    let (mut exe, _) = Cpu::new().compile(&model.pipeline).unwrap();
    let points: Vec<_> = (0..20_000).map(|i| ([0.3, 0.4, i as f32 / 2e4], 0.5)).collect();
    let work = Work { step: 0, seed: 1, loss: &L1 {}, rays: &[], points: &points, priors: &[] };
    let mut best = f64::INFINITY;
    for _ in 0..30 {
        let begun = Instant::now();
        exe.step(&mut model, &work).unwrap();
        best = best.min(begun.elapsed().as_secs_f64());
    }
    best
}
