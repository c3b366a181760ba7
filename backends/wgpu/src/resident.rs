//! Proximal gradient updates of volumes that stay on the device; see [`conefield_core::resident`].
//!
//! An update overwrites the gradient with the argument `v` of the proximal map, makes the dual steps, each with a kernel
//! for the primal and one for the dual, and extrapolates.

use crate::compose::fragment_of;
use crate::device::Gpu;
use crate::source::{Access, Source};
use crate::voxels::{ARRAY, Room, Walks, each};
use conefield_core::error::{Error, Result};
use conefield_core::geometry::Geometry;
use conefield_core::pages::copy;
use conefield_core::regularizer::Dual;
use conefield_core::resident::{Factors, Resident, Volumes};
use conefield_core::wgsl::Fragment;
use ndarray::{ArrayView3, ArrayViewMut3, Axis};
use std::sync::Arc;

/// `Proximal` in `kernels/proximal.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
struct Proximal {
    shape: [u32; 3],
    begin: u32,
    down: [f32; 3],
    end: u32,
    up: [f32; 3],
    step: f32,
    momentum: f32,
    pull: f32,
    pad: [f32; 2],
}

/// Names of the dual variables and of the vectors that guide the penalty, along x, y and z.
const DUAL: [&str; 3] = ["dual_x", "dual_y", "dual_z"];
const GUIDE: [&str; 3] = ["guide_x", "guide_y", "guide_z"];

/// The kernels of an update.
struct Kernels {
    /// The argument of the proximal map.
    argument: Source,
    /// `primal` from the dual.
    primal: Source,
    /// The dual from `primal`.
    ascend: Source,
    /// New coefficients and the point of the next gradient.
    finish: Source,
    /// The same for a weight of 0.
    finish_flat: Source,
}

/// A kernel that runs `body` for every voxel i.
fn kernel(bindings: &[(&str, Access)], functions: &[(&str, &str)], body: &str) -> Source {
    let mut source = Source::default();
    source.add("proximal", include_str!("kernels/proximal.wgsl"));
    source.bind("proximal", Access::Uniform, "Proximal");
    for (name, access) in bindings {
        source.bind(name, *access, if *name == "inside" { "array<u32>" } else { "array<f32>" });
    }
    for (name, text) in functions {
        source.add(name, text);
    }
    source.add("voxels", &each("proximal", body));
    source
}

/// `max(0, v − τ·∇ᵀp)` at voxel i.
const PRIMAL: &str = "fn primal_of(i: u32) -> f32 {
    var d = -vec3<f32>(dual_x[i], dual_y[i], dual_z[i]);
    let plane = proximal.shape.y * proximal.shape.z;
    let at = place(i);
    if i >= plane { d.x += dual_x[i - plane]; }
    if at.x > 0u { d.y += dual_y[i - proximal.shape.z]; }
    if at.y > 0u { d.z += dual_z[i - 1u]; }
    return max(0.0, gradient[i] - dot(d, proximal.down));
}
";

/// The differences of `primal` at voxel i, times `up`; 0 across the far faces.
const DIFFERENCES: &str = "fn differences(i: u32) -> vec3<f32> {
    let shape = proximal.shape;
    let plane = shape.y * shape.z;
    let at = place(i);
    let here = primal[i];
    var d = vec3<f32>();
    if i / plane + 1u < shape.x { d.x = primal[i + plane] - here; }
    if at.x + 1u < shape.y { d.y = primal[i + shape.z] - here; }
    if at.y + 1u < shape.z { d.z = primal[i + 1u] - here; }
    return d * proximal.up;
}
";

