//! What methods on voxels say they take against what they take, byte by byte.

use conefield_backend_cpu::Cpu;
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_core::method::{Context, Job, Silent};
use conefield_core::random::{mix, unit};
use conefield_core::scan::{Scan, Unit};
use conefield_core::spec::load::parse;
use conefield_solvers as _;
use ndarray::Array3;
use peak_alloc::PeakAlloc;

#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

/// 48 views of 96 × 96 pixels for 72³ voxels: a ball with noise. With fewer voxels it is the pixels that decide how much FISTA takes: for
/// a moment it may hold two numbers of each, to learn the noise, and how many are behind the object is known only then.
fn scan() -> Scan {
    let mm = Millimetres;
    let view = |i: usize| {
        let angle = Radians(std::f64::consts::TAU * i as f64 / 48.0);
        View::circular(angle, mm(500.0), mm(750.0), [mm(2.0); 2], [mm(0.0); 2])
    };
    let volume = VoxelGrid { shape: [72; 3], spacing: [4.0 / 3.0; 3], center: [0.0; 3] };
    let geometry = Geometry { detector: [96; 2], views: (0..48).map(view).collect(), volume };
    let mut i = 0;
    let projections = Array3::from_shape_fn((48, 96, 96), |(_, r, c)| {
        i += 1;
        let [r, c] = [r, c].map(|x| x as f32 - 47.5);
        2.0 * (1.0 - (r * r + c * c) / 900.0).max(0.0).sqrt() + 0.02 * (unit(mix(3, i)) - 0.5)
    });
    Scan { geometry, projections, unit: Unit::default(), provenance: serde_json::Value::Null }
}

const STOP: &str = "stop = { passes = 2 }\n";

#[test]
fn the_tally_is_what_a_run_takes() {
    let scan = scan();
    let backend = Cpu::new();
    let volume = 4 * scan.header().voxels();
    let with = |settings: &str| format!("{settings}{STOP}");
    let tv = "type = \"fista\"\nprior.type = \"total-variation\"\n";
    for text in [
        "type = \"fdk\"\n".to_owned(),
        with("type = \"cgls\"\n"),
        with("type = \"lsqr\"\n"),
        with("type = \"lsqr\"\npull = 0.01\n"),
        with("type = \"mlem\"\n"),
        with("type = \"sart\"\n"),
        with("type = \"sart\"\nsubsets = 10\n"),
        with("type = \"sart\"\nsubsets = 1\n"),
        "type = \"sart\"\nsubsets = 1\nstop = { passes = 2, change = 1e-9 }\n".to_owned(),
        with("type = \"asd-pocs\"\n"),
        with("type = \"fista\"\n"),
        with(tv),
        with(
            "type = \"fista\"\nprior = { type = \"sum\", priors = [\"total-variation\", \"directional-total-variation\"] }\n",
        ),
        with("type = \"fista\"\nprior.type = \"patches\"\n"),
        with(&format!("{tv}subsets = 1\nair = false\ndata.type = \"least-squares\"\n")),
    ] {
        let spec = parse(&text, "test.toml", &[], &[]).unwrap().spec;
        let mut plan = spec.method.plan(&Context::new(&backend)).unwrap();
        let job = Job::new(&scan, &backend);
        // Threads and tables that stay are made in the first run.
        plan.run(&job, &mut Silent).unwrap();
        let before = ALLOCATOR.current_usage();
        ALLOCATOR.reset_peak_usage();
        plan.run(&job, &mut Silent).unwrap();
        let taken = (ALLOCATOR.peak_usage() - before) as f64;
        let planned = (plan.needs(&scan.header()).working + volume) as f64;
        println!(
            "{}: {:.2} MiB planned, {:.2} MiB taken",
            text.replace('\n', ", "),
            planned / 1048576.0,
            taken / 1048576.0
        );
        assert!((0.9..1.1).contains(&(planned / taken)), "{text}: {planned} bytes planned, {taken} taken");
        // Two volumes more or less would be seen.
        let other = 2.0 * volume as f64;
        assert!([taken + other, taken - other].iter().all(|taken| !(0.9..1.1).contains(&(planned / taken))), "{text}");
    }
}
