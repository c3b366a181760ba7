//! Negative controls: a small stage that passes the kit, and the same stage with one fault at a time, which must fail
//! the property that the fault breaks. A kit that cannot fail proves nothing.

mod device;

use conefield_conformance::{
    Options, Report, check, check_basis, check_data_term, check_encoder, check_initializer, check_loss,
    check_loss_wgsl, check_prior, check_prior_wgsl, check_projector, check_regularizer, check_settings,
    check_voxel_projector,
};
use conefield_core::geometry::Geometry;
use conefield_core::prelude::*;
use conefield_core::regularizer::Bounds;
use conefield_core::stage::Lengths;
use conefield_core::voxel::{VoxelOperator, VoxelProjector};
use conefield_projectors::voxel::{Joseph, Siddon};
use std::fmt::Debug;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

/// What can be wrong with a stage of a kind, each with the properties that fail, `only` these where it says so; `None` is
/// sound.
macro_rules! faults {
    ($(#[$about:meta])* $name:ident { $($(#[$what:meta])* $fault:ident: $($only:ident)? $($property:literal),*;)* }) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        enum $name {
            None,
            $($(#[$what])* $fault,)*
        }

        impl $name {
            const ALL: &[(Self, bool, &[&str])] =
                &[$((Self::$fault, !stringify!($($only)?).is_empty(), &[$($property),*])),*];
        }
    };
}

faults! {
    Fault {
        /// The parameter gradient is 1 % too large.
        Gradient: "finite differences: parameters";
        /// The last row is left out of the parameter gradient.
        LastRow: "finite differences: parameters", "tile sizes: gradients";
        /// One of the parameters gets no gradient.
        Forgotten: "finite differences: parameters";
        /// The input gradient has the wrong sign.
        InputGradient: "finite differences: inputs";
        /// Gradients replace what is there.
        OverwritesGradients: "gradients add";
        /// The input gradient is added to what is there.
        AddsInputGradient: "input gradient overwrites";
        /// One number past the end of the output.
        WritesOutside: "guards";
        /// One number before the start of the gradients.
        WritesBefore: "guards";
        /// A NaN in one row reaches every row.
        SpreadsNan: "poison rows";
        /// The result depends on the number of rows.
        TileSize: "tile sizes: outputs";
        /// An output is not written.
        SkipsOutput: "outputs overwrite";
        /// Squares overflow.
        Overflows: "extremes";
        /// The kernel that trains has three digits.
        Coarse: "single precision: outputs";
        /// Calls leave a trace that later calls see.
        Remembers: "threads";
        /// Calls at the same time share a number.
        Shares: "threads";
        /// Ranges overlap.
        Overlap: "partition";
        /// Ranges leave a gap.
        Gap: "partition";
        /// The sum depends on the range that is asked for.
        RangeDependent: "partition gradients";
        /// Blocks do not cover the parameters.
        MissingBlock: "parameters";
        /// Two blocks have one name.
        TwinNames: "parameters";
        /// Some parameters are not initialised.
        PartialInit: "init";
        /// It says that it does nothing.
        FalseIdentity: "info";
        /// It panics on its way back.
        Panics: "finite differences: inputs";
        /// A smaller stage computes another channel.
        WrongChannel: "keep outputs";
        /// A smaller stage keeps too many parameters.
        TooManyKept: "keep outputs";
        /// Passes leave another number than forward.
        Pass: "passes";
        /// A channel has no resolution.
        FewResolutions: "resolutions";
        /// A resolution is NaN.
        NanResolution: "resolutions";
        /// A resolution is negative.
        NegativeResolution: "resolutions";
        /// Channels are said to stand from coarse to fine, and do not.
        FallingResolutions: "resolutions";
        /// A smaller stage has the resolutions of other channels.
        OtherResolutions: "resolutions";
    }
}

/// `y_c = w_c·x_c + w_c²` on the channels in `channels`.
struct Toy {
    fault: Fault,
    channels: Vec<usize>,
    /// Whether there is a kernel in double precision.
    double: bool,
}

impl Toy {
    fn new(fault: Fault) -> Self {
        Self { fault, channels: vec![0, 1, 2], double: true }
    }
}

impl<R: Real> Kernel<R> for Toy {
    fn forward(&self, params: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, _: TileMut<'_, R>) {
        let rows = x.rows;
        for (c, &from) in self.channels.iter().enumerate() {
            let w = params[c];
            let everything: R = x.data.iter().copied().sum();
            for i in 0..rows {
                let mut v = w * x.channel(from)[i] + w * w;
                match self.fault {
                    Fault::SpreadsNan => v += everything * R::ZERO,
                    Fault::TileSize => v += R::of(rows as f64 * 1e-6),
                    Fault::Remembers => v += R::of(f64::from(calls()) * 1e-6),
                    Fault::Shares => v = shared(0, v),
                    Fault::Overflows => v = v * v / (v + R::of(1e-9)),
                    Fault::Coarse if size_of::<R>() == 4 => v = R::of((v.f64() * 1e3).round() * 1e-3),
                    _ => {}
                }
                if !(self.fault == Fault::SkipsOutput && i + 1 == rows && rows > 30) {
                    y.channel(c)[i] = v;
                }
            }
        }
        if self.fault == Fault::WritesOutside {
            let end = y.data.len();
            poke(y.data, end as isize);
        }
    }

    fn forward_pass(&self, _: usize, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        self.forward(params, x, TileMut::new(&mut *y.data, y.rows), tape);
        if self.fault == Fault::Pass {
            y.data[0] += R::ONE;
        }
    }

    fn backward(&self, Backward { params, x, dy, grads, dx, .. }: Backward<'_, R>) {
        assert!(self.fault != Fault::Panics, "as ordered");
        for c in grads.range.clone() {
            let w = params[c];
            let rows = if self.fault == Fault::LastRow { x.rows - 1 } else { x.rows };
            let mut sum = R::ZERO;
            for i in 0..rows {
                sum += dy.channel(c)[i] * (x.channel(self.channels[c])[i] + w + w);
            }
            match self.fault {
                Fault::Gradient => sum *= R::of(1.01),
                Fault::Forgotten if c == 1 => sum = R::ZERO,
                Fault::RangeDependent if grads.range.len() == 1 => sum *= R::of(1.0 + 1e-6),
                _ => {}
            }
            let g = &mut grads.values[c - grads.range.start];
            if self.fault == Fault::OverwritesGradients { *g = sum } else { *g += sum }
        }
        if self.fault == Fault::WritesBefore {
            poke(grads.values, -1);
        }
        let Some(mut dx) = dx else { return };
        if self.fault != Fault::AddsInputGradient {
            dx.data.fill(R::ZERO);
        }
        for (c, &from) in self.channels.iter().enumerate() {
            let sign = if self.fault == Fault::InputGradient { R::of(-1.0) } else { R::ONE };
            for i in 0..x.rows {
                dx.channel(from)[i] += sign * params[c] * dy.channel(c)[i];
            }
        }
    }
}

/// Writes beside a slice, as a plugin in another language might.
#[allow(unsafe_code)]
fn poke<R: Real>(data: &mut [R], at: isize) {
    // SAFETY: every buffer of the kit that a stage writes to has a guard on either side within its allocation, and
    // nothing reads that guard during the call.
    unsafe { data.as_mut_ptr().offset(at).write(R::ONE) }
}

impl Stage for Toy {
    fn info(&self) -> Info {
        let n = self.channels.len();
        Info {
            input: 3,
            output: n,
            params: n,
            grads: GradKind::Scatter,
            macs: 2 * n,
            identity: self.fault == Fault::FalseIdentity,
            ..Info::default()
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let number = |c: usize| if self.fault == Fault::TwinNames { c.min(1) } else { c };
        let all = self.channels.iter().enumerate();
        let all = all.map(|(i, &c)| Parameter { name: format!("{}.weight", number(c)), shape: vec![1], start: i });
        all.skip(usize::from(self.fault == Fault::MissingBlock)).collect()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        let skip = usize::from(self.fault == Fault::PartialInit);
        for (i, p) in params.iter_mut().enumerate().skip(skip) {
            *p = 0.5 + 0.1 * i as f32 + 0.01 * (seed % 7) as f32;
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        self.double.then_some(self as _)
    }

    fn partition(&self) -> Vec<Range<usize>> {
        let n = self.channels.len();
        match self.fault {
            Fault::Overlap => vec![0..1, 0..n],
            Fault::Gap => vec![1..n],
            _ => (0..n).map(|c| c..c + 1).collect(),
        }
    }

    fn describe(&self) -> String {
        format!("toy: {:?}", self.fault)
    }
}

impl Encoder for Toy {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        let mut channels: Vec<usize> = keep.iter().map(|&c| self.channels[c]).collect();
        let mut params: Vec<_> = keep.iter().map(|&c| c..c + 1).collect();
        match self.fault {
            Fault::WrongChannel => channels.reverse(),
            Fault::TooManyKept => params = vec![0..self.channels.len()],
            _ => {}
        }
        let stage = Toy { fault: self.fault, channels, double: self.double };
        Ok(Reduced { stage: Box::new(stage), params, channels: vec![0, 1, 2] })
    }

    fn coarse_to_fine(&self) -> bool {
        self.fault == Fault::FallingResolutions
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let mut cells: Vec<f64> = self.channels.iter().map(|&c| 4.0 * (c + 1) as f64).collect();
        match self.fault {
            Fault::FewResolutions => _ = cells.pop(),
            Fault::NanResolution => cells[0] = f64::NAN,
            Fault::NegativeResolution => cells[0] = -4.0,
            Fault::FallingResolutions => cells.reverse(),
            Fault::OtherResolutions => (0..cells.len()).for_each(|c| cells[c] = 4.0 * (c + 1) as f64),
            _ => {}
        }
        Some(cells)
    }
}

/// A refusal, unless all is `well`.
fn sound(well: bool) -> Result<()> {
    if well { Ok(()) } else { Err(Error::unsupported("toy", "as ordered")) }
}

/// The number of calls of toys so far: a trace that later calls see.
fn calls() -> u32 {
    static CALLS: AtomicU32 = AtomicU32::new(0);
    CALLS.fetch_add(1, Ordering::Relaxed)
}

/// `v` by way of a number that all threads share, one for each kind of stage.
fn shared<R: Real>(kind: usize, v: R) -> R {
    static SHARED: [AtomicU64; 5] = [const { AtomicU64::new(0) }; 5];
    SHARED[kind].store(v.f64().to_bits(), Ordering::Relaxed);
    // On one core, too, another thread has its turn in between.
    std::thread::yield_now();
    R::of(f64::from_bits(SHARED[kind].load(Ordering::Relaxed)))
}

/// Quiets the panics that a fault causes on purpose.
fn quietly<T>(f: impl FnOnce() -> T) -> T {
    std::panic::set_hook(Box::new(|_| {}));
    let result = f();
    let _ = std::panic::take_hook();
    result
}

/// Each fault fails its property, and what is sound passes.
fn each_fails<F: Copy + Debug>(sound: F, faults: &[(F, bool, &[&str])], check: impl Fn(F) -> Report) {
    let report = check(sound);
    assert!(report.passed(), "{report}");
    for &(fault, only, properties) in faults {
        let report = quietly(|| check(fault));
        assert!(!only || report.failed() == properties, "{fault:?} fails more than {properties:?}:\n{report}");
        for property in properties {
            assert!(report.failed().contains(property), "{fault:?} passed {property:?}:\n{report}");
        }
    }
}

#[test]
fn every_fault_fails_its_property_and_the_sound_stage_none() {
    each_fails(Fault::None, Fault::ALL, |fault| check_encoder(&Toy::new(fault), &Options::encoder()));
}

/// But for smaller encoders, which have the fault as well.
#[test]
fn faults_of_one_kind_leave_the_other_properties_alone() {
    for (fault, properties) in [
        (Fault::Gradient, &["finite differences: parameters"][..]),
        (Fault::OverwritesGradients, &["gradients add"]),
        (Fault::WritesOutside, &["guards"]),
        (Fault::SpreadsNan, &["poison rows"]),
    ] {
        let report = check(&Toy::new(fault), &Options::encoder());
        assert_eq!(report.failed(), properties, "{report}");
    }
}

#[test]
fn a_stage_in_single_precision_only_is_differenced_coarsely() {
    let toy = |fault| Toy { double: false, ..Toy::new(fault) };
    let faults: [(_, bool, &[&str]); 3] = [
        (Fault::Forgotten, false, &["finite differences: parameters"]),
        (Fault::LastRow, false, &["finite differences: parameters"]),
        (Fault::InputGradient, false, &["finite differences: inputs"]),
    ];
    each_fails(Fault::None, &faults, |fault| check_encoder(&toy(fault), &Options::encoder()));
}

#[test]
fn a_report_reads_well() {
    let text = check(&Toy::new(Fault::OverwritesGradients), &Options::encoder()).to_string();
    assert!(text.starts_with("toy: OverwritesGradients\n"), "{text}");
    assert!(text.lines().any(|l| l.contains("FAILED") && l.contains("gradients add")), "{text}");
    assert!(text.lines().any(|l| l.contains("passed") && l.contains("guards")), "{text}");
}

faults! {
    /// What is wrong with a projector of voxels.
    VoxelFault {
        /// The way back is another projector's, the same but for edges.
        OtherAdjoint: "adjoint: double precision";
        /// The way back is a thousandth too long.
        LongAdjoint: "adjoint: single precision", "adjoint: double precision";
        /// In single precision a part of a thousandth of the way back is lost.
        CoarseAdjoint: "adjoint: single precision", "single precision";
        /// A view takes a little of the one before it in the same call.
        Neighbours: "views stand alone";
        /// The first of several views is given back twice.
        FirstTwice: "views stand alone";
        /// Lengths are 2 % too long, there and back.
        Longer: only "closed form";
        /// Line integrals are added to what is there.
        AddsLines: "projections overwrite";
        /// The way back overwrites.
        OverwritesVoxels: only "adjoint adds";
        /// The result depends on the number of threads.
        Threads: only "threads";
        /// Calls at the same time share a number.
        Shares: only "threads";
        /// Every ray gives a little.
        Leaks: "rays that miss";
        /// Small line integrals are rounded away.
        Rounds: "linear";
        /// 0 over 0 where a ray misses.
        NotANumber: "finite";
        /// It panics.
        Panics: "closed form";
    }
}

impl<R: Real> VoxelOperator<R> for VoxelFault {
    fn forward(&self, g: &Geometry, views: &[usize], volume: ArrayView3<'_, R>, mut out: ArrayViewMut3<'_, R>) {
        let before = out.to_owned();
        Joseph {}.forward(g, views, volume, out.view_mut());
        let mut last = R::ZERO;
        let many = rayon::current_num_threads() == 3;
        for (i, x) in out.iter_mut().enumerate() {
            match self {
                Self::Neighbours => (*x, last) = (*x + R::of(1e-4) * last, *x),
                Self::Longer => *x *= R::of(1.02),
                Self::AddsLines => *x += before.as_slice().map_or(R::ZERO, |b| b[i]),
                Self::Threads if many => *x *= R::of(1.0 + 1e-6),
                Self::Shares if i < 16 => *x = shared(1, *x),
                Self::Leaks => *x += R::of(1e-12),
                Self::Rounds => *x = R::of((x.f64() * 1e3).round() / 1e3),
                Self::NotANumber => *x = *x * *x / *x,
                Self::Panics => panic!("as ordered"),
                _ => {}
            }
        }
    }

    fn adjoint(&self, g: &Geometry, views: &[usize], p: ArrayView3<'_, R>, mut volume: ArrayViewMut3<'_, R>) {
        let mut p = p.to_owned();
        match self {
            Self::OverwritesVoxels => volume.fill(R::ZERO),
            Self::LongAdjoint => p.mapv_inplace(|x| x * R::of(1.001)),
            Self::Longer => p.mapv_inplace(|x| x * R::of(1.02)),
            Self::CoarseAdjoint if size_of::<R>() == 4 => p.mapv_inplace(|x| R::of((x.f64() * 1e3).round() / 1e3)),
            Self::FirstTwice if views.len() > 1 => {
                p.index_axis_mut(ndarray::Axis(0), 0).mapv_inplace(|x| x + x);
            }
            _ => {}
        }
        match self {
            Self::OtherAdjoint => Siddon {}.adjoint(g, views, p.view(), volume),
            _ => Joseph {}.adjoint(g, views, p.view(), volume),
        }
    }
}

impl VoxelProjector for VoxelFault {
    fn operator(&self) -> &dyn VoxelOperator<f32> {
        self
    }
    fn reference(&self) -> &dyn VoxelOperator<f64> {
        self
    }
    fn describe(&self) -> String {
        format!("toy: {self:?}")
    }
}

#[test]
fn every_fault_of_a_voxel_projector_fails_its_property() {
    each_fails(VoxelFault::None, VoxelFault::ALL, |fault| check_voxel_projector(&fault));
}

faults! {
    /// What is wrong with a projector of rays.
    RayFault {
        /// One sample more than it says.
        TooMany: "samples are bounded";
        /// One weight is missing.
        LostWeight: "samples are bounded";
        /// A weight is NaN.
        NotANumber: "samples are finite";
        /// Samples lie beside their ray.
        Beside: "samples lie on their ray";
        /// What was there before goes.
        Clears: "samples add";
        /// Samples depend on the call.
        Remembers: "repeatable";
        /// Calls at the same time share a number.
        Shares: only "threads";
        /// A ray that misses the box gets a sample.
        SeesAir: "rays that miss";
        /// Lengths are 1 % too long.
        Longer: "constant attenuation";
        /// The way back is 1 % too long.
        LongAdjoint: "adjoint";
        /// The way back adds.
        AddsAdjoint: "adjoint overwrites";
        /// It says that something went wrong.
        Reports: "no fault";
        /// The projector for a scene is unsound.
        FitsUnsound: "fitted to a scene";
        /// The projector for a scene is another one each time.
        FitsAnew: "fitted to a scene";
        /// There is no projector for a scene.
        FitsNot: "fitted to a scene";
    }
}

struct ToyRays {
    fault: RayFault,
    samples: usize,
}

impl Projector for ToyRays {
    fn max_samples(&self, ray: &UnitRay) -> usize {
        let hit = ray.inside[1] > ray.inside[0] || self.fault == RayFault::SeesAir;
        if hit { self.samples } else { 0 }
    }

    fn sample(&self, ray: &UnitRay, _: Option<u64>, out: &mut Samples) {
        if self.fault == RayFault::Clears {
            *out = Samples::default();
        }
        let [near, far] = ray.inside;
        let n = self.max_samples(ray) + usize::from(self.fault == RayFault::TooMany);
        let mut delta = (far - near) / n.max(1) as f32;
        if self.fault == RayFault::Longer {
            delta *= 1.01;
        }
        if self.fault == RayFault::Shares {
            delta = shared(2, delta);
        }
        for i in 0..n {
            let shift = if self.fault == RayFault::Remembers { (calls() % 7) as f32 * 1e-3 } else { 0.0 };
            let t = near + (i as f32 + 0.5 + shift) * delta;
            let mut point: [f32; 3] = std::array::from_fn(|k| ray.origin[k] + t * ray.direction[k]);
            if self.fault == RayFault::Beside {
                point[0] += 0.01 * (1.0 - ray.direction[0].abs());
            }
            out.points.push(point);
            out.weights.push(if self.fault == RayFault::NotANumber && i == 3 { f32::NAN } else { delta });
        }
        if self.fault == RayFault::LostWeight {
            out.weights.pop();
        }
    }

    fn fitted(&self, _: Lengths) -> Result<Option<Box<dyn Projector>>> {
        let fitted =
            |samples, fault| -> Result<Option<Box<dyn Projector>>> { Ok(Some(Box::new(Self { fault, samples }))) };
        match self.fault {
            RayFault::FitsUnsound => fitted(10, RayFault::LostWeight),
            RayFault::FitsAnew => {
                static MADE: AtomicU32 = AtomicU32::new(0);
                fitted(10 + MADE.fetch_add(1, Ordering::Relaxed) as usize % 2, RayFault::None)
            }
            RayFault::FitsNot => sound(false).map(|()| None),
            _ => fitted(20, RayFault::None),
        }
    }

    fn adjoint(&self, weights: &[f32], dline: f64, dmu: &mut [f64]) {
        let scale = if self.fault == RayFault::LongAdjoint { 1.01 } else { 1.0 };
        for (d, &w) in dmu.iter_mut().zip(weights) {
            let before = if self.fault == RayFault::AddsAdjoint { *d } else { 0.0 };
            *d = before + scale * f64::from(w) * dline;
        }
    }

    fn fault(&self) -> Result<()> {
        sound(self.fault != RayFault::Reports)
    }

    fn describe(&self) -> String {
        format!("toy rays: {:?}", self.fault)
    }
}

#[test]
fn every_fault_of_a_ray_projector_fails_its_property() {
    let toy = |fault| ToyRays { fault, samples: 10 };
    each_fails(RayFault::None, RayFault::ALL, |fault| check_projector(&toy(fault)));
}

faults! {
    /// What is wrong with an initializer.
    WeightFault {
        /// It fills more than it reports.
        Silent: "leaves the rest alone";
        /// A block is missing in its report.
        Forgets: "applies";
        /// The last number of a block is left as it was.
        Skips: only "fills";
        /// One number is infinite.
        Infinite: "finite";
        /// Numbers depend on the call.
        Remembers: "repeatable";
        /// It refuses.
        Refuses: "applies";
    }
}

impl Initializer for WeightFault {
    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport> {
        sound(*self != Self::Refuses)?;
        let mut report = InitReport::default();
        for b in &layout.blocks {
            let own = b.name.starts_with("field");
            if own || (*self == Self::Silent && b.name.starts_with("normalizers")) {
                let skipped = usize::from(*self == Self::Skips);
                arena.params[b.range.start..b.range.end - skipped].fill(0.25);
            }
            if own && *self == Self::Infinite {
                arena.params[b.range.start] = f32::INFINITY;
            }
            if own && *self == Self::Remembers {
                arena.params[b.range.start] = calls() as f32;
            }
            if own {
                report.loaded.push(b.name.clone());
            } else if *self != Self::Forgets {
                report.fresh.push((b.name.clone(), "not filled".into()));
            }
        }
        Ok(report)
    }

    fn describe(&self) -> String {
        format!("toy weights: {self:?}")
    }
}

#[test]
fn every_fault_of_an_initializer_fails_its_property() {
    each_fails(WeightFault::None, WeightFault::ALL, |fault| check_initializer(&fault));
}

faults! {
    /// What is wrong with a loss.
    LossFault {
        /// The derivative is 1 % too large.
        Derivative: only "finite differences";
        /// The derivative has the wrong sign.
        Away: "least where values agree";
        /// It is not 0 where both values agree.
        Offset: "least where values agree";
        /// Squares overflow.
        Overflows: "extremes";
        /// A NaN is taken for 0.
        HidesNan: "poison";
        /// The result depends on the call.
        Remembers: "repeatable";
        /// Calls at the same time share a number.
        Shares: only "threads";
        /// It learns and does not say that it needs a scan.
        Secret: "learns from a scan";
        /// It says that it needs a scan and learns nothing.
        Idle: "learns from a scan";
        /// What it learned is ten times as large.
        Grows: "learns from a scan";
        /// It says that something went wrong.
        Reports: "no fault";
        /// It panics.
        Panics: "finite differences";
    }
}

/// `s·d²/2`.
struct ToyLoss {
    fault: LossFault,
    /// What is wrong with its WGSL.
    on_device: LossFault,
    scale: f64,
}

impl ToyLoss {
    fn new(fault: LossFault) -> Self {
        Self { fault, on_device: fault, scale: 1.0 }
    }
}

impl Loss for ToyLoss {
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64) {
        let d = self.scale * (predicted - measured);
        let (value, slope) = (0.5 * d * d / self.scale, d);
        match self.fault {
            LossFault::Derivative => (value, 1.01 * slope),
            LossFault::Away => (value, -slope),
            LossFault::Offset => (value + 1e-3, slope),
            LossFault::Overflows => (value * value.powi(4) / value.powi(4), slope),
            LossFault::HidesNan if predicted.is_nan() => (0.0, 0.0),
            LossFault::Remembers => (value * (1.0 + f64::from(calls() % 1000) * 1e-12), slope),
            LossFault::Shares => (shared(3, value), slope),
            LossFault::Panics => panic!("as ordered"),
            _ => (value, slope),
        }
    }

    fn wgsl(&self) -> Option<Fragment> {
        let slope = if self.on_device == LossFault::Derivative { "1.01 * d" } else { "d" };
        Some(Fragment::new(&[&format!(
            "fn stage_at(predicted: f32, measured: f32) -> vec2<f32> {{
    let d = predicted - measured;
    return vec2<f32>(0.5 * d * d, {slope});
}}
"
        )]))
    }

    fn needs_scan(&self) -> bool {
        matches!(self.fault, LossFault::Idle | LossFault::Grows)
    }

    fn fitted(&self, _: &NoiseModel<'_>) -> Option<Box<dyn Loss>> {
        let learns = matches!(self.fault, LossFault::Secret | LossFault::Grows);
        learns.then(|| Box::new(Self { scale: 10.0, ..Self::new(LossFault::None) }) as Box<dyn Loss>)
    }

    fn fault(&self) -> Result<()> {
        sound(self.fault != LossFault::Reports)
    }

    fn describe(&self) -> String {
        format!("toy loss: {:?}", self.fault)
    }
}

