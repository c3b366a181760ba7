//! Scans at the edge: units, objects, photons, views, sizes, distances. A field and the classical solvers meet each.

use crate::case::{Case, Seen};
use crate::common::{neural_field, protocol, scan, solve, truth, volume};
use conefield_core::error::Result;
use conefield_core::scan::{Scan, Volume};
use conefield_io::{Conversion, OpenBeam};
use conefield_projectors::simulate::simulate;
use conefield_scans::counts::line_integrals;
use ndarray::Array3;
use serde_json::{Value, json};

/// A small field.
pub fn field() -> Value {
    let projector = json!({"type": "ray-march", "samples": 20, "sampling": "uniform"});
    let training = json!({"steps": 300, "rays": 64});
    neural_field(12, json!({"projector": projector, "training": training, "optimizer": {"lr": 0.01}}))
}

/// Solvers of voxels, with few passes.
const CLASSICAL: [&str; 7] = ["fdk", "sart", "os-sart", "sirt", "cgls", "asd-pocs", "fista-tv"];

fn method(name: &str) -> Value {
    match name {
        "field" => field(),
        "fdk" => json!({"type": "fdk"}),
        "os-sart" => json!({"type": "sart", "subsets": 10, "relaxation": 1.0, "stop": {"passes": 5}}),
        "sirt" => {
            json!({"type": "sart", "subsets": 1, "relaxation": 1.9, "decay": 1.0, "stop": {"passes": 5}})
        }
        "fista-tv" => json!({"type": "fista", "prior": {"type": "total-variation"}, "stop": {"passes": 5}}),
        _ => json!({"type": name, "stop": {"passes": 5}}),
    }
}

/// A volume with every number finite, and times that training went back.
fn made(method: &Value, scan: &Scan) -> Result<(Volume, u64)> {
    let (solution, _) = solve(method, scan)?;
    let volume = solution.result.volume(&conefield_backend_cpu::Cpu::new())?;
    Ok((volume, solution.rollbacks))
}

fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (n, sum) = values.fold((0.0, 0.0), |(n, s), x| (n + 1.0, s + x * x));
    (sum / f64::max(n, 1.0)).sqrt()
}

/// Error of `found·scale` over what an empty volume has, both in root mean square.
fn error(found: &Volume, truth: &Volume, scale: f64) -> f64 {
    let pairs = found.data.iter().zip(&truth.data);
    let off = rms(pairs.map(|(a, b)| f64::from(*a) * scale - f64::from(*b)));
    off / rms(truth.data.iter().map(|x| f64::from(*x)))
}

fn psnr(found: &Volume, truth: &Volume, scale: f64) -> f64 {
    let peak = truth.data.iter().copied().fold(0.0f32, f32::max);
    let pairs = found.data.iter().zip(&truth.data);
    20.0 * (f64::from(peak) / rms(pairs.map(|(a, b)| f64::from(*a) * scale - f64::from(*b)))).log10()
}

/// Refused, or a finite volume with an error of at most `limit` times what an empty volume has.
fn seen(name: &str, scan: &Scan, truth: &Volume, limit: f64) -> Result<Seen> {
    let (volume, rollbacks) = made(&method(name), scan)?;
    let e = error(&volume, truth, 1.0);
    let finite = volume.data.iter().all(|x| x.is_finite());
    let wrong = (!finite || e.is_nan() || e > limit).then(|| format!("error {e:.3}, finite {finite}"));
    let worse = e >= 1.0 && truth.data.iter().any(|x| *x != 0.0);
    Ok(Seen { figure: format!("{:.2} dB", psnr(&volume, truth, 1.0)), wrong, rollbacks, worse, ..Seen::default() })
}

