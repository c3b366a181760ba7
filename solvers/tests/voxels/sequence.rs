//! Two solvers one after the other.

use crate::kit::{Case, Heard, bodies, geometry, psnr, spec, volume};
use conefield_backend_cpu::Cpu;
use conefield_core::Error;
use conefield_core::method::{Limits, Reconstruction};
use conefield_core::scan::Scan;
use conefield_core::spec::Scene;
use conefield_projectors::simulate::{ellipsoids, scan_ellipsoids};

const FIRST: &str = "type = \"sart\"\nsubsets = 4\nrelaxation = 1.0\nstop = { passes = 3 }\n";
const THEN: &str = "type = \"fista\"\nprior.type = \"total-variation\"\nsubsets = 4\npull = 0.05\n";

fn sequence(first: &str, then: &str, passes: u64) -> String {
    format!("[solver]\ntype = \"sequence\"\npasses = {passes}\n[solver.first]\n{first}[solver.then]\n{then}")
}

fn scan() -> Scan {
    scan_ellipsoids(&bodies(), geometry(12))
}

#[test]
fn the_second_goes_on_where_the_first_ended() {
    let scan = scan();
    let (both, heard) = Case::of(&scan).volume(&sequence(FIRST, THEN, 4));
    // By hand: the first one's volume as the second one's file.
    let (first, _) = Case::of(&scan).volume(&format!("[solver]\n{FIRST}"));
    let limits = Limits { steps: Some(4), ..Limits::default() };
    let by_hand = Case { file: Some(&first), limits, ..Case::of(&scan) };
    let (second, _) = by_hand.volume(&format!("[solver]\nstart = \"first.nii\"\n{THEN}"));
    assert_eq!(both.data, second.data);
    assert_ne!(both.data, first.data);
    // One list of records, whose steps and seconds go on.
    let steps: Vec<u64> = heard.records.iter().map(|r| r.step).collect();
    assert_eq!(steps, [1, 2, 3, 4, 5, 6, 7]);
    assert!(heard.records.windows(2).all(|w| w[0].seconds <= w[1].seconds));
}

/// A field on which little is worth learning, in seconds.
const FIELD: &str = "[encoder]\ntype = \"identity\"\n[field]\ntype = \"voxel-grid\"\nresolution = 24\n[projector]\ntype = \"ray-march\"\nsamples = 48\n";
const GRADIENT: &str = "type = \"gradient\"\nsteps = 60\nrays = 256\nlr = 0.05\n";

#[test]
fn a_field_is_refined_and_kept() {
    let (scan, truth) = (scan(), ellipsoids(&bodies(), &geometry(1).volume));
    let text = format!("{FIELD}{}", sequence(GRADIENT, THEN, 4));
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

/// The field that the first solver alone makes.
fn spec_field(scan: &Scan) -> conefield_core::trained::TrainedField {
    let text = format!("{FIELD}[solver]\n{GRADIENT}");
    match Case::of(scan).run(&text, &mut Heard::default()).unwrap().result {
        Reconstruction::Field(field) => field,
        _ => panic!("gradient trains a field"),
    }
}

/// It is begun anew from where the first one ended, to the same bits.
#[test]
fn an_interruption_of_either_goes_on_to_the_same_bits() {
    let scan = scan();
    for text in [sequence(FIRST, THEN, 4), format!("{FIELD}{}", sequence(GRADIENT, THEN, 4))] {
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
fn what_makes_no_sequence_is_refused() {
    let nested = sequence(
        &format!("type = \"sequence\"\nfirst = {{ {} }}\nthen = {{ type = \"sirt\" }}\n", "type = \"fdk\""),
        THEN,
        4,
    );
    for (text, says) in [
        (sequence(FIRST, GRADIENT, 4), "solver.then"),
        (sequence("type = \"sart\"\nsubsets = 0\n", THEN, 4), "solver.first.subsets"),
        (sequence(FIRST, "type = \"fista\"\npull = -1.0\n", 4), "solver.then.pull"),
        (sequence(FIRST, THEN, 0), "solver.passes"),
        (nested, "a sequence in a sequence"),
    ] {
        let e = Case::of(&scan()).run(&text, &mut Heard::default()).err().unwrap().to_string();
        assert!(e.contains(says), "{e}");
    }
}

#[test]
fn limits_are_the_firsts_and_what_is_told_is_of_both() {
    let scan = scan();
    let text = sequence(FIRST, THEN, 4);
    let limits = Limits { steps: Some(1), ..Limits::default() };
    let solution = Case { limits, ..Case::of(&scan) }.run(&text, &mut Heard::default()).unwrap();
    assert_eq!(solution.steps, 5);
    assert_eq!(volume(solution).data.dim(), (24, 24, 24));
    let solver = spec(&text).unwrap().solver.build().unwrap();
    let said = solver.describe();
    assert!(said.contains("sart: 4 subsets") && said.contains("then at most 4 passes of fista"), "{said}");
    let next = solver.successor(&Scene::default()).unwrap();
    assert_eq!(next.passes, 4);
    assert!(next.first.successor(&Scene::default()).is_none());
}
