//! Without the feature `mpi` a run has one process.

use conefield_core::{Error, Result};

/// The connection to the other processes, which a program without the feature `mpi` never has.
pub enum Joined {}

impl Joined {
    /// Ends the other processes with this one.
    pub fn abandon(self) {
        match self {}
    }
}

/// Refuses to be one of several processes, each of which would do all the work.
///
/// # Errors
/// `mpirun` has started several.
pub fn start() -> Result<Option<Joined>> {
    // Slurm sets the number of tasks also for a script; a rank tells that `srun --mpi` has started this process.
    let ranked = ["PMI_RANK", "PMIX_RANK"].iter().any(|name| std::env::var_os(name).is_some());
    let counts = ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE"].into_iter().chain(ranked.then_some("SLURM_NTASKS"));
    match counts.filter_map(|name| std::env::var(name).ok()).find(|count| count != "1") {
        Some(count) => {
            let what = format!("{count} processes: this program is built without conefield's feature `mpi`");
            Err(Error::unsupported("mpirun", what))
        }
        None => Ok(None),
    }
}
