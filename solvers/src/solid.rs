//! Fits a solid cylinder to the views: one material with lighter parts inside, whose axis is parallel to z.
//!
//! A ray whose chord through the solid is t has the line integral `p(t) = μ·t − κ·t²`: μ is the attenuation of the
//! material, and κ ≥ 0 the curvature that beam hardening causes. Lighter parts only lower line integrals, so rays well
//! below the model are left out of the fit, and the others determine axis, radius, μ and κ by least squares
//! (Levenberg-Marquardt, with weights that limit the effect of stray rays). The first guess comes from the tangents of
//! the object's edges. The solid of a scan with a limited arc is as well determined as that of a full circle: every view
//! shows both its edges.

use crate::support::Blocks;
use conefield_core::geometry::{Ray, norm};
use conefield_core::matrix::{inner, inverse};
use conefield_core::parallel;
use conefield_core::scan::{Scan, ScanHeader, Unit};
use conefield_core::scene::SupportRule;
use conefield_core::support::Cylinder;

/// Most rays in the fit.
const RAYS: usize = 50_000;
/// Share of a high line integral that marks the edge of the object.
const EDGE: f64 = 0.25;
/// The next four constants are relative to that high line integral. Residuals above this count less than their square.
const STRAY: f64 = 0.01;
/// A ray further below the model passes through lighter parts.
const LIGHTER: f64 = 0.02;
/// A ray further above the model contradicts it.
const DENSER: f64 = 0.05;
/// Rays this close to the model confirm it.
const CLOSE: f64 = 0.02;
/// Line integrals along the diameter, relative to the high one, and the share of them that hardening takes.
const STARTS: [[f64; 2]; 6] = [[1.0, 0.0], [1.0, 0.15], [1.0, 0.3], [1.2, 0.0], [1.2, 0.15], [1.2, 0.3]];
/// Least share of the object's rays that confirm a solid.
const CONFIRMED: f64 = 0.08;
/// Least chord, relative to the diameter, that some of them have: what has only a thin wall is no solid.
const LONG: f64 = 0.5;
/// Least share of the rays through the rim that confirm a solid, and their chords relative to the diameter.
const RIM: f64 = 0.5;
const RIM_CHORDS: std::ops::Range<f64> = 0.1..0.4;
/// Largest share of the object's rays that contradict a solid.
const CONTRADICTED: f64 = 0.02;
/// Nine in ten edges deviate less from the first circle, relative to its radius.
const ROUND: f64 = 0.02;
/// Fewest views.
const VIEWS: usize = 3;

/// A solid cylinder; lengths in mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solid {
    /// Its axis and radius.
    pub cylinder: Cylinder,
    /// Attenuation μ of its material for short chords, 1/mm.
    pub attenuation: f64,
    /// Curvature κ of its line integrals, 1/mm².
    pub hardening: f64,
}

impl Solid {
    /// Replaces a line integral with μ times the chord that has it.
    pub fn linear(&self, p: f32) -> f32 {
        let (mu, p) = (self.attenuation, f64::from(p));
        if p <= 0.0 || self.hardening == 0.0 {
            return p as f32;
        }
        (2.0 * mu * p / (mu + (mu * mu - 4.0 * self.hardening * p).max(0.0).sqrt())) as f32
    }

    /// Corrects the views of a scan.
    pub fn linearize(&self, scan: &Scan) -> Scan {
        let mut scan = scan.clone();
        parallel::change_all(&mut scan.projections, |p| self.linear(p));
        scan
    }

    /// Description for the log, in the unit of a scan.
    pub(crate) fn describe(&self, unit: &Unit) -> String {
        let Self { cylinder: Cylinder { center, radius }, attenuation, hardening } = *self;
        let ([x, y], radius) = (center.map(|c| c / unit.mm), radius / unit.mm);
        let lost = 100.0 * 2.0 * hardening * self.cylinder.radius / attenuation;
        format!(
            "support: a solid cylinder with its axis at x = {x:.4}, y = {y:.4} and the radius {radius:.4} {0}; its \
             attenuation is {1:.5} 1/{0}, and beam hardening takes {lost:.1}% of the line integral along its diameter",
            unit.name,
            attenuation * unit.mm
        )
    }

