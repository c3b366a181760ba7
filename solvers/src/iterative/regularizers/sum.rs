//! A sum of priors, each with its own weight.
//!
//! The proximal map of a sum comes from those of its parts: with a dual volume `y_i` for each, `w = v − Σ_{j≠i} y_j`,
//! `u = prox_i(w)` and `y_i = w − u` in turn. This is Dykstra's algorithm for proximal maps (Bauschke and Combettes,
//! Pac. J. Optim. 4(3), 2008), block coordinate ascent on the dual problem. The duals stay between updates of FISTA, so
//! that few turns per update suffice: where nothing changes any more, u is the proximal map of the sum.

use super::TotalVariation;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Vec3, VoxelGrid};
use conefield_core::parallel;
use conefield_core::place::{Host, StatePart};
use conefield_core::regularizer::{Bounds, Penalty, Regularizer, RegularizerSpec};
use conefield_core::space::Space;
use conefield_core::spec::stage;
use ndarray::ArrayView3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The type's name.
const SUM: &str = "sum";

/// Settings of `sum`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Sum {
    /// The priors, each with its own weight. None is a sum itself.
    #[serde(deserialize_with = "stage::list")]
    #[schemars(schema_with = "stage::schema_of_list::<dyn RegularizerSpec>")]
    pub priors: Vec<Box<dyn RegularizerSpec>>,
    /// Turns of all priors per update.
    pub turns: usize,
}

impl Default for Sum {
    fn default() -> Self {
        Self { priors: vec![Box::new(TotalVariation::default())], turns: 1 }
    }
}

conefield_core::stage_type!(RegularizerSpec, "sum", Sum, "several priors, each with its own weight");

impl RegularizerSpec for Sum {
    fn build(&self) -> Result<Box<dyn Regularizer>> {
        ensure(!self.priors.is_empty(), "spec", "priors", "none", "at least one prior")?;
        ensure((1..=1000).contains(&self.turns), "spec", "turns", self.turns, "1 to 1000")?;
        let build = |(i, prior): (usize, &dyn RegularizerSpec)| {
            let place = format!("priors.{i}");
            ensure(prior.type_name() != SUM, "spec", &place, "a sum", "a prior of another type")?;
            prior.build().map_err(|e| e.within(&place))
        };
        let parts = self.priors.iter().map(AsRef::as_ref).enumerate().map(build).collect::<Result<_>>()?;
        Ok(Box::new(SumRegularizer { parts, turns: self.turns }))
    }
}

struct SumRegularizer {
    parts: Vec<Box<dyn Regularizer>>,
    turns: usize,
}

impl Regularizer for SumRegularizer {
    /// It runs on the host, and so do its parts.
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        let header = *space.header();
        let host = if space.is_tally() { Space::tally(header) } else { Space::new(header, Arc::new(Host)) };
        let share = 1.0 / self.parts.len() as f64;
        let count = grid.shape.iter().product();
        let part = |(i, regularizer): (usize, &dyn Regularizer)| {
            let mut penalty = regularizer.on(grid, &host).map_err(|e| e.within(&format!("priors.{i}")))?;
            let names = penalty.state().iter().map(|(name, _)| format!("{i}.{name}")).collect();
            Ok(Part { penalty, share, dual: host.on_host(count), dual_name: format!("dual.{i}"), names })
        };
        let parts = self.parts.iter().map(AsRef::as_ref).enumerate().map(part).collect::<Result<_>>()?;
        let work = host.on_host(count);
        space.hold(host.bytes());
        Ok(Box::new(SumPenalty { parts, work, turns: self.turns }))
    }

    fn weight(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(self.weights(grid, noise)?.iter().sum())
    }

    fn weights(&self, grid: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<Vec<f64>> {
        let each = self.parts.iter().enumerate();
        each.map(|(i, part)| part.weight(grid, noise).map_err(|e| e.within(&format!("priors.{i}")))).collect()
    }

    fn describe(&self) -> String {
        let parts: Vec<String> = self.parts.iter().map(|part| part.describe()).collect();
        let turns = if self.turns == 1 { String::new() } else { format!(", {} turns per update", self.turns) };
        format!("sum{turns} of {}", parts.join(" and "))
    }
}

/// A prior of the sum on one grid.
struct Part {
    penalty: Box<dyn Penalty>,
    /// Its share of the sum's weight.
    share: f64,
    /// What it takes away, `y_i`; 0 outside the support.
    dual: Vec<f32>,
    /// Names for checkpoints. Those of the prior's own state begin with its number, whatever it calls them.
    dual_name: String,
    names: Vec<String>,
}

