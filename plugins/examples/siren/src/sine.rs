//! A multi-layer perceptron whose activation is a sine (Sitzmann et al., "Implicit neural representations with periodic
//! activation functions", 2020): `h₁ = sin(ω·(W₁x + b₁))`, `hₖ = sin(ω·(Wₖhₖ₋₁ + bₖ))`, and `μ = softplus(w·h + b)`,
//! which is never negative.

use conefield_plugin::prelude::*;
use conefield_plugin::wgsl::{Sum, declare, functions};
use std::fmt::Write;

stage_type!(FieldSpec, "siren", Siren, "multi-layer perceptron of sines");

/// Settings of `siren`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("examples" = [{"width": 5, "depth": 3, "omega": 1.0}]))]
pub struct Siren {
    /// Channels of every hidden layer.
    pub width: usize,
    /// Hidden layers.
    pub depth: usize,
    /// Angular frequency of the sines. The paper uses 30 for coordinates; features of order one need less.
    pub omega: f64,
}

impl Default for Siren {
    fn default() -> Self {
        Self { width: 32, depth: 2, omega: 3.0 }
    }
}

impl FieldSpec for Siren {
    fn build(&self, width: usize) -> Result<Box<dyn Field>> {
        ensure((1..=1024).contains(&self.width), "spec", "width", self.width, "1 to 1024")?;
        ensure((1..=16).contains(&self.depth), "spec", "depth", self.depth, "1 to 16")?;
        let good = self.omega.is_finite() && self.omega > 0.0 && self.omega <= 1000.0;
        ensure(good, "spec", "omega", self.omega, "above 0 and at most 1000")?;
        Ok(Box::new(SirenField::new(self.clone(), width)))
    }
}

/// One layer: numbers of `input` and `output` channels, and the positions of its weights and biases.
#[derive(Debug, Clone, Copy)]
struct Layer {
    input: usize,
    output: usize,
    weights: usize,
    biases: usize,
}

/// The field that [`Siren`] builds.
pub struct SirenField {
    settings: Siren,
    input: usize,
    layers: Vec<Layer>,
}

impl SirenField {
    fn new(settings: Siren, input: usize) -> Self {
        let mut layers = vec![];
        let (mut wide, mut at) = (input, 0);
        for k in 0..=settings.depth {
            let output = if k == settings.depth { 1 } else { settings.width };
            layers.push(Layer { input: wide, output, weights: at, biases: at + wide * output });
            at += (wide + 1) * output;
            wide = output;
        }
        Self { settings, input, layers }
    }

    fn params(&self) -> usize {
        self.layers.last().map_or(0, |l| l.biases + l.output)
    }
}

/// `y = W·x + b`, channel by channel, so that the inner loop runs over rows.
fn sums<R: Real>(layer: &Layer, params: &[R], x: &[R], y: &mut [R], rows: usize) {
    for (o, y) in y.chunks_exact_mut(rows).enumerate() {
        y.fill(params[layer.biases + o]);
        let weights = &params[layer.weights + o * layer.input..][..layer.input];
        for (x, &w) in x.chunks_exact(rows).zip(weights) {
            for (y, &x) in y.iter_mut().zip(x) {
                *y += w * x;
            }
        }
    }
}

impl<R: Real> Kernel<R> for SirenField {
    /// Computes the outputs of every hidden layer, then the derivatives of all activations.
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        let rows = x.rows;
        let omega = R::of(self.settings.omega);
        let hidden = self.settings.depth * self.settings.width * rows;
        let (outputs, slopes) = tape.data.split_at_mut(hidden);
        let (last, inner) = self.layers.split_last().expect("a field has layers");
        for (k, layer) in inner.iter().enumerate() {
            let size = self.settings.width * rows;
            let (before, after) = outputs.split_at_mut(k * size);
            let input = if k == 0 { x.data } else { &before[(k - 1) * size..] };
            let output = &mut after[..size];
            sums(layer, params, input, output, rows);
            for (h, slope) in output.iter_mut().zip(&mut slopes[k * size..(k + 1) * size]) {
                let (sin, cos) = (omega * *h).sin_cos();
                (*h, *slope) = (sin, omega * cos);
            }
        }
        let input = &outputs[hidden - last.input * rows..];
        sums(last, params, input, y.data, rows);
        for (y, slope) in y.data.iter_mut().zip(&mut slopes[hidden..]) {
            *slope = R::of(1.0 / (1.0 + (-y.f64()).exp()));
            *y = y.softplus();
        }
    }

    fn backward(&self, Backward { params, x, tape, dy, grads, mut dx }: Backward<'_, R>) {
        let rows = x.rows;
        let size = self.settings.width * rows;
        let hidden = self.settings.depth * size;
        let (outputs, slopes) = tape.data.split_at_mut(hidden);
        let mut add = |at: usize, sum: R| {
            if grads.range.contains(&at) {
                grads.values[at - grads.range.start] += sum;
            }
        };
        // The gradient of each layer's sums replaces its derivatives.
        slopes[hidden..].iter_mut().zip(dy.data).for_each(|(slope, &dy)| *slope *= dy);
        for (k, layer) in self.layers.iter().enumerate().rev() {
            let (before, own) = slopes.split_at_mut(k * size);
            let own = &own[..layer.output * rows];
            let input = if k == 0 { x.data } else { &outputs[(k - 1) * size..k * size] };
            for (o, d) in own.chunks_exact(rows).enumerate() {
                for (i, x) in input.chunks_exact(rows).enumerate() {
                    add(layer.weights + o * layer.input + i, x.iter().zip(d).map(|(&x, &d)| x * d).sum());
                }
                add(layer.biases + o, d.iter().copied().sum());
            }
            // Gradients with respect to the outputs of the previous layer; times its derivatives they are the gradients
            // of its sums.
            let back = |i: usize, row: usize| -> R {
                (0..layer.output).map(|o| params[layer.weights + o * layer.input + i] * own[o * rows + row]).sum()
            };
            if k > 0 {
                let slopes = &mut before[(k - 1) * size..];
                for (i, slopes) in slopes.chunks_exact_mut(rows).enumerate() {
                    slopes.iter_mut().enumerate().for_each(|(row, slope)| *slope *= back(i, row));
                }
            } else if let Some(dx) = &mut dx {
                for i in 0..layer.input {
                    dx.channel(i).iter_mut().enumerate().for_each(|(row, dx)| *dx = back(i, row));
                }
            }
        }
    }
}

