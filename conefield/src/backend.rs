//! Selection of the backend.

use crate::ranks;
use conefield_backend_cpu::Cpu;
use conefield_core::backend::{Backend, Executable, Explain};
use conefield_core::pipeline::Pipeline;
use conefield_core::{Error, Result};
use serde::{Serialize, Serializer};
use std::fmt;
use std::path::Path;
use std::str::FromStr;
use std::sync::OnceLock;

/// Help text of `--backend`.
pub const HELP: &str = "Backend: auto (the CPU, whose results repeat to the bit), cpu, wgpu, or wgpu:N for adapter N";

/// Value of `--backend`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum BackendChoice {
    /// The CPU, whose results repeat to the bit.
    #[default]
    Auto,
    /// Rayon and SIMD.
    Cpu,
    /// A GPU.
    Wgpu {
        /// The adapter's number; otherwise the most capable one.
        index: Option<usize>,
    },
}

impl FromStr for BackendChoice {
    type Err = String;
    fn from_str(s: &str) -> Result<Self, String> {
        match s.split_once(':') {
            None if s == "auto" => Ok(Self::Auto),
            None if s == "cpu" => Ok(Self::Cpu),
            None if s == "wgpu" => Ok(Self::Wgpu { index: None }),
            Some(("wgpu", n)) if n.parse::<usize>().is_ok() => Ok(Self::Wgpu { index: n.parse().ok() }),
            _ => Err("expected auto, cpu, wgpu, or wgpu:N with the number of an adapter".into()),
        }
    }
}

impl fmt::Display for BackendChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Cpu => f.write_str("cpu"),
            Self::Wgpu { index } => {
                f.write_str("wgpu")?;
                index.map_or(Ok(()), |n| write!(f, ":{n}"))
            }
        }
    }
}

impl Serialize for BackendChoice {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.collect_str(self)
    }
}

impl BackendChoice {
    /// Opens the backend.
    pub fn open(self) -> Result<Box<dyn Backend>> {
        if let Some(shared) = ranks::backend() {
            return match self {
                Self::Auto | Self::Cpu => Ok(shared),
                Self::Wgpu { .. } => {
                    Err(Error::invalid("this run", "backend", self, "auto or cpu: several processes share CPUs only"))
                }
            };
        }
        Ok(match self {
            Self::Auto => Box::<Auto>::default(),
            Self::Cpu => Box::new(Cpu::new()),
            Self::Wgpu { index } => gpu::open(index)?,
        })
    }
}

/// The CPU, with a hint about available GPUs, which are faster but whose results do not repeat to the bit.
#[derive(Default)]
struct Auto {
    cpu: Cpu,
    /// The available GPU, looked up when first needed.
    gpu: OnceLock<Option<String>>,
}

impl Auto {
    fn note(&self) -> String {
        // Enumerating adapters loads drivers: skipped if the system shows no GPU.
        let look = || {
            let (index, best) = if shows_gpu() { gpu::best()? } else { return None };
            Some(format!("there is a GPU, {best}: --backend wgpu:{index} uses it"))
        };
        match self.gpu.get_or_init(look) {
            None => "chosen by --backend auto, which uses the CPU; no GPU is available".to_owned(),
            Some(gpu) => format!("chosen by --backend auto, which uses the CPU; {gpu}"),
        }
    }
}

/// Whether the system has the device files of a GPU; true on systems without such files.
fn shows_gpu() -> bool {
    !cfg!(target_os = "linux") || ["/dev/dri", "/dev/nvidiactl", "/dev/dxg"].iter().any(|p| Path::new(p).exists())
}

impl Backend for Auto {
    fn name(&self) -> &'static str {
        "auto"
    }

    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        let (exe, mut explain) = self.cpu.compile(pipeline)?;
        explain.notes.insert(0, self.note());
        Ok((exe, explain))
    }
}

#[cfg(feature = "wgpu")]
mod gpu {
    use conefield_backend_wgpu::{Wgpu, adapters};
    use conefield_core::Result;
    use conefield_core::backend::Backend;

    pub fn open(index: Option<usize>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(Wgpu::open(index)?))
    }

    /// The most capable GPU: its number and description.
    pub fn best() -> Option<(usize, String)> {
        let best = adapters().into_iter().filter(|a| !a.software).max_by_key(|a| a.rank())?;
        Some((best.index, best.to_string()))
    }
}

#[cfg(not(feature = "wgpu"))]
mod gpu {
    use conefield_core::backend::Backend;
    use conefield_core::{Error, Result};

    pub fn open(_: Option<usize>) -> Result<Box<dyn Backend>> {
        let expected = "auto or cpu: this program is built without conefield's feature `wgpu`";
        Err(Error::invalid("this run", "backend", "wgpu", expected))
    }

    pub fn best() -> Option<(usize, String)> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_read_is_what_is_written() {
        for s in ["auto", "cpu", "wgpu", "wgpu:3"] {
            assert_eq!(s.parse::<BackendChoice>().unwrap().to_string(), s);
        }
        for s in ["", "gpu", "wgpu:", "wgpu:x", "cpu:1", "wgpu:-1"] {
            assert!(s.parse::<BackendChoice>().is_err(), "{s}");
        }
    }
}
