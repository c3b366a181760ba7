//! Kernels composed from the fragments of a pipeline's stages.
//!
//! Each invocation takes one row through a kernel, 64 to a group. `forward` goes from the encoder to μ. It writes the features
//! of an encoder with parameters and the channels that stages keep. `backward` starts from these, goes back as far as the
//! features, and leaves their derivatives in their place. `scatter` goes from there to the encoder's tables, and adds scattered
//! gradients where they belong at once. `sums` adds up products of kept channels over rows; each of its groups has a share of the
//! rows and partial sums of its own, which `merge` adds up. Samples of rays that weigh 0, and rows whose derivative is 0, are
//! skipped.

use crate::device::Atomics;
use Access::{Read, Write};
use conefield_core::device::{Access, Source, fragment_of};
use conefield_core::error::{Error, Result};
use conefield_core::loss::Loss;
use conefield_core::pipeline::Pipeline;
use conefield_core::prior::Prior;
use conefield_core::stage::{GradKind, Info, Projector, Scope, Stage, titled};
use conefield_core::wgsl::{self, Fragment, RANDOM, RAY, Sum, TOTAL};
use std::fmt::Write as _;
use std::ops::Range;

/// Rows per group.
pub const GROUP: u32 = 64;

/// Number of partial sums that one invocation of `merge` adds.
const MERGED: usize = 32;

/// Maximum number of channels that a stage keeps.
const MOST_KEPT: usize = 1 << 16;

/// Properties of the device on which the text of kernels depends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Target {
    /// How gradients of scattered parameters are added.
    pub atomics: Atomics,
    /// Whether lanes of a subgroup first combine what they add to the same entry.
    pub subgroups: bool,
    /// Parameters per buffer, a multiple of 64.
    pub segment: usize,
    /// Bytes of the largest uniform buffer.
    pub uniform_bytes: usize,
}

/// The task of stages in a kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Pass {
    /// Forward, keeping nothing.
    Evaluate,
    /// Forward, keeping what `backward` needs.
    Forward,
    /// Backward, keeping what `sums` needs.
    Backward,
}

/// A stage as kernels include it.
#[derive(Debug, Clone)]
pub struct Link {
    /// Its name and type, for messages.
    pub name: String,
    /// Prefix of its functions' names.
    prefix: String,
    fragment: Fragment,
    /// Widths and counts.
    pub info: Info,
    /// Its parameters in the arena.
    range: Range<usize>,
    /// Position of its parameters among those that every row reads; `None` if a row reads few of them.
    dense: Option<usize>,
    /// Its first channel on the tape.
    tape: usize,
    /// Whether a stage before it has parameters.
    wants_dx: bool,
}

/// A sum over rows, in channels of the tape and parameters of the arena.
#[derive(Debug, Clone, Copy)]
struct RowSum {
    sum: Sum,
    /// Its first partial sum.
    partial: usize,
}

/// The stages that do work, in order, and what kernels need to know about them.
#[derive(Debug, Clone)]
pub struct Chain {
    links: Vec<Link>,
    /// Whether the first link is the encoder; otherwise the encoder passes positions on unchanged.
    encoder: bool,
    /// Parameters that every row reads.
    dense: usize,
    /// Channels that rows keep.
    pub tape: usize,
    /// Sums over rows.
    sums: Vec<RowSum>,
    /// The blocks of `sums`.
    blocks: Vec<String>,
    /// Parameters of the arena.
    pub params: usize,
    pub target: Target,
}

impl Chain {
    /// The stages of a pipeline. Refuses stages that cannot run on a GPU.
    pub fn new(pipeline: &Pipeline, target: Target) -> Result<Self> {
        let mut chain = Self::empty(pipeline.layout().len(), target);
        for (i, ((name, stage), range)) in pipeline.stages().into_iter().zip(pipeline.ranges()).enumerate() {
            if stage.info().identity {
                continue;
            }
            chain.encoder |= i == 0;
            let before = chain.links.iter().any(|l: &Link| l.info.params > 0);
            chain.link(&name, stage, range.clone(), before)?;
        }
        Ok(chain)
    }

