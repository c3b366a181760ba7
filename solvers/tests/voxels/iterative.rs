//! Every iterative method on a small scan in closed form: its accuracy, its end, and that its bits depend on the job
//! only.

use crate::kit::{Case, Heard, bodies, geometry, mean, method as spec, psnr, view, volume};
use conefield_core::Error;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::method::Limits;
use conefield_core::random::{mix, unit};
use conefield_core::scan::{Scan, Volume};
use conefield_projectors::simulate::{ellipsoids, scan_ellipsoids};
use std::sync::Arc;

/// Types with settings that suit 24 views.
const ALL: [(&str, &str); 12] = [
    ("sart", ""),
    ("os-sart", "subsets = 6"),
    ("sirt", ""),
    ("mlem", "subsets = 6"),
    ("cgls", ""),
    ("lsqr", ""),
    ("lsqr", "pull = 0.01"),
    ("asd-pocs", "subsets = 6"),
    ("fista-tv", "subsets = 6\nprior.weight = { fixed = 0.1 }"),
    ("fista", "subsets = 6\nprior = { type = \"directional-total-variation\", weight = { fixed = 0.1 } }"),
    ("fista", SUM),
    ("fista", "subsets = 6\nprior = { type = \"patches\", weight = { fixed = 0.1 } }"),
];

