//! What time and memory buy: planning a run for the time there is, and searching for the methods that make the most of
//! it.
//!
//! - [`front`]: methods of which none is beaten, with what they took and reached; [`calibrate`] measures what one takes on
//!   this machine, and [`schedule`] chooses one and says when its training must end, so that the whole command takes the
//!   time that it has.
//! - [`statistics`]: means and correlations.

pub mod calibrate;
pub mod front;
pub mod schedule;
pub mod statistics;