    /// One stage alone, with all its functions.
    pub fn single(stage: &dyn Stage, target: Target) -> Result<Self> {
        let params = stage.info().params;
        let mut chain = Self::empty(params, target);
        chain.link("stage", stage, 0..params, true)?;
        Ok(chain)
    }

    fn empty(params: usize, target: Target) -> Self {
        Self { links: vec![], encoder: false, dense: 0, tape: 0, sums: vec![], blocks: vec![], params, target }
    }

    fn link(&mut self, name: &str, stage: &dyn Stage, range: Range<usize>, wants_dx: bool) -> Result<()> {
        let (info, name) = (stage.info(), titled(name, &stage.describe()));
        let refused = |why: String| Error::unsupported(format!("{name} on the wgpu backend"), why);
        if info.scope == Scope::Ray {
            let why = "the stage looks along rays and kernels see one row at a time; it runs with --backend cpu";
            return Err(refused(why.into()));
        }
        if u32::try_from(self.params).is_err() {
            let why = format!("{} parameters; at most 2^32 can be addressed", self.params);
            return Err(Error::unsupported("the wgpu backend", why));
        }
        let fragment = fragment_of(&name, stage.wgsl())?;
        let (keeps, sums) = (fragment.keeps(), fragment.sums());
        check(&sums, keeps, info.params).map_err(|why| refused(format!("its WGSL {why}")))?;
        for sum in sums {
            let partial = self.summed();
            let sum = Sum { at: range.start + sum.at, left: self.tape + sum.left, right: self.tape + sum.right, ..sum };
            self.sums.push(RowSum { sum, partial });
        }
        self.blocks = blocks_of(&self.sums);
        // Vectors of four are read in one piece.
        let dense = (info.grads == GradKind::Dense).then_some(self.dense.next_multiple_of(4));
        self.dense = dense.map_or(self.dense, |first| first + info.params);
        let prefix = format!("s{}_", self.links.len());
        let tape = self.tape;
        self.tape += keeps;
        self.links.push(Link { name, prefix, fragment, info, range, dense, tape, wants_dx });
        Ok(())
    }

    /// Number of partial sums of a share of the rows.
    pub fn summed(&self) -> usize {
        self.sums.last().map_or(0, |s| s.partial + s.sum.params())
    }

    /// The ranges of the arena in the copy that every row reads, each with its position in the copy.
    pub fn dense_ranges(&self) -> impl Iterator<Item = (usize, Range<usize>)> {
        self.links.iter().filter_map(|l| Some((l.dense?, l.range.clone())))
    }

    /// Bytes of the copy of the parameters that every row reads.
    pub fn dense_bytes(&self) -> u64 {
        16 * self.dense.div_ceil(4) as u64
    }

    /// Number of buffers per part of the arena.
    pub fn segments(&self) -> usize {
        self.params.div_ceil(self.target.segment).max(1)
    }

    /// The range of the arena in buffer `s` of each part.
    pub fn segment(&self, s: usize) -> Range<usize> {
        s * self.target.segment..((s + 1) * self.target.segment).min(self.params)
    }

    /// Number of feature channels that `forward` keeps for `backward`; 0 if the encoder has no parameters.
    pub fn kept(&self) -> usize {
        let first = self.links.first().filter(|l| self.encoder && l.info.params > 0);
        first.map_or(0, |l| l.info.output)
    }

    /// Number of the encoder's output channels.
    pub fn features(&self) -> usize {
        self.links.first().filter(|_| self.encoder).map_or(3, |l| l.info.output)
    }