    /// The line integral of a chord through the solid without lighter parts.
    fn model(&self, chord: f64) -> f64 {
        self.attenuation * chord - self.hardening * chord * chord
    }

    /// How far the line integral of a ray is above that of the solid without lighter parts.
    fn above(&self, m: &Measured) -> f64 {
        m.p - self.model(m.line.chord(&self.cylinder))
    }
}

/// Bytes of the corrected views; 0 if the rule does not look for a solid.
pub fn bytes(rule: &SupportRule, header: &ScanHeader) -> u64 {
    if rule.is_solid() { 4 * header.pixels() } else { 0 }
}

/// A ray with its line integral.
struct Measured {
    line: Line,
    p: f64,
}

/// A ray seen along z: the line `normal·(x, y) = offset`.
#[derive(Clone, Copy)]
struct Line {
    /// Unit vector.
    normal: [f64; 2],
    offset: f64,
    /// Length of the ray's direction in the plane of x and y.
    flat: f64,
}

impl Line {
    fn of(ray: &Ray) -> Self {
        let [dx, dy, _] = ray.direction;
        let flat = dx.hypot(dy);
        let normal = [-dy / flat, dx / flat];
        Self { normal, offset: normal[0] * ray.origin[0] + normal[1] * ray.origin[1], flat }
    }

    /// Its signed distance from the axis of a cylinder.
    fn distance(&self, Cylinder { center, .. }: &Cylinder) -> f64 {
        self.offset - self.normal[0] * center[0] - self.normal[1] * center[1]
    }

    /// Length of the ray inside a cylinder.
    fn chord(&self, cylinder: &Cylinder) -> f64 {
        2.0 * (cylinder.radius.powi(2) - self.distance(cylinder).powi(2)).max(0.0).sqrt() / self.flat
    }
}

/// Some rows of the views of a scan.
struct Rows<'a> {
    scan: &'a Scan,
    /// View and row.
    rows: Vec<(usize, usize)>,
    /// A line integral below which nine in ten of the object's are.
    high: f64,
}

impl<'a> Rows<'a> {
    fn of(scan: &'a Scan) -> Result<Self, String> {
        let g = &scan.geometry;
        let [rows, columns] = g.detector;
        let all = g.views.len() * rows;
        // Whole rows, so that edges are found; other rows in each view.
        let row = |i: usize| (i / rows, (i + i / rows) % rows);
        let step = (all * columns).div_ceil(RAYS).max(1);
        // A step that ends in the same row of every view is one row longer.
        let step = if rows > 2 && step % rows == rows - 1 { step + 1 } else { step };
        let rows: Vec<_> = (0..all).step_by(step).map(row).collect();
        let object = Blocks::of(scan, 1).object();
        let values = rows.iter().flat_map(|&(view, row)| scan.view(view).row(row).to_vec());
        let mut high: Vec<f32> = values.filter(|p| *p > object).collect();
        if high.is_empty() {
            return Err("the views show only air".into());
        }
        let k = high.len() * 9 / 10;
        let high = f64::from(*high.select_nth_unstable_by(k, f32::total_cmp).1);
        Ok(Self { scan, rows, high })
    }

    /// The rays at the first and the last pixel of the object in each row that shows both sides of it.
    fn edges(&self) -> Result<Vec<[Line; 2]>, String> {
        let (g, columns) = (&self.scan.geometry, self.scan.geometry.detector[1]);
        let mut shown = 0;
        let mut edges = vec![];
        for &(view, row) in &self.rows {
            let image = self.scan.view(view);
            let on = |c: &usize| f64::from(image[[row, *c]]) > EDGE * self.high;
            let Some((first, last)) = (0..columns).find(on).zip((0..columns).rev().find(on)) else { continue };
            shown += 1;
            if first > 0 && last + 1 < columns {
                edges.push([first, last].map(|c| Line::of(&g.ray(view, row, c))));
            }
        }
        let enough = g.views.len() >= VIEWS && edges.len() >= VIEWS && 10 * edges.len() >= 9 * shown;
        if enough { Ok(edges) } else { Err("too few views show both sides of the object".into()) }
    }

