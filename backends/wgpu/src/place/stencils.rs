//! Total variation: proximal gradient updates, the penalty's value, edges, and slopes.
//!
//! A proximal gradient update overwrites the gradient with the argument `v` of the proximal map, makes the dual steps,
//! each with a kernel for the primal and one for the dual, and extrapolates. Where a volume has several parts, a kernel
//! also reads the planes beside a part, which are copied on the device.

use super::launch::{ARRAY, Room, Task};
use super::{Array, Chunk, flag, parts, plane};
use Access::{Read, Write};
use conefield_core::device::{Access, fragment_of};
use conefield_core::error::Result;
use conefield_core::place::{ProximalStep, Slab, VariationSlope};
use conefield_core::regularizer::{Dual, Guide, Kernels};

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
/// The argument of the proximal map within the bounds.
const CLIPPED: &str = "min(stencil.high, max(stencil.low, gradient[i]))";

impl<'a> Task<'a> {
    /// A kernel over the voxels of a volume's parts.
    fn of_voxels(label: &'a str) -> Self {
        Self::new(label, include_str!("../kernels/stencil.wgsl"), "stencil", "Stencil")
    }

    /// With three arrays.
    fn with_three(self, names: [&'a str; 3], access: Access, arrays: [&'a Array; 3]) -> Self {
        let [x, y, z] = names;
        self.with(x, access, arrays[0]).with(y, access, arrays[1]).with(z, access, arrays[2])
    }

    /// With the dual variables.
    fn with_dual(self, access: Access, dual: &'a Dual<'_>) -> Self {
        self.with_three(DUAL, access, dual.p.each_ref().map(|p| &**p))
    }

    /// With `x` and the planes beside a part of it, and its differences.
    fn with_values(self, x: &'a Array) -> Self {
        let beside = self.with("values", Read, x).bind("before", Read, "f32").bind("after", Read, "f32");
        beside.add("values", include_str!("../kernels/values.wgsl"))
    }

    /// With a penalty, and the vector that guides it at voxel i in WGSL.
    fn with_penalty(self, dual: &'a Dual<'_>) -> Result<(Self, &'static str)> {
        let fragment = fragment_of("the prior", Some(dual.fragment.clone()))?.named("penalty_");
        let task = self.add("penalty", &fragment);
        let Some(Guide { vectors, .. }) = &dual.guide else { return Ok((task, "vec3<f32>()")) };
        let task = task.with_three(GUIDE, Read, vectors.each_ref().map(|x| &**x));
        Ok((task, "vec3<f32>(guide_x[i], guide_y[i], guide_z[i])"))
    }

    /// With the dual variables and the plane of them before a part: the primal.
    fn with_primal(self, dual: &'a Dual<'_>) -> Self {
        let task = self.with_dual(Read, dual).bind("before", Read, "f32");
        task.add("primal", include_str!("../kernels/primal.wgsl"))
    }
}

/// Work on the parts of a volume.
struct Volume {
    shape: [usize; 3],
    whole: Stencil,
}

impl Volume {
    fn new(x: &Array) -> Self {
        let shape = x.shape();
        Self { shape, whole: Stencil { shape: shape.map(|n| n as u32), ..Stencil::default() } }
    }

    fn uniform(&self, part: &Chunk) -> impl Fn(u32, u32) -> Stencil {
        let (held, planes) = (part.planes.start as u32, part.planes.len() as u32);
        let whole = self.whole;
        move |begin, end| Stencil { held, planes, begin, end, ..whole }
    }

    fn count(&self, part: &Chunk) -> u32 {
        (part.planes.len() * plane(self.shape)) as u32
    }

