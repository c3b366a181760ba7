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
use conefield_core::checksum::of_text;
use conefield_core::place::{Peers, Ranks};
use std::sync::{Arc, OnceLock};
use sysinfo::System;

/// The connection to the other processes.
static PEERS: OnceLock<Arc<dyn Peers>> = OnceLock::new();

/// The place that this process shares with others.
static PLACE: OnceLock<Arc<Ranks>> = OnceLock::new();

/// Number of processes on this machine.
static ON_MACHINE: OnceLock<u64> = OnceLock::new();

/// Makes every later run of this process a run of all processes that `peers` connects. Waits until all of them have
/// joined.
pub fn join(peers: Arc<dyn Peers>) {
    let _ = ON_MACHINE.set(namesakes(peers.as_ref(), &System::host_name().unwrap_or_default()));
    let _ = PEERS.set(peers);
}

/// Number of processes of a run on this machine, which share its memory.
pub(crate) fn on_machine() -> u64 {
    ON_MACHINE.get().copied().unwrap_or(1)
}

/// Number of processes whose machine has this name.
fn namesakes(peers: &dyn Peers, name: &str) -> u64 {
    // Each byte of a checksum as a number.
    let own: Vec<f32> = of_text(name).bytes().map(f32::from).collect();
    let mut all = vec![vec![0.0; own.len()]; peers.count()];
    peers.exchange(&vec![own.clone(); peers.count()], &mut all);
    all.iter().filter(|other| **other == own).count() as u64
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

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::place::Threads;

    #[test]
    fn processes_on_machines_of_one_name_are_counted() {
        let threads = Threads::new(3);
        let peers: Vec<_> = threads.peers().collect();
        let count = |rank: usize| Ok(namesakes(peers[rank].as_ref(), ["one", "one", "two"][rank]));
        assert_eq!(threads.run(|| count(0), count).unwrap(), [2, 2, 1]);
    }
}
