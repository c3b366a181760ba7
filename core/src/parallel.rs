//! Loops over all threads, compiled once.
//!
//! A parallel iterator of `rayon` is compiled anew for every closure, as some 3000 to 6000 lines of LLVM's language.
//! These loops also keep arrays on the disk within the memory limit: each item first gives pages back if the process
//! holds too many. So an item should touch a few megabytes at most.

use crate::allowance;
use ndarray::Array3;
use rayon::prelude::*;
use std::cell::RefCell;
use std::panic::resume_unwind;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Numbers per item of a loop over numbers.
const PART: usize = 1 << 16;

/// Interval at which a loop asks whether to stop.
const LOOK: Duration = Duration::from_millis(20);

/// Answers whether work must stop.
pub type Stop = Arc<dyn Fn() -> bool>;

thread_local! {
    static STOP: RefCell<Option<Stop>> = const { RefCell::new(None) };
}

/// Runs `work`, which ends early once `stop` answers true: a loop that this thread starts asks it, on this thread, begins
/// no more items, and then unwinds, and so does [`look`]. For hosts that learn of an interruption on their own thread only.
pub fn stoppable<T>(stop: Stop, work: impl FnOnce() -> T) -> T {
    struct Before(Option<Stop>);
    impl Drop for Before {
        fn drop(&mut self) {
            STOP.set(self.0.take());
        }
    }
    let _before = Before(STOP.replace(Some(stop)));
    work()
}

/// The question of [`stoppable`]. A thread of a pool has other work, too: it never waits.
fn stop() -> Option<Stop> {
    STOP.with_borrow(Option::clone).filter(|_| rayon::current_thread_index().is_none())
}

/// Ends the work of [`stoppable`] if it must stop. For long work outside loops.
pub fn look() {
    if stop().is_some_and(|stop| stop()) {
        resume_unwind(Box::new("stopped"));
    }
}

/// Calls `work` for every number below `count`.
#[inline(never)]
pub fn each(count: usize, work: &(dyn Fn(usize) + Sync)) {
    let stopped = AtomicBool::new(false);
    let all = || {
        (0..count).into_par_iter().for_each(|n| {
            if !stopped.load(Ordering::Relaxed) {
                allowance::trim();
                work(n);
            }
        });
    };
    let Some(stop) = stop() else { return all() };
    rayon::in_place_scope(|scope| {
        let (end, ended) = mpsc::channel::<()>();
        scope.spawn(|_| {
            let _end = end;
            all();
        });
        while ended.recv_timeout(LOOK) == Err(RecvTimeoutError::Timeout) {
            if stop() {
                stopped.store(true, Ordering::Relaxed);
            }
        }
    });
    if stopped.into_inner() {
        resume_unwind(Box::new("stopped"));
    }
}

/// Calls `work` for every item, with its number.
pub fn over<T: Send>(items: impl IntoIterator<Item = T>, work: impl Fn(usize, T) + Sync) {
    let items: Vec<_> = items.into_iter().map(|item| Mutex::new(Some(item))).collect();
    each(items.len(), &|n| {
        let item = items[n].lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(item) = item {
            work(n, item);
        }
    });
}

/// The result of `work` for every item, in order.
pub fn map<T: Send, U: Send>(items: impl IntoIterator<Item = T>, work: impl Fn(usize, T) -> U + Sync) -> Vec<U> {
    let cells: Vec<_> = items.into_iter().map(|item| Mutex::new((Some(item), None))).collect();
    each(cells.len(), &|n| {
        let mut cell = cells[n].lock().unwrap_or_else(PoisonError::into_inner);
        cell.1 = cell.0.take().map(|item| work(n, item));
    });
    let done = |cell: Mutex<(Option<T>, Option<U>)>| cell.into_inner().unwrap_or_else(PoisonError::into_inner).1;
    cells.into_iter().map(|cell| done(cell).unwrap_or_else(|| unreachable!("every item is worked on"))).collect()
}

