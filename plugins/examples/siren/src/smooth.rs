//! Smooths features along each ray: `yᵢ = (1 − s)·xᵢ + s·(xᵢ₋₁ + xᵢ₊₁)/2`, with the ends repeated. A point off any ray
//! is a ray of one sample and does not change.

use conefield_plugin::prelude::*;

stage_type!(NormalizerSpec, "ray-smooth", RaySmooth, "features smoothed along each ray");

/// Settings of `ray-smooth`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("examples" = [{"strength": 0.0}, {"strength": 0.9}]))]
pub struct RaySmooth {
    /// Share that a sample takes from its neighbours, from 0 to below 1.
    pub strength: f64,
}

impl Default for RaySmooth {
    fn default() -> Self {
        Self { strength: 0.25 }
    }
}

impl NormalizerSpec for RaySmooth {
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>> {
        let good = (0.0..1.0).contains(&self.strength);
        ensure(good, "spec", "strength", self.strength, "0 to below 1")?;
        Ok(Box::new(RaySmoothStage { width, strength: self.strength }))
    }
}

/// The stage that [`RaySmooth`] builds.
pub struct RaySmoothStage {
    width: usize,
    strength: f64,
}

impl<R: Real> Kernel<R> for RaySmoothStage {
    fn forward(&self, _: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, _: TileMut<'_, R>) {
        let (own, each) = (R::of(1.0 - self.strength), R::of(0.5 * self.strength));
        let last = x.rows - 1;
        for c in 0..self.width {
            let x = x.channel(c);
            for (i, y) in y.channel(c).iter_mut().enumerate() {
                *y = own * x[i] + each * (x[i.saturating_sub(1)] + x[(i + 1).min(last)]);
            }
        }
    }

    fn backward(&self, Backward { x, dy, dx, .. }: Backward<'_, R>) {
        let Some(mut dx) = dx else { return };
        let (own, each) = (R::of(1.0 - self.strength), R::of(0.5 * self.strength));
        let last = x.rows - 1;
        dx.data.fill(R::ZERO);
        for c in 0..self.width {
            let dx = dx.channel(c);
            for (i, &d) in dy.channel(c).iter().enumerate() {
                dx[i] += own * d;
                dx[i.saturating_sub(1)] += each * d;
                dx[(i + 1).min(last)] += each * d;
            }
        }
    }
}

impl Stage for RaySmoothStage {
    fn info(&self) -> Info {
        Info {
            input: self.width,
            output: self.width,
            scope: Scope::Ray,
            macs: 3 * self.width,
            identity: self.strength == 0.0,
            ..Info::default()
        }
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
        format!("ray-smooth: {} channels, {} from neighbours", self.width, self.strength)
    }
}

impl Normalizer for RaySmoothStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        let stage = Self { width: keep.len(), strength: self.strength };
        Ok(Reduced { stage: Box::new(stage), params: vec![], channels: keep.to_vec() })
    }
}
