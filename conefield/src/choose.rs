//! Choice of the method: the requested one or, for a time budget, one of a front.

use crate::method::Planned;
use crate::specs;
use crate::tradeoff::calibrate::Bench;
use crate::tradeoff::front::Front;
use crate::tradeoff::schedule::{Budget, Schedule};
use conefield_core::{Error, Result};
use tracing::info;

/// The user's request.
pub enum Wish {
    /// This method.
    Method(Planned),
    /// The best of this front for a budget.
    OneOf(Front),
}

/// Determines the method and its time limits. `held` are the held-out views; `build` builds a method of the front from
/// a spec and settings.
pub fn choose(
    wish: Wish,
    bench: &Bench<'_>,
    budget: Option<Budget>,
    held: &[usize],
    build: impl Fn(&str, &[String]) -> Result<Planned>,
) -> Result<(Planned, Option<Schedule>)> {
    let (method, schedule) = match (budget, wish) {
        (None, Wish::Method(method)) => (method, None),
        (Some(budget), Wish::Method(mut method)) => {
            let schedule = budget.plan(bench, &mut method)?;
            (method, Some(schedule))
        }
        (Some(budget), Wish::OneOf(front)) => {
            let (method, schedule) = budget.choose(bench, &front, build)?;
            (method, Some(schedule))
        }
        (None, Wish::OneOf(_)) => {
            return Err(Error::invalid("reconstruct", "--spec", "nothing", "a spec, or --budget to choose one by"));
        }
    };
    specs::check_held_out(&method.loaded, method.plan.as_ref(), held)?;
    schedule.iter().flat_map(|s| s.lines(&method.loaded.spec.name)).for_each(|line| info!("{line}"));
    info!("memory: {}", method.memory.line());
    Ok((method, schedule))
}
