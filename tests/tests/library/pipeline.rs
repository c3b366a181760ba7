//! Whole pipelines: the gradient of a step, the same bits on any number of threads, any unit, weights from another
//! scan, and masked channels that leave the work.

use crate::common::{
    Heard, bits, decibels, model, moved, neural_field, pipeline, planned, point, protocol, rays, scan, solve,
    solve_from, truth, volume,
};
use conefield_backend_cpu::Cpu;
use conefield_backend_cpu::rows::Kernels;
use conefield_backend_cpu::step::Slots;
use conefield_core::Result;
use conefield_core::arena::Weights;
use conefield_core::backend::{Backend, BlockWork, Work};
use conefield_core::loss::Loss;
use conefield_core::method::{Limits, PretrainJob, Solution};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::scan::{Scan, Volume};
use conefield_core::trained::TrainedField;
use conefield_projectors::simulate::simulate;
use conefield_solvers::losses::{Huber, L2};
use conefield_solvers::priors::TotalVariation;
use serde_json::{Value, json};

fn settings() -> Value {
    neural_field(
        12,
        json!({
            "projector": {"type": "ray-march", "samples": 20, "sampling": "uniform"}, "loss": "l2",
            "training": {"steps": 40, "rays": 128, "report_every": 5}, "optimizer": {"lr": 0.02},
        }),
    )
}

// ---- the gradient of a whole step ----

/// A step's loss in double precision, as a function of the parameters.
struct Case<'a> {
    pipeline: &'a Pipeline,
    kernels: Kernels<'a, f64>,
    work: Work<'a>,
}

impl Case<'_> {
    fn step(&self, params: &[f64]) -> (f64, Vec<f64>) {
        let mut grads = vec![0.0; params.len()];
        let projector = self.pipeline.projector.as_ref();
        let stats = Slots::new(&self.kernels).step(&self.kernels, projector, params, &mut grads, &self.work);
        (stats.loss + stats.prior, grads)
    }

    /// Compares `grads` at the entries of `sampled` with central differences.
    ///
    /// The step is 1e-5 on parameters of order one. Central differences are wrong by h²·L‴/6, some 1e-10 times what
    /// the third derivative is larger than the first, and by the rounding of the loss over h, 1e-16/1e-5 = 1e-11.
    /// A thousand times that is allowed, relative to the block's largest gradient. A wrong formula is off by far
    /// more: a percent of one entry is found, see the negative control.
    fn compare(&self, params: &[f64], grads: &[f64], sampled: &[Vec<usize>]) -> Result<(), String> {
        let h = 1e-5;
        for block in sampled {
            let largest = block.iter().map(|&p| grads[p].abs()).fold(0.0, f64::max);
            for &p in block {
                let at = |d: f64| {
                    let mut moved = params.to_vec();
                    moved[p] += d;
                    self.step(&moved).0
                };
                let expected = (at(h) - at(-h)) / (2.0 * h);
                if (grads[p] - expected).abs() > 1e-7 * largest + 1e-9 {
                    return Err(format!("parameter {p}: gradient {}, differences {expected}", grads[p]));
                }
            }
        }
        Ok(())
    }
}

/// Of every block the largest gradient and ten others.
fn sample(pipeline: &Pipeline, grads: &[f64]) -> Vec<Vec<usize>> {
    let blocks = &pipeline.layout().blocks;
    let of = |b: &conefield_core::arena::Block| {
        let largest = b.range.clone().max_by(|&i, &j| grads[i].abs().total_cmp(&grads[j].abs())).unwrap();
        let every = (b.range.len() / 10).max(1);
        let others = b.range.clone().step_by(every).filter(move |&p| p != largest);
        std::iter::once(largest).chain(others).collect()
    };
    blocks.iter().map(of).collect()
}

