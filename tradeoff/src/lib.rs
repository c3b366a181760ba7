//! The trade-off between time, memory and accuracy: planning a run for the available time, and searching for the best
//! methods.
//!
//! - [`front`]: Pareto-optimal methods with their cost and accuracy; [`calibrate`] measures the cost of a method on
//!   this machine; [`schedule`] chooses a method and sets the end of its training, so that the whole command stays
//!   within its time.
//! - [`levers`]: the settings to vary, and the resulting candidates; [`search`] tries them by [`halving`]; a [`trial`]
//!   is a whole run; [`report`] writes the result: the front from [`pareto`].
//! - [`statistics`] and [`json`] are helpers.
//!
//! This crate knows neither the command line nor how to start a run: the caller supplies the specs, runs the trials and
//! decides when to end.

pub mod calibrate;
pub mod front;
pub mod halving;
pub mod json;
pub mod levers;
pub mod pareto;
pub mod report;
pub mod schedule;
pub mod search;
pub mod speed;
pub mod statistics;
pub mod trial;
