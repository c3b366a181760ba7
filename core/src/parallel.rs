//! Loops over all threads, compiled once.
//!
//! A parallel iterator of `rayon` is compiled anew for every closure, as some 3000 to 6000 lines of LLVM's language.
//! These loops also keep arrays on the disk within the memory limit: each item first gives pages back if the process
//! holds too many. So an item should touch a few megabytes at most.

use crate::allowance;
use ndarray::Array3;
use rayon::prelude::*;
use std::sync::{Mutex, PoisonError};

/// Numbers per item of a loop over numbers.
const PART: usize = 1 << 16;

/// Calls `work` for every number below `count`.
#[inline(never)]
pub fn each(count: usize, work: &(dyn Fn(usize) + Sync)) {
    (0..count).into_par_iter().for_each(|n| {
        allowance::trim();
        work(n);
    });
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
        let done = std::panic::catch_unwind(|| over(0..10, |_, x| assert!(x != 5, "five")));
        assert_eq!(done.unwrap_err().downcast_ref::<&str>(), Some(&"five"));
    }
}
