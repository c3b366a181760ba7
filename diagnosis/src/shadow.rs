//! Where points of the world fall on a view's detector.

use conefield_core::geometry::{Vec3, View, cross, dot, sub};

/// Where points of the world fall on a view's detector.
pub(crate) struct Shadow {
    source: Vec3,
    detector: Vec3,
    /// From the source to the plane of the detector.
    pub depth: f64,
    normal: Vec3,
    /// Their products with a vector in the plane are its columns and rows.
    columns: Vec3,
    rows: Vec3,
}

/// Where a point falls, from the detector's centre, in pixels.
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

    /// `None` for what is not before the source.
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
