//! Masks in whole pipelines: what is removed, and that what is left computes what it did before.

use conefield_backend_cpu::Cpu;
use conefield_core::Result;
use conefield_core::backend::Backend;
use conefield_core::geometry::VoxelGrid;
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::scene::Scene;
use conefield_core::spec::{EncoderSpec, FieldSpec, NormalizerSpec};
use conefield_core::stage::{Projector, Samples, Stage, Tile, TileMut, UnitRay};
use serde_json::{Value, json};

use conefield_encoders as _;
use conefield_fields as _;
use conefield_normalizers as _;

struct Nothing;
impl Projector for Nothing {
    fn max_samples(&self, _: &UnitRay) -> usize {
        0
    }
    fn sample(&self, _: &UnitRay, _: Option<u64>, _: &mut Samples) {}
    fn describe(&self) -> String {
        "nothing".into()
    }
}

fn model(encoder: Value, normalizers: &[Value]) -> Model {
    let encoder = serde_json::from_value::<Box<dyn EncoderSpec>>(encoder).unwrap().build().unwrap();
    let mut width = encoder.info().output;
    let mut built = vec![];
    for n in normalizers {
        let n = serde_json::from_value::<Box<dyn NormalizerSpec>>(n.clone()).unwrap().build(width).unwrap();
        width = n.info().output;
        built.push(n);
    }
    let field = json!({"type": "mlp", "width": 8});
    let field = serde_json::from_value::<Box<dyn FieldSpec>>(field).unwrap().build(width).unwrap();
    let mut model = Model::random(Pipeline::assemble(encoder, built, field, Box::new(Nothing)), 5);
    for (i, p) in model.arena.params.iter_mut().enumerate() {
        *p += (i as f32).sin() * 0.2;
    }
    model
}

fn run(stage: &dyn Stage, params: &[f32], x: &[f32], rows: usize) -> Vec<f32> {
    let (mut y, mut tape) = (vec![0.0; stage.info().output * rows], vec![0.0; stage.info().tape * rows]);
    stage.kernel().forward(params, Tile::new(x, rows), TileMut::new(&mut y, rows), TileMut::new(&mut tape, rows));
    y
}

/// Outputs of every stage at some points. `zero` sets channels of one stage's output to 0.
fn evaluate(model: &Model, points: &[[f32; 3]], zero: Option<(usize, &[usize])>) -> Vec<Vec<f32>> {
    let n = points.len();
    let mut x: Vec<f32> = (0..3).flat_map(|d| points.iter().map(move |p| p[d])).collect();
    let mut all = vec![];
    for (i, ((_, stage), range)) in model.pipeline.stages().into_iter().zip(model.pipeline.ranges()).enumerate() {
        x = run(stage, &model.arena.params[range.clone()], &x, n);
        if let Some((at, channels)) = zero
            && at == i
        {
            channels.iter().for_each(|c| x[c * n..(c + 1) * n].fill(0.0));
        }
        all.push(x.clone());
    }
    all
}

fn points() -> Vec<[f32; 3]> {
    (0..50).map(|i| [0.37, 0.61, 0.83].map(|a| (i as f32 * a).fract())).collect()
}

fn refresh(model: &mut Model, epoch: f64) -> Result<Vec<String>> {
    let grid = VoxelGrid { shape: [16, 12, 8], spacing: [1.0; 3], center: [0.0; 3] };
    let scene = Scene::with_attenuation(grid, &conefield_core::spec::SceneSettings::default(), 1.0)?;
    let backend = Cpu::new();
    let mut exe = backend.compile(&model.pipeline)?.0;
    model.refresh(&scene, epoch, &backend, &mut exe)
}

fn dense() -> Value {
    json!({"type": "dense-grid", "levels": 3, "base_resolution": 3})
}

/// NI-NeRF's order: statistics over every channel, then noise to zero. The encoder computes every channel still, and
/// the rest of the pipeline is as if the masked channels were 0.
#[test]
fn a_mask_after_layer_norm_keeps_the_statistics() {
    let mask = json!({"type": "fft-mask", "keep": [0, 1, 4]});
    let mut model = model(dense(), &[json!({"type": "layer-norm"}), mask]);
    let before = evaluate(&model, &points(), Some((2, &[2, 3, 5])));
    let reports = refresh(&mut model, 0.0).unwrap();
    assert!(reports.len() == 1 && reports[0].contains("3 of 6"), "{reports:?}");
    assert_eq!(model.pipeline.encoder.info().output, 6);
    assert_eq!(model.pipeline.normalizers[0].info().output, 3);
    assert_eq!(model.arena.params.len(), model.pipeline.layout().len());
    let after = evaluate(&model, &points(), None);
    for (a, b) in after[3].iter().zip(&before[3]) {
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }
    assert!(refresh(&mut model, 100.0).unwrap().is_empty(), "a mask is decided once");
}

/// In front of everything else a mask takes whole levels out of the encoder and channels out of the statistics.
#[test]
fn a_mask_before_layer_norm_removes_levels_and_parameters() {
    let mask = json!({"type": "fft-mask", "keep": [0, 1]});
    let mut model = model(dense(), &[mask, json!({"type": "layer-norm"})]);
    let features = evaluate(&model, &points(), None).swap_remove(0);
    let old = model.arena.params.len();
    refresh(&mut model, 0.0).unwrap();
    let after = evaluate(&model, &points(), None);
    assert_eq!(after[0], features[..2 * points().len()]);
    assert_eq!(model.pipeline.normalizers[1].info().input, 2);
    let names: Vec<_> = model.pipeline.layout().blocks.iter().map(|b| b.name.as_str()).collect();
    assert_eq!(names[..3], ["encoder.0.table", "normalizers.0.weight", "normalizers.0.bias"]);
    assert!(model.arena.params.len() < old / 2);
}

#[test]
fn a_measured_mask_waits_for_its_epoch_and_runs_once() {
    let mask = json!({"type": "fft-mask", "epoch": 3, "rule": "relative"});
    let mut model = model(dense(), &[mask]);
    assert!(refresh(&mut model, 2.9).unwrap().is_empty());
    let reports = refresh(&mut model, 3.0).unwrap();
    assert!(reports.len() == 1 && reports[0].contains("of 6 channels kept"), "{reports:?}");
    assert!(refresh(&mut model, 4.0).unwrap().is_empty());
}

#[test]
fn finer_channels_need_an_order() {
    let parts = json!([{"type": "identity"}, dense()]);
    let concat = json!({"type": "concat", "encoders": parts});
    let e = refresh(&mut model(concat.clone(), &[json!({"type": "fft-mask"})]), 10.0).unwrap_err().to_string();
    assert!(e.contains("scope = \"channel\""), "{e}");
    let mut channel = model(concat, &[json!({"type": "fft-mask", "scope": "channel"})]);
    assert_eq!(refresh(&mut channel, 10.0).unwrap().len(), 1);
}
