//! Two methods one after the other.

use crate::kit::{Case, Heard, bodies, geometry, psnr, spec, volume};
use conefield_backend_cpu::Cpu;
use conefield_core::Error;
use conefield_core::method::{Context, Limits, Reconstruction};
use conefield_core::scan::Scan;
use conefield_projectors::simulate::{ellipsoids, scan_ellipsoids};

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
    // By hand: the first one's volume as the second one's file.
    let (first, _) = Case::of(&scan).volume(FIRST);
    let limits = Limits { steps: Some(4), ..Limits::default() };
    let by_hand = Case { file: Some(&first), limits, ..Case::of(&scan) };
    let (second, _) = by_hand.volume(&format!("start = \"first.nii\"\n{THEN}"));
    assert_eq!(both.data, second.data);
    assert_ne!(both.data, first.data);
    // One list of records, whose steps and seconds go on.
    let steps: Vec<u64> = heard.records.iter().map(|r| r.step).collect();
    assert_eq!(steps, [1, 2, 3, 4, 5, 6, 7]);
    assert!(heard.records.windows(2).all(|w| w[0].seconds <= w[1].seconds));
}

/// A field on which little is worth learning, in seconds.
const FIELD: &str = "type = \"neural-field\"\nencoder = \"identity\"\nfield = { type = \"voxel-grid\", resolution = 24 }\n\
    projector = { type = \"ray-march\", samples = 48 }\ntraining = { steps = 60, rays = 256 }\noptimizer.lr = 0.05\n";

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

/// The field that the first method alone makes.
fn spec_field(scan: &Scan) -> conefield_core::trained::TrainedField {
    match Case::of(scan).run(FIELD, &mut Heard::default()).unwrap().result {
        Reconstruction::Field(field) => field,
        _ => panic!("neural-field trains a field"),
    }
}

/// It is begun anew from where the first one ended, to the same bits.
#[test]
fn an_interruption_of_either_goes_on_to_the_same_bits() {
    let scan = scan();
    for text in [chain(FIRST, THEN, 4), chain(FIELD, THEN, 4)] {
        let mut whole = Heard::default();
        let want = Case::of(&scan).run(&text, &mut whole).unwrap().result.volume(&Cpu::new()).unwrap();
        for after in [1, whole.records.len() - 2] {
            let mut heard = Heard::interrupting_after(after);
            let stopped = Case::of(&scan).run(&text, &mut heard);
            assert!(matches!(stopped.err().unwrap(), Error::Interrupted { .. }));
            let kept = heard.kept.unwrap();
            let resumed = Case { resume: Some(&kept), ..Case::of(&scan) };
            let got = resumed.run(&text, &mut Heard::default()).unwrap();
            assert_eq!(got.result.volume(&Cpu::new()).unwrap().data, want.data, "after record {after}");
        }
    }
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

#[test]
fn limits_are_the_firsts_and_what_is_told_is_of_both() {
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