#[test]
fn every_fault_of_a_loss_fails_its_property() {
    each_fails(LossFault::None, LossFault::ALL, |fault| check_loss(&ToyLoss::new(fault)));
}

faults! {
    /// What is wrong with a prior.
    PriorFault {
        /// One derivative is missing.
        Forgotten: only "finite differences";
        /// Gradients replace what is there.
        Overwrites: "gradients add";
        /// The scale is left out.
        Unscaled: "scale";
        /// The penalty is scaled too.
        ScalesPenalty: "scale";
        /// One number past the end of the gradient.
        WritesOutside: "guards";
        /// Cubes overflow.
        Overflows: "extremes";
        /// A NaN is passed over.
        HidesNan: "poison";
        /// The result depends on the call.
        Remembers: "repeatable";
        /// Calls at the same time share a number.
        Shares: only "threads";
        /// Blocks of one point.
        NoBlocks: "blocks";
        /// It says that something went wrong.
        Reports: "no fault";
    }
}

/// `Σ v²/2`.
struct ToyPrior {
    fault: PriorFault,
    /// What is wrong with its WGSL.
    on_device: PriorFault,
}

impl ToyPrior {
    fn new(fault: PriorFault) -> Self {
        Self { fault, on_device: fault }
    }
}

impl Prior for ToyPrior {
    fn blocks(&self) -> Blocks {
        let edge = if self.fault == PriorFault::NoBlocks { 1 } else { 3 };
        Blocks { edge, count: 2, spacing: 1.0, weight: 1.0 }
    }

