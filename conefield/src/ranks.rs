//! Several processes for one run. They share the volume and the views of a classical method; see
//! [`conefield_core::place::Ranks`].
//!
//! The leading process, rank 0, reports and writes. The others make the same calls of the library and write nothing. A
//! program joins them before its first run: by [`start`], or with its own [`Peers`].

#[cfg_attr(not(feature = "mpi"), path = "ranks/alone.rs")]
mod mpi;

pub use mpi::{Joined, start};

use crate::devices::Member;
use conefield_core::Result;
use conefield_core::backend::Backend;
use conefield_core::place::{Peers, Ranks};
use std::sync::{Arc, OnceLock};

/// The connection to the other processes.
static PEERS: OnceLock<Arc<dyn Peers>> = OnceLock::new();

/// The place that this process shares with others.
static PLACE: OnceLock<Arc<Ranks>> = OnceLock::new();

/// From now on, runs of this process are those of all processes that `peers` connects.
pub fn join(peers: Arc<dyn Peers>) {
    let _ = PEERS.set(peers);
}

/// Number of processes of a run.
pub fn count() -> usize {
    PEERS.get().map_or(1, |peers| peers.count())
}

/// The number of this process, from 0. Rank 0 reports and writes.
pub fn rank() -> usize {
    PEERS.get().map_or(0, |peers| peers.rank())
}

/// Bytes that this process has sent to the others.
pub fn sent() -> u64 {
    PLACE.get().map_or(0, |place| place.sent())
}

/// The backend of processes that share their arrays, if there are several. `open` opens that of the process with the given
/// number.
pub(crate) fn backend(open: impl FnOnce(usize) -> Result<Box<dyn Backend>>) -> Option<Result<Box<dyn Backend>>> {
    let peers = PEERS.get().filter(|peers| peers.count() > 1)?;
    let shared = |device: Box<dyn Backend>| {
        let place = PLACE.get_or_init(|| Arc::new(Ranks::new(peers.clone(), device.place())));
        Box::new(Member { device, place: place.clone() }) as Box<dyn Backend>
    };
    Some(open(peers.rank()).map(shared))
}
