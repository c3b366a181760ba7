//! A penalty of coefficients, as a place works with it: its proximal map, and the update around that.

use super::{Array, Mask, Slab, StatePart};
use crate::error::{Error, Result};
use crate::geometry::Vec3;
use crate::parallel;
use crate::wgsl::Fragment;
use ndarray::ArrayView3;
use std::sync::Arc;

/// Bounds of coefficients: none is below `low` or above `high`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// The lower bound.
    pub low: f32,
    /// The upper bound; infinity if there is none.
    pub high: f32,
}

/// Not negative.
impl Default for Bounds {
    fn default() -> Self {
        Self { low: 0.0, high: f32::INFINITY }
    }
}

impl Bounds {
    /// The number within the bounds that is closest to `x`.
    #[inline(always)]
    pub fn clip(self, x: f32) -> f32 {
        x.max(self.low).min(self.high)
    }

    /// Overwrites each `u` with the number within the bounds that is closest to `v`.
    pub fn clip_to(self, u: &mut [f32], v: &[f32]) {
        parallel::change(u, [v], |u, [v]| u.iter_mut().zip(v).for_each(|(u, v)| *u = self.clip(*v)));
    }
}

impl std::fmt::Display for Bounds {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} to {}", self.low, self.high)
    }
}

/// The bounds of a penalty's coefficients, and its slab of a volume that several processes share.
#[derive(Default)]
pub struct Confines {
    /// Bounds of all coefficients.
    pub bounds: Bounds,
    /// Lower and upper bounds of each coefficient, if they differ.
    pub each: Option<Arc<[Vec<f32>; 2]>>,
    /// The slab, if its grid is one.
    pub slab: Option<Slab>,
}

impl Confines {
    /// Clips each `u` to its own bounds, if it has some.
    pub fn clip_each(&self, u: &mut [f32]) {
        let Some([low, high]) = self.each.as_deref() else { return };
        parallel::change(u, [low, high], |u, [low, high]| {
            u.iter_mut().zip(low).zip(high).for_each(|((u, low), high)| *u = u.max(*low).min(*high));
        });
    }
}

/// A penalty `R` on one grid. It keeps the state from which the next call of [`Penalty::prox`] starts.
pub trait Penalty: Send {
    /// `R(x)`, without weight.
    fn value(&self, x: ArrayView3<'_, f32>) -> f64;

    /// Whether it is adaptive; if not, [`Penalty::adapt`] is not called.
    fn adapts(&self) -> bool {
        false
    }

    /// Adapts an adaptive penalty to the coefficients `x`. Called before each pass; the result depends on `x` only.
    /// Returns the new `R(x)` if it changed.
    fn adapt(&mut self, x: ArrayView3<'_, f32>) -> Option<f64> {
        let _ = x;
        None
    }

    /// Overwrites `u` with `argmin_{u ≥ 0} ½‖u − v‖² + tau·R(u)`, or approaches it with each call for the same `v`.
    /// Both are in the grid's standard order. `v` is `f32::MIN` outside the object's support. The result does not depend
    /// on the number of threads.
    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]);

    /// Its bounds and its slab. A penalty that returns them must respect all of them: [`Penalty::prox`] clips to
    /// `bounds` and then to `each`, and [`Penalty::kernels`] is `None` if there is `each`. `None` for a penalty whose
    /// only bound is 0: its result with another bound, clipped, would not be the proximal map.
    fn confines(&mut self) -> Option<&mut Confines> {
        None
    }

    /// Sets the bounds of `u` in [`Penalty::prox`], in place of `u ≥ 0`. Called before the first update, unless
    /// `bounds` are the default.
    ///
    /// # Errors
    /// The penalty, or a part of a sum, has no [`Penalty::confines`].
    fn confine(&mut self, bounds: Bounds) -> Result<()> {
        let expected = "0 and no upper bound: this prior has no other bounds";
        let refused = || Error::invalid("spec", "scene.bounds", format!("{bounds} (in 1/mm)"), expected);
        self.confines().ok_or_else(refused)?.bounds = bounds;
        Ok(())
    }

    /// Sets a lower and an upper bound of each coefficient, within those of [`Penalty::confine`].
    ///
    /// # Errors
    /// The penalty, or a part of a sum, has no [`Penalty::confines`].
    fn confine_each(&mut self, bounds: Arc<[Vec<f32>; 2]>) -> Result<()> {
        let (found, expected) =
            (format!("bounds of {} coefficients", bounds[0].len()), "none: this prior has the same bounds everywhere");
        let refused = || Error::invalid("spec", "scene.bounds.regions", found, expected);
        self.confines().ok_or_else(refused)?.each = Some(bounds);
        Ok(())
    }

    /// Receives the unit vector along the middle of the arc, if the views cover less than half a turn: no ray is
    /// tangent to edges across it. Called before the first update.
    fn limited(&mut self, middle: Vec3) {
        let _ = middle;
    }

    /// Gives the priors of a sum their shares of its weight, which add up to 1. Called before the first update.
    fn share(&mut self, shares: &[f64]) {
        let _ = shares;
    }

    /// Makes its grid a slab of a volume that several processes share. [`Penalty::value`] and
    /// [`Penalty::adapt`] then return the sums over [`Slab::own`]. Called at once, if
    /// [`crate::regularizer::Regularizer::halo`] admits slabs.
    fn divide(&mut self, slab: Slab) {
        if let Some(confines) = self.confines() {
            confines.slab = Some(slab);
        }
    }

    /// The slab of [`Penalty::divide`].
    fn slab(&mut self) -> Option<&Slab> {
        self.confines()?.slab.as_ref()
    }

    /// The whole update, with [`Penalty::prox`] for `tau`. A penalty whose proximal map is a single pass over the
    /// volume can fuse the rest into it.
    fn update(&mut self, update: Update<'_>, tau: f32) {
        update.around(|v, u| self.prox(v, tau, u));
    }

    /// The same penalty for a place with kernels; `None` if it runs on the host only.
    fn kernels(&mut self) -> Option<Kernels<'_>> {
        None
    }

    /// State for the next pass, by name, for checkpoints. What [`Penalty::adapt`] sets before a pass is not part of it.
    fn state(&mut self) -> Vec<(&str, StatePart<'_>)> {
        vec![]
    }

    /// Returns and clears the first error since the last call; see [`crate::stage::Stage::fault`].
    fn fault(&self) -> Result<()> {
        Ok(())
    }
}

