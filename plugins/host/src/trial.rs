//! Trial runs of stages before real work: on a few rows, between guard zones, under a time limit. A stage is refused if
//! it writes outside its tile, leaves outputs unwritten, returns non-finite numbers, fails or hangs. Only the
//! conformance kit checks gradients.

use crate::library::Type;
use bytemuck::Pod;
use conefield_core::pages::Pages;
use conefield_core::prelude::*;
use conefield_core::stage::TILE_ROWS;
use ndarray::Array3;
use std::ops::Range;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

/// Time limit of a trial.
pub const LIMIT: Duration = Duration::from_secs(5);

/// Guard numbers on either side of a buffer: more than a tile of the widest common stages.
pub(crate) const GUARD: usize = 1 << 14;

/// Stages with more parameters are not initialized for their trial: it takes long, and the run does it anyway.
const MANY: usize = 1 << 20;

/// Numbers with a marker of what is unwritten: a NaN that no arithmetic produces.
pub(crate) trait Marked: Real + Pod {
    const MARK: Self;

    fn is_mark(self) -> bool {
        bytemuck::bytes_of(&self) == bytemuck::bytes_of(&Self::MARK)
    }
}

impl Marked for f32 {
    const MARK: Self = Self::from_bits(0x7fc5_a7e1);
}

impl Marked for f64 {
    const MARK: Self = Self::from_bits(0x7ff8_5a7e_1c5a_7e1c);
}

/// A buffer between guard zones. Zeroed pages take no memory until written: a trial runs before the memory check.
struct Guarded<R: Marked>(Pages<R>);

impl<R: Marked> Guarded<R> {
    fn new(n: usize) -> Self {
        let mut g = Self::zeroed(n);
        g.inner().fill(R::MARK);
        g
    }

    /// A buffer with a copy of these numbers.
    fn of(values: &[R]) -> Self {
        let mut g = Self::zeroed(values.len());
        g.inner().copy_from_slice(values);
        g
    }

    fn inner(&mut self) -> &mut [R] {
        let n = self.0.len();
        &mut self.0[GUARD..n - GUARD]
    }

    fn zeroed(n: usize) -> Self {
        let mut pages = Pages::zeros(n + 2 * GUARD);
        for zone in [0..GUARD, GUARD + n..n + 2 * GUARD] {
            pages[zone].fill(R::MARK);
        }
        Self(pages)
    }

    /// Describes damage to the guard zones.
    fn broken(&self, what: &str) -> Option<String> {
        let n = self.0.len();
        let outside = (0..GUARD).chain(n - GUARD..n);
        let at = outside.into_iter().find(|&i| !self.0[i].is_mark())?;
        let place =
            if at < GUARD { format!("{} before", GUARD - at) } else { format!("{} past", at - (n - GUARD) + 1) };
        Some(format!("it writes outside its {what}: {place} {} numbers", n - 2 * GUARD))
    }

    /// Describes errors in the written numbers.
    fn unsound(&mut self, what: &str) -> Option<String> {
        let n = self.inner().len();
        let (i, v) = self.inner().iter().enumerate().find(|(_, v)| !v.f64().is_finite())?;
        let how = if v.is_mark() { "is left unwritten".into() } else { format!("is {}", v.f64()) };
        Some(format!("number {i} of {n} of its {what} {how}"))
    }

    /// Describes damage to the guard zones or errors in the written numbers.
    fn complaint(&mut self, what: &str) -> Option<String> {
        self.broken(what).or_else(|| self.unsound(what))
    }
}

/// Runs a library's constructor under the time limit, on a thread of its own, which is abandoned if it hangs.
pub(crate) fn timed<T: Send + 'static>(ty: &Type, make: impl FnOnce() -> Result<T> + Send + 'static) -> Result<T> {
    let (done, wait) = mpsc::channel();
    thread::spawn(move || {
        // The receiver is gone after a timeout.
        let _ = done.send(make());
    });
    wait.recv_timeout(LIMIT).unwrap_or_else(|e| {
        let what = match e {
            mpsc::RecvTimeoutError::Timeout => format!("it did not return within {} s", LIMIT.as_secs()),
            mpsc::RecvTimeoutError::Disconnected => "it ended its thread".into(),
        };
        Err(refused(ty, &what))
    })
}

