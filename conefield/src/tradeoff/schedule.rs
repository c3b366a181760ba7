//! Plans a run for a budget: chooses the method, if it is open, and the end of training.

use crate::method::Planned;
use crate::tradeoff::calibrate::{Bench, Costs, calibrate, picture, score};
use crate::tradeoff::front::{Expected, Front, Size, Unknowns};
use crate::tradeoff::speed::pass_s;
use conefield_core::method::Plan;
use conefield_core::words::plural;
use conefield_core::{Error, Result};
use conefield_evaluation::report::text::{duration, number};
use serde::{Deserialize, Serialize};
use std::cell::RefCell;
use std::time::{Duration, Instant};

/// Prefix of the error for a budget that is too short for anything: such a run says nothing about its method.
pub const TOO_SHORT: &str = "the budget: ";
/// Planned share of the budget; the rest is a reserve.
const AIM: f64 = 0.98;
/// Minimum share of a point's steps that must fit into the time.
const ENOUGH: f64 = 0.9;
/// Maximum number of methods that are measured before one is chosen.
const MEASURED: usize = 3;
/// Longest measurement of a method, in seconds and as a share of the budget: for short budgets, and for those in which
/// three seconds matter little. Passes on a less coarse scan predict full passes better.
const CALIBRATION: [(f64, f64); 2] = [(1.0, 0.1), (3.0, 0.04)];
/// Share of a chain's time that is reserved for its methods after the first. In `smooth-tv` they take nine tenths; the
/// difference lets the first one end a little late.
const LATER: f64 = 0.7;
/// Minimum share of that reserve for a useful result.
const LEAST_LATER: f64 = 0.1;
/// Minimum number of steps of a useful field.
const STEPS: f64 = 10.0;

/// The available time.
#[derive(Debug, Clone, Copy)]
pub struct Budget {
    /// Start of the command.
    pub begin: Instant,
    /// Seconds from the start.
    pub seconds: f64,
    /// Seconds of training that an interrupted run has already used.
    pub spent: f64,
}

/// Why a run within a budget has its method. A resumed run keeps it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reason {
    /// The point of the front, if the method was chosen.
    pub point: Option<String>,
    /// Reason for the method.
    pub why: String,
    /// Rejected methods, with reasons.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub passed_over: Vec<String>,
}

impl Reason {
    /// The reason for a method that was not chosen.
    pub fn requested() -> Self {
        Self { point: None, why: "the requested spec".into(), passed_over: vec![] }
    }
}

/// The planned run, for people and for the record.
#[derive(Debug, Clone, Serialize)]
pub struct Schedule {
    /// The reason for the method.
    #[serde(flatten)]
    pub reason: Reason,
    /// Steps or passes that fit into the time.
    pub steps: u64,
    /// Seconds until the plan was complete.
    pub load_s: f64,
    /// Part of `load_s` for measurements.
    pub calibrate_s: f64,
    /// Expected durations of the remaining parts.
    pub expected: Costs,
    /// Planned seconds of training.
    pub train_s: f64,
    /// Maximum number of passes or steps, even if time is left ([`Plan::passes`]).
    #[serde(skip)]
    pub passes: Option<u64>,
    #[serde(skip)]
    kind: Unknowns,
    /// Planned end of training.
    #[serde(skip)]
    pub deadline: Instant,
    /// Deadline of a solver that runs after training.
    #[serde(skip)]
    pub then: Option<Instant>,
}

impl Budget {
    /// Remaining seconds of the planned time.
    fn left(&self) -> f64 {
        AIM * self.seconds - self.spent - self.begin.elapsed().as_secs_f64()
    }

    /// Plans `method`, which the run has for this reason.
    pub fn plan(&self, bench: &Bench<'_>, method: &mut Planned, reason: Reason) -> Result<Schedule> {
        let start = Instant::now();
        let costs = calibrate(bench, method.plan.as_mut(), self.measuring())?;
        self.settle(reason, method, costs, start)
    }

