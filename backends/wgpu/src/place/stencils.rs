//! Total variation: proximal gradient updates, the penalty's value, edges, and slopes.
//!
//! A proximal gradient update overwrites the gradient with the argument `v` of the proximal map, makes the dual steps,
//! each with a kernel for the primal and one for the dual, and extrapolates. Where a volume has several parts, a kernel
//! also reads the planes beside a part, which are copied on the device.

use super::launch::{ARRAY, Room, Task, each, summing};
use super::{Array, Chunk, flag, parts, plane};
use crate::Shared;
use Access::{Read, Write};
use conefield_core::device::{Access, Source, fragment_of};
use conefield_core::error::Result;
use conefield_core::place::{ProximalStep, Slab, VariationSlope};
use conefield_core::regularizer::{Bounds, Dual, Guide, Kernels};

/// `Stencil` in `kernels/stencil.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
struct Stencil {
    shape: [u32; 3],
    begin: u32,
    down: [f32; 3],
    end: u32,
    up: [f32; 3],
    held: u32,
    planes: u32,
    step: f32,
    momentum: f32,
    pull: f32,
    low: f32,
    high: f32,
    unused: [u32; 2],
}

/// Names of the dual variables and of the vectors that guide the penalty, along x, y and z.
const DUAL: [&str; 3] = ["dual_x", "dual_y", "dual_z"];
const GUIDE: [&str; 3] = ["guide_x", "guide_y", "guide_z"];
/// Bindings of [`PRIMAL`] besides the argument of the proximal map.
const OF_DUAL: [(&str, Access); 3] = [(DUAL[0], Read), (DUAL[1], Read), (DUAL[2], Read)];
const BEFORE: [(&str, Access); 1] = [("before", Read)];
/// The argument of the proximal map within the bounds.
const CLIPPED: &str = "min(stencil.high, max(stencil.low, gradient[i]))";
const PRIMAL: (&str, &str) = ("primal", include_str!("../kernels/primal.wgsl"));
const VALUES: (&str, &str) = ("values", include_str!("../kernels/values.wgsl"));
/// Bindings of [`VALUES`].
const BESIDE: [(&str, Access); 3] = [("values", Read), ("before", Read), ("after", Read)];

/// A source with bindings and functions.
fn begun(bindings: &[(&str, Access)], functions: &[(&str, &str)]) -> Source {
    let mut source = Source::default();
    source.add("stencil", include_str!("../kernels/stencil.wgsl"));
    source.bind("stencil", Access::Uniform, "Stencil");
    for (name, access) in bindings {
        source.bind(name, *access, if *name == "inside" { "array<u32>" } else { "array<f32>" });
    }
    for (name, text) in functions {
        source.add(name, text);
    }
    source
}

/// A kernel that runs `body` for every voxel i.
fn kernel(bindings: &[(&str, Access)], functions: &[(&str, &str)], body: &str) -> Source {
    let mut source = begun(bindings, functions);
    source.add("voxels", &each("stencil", body));
    source
}

/// Work on the parts of a volume.
struct Volume<'a> {
    shared: &'a Shared,
    shape: [usize; 3],
    whole: Stencil,
}

impl<'a> Volume<'a> {
    fn new(shared: &'a Shared, x: &Array) -> Self {
        let shape = x.shape();
        Self { shared, shape, whole: Stencil { shape: shape.map(|n| n as u32), ..Stencil::default() } }
    }

    /// With bounds of the result of the proximal map.
    fn within(mut self, bounds: Bounds) -> Self {
        // A shader need not know infinity.
        let [low, high] = [bounds.low, bounds.high].map(|x| x.clamp(f32::MIN, f32::MAX));
        self.whole = Stencil { low, high, ..self.whole };
        self
    }

    /// With the factors of dual steps.
    fn of_dual(mut self, dual: &Dual<'_>, tau: f32) -> Self {
        let bound = Dual::bound(dual.weights);
        self.whole.down = dual.weights.map(|g| g * tau);
        self.whole.up = dual.weights.map(|g| g / (bound * tau));
        self
    }

    fn uniform(&self, part: &Chunk) -> (&'static str, impl Fn(u32, u32) -> Stencil) {
        let (held, planes) = (part.planes.start as u32, part.planes.len() as u32);
        let whole = self.whole;
        ("stencil", move |begin, end| Stencil { held, planes, begin, end, ..whole })
    }

