//! Properties of a projector that samples rays: bounded, finite, reproducible samples, and an exact adjoint.

use crate::call::{Draw, beside_others, failed, held, no_fault, require, settle, skipped};
use crate::{Outcome, Report};
use conefield_core::stage::{Lengths, Projector, Samples, UnitRay};

/// Largest mismatch of `<Aμ, y>` and `<μ, Aᵀy>`, relative to their size.
const ADJOINT: f64 = 1e-12;

/// Checks all properties of a ray projector, as it is and fitted to a scene.
pub fn check_projector(projector: &dyn Projector) -> Report {
    let mut report = as_it_is(projector);
    report.add("fitted to a scene", || fitted(projector));
    report
}

fn as_it_is(projector: &dyn Projector) -> Report {
    let mut report = Report::of(projector.describe());
    report.holds(
        "samples are bounded",
        "no more than said, as many weights as points, some on every ray through the box",
        || each(projector, bounded),
    );
    report
        .holds("samples are finite", "positions are finite, weights finite and at least 0", || each(projector, finite));
    report.holds("samples lie on their ray", "to 1e-4 of the cube's side", || each(projector, on_their_ray));
    report.holds("samples add", "to what is there", || adds(projector));
    report.holds("repeatable", "by seed, and without one", || repeatable(projector));
    report.holds("rays that miss", "give no samples and 0", || misses(projector));
    report.holds("constant attenuation", "1 integrates to the length, to 1e-3", || each(projector, constant));
    report.add("adjoint", || adjoint(projector));
    report.holds("adjoint overwrites", "what was there", || overwrites(projector));
    report.holds("threads", "several threads", || threads(projector));
    report.add("no fault", || no_fault(projector.fault()));
    report
}

/// A projector fitted to a scene has all properties, and is the same each time.
fn fitted(p: &dyn Projector) -> Outcome {
    let lengths = Lengths { voxel_mm: 2.0, cell_mm: Some(3.0) };
    let (one, other) = match (p.fitted(lengths)?, p.fitted(lengths)?) {
        (Some(one), Some(other)) => (one, other),
        (None, None) => return skipped("its settings count in no lengths of a scene"),
        _ => return failed("there is one for a scene at times"),
    };
    let report = as_it_is(one.as_ref());
    require(report.passed(), || format!("the fitted projector fails {:?}:\n{report}", report.failed()))?;
    let differs = rays().iter().any(|r| {
        let [a, b] = [&one, &other].map(|p| samples(p.as_ref(), r, Some(1)));
        a.points != b.points || a.weights != b.weights
    });
    settle(differs.then(|| "made twice for one scene, it gives two results".into()), &one.describe())
}

/// Rays through the unit cube in many directions, some along axes, with consistent box and published range.
pub fn rays() -> Vec<UnitRay> {
    let mut draw = Draw::new(11, 9);
    let mut all = vec![];
    for i in 0..40 {
        let mut direction: [f64; 3] = std::array::from_fn(|_| draw.from(&(-1.0..1.0)));
        if i < 6 {
            direction = [0.0; 3];
            direction[i / 2] = if i % 2 == 0 { 1.0 } else { -1.0 };
        }
        let length = direction.iter().map(|d| d * d).sum::<f64>().sqrt();
        let direction = direction.map(|d| d / length);
        let through: [f64; 3] = std::array::from_fn(|_| draw.from(&(0.1..0.9)));
        // The source is outside, two cube sides before the point.
        let origin: [f64; 3] = std::array::from_fn(|k| through[k] - 2.0 * direction[k]);
        let (mut near, mut far) = (0.0f64, f64::INFINITY);
        for k in 0..3 {
            if direction[k].abs() > 1e-9 {
                let ends = [(0.0 - origin[k]) / direction[k], (1.0 - origin[k]) / direction[k]];
                near = near.max(ends[0].min(ends[1]));
                far = far.min(ends[0].max(ends[1]));
            }
        }
        all.push(UnitRay {
            origin: origin.map(|v| v as f32),
            direction: direction.map(|v| v as f32),
            inside: [near as f32, far as f32],
            published: [0.2, 3.8],
            per_mm: 0.004,
        });
    }
    all
}

pub fn samples(p: &dyn Projector, ray: &UnitRay, seed: Option<u64>) -> Samples {
    let mut s = Samples::default();
    p.sample(ray, seed, &mut s);
    s
}

/// The first complaint about any ray, in training and in rendering.
fn each(p: &dyn Projector, one: fn(&dyn Projector, &UnitRay, &Samples) -> Option<String>) -> Option<String> {
    let all = rays();
    let mut tries = all.iter().enumerate().flat_map(|(i, r)| [(i, r, None), (i, r, Some(i as u64))]);
    tries.find_map(|(i, r, seed)| one(p, r, &samples(p, r, seed)).map(|c| format!("ray {i}, seed {seed:?}: {c}")))
}

fn bounded(p: &dyn Projector, r: &UnitRay, s: &Samples) -> Option<String> {
    let (n, most) = (s.points.len(), p.max_samples(r));
    if n != s.weights.len() {
        Some(format!("{n} points and {} weights", s.weights.len()))
    } else {
        (n > most || n == 0).then(|| format!("{n} samples, said at most {most}"))
    }
}

