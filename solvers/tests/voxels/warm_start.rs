//! A known start volume: used directly by voxel methods, learned first by fields.

use crate::kit::{Case, Heard, bodies, geometry, psnr};
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_core::voxel::VoxelOperator;
use conefield_projectors::simulate::{ellipsoids, scan_ellipsoids};
use conefield_projectors::voxel::Joseph;

/// The start of a field.
const START: &str = "[initializer]\ntype = \"volume\"\npath = \"earlier.nii\"\n";

const ALL: [&str; 7] = ["sart", "os-sart", "sirt", "cgls", "lsqr", "asd-pocs", "fista-tv"];

fn truth() -> Volume {
    ellipsoids(&bodies(), &geometry(1).volume)
}

/// Projections of the voxels themselves, so that the volume is an exact solution.
fn scan_of(volume: &Volume) -> Scan {
    let mut scan = scan_ellipsoids(&[], geometry(12));
    let views: Vec<usize> = (0..12).collect();
    let out = scan.projections.view_mut();
    VoxelOperator::<f32>::forward(&Joseph {}, &scan.geometry, &views, volume.data.view(), out);
    scan
}

fn method(kind: &str, more: &str) -> String {
    let weight = if kind == "fista-tv" { "prior.weight = { fixed = 0.0 }\n" } else { "" };
    let descents = if kind == "asd-pocs" { "descents = 0\n" } else { "" };
    crate::kit::method(kind, &format!("stop = {{ passes = 1 }}\n{weight}{descents}{more}"))
}

/// A voxel method that starts from the file.
fn warm(kind: &str) -> String {
    method(kind, "start = \"earlier.nii\"\n")
}

#[test]
fn the_truth_leaves_no_residual_and_stays() {
    let truth = truth();
    let scan = scan_of(&truth);
    for kind in ALL {
        let (cold, first) = Case::of(&scan).volume(&method(kind, ""));
        let case = Case { file: Some(&truth), ..Case::of(&scan) };
        let (warm, heard) = case.volume(&warm(kind));
        let (warm_loss, cold_loss) = (heard.losses()[0], first.losses()[0]);
        println!("{kind}: residual {warm_loss:.1e} instead of {cold_loss:.1e}");
        assert!(warm_loss < 1e-5 * cold_loss.max(0.1), "{kind}: {warm_loss:e} and {cold_loss:e}");
        assert!(psnr(&warm, &truth) > 80.0 && psnr(&cold, &truth) < 40.0, "{kind}");
    }
}

/// The file is in 1/unit of the scan.
#[test]
fn the_start_is_what_the_file_holds() {
    let truth = truth();
    let mut scan = scan_of(&truth);
    scan.unit = Unit { name: "cm".into(), mm: 10.0 };
    let tenfold = truth.clone().mapped(|x| 10.0 * x);
    for kind in ALL {
        // No pass is made: the result is the content of the file.
        let limits = conefield_core::method::Limits { steps: Some(0), ..Default::default() };
        let case = Case { file: Some(&tenfold), limits, ..Case::of(&scan) };
        let (volume, heard) = case.volume(&warm(kind));
        assert!(heard.records.is_empty(), "{kind}");
        let apart = volume.data.iter().zip(&tenfold.data).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(apart < 1e-7, "{kind}: {apart}");
    }
}

#[test]
fn volumes_that_do_not_fit_are_refused() {
    let truth = truth();
    let scan = scan_of(&truth);
    let other = Volume::centered(ndarray::Array3::zeros((24, 23, 24)), [2.0; 3]);
    let mut holed = truth.clone();
    holed.data[[1, 2, 3]] = f32::NAN;
    let field = format!("{}{START}", field(IDENTITY, GRID, 1));
    for text in ALL.map(warm).iter().chain([&field]) {
        for (file, want) in [
            (&other, "earlier.nii: shape: found [24, 23, 24], expected [24, 24, 24]"),
            (&holed, "earlier.nii: voxel (1, 2, 3): found NaN"),
        ] {
            let case = Case { file: Some(file), ..Case::of(&scan) };
            let e = case.run(text, &mut Heard::default()).err().unwrap().to_string();
            assert!(e.contains(want), "{e}");
        }
    }
}

