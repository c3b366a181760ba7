//! Several processes share the arrays of a method: threads stand for them here.

use crate::common::{Heard, Stop, plan, scan, solve_on, spec};
use crate::device::{backends, little};
use crate::places::larger;
use conefield_backend_cpu::Cpu;
use conefield_backend_wgpu::Wgpu;
use conefield_core::arena::Weights;
use conefield_core::backend::{Backend, Executable, Explain};
use conefield_core::checkpoint::{Checkpoint, Resume};
use conefield_core::method::{Job, Observer, Record};
use conefield_core::pipeline::Pipeline;
use conefield_core::place::{Array, Host, Moved, Place, Ranks, Threads};
use conefield_core::scan::Scan;
use conefield_core::{Error, Result};
use ndarray::{Array3, ArrayView3, ArrayViewMut3, Axis};
use serde_json::{Value, json};
use std::sync::Arc;

/// The backend of a rank.
struct Shared(Arc<Ranks>);

impl Backend for Shared {
    fn name(&self) -> &'static str {
        "shared"
    }

    fn compile(&self, _: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        Err(Error::unsupported("method", "a field"))
    }

    fn place(&self) -> Arc<dyn Place> {
        self.0.clone()
    }
}

/// The results of `work` in each of `count` ranks on the host.
fn each<T: Send>(count: usize, work: impl Fn(&Shared) -> T + Sync) -> Vec<T> {
    on(&vec![Arc::new(Host) as Arc<dyn Place>; count], work)
}

/// The results of `work` in each rank, whose arrays live in `places`.
fn on<T: Send>(places: &[Arc<dyn Place>], work: impl Fn(&Shared) -> T + Sync) -> Vec<T> {
    let threads = Threads::new(places.len());
    let all = threads.peers().zip(places).map(|(peers, place)| Shared(Arc::new(Ranks::new(peers, place.clone()))));
    let all: Vec<_> = all.collect();
    threads.run(|| Ok(work(&all[0])), |rank| Ok(work(&all[rank]))).unwrap()
}

fn volume(method: &Value, scan: &Scan, backend: &dyn Backend) -> Array3<f32> {
    let (solution, _) = solve_on(backend, method, scan, &Weights::default()).unwrap();
    solution.result.volume(backend).unwrap().data
}

/// Largest difference as a share of the largest number.
fn off(found: &Array3<f32>, want: &Array3<f32>) -> f32 {
    let top = want.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    found.iter().zip(want).map(|(a, b)| (a - b).abs() / top).fold(0.0, f32::max)
}

/// A chain on samples, as `smooth-tv` is one.
fn smooth() -> Value {
    let link = |samples: usize, prior: &str| {
        json!({"type": "fista", "basis": {"type": "cubic", "spacing": 1, "samples": samples}, "subsets": 2,
            "stop": {"passes": 4}, "prior": prior})
    };
    json!({"type": "chain", "mean": 2, "methods": [
        link(9, "total-variation"), link(13, "directional-total-variation"), link(15, "directional-total-variation"),
    ]})
}

/// Methods and settings that use the arrays in different ways.
fn methods() -> Vec<Value> {
    vec![
        json!({"type": "fdk", "window": "hann", "nonnegative": true}),
        json!({"type": "sart", "subsets": 1, "stop": {"passes": 3}}),
        json!({"type": "sart", "subsets": 3, "stop": {"passes": 3}, "scene": {"support": "carve"}}),
        json!({"type": "mlem", "stop": {"passes": 3}}),
        json!({"type": "cgls", "stop": {"passes": 5}}),
        json!({"type": "lsqr", "pull": 0.01, "stop": {"passes": 5}}),
        json!({"type": "asd-pocs", "stop": {"passes": 4}}),
        json!({"type": "fista", "prior": "total-variation", "stop": {"passes": 5}, "scene": {"surround": {"coarse": {}}}}),
        json!({"type": "fista", "prior": "none", "bin": 2, "air": true, "stop": {"passes": 5}}),
        json!({"type": "fista", "stop": {"passes": 5}, "scene": {"bounds": {"low": 0.0, "high": 0.015}},
            "prior": {"type": "directional-total-variation", "arc": 0.5}}),
        json!({"type": "fista", "prior": "total-variation", "stop": {"passes": 4}, "scene": {"bounds": {"regions": [
            {"within": {"cuboid": {"low": [-30, -20, -30], "high": [10, 30, 20]}}, "low": 0.02, "high": 0.02},
        ]}}}),
        json!({"type": "fista", "stop": {"passes": 4},
            "prior": {"type": "sum", "priors": ["total-variation", "directional-total-variation"]}}),
        json!({"type": "fista", "prior": "directional-total-variation", "stop": {"passes": 5},
            "basis": {"type": "cubic", "spacing": 1.5}, "scene": {"support": "carve"}}),
        smooth(),
    ]
}

