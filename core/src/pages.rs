//! Memory for parameters: slices of numbers on huge pages if the system has them.
//!
//! Hash tables are read at random addresses. On pages of 4 KiB most reads miss the translation lookaside buffer (TLB),
//! and a step takes about twice as long.

use crate::parallel;
use bytemuck::Pod;
use memmap2::MmapMut;
use std::ops::{Deref, DerefMut};

/// Smaller slices use plain pages.
const WORTH_IT: usize = 1 << 21;

/// Numbers per task of a copy.
const PART: usize = 1 << 18;

/// Copies `from` to `to`, of the same length, on all threads.
pub fn copy<T: Pod + Send + Sync>(to: &mut [T], from: &[T]) {
    debug_assert_eq!(to.len(), from.len());
    parallel::over(to.chunks_mut(PART).zip(from.chunks(PART)), |_, (to, from)| to.copy_from_slice(from));
}

/// A slice of numbers of fixed length, initially zero.
pub struct Pages<T: Pod = f32>(Storage<T>);

enum Storage<T> {
    Small(Vec<T>),
    Mapped { map: MmapMut, len: usize },
}

impl<T: Pod> Pages<T> {
    /// `len` zeros.
    pub fn zeros(len: usize) -> Self {
        let bytes = len * size_of::<T>();
        if bytes >= WORTH_IT
            && let Ok(map) = MmapMut::map_anon(bytes)
        {
            // Only advice: without huge pages everything works, but slower.
            #[cfg(target_os = "linux")]
            let _ = map.advise(memmap2::Advice::HugePage);
            return Self(Storage::Mapped { map, len });
        }
        Self(Storage::Small(vec![T::zeroed(); len]))
    }
}

impl<T: Pod> Deref for Pages<T> {
    type Target = [T];
    fn deref(&self) -> &[T] {
        match &self.0 {
            Storage::Small(v) => v,
            Storage::Mapped { map, len } => &bytemuck::cast_slice(map)[..*len],
        }
    }
}

impl<T: Pod> DerefMut for Pages<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        match &mut self.0 {
            Storage::Small(v) => v,
            Storage::Mapped { map, len } => &mut bytemuck::cast_slice_mut(map)[..*len],
        }
    }
}

impl<T: Pod> Default for Pages<T> {
    fn default() -> Self {
        Self::zeros(0)
    }
}

impl<T: Pod + Send + Sync> Clone for Pages<T> {
    fn clone(&self) -> Self {
        let mut new = Self::zeros(self.len());
        copy(&mut new, self);
        new
    }
}

impl<T: Pod> FromIterator<T> for Pages<T> {
    fn from_iter<I: IntoIterator<Item = T>>(iter: I) -> Self {
        let v: Vec<T> = iter.into_iter().collect();
        let mut new = Self::zeros(v.len());
        new.copy_from_slice(&v);
        new
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_and_mapped_slices_behave_alike() {
        for len in [0, 5, 3 << 20] {
            let mut p: Pages = Pages::zeros(len);
            assert_eq!(p.len(), len);
            assert!(p.iter().all(|&x| x == 0.0));
            if len > 0 {
                p[len - 1] = 2.0;
                assert_eq!(p.clone()[len - 1], 2.0);
            }
        }
    }
}
