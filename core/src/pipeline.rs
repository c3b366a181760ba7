//! Pipelines: encoder, normalizers and field, built and checked, with their parameter layout.

use crate::arena::{Arena, Block, Layout};
use crate::error::{Result, ensure};
use crate::opened::Opened;
use crate::scene::Scene;
use crate::simd::Real;
use crate::stage::{
    Backward, Encoder, Field, Info, Kernel, Lengths, Normalizer, Parameter, Projector, Samples, Scope, Stage, Tile,
    TileMut, UnitRay,
};
use std::ops::Range;
use std::sync::Arc;

/// The built stages of a field, in order, with the arena's layout. Copies share the stages.
#[derive(Clone)]
pub struct Pipeline {
    /// Points to features.
    pub encoder: Arc<dyn Encoder>,
    /// Features to features.
    pub normalizers: Vec<Arc<dyn Normalizer>>,
    /// Features to attenuation.
    pub field: Arc<dyn Field>,
    /// Rays to samples.
    pub projector: Arc<dyn Projector>,
    layout: Layout,
    ranges: Vec<Range<usize>>,
    /// The whole encoder and its number of open channels, if some are closed.
    whole: Option<(Arc<dyn Encoder>, usize)>,
}

/// A pipeline with its parameters.
pub struct Model {
    /// The stages.
    pub pipeline: Pipeline,
    /// Their parameters, gradients and optimizer state.
    pub arena: Arena,
    masks: Vec<Vec<usize>>,
}

impl Pipeline {
    /// Assembles stages. Refuses stages that do not fit together, before any parameter is allocated; the error names
    /// the key of the stage.
    pub fn new(
        encoder: Box<dyn Encoder>,
        normalizers: Vec<Box<dyn Normalizer>>,
        field: Box<dyn Field>,
        projector: Box<dyn Projector>,
    ) -> Result<Self> {
        let mut width = check("encoder", encoder.as_ref(), 3)?;
        let (found, expected) = ("one whose rows depend on each other", "an encoder that treats each point alone");
        ensure(encoder.info().scope == Scope::Row, "spec", "encoder", found, expected)?;
        for (i, n) in normalizers.iter().enumerate() {
            width = check(&format!("normalizers.{i}"), n.as_ref(), width)?;
        }
        let out = check("field", field.as_ref(), width)?;
        ensure(out == 1, "spec", "field", format!("{out} channels out"), "1, the attenuation")?;
        let layout = Layout::default();
        let (encoder, field, projector) = (Arc::from(encoder), Arc::from(field), Arc::from(projector));
        let normalizers = normalizers.into_iter().map(Arc::from).collect();
        let mut pipeline = Self { encoder, normalizers, field, projector, layout, ranges: vec![], whole: None };
        pipeline.lay_out();
        // Checks, for any scene, that the encoder reports the lengths that the projector's settings are relative to.
        pipeline.fitted(pipeline.lengths(1.0, 1.0))?;
        Ok(pipeline)
    }

    /// A pipeline of a field with line integrals of its own ([`Field::lines`]), which reads positions.
    pub fn alone(field: Box<dyn Field>) -> Result<Self> {
        ensure(field.lines().is_some(), "spec", "field", "none", "line integrals of the field's own")?;
        Self::new(Box::new(Positions), vec![], field, Box::new(NoSamples))
    }

    fn lay_out(&mut self) {
        let mut blocks = vec![];
        let mut ranges = vec![];
        let mut start = 0;
        for (name, stage) in self.stages() {
            let end = start + stage.info().params;
            for p in stage.parameters() {
                let r = p.range();
                blocks.push(Block {
                    name: format!("{name}.{}", p.name),
                    shape: p.shape,
                    range: start + r.start..start + r.end,
                });
            }
            ranges.push(start..end);
            start = end;
        }
        self.layout = Layout { blocks };
        self.ranges = ranges;
    }

