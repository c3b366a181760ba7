//! The arena: parameters, gradients and optimizer state of a whole pipeline, under their names.

use crate::error::{Error, Result, ensure};
use crate::pages::Pages;
use std::collections::BTreeMap;
use std::ops::Range;

/// A named block of parameters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Block {
    /// Full name: `encoder.…`, `normalizers.0.…`, `field.…`.
    pub name: String,
    /// Shape, row-major.
    pub shape: Vec<usize>,
    /// Its position in the arena.
    pub range: Range<usize>,
}

/// Names and positions of all parameters.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Layout {
    /// In arena order, without gaps.
    pub blocks: Vec<Block>,
}

impl Layout {
    /// Number of parameters.
    pub fn len(&self) -> usize {
        self.blocks.last().map_or(0, |b| b.range.end)
    }

    /// Whether there are no parameters.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The block called `name`.
    pub fn find(&self, name: &str) -> Option<&Block> {
        self.blocks.iter().find(|b| b.name == name)
    }
}

/// Everything that training changes.
#[derive(Clone, Default)]
pub struct Arena {
    /// Parameters.
    pub params: Pages,
    /// Gradients of the current step.
    pub grads: Pages,
    /// Adam's first moments.
    pub first: Pages,
    /// Adam's second moments.
    pub second: Pages,
}

impl Arena {
    /// An arena of `n` zeros.
    pub fn new(n: usize) -> Self {
        let zeros = || Pages::zeros(n);
        Self { params: zeros(), grads: zeros(), first: zeros(), second: zeros() }
    }

    /// Keeps only `ranges` of every part, in that order.
    pub fn retain(&mut self, ranges: &[Range<usize>]) {
        for part in [&mut self.params, &mut self.grads, &mut self.first, &mut self.second] {
            let kept: Pages = ranges.iter().flat_map(|r| part[r.clone()].iter().copied()).collect();
            *part = kept;
        }
    }
}

/// Named tensors with the notes of their file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Weights {
    /// Shape and values by name.
    pub tensors: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
    /// Free-form notes, such as the spec that produced them and the program version.
    pub notes: BTreeMap<String, String>,
}

/// Report of an initializer, tensor by tensor.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize)]
pub struct InitReport {
    /// Names of loaded tensors.
    pub loaded: Vec<String>,
    /// Tensors of the pipeline that keep their stage's own initialization, with the reason.
    pub fresh: Vec<(String, String)>,
    /// Unused tensors of the file, with the reason.
    pub unused: Vec<(String, String)>,
}

impl Weights {
    /// The blocks of `layout` for which `take` holds.
    pub fn from_arena(layout: &Layout, params: &[f32], take: impl Fn(&str) -> bool) -> Self {
        let mut weights = Self::default();
        let taken = layout.blocks.iter().filter(|b| take(&b.name));
        let tensor = |b: &Block| (b.name.clone(), (b.shape.clone(), params[b.range.clone()].to_vec()));
        weights.tensors.extend(taken.map(tensor));
        weights
    }

    /// Copies every block for which `take` holds into `params`, after [`Weights::check`].
    pub fn load(
        &self,
        place: &str,
        layout: &Layout,
        params: &mut [f32],
        take: impl Fn(&str) -> bool,
    ) -> Result<InitReport> {
        let report = self.check(place, layout, &take)?;
        for b in layout.blocks.iter().filter(|b| take(&b.name)) {
            params[b.range.clone()].copy_from_slice(&self.tensors[&b.name].1);
        }
        Ok(report)
    }

    /// Checks [`Weights::load`] without an array of parameters. Refuses a block for which `take` holds if it is missing
    /// here, has another shape or contains a non-finite number.
    pub fn check(&self, place: &str, layout: &Layout, take: impl Fn(&str) -> bool) -> Result<InitReport> {
        let mut report = InitReport::default();
        for b in &layout.blocks {
            if !take(&b.name) {
                report.fresh.push((b.name.clone(), "not asked for".into()));
                continue;
            }
            let Some((shape, data)) = self.tensors.get(&b.name) else {
                return Err(Error::invalid(place, &b.name, "nothing", format!("a tensor of shape {:?}", b.shape)));
            };
            let expected = format!("shape {:?} as this pipeline has it", b.shape);
            ensure(*shape == b.shape, place, &b.name, format!("shape {shape:?}"), expected)?;
            if let Some(x) = data.iter().find(|x| !x.is_finite()) {
                return Err(Error::invalid(place, &b.name, x, "finite weights"));
            }
            report.loaded.push(b.name.clone());
        }
        for name in self.tensors.keys().filter(|n| !report.loaded.contains(n)) {
            let why = if layout.find(name).is_some() { "not asked for" } else { "not in this pipeline" };
            report.unused.push((name.clone(), why.into()));
        }
        Ok(report)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout() -> Layout {
        Layout {
            blocks: vec![
                Block { name: "encoder.a".into(), shape: vec![2], range: 0..2 },
                Block { name: "field.w".into(), shape: vec![2, 2], range: 2..6 },
            ],
        }
    }

    #[test]
    fn weights_load_what_is_asked_for_and_say_what_is_not() {
        let w = Weights::from_arena(&layout(), &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], |_| true);
        let mut params = [0.0; 6];
        let report = w.load("w", &layout(), &mut params, |n| n.starts_with("field")).unwrap();
        assert_eq!(params, [0.0, 0.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(report.loaded, ["field.w"]);
        assert_eq!(report.unused[0].0, "encoder.a");
    }

    #[test]
    fn another_shape_is_refused_before_anything_is_written() {
        let mut w = Weights::from_arena(&layout(), &[1.0; 6], |_| true);
        w.tensors.get_mut("field.w").unwrap().0 = vec![4];
        let mut params = [0.0; 6];
        let e = w.load("w.safetensors", &layout(), &mut params, |_| true).unwrap_err().to_string();
        assert!(e.contains("field.w") && e.contains("[4]") && e.contains("[2, 2]"), "{e}");
        assert_eq!(params, [0.0; 6]);
    }

    #[test]
    fn retain_moves_every_part_alike() {
        let mut a = Arena::new(4);
        for i in 0..4 {
            (a.params[i], a.second[i]) = (i as f32, 9.0 - i as f32);
        }
        a.retain(&[3..4, 0..2]);
        assert_eq!(*a.params, [3., 0., 1.]);
        assert_eq!(*a.second, [6., 9., 8.]);
    }
}
