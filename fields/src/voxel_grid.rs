//! A voxel grid as the field itself: positions `[n, 3]` in the unit cube to attenuation `[n, 1]`.
//!
//! Values are given at the voxel centres and interpolated trilinearly; they are constant within half a voxel of the
//! surface. The activation follows the interpolation, so that edges can lie between voxels.

use crate::passes::{Back, Forward};
use conefield_core::activation::{self, Activation, activate};
use conefield_core::prelude::*;
use conefield_core::simd::{Op, Simd, run};
use conefield_core::trilinear::{BLOCK, Grid, Located};
use conefield_core::wgsl::TRILINEAR;
use std::ops::Range;

/// Number of voxels along the unit cube's sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Resolution {
    /// The same along x, y and z.
    Cube(u32),
    /// Along x, y, z.
    Axes([u32; 3]),
}

/// Settings of `voxel-grid`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct VoxelGridSettings {
    /// Number of voxels along the unit cube's sides: one number, or three for x, y, z.
    pub resolution: Resolution,
    /// Activation after the interpolation.
    pub output: Activation,
    /// Initial value of every voxel, before the activation.
    pub init: f64,
}

impl Default for VoxelGridSettings {
    /// Softplus of −2 is 0.13: a thin cloud, from which every voxel can grow or vanish.
    fn default() -> Self {
        Self { resolution: Resolution::Cube(128), output: Activation::Softplus, init: -2.0 }
    }
}

conefield_core::stage_type!(
    FieldSpec,
    "voxel-grid",
    VoxelGridSettings,
    "a grid of voxels, read by position",
    example = r#"{"resolution": 6}"#
);

impl FieldSpec for VoxelGridSettings {
    fn build(&self, width: usize) -> Result<Box<dyn Field>> {
        Ok(Box::new(VoxelGridStage::new(self, width)?))
    }
}

/// Maximum number of voxels: with gradients and moments they would take 32 GiB.
const MOST: u64 = 1 << 31;

/// Minimum number of voxels in a range summed by one worker.
const SLAB: usize = 1 << 18;

/// The stage that [`VoxelGridSettings`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct VoxelGridStage {
    grid: Grid,
    output: Activation,
    init: f32,
}

impl VoxelGridStage {
    /// The stage; fails if a setting is out of range. `width` must be 3: the positions.
    pub fn new(settings: &VoxelGridSettings, width: usize) -> Result<Self> {
        let expected = "3, the position: use encoder type \"identity\" and no normalizer that changes it";
        ensure(width == 3, "spec", "field", format!("{width} channels for a voxel-grid"), expected)?;
        let axes = match settings.resolution {
            Resolution::Cube(n) => [n; 3],
            Resolution::Axes(n) => n,
        };
        let voxels = axes.iter().try_fold(1u64, |v, &n| v.checked_mul(u64::from(n)));
        ensure(
            axes.iter().all(|n| (1..=1 << 20).contains(n)) && voxels.is_some_and(|v| v <= MOST),
            "spec",
            "resolution",
            format!("{axes:?}"),
            "1 to 2^20 voxels a side and at most 2^31 together",
        )?;
        ensure(settings.init.is_finite(), "spec", "init", settings.init, "a finite number")?;
        Ok(Self { grid: Grid::centres(axes.map(|n| n as usize)), output: settings.output, init: settings.init as f32 })
    }
}

impl<R: Real> Op for Forward<'_, VoxelGridStage, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let (table, _) = self.params.as_chunks::<1>();
        let offsets = self.stage.grid.offsets();
        let mut located = Located::default();
        let mut z = [R::ZERO; BLOCK];
        for at in (0..self.x.rows).step_by(BLOCK) {
            let n = BLOCK.min(self.x.rows - at);
            located.locate(s, &self.stage.grid, self.x, at, n);
            for i in 0..n {
                [z[i]] = located.gather(i, &offsets, table);
            }
            activate(self.stage.output, &mut z[..n], &mut self.y.data[at..at + n]);
        }
    }
}

