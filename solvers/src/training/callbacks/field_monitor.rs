//! The field's metrics in a record: PSNR against the reference and the error of held-out views.

use crate::training::Callback;
use crate::training::run::Run;
use crate::watched;
use conefield_core::backend::TrainRay;
use conefield_core::error::Result;
use conefield_core::method::{Job, Record};
use conefield_core::pipeline::Pipeline;
use conefield_core::scene::Scene;
use conefield_core::stage::UnitRay;

/// Most held-out rays rendered for a record.
const HELD_OUT_RAYS: usize = 8192;

/// Evaluates some voxels of the reference and some rays of the held-out views.
pub struct FieldMonitor {
    points: Vec<[f32; 3]>,
    reference: Vec<f32>,
    /// Number of voxels outside the object's support, and the sum of their squares in the reference.
    outside: (usize, f64),
    /// Converts the scale of the stages to the reference's unit.
    scale: f32,
    peak: f64,
    rays: Vec<TrainRay>,
    /// Number of rays that miss the scene, and the sum of squares of their measured values.
    missing: (usize, f64),
    top: f64,
}

impl FieldMonitor {
    /// A monitor of `job` in `scene`.
    pub fn new(job: &Job<'_>, scene: &Scene, pipeline: &Pipeline) -> Self {
        let (mut points, mut reference, mut outside) = (vec![], vec![], (0, 0.0));
        let shape = scene.grid.shape;
        if let Some(r) = job.reference.filter(|r| r.data.shape() == shape) {
            for voxel in watched::voxels(shape) {
                let value = r.data[voxel];
                if scene.holds(scene.grid.voxel(voxel)) {
                    points.push(scene.voxel(voxel));
                    reference.push(value);
                } else {
                    outside = (outside.0 + 1, outside.1 + f64::from(value).powi(2));
                }
            }
        }
        let (mut rays, mut missing, mut top) = (vec![], (0, 0.0), 0.0f64);
        if let Some(scan) = job.held_out {
            let [rows, columns] = scan.geometry.detector;
            let every = (scan.projections.len() / HELD_OUT_RAYS).max(1) | 1;
            // Over all pixels, as in iterative methods, so that both kinds of error are comparable.
            top = scan.projections.iter().map(|p| f64::from(scene.line_to_unit(*p))).fold(0.0, f64::max);
            for i in (0..scan.projections.len()).step_by(every) {
                let at = [i / (rows * columns), i / columns % rows, i % columns];
                let target = scene.line_to_unit(scan.projections[at]);
                let ray = scene.pixel_ray(&scan.geometry, at[0], at[1], at[2]);
                if pipeline.sees(&ray) {
                    rays.push(TrainRay { ray, target });
                } else {
                    missing = (missing.0 + 1, missing.1 + f64::from(target).powi(2));
                }
            }
        }
        Self {
            points,
            reference,
            outside,
            scale: (scene.attenuation * job.scan.unit.mm) as f32,
            peak: job.peak,
            rays,
            missing,
            top,
        }
    }
}

impl Callback for FieldMonitor {
    fn name(&self) -> &'static str {
        "field-monitor"
    }

    fn at_record(&mut self, record: &mut Record, run: &mut Run<'_>) -> Result<()> {
        let mean = |differences: &mut dyn Iterator<Item = f64>, (more, sum): (usize, f64), n: usize| {
            (differences.map(|d| d.powi(2)).sum::<f64>() + sum) / (n + more) as f64
        };
        if !self.points.is_empty() {
            let mut mu = vec![0.0; self.points.len()];
            run.exe.evaluate(&run.model, &self.points, &mut mu)?;
            let pairs = mu.iter().zip(&self.reference);
            let mse = mean(&mut pairs.map(|(m, r)| f64::from(m * self.scale) - f64::from(*r)), self.outside, mu.len());
            record.psnr = Some(10.0 * (self.peak * self.peak / mse.max(1e-300)).log10());
        }
        if !self.rays.is_empty() {
            let rays: Vec<UnitRay> = self.rays.iter().map(|r| r.ray).collect();
            let mut lines = vec![0.0; rays.len()];
            run.exe.render(&run.model, &rays, &mut lines)?;
            let pairs = lines.iter().zip(&self.rays);
            let mse = mean(&mut pairs.map(|(a, r)| f64::from(*a) - f64::from(r.target)), self.missing, rays.len());
            record.held_out = Some(mse.sqrt() / self.top.max(1e-300));
        }
        Ok(())
    }
}
