//! Methods one after the other.

use crate::kit::{Case, Heard, bodies, geometry, psnr, spec, volume};
use conefield_backend_cpu::Cpu;
use conefield_core::Error;
use conefield_core::checkpoint::Resume;
use conefield_core::method::{Context, Limits, Reconstruction, Solution};
use conefield_core::scan::Scan;
use conefield_projectors::simulate::{ellipsoids, scan_ellipsoids};
use std::sync::Arc;

const FIRST: &str = "type = \"sart\"\nsubsets = 4\nrelaxation = 1.0\nstop = { passes = 3 }\n";
const THEN: &str = "type = \"fista\"\nprior = \"total-variation\"\nsubsets = 4\npull = 0.05\n";

fn chain(first: &str, then: &str, passes: u64) -> String {
    format!("type = \"chain\"\n[[methods]]\n{first}[[methods]]\nstop = {{ passes = {passes} }}\n{then}")
}

fn scan() -> Scan {
    scan_ellipsoids(&bodies(), geometry(12))
}

#[test]
fn the_second_goes_on_where_the_first_ended() {
    let scan = scan();
    let (both, heard) = Case::of(&scan).volume(&chain(FIRST, THEN, 4));
    // By hand: the first method's volume as the second one's file.
    let (first, _) = Case::of(&scan).volume(FIRST);
    let limits = Limits { steps: Some(4), ..Limits::default() };
    let by_hand = Case { file: Some(&first), limits, ..Case::of(&scan) };
    let (second, _) = by_hand.volume(&format!("start = \"first.nii\"\n{THEN}"));
    assert_eq!(both.data, second.data);
    assert_ne!(both.data, first.data);
    // One list of records with continuing steps and seconds.
    let steps: Vec<u64> = heard.records.iter().map(|r| r.step).collect();
    assert_eq!(steps, [1, 2, 3, 4, 5, 6, 7]);
    assert!(heard.records.windows(2).all(|w| w[0].seconds <= w[1].seconds));
}

/// A trivial field that takes seconds to train.
const FIELD: &str = "type = \"neural-field\"\nencoder = \"identity\"\nfield = { type = \"voxel-grid\", resolution = 24 }\n\
    projector = { type = \"ray-march\", samples = 48 }\ntraining = { steps = 60, rays = 64, report_every = 25 }\noptimizer.lr = 0.05\n";

#[test]
fn a_field_is_refined_and_kept() {
    let (scan, truth) = (scan(), ellipsoids(&bodies(), &geometry(1).volume));
    let text = chain(FIELD, THEN, 4);
    let solution = Case::of(&scan).run(&text, &mut Heard::default()).unwrap();
    assert_eq!(solution.steps, 64);
    assert!(solution.samples > 0);
    let Reconstruction::Refined { volume, .. } = &solution.result else { panic!("no field was kept") };
    let before = Reconstruction::Field(spec_field(&scan)).volume(&Cpu::new()).unwrap();
    let (before, after) = (psnr(&before, &truth), psnr(volume, &truth));
    println!("{before:.2} to {after:.2} dB");
    assert!(after > before + 1.0, "{before} to {after}");
    assert!(solution.result.field().is_some());
}

/// The field of the first method alone.
fn spec_field(scan: &Scan) -> conefield_core::trained::TrainedField {
    match Case::of(scan).run(FIELD, &mut Heard::default()).unwrap().result {
        Reconstruction::Field(field) => field,
        _ => panic!("neural-field trains a field"),
    }
}

/// A third method, after [`THEN`].
const LAST: &str = "[[methods]]\nstop = { passes = 3 }\ntype = \"fista\"\nprior = \"total-variation\"\nbasis = { type = \"cubic\", samples = 16 }\n";

/// Chains of three methods: on voxels, with a mean of two, with a field first, and with a field in the middle.
fn chains_of_three() -> [String; 4] {
    let voxels = format!("{}{LAST}", chain(FIRST, THEN, 4));
    let mean = voxels.replacen("type = \"chain\"\n", "type = \"chain\"\nmean = 2\n", 1);
    let field_first = format!("{}{LAST}", chain(FIELD, THEN, 4)).replacen("chain\"\n", "chain\"\nmean = 3\n", 1);
    let field_between = format!("type = \"chain\"\n[[methods]]\n{FIRST}[[methods]]\n{FIELD}{LAST}");
    [voxels, mean, field_first, field_between]
}