    fn count(&self, part: &Chunk) -> u32 {
        (part.planes.len() * plane(self.shape)) as u32
    }

    /// The buffers of the arrays' k-th parts.
    fn bind<'b>(k: usize, arrays: &[(&'b str, &'b Array)]) -> Vec<(&'b str, &'b wgpu::Buffer)> {
        arrays.iter().filter_map(|(name, x)| Some((*name, &parts(x).get(k)?.buffer))).collect()
    }

    /// Copies the planes beside part k of `of` to the room's buffers `before` and `after`.
    fn beside(&self, room: &mut Room, of: &Array, k: usize) -> Result<()> {
        let bytes = 4 * plane(self.shape) as u64;
        let gpu = &self.shared.gpu;
        let all = parts(of);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let sides = [("before", k.checked_sub(1)), ("after", Some(k + 1))];
        for (name, neighbour) in sides {
            let to = room.buffers.of(gpu, name, bytes, ARRAY)?;
            let Some(from) = neighbour.and_then(|n| all.get(n)) else { continue };
            let at = if name == "before" { (from.planes.len() - 1) as u64 * bytes } else { 0 };
            encoder.copy_buffer_to_buffer(&from.buffer, at, &to, 0, bytes);
        }
        gpu.submit(encoder);
        Ok(())
    }

    /// Runs a kernel on every part; `beside` is the array whose neighbouring planes it reads.
    fn run(
        &self,
        room: &mut Room,
        (label, source): (&str, &Source),
        arrays: &[(&str, &Array)],
        beside: Option<&Array>,
    ) -> Result<()> {
        for (k, part) in parts(arrays[0].1).iter().enumerate() {
            beside.map_or(Ok(()), |of| self.beside(room, of, k))?;
            let bind = Self::bind(k, arrays);
            room.run(self.shared, Task { label, source, bind: &bind }, self.uniform(part), self.count(part))?;
        }
        Ok(())
    }

    /// Adds up what a kernel computes on every part, or on its own planes of `slab`.
    fn sum(
        &self,
        room: &mut Room,
        (label, source): (&str, &Source),
        arrays: &[(&str, &Array)],
        (beside, slab): (&Array, Option<&Slab>),
    ) -> Result<f64> {
        let mut total = 0.0;
        let counted = slab.map_or(0..self.shape[0], Slab::inner);
        for (k, part) in parts(beside).iter().enumerate() {
            self.beside(room, beside, k)?;
            let bind = Self::bind(k, arrays);
            let (from, to) = (part.planes.start, part.planes.end);
            let (first, last) = (counted.start.clamp(from, to), counted.end.clamp(from, to));
            for (planes, counts) in [(from..first, false), (first..last, true), (last..to, false)] {
                if planes.is_empty() {
                    continue;
                }
                let (name, uniform) = self.uniform(part);
                let [at, count] = [planes.start - from, planes.len()].map(|n| (n * plane(self.shape)) as u32);
                let of = |begin, end| uniform(at + begin, at + end);
                let task = Task { label, source, bind: &bind };
                let found = room.sum(self.shared, task, (name, of), count, false)?[0];
                total += if counts { found } else { 0.0 };
            }
        }
        Ok(total)
    }
}

/// Overwrites the gradient with the argument of the proximal map.
fn argument(volume: &Volume<'_>, room: &mut Room, step: &ProximalStep<'_>) -> Result<()> {
    let mut bindings = vec![("gradient", Write), ("ahead", Read)];
    let mut v = "let z = ahead[i];\n        var v = z + stencil.step * gradient[i];\n".to_owned();
    if step.towards.is_some() {
        bindings.push(("towards", Read));
        v += "        v += stencil.pull * (towards[i] - z);\n";
    }
    if step.inside.is_some() {
        bindings.push(("inside", Read));
        // Values far below the lower bound stay there, whatever their neighbours are.
        v += &format!("        if !{} {{ v = -3.4e38; }}\n", flag("inside", "i"));
    }
    let source = kernel(&bindings, &[], &(v + "        gradient[i] = v;"));
    for (k, part) in parts(step.gradient).iter().enumerate() {
        let mut bind = Volume::bind(k, &[("gradient", step.gradient), ("ahead", step.ahead)]);
        bind.extend(step.towards.map(|(towards, _)| ("towards", &parts(towards)[k].buffer)));
        bind.extend(step.inside.map(|inside| ("inside", &parts(inside)[k].buffer)));
        let task = Task { label: "argument of the prior", source: &source, bind: &bind };
        room.run(volume.shared, task, volume.uniform(part), volume.count(part))?;
    }
    Ok(())
}