    /// Binds the arena and, if one of `links` needs it, the copy of the parameters that every row reads.
    fn declare(&self, source: &mut Source, links: &[Link], gradients: bool) {
        for s in 0..self.segments() {
            source.bind(&format!("params_{s}"), Read, "array<vec2<f32>>");
        }
        if links.iter().any(|l| l.dense.is_some()) {
            let vectors = self.dense.div_ceil(4);
            // Kernels with a uniform buffer compile fast. But `backward` reads it slowly, for a reason that is not known: on an H200
            // it took 22 ms for 5.2 M samples, and 4.4 ms with a storage buffer.
            match gradients || 16 * vectors > self.target.uniform_bytes {
                true => source.bind("dense", Read, "array<vec4<f32>>"),
                false => source.bind("dense", Access::Uniform, &format!("array<vec4<f32>, {vectors}>")),
            }
        }
        let mut text = String::from("fn arena_param(i: u32) -> f32 {\n");
        // One number at a time: on an H200, reading both of a pair took twice as long.
        self.each_segment(&mut text, |s, i| format!("let at = {i}; return params_{s}[at >> 1u][at & 1u];"));
        text += "    return 0.0;\n}\n";
        if gradients {
            let atomics = self.target.atomics;
            for s in 0..self.segments() {
                source.bind(&format!("grads_{s}"), Write, &format!("array<atomic<{}>>", atomics.number()));
                let _ =
                    writeln!(text, "fn arena_add_{s}(i: u32, v: f32) {{\n{}}}", atomics.sum(&format!("grads_{s}[i]")));
            }
            text += "fn arena_grad(i: u32, v: f32) {\n    if v == 0.0 { return; }\n";
            self.each_segment(&mut text, |s, i| format!("arena_add_{s}({i}, v); return;"));
            text += "}\n";
        }
        source.add("the arena", &text);
    }

    /// Adds `line` for each segment to `text`. It runs for entries `i` of the segment and gets their position in it.
    fn each_segment(&self, text: &mut String, line: impl Fn(usize, &str) -> String) {
        let size = self.target.segment;
        for s in 0..self.segments() {
            let i = if s == 0 { "i".to_owned() } else { format!("i - {}u", s * size) };
            let line = line(s, &i);
            let _ = match s + 1 == self.segments() {
                true => writeln!(text, "    {line}"),
                false => writeln!(text, "    if i < {}u {{ {line} }}", (s + 1) * size),
            };
        }
    }

    /// The functions of `link` and those that it calls.
    fn include(&self, source: &mut Source, link: &Link, pass: Pass) {
        let Link { name, prefix, fragment, range, dense, tape, wants_dx, .. } = link;
        let first = range.start;
        let param = match dense {
            Some(first) => format!("dense[({first}u + i) >> 2u][({first}u + i) & 3u]"),
            None => format!("arena_param({first}u + i)"),
        };
        let four = match dense {
            Some(first) => format!("dense[({first}u + i) >> 2u]"),
            None => wgsl::four_by_one(prefix),
        };
        let gradients = pass == Pass::Backward;
        let scattered = if gradients { format!("arena_scatter({first}u + i, v);") } else { String::new() };
        let at = format!("tape[({tape}u + c) * step.stride + row]");
        let (keep, kept) = match pass {
            Pass::Evaluate => (String::new(), "0.0"),
            Pass::Forward => (format!("{at} = v;"), at.as_str()),
            // Rows past the end have no place on the tape.
            Pass::Backward if !self.skips() => (format!("if row < step.rows {{ {at} = v; }}"), at.as_str()),
            Pass::Backward => (format!("{at} = v;"), at.as_str()),
        };
        // A stage that keeps nothing needs no tape.
        let (keep, kept) = if fragment.keeps() > 0 { (keep.as_str(), kept) } else { ("", "0.0") };
        let mut text = format!(
            "const {prefix}wants_dx = {wants_dx};
fn {prefix}param(i: u32) -> f32 {{ return {param}; }}
fn {prefix}param4(i: u32) -> vec4<f32> {{ return {four}; }}
fn {prefix}keep(c: u32, v: f32) {{ {keep} }}
fn {prefix}kept(c: u32) -> f32 {{ return {kept}; }}
fn {prefix}grad(i: u32, v: f32) {{ {scattered} }}
"
        );
        text += &match (gradients, first.is_multiple_of(2)) {
            (true, true) => {
                format!("fn {prefix}grad_pair(i: u32, v: vec2<f32>) {{ arena_scatter_pair({first}u + i, v); }}\n")
            }
            // Pairs stand at even places of the arena.
            _ => wgsl::one_by_one(prefix),
        };
        source.add(&format!("what the host gives {name}"), &text);
        source.add(name, &fragment.named(prefix));
    }

