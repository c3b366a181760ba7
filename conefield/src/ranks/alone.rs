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
    match std::env::var("OMPI_COMM_WORLD_SIZE") {
        Ok(count) if count != "1" => {
            let what = format!("{count} processes: this program is built without conefield's feature `mpi`");
            Err(Error::unsupported("mpirun", what))
        }
        _ => Ok(None),
    }
}