    fn block(&self, values: &[f64], scale: f64, gradient: &mut [f64]) -> f64 {
        let mut sum = 0.0;
        for (i, (v, g)) in values.iter().zip(gradient.iter_mut()).enumerate() {
            if self.fault == PriorFault::HidesNan && v.is_nan() || self.fault == PriorFault::Forgotten && i == 13 {
                sum += if self.fault == PriorFault::HidesNan { 0.0 } else { 0.5 * v * v };
                continue;
            }
            sum += match self.fault {
                PriorFault::Overflows => 0.5 * v * v * (v.powi(12) + 1.0) / (v.powi(12) + 1.0),
                PriorFault::ScalesPenalty => 0.5 * v * v * scale,
                PriorFault::Shares => shared(4, 0.5 * v * v),
                PriorFault::Remembers => 0.5 * v * v * (1.0 + f64::from(calls() % 1000) * 1e-12),
                _ => 0.5 * v * v,
            };
            let slope = if self.fault == PriorFault::Unscaled { *v } else { scale * v };
            *g = if self.fault == PriorFault::Overwrites { slope } else { *g + slope };
        }
        if self.fault == PriorFault::WritesOutside {
            poke(gradient, values.len() as isize);
        }
        sum
    }

    fn wgsl(&self) -> Option<Fragment> {
        let slope = if self.on_device == PriorFault::Forgotten { "select(v, 0.0, p == 13u)" } else { "v" };
        Some(Fragment::new(&[&format!(
            "fn stage_at(p: u32) -> vec2<f32> {{
    let v = stage_value(p);
    return vec2<f32>(0.5 * v * v, {slope});
}}
"
        )]))
    }

    fn fault(&self) -> Result<()> {
        sound(self.fault != PriorFault::Reports)
    }

    fn describe(&self) -> String {
        format!("toy prior: {:?}", self.fault)
    }
}

