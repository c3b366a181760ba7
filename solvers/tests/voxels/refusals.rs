//! Specs that voxel methods refuse, with messages that name the field.

use crate::kit::{Case, Heard, bodies, geometry, method, spec};
use conefield_core::geometry::View;
use conefield_projectors::simulate::scan_ellipsoids;

const ALL: [&str; 9] = ["fdk", "sart", "os-sart", "sirt", "mlem", "cgls", "lsqr", "asd-pocs", "fista-tv"];

/// The error for a spec that is refused when it is read, built or run.
fn said(text: &str) -> String {
    let scan = scan_ellipsoids(&bodies(), geometry(4));
    match Case::of(&scan).run(text, &mut Heard::default()) {
        Ok(_) => panic!("accepted: {text}"),
        Err(e) => e.to_string(),
    }
}

#[test]
fn stages_of_other_kinds_have_no_place() {
    for kind in ALL.into_iter().filter(|k| *k != "fdk") {
        let e = said(&method(kind, "projector.type = \"ray-march\""));
        assert!(e.contains("projector.type: found no voxel-projector type \"ray-march\""), "{kind}: {e}");
        let e = said(&method(kind, "projector = 3"));
        assert!(e.contains("projector: found 3, expected a table"), "{kind}: {e}");
        let e = said(&method(kind, "projector.steps = 3"));
        assert!(e.contains("projector.type: found nothing"), "{kind}: {e}");
        let e = said(&method(kind, "start = 3"));
        assert!(e.contains("start: found 3, expected a text"), "{kind}: {e}");
    }
    // FDK back-projects in its own way and has no start volume.
    for setting in ["projector.type = \"joseph\"", "start = \"x.nii\""] {
        let e = said(&method("fdk", setting));
        assert!(e.contains("an unknown key"), "{e}");
    }
    for (setting, says) in [
        ("basis.type = \"waves\"", "basis.type: found no basis type \"waves\""),
        ("data.type = \"huber\"", "data.type: found no data-term type \"huber\""),
        ("prior.type = \"totl-variation\"", "expected \"total-variation\""),
        ("prior.weight = 3.0", "prior.type: found nothing"),
    ] {
        let e = said(&method("fista", setting));
        assert!(e.contains(says), "{setting}: {e}");
    }
    // A field cannot be rendered by a voxel projector.
    let field = "encoder = \"identity\"\nfield = \"voxel-grid\"\nprojector.type = \"joseph\"\n";
    let e = said(&method("neural-field", field));
    assert!(e.contains("projector.type: found no projector type \"joseph\""), "{e}");
}

#[test]
fn fdk_refuses_what_is_no_circle() {
    let refused = |change: &dyn Fn(usize, &mut View)| {
        let mut geometry = geometry(8);
        geometry.views.iter_mut().enumerate().for_each(|(i, v)| change(i, v));
        let scan = scan_ellipsoids(&bodies(), geometry);
        Case::of(&scan).run("type = \"fdk\"\n", &mut Heard::default()).err().map(|e| e.to_string())
    };
    assert_eq!(refused(&|_, _| ()), None);
    // A calibrated scan is tilted by a fraction of a degree.
    assert_eq!(refused(&|i, v| (v.source[2], v.u[2]) = (0.01 * i as f64, 0.01 * v.u[1])), None);
    let said = refused(&|i, v| {
        let along = 5.0 * i as f64;
        (v.source[2], v.detector[2]) = (v.source[2] + along, v.detector[2] + along);
    });
    assert!(said.unwrap().contains("sources from 0.0 to 35.0 mm along z, expected a circular orbit"));
    let said = refused(&|_, v| std::mem::swap(&mut v.u, &mut v.v));
    assert!(said.unwrap().contains("a detector whose rows rise along z in view 0"));
    let said = refused(&|i, v| v.source = v.source.map(|x| x * (1.0 + 0.05 * i as f64))).unwrap();
    assert!(said.contains("scan: views: found sources") && said.contains("a circular orbit"), "{said}");
    let said = refused(&|_, v| v.detector = std::array::from_fn(|k| v.detector[k] + 1e4 * v.u[k])).unwrap();
    assert!(said.contains("found rays that all miss the volume"), "{said}");
    let said = refused(&|_, v| v.source = [0.0, 0.0, 100.0]).unwrap();
    assert!(said.contains("mm from the axis z, expected a circular orbit"), "{said}");
}

