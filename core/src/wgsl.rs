//! Stages on a GPU: WGSL functions over one row, which a backend combines into kernels.
//!
//! A fragment declares only names that begin with [`PREFIX`], including helpers; others are refused. A backend gives
//! every stage a different prefix, so that fragments never collide. A stage with widths `IN` and `OUT` (written as
//! numbers) must define:
//!
//! ```wgsl
//! fn stage_forward(x: ptr<function, array<f32, IN>>, y: ptr<function, array<f32, OUT>>)
//! fn stage_backward(x: ptr<function, array<f32, IN>>, dy: ptr<function, array<f32, OUT>>, dx: ptr<function, array<f32, IN>>)
//! ```
//!
//! `forward` overwrites `y`. `backward` adds to gradients and overwrites `dx`, but may leave `dx` alone if
//! `stage_wants_dx` is false. The host defines for them:
//!
//! ```wgsl
//! const stage_wants_dx: bool;
//! fn stage_param(i: u32) -> f32                                          // parameter i of the stage
//! fn stage_param4(i: u32) -> vec4<f32>                                   // parameters i to i + 3; i is a multiple of 4
//! fn stage_keep(c: u32, v: f32)                                          // keeps v as channel c of the row
//! fn stage_kept(c: u32) -> f32                                           // what the row keeps as channel c
//! fn stage_grad(i: u32, v: f32)                                          // adds v to the gradient of parameter i
//! fn stage_grad_pair(i: u32, v: vec2<f32>)                               // adds v to the gradients of i and i + 1; i is even
//! ```
//!
//! `forward` may keep what `backward` needs; `backward` may keep more. A fragment that keeps `N` channels declares
//! `const stage_keeps = Nu;`. Where nothing learns, `stage_keep` does nothing.
//!
//! `stage_grad` and `stage_grad_pair` are for parameters that few rows affect. Gradients of parameters that every row
//! affects are sums over rows of kept channels. A fragment declares each in a line of its own:
//!
//! ```wgsl
//! const stage_sum_0 = array<u32, 6>(AT, LD, LEFT, M, RIGHT, K);
//! ```
//!
//! This adds `Σ a[j]·b[k]` to the gradient of parameter `AT + j·LD + k`, where `a` are the `M` kept channels from `LEFT` on
//! and `b` the `K` kept channels from `RIGHT` on, as `backward` leaves them. With `K = 0` it adds `Σ a[j]` to that of
//! `AT + j`. No two sums have a parameter in common. [`declare`] writes these lines.
//!
//! A stage that is compiled into the program must also call `stage_grad` and `stage_grad_pair` for all rows together, and
//! every loop of its WGSL must end. A plugin's stage need not: its kernels carry [`FOREIGN`].
//!
//! A projector defines
//!
//! ```wgsl
//! fn stage_sample(ray: Ray, i: u32, training: bool) -> vec4<f32>
//! ```
//!
//! This is sample `i` of `ray.count` on a ray: its position in the unit cube and its weight. `ray.count` equals
//! [`Projector::max_samples`](crate::stage::Projector::max_samples); samples beyond the actual number have weight 0.
//! The line integral is the sum of weight times attenuation. [`RAY`] defines `Ray`, [`RANDOM`] random numbers.
//!
//! A loss ([`Loss`](crate::loss::Loss)) defines
//!
//! ```wgsl
//! fn stage_at(predicted: f32, measured: f32) -> vec2<f32>                // the loss and its derivative by `predicted`
//! ```
//!
//! A prior ([`Prior`](crate::prior::Prior)) defines
//!
//! ```wgsl
//! fn stage_at(p: u32) -> vec2<f32>
//! ```
//!
//! This is the share of point `p` in the penalty of a block (the shares sum to the penalty), and the derivative of the
//! whole penalty by the value of point `p`. The host defines for it
//!
//! ```wgsl
//! const stage_edge: u32;                                                 // points along the block's edge
//! fn stage_value(p: u32) -> f32                                          // the field at point p, z fastest
//! ```
//!
//! A penalty of differences ([`Dual`](crate::regularizer::Dual)) defines a step of its dual variables at a voxel, and its
//! value
//!
//! ```wgsl
//! fn stage_ascend(p: vec3<f32>, d: vec3<f32>, guide: vec3<f32>) -> vec3<f32>
//! fn stage_cost(d: vec3<f32>, guide: vec3<f32>) -> f32                   // the penalty of the differences d at a voxel
//! ```
//!
//! A data term ([`Misfit`](crate::data_term::Misfit)) defines, for a pixel with the measured value `p`,
//!
//! ```wgsl
//! fn stage_differentiate(p: f32, r: f32) -> vec2<f32>                    // φ(r) and φ'(r)
//! fn stage_curve(p: f32, x: f32) -> f32                                  // x times a bound of φ''
//! fn stage_spread(p: f32, x: f32) -> f32                                 // x times the standard deviation of φ'
//! ```
//!
//! A projector of voxels defines
//!
//! ```wgsl
//! fn stage_walk(ray: VoxelRay)
//! ```
//!
//! It calls `stage_visit(voxel: vec3<u32>, weight: f32)` for every voxel that the ray meets, with its weight in mm. One
//! walk serves both directions, so that they are adjoint. `stage_shape() -> vec3<u32>` and
//! `stage_spacing() -> vec3<f32>` are the volume's; a `VoxelRay` has `source` and `ahead`, the vector to the pixel, in
//! voxels (whole numbers are voxel centres), and `length`, that vector's length in mm.

