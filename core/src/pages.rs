//! Memory for parameters: a slice of `f32` on huge pages where the system has them.
//!
//! Hash tables are read at random all over. On pages of 4 KiB most of those reads miss the processor's address
//! cache, and a step takes about twice as long.

use memmap2::MmapMut;
use std::fmt;
use std::ops::{Deref, DerefMut};

/// Below this a plain page does.
const WORTH_IT: usize = 1 << 21;

/// A fixed number of `f32`, zero at first.
pub struct Pages(Storage);

enum Storage {
    Small(Vec<f32>),
    Mapped { map: MmapMut, len: usize },
}

impl Pages {
    /// `len` zeros.
    pub fn zeros(len: usize) -> Self {
        if len * 4 >= WORTH_IT
            && let Ok(map) = MmapMut::map_anon(len * 4)
        {
            // Only advice: without huge pages everything works, slower.
            #[cfg(target_os = "linux")]
            let _ = map.advise(memmap2::Advice::HugePage);
            return Self(Storage::Mapped { map, len });
        }
        Self(Storage::Small(vec![0.0; len]))
    }
}

impl Deref for Pages {
    type Target = [f32];
    fn deref(&self) -> &[f32] {
        match &self.0 {
            Storage::Small(v) => v,
            Storage::Mapped { map, len } => &bytemuck::cast_slice(map)[..*len],
        }
    }
}

impl DerefMut for Pages {
    fn deref_mut(&mut self) -> &mut [f32] {
        match &mut self.0 {
            Storage::Small(v) => v,
            Storage::Mapped { map, len } => &mut bytemuck::cast_slice_mut(map)[..*len],
        }
    }
}

impl Default for Pages {
    fn default() -> Self {
        Self::zeros(0)
    }
}

impl Clone for Pages {
    fn clone(&self) -> Self {
        let mut new = Self::zeros(self.len());
        new.copy_from_slice(self);
        new
    }
}

impl PartialEq for Pages {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl fmt::Debug for Pages {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} numbers", self.len())
    }
}

impl FromIterator<f32> for Pages {
    fn from_iter<I: IntoIterator<Item = f32>>(iter: I) -> Self {
        let v: Vec<f32> = iter.into_iter().collect();
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
            let mut p = Pages::zeros(len);
            assert_eq!(p.len(), len);
            assert!(p.iter().all(|&x| x == 0.0));
            if len > 0 {
                p[len - 1] = 2.0;
                assert_eq!(p.clone()[len - 1], 2.0);
            }
        }
    }
}
