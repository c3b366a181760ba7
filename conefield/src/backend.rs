//! Selection of the backend.

use crate::{devices, ranks};
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

/// The same for [`BackendChoice::open_for_run`].
pub const HELP_OF_A_RUN: &str = "Backend: auto (the CPU, whose results repeat to the bit), cpu, wgpu, wgpu:N for adapter N, or wgpu:N,M,... for a volume that several adapters share";

/// Value of `--backend`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum BackendChoice {
    /// The CPU, whose results repeat to the bit.
    #[default]
    Auto,
    /// Rayon and SIMD.
    Cpu,
    /// GPUs.
    Wgpu {
        /// Numbers of adapters; the most capable one if there are none.
        adapters: Vec<usize>,
    },
}

impl FromStr for BackendChoice {
    type Err = String;
    fn from_str(s: &str) -> Result<Self, String> {
        match s.split_once(':') {
            None if s == "auto" => Ok(Self::Auto),
            None if s == "cpu" => Ok(Self::Cpu),
            None if s == "wgpu" => Ok(Self::Wgpu { adapters: vec![] }),
            Some(("wgpu", all)) => match all.split(',').map(str::parse).collect() {
                Ok(adapters) => Ok(Self::Wgpu { adapters }),
                Err(_) => Err("expected numbers of adapters after wgpu:, as in wgpu:0 or wgpu:0,1".into()),
            },
            _ => Err("expected auto, cpu, wgpu, or wgpu:N with the number of an adapter".into()),
        }
    }
}

impl fmt::Display for BackendChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Cpu => f.write_str("cpu"),
            Self::Wgpu { adapters } => {
                f.write_str("wgpu")?;
                let signs = [":"].into_iter().chain(std::iter::repeat(","));
                adapters.iter().zip(signs).try_for_each(|(n, sign)| write!(f, "{sign}{n}"))
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
    /// The name with which the description of the opened backend begins.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Auto | Self::Cpu => "cpu",
            Self::Wgpu { .. } => "wgpu",
        }
    }

    /// Opens the backend.
    pub fn open(&self) -> Result<Box<dyn Backend>> {
        // Each process takes one of the adapters in turn.
        let of_process = |rank: usize| match self {
            Self::Wgpu { adapters } if !adapters.is_empty() => gpu::open(Some(adapters[rank % adapters.len()])),
            _ => self.open_one(),
        };
        ranks::backend(of_process).unwrap_or_else(|| self.open_one())
    }

    fn open_one(&self) -> Result<Box<dyn Backend>> {
        match self {
            Self::Auto => Ok(Box::<Auto>::default()),
            Self::Cpu => Ok(Box::new(Cpu::new())),
            Self::Wgpu { adapters } => match adapters[..] {
                [] => gpu::open(None),
                [one] => gpu::open(Some(one)),
                _ => Err(self.refused("one adapter: only a reconstruction shares a volume among several")),
            },
        }
    }

    /// Opens the backend of a reconstruction, which several adapters may share. `budget` are its seconds, if it has a
    /// budget.
    pub fn open_for_run(&self, budget: Option<f64>) -> Result<Box<dyn Backend>> {
        match self {
            Self::Wgpu { adapters } if adapters.len() > 1 && ranks::count() == 1 => {
                if budget.is_some() {
                    return Err(self.refused("one adapter within a budget: methods are timed on one"));
                }
                let all: Vec<_> = adapters.iter().map(|&n| gpu::open(Some(n))).collect::<Result<_>>()?;
                Ok(devices::join(all))
            }
            _ => self.open(),
        }
    }

    fn refused(&self, expected: &str) -> Error {
        Error::invalid("this run", "backend", self, expected)
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

    fn describe(&self) -> String {
        self.cpu.describe()
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
        for s in ["auto", "cpu", "wgpu", "wgpu:3", "wgpu:0,2,1"] {
            assert_eq!(s.parse::<BackendChoice>().unwrap().to_string(), s);
        }
        for s in ["", "gpu", "wgpu:", "wgpu:x", "cpu:1", "wgpu:-1", "wgpu:0,", "wgpu:0 1"] {
            assert!(s.parse::<BackendChoice>().is_err(), "{s}");
        }
    }
}