use std::ops::Range;

/// Prefix of every name that a fragment declares or uses from its host.
pub const PREFIX: &str = "stage_";

/// The last line of a plugin's fragment. Kernels with it keep the counter that ends every loop, and add gradients lane by
/// lane.
pub const FOREIGN: &str = "// from a plugin\n";

/// `struct Ray`: [`UnitRay`](crate::stage::UnitRay) with its seed and number of samples.
pub const RAY: &str = include_str!("wgsl/ray.wgsl");
/// `random_mix` and `random_unit`: equivalents of [`mix`](crate::random::mix) and [`unit`](crate::random::unit).
pub const RANDOM: &str = include_str!("wgsl/random.wgsl");
/// `total`: the sum of a number over the 64 lanes of a group, in a fixed order.
pub const TOTAL: &str = include_str!("wgsl/total.wgsl");
/// `stage_trilinear_locate`, `…_index` and `…_weight`, and `stage_moved`: equivalents of [`crate::trilinear`].
pub const TRILINEAR: &str = include_str!("wgsl/trilinear.wgsl");

/// WGSL of one stage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fragment {
    /// The functions.
    pub source: String,
}

/// `stage_forward` and `stage_backward` of a stage with `input` and `output` channels, from the lines of their bodies.
pub fn functions(input: usize, output: usize, forward: &str, backward: &str) -> String {
    format!(
        "fn stage_forward(x: ptr<function, array<f32, {input}>>, y: ptr<function, array<f32, {output}>>) {{
{forward}}}

fn stage_backward(
    x: ptr<function, array<f32, {input}>>,
    dy: ptr<function, array<f32, {output}>>,
    dx: ptr<function, array<f32, {input}>>,
) {{
{backward}}}
"
    )
}

/// Gradients that are sums over rows: products of kept channels, or kept channels themselves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sum {
    /// Its first parameter.
    pub at: usize,
    /// Parameters from one channel on the left to the next.
    pub ld: usize,
    /// First kept channel on the left.
    pub left: usize,
    /// Channels on the left.
    pub outputs: usize,
    /// First kept channel on the right.
    pub right: usize,
    /// Channels on the right; 0 for the sums of the left ones.
    pub inputs: usize,
}

impl Sum {
    /// The sums of `outputs` kept channels from `left` on, for the parameters from `at` on.
    pub fn vector(at: usize, left: usize, outputs: usize) -> Self {
        Self { at, ld: 1, left, outputs, right: 0, inputs: 0 }
    }

    /// Number of its parameters.
    pub fn params(&self) -> usize {
        self.outputs * self.inputs.max(1)
    }

    /// The parameters of channel `j` on the left.
    pub fn row(&self, j: usize) -> Range<usize> {
        let start = self.at + j * self.ld;
        start..start + self.inputs.max(1)
    }

