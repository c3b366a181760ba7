//! An encoder with only its coarse levels open, for coarse-to-fine training.

use crate::error::{Error, Result, ensure};
use crate::simd::Real;
use crate::stage::{Backward, Encoder, GradKind, Grads, Info, Kernel, Parameter, Precision, Stage, Tile, TileMut};
use crate::wgsl::{Fragment, functions, hosted};
use std::ops::Range;
use std::sync::Arc;

/// An encoder that computes only its first channels. The others are 0, and their parameters do not change. Widths and
/// parameters are those of the whole encoder, so that an arena fits however many channels are open. A mask applies to
/// the whole encoder ([`Pipeline::open`](crate::pipeline::Pipeline::open) keeps it).
#[derive(Clone)]
pub struct Opened {
    whole: Arc<dyn Encoder>,
    /// The whole encoder without the closed channels.
    open: Arc<dyn Encoder>,
    channels: usize,
    /// Number of parameters of the open channels, which come first.
    params: usize,
}

impl Opened {
    /// Opens the first `channels` of `whole`, at least one. Refused if it has parameters other than feature tables, or
    /// if the parameters of its first channels do not come first.
    pub fn new(whole: Arc<dyn Encoder>, channels: usize) -> Result<Self> {
        let width = whole.info().output;
        ensure((1..=width).contains(&channels), "encoder", "open channels", channels, format!("1 to {width}"))?;
        let kept = whole.keep_outputs(&(0..channels).collect::<Vec<_>>())?;
        let mut params = 0;
        for range in &kept.params {
            if range.start != params {
                return Err(Error::unsupported(whole.describe(), "its coarse levels are not its first parameters"));
            }
            params = range.end;
        }
        let scattered = [whole.info(), kept.stage.info()].iter().all(|i| i.grads == GradKind::Scatter && i.tape == 0);
        if !scattered || kept.channels != [0, 1, 2] {
            return Err(Error::unsupported(whole.describe(), "it has no tables of features that could stay closed"));
        }
        Ok(Self { whole, open: Arc::from(kept.stage), channels, params })
    }

    /// The open channels and the parameters that they have; clears the closed channels.
    fn apart<'a, R: Real>(&self, params: &'a [R], y: TileMut<'a, R>, clear: bool) -> (&'a [R], TileMut<'a, R>) {
        let (open, closed) = y.data.split_at_mut(self.channels * y.rows);
        if clear {
            closed.fill(R::ZERO);
        }
        (&params[..self.params], TileMut::new(open, y.rows))
    }
}

impl<R: Precision> Kernel<R> for Opened {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        let (params, y) = self.apart(params, y, true);
        if let Some(kernel) = R::kernel(&*self.open) {
            kernel.forward(params, x, y, tape);
        }
    }

    fn passes(&self) -> usize {
        R::kernel(&*self.open).map_or(0, |kernel| kernel.passes())
    }

    fn forward_pass(&self, pass: usize, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        let (params, y) = self.apart(params, y, pass == 0);
        if let Some(kernel) = R::kernel(&*self.open) {
            kernel.forward_pass(pass, params, x, y, tape);
        }
    }

    fn backward(&self, Backward { params, x, tape, dy, grads, dx }: Backward<'_, R>) {
        let range = grads.range.start.min(self.params)..grads.range.end.min(self.params);
        let Some(kernel) = R::kernel(&*self.open).filter(|_| !range.is_empty() || dx.is_some()) else { return };
        let values = &mut grads.values[..range.len()];
        let dy = Tile::new(dy.channels(0..self.channels), x.rows);
        let grads = Grads { values, range };
        kernel.backward(Backward { params: &params[..self.params], x, tape, dy, grads, dx });
    }
}

impl Stage for Opened {
    fn info(&self) -> Info {
        Info { macs: self.open.info().macs, ..self.whole.info() }
    }

    fn parameters(&self) -> Vec<Parameter> {
        self.whole.parameters()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        self.whole.init(seed, params);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        self.open.reference().map(|_| self as _)
    }

    /// The closed channels are one additional range.
    fn partition(&self) -> Vec<Range<usize>> {
        let closed = self.params..self.whole.info().params;
        self.open.partition().into_iter().chain((!closed.is_empty()).then_some(closed)).collect()
    }

    fn fault(&self) -> Result<()> {
        self.open.fault()
    }

    fn wgsl(&self) -> Option<Fragment> {
        let (fragment, n, width) = (self.open.wgsl()?, self.channels, self.info().output);
        let name = "stage_open_";
        let parts = hosted(name, 0, 0, &fragment) + &fragment.named(name);
        let forward = format!(
            "    var open: array<f32, {n}>;
    {name}forward(x, &open);
    for (var c = 0u; c < {width}u; c++) {{ (*y)[c] = 0.0; }}
    for (var c = 0u; c < {n}u; c++) {{ (*y)[c] = open[c]; }}
"
        );
        let backward = format!(
            "    var open: array<f32, {n}>;
    for (var c = 0u; c < {n}u; c++) {{ open[c] = (*dy)[c]; }}
    {name}backward(x, &open, dx);
"
        );
        Some(Fragment::new(&[&parts, &functions(3, width, &forward, &backward)]))
    }

    fn describe(&self) -> String {
        let width = self.whole.info().output;
        format!("{}, {} of {width} channels open", self.whole.describe(), self.channels)
    }
}

impl Encoder for Opened {
    fn coarse_to_fine(&self) -> bool {
        self.whole.coarse_to_fine()
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        self.whole.resolutions()
    }
}