/// A case for each of `methods`; `limit` is of the error over that of an empty volume.
fn each(
    what: &str,
    methods: &[&'static str],
    limit: f64,
    make: impl Fn() -> Result<(Scan, Volume)> + Clone + Send + 'static,
) -> Vec<Case> {
    let of = |name: &'static str| {
        let make = make.clone();
        let expected = match limit {
            l if l <= 1.0 => "nearer to the object than nothing is",
            _ => "finite, of the object's order",
        };
        Case::right(format!("{what}: {name}"), expected, move || {
            let (scan, truth) = make()?;
            seen(name, &scan, &truth, limit)
        })
    };
    methods.iter().map(|&m| of(m)).collect()
}

fn of_truth(change: Value) -> impl Fn() -> Result<(Scan, Volume)> + Clone + Send {
    move || Ok((simulate(&truth(), &protocol(change.clone()))?, truth()))
}

/// Every length and every attenuation times these, in a unit of so many millimetres.
const SCALES: [[f64; 3]; 10] = [
    [1.0, 1e-12, 1.0],
    [1.0, 1e-6, 1.0],
    [1.0, 1e6, 1.0],
    [1.0, 1e12, 1.0],
    [1e-6, 1.0, 1.0],
    [1e-3, 1.0, 1e-3],
    [1e3, 1.0, 1e3],
    [1e6, 1.0, 1.0],
    [1e6, 1e-12, 1.0],
    [1e-6, 1e12, 1e3],
];

pub fn units() -> Vec<Case> {
    let case = |name: &'static str| {
        let what = format!("attenuation × 1e-12 to 1e12, lengths × 1e-6 to 1e6: {name}");
        Case::right(what, "the same volume to 1e-3 dB", move || {
            let base = scan();
            let expected = psnr(&made(&method(name), &base)?.0, &truth(), 1.0);
            let mut worst = (0.0f64, String::new());
            for [lengths, attenuation, unit] in SCALES {
                let mut other = base.clone();
                other.geometry = base.geometry.scaled(lengths);
                other.unit.mm = unit;
                other.projections.mapv_inplace(|a| (f64::from(a) * attenuation) as f32);
                let (volume, _) = made(&method(name), &other)?;
                // Line integrals × a over lengths × l make a/l in 1/mm, and u times as much in 1/unit.
                let found = psnr(&volume, &truth(), lengths / (attenuation * unit));
                let fits = found.is_finite() && volume.grid.spacing == other.geometry.volume.spacing;
                let off = if fits { (found - expected).abs() } else { f64::INFINITY };
                if off > worst.0 {
                    worst = (off, format!("lengths × {lengths:e}, attenuation × {attenuation:e}, unit {unit:e} mm"));
                }
            }
            let wrong = (worst.0 > 1e-3).then(|| format!("{} dB at {}", worst.0, worst.1));
            let figure = format!("at most {:.1e} dB apart", worst.0);
            Ok(Seen { figure, reference: format!("{expected:.2} dB"), wrong, ..Seen::default() })
        })
    };
    ["field"].into_iter().chain(CLASSICAL).map(case).collect()
}

/// The object with one piece a hundred times as dense.
fn with_metal() -> Volume {
    let mut v = truth();
    v.data.slice_mut(ndarray::s![9..11, 7..9, 7..9]).fill(1.0);
    v
}

pub fn objects() -> Vec<Case> {
    let metal = || Ok((simulate(&with_metal(), &protocol(json!({})))?, with_metal()));
    let mut all = each("metal of 100 times the rest", &["sart", "cgls", "asd-pocs", "fista-tv"], 1.0, metal);
    // The absolute difference leaves what few rays see to the end; FDK has streaks.
    all.extend(each("metal of 100 times the rest", &["field", "fdk"], 3.0, metal));
    let words: [&[&str]; 2] = [&["no positive line integral"], &["a finite line integral"]];
    for (what, value, words) in [("nothing but air", 0.0, words[0]), ("one pixel is NaN", f32::NAN, words[1])] {
        all.push(Case::refused(format!("{what}: field"), words, move || {
            let mut s = scan();
            if value == 0.0 {
                s.projections.fill(0.0);
            }
            s.projections[[3, 4, 5]] = value;
            seen("field", &s, &truth(), 1.0)
        }));
    }
    for name in CLASSICAL {
        all.push(Case::right(format!("nothing but air: {name}"), "an empty volume", move || {
            let mut s = scan();
            s.projections.fill(0.0);
            let (volume, _) = made(&method(name), &s)?;
            let wrong = volume.data.iter().any(|x| *x != 0.0).then(|| "it is not empty".to_owned());
            Ok(Seen { wrong, ..Seen::default() })
        }));
        all.push(Case::refused(format!("one pixel is NaN: {name}"), &["projections[3, 4, 5]", "NaN"], move || {
            let mut s = scan();
            s.projections[[3, 4, 5]] = f32::NAN;
            seen(name, &s, &truth(), 1.0)
        }));
    }
    all
}