/// Whichever method is interrupted, during or after it: the chain resumes at the same point.
#[test]
fn an_interruption_of_any_goes_on_to_the_same_bits() {
    let scan = scan();
    for text in [chain(FIRST, THEN, 4), chain(FIELD, THEN, 4)].into_iter().chain(chains_of_three()) {
        let mut whole = Heard::default();
        let want = Case::of(&scan).run(&text, &mut whole).unwrap();
        for after in (1..whole.records.len()).step_by(2) {
            let mut heard = Heard::interrupting_after(after);
            let stopped = Case::of(&scan).run(&text, &mut heard);
            let stopped_at = heard.records.last().unwrap().step;
            match stopped.err().unwrap() {
                // A field may complete one more step.
                Error::Interrupted { step } => assert!(step == stopped_at || step == stopped_at + 1, "{step}"),
                e => panic!("{e}"),
            }
            let kept = heard.kept.take().unwrap();
            let (step, recorded) = (kept.standing.step, kept.standing.recorded);
            assert!(step >= stopped_at && recorded <= step, "after record {after}: {step} and {recorded}");
            let resumed = Case { resume: Some(&kept), ..Case::of(&scan) };
            let mut rest = Heard::default();
            let got = resumed.run(&text, &mut rest).unwrap();
            let volume = |s: &Solution| s.result.volume(&Cpu::new()).unwrap().data;
            assert_eq!(volume(&got), volume(&want), "after record {after}");
            let weights = |s: &Solution| s.result.field().map(|f| f.model.arena.params.to_vec());
            assert_eq!(weights(&got), weights(&want), "after record {after}");
            assert_eq!((got.steps, got.samples), (want.steps, want.samples), "after record {after}");
            assert!(got.train_s >= kept.standing.seconds, "{} after {}", got.train_s, kept.standing.seconds);
            // No record is lost or repeated, and none belongs to a completed method.
            heard.records.retain(|r| r.step <= recorded);
            let records: Vec<_> = [&heard, &rest].iter().flat_map(|h| &h.records).map(|r| (r.step, r.loss)).collect();
            assert_eq!(
                records,
                whole.records.iter().map(|r| (r.step, r.loss)).collect::<Vec<_>>(),
                "after record {after}"
            );
        }
    }
}

/// Methods two and three use the same grid of 24 voxels: merged they are one method of seven passes, and the mean is
/// its volume alone.
#[test]
fn methods_on_one_grid_are_merged() {
    let scan = scan();
    let tv = "type = \"fista\"\nprior = \"total-variation\"\nsubsets = 4\n";
    let cubic = |samples: u32, passes: u32| {
        format!(
            "[[methods]]\nstop = {{ passes = {passes} }}\n{tv}basis = {{ type = \"cubic\", spacing = 1, samples = {samples} }}\n"
        )
    };
    let chain = |top: &str, levels: &[(u32, u32)]| {
        let levels: String = levels.iter().map(|&(samples, passes)| cubic(samples, passes)).collect();
        format!("type = \"chain\"\n{top}{levels}")
    };
    let levels = [(12, 2), (32, 3), (48, 4)];
    let (one, heard) = Case::of(&scan).volume(&chain("", &[(12, 2), (24, 7)]));
    let merged = chain("mean = 2\nmerge = true\n", &levels);
    let (both, found) = Case::of(&scan).volume(&merged);
    assert_eq!(both.data, one.data);
    assert_eq!(found.records.len(), heard.records.len());
    assert_ne!(Case::of(&scan).volume(&chain("mean = 2\n", &levels)).0.data, one.data);
    // Levels on different grids are not merged, and the mean stays.
    let apart = |top| Case::of(&scan).volume(&chain(top, &[(12, 2), (16, 3), (24, 4)])).0.data;
    assert_eq!(apart("mean = 2\nmerge = true\n"), apart("mean = 2\n"));
    // An interruption within the merged method resumes to the same bits.
    let mut heard = Heard::interrupting_after(5);
    Case::of(&scan).run(&merged, &mut heard).err().unwrap();
    let resumed = Case { resume: Some(&heard.kept.unwrap()), ..Case::of(&scan) };
    assert_eq!(resumed.volume(&merged).0.data, both.data);
}