    /// Copies the planes beside part k of `of` to the room's buffers `before` and `after`.
    fn beside(&self, room: &mut Room, of: &Array, k: usize) -> Result<()> {
        let bytes = 4 * plane(self.shape) as u64;
        let gpu = &room.shared.gpu;
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

    /// Runs a kernel on every part of `x`; `beside` is the array whose neighbouring planes it reads.
    fn run(&self, room: &mut Room, task: &Task<'_>, x: &Array, beside: Option<&Array>) -> Result<()> {
        for (k, part) in parts(x).iter().enumerate() {
            beside.map_or(Ok(()), |of| self.beside(room, of, k))?;
            room.run(task, &task.parts(k), self.uniform(part), self.count(part))?;
        }
        Ok(())
    }

    /// Adds up what a kernel computes on every part of `x`, or on its own planes of `slab`. The kernel reads the planes
    /// beside a part.
    fn sum(&self, room: &mut Room, task: &Task<'_>, x: &Array, slab: Option<&Slab>) -> Result<f64> {
        let mut total = 0.0;
        let counted = slab.map_or(0..self.shape[0], Slab::inner);
        for (k, part) in parts(x).iter().enumerate() {
            self.beside(room, x, k)?;
            let (from, to) = (part.planes.start, part.planes.end);
            let (first, last) = (counted.start.clamp(from, to), counted.end.clamp(from, to));
            for (planes, counts) in [(from..first, false), (first..last, true), (last..to, false)] {
                if planes.is_empty() {
                    continue;
                }
                let uniform = self.uniform(part);
                let [at, count] = [planes.start - from, planes.len()].map(|n| (n * plane(self.shape)) as u32);
                let of = |begin, end| uniform(at + begin, at + end);
                let found = room.sum(task, &task.parts(k), of, count, false)?[0];
                total += if counts { found } else { 0.0 };
            }
        }
        Ok(total)
    }
}

/// Overwrites the gradient with the argument of the proximal map.
fn argument(volume: &Volume, room: &mut Room, step: &ProximalStep<'_>) -> Result<()> {
    let task = Task::of_voxels("argument of the prior");
    let mut task = task.with("gradient", Write, step.gradient).with("ahead", Read, step.ahead);
    let mut v = "let z = ahead[i];\n        var v = z + stencil.step * gradient[i];\n".to_owned();
    if let Some((towards, _)) = step.towards {
        task = task.with("towards", Read, towards);
        v += "        v += stencil.pull * (towards[i] - z);\n";
    }
    if let Some(inside) = step.inside {
        task = task.masked("inside", inside);
        // Values far below the lower bound stay there, whatever their neighbours are.
        v += &format!("        if !{} {{ v = -3.4e38; }}\n", flag("inside", "i"));
    }
    volume.run(room, &task.each(&(v + "        gradient[i] = v;")), step.gradient, None)
}

/// A whole update with a penalty that has kernels.
pub(super) fn update(room: &mut Room, step: ProximalStep<'_>, tau: f32, kernels: Kernels<'_>) -> Result<()> {
    let mut volume = Volume::new(step.x);
    let pull = step.towards.map_or(0.0, |(_, share)| share);
    volume.whole = Stencil { step: step.step, momentum: step.momentum, pull, ..volume.whole };
    argument(&volume, room, &step)?;
    let [gradient, ahead, x] = [step.gradient, step.ahead, step.x].map(|x| &*x);
    let end = Task::of_voxels("extrapolation").with("gradient", Read, gradient).with("x", Write, x);
    // New coefficients, and the point of the next gradient.
    let body =
        |u: &str| format!("let u = {u};\n        ahead[i] = u + stencil.momentum * (u - x[i]);\n        x[i] = u;");
    // The iterate of the dual steps has the memory of the next point, which is overwritten at the end.
    finish(volume, room, (kernels, tau), [gradient, ahead], end.with("ahead", Write, ahead), &body)
}

/// [`conefield_core::place::Place::prox`] with kernels. `iterate` is for the dual steps.
pub(super) fn prox(room: &mut Room, (v, iterate): (&Array, &Array), tau: f32, kernels: Kernels<'_>) -> Result<()> {
    let end = Task::of_voxels("proximal map of the prior").with("gradient", Write, v);
    let body = |u: &str| format!("gradient[i] = {u};");
    finish(Volume::new(v), room, (kernels, tau), [v, iterate], end, &body)
}

/// Makes the dual steps of the proximal map of `v`, for which `iterate` is overwritten, and runs the kernel `end` on its
/// result: `body` takes the result at voxel i in WGSL. Without a penalty the map only clips.
fn finish(
    mut volume: Volume,
    room: &mut Room,
    (kernels, tau): (Kernels<'_>, f32),
    [v, iterate]: [&Array; 2],
    end: Task<'_>,
    body: &dyn Fn(&str) -> String,
) -> Result<()> {
    let (Kernels::Clip(bounds) | Kernels::Dual(Dual { bounds, .. })) = kernels;
    // A shader need not know infinity.
    [volume.whole.low, volume.whole.high] = [bounds.low, bounds.high].map(|x| x.clamp(f32::MIN, f32::MAX));
    let dual = match kernels {
        Kernels::Dual(dual) if tau >= f32::MIN_POSITIVE => dual,
        _ => return volume.run(room, &end.each(&body(CLIPPED)), v, None),
    };
    let bound = Dual::bound(dual.weights);
    volume.whole.down = dual.weights.map(|g| g * tau);
    volume.whole.up = dual.weights.map(|g| g / (bound * tau));
    dual_steps(&volume, room, &dual, [v, iterate])?;
    volume.run(room, &end.with_primal(&dual).each(&body("primal_of(i)")), v, Some(&*dual.p[0]))
}

/// Makes the dual steps of the proximal map of `v`. `iterate` is overwritten.
fn dual_steps(volume: &Volume, room: &mut Room, dual: &Dual<'_>, [v, iterate]: [&Array; 2]) -> Result<()> {
    let primal = Task::of_voxels("primal of the prior").with("gradient", Read, v).with("ahead", Write, iterate);
    let primal = primal.with_primal(dual).each("ahead[i] = primal_of(i);");
    let ascend = Task::of_voxels("dual of the prior").with_dual(Write, dual).with_values(iterate);
    let (ascend, guide) = ascend.with_penalty(dual)?;
    let ascend = ascend.each(&include_str!("../kernels/ascend.wgsl").replace("GUIDE", guide));
    for _ in 0..dual.steps {
        volume.run(room, &primal, v, Some(&*dual.p[0]))?;
        volume.run(room, &ascend, v, Some(iterate))?;
    }
    Ok(())
}

/// The value of a penalty of differences.
pub(super) fn value(room: &mut Room, dual: &Dual<'_>, x: &Array) -> Result<f64> {
    let (task, guide) = Task::of_voxels("value of the prior").with_values(x).with_penalty(dual)?;
    let body = format!("let v = vec2<f32>(penalty_cost(differences(place(i)), {guide}), 0.0);");
    let mut volume = Volume::new(x);
    volume.whole.up = dual.weights;
    volume.sum(room, &task.summing(&body, false), x, dual.slab)
}

/// Finds the edges of `x` that guide a penalty. Returns the new value.
pub(super) fn adapt(room: &mut Room, dual: Dual<'_>, x: &Array) -> Result<f64> {
    if let Some(Guide { vectors, strength, scale }) = &dual.guide {
        let mut volume = Volume::new(x);
        volume.whole.up = dual.weights;
        let vectors = vectors.each_ref().map(|x| &**x);
        let edges = Task::of_voxels("edges").with_three(GUIDE, Write, vectors).with_values(x);
        let edges = edges.add("edges", include_str!("../kernels/edges.wgsl"));
        let edges = edges.summing(include_str!("../kernels/edge_slopes.wgsl"), false);
        let squares = volume.sum(room, &edges, x, dual.slab)?;
        let mean = match dual.slab {
            None => squares / x.len() as f64,
            Some(slab) => slab.sum(squares) / (slab.whole * plane(x.shape())) as f64,
        };
        volume.whole.step = *strength;
        volume.whole.momentum = mean as f32 * scale * scale;
        let lengths = Task::of_voxels("lengths of edges").with_three(GUIDE, Write, vectors);
        volume.run(room, &lengths.each(include_str!("../kernels/edge_lengths.wgsl")), x, None)?;
    }
    value(room, &dual, x)
}

/// Overwrites `out` with the slope of the smoothed total variation of `x`. Returns its sum of squares.
pub(super) fn slope(room: &mut Room, slope: &VariationSlope<'_>, x: &Array, out: &mut Array) -> Result<f64> {
    let task = Task::of_voxels("slope of total variation").with("out", Write, out).with_values(x);
    let task = task.add("slope", include_str!("../kernels/slope.wgsl"));
    let body = "let s = slope_at(i);\n        out[i] = s;\n        let v = vec2<f32>(s * s, 0.0);";
    let mut volume = Volume::new(x);
    volume.whole.up = slope.weights;
    volume.whole.step = slope.unit;
    volume.sum(room, &task.summing(body, false), x, None)
}
