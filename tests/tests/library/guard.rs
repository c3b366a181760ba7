//! Training that runs away is found out, goes back, and ends in words if that does not help.

use crate::common::{goes_on, model, neural_field, planned, scan, solve, solve_on, state};
use conefield_backend_cpu::Cpu;
use conefield_core::arena::Arena;
use conefield_core::backend::{Adam, Backend, Executable, Explain, StepStats, Work};
use conefield_core::error::{Error, Result};
use conefield_core::method::{Job, Record, Solution};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::stage::UnitRay;
use serde_json::{Value, json};

fn settings(steps: u64) -> Value {
    let training = json!({"steps": steps, "rays": 64, "report_every": 5});
    neural_field(8, json!({"training": training, "optimizer": {"lr": 0.01}}))
}

/// What goes wrong, decided by the step, so that it goes wrong again after a resumption.
#[derive(Clone, Copy)]
enum Fault {
    None,
    /// The loss of this step is NaN.
    Loss(u64),
    /// From this step on every loss is.
    Forever(u64),
    /// After this step's update one parameter is NaN, of a table's entry that few rays meet.
    Parameter(u64),
    /// The updates of these steps go up the slope, a hundred times as far.
    Uphill(u64, u64),
}

/// A backend with a fault: a device, or the CPU with an arena of its own as a device has it.
struct Faulty<'a> {
    fault: Fault,
    device: Option<&'a dyn Backend>,
}

struct Remote {
    fault: Fault,
    inner: Box<dyn Executable>,
    /// Whether `inner` has an arena of its own.
    device: bool,
    arena: Option<Arena>,
    step: u64,
}

impl Remote {
    /// `work` on the arena that lives here.
    fn here<T>(&mut self, model: &mut Model, work: impl FnOnce(&mut dyn Executable, &mut Model) -> T) -> T {
        if self.device {
            return work(self.inner.as_mut(), model);
        }
        let own = self.arena.take().unwrap_or_else(|| model.arena.clone());
        let theirs = std::mem::replace(&mut model.arena, own);
        let result = work(self.inner.as_mut(), model);
        self.arena = Some(std::mem::replace(&mut model.arena, theirs));
        result
    }
}

impl Backend for Faulty<'_> {
    fn name(&self) -> &'static str {
        "faulty"
    }
    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        let (inner, explain) = self.device.unwrap_or(&Cpu::new()).compile(pipeline)?;
        let device = self.device.is_some();
        Ok((Box::new(Remote { fault: self.fault, inner, device, arena: None, step: 0 }), explain))
    }
}

impl Executable for Remote {
    fn step(&mut self, model: &mut Model, work: &Work<'_>) -> Result<StepStats> {
        self.step = work.step;
        let mut stats = self.here(model, |exe, model| exe.step(model, work))?;
        match self.fault {
            Fault::Loss(at) if at == work.step => stats.loss = f64::NAN,
            Fault::Forever(at) if at <= work.step => stats.prior = f64::INFINITY,
            _ => {}
        }
        Ok(stats)
    }
    fn update(&mut self, model: &mut Model, adam: &Adam) -> Result<()> {
        let (step, fault) = (self.step, self.fault);
        self.here(model, |exe, model| {
            let mut adam = *adam;
            if let Fault::Uphill(from, to) = fault
                && (from..to).contains(&step)
            {
                adam.lr *= -100.0;
            }
            exe.update(model, &adam)?;
            if let Fault::Parameter(at) = fault
                && at == step
            {
                model.arena.params[7] = f32::NAN;
            }
            Ok(())
        })
    }
    fn evaluate(&mut self, _: &Model, _: &[[f32; 3]], _: &mut [f32]) -> Result<()> {
        Err(Error::unsupported("faulty", "does not evaluate"))
    }
    fn encode(&mut self, _: &Model, _: &[[f32; 3]]) -> Result<Vec<f32>> {
        Err(Error::unsupported("faulty", "does not encode"))
    }
    fn render(&mut self, _: &Model, _: &[UnitRay], _: &mut [f32]) -> Result<()> {
        Err(Error::unsupported("faulty", "does not render"))
    }
    fn fetch(&mut self, model: &mut Model) -> Result<()> {
        if let Some(own) = &self.arena {
            model.arena = own.clone();
        }
        self.inner.fetch(model)
    }
    fn renew(&mut self) {
        self.arena = None;
        self.inner.renew();
    }
}

