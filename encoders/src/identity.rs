//! The position itself: points `[n, 3]` to `[n, 3]`, for fields that keep their own grid and for [`crate::concat`].

use conefield_core::prelude::*;
use conefield_core::wgsl::functions;

/// Settings of `identity`: there are none.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Identity {}

conefield_core::stage_type!(EncoderSpec, "identity", Identity, "the three coordinates, unchanged");

impl EncoderSpec for Identity {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        Ok(Box::new(IdentityStage { axes: vec![0, 1, 2] }))
    }
}

/// The stage that [`Identity`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct IdentityStage {
    /// The coordinate of each output.
    axes: Vec<usize>,
}

impl<R: Real> Kernel<R> for IdentityStage {
    fn forward(&self, _: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, _: TileMut<'_, R>) {
        for (c, &axis) in self.axes.iter().enumerate() {
            y.channel(c).copy_from_slice(x.channel(axis));
        }
    }

    fn backward(&self, Backward { dy, dx, .. }: Backward<'_, R>) {
        let Some(mut dx) = dx else { return };
        dx.data.fill(R::ZERO);
        for (c, &axis) in self.axes.iter().enumerate() {
            dx.channel(axis).copy_from_slice(dy.channel(c));
        }
    }
}

impl Stage for IdentityStage {
    fn info(&self) -> Info {
        Info { input: 3, output: self.axes.len(), identity: self.axes == [0, 1, 2], ..Info::default() }
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

    fn wgsl(&self) -> Option<Fragment> {
        let n = self.axes.len();
        let each = |line: &dyn Fn(usize, usize) -> String| -> String {
            self.axes.iter().enumerate().map(|(c, &axis)| line(c, axis)).collect()
        };
        let forward = each(&|c, axis| format!("    (*y)[{c}] = (*x)[{axis}];\n"));
        let backward = each(&|c, axis| format!("    (*dx)[{axis}] = (*dy)[{c}];\n"));
        Some(Fragment::new(&[&functions(3, n, &forward, &format!("    *dx = array<f32, 3>();\n{backward}"))]))
    }

    fn describe(&self) -> String {
        let names: Vec<_> = self.axes.iter().map(|&a| ["x", "y", "z"][a]).collect();
        format!("identity: {}", names.join(", "))
    }
}

impl Encoder for IdentityStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        ensure(!keep.is_empty(), "identity", "channels", "none kept", "at least one")?;
        let stage = Self { axes: keep.iter().map(|&c| self.axes[c]).collect() };
        Ok(Reduced { stage: Box::new(stage), params: vec![], channels: vec![0, 1, 2] })
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        Some(vec![1.0; self.axes.len()])
    }
}
