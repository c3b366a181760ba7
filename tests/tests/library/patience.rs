//! Training that ends when held-out views are no longer predicted better.

use crate::common::{Heard, bits, goes_on, model, neural_field, planned, scan};
use conefield_backend_cpu::Cpu;
use conefield_core::Result;
use conefield_core::method::{Best, Job, Limits, Record, Solution};
use conefield_core::scan::Scan;
use rand::{RngExt, SeedableRng};
use serde_json::{Value, json};

/// A scan to learn from and held-out views; the first with noise so strong that a field soon learns nothing else.
fn scans(noise: f32) -> (Scan, Scan) {
    let (mut train, held) = scan().split(&[2, 6]).unwrap();
    let top = train.projections.iter().fold(0.0f32, |m, p| m.max(*p));
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    train.projections.mapv_inplace(|p| p + noise * top * (random.random::<f32>() - 0.5));
    (train, held)
}

fn settings(steps: u64, patience: Option<u64>) -> Value {
    let mut value = neural_field(
        16,
        json!({
            "encoder": {"type": "hash-grid", "levels": 4, "base_resolution": 4, "log2_table_size": 12},
            "training": {"steps": steps, "rays": 64, "pixels": "all", "report_every": 20},
            "optimizer": {"lr": 0.01, "decay": "none"},
        }),
    );
    if let Some(n) = patience {
        value["callbacks"] = json!([{"type": "rollback"}, {"type": "patience", "records": n}]);
    }
    value
}

fn solve(value: &Value, (train, held): &(Scan, Scan), limits: Limits) -> (Solution, Vec<Record>) {
    let (backend, mut heard) = (Cpu::new(), Heard::default());
    let job = Job { seed: 7, held_out: Some(held), limits, ..Job::new(train, &backend) };
    (planned(value, &backend).unwrap().run(&job, &mut heard).unwrap(), heard.records)
}

fn params(solution: Solution) -> Vec<u32> {
    bits(&model(solution).arena.params)
}

/// The record with the least error, and how many came after it.
fn least(records: &[Record]) -> (Best, usize) {
    let error = |r: &Record| r.held_out.unwrap();
    let at = (0..records.len()).min_by(|&a, &b| error(&records[a]).total_cmp(&error(&records[b]))).unwrap();
    (Best { step: records[at].step, held_out: error(&records[at]) }, records.len() - 1 - at)
}

#[test]
fn a_run_that_learns_noise_ends_early_and_returns_the_best() {
    let scans = scans(1.0);
    let mut patient = settings(4000, Some(5));
    patient["callbacks"].as_array_mut().unwrap().push(json!({"type": "fft-mask", "epoch": 100_000}));
    let (solution, records) = solve(&patient, &scans, Limits::default());
    let (best, after) = least(&records);
    let errors: Vec<_> = records.iter().map(|r| r.held_out.unwrap()).collect();
    assert!(solution.steps < 4000 && after == 5, "{errors:.4?}");
    assert_eq!((solution.best, solution.steps), (Some(best), best.step + 5 * 20));
    let met = |r: &Record| r.events.iter().any(|e| e.contains("stopping rule"));
    assert!(met(records.last().unwrap()) && !records[..records.len() - 1].iter().any(met));
    let ends = &records.last().unwrap().events;
    assert!(ends.iter().any(|e| e.contains("no channel was evaluated")), "{ends:?}");
    // The result equals that of a run with this number of steps. More steps would have made it worse.
    let (early, _) = solve(&settings(best.step, None), &scans, Limits::default());
    assert_eq!(early.best, None);
    assert!(params(solution) == params(early));
    let (_, late) = solve(&settings(1000, None), &scans, Limits::default());
    assert!(late.last().unwrap().held_out.unwrap() > 1.05 * best.held_out, "{late:?}");
}