    fn measured(&self) -> Vec<Measured> {
        let (scan, columns) = (self.scan, self.scan.geometry.detector[1]);
        let of = |view: usize, row: usize, c: usize| {
            let ray = scan.geometry.ray(view, row, c);
            Measured { line: Line::of(&ray), p: f64::from(scan.view(view)[[row, c]]) }
        };
        self.rows.iter().flat_map(|&(view, row)| (0..columns).map(move |c| of(view, row, c))).collect()
    }
}

/// Fits a solid to the views of a scan.
///
/// # Errors
/// Why the views do not show one, in words.
pub fn fit(scan: &Scan) -> Result<Solid, String> {
    let rows = Rows::of(scan)?;
    let (high, circle) = (rows.high, circle(&rows.edges()?)?);
    let measured = rows.measured();
    let pixel = norm(scan.geometry.views[0].u);
    // Holes can hide the line integral of long chords, and the fit has several minima: it begins with some hardening and
    // more attenuation than the highest line integral shows.
    let starts = STARTS.map(|[more, lost]| {
        let attenuation = more * high / (2.0 * circle.radius * (1.0 - lost));
        Solid { cylinder: circle, attenuation, hardening: attenuation * lost / (2.0 * circle.radius) }
    });
    let judged = starts.map(|start| {
        let solid = refine(start, &measured, high, pixel);
        (solid, Verdict::of(&solid, &measured, high))
    });
    let best = judged.into_iter().max_by(|a, b| a.1.score().total_cmp(&b.1.score()));
    let (solid, Verdict { close, rim, long, denser }) = best.unwrap_or_else(|| unreachable!("there are starts"));
    let same = (solid.cylinder.radius / circle.radius - 1.0).abs() < 0.1;
    if same && close >= CONFIRMED && rim >= RIM && long >= LONG && denser <= CONTRADICTED {
        return Ok(solid);
    }
    let [close, rim, long, denser] = [close, rim, long, denser].map(|share| 100.0 * share);
    Err(format!(
        "{close:.0}% of the object's rays, and {rim:.0}% of those through its rim, fit a cylinder of one material, on \
         chords up to {long:.0}% of its diameter, and {denser:.1}% are denser"
    ))
}

/// How well rays through the object agree with a solid.
struct Verdict {
    /// Share of the rays that confirm it.
    close: f64,
    /// The same share of the rays through its rim. It is small where a dense core passes for the whole.
    rim: f64,
    /// The chord that one in twenty of the confirming rays exceeds, relative to the diameter.
    long: f64,
    /// Share of the rays that contradict it.
    denser: f64,
}

impl Verdict {
    /// What the best of several fits has most of.
    fn score(&self) -> f64 {
        self.close - 5.0 * self.denser
    }

    fn of(solid: &Solid, measured: &[Measured], high: f64) -> Self {
        let (mut all, mut denser, mut chords, mut rim) = (0, 0, vec![], [0, 0]);
        for m in measured {
            let e = solid.above(m);
            let is_close = e.abs() < CLOSE * high;
            // Seen along z, relative to the diameter.
            let chord = m.line.chord(&solid.cylinder) * m.line.flat / (2.0 * solid.cylinder.radius);
            // Rays above or below the object meet the cylinder too.
            if RIM_CHORDS.contains(&chord) && m.p > 0.5 * (m.p - e) {
                rim = [rim[0] + 1, rim[1] + usize::from(is_close)];
            }
            if m.p > EDGE * high {
                all += 1;
                denser += usize::from(e > DENSER * high);
                chords.extend(is_close.then_some(chord));
            }
        }
        let rim = rim[1] as f64 / rim[0].max(1) as f64;
        let share = |n: usize| n as f64 / all.max(1) as f64;
        let (close, k) = (share(chords.len()), chords.len() * 19 / 20);
        let long = if chords.is_empty() { 0.0 } else { *chords.select_nth_unstable_by(k, f64::total_cmp).1 };
        Self { close, rim, long, denser: share(denser) }
    }
}

