//! `conefield backends`

use crate::out::{self, bytes};
use clap::Args;
use conefield::machine::simd_level;
use conefield::tradeoff::speed::pass_s;
use conefield_backend_cpu::Cpu;
use conefield_backend_wgpu::{Adapter, adapters};
use conefield_core::Result;
use serde_json::json;

/// List the backends of this machine: CPU instructions and speed, GPU adapters.
///
/// The standard reconstruction is a small total-variation run. Its work is the same on every machine, so its time
/// compares machines; fronts of methods record it, too.
#[derive(Args)]
pub struct BackendsArgs {
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl BackendsArgs {
    pub fn run(self) -> Result<()> {
        let (level, threads) = (simd_level(), rayon::current_num_threads());
        let pass_s = pass_s(&Cpu::new(), &|| false)?;
        let adapters = adapters();
        if self.json {
            let cpu = json!({ "name": "cpu", "simd": level, "threads": threads, "pass_s": pass_s });
            let wgpu = json!({ "name": "wgpu", "adapters": adapters });
            return out::json(&json!({ "backends": [cpu, wgpu] }));
        }
        let threads = out::counted(threads, "thread");
        let mut lines =
            vec![format!("cpu     {level}, {threads}, {pass_s:.3} s per pass of the standard reconstruction")];
        if adapters.is_empty() {
            lines.push("wgpu    no Vulkan, Metal or DX12 adapter was found".into());
        }
        lines.extend(adapters.iter().map(line));
        out::say(&lines.join("\n"))
    }
}

/// One line about an adapter and its limits.
fn line(a: &Adapter) -> String {
    let subgroups = a.subgroups.map_or(String::new(), |[least, most]| match least == most {
        true => format!(", subgroups of {least}"),
        false => format!(", subgroups of {least} to {most}"),
    });
    format!(
        "wgpu:{}  {a}\n        buffers up to {}, {} at once of up to {}, {} of workgroup memory, {}{subgroups}{}",
        a.index,
        bytes(a.buffer_bytes),
        a.storage_buffers,
        bytes(a.binding_bytes),
        bytes(a.workgroup_bytes.into()),
        a.atomics,
        if a.timestamps { ", timestamps" } else { "" }
    )
}
