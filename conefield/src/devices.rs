//! Several devices for one run. Each has a thread, which runs the method on its part of every array; see
//! [`conefield_core::place::Ranks`].

use conefield_core::backend::{Backend, Executable, Explain};
use conefield_core::pipeline::Pipeline;
use conefield_core::place::{Moved, Peers, Place, Ranks};
use conefield_core::{Error, Result};
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;

/// A backend among several that share the arrays of a method.
pub(crate) struct Member {
    pub(crate) device: Box<dyn Backend>,
    pub(crate) place: Arc<Ranks>,
}

/// The backend of several devices: the first one leads.
struct Devices {
    members: Vec<Member>,
    post: Arc<Post>,
}

/// The backend of `devices`, which share the arrays of a method. A field is trained by one device only.
pub fn join(devices: Vec<Box<dyn Backend>>) -> Box<dyn Backend> {
    let sent = devices.iter().map(|_| Mutex::default()).collect();
    let post = Arc::new(Post { sent, state: Mutex::default(), changed: Condvar::new() });
    let member = |(rank, device): (usize, Box<dyn Backend>)| {
        let peers = Arc::new(Thread { rank, post: post.clone() });
        let place = Arc::new(Ranks::new(peers, device.place()));
        Member { device, place }
    };
    Box::new(Devices { members: devices.into_iter().enumerate().map(member).collect(), post: post.clone() })
}

impl Backend for Member {
    fn name(&self) -> &'static str {
        self.device.name()
    }

    fn compile(&self, _: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        Err(Error::unsupported("method", "several processes or devices: a field is trained by one"))
    }

    fn place(&self) -> Arc<dyn Place> {
        self.place.clone()
    }

    fn moved(&self) -> Moved {
        self.device.moved()
    }
}

impl Backend for Devices {
    fn name(&self) -> &'static str {
        self.members[0].name()
    }

    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        self.members[0].compile(pipeline)
    }

    fn place(&self) -> Arc<dyn Place> {
        self.members[0].place()
    }

    fn moved(&self) -> Moved {
        self.members.iter().fold(Moved::default(), |sum, member| {
            let Moved { to_device, from_device } = member.moved();
            Moved { to_device: sum.to_device + to_device, from_device: sum.from_device + from_device }
        })
    }

    fn run(
        &self,
        lead: &mut dyn FnMut() -> Result<()>,
        follow: &(dyn Fn(&dyn Backend) -> Result<()> + Sync),
    ) -> Result<()> {
        // An earlier run may have failed.
        *lock(&self.post.state) = State::default();
        let ends = thread::scope(|scope| {
            let others = self.members[1..].iter();
            let followers: Vec<_> =
                others.map(|other| scope.spawn(|| self.post.until_the_end(|| follow(other)))).collect();
            let led = self.post.until_the_end(lead);
            let followed = followers.into_iter().map(|thread| thread.join().unwrap_or_else(Err));
            [led].into_iter().chain(followed).collect::<Vec<_>>()
        });
        // A thread that the others have left says nothing about why.
        let (left, reasons): (Vec<_>, Vec<_>) =
            ends.into_iter().partition(|end| end.as_ref().is_err_and(|panic| panic.is::<Left>()));
        for reason in reasons {
            reason.unwrap_or_else(|panic| resume_unwind(panic))?;
        }
        assert!(left.is_empty(), "a thread is left only by one that fails");
        Ok(())
    }
}

/// What a thread unwinds with when another one has ended.
struct Left;

/// What threads send to each other.
struct Post {
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

fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Post {
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

    /// Does the work of a thread. If it fails, the others do not wait for it.
    fn until_the_end(&self, work: impl FnOnce() -> Result<()>) -> Result<Result<()>, Box<dyn Any + Send>> {
        let end = catch_unwind(AssertUnwindSafe(work));
        if !matches!(end, Ok(Ok(()))) {
            lock(&self.state).failed = true;
            self.changed.notify_all();
        }
        end
    }
}

/// A thread among those of a [`Post`].
struct Thread {
    rank: usize,
    post: Arc<Post>,
}

impl Peers for Thread {
    fn rank(&self) -> usize {
        self.rank
    }

    fn count(&self) -> usize {
        self.post.sent.len()
    }

    fn exchange(&self, out: &[Vec<f32>], into: &mut [Vec<f32>]) {
        *lock(&self.post.sent[self.rank]) = out.to_vec();
        self.post.meet();
        for (from, into) in self.post.sent.iter().zip(into) {
            into.copy_from_slice(&lock(from)[self.rank]);
        }
        self.post.meet();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_backend_cpu::Cpu;
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn three() -> Box<dyn Backend> {
        join((0..3).map(|_| Box::new(Cpu::new()) as Box<dyn Backend>).collect())
    }

    #[test]
    fn all_members_run_and_agree() {
        let (backend, agreed) = (three(), AtomicUsize::new(0));
        let meet = |backend: &dyn Backend, flag: bool| {
            agreed.fetch_add(usize::from(backend.place().agree(flag)), Ordering::Relaxed);
            Ok(())
        };
        backend.run(&mut || meet(backend.as_ref(), true), &|other| meet(other, false)).unwrap();
        assert_eq!(agreed.into_inner(), 3);
    }

    #[test]
    fn the_failure_of_one_ends_all() {
        let backend = three();
        let wait = |backend: &dyn Backend| {
            while !backend.place().agree(false) {}
            Ok(())
        };
        let count = AtomicUsize::new(0);
        let one_fails = |other: &dyn Backend| {
            if count.fetch_add(1, Ordering::Relaxed) == 1 {
                return Err(Error::unsupported("device", "out of memory"));
            }
            wait(other)
        };
        let e = backend.run(&mut || wait(backend.as_ref()), &one_fails).unwrap_err().to_string();
        assert!(e.contains("out of memory"), "{e}");
        let meet = |backend: &dyn Backend| {
            backend.place().agree(false);
            Ok(())
        };
        backend.run(&mut || meet(backend.as_ref()), &meet).expect("the next run can succeed");
    }

    #[test]
    fn a_panic_reaches_the_caller() {
        let backend = three();
        let panics = |_: &dyn Backend| -> Result<()> { resume_unwind(Box::new("lost")) };
        let run = || {
            backend.run(
                &mut || {
                    while !backend.place().agree(false) {}
                    Ok(())
                },
                &panics,
            )
        };
        let panic = catch_unwind(AssertUnwindSafe(run)).unwrap_err();
        assert_eq!(panic.downcast_ref::<&str>(), Some(&"lost"));
    }
}