#[test]
fn every_number_of_ranks_ends_where_one_does() {
    let scan = scan();
    for method in &methods() {
        let want = volume(method, &scan, &Cpu::new());
        for count in [1, 2, 3, 7] {
            let found = each(count, |backend| volume(method, &scan, backend));
            let error = off(&found[0], &want);
            println!("{}, {count} ranks: {error:.1e}", method["type"]);
            assert!(error < 1e-5, "{method}, {count} ranks: {error}");
            assert!(found.iter().all(|x| *x == found[0]), "{method}: {count} ranks end at different volumes");
        }
        // The limit is far below what a lost plane changes.
        let mut lost = want.clone();
        lost.index_axis_mut(Axis(0), 7).fill(0.0);
        assert!(off(&lost, &want) > 1e-2, "{method}");
    }
}

/// Root mean square of the differences as a share of the largest number.
pub fn rms(found: &Array3<f32>, want: &Array3<f32>) -> f32 {
    let top = want.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let squares: f32 = found.iter().zip(want).map(|(a, b)| ((a - b) / top).powi(2)).sum();
    (squares / want.len() as f32).sqrt()
}

/// Devices add atomically, in no fixed order: their volumes differ by rounding. Where slopes are next to 0, edges magnify
/// that.
#[test]
fn several_devices_end_where_one_does() {
    let scan = scan();
    let devices = backends("several devices");
    for method in &methods() {
        for some in [&devices[..devices.len() / 2], &devices[devices.len() / 2..]] {
            let Some((_, one)) = some.first() else { return };
            let want = volume(method, &scan, *one);
            let places: Vec<_> = some.iter().map(|(_, device)| device.place()).collect();
            let found = on(&places, |backend| volume(method, &scan, backend));
            let error = [off(&found[0], &want), rms(&found[0], &want)];
            println!("{}, {} devices: {error:?}", method["type"], places.len());
            assert!(error[0] < 1e-4 && error[1] < 1e-5, "{method}, {} devices: {error:?}", places.len());
        }
    }
}

/// A pass reads the partial line integrals of all views from each device, and its residuals, which the others load. A
/// device loads the sums of its own views and the others' residuals.
#[test]
fn a_pass_moves_the_views_between_devices() {
    let scan = larger();
    let devices = crate::device::alone("bytes between devices");
    let Some(some) = devices.get(..2) else { return };
    let moved = |passes: u64| {
        let before: Vec<_> = some.iter().map(|(_, device)| device.moved()).collect();
        let method = json!({"type": "sart", "subsets": 1, "stop": {"passes": passes}});
        let places: Vec<_> = some.iter().map(|(_, device)| device.place()).collect();
        on(&places, |backend| volume(&method, &scan, backend));
        let moved = |(before, (_, device)): (&Moved, &(_, Wgpu))| {
            let now = device.moved();
            [now.to_device - before.to_device, now.from_device - before.from_device].map(|bytes| bytes as f64)
        };
        before.iter().zip(some).map(moved).collect::<Vec<_>>()
    };
    let views = 4.0 * scan.projections.len() as f64;
    for (two, five) in moved(2).into_iter().zip(moved(5)) {
        for (way, want) in [views, 1.5 * views].into_iter().enumerate() {
            let each = (five[way] - two[way]) / 3.0;
            println!("{each} bytes in a pass, {want} of them pixels");
            assert!(each >= want && each < 1.1 * want, "{each} and {want}");
        }
    }
}