    /// The sum in a line of a fragment.
    fn parse(line: &str) -> Option<Self> {
        let (_, numbers) = line.trim_start().strip_prefix("const stage_sum_")?.split_once('(')?;
        let mut numbers = numbers.split(')').next()?.split(',').map(|n| n.trim().trim_end_matches('u').parse().ok());
        let mut next = || numbers.next().flatten();
        let [at, ld, left, outputs, right, inputs] = [next()?, next()?, next()?, next()?, next()?, next()?];
        Some(Self { at, ld, left, outputs, right, inputs })
    }

    /// The line of a fragment that declares it under `name`.
    fn line(&self, name: &str) -> String {
        let Self { at, ld, left, outputs, right, inputs } = self;
        format!("const {PREFIX}sum_{name} = array<u32, 6>({at}, {ld}, {left}, {outputs}, {right}, {inputs});\n")
    }
}

/// The lines by which a fragment declares how many channels it keeps and its sums over rows.
pub fn declare(keeps: usize, sums: &[Sum]) -> String {
    let sums = sums.iter().enumerate().map(|(i, sum)| sum.line(&i.to_string()));
    format!("const {PREFIX}keeps = {keeps}u;\n") + &sums.collect::<String>()
}

impl Fragment {
    /// A fragment from pieces, concatenated.
    pub fn new(pieces: &[&str]) -> Self {
        Self { source: pieces.join("\n") }
    }