impl Kernels {
    fn new(penalty: &Fragment, [pulled, masked, guided]: [bool; 3]) -> Self {
        use Access::{Read, Write};
        let mut argument = vec![("ahead", Read), ("gradient", Write)];
        let mut v = "let z = ahead[i];\n        var v = z + proximal.step * gradient[i];\n".to_owned();
        if pulled {
            argument.push(("towards", Read));
            v += "        v += proximal.pull * (towards[i] - z);\n";
        }
        if masked {
            argument.push(("inside", Read));
            // Values far below 0 stay at 0, whatever their neighbours are.
            v += "        if ((inside[i / 32u] >> (i % 32u)) & 1u) == 0u { v = -3.4e38; }\n";
        }
        let dual = |access| DUAL.map(|name| (name, access));
        let primal = [&dual(Read)[..], &[("gradient", Read), ("primal", Write)]].concat();
        let mut ascend = [&dual(Write)[..], &[("primal", Read)]].concat();
        let mut guide = "vec3<f32>()";
        if guided {
            ascend.extend(GUIDE.map(|name| (name, Read)));
            guide = "vec3<f32>(guide_x[i], guide_y[i], guide_z[i])";
        }
        let step = format!(
            "let p = penalty_ascend(vec3<f32>(dual_x[i], dual_y[i], dual_z[i]), differences(i), {guide});
        dual_x[i] = p.x;
        dual_y[i] = p.y;
        dual_z[i] = p.z;"
        );
        let finish = |u: &str| {
            format!("let u = {u};\n        ahead[i] = u + proximal.momentum * (u - x[i]);\n        x[i] = u;")
        };
        let flat = [("gradient", Read), ("x", Write), ("ahead", Write)];
        Self {
            argument: kernel(&argument, &[], &(v + "        gradient[i] = v;")),
            primal: kernel(&primal, &[("primal", PRIMAL)], "primal[i] = primal_of(i);"),
            ascend: kernel(&ascend, &[("differences", DIFFERENCES), ("penalty", &penalty.named("penalty_"))], &step),
            finish: kernel(&[&dual(Read)[..], &flat].concat(), &[("primal", PRIMAL)], &finish("primal_of(i)")),
            finish_flat: kernel(&flat, &[], &finish("max(0.0, gradient[i])")),
        }
    }
}

/// The volumes, with the projector's and their own kernels.
pub struct DeviceVolumes {
    walks: Arc<Walks>,
    /// Buffers of the projector.
    rays: Room,
    /// Buffers of the volumes.
    voxels: Room,
    kernels: Kernels,
    shape: [usize; 3],
    weights: [f32; 3],
    steps: usize,
}

impl DeviceVolumes {
    /// Uploads the volumes. Refuses those that are larger than a buffer, and a penalty without WGSL.
    pub fn new(walks: Arc<Walks>, volumes: Volumes<'_>) -> Result<Self> {
        let shared = walks.shared.clone();
        let gpu = &shared.gpu;
        let Volumes { shape, x, ahead, towards, inside, dual } = volumes;
        let dual = dual.ok_or_else(|| Error::unsupported("the prior on the device", "it has no WGSL"))?;
        let Dual { fragment, weights, steps, p, guide } = dual;
        let fragment = fragment_of("the prior", Some(fragment))?;
        let (bytes, most) = (4 * x.len() as u64, gpu.adapter.bound_bytes());
        if bytes > most {
            return Err(gpu.error(format!("a volume takes {bytes} bytes, a buffer holds {most}")));
        }
        let kernels = Kernels::new(&fragment, [towards.is_some(), inside.is_some(), guide.is_some()]);
        kernels.ascend.validate()?;
        let mut voxels = Room::new(gpu);
        let mut upload = |name: &str, data: &[f32]| {
            voxels.buffers.reserve(gpu, name, bytes, ARRAY)?;
            voxels.write(&shared, name, data);
            Ok(())
        };
        upload("x", x)?;
        upload("ahead", ahead)?;
        DUAL.iter().zip(&p).try_for_each(|(name, p)| upload(name, p))?;
        if let Some(guide) = guide {
            GUIDE.iter().zip(guide).try_for_each(|(name, guide)| upload(name, guide))?;
        }
        if let Some(towards) = towards {
            upload("towards", towards)?;
        }
        // Zero at first.
        voxels.buffers.reserve(gpu, "gradient", bytes, ARRAY)?;
        voxels.buffers.reserve(gpu, "primal", bytes, ARRAY)?;
        if let Some(inside) = inside {
            let word = |part: &[bool]| part.iter().rev().fold(0u32, |word, inside| word << 1 | u32::from(*inside));
            let words: Vec<u32> = inside.chunks(32).map(word).collect();
            voxels.buffers.reserve(gpu, "inside", 4 * words.len() as u64, ARRAY)?;
            voxels.write(&shared, "inside", bytemuck::cast_slice(&words));
        }
        let rays = Room::new(gpu);
        Ok(Self { walks, rays, voxels, kernels, shape, weights, steps })
    }

