//! Several processes for one run. They share the volume and the views of a classical method; see
//! [`conefield_core::place::Ranks`].
//!
//! The leading process, rank 0, reports and writes. The others make the same calls of the library and write nothing. A
//! program joins them before its first run: by [`start`], or with its own [`Peers`].

#[cfg_attr(not(feature = "mpi"), path = "ranks/alone.rs")]
mod mpi;

pub use mpi::{Joined, start};

use conefield_core::backend::{Backend, Executable, Explain};
use conefield_core::pipeline::Pipeline;
use conefield_core::place::{Host, Peers, Place, Ranks};
use conefield_core::{Error, Result};
use std::sync::{Arc, OnceLock};

/// The place that this process shares with others.
static SHARED: OnceLock<Shared> = OnceLock::new();

#[derive(Clone)]
struct Shared {
    rank: usize,
    count: usize,
    place: Arc<Ranks>,
}

/// From now on, runs of this process are those of all processes that `peers` connects.
pub fn join(peers: Arc<dyn Peers>) {
    let (rank, count) = (peers.rank(), peers.count());
    let _ = SHARED.set(Shared { rank, count, place: Arc::new(Ranks::new(peers, Arc::new(Host))) });
}

/// Number of processes of a run.
pub fn count() -> usize {
    SHARED.get().map_or(1, |shared| shared.count)
}

/// The number of this process, from 0. Rank 0 reports and writes.
pub fn rank() -> usize {
    SHARED.get().map_or(0, |shared| shared.rank)
}

/// Bytes that this process has sent to the others.
pub fn sent() -> u64 {
    SHARED.get().map_or(0, |shared| shared.place.sent())
}

/// The backend of processes that share their arrays, if there are several.
pub(crate) fn backend() -> Option<Box<dyn Backend>> {
    SHARED.get().filter(|shared| shared.count > 1).map(|shared| Box::new(shared.clone()) as Box<dyn Backend>)
}

impl Backend for Shared {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn compile(&self, _: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        let what = format!("{} processes: a field is trained by one; start it without mpirun", self.count);
        Err(Error::unsupported("method", what))
    }

    fn place(&self) -> Arc<dyn Place> {
        self.place.clone()
    }
}