/// The circle whose tangents the edges are, by least squares with less weight on stray edges.
fn circle(edges: &[[Line; 2]]) -> Result<Cylinder, String> {
    let unclear = || "the edges in the views are not those of a cylinder along z".to_string();
    // Each edge: normal·center + side·radius = offset.
    let tangents: Vec<([f64; 2], f64, f64)> = edges
        .iter()
        .flat_map(|[a, b]| {
            let side = if a.offset > b.offset { 1.0 } else { -1.0 };
            [(a.normal, side, a.offset), (b.normal, -side, b.offset)]
        })
        .collect();
    let mut weights = vec![1.0; tangents.len()];
    let mut found = [0.0; 3];
    let mut close = 0;
    for _ in 0..20 {
        let mut normal = [[0.0; 3]; 3];
        let mut right = [0.0; 3];
        for ((n, side, offset), w) in tangents.iter().zip(&weights) {
            let row = [n[0], n[1], *side];
            for i in 0..3 {
                right[i] += w * row[i] * offset;
                (0..3).for_each(|j| normal[i][j] += w * row[i] * row[j]);
            }
        }
        found = solve(normal, right).ok_or_else(unclear)?;
        let [x, y, radius] = found;
        let deviations: Vec<f64> =
            tangents.iter().map(|(n, side, offset)| (n[0] * x + n[1] * y + side * radius - offset).abs()).collect();
        close = deviations.iter().filter(|d| **d < ROUND * radius).count();
        let scale = 1e-3 * radius.abs();
        weights.iter_mut().zip(&deviations).for_each(|(w, d)| *w = 1.0 / (1.0 + (d / scale).powi(2)).sqrt());
    }
    let [x, y, radius] = found;
    let round = radius.is_finite() && radius > 0.0 && 10 * close >= 9 * tangents.len();
    if round { Ok(Cylinder { center: [x, y], radius }) } else { Err(unclear()) }
}

/// Levenberg-Marquardt on axis, radius, μ and κ. `high` is a high line integral, `pixel` the side of a pixel.
fn refine(start: Solid, measured: &[Measured], high: f64, pixel: f64) -> Solid {
    let weight = |e: f64| {
        if e < -LIGHTER * high { 0.0 } else { 1.0 / (1.0 + (e / (STRAY * high)).powi(2)).sqrt() }
    };
    let with = |solid: &Solid, step: [f64; 5]| Solid {
        cylinder: Cylinder {
            center: [solid.cylinder.center[0] + step[0], solid.cylinder.center[1] + step[1]],
            radius: (solid.cylinder.radius + step[2]).abs(),
        },
        attenuation: solid.attenuation + step[3],
        hardening: (solid.hardening + step[4]).max(0.0),
    };
    let mut solid = start;
    let mut damping = 1e-3;
    for _ in 0..60 {
        // Weights are those of the iteration's start, as in iteratively reweighted least squares.
        let weights = parallel::map(measured.chunks(4096), |_, part| {
            part.iter().map(|m| weight(solid.above(m))).collect::<Vec<f64>>()
        });
        let weights = weights.concat();
        let cost = |solid: &Solid| {
            let one = |(m, w): (&Measured, &f64)| [w * solid.above(m).powi(2)];
            sums(measured, &weights, one)[0]
        };
        // The upper triangle of the normal equations, and their right side.
        let found: [f64; 20] = sums(measured, &weights, |(m, w)| {
            let row = slope(&solid, m, pixel);
            let e = solid.above(m);
            let entry = |(i, j): (usize, usize)| w * row[i] * if j < 5 { row[j] } else { e };
            std::array::from_fn(|k| entry(ENTRIES[k]))
        });
        let (mut normal, mut right) = ([[0.0; 5]; 5], [0.0; 5]);
        for (x, (i, j)) in found.into_iter().zip(ENTRIES) {
            if j < 5 {
                (normal[i][j], normal[j][i]) = (x, x);
            } else {
                right[i] = x;
            }
        }
        let now = cost(&solid);
        let mut better = None;
        for _ in 0..8 {
            let mut damped = normal;
            (0..5).for_each(|k| damped[k][k] *= 1.0 + damping);
            let next = solve(damped, right).map(|step| with(&solid, step));
            match next.filter(|next| cost(next) < now) {
                Some(next) => {
                    better = Some(next);
                    damping *= 0.3;
                    break;
                }
                None => damping *= 4.0,
            }
        }
        let Some(next) = better else { break };
        let change = (next.cylinder.radius - solid.cylinder.radius).abs() / solid.cylinder.radius
            + (next.attenuation - solid.attenuation).abs() / solid.attenuation;
        solid = next;
        if change < 1e-7 {
            break;
        }
    }
    solid
}

