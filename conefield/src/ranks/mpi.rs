//! Processes that `mpirun` starts.

use conefield_core::place::Peers;
use conefield_core::{Error, Result};
use mpi::Threading;
use mpi::collective::SystemOperation;
use mpi::datatype::{Partition, PartitionMut};
use mpi::environment::Universe;
use mpi::topology::SimpleCommunicator;
use mpi::traits::{Communicator, CommunicatorCollectives};
use std::sync::Arc;

/// The connection to the other processes. Its drop waits for them.
pub struct Joined(Option<Universe>);

impl Joined {
    /// Lets the launcher end all processes: it does so when one ends without closing the connection.
    pub fn abandon(self) {
        std::mem::forget(self);
    }
}

impl Drop for Joined {
    /// After a panic, the others would wait for ever: the launcher ends them.
    fn drop(&mut self) {
        if std::thread::panicking() {
            std::mem::forget(self.0.take());
        }
    }
}

/// Joins the processes of this run, if a launcher such as `mpirun` or `srun` has started this one.
///
/// # Errors
/// An MPI library without support for threads.
pub fn start() -> Result<Option<Joined>> {
    if !["OMPI_COMM_WORLD_SIZE", "PMI_RANK", "PMIX_RANK"].iter().any(|name| std::env::var_os(name).is_some()) {
        return Ok(None);
    }
    let failed = |what: &str| Error::unsupported("mpi", what.to_owned());
    let Some((universe, threading)) = mpi::initialize_with_threading(Threading::Serialized) else {
        return Err(failed("it is running already"));
    };
    if threading < Threading::Serialized {
        return Err(failed("this library does not let threads take turns (MPI_THREAD_SERIALIZED)"));
    }
    let world = universe.world();
    let [rank, count] = [world.rank(), world.size()].map(|n| usize::try_from(n).unwrap_or(0));
    super::join(Arc::new(World { rank, count }));
    Ok(Some(Joined(Some(universe))))
}

/// All processes.
struct World {
    rank: usize,
    count: usize,
}

impl Peers for World {
    fn rank(&self) -> usize {
        self.rank
    }

    fn count(&self) -> usize {
        self.count
    }

    /// Works in rounds: MPI counts with 32 bits, and a part may be a plane for each of many processes.
    fn exchange(&self, out: &[Vec<f32>], into: &mut [Vec<f32>]) {
        let world = SimpleCommunicator::world();
        let longest = out.iter().chain(&*into).map(Vec::len).max().unwrap_or(0) as u64;
        let mut rounds = 0u64;
        world.all_reduce_into(&longest.div_ceil(ROUND as u64), &mut rounds, SystemOperation::max());
        for round in 0..rounds as usize {
            let piece = |length: usize| (round * ROUND).min(length)..((round + 1) * ROUND).min(length);
            let pieces: Vec<&[f32]> = out.iter().map(|part| &part[piece(part.len())]).collect();
            let (counts, starts) = layout(pieces.iter().map(|piece| piece.len()));
            let flat = pieces.concat();
            let (their_counts, their_starts) = layout(into.iter().map(|part| piece(part.len()).len()));
            let mut found = vec![0.0f32; their_counts.iter().map(|n| *n as usize).sum()];
            world.all_to_all_varcount_into(
                &Partition::new(&flat[..], counts, starts),
                &mut PartitionMut::new(&mut found[..], their_counts, their_starts),
            );
            let mut rest = &found[..];
            for into in &mut *into {
                let own = piece(into.len());
                let into = &mut into[own];
                let (part, others) = rest.split_at(into.len());
                into.copy_from_slice(part);
                rest = others;
            }
        }
    }
}

/// Numbers of a part in one round: with up to 2000 processes their sum fits into 32 bits.
const ROUND: usize = 1 << 20;

/// Lengths and starts of parts that follow each other.
fn layout(lengths: impl Iterator<Item = usize>) -> (Vec<i32>, Vec<i32>) {
    let mut end = 0;
    lengths
        .map(|length| {
            let length = length as i32;
            end += length;
            (length, end - length)
        })
        .unzip()
}