pub fn photons() -> Vec<Case> {
    let mut all = vec![];
    for i0 in ["1e2", "1e4", "1e7"] {
        let noise = format!("poisson:{i0}");
        let some = of_truth(json!({"noise": noise}));
        all.extend(each(&format!("{i0} photons a pixel"), &["field", "sart", "fista-tv"], 1.0, some.clone()));
        all.extend(each(&format!("{i0} photons a pixel"), &["fdk"], 3.0, some));
    }
    let starved = || Ok((simulate(&with_metal(), &protocol(json!({"noise": "poisson:1e2"})))?, with_metal()));
    all.extend(each("no photon comes through the metal", &["field", "fdk", "sart", "cgls", "fista-tv"], 3.0, starved));
    let counts = |lit: usize| {
        // The first `lit` of 16 columns count; behind the rest nothing arrives.
        let counts = Array3::from_shape_fn((4, 16, 16), |(.., c)| if c < lit { 900.0 } else { 0.0 });
        let correction = Conversion { open: OpenBeam::Number(1000.0), dark: None, floor: None };
        line_integrals(counts, &correction, "counts")
    };
    all.push(Case::right("counts of 0 in 7 of 16 columns", "clamped to the floor, finite", move || {
        let (lines, report) = counts(9)?;
        let wrong = lines.iter().any(|x| !x.is_finite()).then(|| "a line integral is not finite".to_owned());
        let top = lines.iter().copied().fold(0.0f32, f32::max);
        let figure = format!("{:.0} % clamped, line integrals up to {top:.2}", 100.0 * report.clamped);
        Ok(Seen { figure, reference: "ln(1000) = 6.91".into(), wrong, ..Seen::default() })
    }));
    all.push(Case::refused("counts of 0 everywhere", &["expected light in most pixels"], move || {
        counts(0).map(|_| Seen::default())
    }));
    all
}

pub fn views() -> Vec<Case> {
    let even = |views: usize, arc: f64| of_truth(json!({"angles": {"even": {"views": views, "arc_deg": arc}}}));
    let mut all = vec![];
    for views in [1, 2, 3, 1000] {
        let what = if views == 1 { "1 view".to_owned() } else { format!("{views} views") };
        all.extend(each(&what, &["field", "sart", "cgls", "asd-pocs", "fista-tv"], 1.0, even(views, 360.0)));
        all.extend(each(&what, &["fdk"], 3.0, even(views, 360.0)));
    }
    let same = of_truth(json!({"angles": {"list_deg": vec![30.0; 8]}}));
    all.extend(each("8 views at one angle", &["field", "sart", "cgls", "asd-pocs", "fista-tv"], 1.0, same.clone()));
    all.extend(each("8 views at one angle", &["fdk"], 3.0, same));
    let narrow = even(8, 1.0);
    all.extend(each("8 views over 1°", &["field", "sart", "cgls", "asd-pocs", "fista-tv"], 1.0, narrow.clone()));
    all.extend(each("8 views over 1°", &["fdk"], 3.0, narrow));
    all
}