/// A sum of two priors, one of which adapts.
const SUM: &str = "subsets = 6
prior = { type = \"sum\", turns = 2, priors = [\
{ type = \"total-variation\", weight = { fixed = 0.05 }, weights = [1.0, 0.0, 0.0] }, \
{ type = \"directional-total-variation\", weight = { fixed = 0.05 } }] }";

fn passes(n: u64) -> String {
    format!("stop = {{ passes = {n} }}")
}

fn scan() -> Scan {
    scan_ellipsoids(&bodies(), geometry(24))
}

fn truth() -> Volume {
    ellipsoids(&bodies(), &geometry(24).volume)
}

/// The scan with noise of 5 % of its largest value.
fn noisy() -> Scan {
    with_noise(scan())
}

fn with_noise(mut scan: Scan) -> Scan {
    let top = scan.projections.iter().fold(0.0f32, |m, &x| m.max(x));
    let mut i = 0;
    scan.projections.mapv_inplace(|p| {
        i += 1;
        p + 0.05 * top * 3f32.sqrt() * (2.0 * unit(mix(9, i)) - 1.0)
    });
    scan
}

fn same_bits(a: &Volume, b: &Volume, what: &str) {
    let differ = a.data.iter().zip(&b.data).filter(|(a, b)| a.to_bits() != b.to_bits()).count();
    assert_eq!(differ, 0, "{what}: voxels differ");
}

#[test]
fn residuals_fall() {
    let scan = scan();
    for (kind, settings) in ALL {
        let n = if kind == "sirt" { 30 } else { 10 };
        let (_, heard) = Case::of(&scan).volume(&spec(kind, &format!("{settings}\n{}", passes(n))));
        let losses = heard.losses();
        println!("{kind}: {losses:.5?}");
        assert_eq!(losses.len() as u64, n, "{kind}");
        assert!(losses[losses.len() - 1] < 0.3 * losses[0], "{kind}: {losses:?}");
        // A pass reports its progress before its end.
        let shares = &heard.shares;
        assert!(shares.is_sorted() && shares.last() == Some(&1.0), "{kind}: {shares:?}");
        assert!(shares[0] > 0.0 && shares[0] < 0.9 / n as f64 || kind == "sirt", "{kind}: {shares:?}");
        // One has its step size and the other its line search from the whole problem: no pass increases the residual.
        if ["sirt", "cgls", "lsqr"].contains(&kind) {
            assert!(losses.windows(2).all(|w| w[1] <= w[0]), "{kind}: {losses:?}");
        }
    }
}

/// Iterative methods recover what FDK leaves in streaks with few views; total variation recovers most. The voxels are
/// finer than in other tests: the rounding of the bodies' edges is part of every error.
#[test]
fn fewer_views_than_fdk_needs_are_enough() {
    let mut g = geometry(20);
    g.volume = VoxelGrid { shape: [36; 3], spacing: [4.0 / 3.0; 3], ..g.volume };
    g.detector = [48, 54];
    g.views.iter_mut().for_each(|v| (v.u, v.v) = (v.u.map(|x| x / 1.5), v.v.map(|x| x / 1.5)));
    let truth = ellipsoids(&bodies(), &g.volume);
    let scan = scan_ellipsoids(&bodies(), g);
    let of = |spec: &str| psnr(&Case::of(&scan).volume(spec).0, &truth);
    for window in ["ramp", "hann"] {
        let fdk = of(&format!("type = \"fdk\"\nnonnegative = true\nwindow = \"{window}\""));
        println!("fdk, {window}: {fdk:.1} dB");
        assert!(fdk < 30.9, "FDK reaches {fdk:.1} dB");
    }
    // Conjugate gradients end early here, as with noise: voxels cannot represent the bodies' edges.
    for (kind, settings, least) in [
        ("sart", String::new(), 34.2),
        ("os-sart", "subsets = 5".into(), 33.8),
        ("sirt", String::new(), 33.0),
        // Rays that measure nothing empty the voxels at the bodies' edges.
        ("mlem", "subsets = 5".into(), 22.0),
        ("cgls", passes(6), 31.2),
        ("lsqr", passes(6), 31.2),
        ("asd-pocs", "subsets = 5".into(), 38.0),
        ("fista-tv", "subsets = 5\nprior.weight = { fixed = 0.1 }".into(), 38.0),
    ] {
        let found = of(&spec(kind, &settings));
        println!("{kind}: {found:.1} dB");
        assert!(found > least, "{kind}: {found:.1} dB");
    }
}

#[test]
fn attenuation_keeps_its_bounds() {
    let scan = noisy();
    for (kind, settings) in ALL {
        let range = |more: &str| {
            let (volume, _) = Case::of(&scan).volume(&spec(kind, &format!("{settings}\n{}\n{more}", passes(5))));
            volume.data.iter().fold([f32::INFINITY, f32::NEG_INFINITY], |[a, b], &x| [a.min(x), b.max(x)])
        };
        let [least, top] = range("");
        assert!(least >= 0.0, "{kind}");
        if !["mlem", "asd-pocs", "fista-tv", "fista"].contains(&kind) {
            assert!(range("nonnegative = false")[0] < -1e-4, "{kind}");
        }
        if kind == "mlem" {
            continue;
        }
        // The scan's own unit, whatever it is.
        let [low, high] = [0.1, 0.6].map(|share| share * top);
        let bounds = |low: f32, high: f32| format!("scene.bounds = {{ low = {low}, high = {high} }}");
        let [least, most] = range(&bounds(low, high));
        // Descents of total variation may draw the extremes inwards.
        let between = kind == "asd-pocs" && (low..=high).contains(&least) && (low..=high).contains(&most);
        let at = (least / low - 1.0).abs() < 1e-5 && (most / high - 1.0).abs() < 1e-5;
        assert!(between || at, "{kind}: {least} to {most}");
        let [least, most] = range(&bounds(-low, high));
        assert!(least < 0.0 && least >= -1.00001 * low && most <= 1.00001 * high, "{kind}: {least} to {most}");
    }
}

/// With the attenuation of the densest material known, few views are enough for a volume of one material.
#[test]
fn a_known_material_helps() {
    let body = [bodies()[0]];
    let mut g = geometry(24);
    g.views.truncate(6);
    let truth = ellipsoids(&body, &g.volume);
    let top = truth.data.iter().fold(0.0f32, |m, &x| m.max(x));
    let scan = with_noise(scan_ellipsoids(&body, g));
    let settings = format!("subsets = 2\nprior.weight = {{ fixed = 0.02 }}\n{}", passes(30));
    let of = |more: &str| psnr(&Case::of(&scan).volume(&spec("fista-tv", &format!("{settings}\n{more}"))).0, &truth);
    let (without, with) = (of(""), of(&format!("scene.bounds.high = {top}")));
    println!("{without:.1} dB, with its bound {with:.1} dB");
    assert!(with > without + 1.0, "{without:.1} and {with:.1} dB");
}

/// Noise clipped at 0 has a mean above it, which causes a haze around the object unless air is set to 0.
#[test]
fn air_is_taken_for_empty() {
    // Pixels so fine that much of the detector is outside the shadow.
    let mut g = geometry(24);
    g.detector = [128, 144];
    g.views.iter_mut().for_each(|v| (v.u, v.v) = (v.u.map(|x| x / 4.0), v.v.map(|x| x / 4.0)));
    let mut scan = with_noise(scan_ellipsoids(&bodies(), g));
    scan.projections.mapv_inplace(|p| p.max(0.0));
    let haze = |air: bool| {
        let text =
            spec("fista-tv", &format!("subsets = 6\nprior.weight = {{ fixed = 0.02 }}\nair = {air}\n{}", passes(8)));
        let (volume, heard) = Case::of(&scan).volume(&text);
        assert_eq!(heard.said("of the pixels are air"), air);
        mean(&volume, |x| x.iter().any(|x| x.abs() > 21.0))
    };
    let (with, without) = (haze(true), haze(false));
    println!("{with:.2e} and {without:.2e} 1/mm around the object");
    assert!(with < 0.5 * without, "{with:.2e} against {without:.2e} 1/mm");
}

#[test]
fn every_order_of_the_views_serves() {
    let (scan, truth) = (scan(), truth());
    for (kind, settings) in ALL.into_iter().filter(|(k, _)| ["sart", "os-sart", "fista-tv"].contains(k)) {
        let of = |order: &str| {
            let more = format!("{settings}\norder = \"{order}\"\n{}", passes(8));
            Case::of(&scan).volume(&spec(kind, &more)).0
        };
        let all = ["sequential", "random", "golden"].map(of);
        let reached = all.each_ref().map(|v| psnr(v, &truth));
        println!("{kind}: {reached:.2?} dB");
        assert!(reached.iter().all(|r| *r > 35.0), "{kind}: {reached:?}");
        assert!(all[0].data != all[1].data && all[1].data != all[2].data && all[0].data != all[2].data, "{kind}");
        same_bits(&all[1], &of("random"), kind);
    }
}

/// Two passes equal one pass followed by another one with the decayed relaxation.
#[test]
fn relaxation_decays_from_pass_to_pass() {
    let scan = scan();
    for kind in ["sart", "os-sart"] {
        let of = |settings: &str, file: Option<&Volume>| {
            let start = if file.is_some() { "start = \"x\"\n" } else { "" };
            let text = spec(kind, &format!("{start}order = \"sequential\"\ndecay = 0.5\n{settings}"));
            Case { file, ..Case::of(&scan) }.volume(&text).0
        };
        let first = of("relaxation = 0.6\nstop = { passes = 1 }", None);
        let second = of("relaxation = 0.3\nstop = { passes = 1 }", Some(&first));
        let both = of("relaxation = 0.6\nstop = { passes = 2 }", None);
        same_bits(&second, &both, kind);
        let wrong = of("relaxation = 0.6\nstop = { passes = 1 }", Some(&first));
        assert!(wrong.data != both.data, "{kind}");
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let scan = scan();
    for (kind, settings) in ALL.into_iter().chain([("fdk", "")]) {
        let stop = if kind == "fdk" { String::new() } else { passes(3) };
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| Case::of(&scan).volume(&spec(kind, &format!("{settings}\n{stop}"))).0)
        };
        same_bits(&on(1), &on(3), kind);
    }
}