    /// Encoder, normalizers and field with the names of their parameters in the arena. A normalizer is named by its
    /// position among those with parameters, so that a mask beside it does not change the names in a weights file.
    pub fn stages(&self) -> Vec<(String, &dyn Stage)> {
        let mut all: Vec<(String, &dyn Stage)> = vec![("encoder".into(), self.encoder.as_ref())];
        let mut index = 0;
        for n in &self.normalizers {
            all.push((format!("normalizers.{index}"), n.as_ref()));
            index += usize::from(n.info().params > 0);
        }
        all.push(("field".into(), self.field.as_ref()));
        all
    }

    /// Names and positions of all parameters.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Parameter range of each of [`Pipeline::stages`].
    pub fn ranges(&self) -> &[Range<usize>] {
        &self.ranges
    }

    /// The widest scope of all stages.
    pub fn scope(&self) -> Scope {
        let ray = self.stages().iter().any(|(_, s)| s.info().scope == Scope::Ray);
        if ray { Scope::Ray } else { Scope::Row }
    }

    /// Returns and clears the first error of a stage since the last call; see [`Stage::fault`].
    pub fn fault(&self) -> Result<()> {
        self.stages().iter().try_for_each(|(_, s)| s.fault())?;
        self.projector.fault()
    }

    /// Whether `ray` crosses the scene.
    pub fn sees(&self, ray: &UnitRay) -> bool {
        if self.field.lines().is_some() { ray.inside[1] > ray.inside[0] } else { self.projector.max_samples(ray) > 0 }
    }

    /// Multiply-adds of the forward pass, per sample.
    pub fn macs(&self) -> usize {
        self.stages().iter().map(|(_, s)| s.info().macs).sum()
    }

    /// The encoder's channels needed to resolve `cells` along the unit cube's side: all up to the coarsest sufficient
    /// resolution. `None` if all are needed.
    pub fn needed(&self, cells: f64) -> Option<Vec<usize>> {
        let all = self.encoder.resolutions()?;
        // Slightly more, so that a cube of 256 voxels counts as 256 cells.
        let enough = all.iter().copied().filter(|r| 1.001 * r >= cells).fold(f64::INFINITY, f64::min);
        let keep: Vec<usize> = (0..all.len()).filter(|&c| all[c] <= enough).collect();
        (keep.len() < all.len()).then_some(keep)
    }

    /// Sets the lengths of settings that count in units of the scene. Returns whether a stage changed.
    pub fn fit(&mut self, scene: &Scene) -> Result<bool> {
        let fitted = self.fitted(self.lengths(scene.voxel_mm(), scene.side))?;
        let changed = fitted.is_some();
        if let Some(projector) = fitted {
            self.projector = Arc::from(projector);
        }
        Ok(changed)
    }

    fn fitted(&self, lengths: Lengths) -> Result<Option<Box<dyn Projector>>> {
        self.projector.fitted(lengths).map_err(|e| e.within("projector"))
    }

    /// The lengths that settings may count in, for a unit cube with a side of `side` mm.
    fn lengths(&self, voxel_mm: f64, side: f64) -> Lengths {
        let finest = self.encoder.resolutions().map(|all| all.into_iter().fold(1.0, f64::max));
        Lengths { voxel_mm, cell_mm: finest.filter(|n| *n > 0.0).map(|n| side / n) }
    }

    /// Number of open channels of the encoder: the first ones. The others are 0.
    pub fn open_channels(&self) -> usize {
        self.whole.as_ref().map_or(self.encoder.info().output, |(_, open)| *open)
    }

    /// Opens the first `channels` of the encoder and closes the others: they are 0 and not computed, and their
    /// parameters do not change. At least one channel stays open.
    pub fn open(&mut self, channels: usize) -> Result<()> {
        let whole = self.whole.as_ref().map_or_else(|| self.encoder.clone(), |(whole, _)| whole.clone());
        if channels < whole.info().output {
            self.encoder = Arc::new(Opened::new(whole.clone(), channels)?);
            self.whole = Some((whole, channels));
        } else {
            (self.encoder, self.whole) = (whole, None);
        }
        Ok(())
    }

