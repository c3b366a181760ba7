//! Which backend computes.

use conefield_backend_cpu::Cpu;
use conefield_backend_wgpu::{Limits, Wgpu, adapters};
use conefield_core::Result;
use conefield_core::backend::{Backend, Executable, Explain};
use conefield_core::pipeline::Pipeline;
use conefield_core::voxel::{VoxelProjector, VoxelView};
use ndarray::{ArrayView3, ArrayViewMut3};
use serde::{Serialize, Serializer};
use std::fmt;
use std::path::Path;
use std::str::FromStr;
use std::sync::OnceLock;

/// What `--help` says of `--backend`.
pub const HELP: &str = "Which backend: auto, cpu, wgpu, or wgpu:N with the number of an adapter; +subgroups after wgpu adds up \
                        gradients of tables in subgroups first";

/// What `--backend` says.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum BackendChoice {
    /// The fastest here that can run the spec.
    #[default]
    Auto,
    /// Rayon and SIMD.
    Cpu,
    /// A GPU.
    Wgpu {
        /// The adapter's number; otherwise the one that promises most.
        index: Option<usize>,
        /// Gradients of tables are added up in subgroups first.
        subgroups: bool,
    },
}

impl FromStr for BackendChoice {
    type Err = String;
    fn from_str(s: &str) -> Result<Self, String> {
        let (name, subgroups) = s.strip_suffix("+subgroups").map_or((s, false), |name| (name, true));
        match name.split_once(':') {
            None if s == "auto" => Ok(Self::Auto),
            None if s == "cpu" => Ok(Self::Cpu),
            None if name == "wgpu" => Ok(Self::Wgpu { index: None, subgroups }),
            Some(("wgpu", n)) if n.parse::<usize>().is_ok() => Ok(Self::Wgpu { index: n.parse().ok(), subgroups }),
            _ => {
                Err("expected auto, cpu, wgpu, or wgpu:N with the number of an adapter; after wgpu also +subgroups"
                    .into())
            }
        }
    }
}

impl fmt::Display for BackendChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Cpu => f.write_str("cpu"),
            Self::Wgpu { index, subgroups } => {
                f.write_str("wgpu")?;
                index.map_or(Ok(()), |n| write!(f, ":{n}"))?;
                f.write_str(if *subgroups { "+subgroups" } else { "" })
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
    /// The backend.
    pub fn open(self) -> Result<Box<dyn Backend>> {
        Ok(match self {
            Self::Auto => Box::<Auto>::default(),
            Self::Cpu => Box::new(Cpu::new()),
            Self::Wgpu { index, subgroups } => {
                Box::new(Wgpu::with_limits(index, Limits { subgroups, ..Limits::default() })?)
            }
        })
    }
}

/// A GPU where there is one that can run the pipeline, else the CPU.
#[derive(Default)]
struct Auto {
    cpu: Cpu,
    /// Opened when it is first asked for; why there is none otherwise.
    gpu: OnceLock<Result<Wgpu, String>>,
}

impl Auto {
    fn gpu(&self) -> Result<&Wgpu, String> {
        let open = || {
            // Asking for adapters loads drivers: not worth it where the system shows no GPU.
            if !shows_gpu() {
                return Err("no GPU was found".to_owned());
            }
            // A CPU that acts as a GPU is slower than the CPU backend.
            let best = adapters().into_iter().filter(|a| !a.software).max_by_key(|a| a.rank());
            let best = best.ok_or("no GPU was found")?;
            Wgpu::open(Some(best.index)).map_err(|e| e.to_string())
        };
        self.gpu.get_or_init(open).as_ref().map_err(Clone::clone)
    }
}

/// Whether the system has the files through which a GPU is reached; systems that have none are taken to show one.
fn shows_gpu() -> bool {
    !cfg!(target_os = "linux") || ["/dev/dri", "/dev/nvidiactl", "/dev/dxg"].iter().any(|p| Path::new(p).exists())
}

impl Backend for Auto {
    fn name(&self) -> &'static str {
        "auto"
    }

    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        let why = match self.gpu() {
            Err(why) => why,
            Ok(gpu) => match gpu.compile(pipeline) {
                Ok((exe, mut explain)) => {
                    explain.notes.insert(0, "chosen by --backend auto: a GPU that can run every stage".into());
                    return Ok((exe, explain));
                }
                Err(e) => e.to_string(),
            },
        };
        let (exe, mut explain) = self.cpu.compile(pipeline)?;
        explain.notes.insert(0, format!("chosen by --backend auto: {why}"));
        Ok((exe, explain))
    }

    fn place(&self, projector: Box<dyn VoxelProjector>) -> Result<Box<dyn VoxelProjector>> {
        match self.gpu() {
            Ok(gpu) if projector.wgsl().is_some() => gpu.place(projector),
            _ => Ok(projector),
        }
    }

    fn backproject(
        &self,
        views: &[VoxelView],
        images: ArrayView3<'_, f32>,
        volume: ArrayViewMut3<'_, f32>,
    ) -> Result<bool> {
        self.gpu().map_or(Ok(false), |gpu| gpu.backproject(views, images, volume))
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