/// Devices that have no room for their parts of the arrays keep these on the host, all of them or none.
#[test]
fn devices_without_room_share_a_volume() {
    let scan = larger();
    let volume_bytes = 4 * scan.geometry.volume.len().unwrap() as u64;
    let Some(devices) = [2, 20].map(|n| little(n * volume_bytes)).into_iter().collect::<Option<Vec<_>>>() else {
        return;
    };
    let places: Vec<_> = devices.iter().map(|device| device.place()).collect();
    for (bytes, holds) in [(volume_bytes, true), (8 * volume_bytes, false), (100 * volume_bytes, false)] {
        assert_eq!(on(&places, |backend| backend.place().holds(bytes)), [holds; 2], "{bytes} bytes");
    }
    let method = json!({"type": "fista", "prior": "total-variation", "stop": {"passes": 3}});
    let want = volume(&method, &scan, &Cpu::new());
    for found in on(&places, |backend| volume(&method, &scan, backend)) {
        let error = rms(&found, &want);
        println!("{error:.1e}");
        assert!(error < 1e-5, "{error}");
    }
}

/// Slopes along the middle of an arc cost less, also beside the planes of another rank.
#[test]
fn a_limited_arc_is_the_same_for_ranks() {
    let mut scan = scan();
    scan.geometry.views.truncate(3);
    scan.projections.slice_axis_inplace(Axis(0), (..3).into());
    let method = |arc: f64| json!({"type": "fista", "stop": {"passes": 4}, "prior": {"type": "directional-total-variation", "arc": arc}});
    let want = volume(&method(0.3), &scan, &Cpu::new());
    assert!(off(&volume(&method(1.0), &scan, &Cpu::new()), &want) > 1e-2, "the arc has an effect");
    let found = each(3, |backend| volume(&method(0.3), &scan, backend));
    assert!(off(&found[0], &want) < 1e-5);
}

/// More ranks than planes of the volume or images of a subset.
#[test]
fn a_rank_without_a_plane_takes_part() {
    let mut scan = scan();
    scan.geometry.volume.shape[0] = 3;
    for prior in ["total-variation", "directional-total-variation"] {
        let method = json!({"type": "fista", "prior": prior, "stop": {"passes": 3}});
        let want = volume(&method, &scan, &Cpu::new());
        let found = each(5, |backend| volume(&method, &scan, backend));
        assert!(off(&found[4], &want) < 1e-5, "{prior}");
    }
}

#[test]
fn another_number_of_ranks_goes_on_from_a_checkpoint() {
    let method = json!({"type": "fista", "prior": "directional-total-variation", "stop": {"passes": 6}, "subsets": 4});
    let scan = scan();
    let want = volume(&method, &scan, &Cpu::new());
    let kept = each(3, |backend| {
        let mut stop = Stop::at(3);
        let mut plan = plan(&spec(&method).unwrap(), backend, &Weights::default()).unwrap();
        let ended = plan.run(&Job { seed: 7, ..Job::new(&scan, backend) }, &mut stop);
        assert!(matches!(ended, Err(Error::Interrupted { step: 3 })));
        stop.kept.unwrap()
    });
    let resumed = |backend: &dyn Backend, resume: &Resume| {
        let mut plan = plan(&spec(&method).unwrap(), backend, &Weights::default()).unwrap();
        let job = Job { seed: 7, resume: Some(resume), ..Job::new(&scan, backend) };
        plan.run(&job, &mut Heard::default()).unwrap().result.volume(backend).unwrap().data
    };
    // The leading rank's checkpoint is whole.
    assert!(off(&resumed(&Cpu::new(), &kept[0]), &want) < 1e-5);
    for count in [2, 3] {
        let found = each(count, |backend| resumed(backend, &kept[0]));
        assert!(off(&found[0], &want) < 1e-5, "{count}");
    }
}

/// One rank is asked to stop: all stop after the same pass.
#[test]
fn ranks_stop_together() {
    let method = json!({"type": "sart", "stop": {"passes": 9}});
    let scan = scan();
    each(3, |backend| {
        let mut stop = Stop::at(if backend.0.slab(3, 0).unwrap().own.contains(&1) { 2 } else { 100 });
        let mut plan = plan(&spec(&method).unwrap(), backend, &Weights::default()).unwrap();
        let ended = plan.run(&Job::new(&scan, backend), &mut stop);
        assert!(matches!(ended, Err(Error::Interrupted { step: 2 })));
    });
}

/// An observer whose disk is full.
struct Full {
    stop: Stop,
    due: bool,
    warned: usize,
}