#[test]
fn an_interrupted_run_goes_on_to_the_same_bits() {
    let (scan, held) = noisy().split(&[3, 11, 19]).unwrap();
    for (kind, settings) in ALL {
        for stop in ["passes = 6", "passes = 6, patience = 2"] {
            let text = spec(kind, &format!("{settings}\nstop = {{ {stop} }}"));
            let case = Case { held_out: Some(&held), ..Case::of(&scan) };
            let (whole, heard) = case.volume(&text);
            // After some pass, and after the one that meets a stopping rule.
            for after in [2, heard.records.len()] {
                let mut first = Heard::interrupting_after(after);
                let e = case.run(&text, &mut first).err().unwrap();
                assert!(matches!(e, Error::Interrupted { step } if step == after as u64), "{kind}: {e}");
                let kept = first.kept.take().unwrap();
                assert_eq!(kept.standing.step, after as u64);
                let (again, second) = Case { resume: Some(&kept), ..case }.volume(&text);
                same_bits(&whole, &again, &format!("{kind}, {stop}, after {after}"));
                let losses = [first.losses(), second.losses()].concat();
                assert_eq!(losses, heard.losses(), "{kind}, {stop}, after {after}");
            }
        }
    }
}

#[test]
fn a_checkpoint_of_another_volume_is_refused() {
    let scan = scan();
    for (kind, settings) in ALL {
        let text = spec(kind, &format!("{settings}\n{}", passes(3)));
        let mut first = Heard::interrupting_after(1);
        Case::of(&scan).run(&text, &mut first).err().unwrap();
        let mut kept = first.kept.take().unwrap();
        Arc::make_mut(&mut kept.weights).tensors.get_mut("x").unwrap().1.pop();
        let e = Case { resume: Some(&kept), ..Case::of(&scan) }.run(&text, &mut Heard::default()).err().unwrap();
        let e = e.to_string();
        assert!(e.contains("checkpoint: x: found 13823 numbers, expected 13824 numbers"), "{kind}: {e}");
        Arc::make_mut(&mut kept.weights).tensors.remove("x");
        let e = Case { resume: Some(&kept), ..Case::of(&scan) }.run(&text, &mut Heard::default()).err().unwrap();
        assert!(e.to_string().contains("found nothing"), "{kind}: {e}");
    }
}