/// A disc of one slice, or one voxel.
fn flat(shape: [usize; 3]) -> Volume {
    let radius = shape[0] as f32 / 3.0;
    let data = Array3::from_shape_fn(shape, |(x, y, _)| {
        let d = [x, y].map(|i| i as f32 - (shape[0] as f32 - 1.0) / 2.0);
        if d[0].hypot(d[1]) <= radius { 0.01 } else { 0.0 }
    });
    Volume::centered(data, [160.0 / shape[0] as f64, 160.0 / shape[1] as f64, 160.0 / shape[0] as f64])
}

pub fn sizes() -> Vec<Case> {
    let mut all = vec![];
    for detector in [[1, 1], [1, 4096], [4096, 1]] {
        let what = format!("detector of {} × {}", detector[0], detector[1]);
        let some = of_truth(json!({"detector": detector}));
        all.extend(each(&what, &["field", "fdk", "sart", "cgls", "fista-tv"], 3.0, some));
    }
    for shape in [[1, 1, 1], [512, 512, 1]] {
        let what = format!("volume of {} × {} × {}", shape[0], shape[1], shape[2]);
        // An odd number of rows, so that rays go through a thin slice.
        let detector = json!({"detector": [15, 64]});
        let some = move || Ok((simulate(&flat(shape), &protocol(detector.clone()))?, flat(shape)));
        all.extend(each(&what, &["field", "sart", "cgls", "fista-tv"], 1.0, some.clone()));
        all.extend(each(&what, &["fdk"], 3.0, some));
    }
    all
}

pub fn distances() -> Vec<Case> {
    let mut all = vec![];
    let near = of_truth(json!({"dso": 80.01, "dsd": 400.0, "angles": {"list_deg": [0.0, 90.0, 180.0, 270.0]}}));
    all.extend(each("source 0.01 mm before the volume", &["sart", "cgls", "fista-tv"], 1.0, near.clone()));
    all.extend(each("source 0.01 mm before the volume", &["field", "fdk"], 10.0, near));
    for name in CLASSICAL.into_iter().filter(|n| *n != "fdk").chain(["field"]) {
        let words: &[&str] = if name == "field" { &["no ray that meets the volume"] } else { &["rays that all miss"] };
        all.push(Case::refused(format!("every ray misses the volume: {name}"), words, move || {
            let mut s = scan();
            s.geometry.volume.center = [0.0, 0.0, 5e3];
            seen(name, &s, &truth(), 1.0)
        }));
    }
    for name in ["field", "fdk", "sart"] {
        all.push(Case::refused(
            format!("source inside the volume: {name}"),
            &["views[0]", "inside the volume"],
            move || {
                let mut s = scan();
                s.geometry.views[0].source = [79.0, 0.0, 0.0];
                seen(name, &s, &truth(), 1.0)
            },
        ));
    }
    for (what, dso, dsd, side) in [("1.001", 1e5, 1.001e5, 190.0), ("50", 150.0, 7500.0, 20_000.0)] {
        let some = of_truth(json!({"dso": dso, "dsd": dsd, "extent": {"side": [side, side]}}));
        all.extend(each(&format!("magnification {what}"), &["field", "fdk", "sart", "fista-tv"], 1.0, some));
    }
    all
}

/// The result of a small field with one setting changed, for the cases of stages and training.
pub fn with(set: impl FnOnce(&mut Value)) -> Result<Seen> {
    let mut value = field();
    set(&mut value);
    let (solution, records) = solve(&value, &scan())?;
    let found = volume(&solution);
    let loss = records.last().and_then(|r| r.loss).unwrap_or(f64::NAN);
    let e = error(&found, &truth(), 1.0);
    let wrong = (!loss.is_finite() || e.is_nan()).then(|| format!("loss {loss}, error {e}"));
    let reference = records.first().and_then(|r| r.loss).map(|l| format!("first loss {l:.2e}")).unwrap_or_default();
    let figure = format!("{:.2} dB, loss {loss:.2e}", psnr(&found, &truth(), 1.0));
    let warned = records.iter().flat_map(|r| &r.events).any(|e| e.contains("no better than an empty volume"));
    Ok(Seen { figure, reference, wrong, rollbacks: solution.rollbacks, warned, worse: e >= 1.0 })
}