#[test]
fn a_run_that_improves_goes_to_its_end_whatever_sets_it() {
    let (clean, noisy) = (scans(0.0), scans(1.0));
    let (solution, records) = solve(&settings(200, Some(5)), &clean, Limits::default());
    assert_eq!((solution.steps, solution.best), (200, Some(least(&records).0)));
    assert!(records.iter().all(|r| r.events.is_empty()), "{records:?}");
    let limits = Limits { steps: Some(60), ..Limits::default() };
    assert_eq!(solve(&settings(200, Some(5)), &clean, limits).0.steps, 60);
    // A run that is cut short returns the best so far, too.
    let limits = Limits { steps: Some(800), ..Limits::default() };
    let (solution, records) = solve(&settings(200, Some(1000)), &noisy, limits);
    let (best, after) = least(&records);
    assert!(solution.steps == 800 && after > 0 && solution.best == Some(best), "{records:?}");
}

#[test]
fn without_patience_nothing_changes() {
    let scans = scans(1.0);
    let (plain, with) = (settings(200, None), settings(200, Some(1000)));
    let values = |r: &[Record]| r.iter().map(|r| (r.step, r.loss, r.held_out)).collect::<Vec<_>>();
    let ((a, of_a), (b, of_b)) = (solve(&plain, &scans, Limits::default()), solve(&with, &scans, Limits::default()));
    assert_eq!(values(&of_a), values(&of_b));
    // Patience does not change the training; only the returned state may be an earlier one.
    assert_eq!(params(a) == params(b), least(&of_a).1 == 0);
}

/// Wherever a run is interrupted, it goes on to the same bits, the same records and the same end; and so where channels left
/// the work, which starts the comparison anew.
#[test]
fn a_run_resumes_to_the_same_best() {
    let (train, held) = scans(1.0);
    let mut masked = settings(4000, Some(4));
    masked["callbacks"] = json!([{"type": "patience", "records": 4}, {"type": "fft-mask", "keep": [0, 1, 2, 3, 4]}]);
    for (value, masks) in [(settings(4000, Some(4)), false), (masked, true)] {
        let backend = Cpu::new();
        let mut plan = planned(&value, &backend).unwrap();
        let job = Job { seed: 7, held_out: Some(&held), ..Job::new(&train, &backend) };
        let around = |(steps, best, _): &(u64, Option<Best>, _)| {
            let best = best.unwrap().step;
            vec![1, 19, 20, 21, 47, 48, 49, 50, best, best + 1, steps - 1, *steps]
        };
        let ended = |solution: Result<Solution>| solution.map(|s| (s.steps, s.best, params(s))).unwrap();
        let ((steps, best, _), records) = goes_on(plan.as_mut(), &job, around, ended);
        let said = |r: &Record| r.events.iter().any(|e| e.contains("fft-mask: 5 of 8 channels kept"));
        assert_eq!(records.iter().any(said), masks);
        assert!(steps < 4000 && best.is_some_and(|b| b.step == steps - 4 * 20), "{steps}, {best:?}");
    }
}

#[test]
fn its_needs_are_reported() {
    let planned = |patience| planned(&settings(9, patience), &Cpu::new());
    let (with, without) = (planned(Some(3)).unwrap(), planned(None).unwrap());
    assert_eq!((with.needs_held_out(), without.needs_held_out()), (Some("callbacks.1".into()), None));
    let (header, parameters) = (scan().header(), with.outline().parameters() as u64);
    assert_eq!(with.needs(&header).optimizer - without.needs(&header).optimizer, 4 * parameters);
    let said = "ends after 3 records without a smaller held-out error";
    let (with, without) = (with.outline(), without.outline());
    let last = with.beside.last().unwrap();
    assert!(last.stage == "callbacks.1" && last.what.ends_with(said), "{last:?}");
    assert!(without.beside.iter().all(|l| !l.what.contains("held-out")), "{:?}", without.beside);
    let e = planned(Some(0)).err().unwrap().to_string();
    assert!(e.contains("callbacks.1.records: found 0, expected at least 1"), "{e}");
}