    /// Binds the tape where stages keep something.
    fn bind_tape(&self, source: &mut Source, access: Access) {
        if self.tape > 0 {
            source.bind("tape", access, "array<f32>");
        }
    }

    /// From positions to μ. With `keep` it writes the features and the channels that stages keep.
    pub fn forward(&self, keep: bool) -> Source {
        let mut source = begun(&[("samples", Read), ("mu", Write)]);
        let (pass, keep) = if keep { (Pass::Forward, self.kept()) } else { (Pass::Evaluate, 0) };
        if keep > 0 {
            source.bind("features", Write, "array<f32>");
        }
        if pass == Pass::Forward {
            self.bind_tape(&mut source, Write);
        }
        self.declare(&mut source, &self.links, false);
        self.links.iter().for_each(|l| self.include(&mut source, l, pass));
        let mut body = String::from(
            "        let at = samples[row];
        if row < step.ray_rows && at.w == 0.0 {
            mu[row] = 0.0;
            continue;
        }
        var x0 = array<f32, 3>(at.x, at.y, at.z);
",
        );
        for (i, l) in self.links.iter().enumerate() {
            let _ = write!(
                body,
                "        var x{}: array<f32, {}>;\n        {}forward(&x{i}, &x{});\n",
                i + 1,
                l.info.output,
                l.prefix,
                i + 1
            );
            if i == 0 && keep > 0 {
                body += &channels(keep, "features[{at}] = x1[{c}];");
            }
        }
        let _ = writeln!(body, "        mu[row] = x{}[0];", self.links.len());
        source.add("forward", &rows(&body));
        source
    }

    /// From positions to features, channel-major.
    pub fn encode(&self) -> Source {
        let mut source = begun(&[("samples", Read), ("features", Write)]);
        let mut body =
            String::from("        let at = samples[row];\n        var x0 = array<f32, 3>(at.x, at.y, at.z);\n");
        let (mut from, width) = ("x0", self.features());
        if self.encoder {
            self.declare(&mut source, &self.links[..1], false);
            let l = &self.links[0];
            self.include(&mut source, l, Pass::Evaluate);
            let _ = writeln!(body, "        var x1: array<f32, {width}>;\n        {}forward(&x0, &x1);", l.prefix);
            from = "x1";
        }
        let _ = writeln!(
            body,
            "        for (var c = 0u; c < {width}u; c++) {{ features[c * step.stride + row] = {from}[c]; }}"
        );
        source.add("encode", &rows(&body));
        source
    }

    /// From the derivative with respect to μ to gradients and to the inputs of `sums`.
    pub fn backward(&self) -> Source {
        let mut source = begun(&[("samples", Read), ("dmu", Read)]);
        let kept = self.kept();
        if kept > 0 {
            let access = if self.scatters() { Write } else { Read };
            source.bind("features", access, "array<f32>");
        }
        self.bind_tape(&mut source, Write);
        self.declare(&mut source, &self.links, true);
        self.additions(&mut source);
        self.links.iter().skip(usize::from(self.scatters())).for_each(|l| self.include(&mut source, l, Pass::Backward));
        let n = self.links.len();
        let skip = self.skip();
        let mut body = format!(
            "        var at = vec4<f32>();
        var d = 0.0;
        if row < step.rows {{ at = samples[row]; d = dmu[row]; }}
        let live = d != 0.0;
        {skip}
        var x0 = array<f32, 3>(at.x, at.y, at.z);
"
        );
        for (i, l) in self.links[..n - 1].iter().enumerate() {
            let _ = writeln!(body, "        var x{}: array<f32, {}>;", i + 1, l.info.output);
            if i == 0 && kept > 0 {
                let _ = writeln!(body, "        if live {{\n{}        }}", channels(kept, "x1[{c}] = features[{at}];"));
            } else {
                let _ = writeln!(body, "        {}forward(&x{i}, &x{});", l.prefix, i + 1);
            }
        }
        let _ = writeln!(body, "        var d{n} = array<f32, 1>(d);");
        self.back(&mut body);
        if self.scatters() {
            body += &channels(kept, "features[{at}] = d1[{c}];");
        }
        source.add("backward", &self.groups(&body));
        source
    }

