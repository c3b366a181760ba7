//! Measured limits of a device, to compare the speed of kernels with.

use crate::Wgpu;
use crate::device::Atomics;
use crate::programs::Programs;
use conefield_core::device::{Access, Device, Program, Source};
use conefield_core::error::Result;
use serde::Serialize;
use std::time::Instant;
use wgpu::BufferUsages as U;

/// A device's limits. Rates are per second.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Ceiling {
    /// Multiply-adds in single precision.
    pub multiply_adds: f64,
    /// Size of the large buffer: 1 GiB, or what one binding holds.
    pub large_bytes: u64,
    /// Bytes read in order from the large buffer.
    pub bytes: f64,
    /// Reads of 8 bytes at random places of the large buffer.
    pub far_reads: f64,
    /// Reads of 8 bytes at random places of 32 MiB, about the size of a hash grid's tables.
    pub random_reads: f64,
    /// Additions to `f32` numbers at random places of 32 MiB.
    pub random_sums: f64,
    /// Additions in which neighbouring lanes have neighbouring places.
    pub neighbour_sums: f64,
    /// Additions in which the 64 lanes of a group share one place.
    pub shared_sums: f64,
    /// Seconds of an empty submission and the wait for it.
    pub submit_s: f64,
    /// Bytes sent to the device.
    pub upload: f64,
    /// Bytes read back from the device.
    pub read_back: f64,
}

/// Vector multiply-adds of one invocation.
const ROUNDS: u32 = 256;
/// Reads or sums of one invocation.
const READS: u32 = 64;
/// Bytes of the small buffer.
const SMALL: u64 = 32 << 20;
/// Bytes of a transfer.
const TRANSFER: u64 = 64 << 20;
/// Minimum duration of a measurement in seconds. Submission then takes at most a few thousandths of it.
const LONG: f64 = 0.05;
/// Pseudo-random numbers, one after the other: the quotient of the recurrence by 256 is used, since its low bits repeat soon.
const NEXT: &str = "h = h * 1664525u + 1013904223u;";

/// A kernel whose invocations run `body` and keep its result `a` alive.
fn reading(body: &str) -> Source {
    let mut source = Source::default();
    source.bind("data", Access::Write, "array<vec4<f32>>");
    let text = format!(
        "@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {{
    var a = vec4<f32>(f32(id.x));
    var b = a + 1.0;
    var c = a + 2.0;
    var d = a + 3.0;
{body}
    let sum = a + b + c + d;
    // Never true, but the compiler cannot know that.
    if sum.x == 1.2345e30 {{ data[0] = sum; }}
}}
"
    );
    source.add("measure", &text);
    source
}

/// A kernel whose invocations each add [`READS`] times 1 at `place`, an expression of `h`, `i`, `id` and `lane`.
fn adding(atomics: Atomics, place: &str) -> Source {
    let mut source = Source::default();
    source.bind("data", Access::Write, &format!("array<atomic<{}>>", atomics.number()));
    let text = format!(
        "fn add(at: u32, v: f32) {{
{}}}
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(local_invocation_index) lane: u32) {{
    var h = id.x;
    for (var i = 0u; i < {READS}u; i++) {{ {NEXT} add(({place}) % {}u, 1.0); }}
}}
",
        atomics.sum("data[at]"),
        SMALL / 4
    );
    source.add("measure", &text);
    source
}

/// The shortest of `times` runs of `run`, in seconds.
fn shortest(times: usize, mut run: impl FnMut() -> Result<()>) -> Result<f64> {
    let mut best = f64::INFINITY;
    for _ in 0..times {
        let started = Instant::now();
        run()?;
        best = best.min(started.elapsed().as_secs_f64());
    }
    Ok(best)
}

impl Wgpu {
    /// Measures the device. Each rate is the best of five runs of at least a twentieth of a second.
    pub fn ceiling(&self) -> Result<Ceiling> {
        let gpu = &self.shared.gpu;
        let software = gpu.adapter.software;
        // A software device has few lanes and no memory of its own.
        let groups = if software { 64 } else { 1 << 14 };
        let large_bytes = if software { SMALL } else { gpu.adapter.bound_bytes().min(1 << 30) };
        // Seconds of a launch.
        let best = |source: Source, bytes: u64| -> Result<f64> {
            let mut device = Programs::new(self.shared.clone());
            device.reserve("data", bytes)?;
            let program = Program { label: "measure".into(), source };
            let mut run = |launches: usize| {
                device.run(&vec![(&program, groups); launches])?;
                gpu.wait()
            };
            // The first run compiles.
            run(1)?;
            let mut launches = 1;
            while shortest(1, || run(launches))? < LONG && launches < 1 << 14 {
                launches *= 2;
            }
            Ok(shortest(5, || run(launches))? / launches as f64)
        };
        let invocations = (groups * 64) as f64;
        let each = "a = a * 0.999 + b; b = b * 0.998 + c; c = c * 0.997 + d; d = d * 0.996 + a;";
        let multiply = reading(&format!("    for (var i = 0u; i < {ROUNDS}u; i++) {{ {each} }}"));
        let in_order = |bytes: u64| {
            let entries = bytes / 16;
            reading(&format!("    for (var i = id.x; i < {entries}u; i += groups.x * 64u) {{ a += data[i]; }}"))
        };
        let random = |bytes: u64| {
            let read = format!("{NEXT} a += data[(h >> 6u) % {}u].xyxy;", bytes / 16);
            reading(&format!("    var h = id.x;\n    for (var i = 0u; i < {READS}u; i++) {{ {read} }}"))
        };
        let sums = |place: &str| {
            let seconds = best(adding(gpu.adapter.atomics, place), SMALL)?;
            Ok::<_, conefield_core::Error>(invocations * f64::from(READS) / seconds)
        };
        let small = SMALL.min(gpu.adapter.bound_bytes());
        let reads = invocations * f64::from(READS);

        let sent = vec![1u8; TRANSFER.min(gpu.adapter.buffer_bytes) as usize];
        let bytes = sent.len() as u64;
        let device = gpu.buffer("transfer", bytes, U::COPY_DST | U::COPY_SRC)?;
        let host = gpu.buffer("read back", bytes, U::COPY_DST | U::MAP_READ)?;
        let upload = shortest(5, || {
            gpu.queue.write_buffer(&device, 0, &sent);
            gpu.queue.submit([]);
            gpu.wait()
        })?;
        let read_back = shortest(5, || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(&device, 0, &host, 0, bytes);
            gpu.queue.submit([encoder.finish()]);
            gpu.read(&host, bytes, |found| assert_eq!(found.len() as u64, bytes))
        })?;
        let submit_s = shortest(5, || {
            gpu.queue.submit([gpu.device.create_command_encoder(&Default::default()).finish()]);
            gpu.wait()
        })?;
        Ok(Ceiling {
            multiply_adds: invocations * f64::from(ROUNDS * 16) / best(multiply, SMALL)?,
            large_bytes,
            bytes: large_bytes as f64 / best(in_order(large_bytes), large_bytes)?,
            far_reads: reads / best(random(large_bytes), large_bytes)?,
            random_reads: reads / best(random(small), small)?,
            random_sums: sums("h >> 6u")?,
            neighbour_sums: sums("id.x + i * 64u")?,
            shared_sums: sums("(id.x - lane) + i * 64u")?,
            submit_s,
            upload: bytes as f64 / upload,
            read_back: bytes as f64 / read_back,
        })
    }
}
