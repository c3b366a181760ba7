//! A pipeline: encoder, normalizers and field, built and checked, with the layout of their parameters.

use crate::arena::{Arena, Block, Layout};
use crate::backend::{Backend, Executable};
use crate::error::{Result, ensure};
use crate::scene::Scene;
use crate::spec::{Spec, Tables};
use crate::stage::{Encoder, Field, Info, Lengths, Normalizer, Probe, Projector, Scope, Stage};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// The built stages of a spec, in order, with the arena's layout.
pub struct Pipeline {
    /// Points to features.
    pub encoder: Box<dyn Encoder>,
    /// Features to features.
    pub normalizers: Vec<Box<dyn Normalizer>>,
    /// Features to attenuation.
    pub field: Box<dyn Field>,
    /// Rays to samples.
    pub projector: Box<dyn Projector>,
    /// How tables of features are read.
    pub tables: Tables,
    layout: Layout,
    ranges: Vec<Range<usize>>,
}

/// A pipeline with its parameters.
pub struct Model {
    /// The stages.
    pub pipeline: Pipeline,
    /// Their parameters and what training needs beside them.
    pub arena: Arena,
    masks: Vec<Masked>,
}

/// Channels that were removed for good.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Masked {
    /// Which normalizer removed some of its own, counted from 0; none where the scene has no need of some of the encoder's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub normalizer: Option<usize>,
    /// Channels that stayed, of those computed until then; ascending.
    pub keep: Vec<usize>,
}

impl Pipeline {
    /// Builds every stage of `spec` and refuses combinations that do not fit, before any parameter is allocated.
    pub fn build(spec: &Spec) -> Result<Self> {
        let need = |what: &str| crate::Error::invalid("spec", what, "nothing", format!("a table [{what}] with a type"));
        let encoder = spec.encoder.as_ref().ok_or_else(|| need("encoder"))?.build()?;
        let mut width = check("encoder", encoder.as_ref(), 3)?;
        let scope = encoder.info().scope;
        ensure(
            scope == Scope::Row,
            "spec",
            "encoder",
            "one whose rows look at each other",
            "an encoder that treats each point alone",
        )?;
        let mut normalizers = vec![];
        for (i, n) in spec.normalizers.iter().enumerate() {
            let n = n.build(width)?;
            width = check(&format!("normalizers[{i}]"), n.as_ref(), width)?;
            normalizers.push(n);
        }
        let field = spec.field.as_ref().ok_or_else(|| need("field"))?.build(width)?;
        let out = check("field", field.as_ref(), width)?;
        ensure(out == 1, "spec", "field", format!("{out} channels out"), "1, the attenuation")?;
        let projector = spec.projector.as_ref().ok_or_else(|| need("projector"))?.build()?;
        let mut pipeline = Self::assemble(encoder, normalizers, field, projector);
        pipeline.tables = spec.precision.tables;
        // Of any scene: whether the encoder knows what the projector counts in.
        pipeline.projector.fitted(pipeline.lengths(1.0, 1.0))?;
        Ok(pipeline)
    }

