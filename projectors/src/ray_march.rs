//! Ray marching: a ray is divided into intervals of equal length; each has one sample, weighted by the interval's
//! length.
//!
//! With `N` intervals of `δ = (far − near)/N` the line integral is `Σ μ(x_i)·δ`, so that no interval is lost at the
//! end. Samples are in the middle of their interval (midpoint rule, second order) or at a random position in it
//! (stratified, unbiased). The published sum, which gives the last sample no weight, is available for comparisons.

use conefield_core::prelude::*;
use conefield_core::stage::Lengths;

/// Sample positions within the intervals during training. Rendering uses the middle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Sampling {
    /// In the middle.
    Uniform,
    /// At random positions.
    Stratified,
    /// `N` points from end to end, `(far − near)/(N − 1)` apart, the last without weight: the sum of the published
    /// codes.
    EndToEnd,
}

/// The sampled part of a ray.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Extent {
    /// Between the near and far distances of the published codes, the same for every ray of a view.
    Published,
    /// Only inside the reconstruction box.
    Clipped,
}

/// Settings of `ray-march`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
#[schemars(extend("x-one-of" = [["samples", "step_mm", "step_voxels", "step_cells"]]))]
pub struct RayMarch {
    /// Samples per ray; 192 if no step is given either.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<usize>,
    /// Distance between samples in mm, instead of a count. However short it is, a ray has at most 65,536 samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub step_mm: Option<f64>,
    /// Distance between samples in (shortest) voxel sides, instead of a count: the number of samples depends on a ray's
    /// path through the object.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub step_voxels: Option<f64>,
    /// Distance between samples in sides of the encoder's finest cell, instead of a count: a field has little detail
    /// below that.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub step_cells: Option<f64>,
    /// Sample positions within the intervals.
    pub sampling: Sampling,
    /// The sampled part of a ray.
    pub extent: Extent,
}

impl Default for RayMarch {
    fn default() -> Self {
        let (sampling, extent) = (Sampling::Stratified, Extent::Clipped);
        Self { samples: None, step_mm: None, step_voxels: None, step_cells: None, sampling, extent }
    }
}

conefield_core::stage_type!(ProjectorSpec, "ray-march", RayMarch, "equal intervals along the ray, one sample each");

/// Default number of samples per ray.
const SAMPLES: usize = 192;
/// More samples per ray must be an error in units: such a count is refused, and a shorter step adds no more.
const MOST_SAMPLES: usize = 65_536;

impl ProjectorSpec for RayMarch {
    fn build(&self) -> Result<Box<dyn Projector>> {
        let n = self.count();
        ensure((1..=MOST_SAMPLES).contains(&n), "spec", "samples", n, "1 to 65536")?;
        let ends = self.sampling == Sampling::EndToEnd;
        ensure(
            !ends || self.samples.is_some_and(|n| n > 1),
            "spec",
            "sampling",
            "end-to-end",
            "2 or more for `samples` beside it",
        )?;
        let steps = [
            ("step_mm", self.step_mm, "mm"),
            ("step_voxels", self.step_voxels, "voxels"),
            ("step_cells", self.step_cells, "cells"),
        ];
        let mut said: Vec<&str> = self.samples.map(|_| "samples").into_iter().collect();
        for (name, step, unit) in steps {
            let Some(step) = step else { continue };
            ensure(step.is_finite() && step > 0.0, "spec", name, step, format!("a positive number of {unit}"))?;
            said.push(name);
        }
        let expected = "one of samples, step_mm, step_voxels and step_cells";
        ensure(said.len() <= 1, "spec", "projector", said.join(" and "), expected)?;
        Ok(Box::new(self.clone()))
    }
}

impl RayMarch {
    /// Samples per ray, if given as a count.
    fn count(&self) -> usize {
        self.samples.unwrap_or(SAMPLES)
    }

    fn range(&self, ray: &UnitRay) -> [f32; 2] {
        match self.extent {
            Extent::Published => ray.published,
            Extent::Clipped => ray.inside,
        }
    }