/// Row and column of the numbers of five normal equations; column 5 is the right side.
const ENTRIES: [(usize, usize); 20] = {
    let (mut entries, mut k, mut i) = ([(0, 0); 20], 0, 0);
    while i < 5 {
        let mut j = i;
        while j < 6 {
            entries[k] = (i, j);
            (k, j) = (k + 1, j + 1);
        }
        i += 1;
    }
    entries
};

/// Sums over all rays, in an order that does not depend on threads.
fn sums<const N: usize>(
    measured: &[Measured],
    weights: &[f64],
    of: impl Fn((&Measured, &f64)) -> [f64; N] + Sync,
) -> [f64; N] {
    let add = |mut a: [f64; N], b: [f64; N]| {
        a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        a
    };
    let part = |(m, w): (&[Measured], &[f64])| m.iter().zip(w).map(&of).fold([0.0; N], add);
    let parts: Vec<_> = parallel::map(measured.chunks(4096).zip(weights.chunks(4096)), |_, both| part(both));
    parts.into_iter().fold([0.0; N], add)
}

/// Derivatives of the model with respect to axis, radius, μ and κ. At the edge, where the chord's derivative has no
/// bound, it is that a quarter of a pixel inside.
fn slope(solid: &Solid, at: &Measured, pixel: f64) -> [f64; 5] {
    let Solid { cylinder, attenuation, hardening } = *solid;
    let (radius, Line { normal: n, flat, .. }) = (cylinder.radius, at.line);
    let (r, chord) = (at.line.distance(&cylinder), at.line.chord(&cylinder));
    let square = radius * radius - r * r;
    if square <= 0.0 {
        return [0.0; 5];
    }
    let half = square.max(0.5 * radius * pixel).sqrt();
    let by_chord = attenuation - 2.0 * hardening * chord;
    let by_r = by_chord * 2.0 / (flat * half);
    [by_r * r * n[0], by_r * r * n[1], by_r * radius, chord, -chord * chord]
}

/// Solves normal equations; `None` if they are singular.
fn solve<const N: usize>(normal: [[f64; N]; N], right: [f64; N]) -> Option<[f64; N]> {
    // Unknowns of different units: scaled to a diagonal of 1.
    let scale: [f64; N] = std::array::from_fn(|k| normal[k][k].sqrt());
    if scale.iter().any(|s| !(s.is_finite() && *s > 0.0)) {
        return None;
    }
    let scaled = (0..N).map(|i| (0..N).map(|j| normal[i][j] / (scale[i] * scale[j])).collect()).collect();
    let inverse = inverse(scaled)?;
    let right: [f64; N] = std::array::from_fn(|k| right[k] / scale[k]);
    Some(std::array::from_fn(|k| inner(&inverse[k], &right) / scale[k]))
}
