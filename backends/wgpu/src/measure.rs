//! What a device can do at most, measured: the yardstick beside a kernel's own speed.

use crate::Shared;
use crate::kernel::Buffers;
use crate::source::{Access, Source};
use conefield_core::error::Result;
use std::time::Instant;
use wgpu::BufferUsages as U;

/// A device's limits, each a second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ceiling {
    /// Multiply-adds in single precision.
    pub multiply_adds: f64,
    /// Bytes read one after the other.
    pub bytes: f64,
    /// Reads of 8 bytes at random places of 32 MiB.
    pub random_reads: f64,
}

/// Invocations of a measurement.
const MANY: u32 = 1 << 18;
/// Vector multiply-adds of one invocation; reads of one.
const ROUNDS: u32 = 256;
const READS: u32 = 64;
/// Bytes that are read.
const BYTES: u64 = 32 << 20;

fn source(body: &str) -> Source {
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
    // Never so, but the compiler cannot know.
    if sum.x == 1.2345e30 {{ data[0] = sum; }}
}}
"
    );
    source.add("measure", &text);
    source
}

impl Shared {
    /// Measures the device; the best of five runs each. Software devices do a 64th of the work.
    pub fn ceiling(&self) -> Result<Ceiling> {
        let invocations = if self.gpu.adapter.software { MANY / 64 } else { MANY };
        let mut buffers = Buffers::default();
        buffers.reserve(&self.gpu, "data", BYTES, U::STORAGE)?;
        let entries = BYTES / 16;
        let best = |body: String| -> Result<f64> {
            let kernel = self.kernels.get(&self.gpu, "measure", &source(&body))?;
            let bound = kernel.bind(&self.gpu, &buffers)?;
            let mut best = f64::INFINITY;
            for _ in 0..6 {
                let started = Instant::now();
                let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
                kernel.launch(&mut encoder.begin_compute_pass(&Default::default()), &bound, invocations / 64);
                self.gpu.queue.submit([encoder.finish()]);
                self.gpu.wait()?;
                best = best.min(started.elapsed().as_secs_f64());
            }
            Ok(best)
        };
        let each = "a = a * 0.999 + b; b = b * 0.998 + c; c = c * 0.997 + d; d = d * 0.996 + a;";
        let adds = best(format!("    for (var i = 0u; i < {ROUNDS}u; i++) {{ {each} }}"))?;
        let lines = best(format!("    for (var i = id.x; i < {entries}u; i += groups.x * 64u) {{ a += data[i]; }}"))?;
        let places = best(format!(
            "    var h = id.x;
    for (var i = 0u; i < {READS}u; i++) {{ h = h * 1664525u + 1013904223u; a += data[(h >> 8u) % {entries}u].xyxy; }}"
        ))?;
        let n = f64::from(invocations);
        Ok(Ceiling {
            multiply_adds: n * f64::from(ROUNDS * 16) / adds,
            bytes: BYTES as f64 / lines,
            random_reads: n * f64::from(READS) / places,
        })
    }
}