/// Of a step of `count` rays, 50 points and 4 blocks of `edge`³.
fn gradients_of(settings: &Value, count: usize, edge: usize) {
    let pipeline = pipeline(settings);
    // Near and far from what the field says, so that Huber's two parts both occur.
    let rays = rays(count, |i| if i % 2 == 0 { 0.5 } else { 3.0 });
    // Rays that see nothing of the scene take part with a line integral of 0.
    let missed = rays.iter().filter(|r| r.ray.inside[0] == r.ray.inside[1]).count();
    assert!(missed <= count / 2, "{missed} of {count} rays miss the box");
    let points: Vec<_> = (0..50).map(|i| (point(i), if i % 2 == 0 { 0.7 } else { 4.0 })).collect();
    let corners: Vec<_> = (100..105).map(|i| point(i).map(|x| 0.7 * x)).collect();
    let spacing = [0.06, 0.05, 0.07].map(|x| 3.0 * x / edge as f32);
    let fine = TotalVariation { weight: 0.3, edge, smoothing: 1e-2, ..TotalVariation::default() };
    // Points of one block fill no vector: rows after it are padding.
    let coarse = TotalVariation { weight: 0.2, edge: 2, smoothing: 3e-2, ..TotalVariation::default() };
    let priors = [
        BlockWork { prior: &fine, corners: &corners[..4], spacing },
        BlockWork { prior: &coarse, corners: &corners[4..], spacing: [0.1; 3] },
    ];
    let params: Vec<f64> = moved(&pipeline).arena.params.iter().map(|&p| f64::from(p)).collect();
    let losses: [&dyn Loss; 2] = [&L2 {}, &Huber { delta: 0.5 }];
    for loss in losses {
        let kernels = Kernels::new(&pipeline, |s| s.reference().unwrap());
        let work = Work { step: 4, seed: 9, loss, rays: &rays, points: &points, priors: &priors };
        let case = Case { pipeline: &pipeline, kernels, work };
        let (value, grads) = case.step(&params);
        assert!(value.is_finite() && grads.iter().filter(|g| **g != 0.0).count() > grads.len() / 2);
        let sampled = sample(&pipeline, &grads);
        case.compare(&params, &grads, &sampled).unwrap();
        // Negative control: one entry, a percent off, in every block.
        for block in &sampled {
            let mut wrong = grads.clone();
            wrong[block[0]] *= 1.01;
            assert!(case.compare(&params, &wrong, std::slice::from_ref(block)).is_err());
        }
        // Every part is in the sum: without it the gradient is another.
        let parts = [
            Work { rays: &[], ..case.work.clone() },
            Work { points: &[], ..case.work.clone() },
            Work { priors: &[], ..case.work.clone() },
            Work { priors: &priors[..1], ..case.work.clone() },
        ];
        for work in parts {
            let kernels = Kernels::new(&pipeline, |s| s.reference().unwrap());
            let (_, other) = Case { pipeline: &pipeline, kernels, work }.step(&params);
            assert!(case.compare(&params, &other, &sampled).is_err());
        }
    }
}

#[test]
fn a_steps_gradient_is_that_of_its_loss() {
    gradients_of(&settings(), 40, 3);
}

/// They are processed in parts, because a worker holds a limited number of rows.
#[test]
fn a_steps_gradient_is_that_of_its_loss_where_rays_and_blocks_have_many_rows() {
    let mut long = settings();
    long["projector"]["samples"] = json!(700);
    gradients_of(&long, 6, 9);
}

/// Scattered parameters in the field, and more than one encoder in front.
#[test]
fn a_steps_gradient_is_that_of_its_loss_in_other_pipelines() {
    let mut voxels = settings();
    voxels["encoder"] = json!({"type": "identity"});
    voxels["normalizers"] = json!([]);
    voxels["field"] = json!({"type": "voxel-grid", "resolution": 4});
    gradients_of(&voxels, 40, 3);
    let mut concat = settings();
    let parts = json!([{"type": "frequency", "bands": 2, "max_frequency": 2.0}, {"type": "dense-grid", "levels": 2, "base_resolution": 2}]);
    concat["encoder"] = json!({"type": "concat", "encoders": parts});
    gradients_of(&concat, 40, 3);
}

// ---- threads ----

#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    let mut s = settings();
    s["encoder"]["levels"] = json!(5);
    s["projector"]["sampling"] = json!("stratified");
    // 25 000 rows a step: every slot has several groups.
    s["projector"]["samples"] = json!(48);
    s["training"]["rays"] = json!(512);
    s["training"]["steps"] = json!(10);
    s["priors"] = json!([{"type": "total-variation", "weight": 0.01, "blocks": 8, "edge": 4}]);
    let scan = scan();
    let run = |threads: usize, s: &Value| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (solution, records) = pool.install(|| solve(s, &scan)).unwrap();
        assert_eq!(solution.steps, 10);
        let volume = volume(&solution);
        let arena = &solution.result.field().unwrap().model.arena;
        let losses: Vec<u64> =
            records.iter().flat_map(|r| [r.loss.unwrap(), r.prior.unwrap()]).map(f64::to_bits).collect();
        let volume = bits(volume.data.as_slice().unwrap());
        ([bits(&arena.params), bits(&arena.first), bits(&arena.second), volume], losses)
    };
    let one = run(1, &s);
    assert!(one == run(2, &s), "two threads");
    assert!(one == run(3, &s), "three threads");
    // Negative control: bits that a hardly changed run does change.
    s["optimizer"]["lr"] = json!(0.020001);
    assert!(one != run(1, &s));
}

