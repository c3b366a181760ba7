//! A command builds each stage of a spec only once, both to explain it and to run it.

use conefield_core::Result;
use conefield_core::settings::{EncoderSpec, FieldSpec, ProjectorSpec};
use conefield_core::stage::{Encoder, Field, Projector};
use conefield_encoders::dense_grid::DenseGrid;
use conefield_fields::mlp::Mlp;
use conefield_projectors::ray_march::RayMarch;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Numbers of encoders, fields and projectors built.
static BUILT: [AtomicUsize; 3] = [const { AtomicUsize::new(0) }; 3];

/// Settings of stages that count how often they are built.
macro_rules! counted {
    ($($own:ident $spec:ident;)*) => {$(
        #[derive(Serialize, Deserialize, JsonSchema)]
        #[serde(deny_unknown_fields)]
        struct $own {}

        conefield_core::stage_type!($spec, "counted", $own, "for tests");
    )*};
}

counted! {
    CountedEncoder EncoderSpec;
    CountedField FieldSpec;
    CountedProjector ProjectorSpec;
}

impl EncoderSpec for CountedEncoder {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        BUILT[0].fetch_add(1, Ordering::Relaxed);
        DenseGrid { levels: 2, base_resolution: 4, ..DenseGrid::default() }.build()
    }
}

impl FieldSpec for CountedField {
    fn build(&self, width: usize) -> Result<Box<dyn Field>> {
        BUILT[1].fetch_add(1, Ordering::Relaxed);
        Mlp { width: 8, depth: 2, skips: vec![], ..Mlp::default() }.build(width)
    }
}

impl ProjectorSpec for CountedProjector {
    fn build(&self) -> Result<Box<dyn Projector>> {
        BUILT[2].fetch_add(1, Ordering::Relaxed);
        RayMarch { samples: Some(16), ..RayMarch::default() }.build()
    }
}

/// Runs a command in this process; returns how often each stage was built.
fn built(args: &[&str]) -> [usize; 3] {
    BUILT.iter().for_each(|n| n.store(0, Ordering::Relaxed));
    let args = std::iter::once("conefield").chain(args.iter().copied()).map(Into::into);
    assert_eq!(conefield_cli::run(args, None), 0);
    BUILT.each_ref().map(|n| n.load(Ordering::Relaxed))
}

#[test]
fn explain_and_reconstruct_build_each_stage_once() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).display().to_string();
    let (scan, spec) = (at("scan"), at("spec.toml"));
    let field =
        "type = 'neural-field'\nname = 'counted'\nencoder = 'counted'\nfield = 'counted'\nprojector = 'counted'\n";
    std::fs::write(&spec, format!("{field}[training]\nsteps = 3\nrays = 16\n")).unwrap();
    built(&["simulate", "phantom:head:16", "-o", &scan, "--views", "6", "--detector", "16x16"]);
    assert_eq!(built(&["explain", &spec]), [1; 3]);
    assert_eq!(built(&["explain", &spec, "--scan", &scan]), [1; 3]);
    assert_eq!(built(&["reconstruct", &scan, "--spec", &spec, "-o", &at("run")]), [1; 3]);
    assert!(Path::new(&at("run")).join("volume.nii.gz").is_file());
    // A budget measures the plan that then runs.
    assert_eq!(built(&["reconstruct", &scan, "--spec", &spec, "-o", &at("timed"), "--budget", "6s"]), [1; 3]);
    let chain = at("chain.toml");
    let text = format!(
        "type = 'chain'\nname = 'two'\n[[methods]]\nextends = '{spec}'\n[[methods]]\ntype = 'sart'\nstop.passes = 1\n"
    );
    std::fs::write(&chain, text).unwrap();
    assert_eq!(built(&["reconstruct", &scan, "--spec", &chain, "-o", &at("both")]), [1; 3]);
}