/// A penalty for a place with kernels.
pub enum Kernels<'a> {
    /// No penalty: the proximal map clips `v` to the bounds.
    Clip(Bounds),
    /// A penalty of differences.
    Dual(Dual<'a>),
}

/// A penalty of differences, `R(x) = Σ_j stage_cost(∇x_j, guide_j)`. ∇ takes forward differences times `weights`, 0 at
/// the far faces. The proximal map takes steps on dual variables `p`: `u = clip(v − τ·∇ᵀp)`. Each step replaces every
/// voxel's `p` by `stage_ascend(p, ∇u/(L·τ), guide)`, with `L = 4·Σ weights²`, a bound of `‖∇‖²`.
pub struct Dual<'a> {
    /// `stage_ascend` and `stage_cost`; see [`crate::wgsl`].
    pub fragment: Fragment,
    /// Weights of differences along x, y, z.
    pub weights: [f32; 3],
    /// Steps per update.
    pub steps: usize,
    /// Bounds of `u`.
    pub bounds: Bounds,
    /// The dual variables along x, y and z, from the previous update.
    pub p: [&'a mut Array; 3],
    /// A vector per voxel; 0 if there are none.
    pub guide: Option<Guide<'a>>,
    /// The slab of [`Penalty::divide`]: sums count its own planes only.
    pub slab: Option<&'a Slab>,
}

/// Vectors normal to a volume's edges, which [`Penalty::adapt`] finds: `n = √strength·s/√(|s|² + η²)`, where the slope s
/// is a central difference times the weights, smoothed by 1-2-1 along the other two axes (Sobel), 0 across the far faces,
/// and η is `scale` times the root mean square of all |s|.
pub struct Guide<'a> {
    /// Components along x, y and z.
    pub vectors: [&'a mut Array; 3],
    /// Largest square of a vector's length.
    pub strength: f32,
    /// Threshold of a clear edge.
    pub scale: f32,
}

impl Dual<'_> {
    /// The bound `L` of `‖∇‖²`.
    pub fn bound(weights: [f32; 3]) -> f32 {
        4.0 * weights.iter().map(|g| g * g).sum::<f32>()
    }
}

/// An update of a proximal gradient method with momentum. The proximal map is applied to `v = ahead + step·gradient`
/// after pulling and masking. Its result `u` is the new `x`, and `u + momentum·(u − x)` the new `ahead`. All arrays
/// have the same length.
pub struct UpdateOf<'a, Numbers: ?Sized, Flags: ?Sized> {
    /// Negative gradient of the data term at `ahead`; unspecified afterwards.
    pub gradient: &'a mut Numbers,
    /// Point of the gradient; afterwards the point of the next one.
    pub ahead: &'a mut Numbers,
    /// The coefficients.
    pub x: &'a mut Numbers,
    /// Step along `gradient`.
    pub step: f32,
    /// Extrapolation beyond the new coefficients.
    pub momentum: f32,
    /// The coefficients to pull towards, and the share of the way.
    pub towards: Option<(&'a Numbers, f32)>,
    /// Coefficients that may be non-zero, if not all.
    pub inside: Option<&'a Flags>,
}

/// The update of numbers in the host's memory.
pub type Update<'a> = UpdateOf<'a, [f32], [bool]>;