/// Calls `work` with parts of `out` and the same parts of `with`, which have its length.
pub fn change<const N: usize>(out: &mut [f32], with: [&[f32]; N], work: impl Fn(&mut [f32], [&[f32]; N]) + Sync) {
    over(out.chunks_mut(PART), |n, out| {
        let with = with.map(|x| &x[n * PART..][..out.len()]);
        work(out, with);
    });
}

/// Replaces each number of `x` by `f` of it.
pub fn change_all(x: &mut Array3<f32>, f: impl Fn(f32) -> f32 + Sync) {
    match x.as_slice_memory_order_mut() {
        Some(x) => change(x, [], |x, []| x.iter_mut().for_each(|x| *x = f(*x))),
        None => x.mapv_inplace(f),
    }
}

/// Multiplies each number of `x` by `factor`.
pub fn scale(x: &mut Array3<f32>, factor: f32) {
    change_all(x, |x| x * factor);
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::panic::{AssertUnwindSafe, catch_unwind};
    use std::sync::atomic::AtomicUsize;
    use std::thread::{self, sleep};

    #[test]
    fn numbers_change_with_those_at_the_same_place() {
        let count = 3 * PART + 5;
        let numbers = |from: usize| (from..from + count).map(|i| i as f32).collect::<Vec<_>>();
        let mut out = numbers(0);
        change(&mut out, [&numbers(7), &numbers(1)], |x, [a, b]| {
            x.iter_mut().zip(a).zip(b).for_each(|((x, a), b)| *x += a - b);
        });
        assert!(out == numbers(6));
        let mut array = Array3::from_shape_fn((3, 4, 5), |(i, j, k)| (i * 20 + j * 5 + k) as f32).reversed_axes();
        let doubled = array.mapv(|x| 2.0 * x);
        change_all(&mut array, |x| 2.0 * x);
        assert_eq!(array, doubled);
    }

    #[test]
    fn every_item_comes_once_and_results_in_order() {
        let mut numbers = vec![0; 1000];
        over(numbers.chunks_mut(7), |n, part| part.iter_mut().for_each(|x| *x += n));
        assert!(numbers.iter().enumerate().all(|(i, x)| *x == i / 7));
        assert_eq!(map(0..100, |n, x| n + x), (0..100).map(|n| 2 * n).collect::<Vec<_>>());
        assert!(map([0; 0], |_, x| x).is_empty());
    }

    #[test]
    fn a_panic_reaches_the_caller() {
        for stop in [None, Some(Arc::new(|| false) as Stop)] {
            let five = || over(0..10, |_, x| assert!(x != 5, "five"));
            let done = catch_unwind(AssertUnwindSafe(|| match stop {
                Some(stop) => stoppable(stop, five),
                None => five(),
            }));
            assert_eq!(done.unwrap_err().downcast_ref::<&str>(), Some(&"five"));
        }
    }

    #[test]
    fn a_loop_that_must_stop_begins_no_more_items() {
        let done = AtomicUsize::new(0);
        let work = || {
            // A loop within a loop does not ask: its thread is one of the pool.
            each(500, &|_| {
                each(2, &|_| sleep(Duration::from_millis(1)));
                done.fetch_add(1, Ordering::Relaxed);
            });
            look();
        };
        stoppable(Arc::new(|| false), work);
        assert_eq!(done.swap(0, Ordering::Relaxed), 500);
        let here = thread::current().id();
        let stop = Arc::new(move || {
            assert_eq!(thread::current().id(), here);
            true
        });
        for work in [&work as &dyn Fn(), &look] {
            let ended = catch_unwind(AssertUnwindSafe(|| stoppable(stop.clone(), work)));
            assert_eq!(ended.unwrap_err().downcast_ref::<&str>(), Some(&"stopped"));
            assert!(done.load(Ordering::Relaxed) < 500);
        }
        // Nothing of it remains.
        work();
    }
}