    /// Samples of a ray that a step of `step` mm asks for.
    fn wanted(&self, ray: &UnitRay, step: f64) -> f64 {
        let [near, far] = self.range(ray);
        (f64::from(far - near) / (step * f64::from(ray.per_mm))).ceil()
    }
}

impl Projector for RayMarch {
    fn max_samples(&self, ray: &UnitRay) -> usize {
        let [near, far] = self.range(ray);
        if far <= near {
            return 0;
        }
        let Some(step) = self.step_mm else { return self.count() };
        (self.wanted(ray, step) as usize).clamp(1, MOST_SAMPLES)
    }

    fn doubt(&self, ray: &UnitRay) -> Option<String> {
        let step = self.step_mm?;
        let wanted = self.wanted(ray, step);
        (wanted > MOST_SAMPLES as f64).then(|| {
            let [near, far] = self.range(ray);
            let longer = f64::from(far - near) / f64::from(ray.per_mm) / MOST_SAMPLES as f64;
            format!(
                "ray-march: samples are {longer:.2e} mm apart and not {step:.2e} mm, since a ray has at most {MOST_SAMPLES}"
            )
        })
    }

    fn sample(&self, ray: &UnitRay, seed: Option<u64>, out: &mut Samples) {
        let [near, far] = self.range(ray);
        let n = self.max_samples(ray);
        let ends = self.sampling == Sampling::EndToEnd;
        // A ray that misses has no samples.
        let delta = (far - near) / if ends { n.saturating_sub(1).max(1) } else { n } as f32;
        for i in 0..n {
            let place = match (self.sampling, seed) {
                (Sampling::EndToEnd, _) => 0.0,
                (Sampling::Stratified, Some(seed)) => unit(mix(seed, i as u64)),
                _ => 0.5,
            };
            let t = near + (i as f32 + place) * delta;
            out.points.push(std::array::from_fn(|k| ray.origin[k] + t * ray.direction[k]));
            out.weights.push(if ends && i + 1 == n { 0.0 } else { delta });
        }
    }

    fn fitted(&self, lengths: Lengths) -> Result<Option<Box<dyn Projector>>> {
        let step = match (self.step_voxels, self.step_cells) {
            (Some(n), _) => n * lengths.voxel_mm,
            (_, Some(n)) => {
                let unknown = || {
                    let found = "an encoder that does not say how fine it is";
                    Error::invalid(
                        "spec",
                        "step_cells",
                        found,
                        "samples, step_mm or step_voxels with it: --set projector.step_voxels=1 takes a sample per voxel",
                    )
                };
                n * lengths.cell_mm.ok_or_else(unknown)?
            }
            _ => return Ok(None),
        };
        Ok(Some(Box::new(Self { step_mm: Some(step), step_voxels: None, step_cells: None, ..self.clone() })))
    }

    fn describe(&self) -> String {
        let count = match (self.step_mm, self.step_voxels, self.step_cells) {
            (Some(step), ..) => format!("a sample every {step} mm"),
            (_, Some(1.0), _) => "a sample every voxel".into(),
            (_, Some(step), _) => format!("a sample every {step} voxels"),
            (.., Some(1.0)) => "a sample every finest cell of the encoder".into(),
            (.., Some(step)) => format!("a sample every {step} of the encoder's finest cells"),
            _ => format!("{} samples per ray", self.count()),
        };
        format!("ray-march: {count}, {:?}, {:?}", self.sampling, self.extent).to_lowercase()
    }

