//! Loops over all threads, compiled once.
//!
//! A parallel iterator of `rayon` is compiled anew for every closure, as some 3000 to 6000 lines of LLVM's language. Loops
//! over chunks that take microseconds or more use these functions; loops over single numbers use `rayon`.

use rayon::prelude::*;
use std::sync::{Mutex, PoisonError};

/// Calls `work` for every number below `count`.
#[inline(never)]
pub fn each(count: usize, work: &(dyn Fn(usize) + Sync)) {
    (0..count).into_par_iter().for_each(work);
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
    let items: Vec<T> = items.into_iter().collect();
    let mut results: Vec<Option<U>> = items.iter().map(|_| None).collect();
    over(items.into_iter().zip(&mut results), |n, (item, result)| *result = Some(work(n, item)));
    let done = |result: Option<U>| result.unwrap_or_else(|| unreachable!("every item is worked on"));
    results.into_iter().map(done).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let done = std::panic::catch_unwind(|| over(0..10, |_, x| assert!(x != 5, "five")));
        assert_eq!(done.unwrap_err().downcast_ref::<&str>(), Some(&"five"));
    }
}