    /// The best method of `front` that fits, built by `build` from a spec and settings, with its schedule.
    pub fn choose(
        &self,
        bench: &Bench<'_>,
        front: &Front,
        build: impl Fn(&str, &[String]) -> Result<Planned>,
    ) -> Result<(Planned, Schedule)> {
        let start = Instant::now();
        let g = &bench.job.scan.geometry;
        let size = Size::new(g.views.len(), g.detector, g.volume.shape);
        let front = &front.near(size);
        let mut points: Vec<_> = front.points.iter().collect();
        points.sort_by(|a, b| b.accuracy().total_cmp(&a.accuracy()));
        let expected: Vec<(Unknowns, Expected)> = points.iter().map(|p| (p.kind, front.expected(p, size))).collect();
        // On a scan as large as one of the front, the cost is the front's, scaled by the relative speed of the
        // machines. This is more accurate than an extrapolation from a coarser scan. A smaller scan costs less.
        let iterates = points.iter().any(|p| p.kind == Unknowns::Voxels);
        let slower = match front.pass_s {
            // If it fails, the methods themselves are timed.
            Some(then) if iterates && (front.close(size) || front.larger(size)) => {
                pass_s(bench.job.backend, bench.cancelled).ok().map(|s| s / then)
            }
            _ => None,
        };
        let afterwards = match slower {
            Some(_) => Costs { picture_s: picture(bench)?, score_s: score(bench)?, ..Costs::default() },
            None => Costs::default(),
        };
        let built = RefCell::new(vec![]);
        let measure = |i: usize| {
            let mut method = build(&points[i].spec, &points[i].sets)?;
            let there = match (slower, points[i].kind) {
                (Some(slower), Unknowns::Voxels) => {
                    let e = if front.close(size) { expected[i].1 } else { front.least(points[i]) };
                    let Costs { picture_s, score_s, .. } = afterwards;
                    Some(Costs { picture_s, score_s, ..as_there(e, slower, method.plan.as_mut()) })
                }
                _ => None,
            };
            let whole = |c: &Costs| c.run_s(expected[i].1.steps, 1.0);
            let costs = match there {
                Some(there) if front.close(size) => there,
                there => {
                    let here = calibrate(bench, method.plan.as_mut(), self.measuring() / 2.0)?;
                    there.filter(|t| whole(t) < whole(&here)).unwrap_or(here)
                }
            };
            built.borrow_mut().push((i, method));
            Ok(costs)
        };
        let Choice { point: at, costs, fits, passed_over } = pick(&expected, slower, || self.left(), measure)?;
        let method = built.take().into_iter().find(|(i, _)| *i == at).map(|(_, m)| m);
        let mut method =
            method.ok_or_else(|| Error::unsupported("the budget", "no method of the front was measured"))?;
        let point = points[at];
        let why = if fits {
            "the best of the front that fits"
        } else {
            "no method of the front fits completely; this one is the fastest"
        };
        let why = format!("{why} ({})", point.scores(front));
        let passed_over = passed_over.into_iter().map(|(i, why)| format!("{}: {why}", points[i].name)).collect();
        let reason = Reason { point: Some(point.name.clone()), why, passed_over };
        let plan = self.settle(reason, &mut method, costs, start)?;
        Ok((method, plan))
    }

    /// Seconds for measuring a method.
    fn measuring(&self) -> f64 {
        CALIBRATION.into_iter().map(|(longest, share)| longest.min(share * self.seconds)).fold(0.0, f64::max)
    }

