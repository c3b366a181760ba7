//! Bins of Gaussians by the part of the computation that they reach.

/// Lists of Gaussians, one per bin, each in the Gaussians' order. Reused to keep their memory.
#[derive(Debug, Default)]
pub struct Lists {
    all: Vec<u32>,
    starts: Vec<usize>,
}

impl Lists {
    /// Rebuilds `bins` lists: `visit(i, put)` puts Gaussian `i` of `count` into its bins.
    pub fn fill(&mut self, bins: usize, count: usize, visit: impl Fn(usize, &mut dyn FnMut(usize))) {
        let Self { all, starts } = self;
        starts.clear();
        starts.resize(bins + 1, 0);
        (0..count).for_each(|i| visit(i, &mut |bin| starts[bin + 1] += 1));
        for bin in 0..bins {
            starts[bin + 1] += starts[bin];
        }
        all.resize(starts[bins], 0);
        // Each start advances to its list's end, which is where the next list began.
        (0..count).for_each(|i| {
            visit(i, &mut |bin| {
                all[starts[bin]] = i as u32;
                starts[bin] += 1;
            });
        });
        starts.rotate_right(1);
        starts[0] = 0;
    }

    /// The list of a bin.
    pub fn of(&self, bin: usize) -> &[u32] {
        &self.all[self.starts[bin]..self.starts[bin + 1]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_hold_what_was_put_into_them_in_order() {
        let mut lists = Lists::default();
        for _ in 0..2 {
            lists.fill(4, 6, |i, put| (i % 3..i.min(4)).for_each(put));
            let found: Vec<&[u32]> = (0..4).map(|bin| lists.of(bin)).collect();
            assert_eq!(found, [&[3][..], &[3, 4], &[3, 4, 5], &[4, 5]]);
        }
    }
}