#[test]
fn every_fault_of_a_prior_fails_its_property() {
    each_fails(PriorFault::None, PriorFault::ALL, |fault| check_prior(&ToyPrior::new(fault)));
}

/// A formula for a device that is not the one for the CPU is found out.
#[test]
fn wgsl_with_another_derivative_fails() {
    let Some(shared) = device::shared("the WGSL of toys") else { return };
    for [cpu, device] in
        [[LossFault::None; 2], [LossFault::None, LossFault::Derivative], [LossFault::Derivative, LossFault::None]]
    {
        let report = check_loss_wgsl(&ToyLoss { on_device: device, ..ToyLoss::new(cpu) }, shared);
        assert_eq!(report.passed(), cpu == device, "{report}");
    }
    for on_device in [PriorFault::None, PriorFault::Forgotten] {
        let report = check_prior_wgsl(&ToyPrior { on_device, ..ToyPrior::new(PriorFault::None) }, shared);
        assert_eq!(report.passed(), on_device == PriorFault::None, "{report}");
    }
}

/// Settings that lose a number when they are read.
#[derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
struct Lossy {
    #[serde(skip_deserializing)]
    lost: f64,
}

conefield_core::stage_type!(LossSpec, "test-lossy", Lossy, "for tests", example = r#"{"lost": 1.0}"#);

impl LossSpec for Lossy {
    fn build(&self) -> Result<Box<dyn Loss>> {
        Ok(Box::new(ToyLoss::new(LossFault::None)))
    }
}

#[test]
fn settings_that_get_lost_are_found_out() {
    let report = check_settings::<dyn LossSpec>("test-lossy", &serde_json::json!({"lost": 2.0}));
    assert_eq!(report.failed(), ["save and load"], "{report}");
    let report = check_settings::<dyn LossSpec>("test-none", &serde_json::json!({}));
    assert_eq!(report.failed(), ["save and load", "a name alone"], "{report}");
}

faults! {
    /// What is wrong with a basis. It is that of voxels otherwise.
    BasisFault {
        /// It has no grid of voxels that it is made for.
        Refuses: "builds";
        /// The number of coefficients follows from the size of voxels.
        CountsMillimetres: "builds";
        /// The way back is a thousandth too long.
        LongAdjoint: "adjoint: double precision", "adjoint: single precision";
        /// Small voxels are rounded away in single precision.
        CoarseSingle: "single precision";
        /// Voxels are squared.
        Squares: "linear";
        /// Voxels are added to what is there.
        AddsVoxels: "overwrites";
        /// So are coefficients.
        AddsCoefficients: "overwrites";
        /// Every coefficient counts against its voxel.
        Negative: "no negative entries";
        /// It says that its coefficients are samples and doubles everything.
        Doubles: only "samples";
        /// The result depends on the number of threads.
        Threads: "threads";
        /// It has a fault to report.
        Fails: "no fault";
    }
}

struct BasisOn(BasisFault, VoxelGrid);

impl Basis for BasisFault {
    fn on(&self, grid: &VoxelGrid) -> Result<Box<dyn Expansion>> {
        sound(*self != Self::Refuses || grid.shape[0] > 1)?;
        Ok(Box::new(BasisOn(*self, *grid)))
    }
    fn describe(&self) -> String {
        format!("toy: {self:?}")
    }
}

impl Expansion for BasisOn {
    fn coefficients(&self) -> VoxelGrid {
        let mut grid = self.1;
        if self.0 == BasisFault::CountsMillimetres {
            grid.shape[0] = grid.size()[0].ceil() as usize;
        }
        grid
    }
    fn are_samples(&self) -> bool {
        matches!(self.0, BasisFault::None | BasisFault::Doubles)
    }
    fn operator(&self) -> &dyn BasisOperator<f32> {
        self
    }
    fn reference(&self) -> Option<&dyn BasisOperator<f64>> {
        Some(self)
    }
    fn fault(&self) -> Result<()> {
        sound(self.0 != BasisFault::Fails)
    }
}

impl<R: Real> BasisOperator<R> for BasisOn {
    fn expand(&self, coefficients: ArrayView3<'_, R>, mut voxels: ArrayViewMut3<'_, R>) {
        let many = rayon::current_num_threads() == 3;
        for (v, &c) in voxels.iter_mut().zip(&coefficients) {
            *v = match self.0 {
                BasisFault::AddsVoxels => *v + c,
                BasisFault::Squares => c * c,
                BasisFault::Negative => R::ZERO - c,
                BasisFault::Doubles => c + c,
                BasisFault::CoarseSingle if size_of::<R>() == 4 => R::of((c.f64() * 1e3).round() / 1e3),
                BasisFault::Threads if many => c * R::of(1.0 + 1e-6),
                _ => c,
            };
        }
    }

    fn adjoint(&self, voxels: ArrayView3<'_, R>, mut coefficients: ArrayViewMut3<'_, R>) {
        for (c, &v) in coefficients.iter_mut().zip(&voxels) {
            *c = match self.0 {
                BasisFault::AddsCoefficients => *c + v,
                BasisFault::LongAdjoint => v * R::of(1.001),
                BasisFault::Negative => R::ZERO - v,
                BasisFault::Doubles => v + v,
                _ => v,
            };
        }
    }
}

#[test]
fn every_fault_of_a_basis_fails_its_property() {
    each_fails(BasisFault::None, BasisFault::ALL, |fault| check_basis(&fault));
}

faults! {
    /// What is wrong with a regularizer: `½‖x‖²` otherwise, whose proximal map is `v/(1 + τ)` within the bounds.
    RegularizerFault {
        /// The map shrinks half as much as it should.
        Halved: "proximal map";
        /// The map grows.
        Grows: "nonexpansive";
        /// The penalty is concave.
        Concave: "convex";
        /// The penalty of nothing is not a number.
        NotANumber: "value";
        /// Less weight with more noise.
        LessWithNoise: "weight";
        /// What is below 0 stays.
        Negative: "not negative";
        /// It takes bounds and ignores them.
        Unbounded: "bounds";
        /// A weight of 0 shrinks as well.
        ShrinksAlways: "weight of 0";
        /// The map adds to what is there.
        Adds: "overwrites";
        /// The map of a call depends on how many came before, and that is no part of the state.
        Forgets: "state";
        /// It has an array that it did not ask the space for.
        Uncounted: only "tally";
        /// The result depends on the number of threads.
        Threads: "threads";
        /// It has a fault to report after a call.
        Fails: "no fault";
    }
}

struct PenaltyOn {
    fault: RegularizerFault,
    bounds: Bounds,
    calls: u64,
    state: Vec<f32>,
}

impl Regularizer for RegularizerFault {
    fn on(&self, grid: &VoxelGrid, _: &Space) -> Result<Box<dyn Penalty>> {
        let held = if *self == Self::Uncounted { grid.shape.iter().product() } else { 0 };
        Ok(Box::new(PenaltyOn { fault: *self, bounds: Bounds::default(), calls: 0, state: vec![0.0; held] }))
    }
    fn weight(&self, _: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(if *self == Self::LessWithNoise { 1.0 / (1.0 + noise(1.0)) } else { noise(1.0) })
    }
    fn describe(&self) -> String {
        format!("toy: {self:?}")
    }
}

impl Penalty for PenaltyOn {
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        let square: f64 = x.iter().map(|x| f64::from(*x).powi(2)).sum();
        match self.fault {
            RegularizerFault::Concave => square.sqrt().sqrt(),
            RegularizerFault::NotANumber => square * square / square,
            _ => 0.5 * square,
        }
    }

    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        self.calls += 1;
        let shrink = match self.fault {
            RegularizerFault::Halved => 1.0 + 0.5 * tau,
            RegularizerFault::Grows => 0.8,
            RegularizerFault::ShrinksAlways => 1.01 + tau,
            RegularizerFault::Forgets => 1.0 + tau * (1.0 + 0.5 / self.calls as f32),
            RegularizerFault::Threads if rayon::current_num_threads() == 3 => 1.0 + 1.01 * tau,
            _ => 1.0 + tau,
        };
        for (u, v) in u.iter_mut().zip(v) {
            let x = if self.fault == RegularizerFault::Negative { v / shrink } else { self.bounds.clip(v / shrink) };
            *u = if self.fault == RegularizerFault::Adds { *u + x } else { x };
        }
    }

    fn confine(&mut self, bounds: Bounds) -> Result<()> {
        if self.fault != RegularizerFault::Unbounded {
            self.bounds = bounds;
        }
        Ok(())
    }

    fn state(&mut self) -> Vec<(&str, StatePart<'_>)> {
        vec![("state", StatePart::Host(&mut self.state))]
    }
    fn fault(&self) -> Result<()> {
        sound(self.fault != RegularizerFault::Fails || self.calls == 0)
    }
}