/// A binned scan of a smooth body has about the residual of each pixel, not that of their sum.
#[test]
fn the_loss_counts_the_pixels_of_a_binned_scan() {
    let scan = scan();
    let loss = |bin: usize| {
        let text =
            spec("fista-tv", &format!("bin = {bin}\nsubsets = 1\nprior.weight = {{ fixed = 0.0 }}\n{}", passes(1)));
        Case::of(&scan).volume(&text).1.losses()[0]
    };
    let (all, binned) = (loss(1), loss(2));
    assert!((binned / all - 1.0).abs() < 0.1, "{binned} and {all}");
}

/// Views that see nothing, as the first ones of a helix.
#[test]
fn a_subset_may_miss_the_volume() {
    let mut scan = scan();
    let (without, _) = scan.split(&[0, 8]).unwrap();
    for i in [0, 8] {
        let mut away = scan.geometry.views[i];
        for p in [&mut away.source, &mut away.detector] {
            p[2] += 300.0;
        }
        scan.geometry.views[i] = away;
        scan.projections.index_axis_mut(ndarray::Axis(0), i).fill(0.0);
    }
    let empty = psnr(&Volume { data: 0.0 * truth().data, ..truth() }, &truth());
    for prior in ["{ fixed = 0.0 }", "{ noise = 0.5 }"] {
        let settings = format!("subsets = \"views\"\nprior.weight = {prior}\n{}", passes(6));
        let [found, expected] =
            [&scan, &without].map(|scan| psnr(&Case::of(scan).volume(&spec("fista-tv", &settings)).0, &truth()));
        // The momentum goes on where a subset has no gradient, which costs some decibels after few passes.
        println!("{prior}: {found:.2} dB, {expected:.2} dB without these views");
        assert!(found > expected - 5.0 && found > empty + 5.0, "{prior}: {found} and {expected} dB, empty {empty}");
    }
}

/// A support beside all rays.
#[test]
fn likelihood_needs_rays_through_the_support() {
    let mut scan = scan();
    scan.geometry.volume.shape = [24, 24, 96];
    let away = "scene.support = { cuboid = { low = [-4.0, -4.0, 82.0], high = [4.0, 4.0, 92.0] } }";
    let e = Case::of(&scan).run(&spec("mlem", &format!("{away}\n{}", passes(2))), &mut Heard::default()).err().unwrap();
    assert!(e.to_string().contains("rays that all miss the object's support"), "{e}");
}

/// Between the centres of voxels there is nothing to reconstruct.
#[test]
fn a_support_without_voxels_is_refused() {
    let scan = scan();
    let none = "scene.support = { cylinder = { center = [0.01, 0.01], radius = 0.001 } }";
    for (kind, settings) in ALL {
        let text = spec(kind, &format!("{settings}\n{none}\n{}", passes(2)));
        let e = Case::of(&scan).run(&text, &mut Heard::default()).err().unwrap().to_string();
        assert!(e.contains("scene.support") && e.contains("holds no centre of a voxel"), "{kind}: {e}");
    }
}

#[test]
fn passes_time_or_a_small_change_end_a_run() {
    let scan = scan();
    for (kind, settings) in ALL {
        let run = |stop: &str, limits: Limits| {
            let mut heard = Heard::default();
            let text = spec(kind, &format!("{settings}\nstop = {{ {stop} }}"));
            let solution = Case { limits, ..Case::of(&scan) }.run(&text, &mut heard).unwrap();
            assert_eq!(solution.steps as usize, heard.records.len(), "{kind}: {stop}");
            (volume(solution), heard)
        };
        let none = Limits::default();
        assert_eq!(run("passes = 3", none).1.records.len(), 3, "{kind}");
        assert_eq!(run("passes = 3", Limits { steps: Some(2), ..none }).1.records.len(), 2, "{kind}");
        // At least one pass is made, however little time there is.
        for (stop, limits) in [
            ("seconds = 1e-9", none),
            ("passes = 9", Limits { seconds: Some(1e-9), ..none }),
            ("passes = 9", Limits { seconds: Some(0.0), ..none }),
        ] {
            let (volume, heard) = run(stop, limits);
            assert_eq!(heard.records.len(), 1, "{kind}: {stop}");
            assert!(volume.data.iter().any(|x| *x > 0.0), "{kind}: {stop}");
        }
        let (_, heard) = run("change = 0.03", none);
        let n = heard.records.len();
        println!("{kind}: {n} passes to a change of 3 %");
        assert!(n > 1 && n < 200, "{kind}: {n} passes");
        let events = |r: &conefield_core::method::Record| r.events.iter().any(|e| e.contains("stopping rule"));
        assert!(events(&heard.records[n - 1]) && !heard.records[..n - 1].iter().any(events), "{kind}");
    }
}

