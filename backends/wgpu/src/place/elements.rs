//! Elementwise maps, masks and reductions.

use super::launch::{Room, Task, each, summing};
use super::{Array, Chunk, Mask, flag, parts, plane};
use crate::Shared;
use conefield_core::device::{Access, Source};
use conefield_core::error::Result;
use conefield_core::place::{Map, Reduction};
use ndarray::ArrayView3;

/// `Elements` in `kernels/elements.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
struct Elements {
    begin: u32,
    end: u32,
    a: f32,
    b: f32,
}

/// A source with the uniform buffer `elements`.
fn begun() -> Source {
    let mut source = Source::default();
    source.add("elements", include_str!("../kernels/elements.wgsl"));
    source.bind("elements", Access::Uniform, "Elements");
    source
}

/// Flags as bits.
pub(super) fn words(flags: &ArrayView3<'_, bool>) -> Vec<u32> {
    let flags = flags.as_standard_layout();
    let word = |part: &[bool]| part.iter().rev().fold(0u32, |word, inside| word << 1 | u32::from(*inside));
    flags.as_slice().unwrap_or_default().chunks(32).map(word).collect()
}

/// Factors for a kernel: ±∞ become the lowest and the highest number.
fn uniform([a, b]: [f64; 2]) -> (&'static str, impl Fn(u32, u32) -> Elements) {
    let [a, b] = [a, b].map(|x| (x as f32).clamp(f32::MIN, f32::MAX));
    ("elements", move |begin, end| Elements { begin, end, a, b })
}

/// Runs `body` for every element i of `out`; `with` are further buffers, each with its type in WGSL.
fn apply(
    shared: &Shared,
    room: &mut Room,
    (label, body): (&str, &str),
    factors: [f64; 2],
    out: &Array,
    with: &[(&str, &str, &[Chunk])],
) -> Result<()> {
    let mut source = begun();
    source.bind("out", Access::Write, "array<f32>");
    with.iter().for_each(|(name, ty, _)| source.bind(name, Access::Read, ty));
    source.add(label, &each("elements", body));
    let plane = plane(out.shape());
    for (k, part) in parts(out).iter().enumerate() {
        let others = with.iter().filter_map(|(name, _, parts)| Some((*name, &parts.get(k)?.buffer)));
        let bind: Vec<_> = [("out", &part.buffer)].into_iter().chain(others).collect();
        let task = Task { label, source: &source, bind: &bind };
        room.run(shared, task, uniform(factors), (part.planes.len() * plane) as u32)?;
    }
    Ok(())
}

pub(super) fn fill(shared: &Shared, room: &mut Room, x: &Array, value: f32) -> Result<()> {
    if value == 0.0 {
        let mut encoder = shared.gpu.device.create_command_encoder(&Default::default());
        parts(x).iter().for_each(|part| encoder.clear_buffer(&part.buffer, 0, None));
        shared.gpu.submit(encoder);
        return Ok(());
    }
    apply(shared, room, ("fill", "out[i] = elements.a;"), [f64::from(value), 0.0], x, &[])
}

pub(super) fn scatter(shared: &Shared, (from, first): (&Array, usize), out: &mut Array, at: &[usize]) {
    let plane = 4 * plane(out.shape()) as u64;
    let mut encoder = shared.gpu.device.create_command_encoder(&Default::default());
    for (from_plane, &to_plane) in at.iter().enumerate() {
        let of = |x: &Array, i: usize| {
            let part = parts(x).iter().find(|part| part.planes.contains(&i))?;
            Some((part.buffer.clone(), (i - part.planes.start) as u64 * plane))
        };
        if let (Some((from, a)), Some((to, b))) = (of(from, first + from_plane), of(out, to_plane)) {
            encoder.copy_buffer_to_buffer(&from, a, &to, b, plane);
        }
    }
    shared.gpu.submit(encoder);
}

pub(super) fn keep(shared: &Shared, room: &mut Room, x: &mut Array, inside: &Mask, value: f32) -> Result<()> {
    let body = format!("if !{} {{ out[i] = elements.a; }}", flag("inside", "i"));
    let inside = [("inside", "array<u32>", parts(inside))];
    apply(shared, room, ("mask", &body), [f64::from(value), 0.0], x, &inside)
}

pub(super) fn map(
    shared: &Shared,
    room: &mut Room,
    map: &Map,
    factors: [f64; 2],
    out: &mut Array,
    inputs: &[&Array],
) -> Result<()> {
    let names = &["first", "second"][..map.inputs];
    let number = |k: usize| names.get(k).map_or("0.0".to_owned(), |name| format!("{name}[i]"));
    let body = include_str!("../kernels/map.wgsl").replace("FIRST", &number(0)).replace("SECOND", &number(1));
    let inputs: Vec<_> = names.iter().zip(inputs).map(|(name, x)| (*name, "array<f32>", parts(x))).collect();
    apply(shared, room, (map.name, &body.replace("VALUE", map.wgsl)), factors, out, &inputs)
}

pub(super) fn reduce(shared: &Shared, room: &mut Room, kind: Reduction, x: &Array, y: &Array) -> Result<f64> {
    let largest = kind == Reduction::Maximum;
    let mut source = begun();
    source.bind("first", Access::Read, "array<f32>");
    source.bind("second", Access::Read, "array<f32>");
    let body =
        format!("let x = first[i];\n        let y = second[i];\n        let v = vec2<f32>({}, 0.0);", kind.wgsl());
    summing(&mut source, "elements", &body, largest);
    let mut total = 0.0f64;
    for (x_part, y_part) in parts(x).iter().zip(parts(y)) {
        let bind = [("first", &x_part.buffer), ("second", &y_part.buffer)];
        let task = Task { label: "reduction", source: &source, bind: &bind };
        let count = (x_part.planes.len() * plane(x.shape())) as u32;
        let [found, _] = room.sum(shared, task, uniform([0.0; 2]), count, largest)?;
        total = if largest { total.max(found) } else { total + found };
    }
    Ok(total)
}