    /// The schedule, or an error that states a sufficient time.
    fn settle(&self, reason: Reason, method: &mut Planned, costs: Costs, start: Instant) -> Result<Schedule> {
        let kind = Unknowns::of(method.plan.as_mut());
        let left = self.left();
        // If time is short, training gets half of it, provided that later methods can do with less.
        let room = 0.5 * (left - costs.prepare_s - (costs.after_s() - costs.then_s));
        let costs = Costs { then_s: costs.then_s.min(room.max(costs.then_least_s)), ..costs };
        let load_s = self.begin.elapsed().as_secs_f64();
        let train_s = left - costs.after_s() - costs.prepare_s;
        let (least, first) = match kind {
            Unknowns::Field => (STEPS, format!("{STEPS} steps")),
            Unknowns::Voxels => (1.0, "one pass".into()),
        };
        let least = least * costs.step_s;
        // A resumed run has made progress and continues to its end.
        if train_s < least && self.spent == 0.0 {
            let needed = (load_s + self.spent + costs.prepare_s + least + costs.after_s()) / AIM;
            let expected = format!(
                "at least {} on this machine: {} until the plan was made, {} to prepare and for {first} of {}, {} to write and compare",
                time(needed.max(self.seconds * 1.01)),
                time(load_s + self.spent),
                time(costs.prepare_s + least),
                method.loaded.spec.name,
                time(costs.after_s()),
            );
            return Err(Error::invalid(TOO_SHORT.trim_end_matches(": "), "time", time(self.seconds), expected));
        }
        let passes = match method.plan.as_mut().links() {
            [first, ..] => first.passes(),
            [] => method.plan.as_mut().passes(),
        };
        let steps = (train_s / costs.step_s.max(1e-12)) as u64;
        Ok(Schedule {
            reason,
            steps: passes.map_or(steps, |most| most.min(steps)),
            passes,
            load_s,
            calibrate_s: start.elapsed().as_secs_f64(),
            expected: costs,
            train_s: train_s.max(0.0),
            kind,
            deadline: within(left - costs.after_s()),
            then: (costs.then_s > 0.0).then(|| within(left - costs.after_s() + costs.then_s)),
        })
    }
}

/// The cost of a voxel method that costs `expected` on the front's machine, on a machine that takes `slower` times as
/// long. Excludes drawing and scoring.
fn as_there(expected: Expected, slower: f64, plan: &mut dyn Plan) -> Costs {
    let step_s = slower * expected.step_s;
    let costs = Costs { step_s, export_s: slower * expected.beside_s, ..Costs::default() };
    if plan.links().is_empty() {
        return costs;
    }
    let then_steps = LATER * expected.steps;
    let then_s = then_steps * step_s;
    Costs { then_s, then_least_s: LEAST_LATER * then_s, then_steps, ..costs }
}

/// The time `seconds` from now.
fn within(seconds: f64) -> Instant {
    Instant::now() + Duration::from_secs_f64(seconds.max(0.0))
}

/// Formats a time, with tenths if it is short.
fn time(seconds: f64) -> String {
    if seconds < 10.0 { format!("{seconds:.2} s") } else { duration(seconds) }
}

impl Schedule {
    /// Text for people; `spec` is the name of the method's spec.
    pub fn lines(&self, spec: &str) -> Vec<String> {
        let Reason { point, why, passed_over } = &self.reason;
        let named = match point {
            Some(point) => format!("{point} (spec {spec})"),
            None => format!("spec {spec}"),
        };
        let (e, steps) = (&self.expected, plural(self.steps, self.kind.step()));
        let mut lines = vec![format!("method: {named}, {why}")];
        lines.extend(passed_over.iter().map(|line| format!("passed over: {line}")));
        if e.then_s > 0.0 {
            lines.push(format!("planned: at most {} after the training", time(e.then_s)));
        }
        let train_s = self.train_s.min(self.steps as f64 * e.step_s);
        let free = match self.train_s - train_s {
            // The method has no more passes.
            free if free > e.step_s => format!("; it then stops by itself and leaves {}", time(free)),
            _ => String::new(),
        };
        lines.push(format!(
            "planned: {} to read and to measure, {} to prepare, {} for about {} {steps} of {} each, {} to write and compare{free}",
            time(self.load_s),
            time(e.prepare_s),
            time(train_s),
            number(self.steps),
            time(e.step_s),
            time(e.after_s() - e.then_s),
        ));
        lines
    }
}

/// The result of [`pick`].
struct Choice {
    /// Index of the point, and its cost on this machine.
    point: usize,
    costs: Costs,
    /// Whether there is time for all its steps.
    fits: bool,
    /// Better points, with the reason for rejecting each.
    passed_over: Vec<(usize, String)>,
}

