//! Threads that share the arrays of a method; see [`super::Ranks`].

use super::Peers;
use crate::error::Result;
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;

/// What threads send to each other.
pub struct Threads {
    /// What each sends to each.
    sent: Vec<Mutex<Vec<Vec<f32>>>>,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// Threads that wait for the others.
    waiting: usize,
    /// How often all have met.
    met: u64,
    /// Whether a thread has failed, and will not come.
    failed: bool,
}

/// What a thread unwinds with when another one has failed.
struct Left;

fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Threads {
    /// Connects `count` threads.
    pub fn new(count: usize) -> Arc<Self> {
        let sent = (0..count).map(|_| Mutex::default()).collect();
        Arc::new(Self { sent, state: Mutex::default(), changed: Condvar::new() })
    }

    /// The peers of each thread.
    pub fn peers(self: &Arc<Self>) -> impl Iterator<Item = Arc<dyn Peers>> {
        (0..self.sent.len()).map(|rank| Arc::new(Thread { rank, threads: self.clone() }) as Arc<dyn Peers>)
    }

    /// Runs `lead` here as rank 0, and `follow` in a thread for each other rank. Returns their results in order.
    ///
    /// # Errors
    /// The first one by rank. Nobody waits for a rank that fails or panics: the others end too, and the panic goes on here.
    pub fn run<T: Send>(
        &self,
        lead: impl FnOnce() -> Result<T>,
        follow: impl Fn(usize) -> Result<T> + Sync,
    ) -> Result<Vec<T>> {
        // An earlier run may have failed.
        *lock(&self.state) = State::default();
        let follow = |rank| self.until_the_end(|| follow(rank));
        let ends = thread::scope(|scope| {
            let follow = &follow;
            let followers: Vec<_> = (1..self.sent.len()).map(|rank| scope.spawn(move || follow(rank))).collect();
            let led = self.until_the_end(lead);
            let followed = followers.into_iter().map(|thread| thread.join().unwrap_or_else(Err));
            [led].into_iter().chain(followed).collect::<Vec<_>>()
        });
        // A thread that the others have left says nothing about why.
        let (left, ends): (Vec<_>, Vec<_>) =
            ends.into_iter().partition(|end| end.as_ref().is_err_and(|panic| panic.is::<Left>()));
        let made = ends.into_iter().map(|end| end.unwrap_or_else(|panic| resume_unwind(panic)));
        let made = made.collect::<Result<Vec<_>>>()?;
        assert!(left.is_empty(), "a thread is left only by one that fails");
        Ok(made)
    }

    /// Does the work of a thread. If it fails, the others do not wait for it.
    fn until_the_end<T>(&self, work: impl FnOnce() -> Result<T>) -> Result<Result<T>, Box<dyn Any + Send>> {
        let end = catch_unwind(AssertUnwindSafe(work));
        if !matches!(end, Ok(Ok(_))) {
            lock(&self.state).failed = true;
            self.changed.notify_all();
        }
        end
    }

    /// Waits for all threads.
    fn meet(&self) {
        let mut state = lock(&self.state);
        let met = state.met;
        state.waiting += 1;
        if state.waiting == self.sent.len() {
            state.waiting = 0;
            state.met += 1;
            self.changed.notify_all();
            return;
        }
        while state.met == met && !state.failed {
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        if state.met == met {
            drop(state);
            resume_unwind(Box::new(Left));
        }
    }
}

/// One of the threads.
struct Thread {
    rank: usize,
    threads: Arc<Threads>,
}

impl Peers for Thread {
    fn rank(&self) -> usize {
        self.rank
    }

    fn count(&self) -> usize {
        self.threads.sent.len()
    }

    fn exchange(&self, out: &[Vec<f32>], into: &mut [Vec<f32>]) {
        *lock(&self.threads.sent[self.rank]) = out.to_vec();
        self.threads.meet();
        for (from, into) in self.threads.sent.iter().zip(into) {
            into.copy_from_slice(&lock(from)[self.rank]);
        }
        self.threads.meet();
        lock(&self.threads.sent[self.rank]).clear();
    }
}