    /// Puts built stages together; their widths must fit.
    pub fn assemble(
        encoder: Box<dyn Encoder>,
        normalizers: Vec<Box<dyn Normalizer>>,
        field: Box<dyn Field>,
        projector: Box<dyn Projector>,
    ) -> Self {
        let (tables, layout) = (Tables::default(), Layout::default());
        let mut p = Self { encoder, normalizers, field, projector, tables, layout, ranges: vec![] };
        p.lay_out();
        p
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

    /// Takes a scene's lengths for the measure of what counts in them.
    pub fn fit(&mut self, scene: &Scene) -> Result<()> {
        if let Some(fitted) = self.projector.fitted(self.lengths(scene.voxel_mm(), scene.side))? {
            self.projector = fitted;
        }
        Ok(())
    }

    /// What settings may count in, of a unit cube with a side of `side` mm.
    fn lengths(&self, voxel_mm: f64, side: f64) -> Lengths {
        let finest = self.encoder.resolutions().map(|all| all.into_iter().fold(1.0, f64::max));
        Lengths { voxel_mm, cell_mm: finest.filter(|n| *n > 1.0).map(|n| side / n) }
    }

    /// Removes the channels that normalizer `at` masked: stages before it compute only what is still read, stages
    /// after it become narrower, and parameters that nothing reads leave the arena.
    fn apply_mask(&mut self, at: usize, masked: &[usize], arena: &mut Arena) -> Result<()> {
        let old = self.ranges.clone();
        let mut kept: Vec<Vec<Range<usize>>> = vec![vec![]; old.len()];
        let mut keep = masked.to_vec();
        for i in at..self.normalizers.len() {
            let r = self.normalizers[i].keep_inputs(&keep)?;
            self.normalizers[i] = r.stage;
            kept[1 + i] = r.params;
            keep = r.channels;
        }
        let r = self.field.keep_inputs(&keep)?;
        self.field = r.stage;
        kept[1 + self.normalizers.len()] = r.params;
        let mut needed = masked.to_vec();
        for i in (0..at).rev() {
            let r = self.normalizers[i].keep_outputs(&needed)?;
            self.normalizers[i] = r.stage;
            kept[1 + i] = r.params;
            needed = r.channels;
        }
        let r = self.encoder.keep_outputs(&needed)?;
        self.encoder = r.stage;
        kept[0] = r.params;
        let ranges: Vec<_> =
            kept.iter().zip(&old).flat_map(|(k, o)| k.iter().map(|r| o.start + r.start..o.start + r.end)).collect();
        arena.retain(&ranges);
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

    /// Lets every normalizer look at the encoder, through `exe`, after `epoch` passes over the views. What was masked
    /// is gone from pipeline and arena when this returns, and `exe` is compiled again for what is left. Returns what
    /// normalizers had to say, for the log.
    pub fn refresh(
        &mut self,
        scene: &Scene,
        epoch: f64,
        backend: &dyn Backend,
        exe: &mut Box<dyn Executable>,
    ) -> Result<Vec<String>> {
        let mut reports = vec![];
        for i in 0..self.pipeline.normalizers.len() {
            let mut look = Look { model: self, scene, epoch, exe: exe.as_mut() };
            let mask = self.pipeline.normalizers[i].refresh(&mut look)?;
            if let Some(mask) = mask {
                exe.fetch(self)?;
                self.pipeline.apply_mask(i, &mask.keep, &mut self.arena)?;
                self.masks.push(Masked { normalizer: Some(i), keep: mask.keep });
                reports.push(mask.report);
                *exe = backend.compile(&self.pipeline)?.0;
            }
        }
        Ok(reports)
    }

    /// What normalizers have masked so far, in order.
    pub fn masks(&self) -> &[Masked] {
        &self.masks
    }

    /// Removes channels as was decided before: by the scene, or by a normalizer, which will not decide again.
    pub fn mask(&mut self, masked: &Masked) -> Result<()> {
        let Masked { normalizer, keep } = masked;
        let all = &self.pipeline.normalizers;
        let stage = normalizer.map(|at| all.get(at));
        let width = match stage {
            None => self.pipeline.encoder.info().output,
            Some(n) => n.map_or(0, |n| n.info().input),
        };
        let ascending = keep.windows(2).all(|w| w[0] < w[1]) && keep.last().is_some_and(|&k| k < width);
        ensure(
            ascending,
            "checkpoint",
            "masks",
            format!("{} keeps {keep:?}", normalizer.map_or("the scene".into(), |at| format!("normalizer {at}"))),
            format!("one of {} normalizers and ascending channels of those that it reads", all.len()),
        )?;
        if let Some(n) = stage.flatten() {
            n.decided();
        }
        self.pipeline.apply_mask(normalizer.unwrap_or(0), keep, &mut self.arena)?;
        self.masks.push(masked.clone());
        Ok(())
    }
}

struct Look<'a> {
    model: &'a Model,
    scene: &'a Scene,
    epoch: f64,
    exe: &'a mut dyn Executable,
}

impl Probe for Look<'_> {
    fn encode(&mut self, points: &[[f32; 3]]) -> Result<Vec<f32>> {
        self.exe.encode(self.model, points)
    }
    fn shape(&self) -> [usize; 3] {
        self.scene.grid.shape
    }
    fn voxel(&self, index: [usize; 3]) -> [f32; 3] {
        self.scene.voxel(index)
    }
    fn epoch(&self) -> f64 {
        self.epoch
    }
    fn coarse_to_fine(&self) -> bool {
        self.model.pipeline.encoder.coarse_to_fine()
    }
}

fn check(name: &str, stage: &dyn Stage, width: usize) -> Result<usize> {
    let Info { input, output, .. } = stage.info();
    ensure(input == width, "spec", name, format!("{width} channels from the stage before"), format!("{input}"))?;
    ensure(output > 0, "spec", name, "no channels out", "at least one")?;
    Ok(output)
}
