//! Several encoders side by side: points `[n, 3]` to the channels of the first part, then of the second, and so on.

use conefield_core::prelude::*;
use conefield_core::stage::Precision;
use conefield_core::wgsl::{functions, hosted};
use std::fmt::Write;
use std::ops::Range;
use std::sync::Arc;

/// Settings of `concat`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Concat {
    /// The encoders, in the order of their channels; may include `concat`.
    #[serde(deserialize_with = "conefield_core::spec::stage::list")]
    #[schemars(schema_with = "conefield_core::spec::stage::schema_of_list::<dyn EncoderSpec>", extend("minItems" = 1))]
    pub encoders: Vec<Box<dyn EncoderSpec>>,
}

conefield_core::stage_type!(
    EncoderSpec,
    "concat",
    Concat,
    "several encoders side by side",
    example = r#"{"encoders": ["identity", {"type": "frequency", "bands": 2, "max_frequency": 2.0}]}"#
);

impl EncoderSpec for Concat {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        let mut parts = vec![];
        for (i, e) in self.encoders.iter().enumerate() {
            let part = e.build().map_err(|e| e.within(&format!("encoders.{i}")))?;
            let input = part.info().input;
            ensure(input == 3, "spec", &format!("encoders.{i}"), format!("{input} channels in"), "3")?;
            parts.push((i, Arc::from(part)));
        }
        Ok(Box::new(ConcatStage::new(parts)?))
    }
}

#[derive(Clone)]
struct ConcatMember {
    stage: Arc<dyn Encoder>,
    info: Info,
    /// Its index in the settings, which names its parameters.
    number: usize,
    outputs: Range<usize>,
    params: Range<usize>,
    tape: Range<usize>,
}

/// The stage that [`Concat`] builds.
#[derive(Clone)]
pub struct ConcatStage {
    parts: Vec<ConcatMember>,
    info: Info,
}

impl ConcatStage {
    /// Concatenates parts, each with its index in the settings.
    fn new(stages: Vec<(usize, Arc<dyn Encoder>)>) -> Result<Self> {
        ensure(!stages.is_empty(), "spec", "encoders", "none", "at least one encoder")?;
        let mut info = Info { input: 3, output: 0, ..Info::default() };
        let mut parts = vec![];
        for (number, stage) in stages {
            let i = stage.info();
            let part = ConcatMember {
                outputs: info.output..info.output + i.output,
                params: info.params..info.params + i.params,
                tape: info.tape..info.tape + i.tape,
                number,
                stage,
                info: i.clone(),
            };
            info.output = part.outputs.end;
            info.params = part.params.end;
            info.tape = part.tape.end;
            info.macs += i.macs;
            // One part with scattered gradients makes the whole scattered; a dense part is then one range of the
            // partition.
            info.grads = match (info.grads, i.grads) {
                (GradKind::None, g) | (g, GradKind::None) => g,
                (GradKind::Dense, GradKind::Dense) => GradKind::Dense,
                _ => GradKind::Scatter,
            };
            parts.push(part);
        }
        if info.grads == GradKind::Scatter && info.tape > 0 {
            return Err(Error::unsupported(
                "concat: encoders",
                "an encoder that keeps a tape beside one whose gradients are scattered; use them in separate specs",
            ));
        }
        Ok(Self { parts, info })
    }
}

fn channels<'a, R: Real>(data: &'a mut [R], range: &Range<usize>, rows: usize) -> TileMut<'a, R> {
    TileMut::new(&mut data[range.start * rows..range.end * rows], rows)
}

impl ConcatStage {
    /// The parts with their kernels.
    fn kernels<R: Precision>(&self) -> impl Iterator<Item = (&ConcatMember, &dyn Kernel<R>)> {
        self.parts.iter().filter_map(|part| Some((part, R::kernel(&*part.stage)?)))
    }
}

impl<R: Precision> Kernel<R> for ConcatStage {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        for (part, kernel) in self.kernels::<R>() {
            let y = channels(y.data, &part.outputs, x.rows);
            let tape = channels(tape.data, &part.tape, x.rows);
            kernel.forward(&params[part.params.clone()], x, y, tape);
        }
    }

    /// Sum of the passes of all parts.
    fn passes(&self) -> usize {
        self.kernels::<R>().map(|(_, kernel)| kernel.passes()).sum()
    }

    fn forward_pass(&self, mut pass: usize, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        for (part, kernel) in self.kernels::<R>() {
            if pass >= kernel.passes() {
                pass -= kernel.passes();
                continue;
            }
            let y = channels(y.data, &part.outputs, x.rows);
            let tape = channels(tape.data, &part.tape, x.rows);
            return kernel.forward_pass(pass, &params[part.params.clone()], x, y, tape);
        }
    }

    fn backward(&self, Backward { params, x, tape, dy, grads, mut dx }: Backward<'_, R>) {
        let n = x.rows;
        // Parts overwrite their input gradient, so every part except the first needs its own buffer.
        let mut one = if dx.is_some() && self.parts.len() > 1 { vec![R::ZERO; 3 * n] } else { vec![] };
        let range = &grads.range;
        for (i, (part, kernel)) in self.kernels::<R>().enumerate() {
            let (from, to) = (part.params.start.max(range.start), part.params.end.min(range.end));
            let own = if from < to { from..to } else { part.params.start..part.params.start };
            if own.is_empty() && dx.is_none() {
                continue;
            }
            let values = if own.is_empty() {
                &mut []
            } else {
                &mut grads.values[own.start - range.start..own.end - range.start]
            };
            let own = own.start - part.params.start..own.end - part.params.start;
            kernel.backward(Backward {
                params: &params[part.params.clone()],
                x,
                tape: channels(tape.data, &part.tape, n),
                dy: Tile::new(dy.channels(part.outputs.clone()), n),
                grads: Grads { values, range: own },
                dx: dx.as_mut().map(|dx| TileMut::new(if i == 0 { &mut *dx.data } else { &mut one }, n)),
            });
            if let (Some(dx), true) = (&mut dx, i > 0) {
                dx.data.iter_mut().zip(&one).for_each(|(sum, &d)| *sum += d);
            }
        }
    }
}