fn run(value: &Value, fault: Fault) -> Result<(Solution, Vec<Record>)> {
    solve_on(&Faulty { fault, device: None }, value, &scan())
}

fn outcome(solution: Solution) -> Vec<u32> {
    state(&model(solution).arena)
}

/// What was said of going back, with the step of the record.
fn events(records: &[Record]) -> Vec<(u64, String)> {
    let all = records.iter().flat_map(|r| r.events.iter().map(|e| (r.step, e.clone())));
    all.filter(|(_, e)| e.starts_with("step ")).collect()
}

#[test]
fn what_never_diverges_keeps_its_bits() {
    let mut off = settings(130);
    off["callbacks"] = json!([]);
    let plain = |s: &Value| solve(s, &scan()).unwrap();
    let ((a, on), (b, without)) = (plain(&settings(130)), plain(&off));
    assert_eq!(a.rollbacks, 0);
    assert_eq!(on.iter().map(|r| r.loss).collect::<Vec<_>>(), without.iter().map(|r| r.loss).collect::<Vec<_>>());
    let a = outcome(a);
    assert!(a == outcome(b) && a == outcome(run(&settings(130), Fault::None).unwrap().0));
}

#[test]
fn a_loss_that_is_not_finite_goes_back_at_once() {
    let (solution, records) = run(&settings(160), Fault::Loss(130)).unwrap();
    assert_eq!((solution.rollbacks, solution.steps), (1, 160));
    let said = events(&records);
    assert_eq!(said.len(), 1);
    // Copies are made at the end of windows of 25 steps: the first, and one a hundred steps later.
    let words = "step 130: the loss is NaN, the prior 0; rolled back to step 124, learning rate times 0.5";
    assert_eq!(said[0], (135, words.to_owned()));
    let rate = |step| records.iter().find(|r| r.step == step).unwrap().lr.unwrap();
    let decay = |step: u64| 0.1f64.powf(step as f64 / 160.0);
    assert!(
        (rate(130) / (0.01 * decay(130)) - 1.0).abs() < 1e-9 && (rate(135) / (0.005 * decay(135)) - 1.0).abs() < 1e-9
    );
    assert!(records.iter().all(|r| r.loss.is_some_and(f64::is_finite)));
    assert!(outcome(solution).iter().all(|b| f32::from_bits(*b).is_finite()));
}

/// The state after a rollback is that of the copy: a run that ends there has its bits, moments included.
#[test]
fn parameters_and_moments_come_back() {
    let mut long = settings(131);
    long["optimizer"]["decay"] = json!("none");
    let mut short = long.clone();
    short["training"]["steps"] = json!(124);
    let back = run(&long, Fault::Loss(130)).unwrap().0;
    assert_eq!(back.rollbacks, 1);
    assert!(outcome(back) == outcome(run(&short, Fault::None).unwrap().0));
}

#[test]
fn a_run_that_goes_astray_is_found_out_within_fifty_steps() {
    for from in [0, 3, 30, 111] {
        let (solution, records) = run(&settings(300), Fault::Uphill(from, from + 6)).unwrap();
        let said = events(&records);
        let step =
            |text: &str| text.strip_prefix("step ").and_then(|t| t.split(':').next()?.parse::<u64>().ok()).unwrap();
        assert!(solution.rollbacks >= 1 && said[0].1.contains("the loss grew from"), "{said:?}");
        assert!(step(&said[0].1) < from + 50, "{from}: {said:?}");
        let last = records.last().unwrap().loss.unwrap();
        assert!(last < 0.5 * records[0].loss.unwrap(), "{from}: {last} after {records:?}");
    }
}

