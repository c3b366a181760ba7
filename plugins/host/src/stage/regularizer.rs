//! Regularizers.

use super::*;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Maximum number of state values per coefficient.
const MOST_STATE: usize = 64;

settings! {
    regularizer RegularizerSpec(self) -> dyn Regularizer { self.build(0, RegularizerStage::tried) }
}

/// A regularizer from a library.
pub struct RegularizerStage(Foreign<ConefieldRegularizer>);

impl RegularizerStage {
    /// The regularizer of `handle`, after a trial.
    pub(crate) fn tried(handle: Handle) -> Result<Self> {
        let stage = Self(Foreign::new(handle)?);
        stage.weight(&SMALL, &mut |k| 0.01 * k)?;
        let mut penalty = stage.made_on(&SMALL)?;
        let mut v = Guarded::of(&drawn(penalty.count).map(|x| x - 0.3).collect::<Vec<f32>>());
        for _ in 0..2 {
            let mut u = Guarded::<f32>::new(penalty.count);
            penalty.try_prox(v.inner(), 0.1, u.inner())?;
            let value = penalty.try_value(v.inner())?;
            stage.0.settled(u.complaint("coefficients").or_else(|| v.broken("input")))?;
            stage.0.settled(below_zero("the penalty", value))?;
            let negative = u.inner().iter().find(|u| **u < 0.0).map(|u| format!("its proximal map gives {u}"));
            stage.0.settled(negative)?;
        }
        Ok(stage)
    }

    /// The penalty on a grid.
    fn made_on(&self, grid: &VoxelGrid) -> Result<PenaltyOn> {
        let own = self.0.derived("on", make!(self.0, on(&raw_grid(grid)))?)?;
        let mut made = PenaltyOn { own, count: grid.shape.iter().product(), state: vec![] };
        made.state = made.read_state()?;
        Ok(made)
    }
}

/// Callback for a library that queries the noise.
unsafe extern "C" fn noise(context: *mut c_void, k: f64) -> f64 {
    // SAFETY: `weight` passes it for the duration of its call.
    let measure = unsafe { &mut *context.cast::<&mut dyn FnMut(f64) -> f64>() };
    // Panics must not unwind into the library.
    catch_unwind(AssertUnwindSafe(|| measure(k))).unwrap_or(f64::NAN)
}

impl Regularizer for RegularizerStage {
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        // SAFETY: the stage is alive, the grid lives during the call.
        let bytes = self.0.functions.bytes.map_or(0, |f| unsafe { f(self.0.handle.stage, &raw_grid(grid)) });
        space.hold(bytes.min(MOST_BYTES));
        // A tally only counts bytes: nothing is built for the actual grid.
        let grid = if space.is_tally() { &SMALL } else { grid };
        Ok(Box::new(self.made_on(grid)?))
    }

    fn weight(&self, grid: &VoxelGrid, noise_of: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        let mut measure = noise_of;
        let context = ptr::from_mut(&mut measure).cast();
        let mut weight = f64::NAN;
        call!(self.0, weight(&raw_grid(grid), Some(noise), context, &mut weight))?;
        let good = weight.is_finite() && weight >= 0.0;
        ensure(good, &self.0.ty().words(), "weight", weight, "a finite number, 0 or more")?;
        Ok(weight)
    }

    said! { 0: describe }
}

/// A penalty that a library made for one grid.
struct PenaltyOn {
    own: Foreign<ConefieldRegularizer>,
    /// Number of coefficients of the grid.
    count: usize,
    /// Names and lengths of its state.
    state: Vec<(String, usize)>,
}

impl PenaltyOn {
    fn try_value(&self, x: &[f32]) -> Result<f64> {
        assert_eq!(x.len(), self.count, "the coefficients of its grid");
        let mut value = f64::NAN;
        call!(self.own, value(x.as_ptr(), x.len(), &mut value))?;
        Ok(value)
    }

    fn try_prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) -> Result<()> {
        assert_eq!([v.len(), u.len()], [self.count; 2], "the coefficients of its grid");
        call!(self.own, prox(v.as_ptr(), v.len(), tau, u.as_mut_ptr()))
    }

    /// Entry `index` of its state; `None` after the last.
    fn entry(&self, index: usize) -> Result<Option<ConefieldState>> {
        let Some(state) = self.own.functions.state else { return Ok(None) };
        let mut entry = ConefieldState { name: ConefieldStr::of(""), data: ptr::null_mut(), length: 0 };
        // SAFETY: the penalty is alive, `entry` is writable.
        let known = self.own.asked("state", |penalty, _| unsafe { state(penalty, index, &mut entry) })?;
        Ok(known.then_some(entry))
    }

    fn read_state(&self) -> Result<Vec<(String, usize)>> {
        let (mut all, mut names, mut numbers) = (vec![], BTreeSet::new(), 0usize);
        while let Some(entry) = self.entry(all.len())? {
            // SAFETY: the plugin guarantees that this many bytes are valid while the penalty lives.
            let name = unsafe { text(entry.name, &self.own.ty().words(), "state") }?;
            numbers = numbers.saturating_add(entry.length);
            let sane = !entry.data.is_null() && entry.length > 0 && numbers <= MOST_STATE * self.count.max(64);
            self.own.require(sane, "state", || format!("{name:?} has {} numbers", entry.length))?;
            let fresh = names.insert(name.clone());
            self.own.require(fresh, "state", || format!("two entries are called {name:?}"))?;
            all.push((name, entry.length));
        }
        Ok(all)
    }
}

impl Penalty for PenaltyOn {
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        let x = x.as_standard_layout();
        self.own.noted(self.try_value(x.as_slice().unwrap_or_default()), f64::NAN)
    }

    fn adapts(&self) -> bool {
        self.own.functions.adapt.is_some()
    }

    fn adapt(&mut self, x: ArrayView3<'_, f32>) -> Option<f64> {
        let adapt = self.own.functions.adapt?;
        let x = x.as_standard_layout();
        let x = x.as_slice().unwrap_or_default();
        let mut value = f64::NAN;
        // SAFETY: the penalty is alive; all arguments live during the call.
        let adapted =
            self.own.asked("adapt", |penalty, error| unsafe { adapt(penalty, x.as_ptr(), x.len(), &mut value, error) });
        self.own.noted(adapted.map(|known| known.then_some(value)), Some(f64::NAN))
    }

    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        let done = self.try_prox(v, tau, u);
        self.own.filled(done, u);
    }

    fn state(&mut self) -> Vec<(&str, StatePart<'_>)> {
        let part = |(i, (name, length)): (usize, &'_ (String, usize))| -> Result<_> {
            let found = self.entry(i)?.filter(|e| e.length == *length && !e.data.is_null());
            let found = found.ok_or_else(|| self.own.wrong("state", &format!("{name:?} changes")))?;
            // SAFETY: the plugin guarantees that this many numbers are valid while the penalty lives; entries do not
            // overlap.
            Ok((i, unsafe { slice::from_raw_parts_mut(found.data, *length) }))
        };
        let all: Result<Vec<_>> = self.state.iter().enumerate().map(part).collect();
        // Without one entry all are without meaning: the fault ends the run.
        let all = self.own.noted(all, vec![]);
        all.into_iter().map(|(i, numbers)| (self.state[i].0.as_str(), StatePart::Host(numbers))).collect()
    }

    said! { own: fault }
}