#[test]
fn every_fault_of_a_regularizer_fails_its_property() {
    each_fails(RegularizerFault::None, RegularizerFault::ALL, |fault| check_regularizer(&fault));
}

faults! {
    /// What is wrong with a data term: least squares otherwise.
    DataFault {
        /// The derivative is twice what it is.
        Steep: "finite differences";
        /// One derivative is NaN.
        Hole: "finite differences", "finite";
        /// The bound of the curvature is a tenth too low.
        LowBound: only "curvature";
        /// It falls where residuals grow.
        Upside: "curvature", "least where nothing is left";
        /// A view counts more after others.
        Neighbours: "views stand alone";
        /// Ten times the noise is found.
        Loud: "noise";
        /// Noise is spread as if it were not weighted.
        Wide: "spread of noise";
        /// 0 over 0 on a scan of nothing.
        NotANumber: "finite";
        /// The result depends on the number of threads.
        Threads: "threads";
        /// It refuses a scan.
        LearnsNothing: "learns from a scan";
        /// It has a fault to report.
        Fails: "no fault";
    }
}

struct DataOn {
    fault: DataFault,
    /// What was measured first.
    first: f32,
    /// Views that were asked for.
    asked: AtomicU64,
}

impl DataTerm for DataFault {
    fn of(&self, measured: ArrayView3<'_, f32>) -> Result<Box<dyn Misfit>> {
        sound(*self != Self::LearnsNothing)?;
        Ok(Box::new(DataOn { fault: *self, first: measured[[0, 0, 0]], asked: AtomicU64::new(0) }))
    }
    fn describe(&self) -> String {
        format!("toy: {self:?}")
    }
}

