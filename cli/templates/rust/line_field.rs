//! A line field for conefield: a sum of Gaussian blobs on a grid, whose line integrals are known in closed form.

use conefield_plugin::prelude::*;

conefield_plugin::export!();
stage_type!(LineField, "@name@", Settings, "Gaussian blobs on a grid");

/// Settings in a spec.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Blobs along the cube's side.
    pub blobs: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { blobs: 12 }
    }
}

#[typetag::serde(name = "@name@")]
impl LineFieldSpec for Settings {
    fn build(&self) -> Result<Box<dyn Field>> {
        ensure((2..=128).contains(&self.blobs), "spec", "blobs", self.blobs, "2 to 128")?;
        Ok(Box::new(ByRay::new(self.clone())))
    }
}

impl Settings {
    /// The vector from `at` to the centre of blob `i`.
    fn way(&self, i: usize, at: [f64; 3]) -> [f64; 3] {
        let n = self.blobs;
        let place = [i / (n * n), i / n % n, i % n];
        [0, 1, 2].map(|k| (place[k] as f64 + 0.5) / n as f64 - at[k])
    }

    /// The inverse square of a blob's width.
    fn sharpness(&self) -> f64 {
        (1.6 * self.blobs as f64).powi(2)
    }

    /// A blob of height 1 at this squared distance from its middle.
    fn blob(&self, square: f64) -> f64 {
        (-0.5 * square * self.sharpness()).exp()
    }

    /// The line integral of blob `i`, with a height of 1, along a ray.
    fn along(&self, i: usize, ray: &UnitRay) -> f64 {
        let way = self.way(i, ray.origin.map(f64::from));
        let ahead = dot(way, ray.direction.map(f64::from));
        (std::f64::consts::TAU / self.sharpness()).sqrt() * self.blob(dot(way, way) - ahead * ahead)
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

impl RowMap for Settings {
    fn widths(&self) -> [usize; 2] {
        [3, 1]
    }

    fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        vec![("height".into(), vec![self.blobs; 3])]
    }

    /// All blobs start with a height of 0.
    fn init(&self, _: u64, params: &mut [f32]) {
        params.fill(0.0);
    }

    fn forward<R: Real>(&self, params: &[R], x: &[R], y: &mut [R]) {
        let at = [0, 1, 2].map(|k| x[k].f64());
        for (i, &height) in params.iter().enumerate() {
            let way = self.way(i, at);
            y[0] += height * R::of(self.blob(dot(way, way)));
        }
    }

    fn backward<R: Real>(&self, params: &[R], x: &[R], dy: &[R], grads: &mut Sums<'_, R>, dx: &mut [R]) {
        let at = [0, 1, 2].map(|k| x[k].f64());
        for (i, &height) in params.iter().enumerate() {
            let way = self.way(i, at);
            let d = dy[0] * R::of(self.blob(dot(way, way)));
            grads.add(i, d);
            for k in 0..3 {
                dx[k] += d * height * R::of(self.sharpness() * way[k]);
            }
        }
    }

    fn describe(&self) -> String {
        format!("@name@: {} blobs per side", self.blobs)
    }
}

impl RayMap for Settings {
    fn project<R: Real>(&self, params: &[R], ray: &UnitRay) -> R {
        params.iter().enumerate().map(|(i, height)| *height * R::of(self.along(i, ray))).sum()
    }

    /// The adjoint uses the same lengths.
    fn backproject<R: Real>(&self, params: &[R], ray: &UnitRay, dline: R, grads: &mut Sums<'_, R>) {
        (0..params.len()).for_each(|i| grads.add(i, dline * R::of(self.along(i, ray))));
    }
}