#[test]
fn a_checkpoint_that_does_not_fit_the_chain_is_refused() {
    let scan = scan();
    let [text, ..] = chains_of_three();
    let mut heard = Heard::interrupting_after(5);
    Case::of(&scan).run(&text, &mut heard).err().unwrap();
    let kept = heard.kept.unwrap();
    let refused = |kept: &Resume, text: &str, says: &str| {
        let e = Case { resume: Some(kept), ..Case::of(&scan) }.run(text, &mut Heard::default());
        let e = e.err().unwrap().to_string();
        assert!(e.contains(says), "{e}");
    };
    let mut short = kept.clone();
    Arc::make_mut(&mut short.weights).tensors.get_mut("chain.start").unwrap().0 = vec![23, 24, 24];
    refused(&short, &text, "chain.start: found shape [23, 24, 24], expected a tensor of shape [24, 24, 24]");
    let mut none = kept.clone();
    Arc::make_mut(&mut none.weights).tensors.remove("link.x");
    refused(&none, &text, "checkpoint: x: found nothing");
    let mut far = kept.clone();
    far.standing.method["links"] = 3.into();
    refused(&far, &text, "method.links: found 3, expected fewer than 3");
    refused(&kept, FIRST, "method: ");
    let mut alone = Heard::interrupting_after(1);
    Case::of(&scan).run(FIRST, &mut alone).err().unwrap();
    refused(&alone.kept.unwrap(), &text, "the state of a chain");
}

#[test]
fn what_makes_no_chain_is_refused() {
    let nested = chain("type = \"chain\"\nmethods = [{ type = \"fdk\" }, { type = \"sart\" }]\n", THEN, 4);
    for (text, says) in [
        (
            format!("type = \"chain\"\n[[methods]]\n{FIRST}[[methods]]\ntype = \"fdk\"\n"),
            "methods.1: found fdk, expected a method that starts from a volume",
        ),
        (chain("type = \"sart\"\nsubsets = 0\n", THEN, 4), "methods.0.subsets"),
        (chain(FIRST, "type = \"fista\"\npull = -1.0\n", 4), "methods.1.pull"),
        (format!("type = \"chain\"\n[[methods]]\n{FIRST}"), "methods: found 1, expected at least 2 methods"),
        (chain(FIRST, THEN, 0), "methods.1.stop.passes"),
        (nested, "a chain in a chain"),
    ] {
        let e = Case::of(&scan()).run(&text, &mut Heard::default()).err().unwrap().to_string();
        assert!(e.contains(says), "{e}");
    }
}

/// A later method ends by its own time, however many passes it may make.
#[test]
fn a_later_method_ends_by_its_own_seconds() {
    let scan = scan();
    let text = chain(FIRST, THEN, 500).replace("{ passes = 500 }", "{ passes = 500, seconds = 1e-9 }");
    let solution = Case::of(&scan).run(&text, &mut Heard::default()).unwrap();
    assert_eq!(solution.steps, 4);
}

#[test]
fn limits_apply_to_the_first_and_the_outline_shows_both() {
    let scan = scan();
    let text = chain(FIRST, THEN, 4);
    let limits = Limits { steps: Some(1), ..Limits::default() };
    let solution = Case { limits, ..Case::of(&scan) }.run(&text, &mut Heard::default()).unwrap();
    assert_eq!(solution.steps, 5);
    assert_eq!(volume(solution).data.dim(), (24, 24, 24));
    let backend = Cpu::new();
    let mut plan = spec(&text).unwrap().method.plan(&Context::new(&backend)).unwrap();
    let outline = plan.outline();
    assert_eq!(outline.method.what, "sart, then fista");
    let said: Vec<&str> = outline.links.iter().map(|l| &l.method.what[..]).collect();
    assert!(said[0].starts_with("4 subsets") && said[1].starts_with("4 subsets"), "{said:?}");
    assert_eq!(plan.links().iter().map(|l| l.passes()).collect::<Vec<_>>(), [Some(3), Some(4)]);
    assert!(plan.links().iter_mut().all(|l| l.links().is_empty()));
}
