//! A pipeline: encoder, normalizers and field, built and checked, with the layout of their parameters.

use crate::arena::{Arena, Block, Layout};
use crate::error::{Result, ensure};
use crate::opened::Opened;
use crate::precision::Tables;
use crate::scene::Scene;
use crate::simd::Real;
use crate::stage::{
    Encoder, Field, GradKind, Grads, Info, Kernel, Lengths, Normalizer, Parameter, Projector, Samples, Scope, Stage,
    Tile, TileMut, UnitRay,
};
use std::ops::Range;
use std::sync::Arc;

/// The built stages of a field, in order, with the arena's layout. A copy shares the stages.
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
    /// How tables of features are read.
    pub tables: Tables,
    layout: Layout,
    ranges: Vec<Range<usize>>,
    /// The encoder with every channel open, where some are closed, and how many are not.
    whole: Option<(Arc<dyn Encoder>, usize)>,
}

/// A pipeline with its parameters.
pub struct Model {
    /// The stages.
    pub pipeline: Pipeline,
    /// Their parameters and what training needs beside them.
    pub arena: Arena,
    masks: Vec<Vec<usize>>,
}

impl Pipeline {
    /// Puts stages together. Refuses those that do not fit, before any parameter is allocated; the error names the key of
    /// the stage.
    pub fn new(
        encoder: Box<dyn Encoder>,
        normalizers: Vec<Box<dyn Normalizer>>,
        field: Box<dyn Field>,
        projector: Box<dyn Projector>,
    ) -> Result<Self> {
        let mut width = check("encoder", encoder.as_ref(), 3)?;
        ensure(
            encoder.info().scope == Scope::Row,
            "spec",
            "encoder",
            "one whose rows depend on each other",
            "an encoder that treats each point alone",
        )?;
        for (i, n) in normalizers.iter().enumerate() {
            width = check(&format!("normalizers.{i}"), n.as_ref(), width)?;
        }
        let out = check("field", field.as_ref(), width)?;
        ensure(out == 1, "spec", "field", format!("{out} channels out"), "1, the attenuation")?;
        let (tables, layout) = (Tables::default(), Layout::default());
        let (encoder, field, projector) = (Arc::from(encoder), Arc::from(field), Arc::from(projector));
        let normalizers = normalizers.into_iter().map(Arc::from).collect();
        let mut pipeline = Self { encoder, normalizers, field, projector, tables, layout, ranges: vec![], whole: None };
        pipeline.lay_out();
        // Of any scene: whether the encoder knows what the projector counts in.
        pipeline.fitted(pipeline.lengths(1.0, 1.0))?;
        Ok(pipeline)
    }

    /// A field that brings line integrals of its own ([`Field::lines`]): it reads positions.
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

    /// Encoder, normalizers and field with the names under which their parameters stand in the arena. A
    /// normalizer is named by its place among those that have parameters, so that a mask beside it does not
    /// change the names in a weights file.
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

    /// Names and places of every parameter.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Where each of [`Pipeline::stages`] has its parameters.
    pub fn ranges(&self) -> &[Range<usize>] {
        &self.ranges
    }

    /// The furthest that any stage looks.
    pub fn scope(&self) -> Scope {
        let ray = self.stages().iter().any(|(_, s)| s.info().scope == Scope::Ray);
        if ray { Scope::Ray } else { Scope::Row }
    }

    /// What a stage could not do since this was last asked; see [`Stage::fault`].
    pub fn fault(&self) -> Result<()> {
        self.stages().iter().try_for_each(|(_, s)| s.fault())?;
        self.projector.fault()
    }

    /// Whether `ray` meets anything of the scene.
    pub fn sees(&self, ray: &UnitRay) -> bool {
        if self.field.lines().is_some() { ray.inside[1] > ray.inside[0] } else { self.projector.max_samples(ray) > 0 }
    }

    /// Multiply-adds a sample, forward.
    pub fn macs(&self) -> usize {
        self.stages().iter().map(|(_, s)| s.info().macs).sum()
    }

    /// The encoder's channels that a scene needs of which `cells` along the unit cube's side are to be told apart: all up to
    /// the coarsest that suffice. `None` where it needs all.
    pub fn needed(&self, cells: f64) -> Option<Vec<usize>> {
        let all = self.encoder.resolutions()?;
        // A hair more, so that a cube of 256 voxels takes 256 cells for enough.
        let enough = all.iter().copied().filter(|r| 1.001 * r >= cells).fold(f64::INFINITY, f64::min);
        let keep: Vec<usize> = (0..all.len()).filter(|&c| all[c] <= enough).collect();
        (keep.len() < all.len()).then_some(keep)
    }

    /// Takes a scene's lengths for the measure of what counts in them. Returns whether that changed a stage.
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

    /// What settings may count in, of a unit cube with a side of `side` mm.
    fn lengths(&self, voxel_mm: f64, side: f64) -> Lengths {
        let finest = self.encoder.resolutions().map(|all| all.into_iter().fold(1.0, f64::max));
        Lengths { voxel_mm, cell_mm: finest.filter(|n| *n > 1.0).map(|n| side / n) }
    }

    /// How many of the encoder's channels are open: the first ones. The others are 0.
    pub fn open_channels(&self) -> usize {
        self.whole.as_ref().map_or(self.encoder.info().output, |(_, open)| *open)
    }

    /// Opens the first `channels` of the encoder's and closes the others: they are 0 and not computed, and their parameters
    /// stay as they are. At least one stays open; as many as there are means all.
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

    /// Leaves of the encoder's channels only `masked`: it no longer computes the others, the stages after it become
    /// narrower, and parameters that nothing reads leave the arena.
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
    /// A model with every parameter as its stage's own scheme makes it.
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

    /// The encoder's channels that stayed each time some were removed: of those that it computed until then, ascending.
    pub fn masks(&self) -> &[Vec<usize>] {
        &self.masks
    }

    /// Removes all of the encoder's channels but `keep` for good.
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

/// Stands where a field needs no encoder: positions are its features.
struct Positions;

impl<R: Real> Kernel<R> for Positions {
    fn forward(&self, _: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
        y.data.copy_from_slice(x.data);
    }

    fn backward(
        &self,
        _: &[R],
        _: Tile<'_, R>,
        _: TileMut<'_, R>,
        dy: Tile<'_, R>,
        _: Grads<'_, R>,
        dx: Option<TileMut<'_, R>>,
    ) {
        if let Some(dx) = dx {
            dx.data.copy_from_slice(dy.data);
        }
    }
}

impl Stage for Positions {
    fn info(&self) -> Info {
        let (scope, grads) = (Scope::Row, GradKind::None);
        Info { input: 3, output: 3, params: 0, tape: 0, scope, grads, macs: 0, identity: true }
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

/// Stands where a field needs no projector.
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
