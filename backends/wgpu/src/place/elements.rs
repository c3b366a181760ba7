//! Elementwise maps, masks and reductions.

use super::launch::{Room, Task};
use super::{Array, Mask, flag, parts, plane};
use crate::Shared;
use conefield_core::device::Access;
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

/// A kernel over elements.
fn task(label: &str) -> Task<'_> {
    Task::new(label, include_str!("../kernels/elements.wgsl"), "elements", "Elements")
}

/// Flags as bits.
pub(super) fn words(flags: &ArrayView3<'_, bool>) -> Vec<u32> {
    let flags = flags.as_standard_layout();
    let word = |part: &[bool]| part.iter().rev().fold(0u32, |word, inside| word << 1 | u32::from(*inside));
    flags.as_slice().unwrap_or_default().chunks(32).map(word).collect()
}

/// Factors for a kernel: ±∞ become the lowest and the highest number.
fn uniform([a, b]: [f64; 2]) -> impl Fn(u32, u32) -> Elements {
    let [a, b] = [a, b].map(|x| (x as f32).clamp(f32::MIN, f32::MAX));
    move |begin, end| Elements { begin, end, a, b }
}

/// Runs a kernel for every element i of `out`.
fn apply(room: &mut Room, task: &Task<'_>, factors: [f64; 2], out: &Array) -> Result<()> {
    for (k, part) in parts(out).iter().enumerate() {
        room.run(task, &task.parts(k), uniform(factors), (part.planes.len() * plane(out.shape())) as u32)?;
    }
    Ok(())
}

pub(super) fn fill(room: &mut Room, x: &Array, value: f32) -> Result<()> {
    if value == 0.0 {
        let gpu = &room.shared.gpu;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        parts(x).iter().for_each(|part| encoder.clear_buffer(&part.buffer, 0, None));
        gpu.submit(encoder);
        return Ok(());
    }
    let task = task("fill").with("out", Access::Write, x).each("out[i] = elements.a;");
    apply(room, &task, [f64::from(value), 0.0], x)
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

pub(super) fn keep(room: &mut Room, x: &mut Array, inside: &Mask, value: f32) -> Result<()> {
    let body = format!("if !{} {{ out[i] = elements.a; }}", flag("inside", "i"));
    let task = task("mask").with("out", Access::Write, x).masked("inside", inside).each(&body);
    apply(room, &task, [f64::from(value), 0.0], x)
}

pub(super) fn map(room: &mut Room, map: &Map, factors: [f64; 2], out: &mut Array, inputs: &[&Array]) -> Result<()> {
    let names = &["first", "second"][..map.inputs];
    let number = |k: usize| names.get(k).map_or("0.0".to_owned(), |name| format!("{name}[i]"));
    let body = include_str!("../kernels/map.wgsl").replace("FIRST", &number(0)).replace("SECOND", &number(1));
    let mut task = task(map.name).with("out", Access::Write, out);
    for (name, x) in names.iter().zip(inputs) {
        task = task.with(name, Access::Read, x);
    }
    apply(room, &task.each(&body.replace("VALUE", map.wgsl)), factors, out)
}

pub(super) fn reduce(room: &mut Room, kind: Reduction, x: &Array, y: &Array) -> Result<f64> {
    let largest = kind == Reduction::Maximum;
    let task = task("reduction").with("first", Access::Read, x).with("second", Access::Read, y);
    let body =
        format!("let x = first[i];\n        let y = second[i];\n        let v = vec2<f32>({}, 0.0);", kind.wgsl());
    let task = task.summing(&body, largest);
    let mut total = 0.0f64;
    for (k, part) in parts(x).iter().enumerate() {
        let count = (part.planes.len() * plane(x.shape())) as u32;
        let [found, _] = room.sum(&task, &task.parts(k), uniform([0.0; 2]), count, largest)?;
        total = if largest { total.max(found) } else { total + found };
    }
    Ok(total)
}