struct SumPenalty {
    parts: Vec<Part>,
    /// The argument of a part's proximal map.
    work: Vec<f32>,
    turns: usize,
}

/// Whether an argument of a proximal map marks a voxel outside the support; see [`Penalty::prox`].
fn is_outside(v: f32) -> bool {
    v == f32::MIN
}

impl Penalty for SumPenalty {
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        self.parts.iter().map(|part| part.share * part.penalty.value(x)).sum()
    }

    fn adapts(&self) -> bool {
        self.parts.iter().any(|part| part.penalty.adapts())
    }

    fn adapt(&mut self, x: ArrayView3<'_, f32>) -> Option<f64> {
        let mut changed = false;
        for part in self.parts.iter_mut().filter(|part| part.penalty.adapts()) {
            changed |= part.penalty.adapt(x).is_some();
        }
        changed.then(|| self.value(x))
    }

    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        u.copy_from_slice(v);
        for part in &self.parts {
            parallel::change(u, [&part.dual], |u, [y]| u.iter_mut().zip(y).for_each(|(u, y)| *u -= y));
        }
        let Self { parts, work, turns } = self;
        for part in (0..*turns).flat_map(|_| 0..parts.len()).collect::<Vec<_>>() {
            let Part { penalty, share, dual, .. } = &mut parts[part];
            parallel::change(work, [v, u, dual], |work, [v, u, y]| {
                let all = work.iter_mut().zip(v).zip(u).zip(y);
                all.for_each(|(((w, v), u), y)| *w = if is_outside(*v) { *v } else { u + y });
            });
            penalty.prox(work, (f64::from(tau) * *share) as f32, u);
            parallel::change(dual, [v, u, work], |dual, [v, u, w]| {
                let all = dual.iter_mut().zip(v).zip(u).zip(w);
                all.for_each(|(((y, v), u), w)| *y = if is_outside(*v) { 0.0 } else { w - u });
            });
        }
    }

    fn confine(&mut self, bounds: Bounds) -> Result<()> {
        self.parts.iter_mut().try_for_each(|part| part.penalty.confine(bounds))
    }

    fn confine_each(&mut self, bounds: Arc<[Vec<f32>; 2]>) -> Result<()> {
        self.parts.iter_mut().try_for_each(|part| part.penalty.confine_each(bounds.clone()))
    }

    fn limited(&mut self, middle: Vec3) {
        self.parts.iter_mut().for_each(|part| part.penalty.limited(middle));
    }

    fn share(&mut self, shares: &[f64]) {
        self.parts.iter_mut().zip(shares).for_each(|(part, share)| part.share = *share);
    }

    fn state(&mut self) -> Vec<(&str, StatePart<'_>)> {
        let parts = self.parts.iter_mut().flat_map(|Part { penalty, dual, dual_name, names, .. }| {
            let own = (dual_name.as_str(), StatePart::Host(dual));
            let states = penalty.state().into_iter().map(|(_, state)| state);
            std::iter::once(own).chain(names.iter().map(String::as_str).zip(states))
        });
        parts.collect()
    }

    fn fault(&self) -> Result<()> {
        self.parts.iter().try_for_each(|part| part.penalty.fault())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::scan::ScanHeader;
    use std::collections::BTreeSet;

    /// Names of a prior's state begin with the prior's number. So none of them equals a name of the sum.
    #[test]
    fn the_state_has_a_name_for_each_part() {
        let part = || TotalVariation::default().build().unwrap();
        let grid = VoxelGrid { shape: [2; 3], spacing: [1.0; 3], center: [0.0; 3] };
        let header = ScanHeader { views: 2, detector: [2; 2], volume: [2; 3] };
        let sum = SumRegularizer { parts: vec![part(), part()], turns: 1 };
        let mut sum = sum.on(&grid, &Space::tally(header)).unwrap();
        let names: BTreeSet<String> = sum.state().into_iter().map(|(name, _)| name.to_owned()).collect();
        let own = |i: usize| ["x", "y", "z"].map(|axis| format!("{i}.dual.{axis}"));
        let duals = [0, 1].map(|i| format!("dual.{i}"));
        assert_eq!(names, own(0).into_iter().chain(own(1)).chain(duals).collect());
    }
}