    /// Keeps only `masked` of the encoder's channels: the encoder no longer computes the others, later stages become
    /// narrower, and unused parameters leave the arena.
    fn apply_mask(&mut self, masked: &[usize], arena: &mut Arena) -> Result<()> {
        let (whole, open) = match &self.whole {
            Some((whole, open)) => (whole, *open),
            None => (&self.encoder, usize::MAX),
        };
        let encoder = whole.keep_outputs(masked)?;
        let open = masked.iter().filter(|c| **c < open).count().max(1);
        let mut kept = vec![encoder.params];
        let mut keep = masked.to_vec();
        let mut normalizers = vec![];
        for n in &self.normalizers {
            let r = n.keep_inputs(&keep)?;
            normalizers.push(Arc::from(r.stage));
            kept.push(r.params);
            keep = r.channels;
        }
        let field = self.field.keep_inputs(&keep)?;
        kept.push(field.params);
        (self.encoder, self.normalizers, self.field) = (Arc::from(encoder.stage), normalizers, Arc::from(field.stage));
        let all = kept.iter().zip(&self.ranges);
        let ranges: Vec<_> =
            all.flat_map(|(k, whole)| k.iter().map(|r| whole.start + r.start..whole.start + r.end)).collect();
        arena.retain(&ranges);
        self.whole = None;
        self.open(open)?;
        self.lay_out();
        debug_assert_eq!(arena.params.len(), self.layout.len());
        Ok(())
    }
}

impl Model {
    /// A model with every parameter initialized by its own stage.
    pub fn random(pipeline: Pipeline, seed: u64) -> Self {
        let mut arena = Arena::new(pipeline.layout.len());
        for ((i, (_, stage)), range) in pipeline.stages().into_iter().enumerate().zip(&pipeline.ranges) {
            stage.init(
                seed.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(i as u64),
                &mut arena.params[range.clone()],
            );
        }
        Self { pipeline, arena, masks: vec![] }
    }

    /// The encoder's remaining channels after each masking, ascending, as indices into the channels before it.
    pub fn masks(&self) -> &[Vec<usize>] {
        &self.masks
    }

    /// Permanently removes all encoder channels but `keep`.
    pub fn mask(&mut self, keep: Vec<usize>) -> Result<()> {
        let width = self.pipeline.encoder.info().output;
        let ascending = keep.is_sorted_by(|a, b| a < b) && keep.last().is_some_and(|&k| k < width);
        let expected = format!("some of channels 0 to {}, ascending", width - 1);
        ensure(ascending, "model", "channels to keep", format!("{keep:?}"), expected)?;
        self.pipeline.apply_mask(&keep, &mut self.arena)?;
        self.masks.push(keep);
        Ok(())
    }
}

/// Placeholder encoder for fields that need none: positions are the features.
struct Positions;

impl<R: Real> Kernel<R> for Positions {
    fn forward(&self, _: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
        y.data.copy_from_slice(x.data);
    }

    fn backward(&self, Backward { dy, dx, .. }: Backward<'_, R>) {
        if let Some(dx) = dx {
            dx.data.copy_from_slice(dy.data);
        }
    }
}

impl Stage for Positions {
    fn info(&self) -> Info {
        Info { input: 3, output: 3, identity: true, ..Info::default() }
    }

    fn parameters(&self) -> Vec<Parameter> {
        vec![]
    }

    fn init(&self, _: u64, _: &mut [f32]) {}

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn describe(&self) -> String {
        "none: the field reads positions".into()
    }
}

impl Encoder for Positions {}

/// Placeholder projector for fields that need none.
struct NoSamples;

impl Projector for NoSamples {
    fn max_samples(&self, _: &UnitRay) -> usize {
        0
    }

    fn sample(&self, _: &UnitRay, _: Option<u64>, _: &mut Samples) {}

    fn describe(&self) -> String {
        "none: the field brings line integrals of its own".into()
    }
}

fn check(name: &str, stage: &dyn Stage, width: usize) -> Result<usize> {
    let Info { input, output, .. } = stage.info();
    ensure(input == width, "spec", name, format!("{width} channels from the stage before"), format!("{input}"))?;
    ensure(output > 0, "spec", name, "no channels out", "at least one")?;
    Ok(output)
}
