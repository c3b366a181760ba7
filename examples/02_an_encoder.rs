//! An encoder of your own in the tree: settings, forward, backward and registration, then a reconstruction with it. The
//! same lines make a plugin: docs/guide/writing-stages.md.

use conefield::Reconstruct;
use conefield::simulate::{Protocol, phantom, simulate};
use conefield_conformance::{Options, check_encoder};
use conefield_core::prelude::*;

stage_type!(EncoderSpec, "waves", Waves, "waves of learned directions");

/// `y = sin(d·x + p)` with directions `d` and phases `p` that are learned.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
struct Waves {
    /// Number of channels, one per wave.
    waves: usize,
    /// Largest initial frequency of a wave, in radians per cube side.
    frequency: f32,
}

impl Default for Waves {
    fn default() -> Self {
        Self { waves: 32, frequency: 20.0 }
    }
}

impl EncoderSpec for Waves {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        ensure((1..=4096).contains(&self.waves), "spec", "waves", self.waves, "1 to 4096")?;
        Ok(Box::new(ByRow::new(self.clone())))
    }
}

impl RowMap for Waves {
    fn widths(&self) -> [usize; 2] {
        [3, self.waves]
    }

    fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        vec![("wave".into(), vec![self.waves, 4])]
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        for (i, p) in params.iter_mut().enumerate() {
            *p = self.frequency * (2.0 * unit(mix(seed, i as u64)) - 1.0);
        }
    }

    #[inline(always)]
    fn forward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, y: &mut ChannelsMut<N>) {
        for (c, w) in params.chunks(4).enumerate() {
            let angle = x.at(0) * w[0] + x.at(1) * w[1] + x.at(2) * w[2] + w[3];
            y.set(c, angle.sin_cos().0);
        }
    }

    #[inline(always)]
    fn backward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, dy: Channels<N>, grads: &mut Gradients<N>) {
        for (c, w) in params.chunks(4).enumerate() {
            let angle = x.at(0) * w[0] + x.at(1) * w[1] + x.at(2) * w[2] + w[3];
            let slope = dy.at(c) * angle.sin_cos().1;
            for k in 0..3 {
                grads.param(4 * c + k, slope * x.at(k));
                grads.input(k, slope * w[k]);
            }
            grads.param(4 * c + 3, slope);
        }
    }

    /// For `step_cells` of a projector, as in the spec balanced: resolving a period takes two cells.
    fn resolutions(&self) -> Option<Vec<f64>> {
        Some(vec![f64::from(self.frequency / std::f32::consts::PI).max(1.0); self.waves])
    }

    fn describe(&self) -> String {
        format!("waves: {} waves", self.waves)
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // The conformance kit compares the gradients with finite differences, and more.
    let report = check_encoder(Waves::default().build()?.as_ref(), &Options::encoder());
    assert!(report.passed(), "{report}");

    let truth = phantom(48);
    let protocol = Protocol::r2(&truth.grid).with_detector([48, 48]).with_views(30);
    let scan = simulate(&truth, &protocol)?;

    let run = Reconstruct::with("fast").set("encoder.type=waves").set("encoder.waves=48").set("field.width=16");
    let result = run.steps(200).reference(truth).run(scan)?;
    let psnr = result.scores.map_or(f64::NAN, |s| s.psnr);
    println!("{} steps in {:.1} s: {psnr:.2} dB", result.steps, result.train_s);
    Ok(())
}
