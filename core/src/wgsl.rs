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
//! `stage_wants_dx` is false. Nothing is kept between the two: `backward` recomputes what it needs. The host defines
//! for them:
//!
//! ```wgsl
//! const stage_wants_dx: bool;
//! fn stage_param(i: u32) -> f32                                          // parameter i of the stage
//! fn stage_grad(i: u32, v: f32)                                          // adds v to the gradient of parameter i
//! fn stage_grad_pair(i: u32, v: vec2<f32>)                               // adds v to the gradients of i and i + 1; i is even
//! fn stage_sum_M(at: u32, a: ptr<function, array<f32, M>>)               // adds Σ a[j] to parameters at + j
//! fn stage_outer_M_K(at: u32, ld: u32, a: ptr<function, array<f32, M>>, b: ptr<function, array<f32, K>>)
//!                                                                        // adds Σ a[j]·b[k] to at + j·ld + k, all different
//! ```
//!
//! `stage_grad` and `stage_grad_pair` are for parameters of which a row affects few. `stage_sum_M` and `stage_outer_M_K` are
//! sums over rows, for any numbers `M` and `K` in the name, for parameters that every row affects: all rows call them
//! together, so never inside a branch or loop that only some rows take.
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

use std::collections::BTreeSet;
use std::fmt::Write;

/// Prefix of every name that a fragment declares or uses from its host.
pub const PREFIX: &str = "stage_";

/// The last line of a plugin's fragment. Kernels with it keep the counter that ends every loop, and add gradients lane by
/// lane.
pub const FOREIGN: &str = "// from a plugin\n";

/// `struct Ray`: [`UnitRay`](crate::stage::UnitRay) with its seed and number of samples.
pub const RAY: &str = include_str!("wgsl/ray.wgsl");
/// `random_mix` and `random_unit`: equivalents of [`mix`](crate::random::mix) and [`unit`](crate::random::unit).
pub const RANDOM: &str = include_str!("wgsl/random.wgsl");
/// `stage_trilinear_locate`, `…_index`, `…_weight` and `…_slopes`: equivalents of [`crate::trilinear`].
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

/// A sum over rows used by a fragment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Sum {
    /// `stage_sum_M`.
    Vector(usize),
    /// `stage_outer_M_K`.
    Outer(usize, usize),
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

    /// The sums over rows that it uses, found by name.
    pub fn sums(&self) -> BTreeSet<Sum> {
        let words = self.source.split(|c: char| !(c.is_alphanumeric() || c == '_'));
        let sum = |word: &str| {
            let rest = word.strip_prefix(PREFIX)?;
            if let Some(m) = rest.strip_prefix("sum_") {
                return Some(Sum::Vector(m.parse().ok()?));
            }
            let (m, k) = rest.strip_prefix("outer_")?.split_once('_')?;
            Some(Sum::Outer(m.parse().ok()?, k.parse().ok()?))
        };
        words.filter_map(sum).collect()
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
/// own functions; the part's parameters begin at `first`.
pub fn hosted(name: &str, first: u32, fragment: &Fragment) -> String {
    let mut out = format!(
        "const {name}wants_dx = stage_wants_dx;
fn {name}param(i: u32) -> f32 {{ return stage_param({first}u + i); }}
fn {name}grad(i: u32, v: f32) {{ stage_grad({first}u + i, v); }}
"
    );
    out += &match first.is_multiple_of(2) {
        true => format!("fn {name}grad_pair(i: u32, v: vec2<f32>) {{ stage_grad_pair({first}u + i, v); }}\n"),
        false => one_by_one(name),
    };
    for sum in fragment.sums() {
        let _ = match sum {
            Sum::Vector(m) => writeln!(
                out,
                "fn {name}sum_{m}(at: u32, a: ptr<function, array<f32, {m}>>) {{ stage_sum_{m}({first}u + at, a); }}"
            ),
            Sum::Outer(m, k) => writeln!(
                out,
                "fn {name}outer_{m}_{k}(at: u32, ld: u32, a: ptr<function, array<f32, {m}>>, b: ptr<function, array<f32, {k}>>) {{ stage_outer_{m}_{k}({first}u + at, ld, a, b); }}"
            ),
        };
    }
    out
}

/// `grad_pair` of stage `name` by two of its `grad`.
pub fn one_by_one(name: &str) -> String {
    format!("fn {name}grad_pair(i: u32, v: vec2<f32>) {{ {name}grad(i, v.x); {name}grad(i + 1u, v.y); }}\n")
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
    fn sums_are_found_by_their_names() {
        let f =
            Fragment::new(&["stage_sum_20(at, &a); stage_outer_32_20(at, 20u, &a, &b); other_sum_3(); stage_sum_x();"]);
        assert_eq!(f.sums().into_iter().collect::<Vec<_>>(), [Sum::Vector(20), Sum::Outer(32, 20)]);
    }
}