/// Takes the first of `points`, sorted from the best, that fits into `left` seconds. The first estimate of a point's
/// cost comes from the front's own machine; voxel methods take `voxels_slower` times as long here, if that is known.
/// `measure` finds the cost here, which also gives the relative speed for other points of its kind.
fn pick(
    points: &[(Unknowns, Expected)],
    voxels_slower: Option<f64>,
    left: impl Fn() -> f64,
    mut measure: impl FnMut(usize) -> Result<Costs>,
) -> Result<Choice> {
    let mut known: Vec<Option<Result<Costs, String>>> = points.iter().map(|_| None).collect();
    // For fields and for voxels. If only one kind has been measured, its ratio is the best guess for the other.
    let mut slower: [Option<f64>; 2] = [None; 2];
    slower[Unknowns::Voxels as usize] = voxels_slower;
    let index = |kind: Unknowns| kind as usize;
    while known.iter().flatten().filter(|k| k.is_ok()).count() < MEASURED {
        let needed = |i: usize| {
            let (kind, e) = points[i];
            match &known[i] {
                Some(Ok(c)) => c.run_s(e.steps, ENOUGH),
                Some(Err(_)) => f64::INFINITY,
                None => {
                    let factor = slower[index(kind)].or(slower[1 - index(kind)]).unwrap_or(1.0);
                    factor * (ENOUGH * e.steps * e.step_s + e.beside_s)
                }
            }
        };
        let all: Vec<f64> = (0..points.len()).map(needed).collect();
        let now = left();
        let first = all.iter().position(|t| *t <= now);
        let cheapest = (0..points.len()).min_by(|a, b| all[*a].total_cmp(&all[*b])).unwrap_or(0);
        let at = first.unwrap_or(cheapest);
        match &known[at] {
            None => {
                let measured = measure(at);
                if let Ok(costs) = &measured {
                    let (kind, e) = points[at];
                    // Ratio of whole runs, because the steps of a chain differ.
                    let ratio = costs.run_s(e.steps, 1.0) / (e.steps * e.step_s + e.beside_s).max(1e-12);
                    slower[index(kind)] = voxels_slower.filter(|_| kind == Unknowns::Voxels).or(Some(ratio));
                }
                known[at] = Some(measured.map_err(|e| e.to_string()));
            }
            Some(_) => break,
        }
    }
    let now = left();
    let mut passed_over = vec![];
    let mut fallback: Option<(usize, Costs, f64)> = None;
    for (i, (kind, e)) in points.iter().enumerate() {
        match &known[i] {
            Some(Ok(c)) => {
                let needed = c.run_s(e.steps, ENOUGH);
                if needed <= now {
                    return Ok(Choice { point: i, costs: *c, fits: true, passed_over });
                }
                passed_over.push((i, format!("needs {}, but only {} are left", time(needed), time(now))));
                // A few steps give a useful field; a few passes do not give a useful volume.
                let least = match kind {
                    Unknowns::Field => c.prepare_s + STEPS * c.step_s + c.after_s(),
                    Unknowns::Voxels => needed,
                };
                if fallback.is_none_or(|f| least < f.2) {
                    fallback = Some((i, *c, least));
                }
            }
            Some(Err(why)) => passed_over.push((i, why.clone())),
            None => {}
        }
    }
    match fallback {
        Some((point, costs, _)) => {
            passed_over.retain(|(i, _)| *i != point);
            Ok(Choice { point, costs, fits: false, passed_over })
        }
        None => {
            let why: Vec<&str> = passed_over.iter().map(|(_, why)| &why[..]).collect();
            Err(Error::unsupported("the front", format!("none of its methods can run here: {}", why.join("; "))))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two fields and two voxel methods, the best first; seconds on the front's machine 100, 40, 20 and 2.
    fn points() -> Vec<(Unknowns, Expected)> {
        let point = |kind, steps, step_s| (kind, Expected { steps, step_s, beside_s: 0.0 });
        vec![
            point(Unknowns::Field, 1000.0, 0.1),
            point(Unknowns::Voxels, 20.0, 2.0),
            point(Unknowns::Field, 400.0, 0.05),
            point(Unknowns::Voxels, 1.0, 2.0),
        ]
    }

    /// The choice with `left` seconds on a machine that is `factor` times as slow, and the points measured for it.
    fn chosen(left: f64, factor: f64) -> (usize, bool, Vec<usize>) {
        let points = points();
        let mut measured = vec![];
        let measure = |i: usize| {
            measured.push(i);
            Ok(Costs { step_s: factor * points[i].1.step_s, ..Costs::default() })
        };
        let choice = pick(&points, None, || left, measure).unwrap();
        (choice.point, choice.fits, measured)
    }

    #[test]
    fn the_best_that_fits_is_taken() {
        assert_eq!(chosen(100.0, 1.0), (0, true, vec![0]));
        assert_eq!(chosen(60.0, 1.0), (1, true, vec![1]));
        assert_eq!(chosen(25.0, 1.0), (2, true, vec![2]));
        assert_eq!(chosen(3.0, 1.0), (3, true, vec![3]));
    }

    #[test]
    fn one_measurement_predicts_others_of_its_kind() {
        // The field of 90 s takes 270 s, and the voxel method takes longer by the same factor: 108 s.
        assert_eq!(chosen(100.0, 3.0), (2, true, vec![0, 2]));
        // On a faster machine a better point fits.
        assert_eq!(chosen(50.0, 0.5), (0, true, vec![1, 0]));
    }

    #[test]
    fn a_chain_whose_first_steps_are_cheap_makes_nothing_else_seem_so() {
        // A chain of 27 s, 40 passes of 1.7 s and 8 of 1 s, on a machine as fast as the front's.
        let point = |steps, step_s| (Unknowns::Voxels, Expected { steps, step_s, beside_s: 0.0 });
        let points = [point(27.0, 1.0), point(40.0, 1.7), point(8.0, 1.0)];
        let mut measured = vec![];
        let measure = |i: usize| {
            measured.push(i);
            Ok(match i {
                0 => Costs { step_s: 0.05, then_s: 26.5, then_steps: 17.0, ..Costs::default() },
                _ => Costs { step_s: points[i].1.step_s, ..Costs::default() },
            })
        };
        let choice = pick(&points, None, || 26.0, measure).unwrap();
        assert_eq!((choice.point, choice.fits, measured), (2, true, vec![0, 2]));
    }

    /// Drawing and scoring cost the same in every run and do not indicate a slow machine.
    #[test]
    fn a_known_speed_is_not_overruled_by_what_is_measured() {
        let points = [(20.0, 1.0), (15.0, 1.0), (1.0, 1.0)]
            .map(|(steps, step_s)| (Unknowns::Voxels, Expected { steps, step_s, beside_s: 0.0 }));
        let mut measured = vec![];
        let measure = |i: usize| {
            measured.push(i);
            let score_s = if i == 0 { 10.0 } else { 0.0 };
            Ok(Costs { step_s: points[i].1.step_s, score_s, ..Costs::default() })
        };
        let choice = pick(&points, Some(1.0), || 19.0, measure).unwrap();
        assert_eq!((choice.point, choice.fits, measured), (1, true, vec![0, 1]));
    }

    #[test]
    fn where_nothing_fits_the_least_is_taken() {
        let (point, fits, measured) = chosen(1.0, 1.0);
        assert_eq!((point, fits, measured), (3, false, vec![3]));
        let refused = pick(&points(), None, || 1e9, |_| Err(Error::unsupported("memory", "too little")));
        assert!(refused.err().unwrap().to_string().contains("too little"));
    }

    #[test]
    fn one_that_cannot_run_is_passed_over() {
        let points = points();
        let measure = |i: usize| match i {
            0 => Err(Error::unsupported("memory", "too little")),
            _ => Ok(Costs { step_s: points[i].1.step_s, ..Costs::default() }),
        };
        let choice = pick(&points, None, || 100.0, measure).unwrap();
        assert_eq!((choice.point, choice.passed_over.len()), (1, 1));
    }
}