    /// Whether the encoder's gradients have a kernel of their own. `backward` then overwrites the features with their
    /// derivatives. The second kernel needs few registers, so more of its rows wait for memory at the same time.
    pub fn scatters(&self) -> bool {
        let scattered = |l: &Link| l.info.grads == GradKind::Scatter && l.fragment.keeps() == 0;
        self.kept() > 0 && self.links.len() > 1 && self.links.first().is_some_and(scattered)
    }

    /// Whether `backward` may skip a row: not if lanes add together.
    fn skips(&self) -> bool {
        self.scatters() || !self.together()
    }

    /// Skips a row that is not `live`, if `backward` may skip rows.
    fn skip(&self) -> &'static str {
        if self.skips() { "if !live { continue; }" } else { "" }
    }

    /// From the derivatives with respect to the features to the encoder's gradients.
    pub fn scatter(&self) -> Source {
        let mut source = begun(&[("samples", Read), ("dmu", Read), ("features", Read)]);
        self.declare(&mut source, &self.links[..1], true);
        self.additions(&mut source);
        let l = &self.links[0];
        self.include(&mut source, l, Pass::Backward);
        let kept = self.kept();
        let body = format!(
            "        var at = vec4<f32>();
        var d: array<f32, {kept}>;
        if row < step.rows && dmu[row] != 0.0 {{
            at = samples[row];
{read}        }}
        var x0 = array<f32, 3>(at.x, at.y, at.z);
        var dx: array<f32, 3>;
        {prefix}backward(&x0, &d, &dx);
",
            read = channels(kept, "d[{c}] = features[{at}];"),
            prefix = l.prefix,
        );
        source.add("scatter", &self.groups(&body));
        source
    }

    /// Calls of `backward`, from the last link to the first with parameters.
    fn back(&self, body: &mut String) {
        for (i, l) in self.links.iter().enumerate().skip(usize::from(self.scatters())).rev() {
            if l.info.params == 0 && !l.wants_dx {
                break;
            }
            let _ = write!(
                body,
                "        var d{i}: array<f32, {}>;\n        {}backward(&x{i}, &d{}, &d{i});\n",
                l.info.input,
                l.prefix,
                i + 1
            );
        }
    }

    /// A kernel whose groups take 64 rows at a time, together, including rows past the end.
    fn groups(&self, body: &str) -> String {
        let (builtins, begin) = match self.together() {
            true => (
                "\n    @builtin(subgroup_invocation_id) within: u32,\n    @builtin(subgroup_size) size: u32,",
                "    together_lane = within;\n    together_size = size;\n",
            ),
            false => ("", ""),
        };
        format!(
            "@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) all: vec3<u32>,
    @builtin(local_invocation_index) index: u32,{builtins}
) {{
{begin}    let pieces = (step.rows + 63u) / 64u;
    for (var piece = id.x; piece < pieces; piece += all.x) {{
        row = piece * 64u + index;
{body}    }}
}}
"
        )
    }

    /// The functions by which rows add to the arena's gradients.
    fn additions(&self, source: &mut Source) {
        let text = match self.together() {
            true => include_str!("kernels/together.wgsl"),
            false => {
                "fn arena_scatter(i: u32, v: f32) { arena_grad(i, v); }
fn arena_scatter_pair(i: u32, v: vec2<f32>) { arena_grad(i, v.x); arena_grad(i + 1u, v.y); }"
            }
        };
        source.add("scattered gradients", text);
    }

    /// Whether lanes of a subgroup first combine what they add to the same entry. All lanes must call together, but a
    /// plugin's stage may call from a branch.
    pub fn together(&self) -> bool {
        self.target.subgroups && !self.links.iter().any(|l| l.fragment.source.contains(wgsl::FOREIGN))
    }

    /// Groups of `sums` for `shares` shares of the rows: one per share and block.
    pub fn summing(&self, shares: usize) -> usize {
        self.blocks.len() * shares
    }

    /// Sums over rows, added to the partial sums of each share.
    pub fn sums(&self) -> Source {
        let mut source = begun(&[("dmu", Read)]);
        self.bind_tape(&mut source, Read);
        source.bind("partial", Write, "array<f32>");
        let (blocks, summed) = (&self.blocks, self.summed());
        let mut text = format!("const summed = {summed}u;\nconst blocks = {}u;\n", blocks.len());
        source.add("sums", include_str!("kernels/sums.wgsl"));
        text += "fn block_of(i: u32) -> Block {\n";
        for (i, block) in blocks.iter().enumerate() {
            let _ = match i + 1 == blocks.len() {
                true => writeln!(text, "    return {block};\n}}"),
                false => writeln!(text, "    if i == {i}u {{ return {block}; }}"),
            };
        }
        source.add("blocks of sums", &text);
        source
    }

    /// Groups of `merge` for the partial sums of `shares` shares of the rows.
    pub fn merging(&self, shares: usize) -> usize {
        self.summed().div_ceil(GROUP as usize) * shares.div_ceil(MERGED)
    }

    /// Adds all shares' partial sums to the arena's gradients.
    pub fn merge(&self) -> Source {
        let mut source = Source::default();
        source.bind("partial", Read, "array<f32>");
        self.declare(&mut source, &[], true);
        let mut text = String::from("fn arena_index(i: u32) -> u32 {\n");
        for RowSum { sum, partial } in &self.sums {
            let (at, ld, width, end) = (sum.at, sum.ld, sum.inputs.max(1), partial + sum.params());
            let _ = writeln!(
                text,
                "    if i < {end}u {{ return {at}u + (i - {partial}u) / {width}u * {ld}u + (i - {partial}u) % {width}u; }}"
            );
        }
        let (summed, blocks) = (self.summed(), self.summed().div_ceil(GROUP as usize));
        let _ = write!(
            text,
            "    return 0u;
}}

