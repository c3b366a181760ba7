//! Values of Gaussians at scattered points.

use super::grid::EXTENT;
use super::lists::Lists;
use super::shape::Shape;
use conefield_core::geometry::Vec3;

/// Cells per side of the unit cube.
const SIDE: usize = 48;

/// Lists, for each cell of the unit cube, the Gaussians that reach it.
pub struct Cells {
    lists: Lists,
}

fn cell(x: f64) -> usize {
    ((x * SIDE as f64).max(0.0) as usize).min(SIDE - 1)
}

impl Cells {
    /// Builds the lists for `shapes`.
    pub fn new(shapes: &[Shape]) -> Self {
        let mut lists = Lists::default();
        lists.fill(SIDE.pow(3), shapes.len(), |i, put| {
            let shape = &shapes[i];
            if shape.density == 0.0 {
                return;
            }
            let reach = shape.reach(EXTENT);
            let [xs, ys, zs]: [_; 3] =
                std::array::from_fn(|k| cell(shape.centre[k] - reach[k])..cell(shape.centre[k] + reach[k]) + 1);
            for x in xs {
                for y in ys.clone() {
                    zs.clone().for_each(|z| put((x * SIDE + y) * SIDE + z));
                }
            }
        });
        Self { lists }
    }

    /// The value of `shapes` at a point of the unit cube; their densities may have changed since.
    pub fn value(&self, shapes: &[Shape], p: Vec3) -> f64 {
        let [x, y, z] = p.map(cell);
        let near = self.lists.of((x * SIDE + y) * SIDE + z);
        near.iter().fold(0.0, |sum, &i| sum + shapes[i as usize].value(p, EXTENT))
    }
}