    fn wgsl(&self) -> Option<Fragment> {
        let settings = format!(
            "const stage_PUBLISHED = {};\nconst stage_STRATIFIED = {};\nconst stage_END_TO_END = {};\n",
            self.extent == Extent::Published,
            self.sampling == Sampling::Stratified,
            self.sampling == Sampling::EndToEnd
        );
        Some(Fragment::new(&[&settings, include_str!("ray_march.wgsl")]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray() -> UnitRay {
        UnitRay {
            origin: [-1.0, 0.5, 0.5],
            direction: [1.0, 0.0, 0.0],
            inside: [1.0, 2.0],
            published: [0.5, 2.5],
            per_mm: 0.01,
        }
    }

    #[test]
    fn the_published_sum_goes_from_end_to_end_and_leaves_the_last_sample_out() {
        let p = RayMarch { samples: Some(5), sampling: Sampling::EndToEnd, ..RayMarch::default() };
        let mut s = Samples::default();
        p.sample(&ray(), Some(1), &mut s);
        assert_eq!(s.points.iter().map(|q| q[0]).collect::<Vec<f32>>(), [0.0, 0.25, 0.5, 0.75, 1.0]);
        assert_eq!(s.weights, [0.25, 0.25, 0.25, 0.25, 0.0]);
    }

    #[test]
    fn samples_are_given_in_one_way() {
        let all = RayMarch { samples: Some(7), step_mm: Some(1.0), step_voxels: Some(2.0), ..RayMarch::default() };
        for both in [
            RayMarch { samples: None, ..all.clone() },
            RayMarch { step_mm: None, ..all.clone() },
            RayMarch { step_voxels: None, ..all.clone() },
        ] {
            let e = both.build().err().unwrap().to_string();
            assert!(e.contains("one of samples, step_mm, step_voxels and step_cells"), "{e}");
        }
        assert_eq!(RayMarch::default().build().unwrap().max_samples(&ray()), SAMPLES);
    }

    #[test]
    fn stratified_samples_stay_in_their_interval_and_repeat_by_seed() {
        let p = RayMarch { samples: Some(16), ..RayMarch::default() };
        let (mut a, mut b, mut c) = (Samples::default(), Samples::default(), Samples::default());
        p.sample(&ray(), Some(5), &mut a);
        p.sample(&ray(), Some(5), &mut b);
        p.sample(&ray(), Some(6), &mut c);
        assert_eq!(a.points, b.points);
        assert_ne!(a.points, c.points);
        for (i, q) in a.points.iter().enumerate() {
            let t = q[0] * 16.0;
            assert!(t >= i as f32 - 1e-4 && t <= i as f32 + 1.0001);
        }
    }

    #[test]
    fn a_step_that_is_too_short_is_said() {
        // The ray is 100 mm long.
        let p = |step| RayMarch { step_mm: Some(step), ..RayMarch::default() };
        assert!(p(2e-3).max_samples(&ray()) < MOST_SAMPLES);
        assert_eq!(p(2e-3).doubt(&ray()), None);
        assert_eq!(p(1e-3).max_samples(&ray()), MOST_SAMPLES);
        let said = p(1e-3).doubt(&ray()).unwrap();
        assert!(said.contains("1.53e-3 mm apart and not 1.00e-3 mm"), "{said}");
        assert_eq!(RayMarch::default().doubt(&ray()), None);
    }

    #[test]
    fn steps_in_voxels_and_cells_become_millimetres() {
        let lengths = Lengths { voxel_mm: 0.5, cell_mm: Some(0.8) };
        let fitted = |p: &RayMarch, lengths| p.fitted(lengths).map(|p| p.map(|p| p.describe()));
        let voxels = RayMarch { step_voxels: Some(3.0), ..RayMarch::default() };
        let cells = RayMarch { step_cells: Some(2.0), ..RayMarch::default() };
        assert!(fitted(&voxels, lengths).unwrap().unwrap().contains("every 1.5 mm"));
        assert!(fitted(&cells, lengths).unwrap().unwrap().contains("every 1.6 mm"));
        assert!(fitted(&RayMarch::default(), lengths).unwrap().is_none());
        let e = fitted(&cells, Lengths { cell_mm: None, ..lengths }).unwrap_err().to_string();
        assert!(e.contains("step_cells") && e.contains("does not say how fine"), "{e}");
        assert!(e.contains("--set projector.step_voxels=1"), "{e}");
        assert!(RayMarch { step_cells: Some(-1.0), ..RayMarch::default() }.build().is_err());
        assert_eq!(cells.describe(), "ray-march: a sample every 2 of the encoder's finest cells, stratified, clipped");
    }
}