fn finite(_: &dyn Projector, _: &UnitRay, s: &Samples) -> Option<String> {
    let mut both = s.points.iter().zip(&s.weights);
    let bad = both.find(|(x, w)| !x.iter().all(|v| v.is_finite()) || !w.is_finite() || **w < 0.0);
    bad.map(|(x, w)| format!("a sample at {x:?} with weight {w}"))
}

fn on_their_ray(_: &dyn Projector, r: &UnitRay, s: &Samples) -> Option<String> {
    let off = |x: &[f32; 3]| {
        let d: [f64; 3] = std::array::from_fn(|k| f64::from(x[k]) - f64::from(r.origin[k]));
        let t: f64 = (0..3).map(|k| d[k] * f64::from(r.direction[k])).sum();
        (0..3).map(|k| (d[k] - t * f64::from(r.direction[k])).abs()).fold(0.0, f64::max)
    };
    let bad = s.points.iter().find(|x| off(x) > 1e-4);
    bad.map(|x| format!("a sample at {x:?} is {:.1e} beside the ray", off(x)))
}

/// Existing samples are kept.
fn adds(p: &dyn Projector) -> Option<String> {
    rays().iter().enumerate().find_map(|(i, r)| {
        let mut out = Samples { points: vec![[7.0; 3]; 3], weights: vec![9.0; 3] };
        p.sample(r, None, &mut out);
        let (alone, n) = (samples(p, r, None), 3);
        let kept = out.points[..n] == [[7.0; 3]; 3] && out.weights[..n] == [9.0; 3];
        let same = out.points[n..] == alone.points[..] && out.weights[n..] == alone.weights[..];
        (!(kept && same)).then(|| format!("ray {i}: what was there before changed, or what was added did"))
    })
}

fn repeatable(p: &dyn Projector) -> Option<String> {
    rays().iter().enumerate().find_map(|(i, r)| {
        [None, Some(5), Some(u64::MAX)].into_iter().find_map(|seed| {
            let (a, b) = (samples(p, r, seed), samples(p, r, seed));
            (a.points != b.points || a.weights != b.weights).then(|| format!("ray {i}, seed {seed:?}: two results"))
        })
    })
}

/// A ray that misses both the box and the published range has no samples and the line integral 0.
fn misses(p: &dyn Projector) -> Option<String> {
    let r = UnitRay { origin: [4.0; 3], inside: [0.0; 2], published: [0.0; 2], ..rays()[7] };
    let (s, most) = (samples(p, &r, None), p.max_samples(&r));
    let line = p.integrate(&s.weights, &vec![1.0; s.weights.len()]);
    (most > 0 || !s.points.is_empty() || line != 0.0)
        .then(|| format!("{} samples of at most {most}, line integral {line}", s.points.len()))
}

/// An attenuation of 1 gives the sampled length: that inside the box, or the published range.
fn constant(p: &dyn Projector, r: &UnitRay, s: &Samples) -> Option<String> {
    let line = p.integrate(&s.weights, &vec![1.0; s.weights.len()]);
    let lengths = [r.inside, r.published].map(|[a, b]| f64::from(b - a));
    let fits = lengths.iter().any(|l| (line - l).abs() <= 1e-3 * l);
    (!fits).then(|| format!("{line}, where the ray is {:.5} long inside, {:.5} in all", lengths[0], lengths[1]))
}

fn adjoint(p: &dyn Projector) -> Outcome {
    let mut draw = Draw::new(3, 1);
    let mut worst = 0.0f64;
    for r in rays() {
        let s = samples(p, &r, Some(1));
        let mu: Vec<f64> = draw.many(&(-1.0..1.0), s.weights.len());
        let y = draw.from(&(0.5..1.5));
        let mut back = vec![0.0; mu.len()];
        p.adjoint(&s.weights, y, &mut back);
        let left = p.integrate(&s.weights, &mu) * y;
        let right: f64 = back.iter().zip(&mu).map(|(b, m)| b * m).sum();
        let scale: f64 = back.iter().zip(&mu).map(|(b, m)| (b * m).abs()).sum::<f64>() + 1e-30;
        let e = (left - right).abs() / scale;
        worst = if e.is_nan() { f64::INFINITY } else { worst.max(e) };
    }
    held(worst <= ADJOINT, format!("<Aμ, y> and <μ, Aᵀy> differ by {worst:.1e}, limit {ADJOINT:.0e}"))
}

fn overwrites(p: &dyn Projector) -> Option<String> {
    let s = samples(p, &rays()[8], None);
    let [a, b] = [0.0, 5.0].map(|before| {
        let mut back = vec![before; s.weights.len()];
        p.adjoint(&s.weights, 0.7, &mut back);
        back
    });
    (a != b).then(|| "what was there before shows".into())
}

fn threads(p: &dyn Projector) -> Option<String> {
    let rays = rays();
    // Each thread begins with another ray.
    let run = |first: usize| -> Vec<(Vec<[f32; 3]>, Vec<f32>)> {
        let all = rays.iter().enumerate().cycle().skip(first).take(rays.len());
        let samples = all.map(|(i, r)| samples(p, r, Some(i as u64)));
        samples.map(|s| (s.points, s.weights)).collect()
    };
    beside_others(run, |a, b| (a != b).then(|| "another result beside other threads".into()))
}