// ---- a loss that learns from the scan ----

#[test]
fn noise_weights_come_from_the_scan() {
    let protocol = protocol(json!({"detector": [64, 64]}));
    let scan = simulate(&truth(), &protocol.with_noise("tigre:1e3,0".parse().unwrap(), 5)).unwrap();
    let run = |loss: &str| {
        let mut s = settings();
        s["loss"] = json!(loss);
        let (solution, records) = solve(&s, &scan).unwrap();
        (model(solution).arena.params.to_vec(), records.last().unwrap().loss.unwrap())
    };
    let ([weighted, again], (plain, squares)) = ([(); 2].map(|()| run("noise-weighted")), run("l2"));
    assert!(weighted == again, "the same weights every time");
    assert!(weighted.0 != plain, "weights change the result");
    // Their mean is 1: the loss stays what it was, but for how noise and weights go together.
    assert!((0.3..1.0).contains(&(weighted.1 / squares)), "{} against {squares}", weighted.1);
}

// ---- export ----

/// The field that `value` trained, from its weights and its placement as it would come back from a file.
fn restored(value: &Value, field: &TrainedField) -> TrainedField {
    let weights = Weights::from_arena(field.model.pipeline.layout(), &field.model.arena.params, |_| true);
    let placement = serde_json::from_str(&serde_json::to_string(&field.placement()).unwrap()).unwrap();
    let load = &mut |model: &mut Model| {
        weights.load("test", model.pipeline.layout(), &mut model.arena.params, |_| true).map(drop)
    };
    planned(value, &Cpu::new()).unwrap().restore(&placement, load).unwrap()
}

#[test]
fn a_field_evaluated_part_by_part_is_the_same_to_the_bit() {
    let (solution, _) = solve(&settings(), &scan()).unwrap();
    let whole = volume(&solution);
    let mut voxels = solution.result.voxels(&Cpu::new()).unwrap();
    for part in [[0..16, 0..16, 3..4], [0..1, 5..16, 0..16], [7..12, 2..3, 1..16], [15..16, 15..16, 15..16]] {
        let mut found = ndarray::Array3::zeros(part.each_ref().map(|r| r.len()));
        voxels.fill(&part, found.view_mut()).unwrap();
        let [x, y, z] = part.clone();
        let want = whole.data.slice(ndarray::s![x, y, z]);
        assert!(found.iter().zip(&want).all(|(a, b)| a.to_bits() == b.to_bits()), "{part:?}");
    }
}

/// Weights with their placement make the same field again, with channels that a mask removed, and one on finer voxels
/// goes through the same places.
#[test]
fn a_field_comes_back_from_its_weights() {
    let mut s = settings();
    let width = s["encoder"]["levels"].as_u64().unwrap() * s["encoder"]["features"].as_u64().unwrap_or(2);
    let kept: Vec<u64> = (0..width - 1).collect();
    s["callbacks"] = json!([{"type": "fft-mask", "keep": kept}]);
    let (solution, _) = solve(&s, &scan()).unwrap();
    let field = solution.result.field().unwrap();
    assert_eq!(field.placement().masks.len(), 1);
    let again = restored(&s, field);
    let whole = volume(&solution);
    let values = |n: usize| {
        let grid = again.scene.grid.with_longest(n);
        Volume::collect(&mut again.voxels(&Cpu::new(), grid).unwrap()).unwrap()
    };
    assert_eq!(bits(values(16).data.as_slice().unwrap()), bits(whole.data.as_slice().unwrap()));
    // The middle one of three voxels has the centre of the one that they replace.
    let fine = values(48);
    assert!((fine.data[[22, 22, 22]] - whole.data[[7, 7, 7]]).abs() < 1e-5 * whole.data[[7, 7, 7]].abs().max(1e-3));
}

// ---- units ----

