//! A front file: Pareto-optimal methods in time, memory and accuracy, with their cost and accuracy on tuning scans.
//! `conefield tradeoff` creates it, `conefield reconstruct --budget` selects from it.

use crate::shipped::FRONT;
use crate::tradeoff::statistics::mean;
use conefield_core::error::{Result, ensure};
use conefield_core::method::Plan;
use conefield_core::written;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Longest front file, in bytes.
const LONGEST: u64 = 4 << 20;
/// A scan counts as near if its size ratio is at most this many times that of the nearest scan.
const NEAR: f64 = 2.0;

/// The unknowns of a method. The two kinds are searched separately: fields need longer before they show their quality.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Unknowns {
    /// It trains a field.
    Field,
    /// It makes voxels.
    Voxels,
}

impl Unknowns {
    /// The unknowns of a method. A chain with a field trains a field.
    pub fn of(plan: &dyn Plan) -> Self {
        if plan.pipeline().is_some() { Self::Field } else { Self::Voxels }
    }

    /// The name of its steps.
    pub fn step(self) -> &'static str {
        match self {
            Self::Field => "step",
            Self::Voxels => "pass",
        }
    }
}

/// A whole front.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Front {
    /// Program and device with which it was made.
    pub made: String,
    /// Time of a pass of the [standard reconstruction](crate::tradeoff::speed) on that machine, in seconds: a measure of its
    /// speed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pass_s: Option<f64>,
    /// The scans on which it was measured.
    pub scans: Vec<Tuned>,
    /// Its points.
    pub points: Vec<Point>,
}

/// A scan on which a front was measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tuned {
    /// The name of its file or folder.
    pub name: String,
    /// Number of views.
    pub views: usize,
    /// Rows and columns of the detector.
    pub detector: [usize; 2],
    /// Shape of the volume.
    pub volume: [usize; 3],
}

impl Tuned {
    fn size(&self) -> Size {
        Size::new(self.views, self.detector, self.volume)
    }
}

/// A method with its cost and accuracy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Point {
    /// Its name.
    pub name: String,
    /// Its unknowns.
    pub kind: Unknowns,
    /// The base spec.
    pub spec: String,
    /// Changes to the spec, as in `--set`.
    #[serde(default)]
    pub sets: Vec<String>,
    /// The budget of the measurement.
    pub budget_s: f64,
    /// One run per scan of the front, in the same order.
    pub runs: Vec<Reached>,
}

/// A point's run on one scan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reached {
    /// Its cost in steps or passes. Multiplied by the duration of one step on any machine, it gives the time there.
    pub steps: u64,
    /// Time for all steps in seconds.
    pub train_s: f64,
    /// Time of the whole run in seconds.
    pub total_s: f64,
    /// Part of `total_s` that is not spent on steps, reading or scoring.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beside_s: Option<f64>,
    /// Peak memory.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_bytes: Option<u64>,
    /// PSNR in dB, if there was a reference.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub psnr: Option<f64>,
    /// Mean SSIM over slices, if there was a reference.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ssim_2d: Option<f64>,
    /// Error of held-out views, relative to the largest line integral.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out: Option<f64>,
}

/// Size of a scan.
#[derive(Debug, Clone, Copy)]
pub struct Size {
    /// Pixels of all views.
    pub pixels: f64,
    /// Voxels of the volume.
    pub voxels: f64,
}

impl Size {
    /// The size for this many views of a detector with these rows and columns, and a volume of this shape.
    pub fn new(views: usize, detector: [usize; 2], volume: [usize; 3]) -> Self {
        let product = |n: &[usize]| n.iter().map(|n| *n as f64).product();
        Self { pixels: views as f64 * product(&detector), voxels: product(&volume) }
    }

    /// The relative cost of a projection: every pixel's ray traverses the volume.
    fn projecting(self) -> f64 {
        self.pixels * self.voxels.cbrt()
    }
}

/// Expected cost of a point for a scan, on the machine of the front.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Expected {
    /// Steps or passes.
    pub steps: f64,
    /// Seconds per step or pass.
    pub step_s: f64,
    /// Seconds of everything else.
    pub beside_s: f64,
}

impl Front {
    /// The built-in front.
    pub fn shipped() -> Result<Self> {
        Self::parse(FRONT, "front.toml (shipped)")
    }