// Each invocation adds up the sums of {MERGED} shares.
@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) all: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {{
    let shares = arrayLength(&partial) / {summed}u;
    let pieces = {blocks}u * ((shares + {MERGED}u - 1u) / {MERGED}u);
    for (var piece = id.x; piece < pieces; piece += all.x) {{
        let i = (piece % {blocks}u) * 64u + lane;
        if i >= {summed}u {{ continue; }}
        let first = piece / {blocks}u * {MERGED}u;
        var sum = 0.0;
        for (var s = first; s < min(first + {MERGED}u, shares); s++) {{ sum += partial[s * {summed}u + i]; }}
        arena_grad(arena_index(i), sum);
    }}
}}
"
        );
        source.add("merge", &text);
        source
    }

    /// One stage alone: `y` of `x`, both channel-major in buffers of their own.
    pub fn single_forward(&self) -> Source {
        let mut source = begun(&[("x", Read), ("y", Write)]);
        self.bind_tape(&mut source, Write);
        self.declare(&mut source, &self.links, false);
        let l = &self.links[0];
        self.include(&mut source, l, Pass::Forward);
        let Info { input, output, .. } = l.info;
        source.add(
            "forward",
            &rows(&format!(
                "        var x0: array<f32, {input}>;
        for (var c = 0u; c < {input}u; c++) {{ x0[c] = x[c * step.stride + row]; }}
        var x1: array<f32, {output}>;
        {}forward(&x0, &x1);
        for (var c = 0u; c < {output}u; c++) {{ y[c * step.stride + row] = x1[c]; }}
",
                l.prefix
            )),
        );
        source
    }

    /// One stage alone: gradients and `dx` of `x` and `dy`.
    pub fn single_backward(&self) -> Source {
        let mut source = begun(&[("x", Read), ("dy", Read), ("dx", Write)]);
        self.bind_tape(&mut source, Write);
        self.declare(&mut source, &self.links, true);
        self.additions(&mut source);
        let l = &self.links[0];
        self.include(&mut source, l, Pass::Backward);
        let Info { input, output, .. } = l.info;
        let skip = self.skip();
        source.add(
            "backward",
            &self.groups(&format!(
                "        let live = row < step.rows;
        {skip}
        var x0: array<f32, {input}>;
        var d1: array<f32, {output}>;
        var d0: array<f32, {input}>;
        if live {{
            for (var c = 0u; c < {input}u; c++) {{ x0[c] = x[c * step.stride + row]; }}
            for (var c = 0u; c < {output}u; c++) {{ d1[c] = dy[c * step.stride + row]; }}
        }}
        {}backward(&x0, &d1, &d0);
        if live {{ for (var c = 0u; c < {input}u; c++) {{ dx[c * step.stride + row] = d0[c]; }} }}
",
                l.prefix
            )),
        );
        source
    }
}

