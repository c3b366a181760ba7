//! The arrays of a method and their memory.
//!
//! A constructor requests its arrays from a [`Space`]. One kind of space allocates them in a place. The other kind, a
//! tally, returns empty arrays and adds up their bytes: the same code allocates and estimates memory.

use crate::error::Result;
use crate::place::{Array, Host, Place, Slab};
use crate::scan::ScanHeader;
use std::cell::Cell;
use std::sync::Arc;

/// Allocates arrays for a scan of known size, or only counts their bytes.
pub struct Space {
    header: ScanHeader,
    place: Arc<dyn Place>,
    tally: bool,
    /// The slab whose arrays it allocates: planes of the whole, and the first one.
    slab: Option<[usize; 2]>,
    /// Bytes currently held.
    held: Cell<u64>,
    /// Peak of the bytes held.
    most: Cell<u64>,
}

impl Space {
    /// A space that allocates in `place`.
    pub fn new(header: ScanHeader, place: Arc<dyn Place>) -> Self {
        Self { header, place, tally: false, slab: None, held: Cell::new(0), most: Cell::new(0) }
    }

    /// A space that returns empty arrays and counts the bytes they would take.
    pub fn tally(header: ScanHeader) -> Self {
        Self { tally: true, ..Self::new(header, Arc::new(Host)) }
    }

    /// A space for arrays in the shape of a slab, where this process keeps its planes.
    pub fn within(&self, slab: &Slab) -> Self {
        Self { slab: Some([slab.whole, slab.planes.start]), ..Self::new(self.header, slab.here.clone()) }
    }

    /// Whether it only counts: its arrays are empty.
    pub fn is_tally(&self) -> bool {
        self.tally
    }

    /// Where its arrays live.
    pub fn place(&self) -> &Arc<dyn Place> {
        &self.place
    }

    /// The sizes of the scan.
    pub fn header(&self) -> &ScanHeader {
        &self.header
    }

    /// A zero for each voxel.
    pub fn volume(&self) -> Result<Array> {
        self.array(self.header.volume)
    }

    /// A zero for each pixel of `views` views.
    pub fn projections(&self, views: usize) -> Result<Array> {
        let [rows, columns] = self.header.detector;
        self.array([views, rows, columns])
    }

    /// Zeros.
    pub fn array(&self, shape: [usize; 3]) -> Result<Array> {
        self.hold(shape.iter().fold(size_of::<f32>() as u64, |n, side| n.saturating_mul(*side as u64)));
        if self.tally {
            return Host.zeros([0; 3]);
        }
        let array = self.place.zeros(shape)?;
        Ok(match self.slab {
            None => array,
            Some([whole, first]) => Array::part([whole, shape[1], shape[2]], first, array),
        })
    }

    /// Zeros in the host's memory, for a stage that works there wherever the arrays are.
    pub fn on_host(&self, count: usize) -> Vec<f32> {
        self.hold((count as u64).saturating_mul(size_of::<f32>() as u64));
        vec![0.0; if self.tally { 0 } else { count }]
    }

    /// Counts bytes held from now on.
    pub fn hold(&self, bytes: u64) {
        let held = self.held.get().saturating_add(bytes);
        self.held.set(held);
        self.most.set(self.most.get().max(held));
    }

    /// Counts bytes held temporarily.
    pub fn pass(&self, bytes: u64) {
        self.briefly(|space| space.hold(bytes));
    }

    /// Counts the memory of `make` as released when it returns.
    pub fn briefly<T>(&self, make: impl FnOnce(&Self) -> T) -> T {
        let held = self.held.get();
        let made = make(self);
        self.held.set(held);
        made
    }

    /// Peak of the bytes held.
    pub fn bytes(&self) -> u64 {
        self.most.get()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: ScanHeader = ScanHeader { views: 7, detector: [3, 5], volume: [2, 3, 4] };

    #[test]
    fn both_kinds_count_the_same() {
        for space in [Space::new(HEADER, Arc::new(Host)), Space::tally(HEADER)] {
            let volume = space.volume().unwrap();
            assert_eq!(space.bytes(), 96);
            let views = space.briefly(|space| space.projections(2)).unwrap();
            assert_eq!(space.bytes(), 96 + 120);
            space.pass(10);
            assert_eq!(space.bytes(), 96 + 120);
            space.hold(100);
            space.pass(30);
            assert_eq!(space.bytes(), 96 + 100 + 30);
            let made = [volume.len(), views.len()];
            assert_eq!(made, if space.tally { [0, 0] } else { [24, 30] });
        }
    }

    #[test]
    fn sizes_beyond_any_memory_are_counted_without_overflow() {
        let space = Space::tally(ScanHeader { volume: [usize::MAX; 3], ..HEADER });
        space.volume().unwrap();
        space.volume().unwrap();
        assert_eq!(space.bytes(), u64::MAX);
    }
}