/// Noise grows with the passes of conjugate gradients. The held-out views detect it, and the run returns the best
/// volume.
#[test]
fn patience_ends_a_run_at_the_best_volume() {
    let (scan, held) = noisy().split(&[3, 11, 19]).unwrap();
    let case = Case { held_out: Some(&held), ..Case::of(&scan) };
    let (volume, heard) = case.volume(&spec("cgls", "stop = { passes = 40, patience = 3 }"));
    let errors: Vec<f64> = heard.records.iter().map(|r| r.held_out.unwrap()).collect();
    println!("{errors:.4?}");
    let best = (0..errors.len()).min_by(|&a, &b| errors[a].total_cmp(&errors[b])).unwrap();
    assert!(errors.len() < 40 && errors.len() == best + 4, "{errors:?}");
    assert!(heard.records.last().unwrap().events.iter().any(|e| e.contains("stopping rule")));
    let (early, _) = case.volume(&spec("cgls", &passes(best as u64 + 1)));
    same_bits(&volume, &early, "the best pass");
    let (late, _) = case.volume(&spec("cgls", &passes(40)));
    assert!(psnr(&volume, &truth()) > psnr(&late, &truth()) + 1.0);
    // Without held-out views it cannot end a run, and a note reports this.
    let (_, heard) = Case::of(&scan).volume(&spec("cgls", "stop = { passes = 5, patience = 1 }"));
    assert!(heard.records.len() == 5 && heard.said("held-out views"), "{:?}", heard.notes);
}

#[test]
fn every_projector_serves_and_the_unit_is_the_scan_s() {
    let (mut scan, truth) = (scan(), truth());
    let of = |scan: &Scan, settings: &str| Case::of(scan).volume(&spec("cgls", settings)).0;
    let plain = of(&scan, "");
    for kind in ["siddon", "joseph", "trilinear"] {
        let found = of(&scan, &format!("projector.type = \"{kind}\""));
        assert!(psnr(&found, &truth) > 27.0, "{kind}: {:.1} dB", psnr(&found, &truth));
        assert_eq!(found.data == plain.data, kind == "joseph", "{kind}: Joseph's is taken where none is named");
    }
    scan.unit = conefield_core::scan::Unit { name: "cm".into(), mm: 10.0 };
    let tenfold = of(&scan, "");
    let apart = plain.data.iter().zip(&tenfold.data).fold(0.0f32, |m, (a, b)| m.max((10.0 * a - b).abs()));
    assert!(apart < 1e-7, "{apart}");
}

/// A factor along the middle of an arc acts on the axis there, as one for the axis, whose dual steps are larger; without
/// such an arc it is ignored.
#[test]
fn differences_along_the_middle_of_an_arc_cost_less() {
    let scan = |degrees: f64| {
        let at = |i: usize| (degrees * (i as f64 / 23.0 - 0.5)).to_radians();
        let views = (0..24).map(|i| view(at(i), [150.0, 220.0], [2.8, 2.8], [0.0, 0.0])).collect();
        scan_ellipsoids(&bodies(), Geometry { views, ..geometry(1) })
    };
    let solved = |degrees: f64, prior: &str| {
        let text = spec("fista", &format!("prior = {{ {prior} }}\nstop = {{ passes = 4 }}"));
        Case::of(&scan(degrees)).volume(&text).0.data
    };
    // Edges are found without the factor of an arc, and with those of axes.
    for (kind, most) in [("total-variation", 0.1), ("directional-total-variation", 0.5)] {
        let of = |degrees, factor: &str| solved(degrees, &format!("type = \"{kind}\"{factor}"));
        let (arc, axes, plain) = (of(100.0, ", arc = 0.5"), of(100.0, ", weights = [0.5, 1, 1]"), of(100.0, ""));
        let [near, far] =
            [&axes, &plain].map(|other| (&arc - other).iter().map(|x| f64::from(x * x)).sum::<f64>().sqrt());
        assert!(near < most * far, "{kind}: {near} from the factor of the axis, {far} from none");
        assert!(of(200.0, ", arc = 0.5") == of(200.0, ""), "{kind}");
    }
}