/// A kernel whose invocations take rows one by one.
fn rows(body: &str) -> String {
    format!(
        "@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {{
    for (row = id.x; row < step.rows; row += groups.x * 64u) {{
{body}    }}
}}
"
    )
}

/// A line for each of `count` channels, with the channel in place of `{c}` and its place in a buffer for `{at}`.
fn channels(count: usize, line: &str) -> String {
    let own = |c: usize| line.replace("{c}", &c.to_string()).replace("{at}", &format!("{c}u * step.stride + row"));
    (0..count).map(|c| format!("            {}\n", own(c))).collect()
}

/// Refuses sums of channels that are not kept, of parameters that a stage does not have, and two for one parameter.
fn check(sums: &[Sum], keeps: usize, params: usize) -> std::result::Result<(), String> {
    if keeps > MOST_KEPT {
        return Err(format!("keeps {keeps} channels, expected at most {MOST_KEPT}"));
    }
    let within = |first: usize, count: usize, all: usize| first.checked_add(count).is_some_and(|end| end <= all);
    let mut rows = vec![];
    for sum in sums {
        let Sum { at, ld, left, outputs, right, inputs } = *sum;
        if outputs == 0 || !within(left, outputs, keeps) || !within(right, inputs, keeps) {
            return Err(format!("sums channels {left} + {outputs} and {right} + {inputs}, but keeps {keeps}"));
        }
        let last = ld.checked_mul(outputs - 1).and_then(|l| l.checked_add(at));
        if !last.is_some_and(|l| within(l, inputs.max(1), params)) {
            return Err(format!("sums to parameter {at} and later ones, but the stage has {params}"));
        }
        rows.extend((0..outputs).map(|j| sum.row(j)));
    }
    rows.sort_by_key(|r| r.start);
    match rows.windows(2).find(|r| r[1].start < r[0].end) {
        Some(twice) => Err(format!("has two sums for parameter {}", twice[1].start)),
        None => Ok(()),
    }
}

/// Samples of rays.
pub fn sample(projector: &dyn Projector) -> Result<Source> {
    let name = titled("projector", &projector.describe());
    let fragment = fragment_of(&name, projector.wgsl())?;
    let mut source = begun(&[("rays", Read), ("samples", Write)]);
    source.add("rays", RAY);
    source.add("random numbers", RANDOM);
    source.add(&name, &fragment.named("projector_"));
    source.add("sample", include_str!("kernels/sample.wgsl"));
    Ok(source)
}

