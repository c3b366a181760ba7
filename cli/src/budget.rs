//! Planning a run for the time there is: which method (from a [`front`] that was measured), and when its training must
//! end so that the whole command takes that time on this machine ([`calibrate`] measures it).

pub mod calibrate;
pub mod front;
pub mod plan;

/// How a refusal begins where the time is too short for anything: such a run says nothing of its method.
pub const TOO_SHORT: &str = "the budget: ";