/// A whole update with a penalty that has kernels.
pub(super) fn update(
    shared: &Shared,
    room: &mut Room,
    step: ProximalStep<'_>,
    tau: f32,
    kernels: Kernels<'_>,
) -> Result<()> {
    let mut volume = Volume::new(shared, step.x);
    let pull = step.towards.map_or(0.0, |(_, share)| share);
    volume.whole = Stencil { step: step.step, momentum: step.momentum, pull, ..volume.whole };
    argument(&volume, room, &step)?;
    let [gradient, ahead, x] = [step.gradient, step.ahead, step.x].map(|x| &*x);
    // New coefficients, and the point of the next gradient.
    let end =
        |u: &str| format!("let u = {u};\n        ahead[i] = u + stencil.momentum * (u - x[i]);\n        x[i] = u;");
    let arrays = [("gradient", Read, gradient), ("x", Write, x), ("ahead", Write, ahead)];
    // The iterate of the dual steps has the memory of the next point, which is overwritten at the end.
    finish(volume, room, (kernels, tau), [gradient, ahead], ("extrapolation", &end), &arrays)
}

/// [`conefield_core::place::Place::prox`] with kernels. `iterate` is for the dual steps.
pub(super) fn prox(
    shared: &Shared,
    room: &mut Room,
    (v, iterate): (&Array, &Array),
    tau: f32,
    kernels: Kernels<'_>,
) -> Result<()> {
    let end = |u: &str| format!("gradient[i] = {u};");
    let label = "proximal map of the prior";
    finish(Volume::new(shared, v), room, (kernels, tau), [v, iterate], (label, &end), &[("gradient", Write, v)])
}

/// Makes the dual steps of the proximal map of `v`, for which `iterate` is overwritten, and runs a kernel on its result:
/// `body` takes the result at voxel i in WGSL. Without a penalty the map only clips.
fn finish(
    volume: Volume<'_>,
    room: &mut Room,
    (kernels, tau): (Kernels<'_>, f32),
    [v, iterate]: [&Array; 2],
    (label, body): (&str, &dyn Fn(&str) -> String),
    arrays: &[(&'static str, Access, &Array)],
) -> Result<()> {
    let (Kernels::Clip(bounds) | Kernels::Dual(Dual { bounds, .. })) = kernels;
    let volume = volume.within(bounds);
    let flat: Vec<_> = arrays.iter().map(|(name, access, _)| (*name, *access)).collect();
    let arrays: Vec<_> = arrays.iter().map(|(name, _, x)| (*name, *x)).collect();
    let dual = match kernels {
        Kernels::Dual(dual) if tau >= f32::MIN_POSITIVE => dual,
        _ => return volume.run(room, (label, &kernel(&flat, &[], &body(CLIPPED))), &arrays, None),
    };
    let volume = volume.of_dual(&dual, tau);
    dual_steps(&volume, room, &dual, [v, iterate])?;
    let p = duals(&dual);
    let source = kernel(&[&OF_DUAL[..], &flat, &BEFORE].concat(), &[PRIMAL], &body("primal_of(i)"));
    volume.run(room, (label, &source), &[&p[..], &arrays].concat(), Some(p[0].1))
}

/// The dual variables by name.
fn duals<'a>(dual: &'a Dual<'_>) -> [(&'static str, &'a Array); 3] {
    std::array::from_fn(|k| (DUAL[k], &*dual.p[k]))
}

/// Makes the dual steps of the proximal map of `v`. `iterate` is overwritten.
fn dual_steps(volume: &Volume<'_>, room: &mut Room, dual: &Dual<'_>, [v, iterate]: [&Array; 2]) -> Result<()> {
    let p = duals(dual);
    let fragment = fragment_of("the prior", Some(dual.fragment.clone()))?.named("penalty_");
    let primal = [&OF_DUAL[..], &[("gradient", Read), ("ahead", Write)], &BEFORE].concat();
    let primal = kernel(&primal, &[PRIMAL], "ahead[i] = primal_of(i);");
    let mut bindings = [&DUAL.map(|name| (name, Write))[..], &BESIDE].concat();
    let mut arrays = [&p[..], &[("values", iterate)]].concat();
    let guide = guided(dual, &mut bindings, &mut arrays);
    let body = include_str!("../kernels/ascend.wgsl").replace("GUIDE", guide);
    let ascend = kernel(&bindings, &[VALUES, ("penalty", &fragment)], &body);
    let of_primal = [&p[..], &[("gradient", v), ("ahead", iterate)]].concat();
    for _ in 0..dual.steps {
        volume.run(room, ("primal of the prior", &primal), &of_primal, Some(p[0].1))?;
        volume.run(room, ("dual of the prior", &ascend), &arrays, Some(iterate))?;
    }
    Ok(())
}

/// Adds the bindings and arrays of the vectors that guide a penalty. Returns the vector at voxel i in WGSL.
fn guided<'a>(
    dual: &'a Dual<'_>,
    bindings: &mut Vec<(&str, Access)>,
    arrays: &mut Vec<(&'a str, &'a Array)>,
) -> &'static str {
    let Some(Guide { vectors, .. }) = &dual.guide else { return "vec3<f32>()" };
    bindings.extend(GUIDE.map(|name| (name, Read)));
    arrays.extend(GUIDE.iter().zip(vectors).map(|(name, x)| (*name, &**x)));
    "vec3<f32>(guide_x[i], guide_y[i], guide_z[i])"
}