    /// Reads a front file.
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(&conefield_core::files::read_text(path, LONGEST)?, &path.display().to_string())
    }

    fn parse(text: &str, place: &str) -> Result<Self> {
        let front: Self = written::read(place, text)?;
        ensure(!front.scans.is_empty(), place, "scans", "none", "the scans that it was measured on")?;
        ensure(!front.points.is_empty(), place, "points", "none", "at least one method")?;
        for scan in &front.scans {
            let empty = scan.views == 0 || scan.detector.contains(&0) || scan.volume.contains(&0);
            ensure(!empty, place, &format!("scans: {}", scan.name), "a size of 0", "views, pixels and voxels")?;
        }
        if let Some(pass_s) = front.pass_s {
            let good = pass_s.is_finite() && pass_s > 0.0;
            ensure(good, place, "pass_s", pass_s, "a positive number of seconds")?;
        }
        for (i, point) in front.points.iter().enumerate() {
            let field = |what: &str| format!("points[{i}].{what}");
            let (found, want) = (point.runs.len(), front.scans.len());
            ensure(found == want, place, &field("runs"), format!("{found}"), format!("{want}, one per scan"))?;
            for run in &point.runs {
                let times = [point.budget_s, run.train_s, run.total_s, run.beside_s.unwrap_or(0.0)];
                let good = times.iter().all(|t| t.is_finite() && *t >= 0.0) && run.steps > 0;
                ensure(good, place, &field("runs"), format!("{run:?}"), "steps, and seconds that are 0 or more")?;
                let scored = [run.psnr, run.held_out].iter().flatten().any(|x| x.is_finite());
                ensure(scored, place, &field("runs"), format!("{run:?}"), "a finite psnr or held_out")?;
            }
        }
        Ok(front)
    }

    /// The front restricted to the scans whose volumes are closest in size, because the best methods depend on it.
    pub fn near(&self, size: Size) -> Self {
        let apart = |scan: &Tuned| (scan.size().voxels / size.voxels).ln().abs();
        let least = self.scans.iter().map(apart).fold(f64::INFINITY, f64::min);
        let kept: Vec<bool> = self.scans.iter().map(|scan| apart(scan) < least + NEAR.ln()).collect();
        let chosen = |i: &usize| kept[*i];
        let mut near = self.clone();
        near.scans = (0..kept.len()).filter(chosen).map(|i| self.scans[i].clone()).collect();
        for (point, all) in near.points.iter_mut().zip(&self.points) {
            point.runs = (0..kept.len()).filter(chosen).map(|i| all.runs[i].clone()).collect();
        }
        near
    }

    /// Whether one of its scans is about as large as `size`. The front then predicts the cost of methods from the
    /// speeds of both machines.
    pub fn close(&self, size: Size) -> bool {
        let within = |a: f64, b: f64| (a / b).ln().abs() < NEAR.ln();
        self.sizes().any(|then| within(then.pixels, size.pixels) && within(then.voxels, size.voxels))
    }

    /// Whether all of its scans are larger than `size`: a method then takes less time than on them.
    pub fn larger(&self, size: Size) -> bool {
        self.sizes().all(|then| then.pixels > size.pixels && then.voxels > size.voxels)
    }

    fn sizes(&self) -> impl Iterator<Item = Size> {
        self.scans.iter().map(Tuned::size)
    }

    /// The cost of `point` on the smallest of the scans.
    pub fn least(&self, point: &Point) -> Expected {
        let sizes: Vec<Size> = self.sizes().collect();
        let costs = sizes.iter().map(|size| self.expected(point, *size));
        let whole = |e: &Expected| e.steps * e.step_s + e.beside_s;
        costs.min_by(|a, b| whole(a).total_cmp(&whole(b))).unwrap_or_default()
    }

    /// The expected cost of `point` for a scan of this size. A step of a field costs the same for every scan.
    pub fn expected(&self, point: &Point, size: Size) -> Expected {
        let mut sum = Expected::default();
        let n = point.runs.len() as f64;
        for (run, scan) in point.runs.iter().zip(&self.scans) {
            let then = scan.size();
            let larger = match point.kind {
                Unknowns::Field => 1.0,
                Unknowns::Voxels => size.projecting() / then.projecting(),
            };
            sum.steps += run.steps as f64 / n;
            sum.step_s += run.train_s / run.steps as f64 * larger / n;
            let beside = run.beside_s.unwrap_or(run.total_s - run.train_s);
            sum.beside_s += beside.max(0.0) * size.voxels / then.voxels / n;
        }
        sum
    }
}