/// Line integrals times a over lengths times l make a/l in 1/mm. A share of what the scan takes by itself is of the scan
/// alone, a fixed attenuation is not.
#[test]
fn a_relative_attenuation_knows_no_unit() {
    let base = scan();
    let found = |attenuation: Value, scan: &Scan, scale: f64| {
        let mut s = settings();
        s["scene"] = json!({ "attenuation": attenuation });
        decibels(&volume(&solve(&s, scan).unwrap().0).data, scale)
    };
    let mut other = base.clone();
    other.projections.mapv_inplace(|a| 2.0 * a);
    let mut longer = other.clone();
    (longer.geometry, longer.unit.mm) = (base.geometry.scaled(1e3), 1e3);
    let empty = decibels(&ndarray::Array3::zeros(truth().data.dim()), 1.0);
    let [relative, fixed] = [json!({"relative": 0.5}), json!({"fixed": 0.02})];
    let right = found(relative.clone(), &base, 1.0);
    assert!(right > empty + 0.5, "{right} dB, an empty volume {empty}");
    for scan in [&other, &longer] {
        let apart = (right - found(relative.clone(), scan, 0.5)).abs();
        assert!(apart < 1e-3, "{apart} dB apart");
    }
    let apart = (found(fixed.clone(), &base, 1.0) - found(fixed, &other, 0.5)).abs();
    assert!(apart > 1e-3, "{apart} dB apart with a fixed attenuation");
}

// ---- weights from another scan ----

/// A field of `s` that learned two volumes in 60 steps, and its losses.
pub fn pretrained(s: &Value, backend: &dyn Backend) -> (Model, Vec<f64>) {
    let volumes = [truth(), truth().mapped(|x| 3.0 * x)];
    let limits = Limits { steps: Some(60), ..Limits::default() };
    let mut heard = Heard::default();
    let job = PretrainJob { volumes: &volumes, backend, seed: 21, limits };
    let model = planned(s, backend).unwrap().pretrain(&job, &mut heard).unwrap();
    (model, heard.records.iter().map(|r| r.loss.unwrap()).collect())
}

fn parts(model: &Model) -> (Vec<u32>, Vec<u32>) {
    let encoder = model.pipeline.ranges()[0].end;
    (bits(&model.arena.params[..encoder]), bits(&model.arena.params[encoder..]))
}

#[test]
fn weights_behind_the_encoder_go_to_another_scan() {
    let mut s = settings();
    s["pretraining"]["points"] = json!(512);
    let (trained, losses) = pretrained(&s, &Cpu::new());
    assert!(losses.last().unwrap() < &(0.9 * losses[0]), "{losses:?}");
    let weights = Weights::from_arena(trained.pipeline.layout(), &trained.arena.params, |_| true);

    let run = |s: &Value, steps: u64| -> Result<(Solution, Vec<f64>)> {
        let mut s = s.clone();
        // No step is refused: one that is too small to change anything stands for it.
        s["training"]["steps"] = json!(steps.max(1));
        if steps == 0 {
            s["optimizer"]["lr"] = json!(1e-60);
        }
        let (solution, records) = solve_from(&weights, &s, &scan())?;
        Ok((solution, records.iter().map(|r| r.loss.unwrap()).collect()))
    };
    let fresh = model(run(&s, 0).unwrap().0);
    s["initializer"] = json!({"type": "mci", "weights": "other.safetensors"});
    let loaded = model(run(&s, 0).unwrap().0);
    let ((fresh_encoder, fresh_rest), (encoder, rest)) = (parts(&fresh), parts(&loaded));
    let (trained_encoder, trained_rest) = parts(&trained);
    assert!(encoder == fresh_encoder && encoder != trained_encoder, "the encoder starts afresh");
    assert!(rest == trained_rest && rest != fresh_rest, "everything behind it is loaded");

    let (after, losses) = run(&s, 30).unwrap();
    assert!(losses.last().unwrap() < &(0.8 * losses[0]), "{losses:?}");
    let (encoder, rest) = parts(&model(after));
    assert!(encoder != fresh_encoder && rest != trained_rest, "all of it trains on");

    for (field, value) in [("width", json!(16)), ("depth", json!(4))] {
        let mut other = s.clone();
        other["field"][field] = value;
        let e = run(&other, 0).err().unwrap().to_string();
        assert!(e.contains("other.safetensors") && e.contains("field.") && e.contains("shape"), "{e}");
    }
    // Another encoder with as many channels is no obstacle.
    let mut other = s.clone();
    other["encoder"] = json!({"type": "dense-grid", "levels": 3, "base_resolution": 4});
    let other = model(run(&other, 0).unwrap().0);
    assert!(parts(&other).1 == trained_rest);
}

// ---- masks ----