fn refused(ty: &Type, what: &str) -> Error {
    Error::unsupported(ty.words(), format!("refused: {what}"))
}

/// Returns the complaint as an error, if there is one.
fn settled(ty: &Type, complaint: Option<String>) -> Result<()> {
    complaint.map_or(Ok(()), |complaint| Err(refused(ty, &complaint)))
}

/// Tries an encoder, normalizer or field of type `ty`.
pub(crate) fn map(ty: &Type, stage: &dyn Stage) -> Result<()> {
    let info = stage.info();
    let mut params = Guarded::zeroed(info.params);
    if info.params <= MANY {
        stage.init(1, params.inner());
        stage.fault()?;
        settled(ty, params.broken("parameters").or_else(|| params.unsound("initial parameters")))?;
    }
    for rows in [1, 3, TILE_ROWS] {
        tile(ty, stage, &mut params, rows)?;
    }
    Ok(())
}

/// Tries the kernel of a stage on a tile.
fn tile(ty: &Type, stage: &dyn Stage, params: &mut Guarded<f32>, rows: usize) -> Result<()> {
    let (info, kernel) = (stage.info(), stage.kernel());
    let range: Range<usize> = match info.grads {
        GradKind::Scatter => stage.partition().into_iter().min_by_key(Range::len).unwrap_or(0..info.params),
        _ => 0..info.params,
    };
    let mut x = Guarded::new(info.input * rows);
    for (i, x) in x.inner().iter_mut().enumerate() {
        *x = unit(mix(7, i as u64));
    }
    let [mut y, mut tape, mut dx] = [info.output, info.tape, info.input].map(|c| Guarded::new(c * rows));
    let (to, left) = (TileMut::new(y.inner(), rows), TileMut::new(tape.inner(), rows));
    kernel.forward(params.inner(), Tile::new(x.inner(), rows), to, left);
    stage.fault()?;
    settled(ty, y.broken("output").or_else(|| tape.broken("tape")).or_else(|| y.unsound("output")))?;
    let changed = info.identity && y.inner() != x.inner();
    settled(ty, changed.then(|| "an identity must return its input unchanged".into()))?;
    if kernel.passes() > 1 {
        let [mut again, mut left] = [info.output, info.tape].map(|c| Guarded::new(c * rows));
        for pass in 0..kernel.passes() {
            let (y, tape) = (TileMut::new(again.inner(), rows), TileMut::new(left.inner(), rows));
            kernel.forward_pass(pass, params.inner(), Tile::new(x.inner(), rows), y, tape);
        }
        stage.fault()?;
        settled(ty, again.broken("output in passes").or_else(|| left.broken("tape in passes")))?;
        let same = again.inner() == y.inner() && left.inner() == tape.inner();
        settled(ty, (!same).then(|| "its passes together are not its forward".into()))?;
    }
    let dy = vec![1.0; info.output * rows];
    let mut grads = Guarded::zeroed(range.len());
    kernel.backward(Backward {
        params: params.inner(),
        x: Tile::new(x.inner(), rows),
        tape: TileMut::new(tape.inner(), rows),
        dy: Tile::new(&dy, rows),
        grads: Grads { values: grads.inner(), range },
        dx: Some(TileMut::new(dx.inner(), rows)),
    });
    stage.fault()?;
    settled(ty, grads.broken("gradients").or_else(|| dx.broken("input gradient")))?;
    settled(ty, tape.broken("tape").or_else(|| x.broken("input")).or_else(|| params.broken("parameters")))?;
    settled(ty, grads.unsound("gradients").or_else(|| dx.unsound("input gradient")))
}