impl Point {
    /// Accuracy, higher is better: the mean PSNR in dB or, without a reference, the negative error of held-out views.
    pub fn accuracy(&self) -> f64 {
        let mean = |of: fn(&Reached) -> Option<f64>| mean(self.runs.iter().map(of));
        mean(|r| r.psnr).or_else(|| mean(|r| r.held_out).map(|e| -e)).unwrap_or(f64::NEG_INFINITY)
    }

    /// Its scores as text.
    pub fn scores(&self, front: &Front) -> String {
        let one = |(run, scan): (&Reached, &Tuned)| match (run.psnr, run.held_out) {
            (Some(psnr), _) => format!("{psnr:.2} dB on {}", scan.name),
            (None, error) => format!("held-out error {:.4} on {}", error.unwrap_or(f64::NAN), scan.name),
        };
        self.runs.iter().zip(&front.scans).map(one).collect::<Vec<_>>().join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_of_near_scans_counts() {
        let scan = |name: &str, n: usize| {
            format!("[[scans]]\nname = \"{name}\"\nviews = 10\ndetector = [10, 10]\nvolume = [{n}, {n}, {n}]\n")
        };
        let run = |psnr: f64| format!("[[points.runs]]\nsteps = 4\ntrain_s = 2.0\ntotal_s = 3.0\npsnr = {psnr}\n");
        let text = format!(
            "made = \"test\"\n{}{}{}[[points]]\nname = \"p\"\nkind = \"voxels\"\nspec = \"fdk\"\nbudget_s = 9.0\n{}{}{}",
            scan("small", 16),
            scan("large", 64),
            scan("other", 72),
            run(20.0),
            run(30.0),
            run(32.0)
        );
        let front = Front::parse(&text, "a").unwrap();
        let accuracy = |n: usize| front.near(Size::new(10, [10, 10], [n; 3])).points[0].accuracy();
        assert_eq!([accuracy(8), accuracy(16), accuracy(68), accuracy(512)], [20.0, 20.0, 31.0, 31.0]);
        let close = |views: usize, n: usize| front.close(Size::new(views, [10, 10], [n; 3]));
        assert_eq!([close(10, 16), close(15, 70), close(30, 16), close(10, 32)], [true, true, false, false]);
        let larger = |views: usize, n: usize| front.larger(Size::new(views, [10, 10], [n; 3]));
        assert_eq!([larger(9, 15), larger(10, 15), larger(9, 20)], [true, false, false]);
    }

    #[test]
    fn a_scan_of_another_size_costs_voxels_in_proportion_and_fields_nothing_more() {
        let text = |kind: &str| {
            format!(
                "made = \"test\"\n[[scans]]\nname = \"a\"\nviews = 10\ndetector = [10, 10]\nvolume = [10, 10, 10]\n\
                 [[points]]\nname = \"p\"\nkind = \"{kind}\"\nspec = \"fdk\"\nbudget_s = 9.0\n\
                 [[points.runs]]\nsteps = 4\ntrain_s = 2.0\ntotal_s = 3.0\npsnr = 30.0\n"
            )
        };
        let size = Size::new(20, [10, 10], [20, 20, 20]);
        for (kind, step_s) in [("voxels", 2.0), ("field", 0.5)] {
            let front = Front::parse(&text(kind), "a").unwrap();
            let want = Expected { steps: 4.0, step_s, beside_s: 8.0 };
            assert_eq!(front.expected(&front.points[0], size), want);
        }
        for (from, to, says) in [
            ("psnr = 30.0", "psnr = nan", "psnr: found nan"),
            ("made = \"test\"", "made = \"test\"\npass_s = 0", "pass_s"),
            ("psnr = 30.0", "psnr = 30.0\nbeside_s = -1.0", "points[0].runs"),
            ("kind", "kinds", "a:9:1: points.0.kinds: found a key that is not known here"),
            ("views = 10", "views = 0", "scans: a"),
            (
                "[[points.runs]]",
                "[[points.runs]]\nsteps = 4\ntrain_s = 2.0\ntotal_s = 3.0\npsnr = 1\n[[points.runs]]",
                "one per scan",
            ),
        ] {
            let text = text("field").replace(from, to);
            let e = Front::parse(&text, "a").unwrap_err().to_string();
            assert!(e.contains(says), "{e}");
        }
    }
}