impl Stage for ConcatStage {
    fn info(&self) -> Info {
        self.info.clone()
    }

    /// The parts' parameter names after their index, e.g. `1.0.table`.
    fn parameters(&self) -> Vec<Parameter> {
        let of = |p: &ConcatMember| {
            let (number, start) = (p.number, p.params.start);
            let named =
                move |q: Parameter| Parameter { name: format!("{number}.{}", q.name), start: start + q.start, ..q };
            p.stage.parameters().into_iter().map(named)
        };
        self.parts.iter().flat_map(of).collect()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        for p in &self.parts {
            p.stage.init(mix(seed, p.number as u64), &mut params[p.params.clone()]);
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        self.parts.iter().all(|p| p.stage.reference().is_some()).then_some(self as _)
    }

    fn partition(&self) -> Vec<Range<usize>> {
        let of = |p: &ConcatMember| {
            let start = p.params.start;
            let ranges = match p.info.grads {
                GradKind::None => vec![],
                GradKind::Dense => vec![0..p.info.params],
                GradKind::Scatter => p.stage.partition(),
            };
            ranges.into_iter().map(move |r| start + r.start..start + r.end)
        };
        self.parts.iter().flat_map(of).collect()
    }

    fn fault(&self) -> Result<()> {
        self.parts.iter().try_for_each(|p| p.stage.fault())
    }

    fn wgsl(&self) -> Option<Fragment> {
        let width = self.info.output;
        let (mut parts, mut forward, mut backward) = (String::new(), String::new(), String::new());
        let mut kept = 0;
        for (i, part) in self.parts.iter().enumerate() {
            let fragment = part.stage.wgsl()?;
            let name = format!("stage_{i}_");
            parts += &hosted(&name, u32::try_from(part.params.start).ok()?, kept, &fragment);
            kept += fragment.keeps();
            parts += &fragment.named(&name);
            let (n, first) = (part.outputs.len(), part.outputs.start);
            let copy = format!("for (var c = 0u; c < {n}u; c++)");
            let _ = write!(
                forward,
                "    var y{i}: array<f32, {n}>;
    {name}forward(x, &y{i});
    {copy} {{ (*y)[{first}u + c] = y{i}[c]; }}
"
            );
            let _ = write!(
                backward,
                "    var d{i}: array<f32, {n}>;
    {copy} {{ d{i}[c] = (*dy)[{first}u + c]; }}
    {name}backward(x, &d{i}, &part);
    for (var k = 0u; k < 3u; k++) {{ sum[k] += part[k]; }}
"
            );
        }
        let begin = "    var sum: array<f32, 3>;\n    var part: array<f32, 3>;\n";
        let functions = functions(3, width, &forward, &format!("{begin}{backward}    *dx = sum;\n"));
        Some(Fragment::new(&[&parts, &functions]))
    }

    fn describe(&self) -> String {
        let parts: Vec<_> = self.parts.iter().map(|p| p.stage.describe()).collect();
        format!("concat: {} channels of ({})", self.info.output, parts.join(") + ("))
    }
}

impl Encoder for ConcatStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        let mut stages = vec![];
        let mut params = vec![];
        for p in &self.parts {
            let keep: Vec<usize> = keep.iter().filter(|c| p.outputs.contains(c)).map(|c| c - p.outputs.start).collect();
            if keep.is_empty() {
                continue;
            }
            // A part that keeps all channels need not support masking.
            if keep.len() == p.outputs.len() {
                stages.push((p.number, p.stage.clone()));
                params.push(p.params.clone());
                continue;
            }
            let r = p.stage.keep_outputs(&keep)?;
            if r.channels != [0, 1, 2] {
                return Err(Error::unsupported(r.stage.describe(), "a part of a concat must read all 3 coordinates"));
            }
            params.extend(r.params.iter().map(|q| p.params.start + q.start..p.params.start + q.end));
            stages.push((p.number, Arc::from(r.stage)));
        }
        Ok(Reduced { stage: Box::new(Self::new(stages)?), params, channels: vec![0, 1, 2] })
    }

    fn coarse_to_fine(&self) -> bool {
        self.parts.len() == 1 && self.parts[0].stage.coarse_to_fine()
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let parts: Option<Vec<_>> = self.parts.iter().map(|p| p.stage.resolutions()).collect();
        parts.map(|p| p.concat())
    }
}