impl Stage for SirenField {
    fn info(&self) -> Info {
        Info {
            input: self.input,
            output: 1,
            params: self.params(),
            tape: 2 * self.settings.depth * self.settings.width + 1,
            grads: GradKind::Dense,
            macs: self.layers.iter().map(|l| l.input * l.output).sum(),
            ..Info::default()
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let of = |(k, l): (usize, &Layer)| {
            [
                Parameter { name: format!("{k}.weight"), shape: vec![l.output, l.input], start: l.weights },
                Parameter { name: format!("{k}.bias"), shape: vec![l.output], start: l.biases },
            ]
        };
        self.layers.iter().enumerate().flat_map(of).collect()
    }

    /// The paper's scheme: uniform within 1/n for the first layer of n inputs, within √(6/n)/ω for the others.
    fn init(&self, seed: u64, params: &mut [f32]) {
        for (k, l) in self.layers.iter().enumerate() {
            let n = l.input as f64;
            let bound = if k == 0 { 1.0 / n } else { (6.0 / n).sqrt() / self.settings.omega };
            for i in l.weights..l.biases + l.output {
                params[i] = bound as f32 * (2.0 * unit(mix(seed, i as u64)) - 1.0);
            }
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    /// The same layers for one row. Every row touches every weight: gradients are sums over rows of channels that `backward`
    /// keeps, first the features, then the outputs and slopes of each layer.
    fn wgsl(&self) -> Option<Fragment> {
        let (n, last) = (self.input, self.layers.len() - 1);
        let (mut layers, mut back) = (String::new(), String::new());
        let mut keep = format!("    for (var i = 0u; i < {n}u; i++) {{ stage_keep(i, (*x)[i]); }}\n");
        let mut sums = vec![];
        let (mut right, mut keeps) = (0, n);
        for (k, &Layer { input, output, weights, biases }) in self.layers.iter().enumerate() {
            let from = if k == 0 { "(*x)".into() } else { format!("h{}", k - 1) };
            let activation = if k == last { "stage_softplus" } else { "stage_sine" };
            let _ = write!(
                layers,
                "    var h{k}: array<f32, {output}>;
    var s{k}: array<f32, {output}>;
    for (var o = 0u; o < {output}u; o++) {{
        var sum = stage_param({biases}u + o);
        for (var i = 0u; i < {input}u; i++) {{ sum += stage_param({weights}u + o * {input}u + i) * {from}[i]; }}
        let found = {activation}(sum);
        h{k}[o] = found.x;
        s{k}[o] = found.y;
    }}
"
            );
            let left = keeps + output;
            sums.push(Sum { at: weights, ld: input, left, outputs: output, right, inputs: input });
            sums.push(Sum::vector(biases, left, output));
            let _ = write!(
                keep,
                "    for (var o = 0u; o < {output}u; o++) {{
        stage_keep({keeps}u + o, h{k}[o]);
        stage_keep({left}u + o, s{k}[o]);
    }}
"
            );
            (right, keeps) = (keeps, keeps + 2 * output);
        }
        for (k, Layer { input, output, weights, .. }) in self.layers.iter().enumerate().rev() {
            let put = if k == 0 { "(*dx)[i] =".into() } else { format!("s{}[i] *=", k - 1) };
            let _ = write!(
                back,
                "    for (var i = 0u; i < {input}u; i++) {{
        var sum = 0.0;
        for (var o = 0u; o < {output}u; o++) {{ sum += stage_param({weights}u + o * {input}u + i) * s{k}[o]; }}
        {put} sum;
    }}
"
            );
        }
        let omega = self.settings.omega as f32;
        let activations = format!(
            "fn stage_sine(x: f32) -> vec2<f32> {{ return vec2<f32>(sin({omega:?} * x), {omega:?} * cos({omega:?} * x)); }}

fn stage_softplus(x: f32) -> vec2<f32> {{
    let e = exp(-min(abs(x), 87.0));
    return vec2<f32>(max(x, 0.0) + log(1.0 + e), select(e, 1.0, x >= 0.0) / (1.0 + e));
}}
"
        );
        let forward = format!("{layers}    (*y)[0] = h{last}[0];\n");
        let backward = format!("{layers}    s{last}[0] *= (*dy)[0];\n{back}{keep}");
        Some(Fragment::new(&[&declare(keeps, &sums), &activations, &functions(n, 1, &forward, &backward)]))
    }

    fn describe(&self) -> String {
        let Siren { width, depth, omega } = &self.settings;
        format!("siren: {} -> {depth} layers of {width} -> 1, sines of frequency {omega}", self.input)
    }
}

impl Field for SirenField {}