/// FISTA with a pull ends between the scan's solution and the start volume, closer to the latter with a stronger pull.
#[test]
fn a_pull_holds_to_the_start() {
    let truth = truth();
    let scan = scan_of(&truth);
    let start = truth.clone().mapped(|x| 0.9 * x + 1e-3);
    let case = Case { file: Some(&start), ..Case::of(&scan) };
    let held = |pull: f64, start: &str| {
        let settings = format!("{start}stop = {{ passes = 6 }}\nprior.weight = {{ fixed = 0.0 }}\npull = {pull:?}\n");
        crate::kit::method("fista-tv", &settings)
    };
    let spec = |pull: f64| held(pull, "start = \"earlier.nii\"\n");
    let free = case.volume(&spec(0.0)).0;
    let apart: Vec<f64> =
        [1e-2, 1.0, 1e4].iter().map(|&p| psnr(&case.volume(&spec(p)).0, &start) - psnr(&free, &start)).collect();
    assert!(apart[0] > 0.2 && apart[1] > apart[0] + 6.0 && apart[2] > apart[1] + 20.0, "{apart:?}");
    // Without a pull it approaches the truth; with a slight pull it stays behind.
    assert!(psnr(&free, &truth) > psnr(&case.volume(&spec(1.0)).0, &truth) + 3.0);

    let e = case.run(&held(0.1, ""), &mut Heard::default()).err().unwrap().to_string();
    assert!(e.contains("pull: found 0.1, expected 0, or a volume to start from"), "{e}");
}

/// A job may pass the volume itself, which takes precedence over the file.
#[test]
fn a_volume_that_is_handed_over_is_the_start() {
    let truth = truth();
    let scan = scan_of(&truth);
    let other = truth.clone().mapped(|x| 0.5 * x);
    for kind in ALL {
        let text = warm(kind);
        let (by_file, _) = Case { file: Some(&truth), ..Case::of(&scan) }.volume(&text);
        let (handed, _) = Case { file: Some(&other), start: Some(&truth), ..Case::of(&scan) }.volume(&text);
        assert!(by_file.data == handed.data, "{kind}");
    }
    let small = Volume::centered(ndarray::Array3::zeros((2, 3, 4)), [2.0; 3]);
    let case = Case { start: Some(&small), ..Case::of(&scan) };
    let e = case.run(&method("sirt", ""), &mut Heard::default()).err().unwrap().to_string();
    assert!(e.contains("start: shape: found [2, 3, 4], expected [24, 24, 24]"), "{e}");
}

const IDENTITY: &str = "type = \"identity\"";
const GRID: &str = "type = \"voxel-grid\"\nresolution = 24";
const DENSE: &str = "type = \"dense-grid\"\nlevels = 2\nbase_resolution = 12\ngrowth = 2.0";
const MLP: &str = "type = \"mlp\"\nwidth = 16\ndepth = 3\nskips = []\noutput = \"squareplus\"";

/// A field that is trained for a few steps, with a record of each.
fn field(encoder: &str, field: &str, steps: usize) -> String {
    format!(
        "type = \"neural-field\"\nprojector = {{ type = \"ray-march\", samples = 48 }}\noptimizer.lr = 0.03\n\
         pretraining.points = 4096\n[encoder]\n{encoder}\n[field]\n{field}\n[training]\nsteps = {steps}\n\
         report_every = 1\nrays = 64\npixels = \"all\"\n"
    )
}

#[test]
fn fields_learn_it_before_they_see_the_scan() {
    let truth = truth();
    let scan = scan_of(&truth);
    for (name, encoder, net, gain) in [("voxel-grid", IDENTITY, GRID, 12.0), ("dense-grid", DENSE, MLP, 8.0)] {
        let first = |head: &str, file: Option<&Volume>| {
            let case = Case { file, reference: Some(&truth), ..Case::of(&scan) };
            let mut heard = Heard::default();
            case.run(&format!("{}{head}", field(encoder, net, 1)), &mut heard).unwrap();
            (heard.records[0].psnr.unwrap(), heard)
        };
        let (random, _) = first("", None);
        let start = format!("{START}steps = 300\n");
        let (warm, heard) = first(&start, Some(&truth));
        println!("{name}: {random:.1} dB from random weights, {warm:.1} dB from the volume");
        assert!(heard.said("learned earlier.nii in 300 steps"), "{:?}", heard.notes);
        assert!(warm > random + gain, "{name}: {random:.1} and {warm:.1} dB");
    }
}

#[test]
fn learning_a_volume_can_be_stopped() {
    let truth = truth();
    let scan = scan_of(&truth);
    let text = format!("{}{START}steps = 1000000\n", field(IDENTITY, GRID, 1));
    let mut heard = Heard::interrupting_after(0);
    let stopped = Case { file: Some(&truth), ..Case::of(&scan) }.run(&text, &mut heard);
    assert!(matches!(stopped.err().unwrap(), conefield_core::Error::Interrupted { step: 0 }));
}