    fn gpu(&self) -> &Gpu {
        &self.walks.shared.gpu
    }

    fn voxels(&self) -> usize {
        self.shape.iter().product()
    }

    /// Makes the projector work on volume `name`.
    fn project(&mut self, name: &str) -> Result<()> {
        let volume = self.voxels.buffers.get(name).ok_or_else(|| self.gpu().error(format!("no volume {name}")))?;
        self.rays.buffers.insert("volume", volume.clone());
        Ok(())
    }

    fn views_at_once(&self, geometry: &Geometry) -> usize {
        self.walks.views_at_once(geometry.detector[0] * geometry.detector[1])
    }

    fn download(&mut self, name: &str, to: &mut [f32]) -> Result<()> {
        self.voxels.read(&self.walks.shared, name, to.len(), |found| copy(to, found))
    }
}

impl Resident for DeviceVolumes {
    fn forward(&mut self, geometry: &Geometry, views: &[usize], mut out: ArrayViewMut3<'_, f32>) -> Result<()> {
        self.project("ahead")?;
        let (chunk, whole) = (self.views_at_once(geometry), [0..self.shape[0]]);
        for (views, out) in views.chunks(chunk).zip(out.axis_chunks_iter_mut(Axis(0), chunk)) {
            self.walks.integrate(&mut self.rays, (geometry, views), &whole, |_, _| {}, out)?;
        }
        Ok(())
    }

    fn adjoint(&mut self, geometry: &Geometry, views: &[usize], projections: ArrayView3<'_, f32>) -> Result<()> {
        self.project("gradient")?;
        let (chunk, whole) = (self.views_at_once(geometry), 0..self.shape[0]);
        for (views, lines) in views.chunks(chunk).zip(projections.axis_chunks_iter(Axis(0), chunk)) {
            self.walks.spread(&mut self.rays, (geometry, views), &whole, lines)?;
        }
        Ok(())
    }

    fn update(&mut self, factors: Factors) -> Result<()> {
        let Factors { step, momentum, pull, tau } = factors;
        let bound = Dual::bound(self.weights);
        let shape = self.shape.map(|n| n as u32);
        let (down, up) = (self.weights.map(|g| g * tau), self.weights.map(|g| g / (bound * tau)));
        let uniform = |begin, end| Proximal { shape, begin, down, end, up, step, momentum, pull, pad: [0.0; 2] };
        let kernels = &self.kernels;
        let mut run = vec![("argument of the prior", &kernels.argument)];
        if tau < f32::MIN_POSITIVE {
            run.push(("extrapolation", &kernels.finish_flat));
        } else {
            let step = [("primal of the prior", &kernels.primal), ("dual of the prior", &kernels.ascend)];
            run.extend(step.into_iter().cycle().take(2 * self.steps));
            run.push(("extrapolation", &kernels.finish));
        }
        let count = self.voxels() as u32;
        self.voxels.run(&self.walks.shared, &run, ("proximal", uniform), count)?;
        self.voxels.clear(&self.walks.shared, "gradient");
        Ok(())
    }

    fn guide(&mut self, guide: [&[f32]; 3]) -> Result<()> {
        GUIDE.iter().zip(guide).for_each(|(name, guide)| self.voxels.write(&self.walks.shared, name, guide));
        Ok(())
    }

    fn coefficients(&mut self, x: &mut [f32]) -> Result<()> {
        self.download("x", x)
    }

    fn rest(&mut self, ahead: &mut [f32], dual: [&mut [f32]; 3]) -> Result<()> {
        self.download("ahead", ahead)?;
        DUAL.iter().zip(dual).try_for_each(|(name, p)| self.download(name, p))
    }
}