/// The value of a penalty of differences.
pub(super) fn value(shared: &Shared, room: &mut Room, dual: &Dual<'_>, x: &Array) -> Result<f64> {
    let fragment = fragment_of("the prior", Some(dual.fragment.clone()))?.named("penalty_");
    let mut bindings = BESIDE.to_vec();
    let mut arrays = vec![("values", x)];
    let guide = guided(dual, &mut bindings, &mut arrays);
    let mut source = begun(&bindings, &[VALUES, ("penalty", &fragment)]);
    let body = format!("let v = vec2<f32>(penalty_cost(differences(place(i)), {guide}), 0.0);");
    summing(&mut source, "stencil", &body, false);
    let mut volume = Volume::new(shared, x);
    volume.whole.up = dual.weights;
    volume.sum(room, ("value of the prior", &source), &arrays, (x, dual.slab))
}

/// Finds the edges of `x` that guide a penalty. Returns the new value.
pub(super) fn adapt(shared: &Shared, room: &mut Room, dual: Dual<'_>, x: &Array) -> Result<f64> {
    if let Some(Guide { vectors, strength, scale }) = &dual.guide {
        let mut volume = Volume::new(shared, x);
        volume.whole.up = dual.weights;
        let n = GUIDE.map(|name| (name, Write));
        let edges = ("edges", include_str!("../kernels/edges.wgsl"));
        let mut slopes = begun(&[&n[..], &BESIDE].concat(), &[VALUES, edges]);
        summing(&mut slopes, "stencil", include_str!("../kernels/edge_slopes.wgsl"), false);
        let vectors: [(&str, &Array); 3] = std::array::from_fn(|k| (GUIDE[k], &*vectors[k]));
        let squares =
            volume.sum(room, ("edges", &slopes), &[&vectors[..], &[("values", x)]].concat(), (x, dual.slab))?;
        let mean = match dual.slab {
            None => squares / x.len() as f64,
            Some(slab) => slab.sum(squares) / (slab.whole * plane(x.shape())) as f64,
        };
        volume.whole.step = *strength;
        volume.whole.momentum = mean as f32 * scale * scale;
        let lengths = kernel(&n, &[], include_str!("../kernels/edge_lengths.wgsl"));
        volume.run(room, ("lengths of edges", &lengths), &vectors, None)?;
    }
    value(shared, room, &dual, x)
}

/// Overwrites `out` with the slope of the smoothed total variation of `x`. Returns its sum of squares.
pub(super) fn slope(
    shared: &Shared,
    room: &mut Room,
    slope: &VariationSlope<'_>,
    x: &Array,
    out: &mut Array,
) -> Result<f64> {
    let functions = [VALUES, ("slope", include_str!("../kernels/slope.wgsl"))];
    let mut source = begun(&[&[("out", Write)][..], &BESIDE].concat(), &functions);
    let body = "let s = slope_at(i);\n        out[i] = s;\n        let v = vec2<f32>(s * s, 0.0);";
    summing(&mut source, "stencil", body, false);
    let mut volume = Volume::new(shared, x);
    volume.whole.up = slope.weights;
    volume.whole.step = slope.unit;
    volume.sum(room, ("slope of total variation", &source), &[("out", out), ("values", x)], (x, None))
}