#[test]
fn a_parameter_that_is_not_finite_goes_back_even_at_the_end() {
    for (fault, steps) in [(Fault::Parameter(40), 60), (Fault::Parameter(59), 60)] {
        let (solution, records) = run(&settings(steps), fault).unwrap();
        assert_eq!(solution.rollbacks, 1, "{:?}", events(&records));
        assert!(outcome(solution).iter().all(|b| f32::from_bits(*b).is_finite()));
    }
}

#[test]
fn a_run_that_cannot_be_saved_ends_in_words() {
    let e = run(&settings(300), Fault::Forever(40)).err().unwrap().to_string();
    assert!(e.starts_with("training diverged at step 48: the loss is") && e.contains("after 8 rollbacks"), "{e}");
    assert!(e.contains("the prior inf") && e.contains("optimizer.lr"), "{e}");
    let mut off = settings(300);
    off["callbacks"] = json!([]);
    for fault in [Fault::Forever(40), Fault::Loss(40), Fault::Parameter(299)] {
        let e = run(&off, fault).err().unwrap().to_string();
        assert!(e.starts_with("training diverged at step") && e.contains("optimizer.lr"), "{e}");
    }
    // Nothing to go back to.
    let e = run(&settings(300), Fault::Loss(0)).err().unwrap().to_string();
    assert!(e.starts_with("training diverged at step 0: the loss is NaN"), "{e}");
}

/// Wherever a run is interrupted, before, after or between rollbacks, it goes on to the same bits; and so where channels
/// left the work.
#[test]
fn a_run_that_went_back_resumes_to_the_same_bits() {
    let mut masked = settings(170);
    masked["encoder"]["levels"] = json!(6);
    let mask = json!({"type": "fft-mask", "keep": [0, 1, 2, 3, 5, 8]});
    masked["callbacks"] = json!([{"type": "rollback"}, mask]);
    for (value, fault) in [
        (settings(170), Fault::Loss(130)),
        (settings(170), Fault::Uphill(60, 66)),
        (settings(170), Fault::Forever(163)),
        (masked, Fault::Loss(118)),
    ] {
        let (scan, backend) = (scan(), Faulty { fault, device: None });
        let mut plan = planned(&value, &backend).unwrap();
        let job = Job { seed: 7, ..Job::new(&scan, &backend) };
        let steps = |_: &_| vec![1, 24, 26, 64, 99, 118, 124, 125, 131, 140, 165];
        let ended = |solution: Result<Solution>| solution.map(|s| (s.rollbacks, outcome(s))).map_err(|e| e.to_string());
        let (whole, _) = goes_on(plan.as_mut(), &job, steps, ended);
        assert!(whole.map_or(true, |(rollbacks, _)| rollbacks > 0));
    }
}

/// On a device the copy comes from there and goes back there: a run that ends at once afterwards is where one of as many
/// updates is, but for what sums in another order come to.
#[test]
fn a_device_goes_back_too() {
    if let Some((name, device)) = crate::device::backends("rollbacks").into_iter().next() {
        let after = |steps: u64, fault| {
            let mut value = settings(steps);
            value["optimizer"]["decay"] = json!("none");
            value["training"]["rays"] = json!(8);
            value["projector"]["samples"] = json!(4);
            let backend = Faulty { fault, device: Some(device) };
            let (solution, _) = solve_on(&backend, &value, &scan()).unwrap();
            (solution.rollbacks, model(solution).arena)
        };
        let (rollbacks, back) = after(131, Fault::Loss(130));
        let (short, long) = (after(124, Fault::None).1, after(131, Fault::None).1);
        assert_eq!(rollbacks, 1, "{name}");
        let distance =
            |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt();
        let all = [(&back.params, &short.params, &long.params), (&back.second, &short.second, &long.second)];
        for (back, short, long) in all {
            let (off, apart) = (distance(back, short), distance(long, short));
            assert!(off < 0.2 * apart, "{name}: {off} from where it was to be, {apart} in seven updates");
        }
    }
}