impl<R: Real> Op for Back<'_, VoxelGridStage, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let (stage, Backward { params, x, dy, grads, mut dx, .. }) = (self.stage, self.pass);
        let (table, _) = params.as_chunks::<1>();
        let offsets = stage.grid.offsets();
        let own = grads.range.clone();
        let mut located = Located::default();
        let (mut slope, mut value) = ([R::ZERO; BLOCK], [R::ZERO; BLOCK]);
        for at in (0..x.rows).step_by(BLOCK) {
            let n = BLOCK.min(x.rows - at);
            located.locate(s, &stage.grid, x, at, n);
            let touched = (0..n).any(|i| {
                let first = located.base(i);
                first < own.end && own.start <= first + offsets[7]
            });
            if !touched && dx.is_none() {
                continue;
            }
            // A scattered stage keeps no tape, so the activation's derivative is recomputed.
            slope[..n].fill(R::ONE);
            if stage.output != Activation::None {
                for i in 0..n {
                    [slope[i]] = located.gather(i, &offsets, table);
                }
                activate(stage.output, &mut slope[..n], &mut value[..n]);
            }
            for i in 0..n {
                slope[i] *= dy.data[at + i];
            }
            for i in 0..n {
                located.scatter(i, &offsets, &[slope[i]], grads.values, &own);
            }
            if let Some(dx) = &mut dx {
                for d in 0..3 {
                    let (mut near, mut far) = (located.clone(), located.clone());
                    near.move_to(d, R::ZERO);
                    far.move_to(d, R::ONE);
                    for i in 0..n {
                        let [[near], [far]] = [&near, &far].map(|moved| moved.gather(i, &offsets, table));
                        let stretch = stage.grid.stretch(d, x.channel(d)[at + i]);
                        dx.channel(d)[at + i] = (far - near) * stretch * slope[i];
                    }
                }
            }
        }
    }
}

impl<R: Real> Kernel<R> for VoxelGridStage {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        run(Forward { stage: self, params, x, y, tape });
    }

    fn backward(&self, pass: Backward<'_, R>) {
        run(Back { stage: self, pass });
    }
}

impl Stage for VoxelGridStage {
    fn info(&self) -> Info {
        Info { input: 3, output: 1, params: self.grid.entries(), grads: GradKind::Scatter, macs: 24, ..Info::default() }
    }

    fn parameters(&self) -> Vec<Parameter> {
        vec![Parameter { name: "voxels".into(), shape: self.grid.side().to_vec(), start: 0 }]
    }

    fn init(&self, _: u64, params: &mut [f32]) {
        params.fill(self.init);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn partition(&self) -> Vec<Range<usize>> {
        self.grid.slabs(SLAB)
    }

    fn wgsl(&self) -> Option<Fragment> {
        let ([x, y, z], [sx, sy, sz]) = (self.grid.side(), self.grid.strides());
        let settings = format!(
            "const stage_SIDE = vec3<u32>({x}u, {y}u, {z}u);
const stage_STRIDES = vec3<u32>({sx}u, {sy}u, {sz}u);
fn stage_output(x: f32) -> vec2<f32> {{ return {}(x); }}
",
            self.output.wgsl()
        );
        Some(Fragment::new(&[&settings, TRILINEAR, activation::WGSL, include_str!("voxel_grid.wgsl")]))
    }

    fn describe(&self) -> String {
        let [x, y, z] = self.grid.side();
        format!("voxel-grid: {x} x {y} x {z} voxels, {:?}", self.output).to_lowercase()
    }
}

impl Field for VoxelGridStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        if keep != [0, 1, 2] {
            return Err(Error::unsupported("voxel-grid", "it needs all three coordinates; leave out masks before it"));
        }
        Ok(Reduced { stage: Box::new(self.clone()), params: vec![0..self.grid.entries()], channels: vec![0] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_stand_at_voxel_centres() {
        let settings = VoxelGridSettings {
            resolution: Resolution::Axes([4, 2, 1]),
            output: Activation::Relu,
            ..VoxelGridSettings::default()
        };
        let stage = VoxelGridStage::new(&settings, 3).unwrap();
        let params: Vec<f64> = (0..8).map(|v| f64::from(v) - 1.0).collect();
        let at = |x: [f64; 3]| {
            let mut y = [0.0];
            stage.forward(&params, Tile::new(&x, 1), TileMut::new(&mut y, 1), TileMut::new(&mut [], 1));
            y[0]
        };
        for i in 0..4 {
            for j in 0..2 {
                let want = f64::max(f64::from(2 * i + j) - 1.0, 0.0);
                assert!((at([(f64::from(i) + 0.5) / 4.0, (f64::from(j) + 0.5) / 2.0, 0.3]) - want).abs() < 1e-12);
            }
        }
        assert_eq!(at([1.0, 1.0, 0.0]), 6.0);
        assert_eq!(stage.parameters()[0].shape, [4, 2, 1]);
    }

    #[test]
    fn what_does_not_fit_is_refused_with_words() {
        let e = VoxelGridStage::new(&VoxelGridSettings::default(), 20).unwrap_err().to_string();
        assert!(e.contains("20 channels") && e.contains("identity"), "{e}");
        for resolution in [Resolution::Cube(0), Resolution::Axes([1 << 20; 3]), Resolution::Cube(2048)] {
            let e = VoxelGridStage::new(&VoxelGridSettings { resolution, ..VoxelGridSettings::default() }, 3)
                .unwrap_err()
                .to_string();
            assert!(e.contains("resolution") && e.contains("2^31"), "{e}");
        }
    }
}
