//! Projection of points onto a view's detector.

use conefield_core::geometry::{Vec3, View, cross, dot, sub};

/// Projects points onto a view's detector.
pub(crate) struct Shadow {
    source: Vec3,
    detector: Vec3,
    /// Distance from the source to the detector plane.
    pub depth: f64,
    normal: Vec3,
    /// The products of these with a vector in the plane are its column and row.
    columns: Vec3,
    rows: Vec3,
}

/// The projection of a point, relative to the detector's centre, in pixels.
pub(crate) struct Fall {
    pub row: f64,
    pub column: f64,
    pub magnification: f64,
}

impl Shadow {
    pub fn of(view: &View) -> Self {
        let (normal, depth) = view.normal();
        let over = |a: Vec3, b: Vec3| {
            let c = cross(a, normal);
            let length = dot(b, c);
            c.map(|x| x / length)
        };
        let (columns, rows) = (over(view.v, view.u), over(view.u, view.v));
        Self { source: view.source, detector: view.detector, depth, normal, columns, rows }
    }

    /// `None` for a point that is not in front of the source.
    pub fn of_point(&self, p: Vec3) -> Option<Fall> {
        let to = sub(p, self.source);
        let magnification = self.depth / dot(self.normal, to);
        if !(magnification > 0.0 && magnification.is_finite()) {
            return None;
        }
        let on: Vec3 = std::array::from_fn(|k| self.source[k] + magnification * to[k] - self.detector[k]);
        Some(Fall { row: dot(on, self.rows), column: dot(on, self.columns), magnification })
    }
}