    /// The same functions with `prefix` instead of [`PREFIX`] in names.
    pub fn named(&self, prefix: &str) -> String {
        let mut out = String::with_capacity(self.source.len());
        let mut end = 0;
        for (at, _) in self.source.match_indices(PREFIX) {
            let inside = self.source[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_');
            out.push_str(&self.source[end..at]);
            out.push_str(if inside { PREFIX } else { prefix });
            end = at + PREFIX.len();
        }
        out.push_str(&self.source[end..]);
        out
    }

    /// The first declared name without [`PREFIX`]. Two fragments with such a name could not be in one kernel.
    pub fn stray(&self) -> Option<&str> {
        let (mut depth, mut declares, mut space) = (0, false, false);
        for token in tokens(&self.source) {
            match token {
                "{" => depth += 1,
                "}" => depth -= 1,
                // The address space of a variable.
                "<" => space = declares,
                ">" => space = false,
                "fn" | "const" | "override" | "var" | "struct" | "alias" if depth == 0 => declares = true,
                name if declares && !space => {
                    if !name.starts_with(PREFIX) {
                        return Some(name);
                    }
                    declares = false;
                }
                _ => {}
            }
        }
        None
    }

    /// Number of channels that it keeps.
    pub fn keeps(&self) -> usize {
        let number = |line: &str| {
            let (_, n) = line.trim_start().strip_prefix("const stage_keeps")?.split_once('=')?;
            n.trim().trim_end_matches(';').trim_end_matches('u').parse::<usize>().ok()
        };
        self.source.lines().filter_map(number).fold(0, usize::saturating_add)
    }

    /// The sums over rows that it declares.
    pub fn sums(&self) -> Vec<Sum> {
        self.source.lines().filter_map(Sum::parse).collect()
    }
}

/// Words, braces and angle brackets of a WGSL text, without comments. Nested comments are not followed: such a text is
/// refused when it is compiled.
fn tokens(text: &str) -> impl Iterator<Item = &str> {
    let mut rest = text;
    std::iter::from_fn(move || {
        loop {
            rest = rest.trim_start();
            let first = rest.chars().next()?;
            let end = if rest.starts_with("//") {
                rest.find('\n').unwrap_or(rest.len())
            } else if rest.starts_with("/*") {
                rest.find("*/").map_or(rest.len(), |at| at + 2)
            } else {
                let word = |c: char| c.is_alphanumeric() || c == '_';
                let end = if word(first) { rest.find(|c| !word(c)).unwrap_or(rest.len()) } else { first.len_utf8() };
                let (token, after) = rest.split_at(end);
                rest = after;
                if word(first) || "{}<>".contains(first) {
                    return Some(token);
                }
                continue;
            };
            rest = &rest[end..];
        }
    })
}

/// Declares what the fragment of a part expects of its host, under names with prefix `name`, in terms of the whole's
/// own functions; the part's parameters begin at `first`, its kept channels at `kept`.
pub fn hosted(name: &str, first: u32, kept: usize, fragment: &Fragment) -> String {
    let keeps = fragment.keeps();
    let own = name.strip_prefix(PREFIX).unwrap_or(name);
    let four = if first.is_multiple_of(4) { format!("stage_param4({first}u + i)") } else { four_by_one(name) };
    let mut out = format!(
        "const {PREFIX}keeps_{own} = {keeps}u;
const {name}wants_dx = stage_wants_dx;
fn {name}param(i: u32) -> f32 {{ return stage_param({first}u + i); }}
fn {name}param4(i: u32) -> vec4<f32> {{ return {four}; }}
fn {name}keep(c: u32, v: f32) {{ stage_keep({kept}u + c, v); }}
fn {name}kept(c: u32) -> f32 {{ return stage_kept({kept}u + c); }}
fn {name}grad(i: u32, v: f32) {{ stage_grad({first}u + i, v); }}
"
    );
    out += &match first.is_multiple_of(2) {
        true => format!("fn {name}grad_pair(i: u32, v: vec2<f32>) {{ stage_grad_pair({first}u + i, v); }}\n"),
        false => one_by_one(name),
    };
    for (i, sum) in fragment.sums().iter().enumerate() {
        let whole = Sum { at: first as usize + sum.at, left: kept + sum.left, right: kept + sum.right, ..*sum };
        out += &whole.line(&format!("{own}{i}"));
    }
    out
}

/// `grad_pair` of stage `name` by two of its `grad`.
pub fn one_by_one(name: &str) -> String {
    format!("fn {name}grad_pair(i: u32, v: vec2<f32>) {{ {name}grad(i, v.x); {name}grad(i + 1u, v.y); }}\n")
}

/// The value of `param4` of stage `name` from four of its `param`.
pub fn four_by_one(name: &str) -> String {
    let each = ["i", "i + 1u", "i + 2u", "i + 3u"].map(|i| format!("{name}param({i})"));
    format!("vec4<f32>({})", each.join(", "))
}

/// Whether a setting is a positive normal number also in single precision, as used in shaders.
pub fn is_positive(x: f64) -> bool {
    x > 0.0 && (x as f32).is_normal()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_changed_where_they_begin() {
        let f = Fragment::new(&["fn stage_a() { backstage_b(stage_param(0u)); stage_stage_c(); }"]);
        assert_eq!(f.named("s1_"), "fn s1_a() { backstage_b(s1_param(0u)); s1_stage_c(); }");
    }

    #[test]
    fn a_declared_name_without_the_prefix_is_found() {
        let stray = |text: &str| Fragment::new(&[text]).stray().map(str::to_owned);
        let good = "// fn no() {}\n/* const no */ const stage_n = 3u;\nvar<private> stage_x: array<f32, 3>;
            fn stage_forward() { var y = 1.0; const z = 2.0; if y < z { y = z; } }\nstruct stage_S { a: f32 }";
        assert_eq!(stray(good), None);
        assert_eq!(
            stray("fn stage_a() { let b = 1; }\nfn square(x: f32) -> f32 { return x * x; }").as_deref(),
            Some("square")
        );
        assert_eq!(stray("const N = 3u;").as_deref(), Some("N"));
        assert_eq!(stray("@group(0) var<storage, read_write> all: array<f32>;").as_deref(), Some("all"));
        assert_eq!(stray("} } { fn"), None);
    }

    #[test]
    fn sums_are_read_as_they_are_declared_also_from_a_part() {
        let sums = [Sum { at: 2, ld: 9, left: 3, outputs: 4, right: 0, inputs: 3 }, Sum::vector(40, 3, 4)];
        let part = Fragment::new(&[&declare(7, &sums), "// const stage_sum_9 = array<u32, 6>(1, 1, 1, 1, 1, 1);"]);
        assert_eq!((part.keeps(), part.sums()), (7, sums.to_vec()));
        let texts = [0, 1].map(|i| {
            let name = format!("stage_{i}_");
            hosted(&name, 100 * i, 7 * i as usize, &part) + &part.named(&name)
        });
        let whole = Fragment::new(&[&texts[0], &texts[1]]);
        let moved = sums.map(|s| Sum { at: s.at + 100, left: s.left + 7, right: s.right + 7, ..s });
        assert_eq!((whole.keeps(), whole.sums()), (14, [sums, moved].concat()));
        assert_eq!((sums[0].params(), sums[0].row(1), sums[1].row(1)), (12, 11..14, 41..42));
    }
}
