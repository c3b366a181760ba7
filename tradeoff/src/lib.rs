//! What time and memory buy: planning a run for the time there is, and searching for the methods that make the most of
//! it.
//!
//! - [`front`]: methods of which none is beaten, with what they took and reached; [`calibrate`] measures what one takes on
//!   this machine, and [`schedule`] chooses one and says when its training must end, so that the whole command takes the
//!   time that it has.
//! - [`levers`]: what may be turned, and the candidates that come of it; [`search`] tries them by [`halving`], a [`trial`]
//!   is a whole run, and [`report`] has the result: the front by [`pareto`].
//! - [`statistics`] and [`json`] serve the others.
//!
//! What goes on here knows neither a command line nor how a run is started: the caller brings the specs, runs the trials
//! and says when to end.

pub mod calibrate;
pub mod front;
pub mod halving;
pub mod json;
pub mod levers;
pub mod pareto;
pub mod report;
pub mod schedule;
pub mod search;
pub mod statistics;
pub mod trial;