/// Rays along an axis, across the cube, in the opposite direction, and past the cube.
fn rays() -> [UnitRay; 4] {
    let ray = |origin, direction: [f32; 3], inside| UnitRay {
        origin,
        direction,
        inside,
        published: [0.5, 3.0],
        per_mm: 0.01,
    };
    let third = (1.0f32 / 3.0).sqrt();
    [
        ray([-1.0, 0.5, 0.5], [1.0, 0.0, 0.0], [1.0, 2.0]),
        ray([-third; 3], [third; 3], [1.0, 1.0 + 1.0 / third]),
        ray([0.5, 2.0, 0.25], [0.0, -1.0, 0.0], [1.0, 2.0]),
        ray([-1.0, 5.0, 0.5], [1.0, 0.0, 0.0], [0.0, 0.0]),
    ]
}

/// Tries a projector of type `ty`: `cast` samples a ray, with this many guard numbers behind the samples, and returns
/// the line integral of ones.
pub(crate) fn projector(ty: &Type, cast: impl Fn(&UnitRay, Option<u64>, usize) -> Result<f64>) -> Result<()> {
    for ray in rays() {
        for seed in [None, Some(3)] {
            let line = cast(&ray, seed, GUARD)?;
            if !line.is_finite() {
                return Err(refused(ty, &format!("the line integral of ones is {line}")));
            }
        }
    }
    Ok(())
}

/// Tries the adjoint of a projector of type `ty`, which writes `count` derivatives.
pub(crate) fn derivatives(ty: &Type, count: usize, adjoint: impl Fn(&mut [f64])) -> Result<()> {
    let mut dmu = Guarded::<f64>::new(count);
    adjoint(dmu.inner());
    settled(ty, dmu.complaint("derivatives"))
}

/// Tries a loss of type `ty`: `at` compares pairs of a predicted and a measured value.
pub(crate) fn loss(ty: &Type, at: impl Fn(&[f64], &[f64], [&mut [f64]; 2]) -> Result<()>) -> Result<()> {
    let values: Vec<f64> = (0..16).map(|i| 0.25 * f64::from(i) - 0.5).collect();
    for shift in [0.0, 0.25, -1.0] {
        let predicted: Vec<f64> = values.iter().map(|v| v + shift).collect();
        let [mut loss, mut slope] = [0; 2].map(|_| Guarded::<f64>::new(values.len()));
        at(&predicted, &values, [loss.inner(), slope.inner()])?;
        settled(ty, loss.broken("losses").or_else(|| slope.broken("slopes")))?;
        for (i, (loss, slope)) in loss.inner().iter().zip(slope.inner()).enumerate() {
            let pair = format!("predicted {}, measured {}", predicted[i], values[i]);
            if loss.is_mark() || slope.is_mark() {
                return Err(refused(ty, &format!("{pair}: a number is left unwritten")));
            }
            if !(loss.is_finite() && *loss >= 0.0 && slope.is_finite()) {
                return Err(refused(ty, &format!("{pair}: loss {loss}, slope {slope}")));
            }
        }
    }
    Ok(())
}

/// `n` random numbers in [0, 1).
fn drawn(n: usize) -> impl Iterator<Item = f32> {
    (0..n).map(|i| unit(mix(5, i as u64)))
}

/// Describes a number that should be finite and non-negative but is not.
fn below_zero(what: &str, value: f64) -> Option<String> {
    (!(value.is_finite() && value >= 0.0)).then(|| format!("{what} is {value}"))
}

/// Tries a prior of type `ty` on a block of `points`: `block` adds to the gradient and returns the penalty.
pub(crate) fn prior(ty: &Type, points: usize, block: impl Fn(&[f64], &mut [f64]) -> Result<f64>) -> Result<()> {
    let values: Vec<f64> = drawn(points).map(f64::from).collect();
    let mut gradient = Guarded::zeroed(points);
    let penalty = block(&values, gradient.inner())?;
    settled(ty, gradient.broken("gradient").or_else(|| below_zero("the penalty of a block", penalty)))?;
    settled(ty, gradient.unsound("gradient"))
}

