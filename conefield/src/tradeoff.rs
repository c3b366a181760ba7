//! The trade-off between time, memory and accuracy: planning a run for the available time, and searching for the best
//! methods.
//!
//! - [`front`]: Pareto-optimal methods with their cost and accuracy; [`calibrate`] measures the cost of a method on
//!   this machine; [`schedule`] chooses a method and sets the end of its training, so that the whole command stays
//!   within its time.
//! - `levers`: the settings to vary, and the resulting candidates; `search` tries them by `halving`; a `trial`
//!   is a whole run; `report` writes the result: the front from `pareto`.
//! - [`statistics`] and [`json`] are helpers.
//!
//! The caller runs the trials and decides when to end. A search needs the feature `plots`, because its report has them.

pub mod calibrate;
pub mod front;
#[cfg(feature = "plots")]
pub mod halving;
pub mod json;
#[cfg(feature = "plots")]
pub mod levers;
#[cfg(feature = "plots")]
pub mod pareto;
#[cfg(feature = "plots")]
pub mod report;
pub mod schedule;
#[cfg(feature = "plots")]
pub mod search;
pub mod speed;
pub mod statistics;
#[cfg(feature = "plots")]
pub mod trial;

#[cfg(all(test, feature = "plots"))]
mod tests;