impl Misfit for DataOn {
    fn differentiate(&self, _: usize, _: &[f32], residuals: &mut [f32]) -> f64 {
        let square: f64 = residuals.iter().map(|r| f64::from(*r).powi(2)).sum();
        let asked = self.asked.fetch_add(1, Ordering::Relaxed);
        let factor = match self.fault {
            DataFault::Steep => 2.0,
            DataFault::Neighbours if asked % 3 == 1 => 1.001,
            DataFault::NotANumber => self.first * f32::NAN,
            DataFault::Threads if rayon::current_num_threads() == 3 => 1.0 + 1e-6,
            DataFault::Upside => -1.0,
            _ => 1.0,
        };
        residuals.iter_mut().for_each(|r| *r *= factor);
        if self.fault == DataFault::Hole {
            residuals[0] = f32::NAN;
        }
        if self.fault == DataFault::Upside { -0.5 * square } else { 0.5 * square }
    }
    fn curve(&self, _: usize, _: &[f32], values: &mut [f32]) {
        if self.fault == DataFault::LowBound {
            values.iter_mut().for_each(|x| *x *= 0.9);
        }
    }
    fn spread(&self, _: usize, _: &[f32], values: &mut [f32]) {
        match self.fault {
            DataFault::LowBound => values.iter_mut().for_each(|x| *x *= 0.9f32.sqrt()),
            DataFault::Wide => values.iter_mut().for_each(|x| *x *= 1.2),
            _ => {}
        }
    }
    fn fault(&self) -> Result<()> {
        sound(self.fault != DataFault::Fails)
    }
    fn noise(&self) -> f64 {
        if self.fault == DataFault::Loud { 0.2 } else { 0.02 }
    }
    fn describe(&self) -> String {
        "toy".into()
    }
}

#[test]
fn every_fault_of_a_data_term_fails_its_property() {
    each_fails(DataFault::None, DataFault::ALL, |fault| check_data_term(&fault));
}