/// The blocks of the kernel `sums` in WGSL, each of at most 32 × 32 products. A block also adds up its left channels where a sum wants them (biases).
fn blocks_of(sums: &[RowSum]) -> Vec<String> {
    let mut blocks = vec![];
    let vector = |left, outputs| {
        let mut vectors = sums.iter().filter(|s| s.sum.inputs == 0);
        vectors.find(|v| v.sum.left == left && v.sum.outputs == outputs)
    };
    let mut taken = vec![];
    // Products first: they take their biases along.
    let (products, vectors): (Vec<&RowSum>, Vec<&RowSum>) = sums.iter().partition(|s| s.sum.inputs > 0);
    for RowSum { sum, partial } in products.into_iter().chain(vectors) {
        let Sum { left, outputs, right, inputs, .. } = *sum;
        let bias = match inputs {
            0 => Some(*partial),
            _ => vector(left, outputs).map(|v| v.partial),
        };
        let bias = bias.filter(|b| !taken.contains(b));
        if inputs == 0 && bias.is_none() {
            continue;
        }
        taken.extend(bias);
        for top in (0..outputs).step_by(32) {
            for side in (0..inputs.max(1)).step_by(32) {
                let own = bias.filter(|_| side == 0).map_or("none".into(), |b| format!("{}u", b + top));
                blocks.push(format!(
                    "Block({}u, {}u, {}u, {}u, {}u, {inputs}u, {own})",
                    left + top,
                    (outputs - top).min(32),
                    right + side,
                    inputs.saturating_sub(side).min(32),
                    partial + top * inputs + side,
                ));
            }
        }
    }
    blocks
}

/// Points of blocks.
pub fn blocks() -> Source {
    let mut source = begun(&[("corners", Read), ("samples", Write)]);
    source.add("blocks", include_str!("kernels/blocks.wgsl"));
    source
}

/// Line integrals alone, without derivatives.
pub fn lines() -> Source {
    of_rays("fn loss_at(predicted: f32, measured: f32) -> vec2<f32> { return vec2<f32>(predicted, 0.0); }")
}

/// The loss of rays and its derivative with respect to μ.
pub fn loss_of_rays(loss: &dyn Loss) -> Result<Source> {
    Ok(of_rays(&loss_at(loss)?))
}

/// The loss of known points and its derivative with respect to μ.
pub fn loss_of_points(loss: &dyn Loss) -> Result<Source> {
    let mut source = derivatives(&[("targets", Read)]);
    source.add("loss", &loss_at(loss)?);
    source.add("loss of points", include_str!("kernels/points.wgsl"));
    Ok(source)
}

/// The penalty of a prior's blocks and its derivative with respect to μ.
pub fn penalty_of_blocks(prior: &dyn Prior) -> Result<Source> {
    let name = titled("prior", &prior.describe());
    let mut source = derivatives(&[]);
    source.add("blocks", &format!("const prior_edge = {}u;", prior.blocks().edge));
    source.add(&name, &fragment_of(&name, prior.wgsl())?.named("prior_"));
    source.add("penalty of blocks", include_str!("kernels/block_penalty.wgsl"));
    Ok(source)
}

fn of_rays(loss: &str) -> Source {
    let mut source = derivatives(&[("rays", Read), ("samples", Read)]);
    source.add("loss", loss);
    source.add("rays", RAY);
    source.add("loss of rays", include_str!("kernels/rays.wgsl"));
    source
}

fn loss_at(loss: &dyn Loss) -> Result<String> {
    Ok(fragment_of(&titled("loss", &loss.describe()), loss.wgsl())?.named("loss_"))
}

/// A kernel that computes derivatives with respect to μ.
fn derivatives(arrays: &[(&str, Access)]) -> Source {
    let mut source = begun(&[&[("mu", Read), ("dmu", Write), ("losses", Write)], arrays].concat());
    source.add("total", TOTAL);
    source
}

/// A source with the uniform buffer `step` and arrays.
fn begun(arrays: &[(&str, Access)]) -> Source {
    let mut source = Source::default();
    source.add("step", include_str!("kernels/step.wgsl"));
    source.bind("step", Access::Uniform, "Step");
    for (name, access) in arrays {
        let element = match *name {
            "samples" | "corners" => "vec4<f32>",
            "rays" => "Ray",
            _ => "f32",
        };
        source.bind(name, *access, &format!("array<{element}>"));
    }
    source
}

/// The optimizer.
pub fn adam() -> Source {
    let mut source = Source::default();
    source.bind("rule", Access::Uniform, "Rule");
    for name in ["params", "grads", "first", "second"] {
        source.bind(name, Write, "array<f32>");
    }
    source.add("adam", include_str!("kernels/adam.wgsl"));
    source
}
