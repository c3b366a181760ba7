//! Adapts the size of launches to the time that earlier launches took.

/// Launches grow if they take less than the first time, and shrink if they take more than the second. A watchdog may end
/// launches after half a second.
const SECONDS: [f64; 2] = [0.06, 0.25];

/// The size of launches: rows, rays or voxels.
#[derive(Debug, Clone, Copy)]
pub struct Pace {
    size: u32,
    least: u32,
    most: u32,
}

impl Pace {
    /// Starts with `first`, and stays between `least` and `most`.
    pub fn new(first: u32, least: u32, most: u32) -> Self {
        Self { size: first, least, most }
    }

    /// The maximum size of a launch now.
    pub fn size(&self) -> u32 {
        self.size
    }

    /// Takes note that `launches`, the largest of size `largest`, took `seconds`.
    pub fn heard(&mut self, seconds: f64, launches: usize, largest: u32) {
        let each = seconds / launches.max(1) as f64;
        if each > SECONDS[1] && self.size > self.least {
            self.size /= 2;
        } else if each < SECONDS[0] && largest > self.size / 2 && self.size < self.most {
            self.size = self.size.saturating_mul(2).min(self.most);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slow_launches_become_smaller_and_fast_full_ones_larger() {
        let mut pace = Pace::new(1 << 14, 1 << 12, 1 << 15);
        pace.heard(1.0, 2, 1 << 14);
        assert_eq!(pace.size(), 1 << 13);
        (0..5).for_each(|_| pace.heard(1.0, 1, 1 << 13));
        assert_eq!(pace.size(), 1 << 12);
        // A launch that was not full says little.
        pace.heard(0.01, 1, 100);
        assert_eq!(pace.size(), 1 << 12);
        (0..9).for_each(|_| pace.heard(0.01, 1, pace.size()));
        assert_eq!(pace.size(), 1 << 15);
        let mut pace = Pace::new(1000, 1000, 1500);
        pace.heard(0.01, 1, 1000);
        assert_eq!(pace.size(), 1500);
    }
}