/// Tries a regularizer of type `ty` on `count` coefficients: `prox` applies its proximal map and returns the penalty.
pub(crate) fn regularizer(
    ty: &Type,
    count: usize,
    mut prox: impl FnMut(&[f32], &mut [f32]) -> Result<f64>,
) -> Result<()> {
    let mut v = Guarded::of(&drawn(count).map(|x| x - 0.3).collect::<Vec<f32>>());
    for _ in 0..2 {
        let mut u = Guarded::<f32>::new(count);
        let value = prox(v.inner(), u.inner())?;
        settled(ty, u.complaint("coefficients").or_else(|| v.broken("input")))?;
        settled(ty, below_zero("the penalty", value))?;
        let negative = u.inner().iter().find(|u| **u < 0.0).map(|u| format!("its proximal map gives {u}"));
        settled(ty, negative)?;
    }
    Ok(())
}

/// Tries a data term of type `ty`: `of` builds it for a scan.
pub(crate) fn data_term<M: Misfit>(ty: &Type, of: impl Fn(ArrayView3<'_, f32>) -> Result<M>) -> Result<()> {
    let shape = [2, 6, 7];
    let scan = Array3::from_shape_vec(shape, drawn(2 * 6 * 7).map(|x| 2.0 * x).collect());
    let scan = scan.unwrap_or_else(|_| Array3::zeros(shape));
    let misfit = of(scan.view())?;
    settled(ty, below_zero("the noise that it finds", misfit.noise()))?;
    for (view, measured) in scan.outer_iter().enumerate() {
        let measured: Vec<f32> = measured.iter().copied().collect();
        let [mut residuals, mut curve, mut spread] = [0.5f32, 1.0, 1.0].map(|x| Guarded::of(&vec![x; measured.len()]));
        let sum = misfit.differentiate(view, &measured, residuals.inner());
        misfit.curve(view, &measured, curve.inner());
        misfit.spread(view, &measured, spread.inner());
        misfit.fault()?;
        settled(ty, residuals.complaint("derivatives").or_else(|| curve.complaint("curvatures")))?;
        settled(ty, spread.complaint("spread of noise").or_else(|| below_zero("the misfit", sum)))?;
    }
    Ok(())
}

/// Tries a basis of type `ty` on a grid of `voxels`.
pub(crate) fn basis(ty: &Type, voxels: [usize; 3], basis: &dyn Expansion) -> Result<()> {
    let mut complaint = try_operator(basis.operator(), voxels, basis.coefficients().shape);
    if let (None, Some(reference)) = (&complaint, basis.reference()) {
        complaint = try_operator(reference, voxels, basis.coefficients().shape);
    }
    basis.fault()?;
    settled(ty, complaint)
}

/// The first complaint about one of the two operators of a basis.
fn try_operator<R: Marked>(of: &dyn BasisOperator<R>, voxels: [usize; 3], coefficients: [usize; 3]) -> Option<String> {
    let count = |shape: [usize; 3]| shape.iter().product::<usize>();
    let try_one = |what: &str, shapes: [[usize; 3]; 2], back: bool| {
        let [mut from, mut to] = shapes.map(|shape| Guarded::<R>::new(count(shape)));
        from.inner().iter_mut().zip(drawn(count(shapes[0]))).for_each(|(x, drawn)| *x = R::of(drawn.into()));
        let x = ArrayView3::from_shape(shapes[0], &*from.inner()).ok()?;
        let y = ArrayViewMut3::from_shape(shapes[1], to.inner()).ok()?;
        if back {
            of.adjoint(x, y)
        } else {
            of.expand(x, y)
        }
        to.complaint(what).or_else(|| from.broken("input"))
    };
    try_one("voxels", [coefficients, voxels], false).or_else(|| try_one("coefficients", [voxels, coefficients], true))
}
