//! Trial runs of stages before real work: on a few rows, between guard zones, under a time limit. A stage is refused if
//! it writes outside its tile, leaves outputs unwritten, returns non-finite numbers, fails or hangs. Only the
//! conformance kit checks gradients.

use crate::library::Type;
use bytemuck::Pod;
use conefield_core::pages::Pages;
use conefield_core::prelude::*;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

/// Time limit of a trial.
pub const LIMIT: Duration = Duration::from_secs(5);

/// Guard numbers on either side of a buffer: more than a tile of the widest common stages.
pub(crate) const GUARD: usize = 1 << 14;

/// Numbers with a marker of what is unwritten: a NaN that no arithmetic produces.
pub(crate) trait Marked: Real + Pod {
    const MARK: Self;

    fn is_mark(self) -> bool {
        bytemuck::bytes_of(&self) == bytemuck::bytes_of(&Self::MARK)
    }
}

impl Marked for f32 {
    const MARK: Self = Self::from_bits(0x7fc5_a7e1);
}

impl Marked for f64 {
    const MARK: Self = Self::from_bits(0x7ff8_5a7e_1c5a_7e1c);
}

/// A buffer between guard zones. Zeroed pages take no memory until written: a trial runs before the memory check.
pub(crate) struct Guarded<R: Marked>(Pages<R>);

impl<R: Marked> Guarded<R> {
    pub fn new(n: usize) -> Self {
        let mut g = Self::zeroed(n);
        g.inner().fill(R::MARK);
        g
    }

    /// A buffer with a copy of these numbers.
    pub fn of(values: &[R]) -> Self {
        let mut g = Self::zeroed(values.len());
        g.inner().copy_from_slice(values);
        g
    }

    pub fn inner(&mut self) -> &mut [R] {
        let n = self.0.len();
        &mut self.0[GUARD..n - GUARD]
    }

    pub fn zeroed(n: usize) -> Self {
        let mut pages = Pages::zeros(n + 2 * GUARD);
        for zone in [0..GUARD, GUARD + n..n + 2 * GUARD] {
            pages[zone].fill(R::MARK);
        }
        Self(pages)
    }

    /// Describes damage to the guard zones.
    pub fn broken(&self, what: &str) -> Option<String> {
        let n = self.0.len();
        let outside = (0..GUARD).chain(n - GUARD..n);
        let at = outside.into_iter().find(|&i| !self.0[i].is_mark())?;
        let place =
            if at < GUARD { format!("{} before", GUARD - at) } else { format!("{} past", at - (n - GUARD) + 1) };
        Some(format!("it writes outside its {what}: {place} {} numbers", n - 2 * GUARD))
    }

    /// Describes errors in the written numbers.
    pub fn unsound(&mut self, what: &str) -> Option<String> {
        let n = self.inner().len();
        let (i, v) = self.inner().iter().enumerate().find(|(_, v)| !v.f64().is_finite())?;
        let how = if v.is_mark() { "is left unwritten".into() } else { format!("is {}", v.f64()) };
        Some(format!("number {i} of {n} of its {what} {how}"))
    }

    /// Describes damage to the guard zones or errors in the written numbers.
    pub fn complaint(&mut self, what: &str) -> Option<String> {
        self.broken(what).or_else(|| self.unsound(what))
    }
}

/// Runs a library's constructor under the time limit, on a thread of its own, which is abandoned if it hangs.
pub(crate) fn timed<T: Send + 'static>(ty: &Type, make: impl FnOnce() -> Result<T> + Send + 'static) -> Result<T> {
    let (done, wait) = mpsc::channel();
    thread::spawn(move || {
        // The receiver is gone after a timeout.
        let _ = done.send(make());
    });
    wait.recv_timeout(LIMIT).unwrap_or_else(|e| {
        let what = match e {
            mpsc::RecvTimeoutError::Timeout => format!("it did not return within {} s", LIMIT.as_secs()),
            mpsc::RecvTimeoutError::Disconnected => "it ended its thread".into(),
        };
        Err(refused(ty, &what))
    })
}

fn refused(ty: &Type, what: &str) -> Error {
    Error::unsupported(ty.words(), format!("refused: {what}"))
}

/// Returns the complaint as an error, if there is one.
pub(crate) fn settled(ty: &Type, complaint: Option<String>) -> Result<()> {
    complaint.map_or(Ok(()), |complaint| Err(refused(ty, &complaint)))
}

/// `n` random numbers in [0, 1).
pub(crate) fn drawn(n: usize) -> impl Iterator<Item = f32> {
    (0..n).map(|i| unit(mix(5, i as u64)))
}

/// Describes a number that should be finite and non-negative but is not.
pub(crate) fn below_zero(what: &str, value: f64) -> Option<String> {
    (!(value.is_finite() && value >= 0.0)).then(|| format!("{what} is {value}"))
}