#[test]
fn bounds_are_numbers_in_order_and_hold_0_outside_a_support() {
    for kind in ALL.into_iter().filter(|k| *k != "fdk") {
        for (scene, says) in [
            ("bounds = { low = nan }", "found nan, expected a finite number"),
            ("bounds = { high = inf }", "found inf, expected a finite number"),
            ("bounds = { low = 0.5, high = 0.5 }", "scene.bounds.high: found 0.5, expected a finite number above"),
            ("bounds = { low = 0.1 }\nsupport = \"carve\"", "scene.bounds.low: found 0.1, expected 0, because"),
            ("bounds = { top = 0.1 }", "top"),
            ("support = \"ball\"", "ball"),
            (
                "support = { cylinder = { radius = 0.0 } }",
                "scene.support.cylinder.radius: found 0, expected a positive",
            ),
            ("support = { cylinder = { center = [nan, 0.0], radius = 1.0 } }", "found nan, expected a finite number"),
            ("support = { cylinder = { center = [500.0, 0.0], radius = 1.0 } }", "a region that meets the volume"),
            ("support = { cuboid = { low = [0, 0, 1], high = [1, 1, 0] } }", "scene.support.cuboid: found"),
            ("support = { cuboid = { low = [500, 0, 0], high = [501, 1, 1] } }", "a region that meets the volume"),
            (
                "support = \"solid\"\nsurround = { coarse = {} }",
                "scene.surround: found coarse, expected \"none\", because",
            ),
            ("support = \"solid\"", "scene.support: found \"solid\", but"),
        ] {
            let e = said(&method(kind, &format!("[scene]\n{scene}")));
            assert!(e.contains(says), "{kind}, {scene}: {e}");
        }
    }
}

#[test]
fn a_run_has_an_end() {
    for kind in ALL.into_iter().filter(|k| *k != "fdk") {
        for stop in ["{}", "{ patience = 3 }"] {
            let e = said(&method(kind, &format!("stop = {stop}")));
            assert!(e.contains("stop: found no end, expected one of passes, seconds or change"), "{kind}: {e}");
        }
        for (stop, field) in [
            ("{ seconds = 0.0 }", "seconds"),
            ("{ passes = 3, seconds = -1.0 }", "seconds"),
            ("{ change = 0.0 }", "change"),
            ("{ passes = 3, patience = 0 }", "patience"),
            ("{ passes = -1 }", "passes"),
            ("{ passes = 0 }", "passes"),
        ] {
            let e = said(&method(kind, &format!("stop = {stop}")));
            assert!(e.contains(&format!("stop.{field}: found")), "{kind}, {stop}: {e}");
        }
        // Only the given settings end a run: no number of passes is added to a time.
        let spec = spec(&method(kind, "stop = { seconds = 60.0 }")).unwrap();
        let stop = serde_json::to_value(&spec).unwrap()["stop"].clone();
        assert_eq!(stop, serde_json::json!({ "seconds": 60.0 }), "{kind}");
    }
}

#[test]
fn settings_out_of_range_are_named() {
    for (kind, setting, field) in [
        ("fdk", "window = \"han\"", "window"),
        ("fdk", "cutoff = 0.0", "cutoff"),
        ("fdk", "cutoff = 1.01", "cutoff"),
        ("fdk", "windw = \"hann\"", "windw"),
        ("sart", "relaxation = 0.0", "relaxation"),
        ("sart", "relaxation = 2.0", "relaxation"),
        ("sart", "decay = 0.0", "decay"),
        ("sart", "decay = 1.1", "decay"),
        ("sart", "order = \"silver\"", "order"),
        ("sart", "stop = { passs = 3 }", "stop.passs"),
        ("os-sart", "subsets = 0", "subsets"),
        ("sart", "subsets = \"view\"", "subsets"),
        ("sirt", "relaxation = -1.0", "relaxation"),
        ("cgls", "relaxation = 1.0", "relaxation"),
        ("mlem", "relaxation = 1.0", "relaxation"),
        ("mlem", "subsets = 0", "subsets"),
        ("lsqr", "pull = -1.0", "pull"),
        ("asd-pocs", "subsets = 0", "subsets"),
        ("asd-pocs", "alpha = 0.0", "alpha"),
        ("asd-pocs", "tolerance = -1.0", "tolerance"),
        ("fista-tv", "subsets = 0", "subsets"),
        ("fista-tv", "prior.inner = 0", "prior.inner"),
        ("fista-tv", "prior.weight = { noise = -1.0 }", "prior.weight"),
        ("fista-tv", "prior.weight = 3.0", "prior.weight"),
        ("fista", "prior = { type = \"directional-total-variation\", strength = 1.0 }", "prior.strength"),
        ("fista", "prior = { type = \"patches\", radius = 7 }", "prior.radius"),
        ("fista", "prior = { type = \"patches\", large = 0.0 }", "prior.large"),
        ("fista", "prior = { type = \"directional-total-variation\", edge = 0.0 }", "prior.edge"),
        ("fista", "prior = { type = \"sum\", priors = [] }", "prior.priors"),
        ("fista", "prior = { type = \"sum\", turns = 0 }", "prior.turns"),
        ("fista", "prior = { type = \"sum\", priors = [\"none\", \"sum\"] }", "prior.priors.1"),
        (
            "fista",
            "prior = { type = \"sum\", priors = [\"none\", { type = \"total-variation\", inner = 0 }] }",
            "prior.priors.1.inner",
        ),
    ] {
        let e = said(&method(kind, setting));
        assert!(e.contains(&format!(": {field}: found")), "{kind}, {setting}: {e}");
    }
    let e = said(&method("sart", "projector = { type = \"trilinear\", samples_per_voxel = 0.1 }"));
    assert!(e.contains("projector.samples_per_voxel: found 0.1"), "{e}");
    let e = said("type = \"fdk\"\nwindow = \"han\"\n");
    assert!(e.contains("hann"), "the nearest name is offered: {e}");
}