/// The update of arrays in a place.
pub type ProximalStep<'a> = UpdateOf<'a, Array, Mask>;

/// Numbers per task of [`Update::step`] and [`Update::momentum`]: few enough for the first-level cache.
const PART: usize = 1 << 12;

impl<'a> Update<'a> {
    /// Overwrites `v` with the argument of the proximal map, from index `at` on.
    #[inline(always)]
    pub fn read(&self, at: usize, v: &mut [f32]) {
        let part = at..at + v.len();
        let ahead = &self.ahead[part.clone()];
        for ((v, z), g) in v.iter_mut().zip(ahead).zip(&self.gradient[part.clone()]) {
            *v = z + self.step * g;
        }
        if let Some((towards, share)) = self.towards {
            for ((v, z), to) in v.iter_mut().zip(ahead).zip(&towards[part.clone()]) {
                *v += share * (to - z);
            }
        }
        if let Some(inside) = self.inside {
            // Values far below the lower bound stay there, whatever their neighbours are.
            v.iter_mut().zip(&inside[part]).for_each(|(v, inside)| *v = if *inside { *v } else { f32::MIN });
        }
    }

    /// Applies the result `u` of the proximal map from index `at` on.
    #[inline(always)]
    pub fn write(&mut self, at: usize, u: &[f32]) {
        let part = at..at + u.len();
        for ((z, x), u) in self.ahead[part.clone()].iter_mut().zip(&mut self.x[part]).zip(u) {
            *z = u + self.momentum * (u - *x);
            *x = *u;
        }
    }

    /// Splits into the first `at` numbers and the rest.
    pub fn split(self, at: usize) -> [Self; 2] {
        let (gradient, ahead) = (self.gradient.split_at_mut(at), self.ahead.split_at_mut(at));
        let x = self.x.split_at_mut(at);
        let both = |(towards, share): (&'a [f32], f32)| {
            let (a, b) = towards.split_at(at);
            ((a, share), (b, share))
        };
        let towards = self.towards.map(both).unzip();
        let inside = self.inside.map(|inside| inside.split_at(at)).unzip();
        [
            Self { gradient: gradient.0, ahead: ahead.0, x: x.0, towards: towards.0, inside: inside.0, ..self },
            Self { gradient: gradient.1, ahead: ahead.1, x: x.1, towards: towards.1, inside: inside.1, ..self },
        ]
    }

    /// The whole update around a proximal map that overwrites its second argument: one pass over memory before and one
    /// after.
    pub fn around(mut self, prox: impl FnOnce(&[f32], &mut [f32])) {
        self.step();
        prox(self.gradient, self.ahead);
        self.momentum();
    }

    /// Writes the argument of the proximal map into `gradient`.
    fn step(&mut self) {
        parallel::over(self.parts(), |_, part| {
            let mut v = [0.0; PART];
            let v = &mut v[..part.x.len()];
            part.read(0, v);
            part.gradient.copy_from_slice(v);
        });
    }

    /// Reads the result of the proximal map from `ahead`.
    fn momentum(&mut self) {
        parallel::over(self.parts(), |_, mut part| {
            let mut u = [0.0; PART];
            let u = &mut u[..part.x.len()];
            u.copy_from_slice(part.ahead);
            part.write(0, u);
        });
    }

    /// Parts for parallel threads.
    fn parts(&mut self) -> Vec<Update<'_>> {
        let mut rest = Update { gradient: self.gradient, ahead: self.ahead, x: self.x, ..*self };
        let mut parts = vec![];
        while rest.x.len() > PART {
            let [part, others] = rest.split(PART);
            parts.push(part);
            rest = others;
        }
        parts.push(rest);
        parts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_update_steps_pulls_masks_maps_and_goes_on() {
        let n = 2 * PART + 7;
        let fill = |a: f32| (0..n).map(|i| a + (i % 13) as f32).collect::<Vec<f32>>();
        let (g, z, old, to) = (fill(-3.0), fill(1.0), fill(2.0), fill(-5.0));
        let inside: Vec<bool> = (0..n).map(|i| i % 5 != 0).collect();
        let (mut gradient, mut ahead, mut x) = (g.clone(), z.clone(), old.clone());
        let update = Update {
            gradient: &mut gradient,
            ahead: &mut ahead,
            x: &mut x,
            step: 0.5,
            momentum: 0.25,
            towards: Some((&to, 0.125)),
            inside: Some(&inside),
        };
        update.around(|v, u| u.iter_mut().zip(v).for_each(|(u, v)| *u = v.max(0.0)));
        for i in 0..n {
            let v = z[i] + 0.5 * g[i] + 0.125 * (to[i] - z[i]);
            let u = if inside[i] { v.max(0.0) } else { 0.0 };
            assert_eq!([x[i], ahead[i]], [u, u + 0.25 * (u - old[i])], "{i}");
        }
    }
}