#[test]
fn masked_channels_leave_the_work() {
    let mut s = settings();
    s["encoder"]["levels"] = json!(6);
    s["encoder"]["base_resolution"] = json!(2);
    // Fine levels hardly train in a pass and stay as random as they started.
    let mask = json!({"type": "fft-mask", "epoch": 1, "rule": "relative", "threshold": 0.72});
    s["callbacks"] = json!([{"type": "rollback"}, mask]);
    let whole = pipeline(&s);
    let (solution, records) = solve(&s, &scan()).unwrap();
    let model = model(solution);
    let p = &model.pipeline;
    let events: Vec<&String> = records.iter().flat_map(|r| &r.events).collect();
    assert_eq!(events.len(), 1, "{events:?}");
    println!("{}", events[0]);
    // 8 views make an epoch: the first record from step 8 on reports the mask.
    let reports = records.iter().map(|r| r.step).find(|step| *step >= 8);
    assert!(reports.is_some() && records.iter().all(|r| r.events.is_empty() == (Some(r.step) != reports)));

    let kept = p.encoder.info().output;
    assert!((1..12).contains(&kept) && events[0].contains(&format!("{kept} of 12")), "{kept}: {}", events[0]);
    let levels = |p: &Pipeline| p.layout().blocks.iter().filter(|b| b.name.starts_with("encoder.")).count();
    assert_eq!((levels(&whole), levels(p)), (6, kept.div_ceil(2)));
    assert!(p.layout().len() < whole.layout().len() && p.macs() < whole.macs());
    for part in [&model.arena.params, &model.arena.grads, &model.arena.first, &model.arena.second] {
        assert_eq!(part.len(), p.layout().len());
    }
    assert_eq!(p.field.info().input, kept);
    assert_eq!(p.layout().find("normalizers.0.weight").unwrap().shape, [kept]);

    // Training goes on: every loss is finite, the last below the one right after the mask, and weights still move.
    assert!(records.iter().all(|r| r.loss.unwrap().is_finite()));
    let after = records.iter().find(|r| r.step == 15).unwrap().loss.unwrap();
    let last = records.last().unwrap().loss.unwrap();
    assert!(last < after, "{after} after the mask, {last}");
    assert!(model.arena.first.iter().filter(|m| **m != 0.0).count() > model.arena.first.len() / 4);
}

// ---- what a scan has need of ----

/// 160 mm of voxels of 10 mm, seen by pixels of 11.7 mm at their distance: 14 cells are resolved, 16 suffice.
#[test]
fn channels_finer_than_the_data_leave_the_work() {
    let mut s = settings();
    s["encoder"] = json!({"type": "hash-grid", "levels": 6, "base_resolution": 2, "log2_table_size": 8});
    // A mask that has its own say afterwards.
    s["callbacks"] = json!([{"type": "fft-mask", "keep": [0, 1, 2, 3, 4, 5, 6, 9]}]);
    s["scene"] = json!({"levels": "needed"});
    let (solution, records) = solve(&s, &scan()).unwrap();
    assert_eq!(records.iter().flat_map(|r| &r.events).count(), 1);
    let field = solution.result.field().unwrap();
    let masks = field.placement().masks;
    // The mask counts the channels of the whole encoder.
    assert_eq!(masks, [(0..8).collect::<Vec<_>>(), (0..7).collect()]);
    let names: Vec<_> = field.model.pipeline.layout().blocks.iter().map(|b| b.name.as_str()).collect();
    assert!(names.contains(&"encoder.3.table") && !names.contains(&"encoder.4.table"), "{names:?}");

    // It comes back from its weights.
    let again = restored(&s, field);
    let values = Volume::collect(&mut again.voxels(&Cpu::new(), again.scene.grid).unwrap()).unwrap();
    assert_eq!(bits(values.data.as_slice().unwrap()), bits(volume(&solution).data.as_slice().unwrap()));

    // A grid that is coarser than the data keeps all.
    s["encoder"]["levels"] = json!(3);
    s["callbacks"] = json!([]);
    let (solution, _) = solve(&s, &scan()).unwrap();
    assert!(solution.result.field().unwrap().placement().masks.is_empty());
}

#[test]
fn a_step_in_voxels_is_one_in_millimetres() {
    let mut s = settings();
    let run = |projector: Value| {
        let mut s = s.clone();
        s["projector"] = projector;
        bits(&model(solve(&s, &scan()).unwrap().0).arena.params)
    };
    let voxels = run(json!({"type": "ray-march", "step_voxels": 1.5}));
    assert_eq!(voxels, run(json!({"type": "ray-march", "step_mm": 15.0})));
    assert_ne!(voxels, run(json!({"type": "ray-march", "step_mm": 10.0})));
    s["projector"] = json!({"type": "ray-march", "step_voxels": 1.5, "step_mm": 2.0});
    let e = solve(&s, &scan()).err().unwrap().to_string();
    assert!(e.contains("projector.step_voxels"), "{e}");
}
