//! The machine of a run.

use conefield_core::simd;
use conefield_evaluation::report::text::bytes;
use serde::{Deserialize, Serialize};
use sysinfo::{CpuRefreshKind, MemoryRefreshKind, RefreshKind, System};

/// The properties of a machine that determine the speed of a run. The record of an earlier version may lack some.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Machine {
    /// Name of the processor.
    pub cpu: String,
    /// Cores that this process may use.
    pub cores: usize,
    /// Total memory of the machine.
    pub memory_bytes: u64,
    /// Operating system and architecture.
    pub system: String,
}

impl Machine {
    /// The current machine.
    pub fn here() -> Self {
        let (cpu, memory) = (CpuRefreshKind::nothing(), MemoryRefreshKind::nothing().with_ram());
        let system = System::new_with_specifics(RefreshKind::nothing().with_cpu(cpu).with_memory(memory)).ok();
        let cpu = system.as_ref().and_then(|s| s.cpus().first()).map(|c| c.brand().trim().to_owned());
        Self {
            cpu: cpu.filter(|c| !c.is_empty()).unwrap_or_else(|| "unknown".into()),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_bytes: system.map_or(0, |s| s.total_memory()),
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
        }
    }

    /// Text for people.
    pub fn line(&self) -> String {
        format!("{}, {} cores, {}, {}", self.cpu, self.cores, bytes(self.memory_bytes), self.system)
    }
}

/// The instruction set that kernels use on this machine.
pub fn simd_level() -> String {
    let debug = format!("{:?}", simd::level());
    debug.split(['(', ' ', '{']).next().unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_machine_has_cores_and_memory() {
        let here = Machine::here();
        assert!(here.cores > 0 && here.memory_bytes > 1 << 20 && !here.cpu.is_empty(), "{here:?}");
        let text = serde_json::to_string(&here).unwrap();
        assert_eq!(serde_json::from_str::<Machine>(&text).unwrap(), here);
        let earlier: Machine = serde_json::from_str("{\"cpu\": \"a\"}").unwrap();
        assert_eq!(earlier, Machine { cpu: "a".into(), ..Machine::default() });
    }
}