impl Observer for Full {
    fn progress(&mut self, step: u64, share: f64, left: f64) {
        self.stop.progress(step, share, left);
    }
    fn record(&mut self, _: &Record) {}
    fn note(&mut self, _: &str) {}
    fn warn(&mut self, text: &str) {
        assert!(text.contains("goes on") && text.contains("disk"), "{text}");
        self.warned += 1;
    }
    fn cancelled(&self) -> bool {
        self.stop.cancelled()
    }
    fn checkpoint_due(&self) -> bool {
        self.due
    }
    fn checkpoint(&mut self, _: &Checkpoint<'_>) -> Result<()> {
        Err(Error::unsupported("checkpoint", "no room on the disk"))
    }
}

/// A place with room for a few planes only.
struct Small(usize);

impl Place for Small {
    fn zeros(&self, shape: [usize; 3]) -> Result<Array> {
        if shape[0] > self.0 { Err(Error::unsupported("memory", "none is left")) } else { Host.zeros(shape) }
    }
    fn load(&self, from: ArrayView3<'_, f32>, to: &mut Array, first: usize) -> Result<()> {
        Host.load(from, to, first)
    }
    fn store(&self, from: &Array, first: usize, to: ArrayViewMut3<'_, f32>) -> Result<()> {
        Host.store(from, first, to)
    }
}

/// `fdk` tries smaller slabs where an array finds no room: all ranks must take the same ones.
#[test]
fn an_array_that_one_rank_has_no_room_for_is_refused_by_all() {
    let places: Vec<Arc<dyn Place>> = vec![Arc::new(Host), Arc::new(Small(3)), Arc::new(Host)];
    for (planes, fits) in [(9, true), (12, false), (9, true)] {
        let made = on(&places, |backend| backend.place().zeros([planes, 2, 2]).is_ok());
        assert_eq!(made, [fits; 3], "{planes} planes");
    }
}

/// A run that goes on needs no checkpoint. One that ends needs it, whichever rank was asked to stop.
#[test]
fn a_checkpoint_without_room_is_an_error_where_the_run_ends() {
    let link = json!({"type": "sart", "stop": {"passes": 3}});
    let chain = json!({"type": "chain", "methods": [link, {"type": "sart", "stop": {"passes": 2}}]});
    let scan = scan();
    for method in [link, chain] {
        let run = |backend: &dyn Backend, at: u64, due: bool| {
            let mut full = Full { stop: Stop::at(at), due, warned: 0 };
            let mut plan = plan(&spec(&method).unwrap(), backend, &Weights::default()).unwrap();
            let ended = plan.run(&Job::new(&scan, backend), &mut full).map(drop);
            (ended, full.warned)
        };
        let (ended, warned) = run(&Cpu::new(), 100, true);
        assert!(ended.is_ok() && warned >= 2, "{method}: {ended:?}, {warned}");
        let ended = each(3, |backend| {
            let last = backend.0.slab(3, 0).unwrap().own.contains(&2);
            run(backend, if last { 2 } else { 100 }, false).0.unwrap_err().to_string()
        });
        assert!(ended.iter().all(|e| e.contains("disk")), "{ended:?}");
    }
}

/// Line integrals are summed where they are kept, and their images go to all: with n ranks, each sends a share of
/// (n − 1)/n of all pixels twice in a pass, and besides it sums of a few bytes.
#[test]
fn a_pass_sends_all_pixels_twice() {
    let scan = scan();
    let pixels = scan.projections.len() as f64;
    for count in [2, 4] {
        let sent = |passes: u64| {
            let method = json!({"type": "sart", "subsets": 1, "stop": {"passes": passes}});
            each(count, |backend| {
                volume(&method, &scan, backend);
                backend.0.sent() as f64
            })
        };
        let (two, five) = (sent(2), sent(5));
        for (two, five) in two.into_iter().zip(five) {
            let each = (five - two) / 3.0;
            let want = 2.0 * 4.0 * pixels * (count - 1) as f64 / count as f64;
            println!("{count} ranks: {each} bytes in a pass, {want} of them pixels");
            assert!(each >= want && each < want + 512.0, "{count} ranks: {each} and {want}");
        }
    }
}

#[test]
fn a_projector_of_samples_is_refused() {
    let method = json!({"type": "sart", "projector": {"type": "trilinear"}, "stop": {"passes": 1}});
    let scan = scan();
    for said in each(2, |backend| solve_on(backend, &method, &scan, &Weights::default()).err().unwrap().to_string()) {
        assert!(said.contains("projector") && said.contains("sums of those of slabs"), "{said}");
    }
}
