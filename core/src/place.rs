//! Places: where the arrays of a method live.
//!
//! Volumes and views are large, and moving them takes longer than most computations with them. A method requests
//! [`Array`]s from a [`Place`] and combines them there. It moves numbers only where it says so: [`Place::load`],
//! [`Place::store`], and what is made of the two.
//!
//! A place must allocate, load and store. The other methods have defaults that compute on the host: arrays in its memory
//! are used as they are, others are stored, changed and loaded again. A place with kernels of its own overrides them.

mod map;
mod penalty;
mod ranks;
mod streamed;
mod threads;
mod views;

pub use map::{ADD, CLIP, DIVIDE, EXTRAPOLATE, INVERT, MULTIPLY, Map, RELAX, Reduction, squares};
pub use penalty::{Bounds, Confines, Dual, Guide, Kernels, Penalty, ProximalStep, Update, UpdateOf};
pub use ranks::{Peers, Ranks, Slab};
pub use streamed::{SPARE, Streamed, zeros_with_spare};
pub use threads::Threads;
pub use views::{FilteredViews, MeasuredViews, RowWeights, Weighing};

use crate::allowance;
use crate::error::{Error, Result};
use crate::geometry::Geometry;
use crate::parallel;
use crate::voxel::VoxelProjector;
use ndarray::{Array3, ArrayView3, ArrayViewMut3, Axis, CowArray, Ix3, s};
use serde::Serialize;
use std::any::Any;
use std::borrow::Cow;
use std::sync::Arc;

/// Elements of an array that lives in a place.
pub struct Held<T> {
    shape: [usize; 3],
    data: Data<T>,
}

/// Numbers: a volume `[x, y, z]`, or images `[view, row, column]`.
pub type Array = Held<f32>;
/// A flag per voxel or pixel.
pub type Mask = Held<bool>;

enum Data<T> {
    Host(Array3<T>),
    There(Box<dyn Any + Send + Sync>),
    /// Planes along the first axis, from plane `first` on.
    Part {
        first: usize,
        planes: Box<Held<T>>,
    },
}

impl<T> Held<T> {
    /// An array in the host's memory. Copies it unless it is in standard order.
    pub fn host(array: Array3<T>) -> Self
    where
        T: Clone,
    {
        let array = if array.is_standard_layout() { array } else { array.as_standard_layout().into_owned() };
        Self { shape: array.dim().into(), data: Data::Host(array) }
    }

    /// An array without elements.
    pub fn nothing() -> Self {
        Self { shape: [0; 3], data: Data::There(Box::new(())) }
    }

    /// An array that a place keeps as `data`.
    pub fn there(shape: [usize; 3], data: impl Any + Send + Sync) -> Self {
        Self { shape, data: Data::There(Box::new(data)) }
    }

    /// Planes of an array that several processes share, from plane `first` on.
    pub fn part(shape: [usize; 3], first: usize, planes: Self) -> Self {
        Self { shape, data: Data::Part { first, planes: Box::new(planes) } }
    }

    /// The planes at hand of an array that several processes share, and the number of the first one.
    pub fn planes(&self) -> Option<(usize, &Self)> {
        match &self.data {
            Data::Part { first, planes } => Some((*first, planes)),
            _ => None,
        }
    }

    /// Mutable version of [`Held::planes`].
    pub fn planes_mut(&mut self) -> Option<(usize, &mut Self)> {
        match &mut self.data {
            Data::Part { first, planes } => Some((*first, planes)),
            _ => None,
        }
    }

    /// Its shape.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The array in the host's memory, if it lives there.
    pub fn on_host(&self) -> Option<&Array3<T>> {
        match &self.data {
            Data::Host(array) => Some(array),
            _ => None,
        }
    }

    /// Mutable version of [`Held::on_host`].
    pub fn on_host_mut(&mut self) -> Option<&mut Array3<T>> {
        match &mut self.data {
            Data::Host(array) => Some(array),
            _ => None,
        }
    }

    /// The elements at hand in order, if they live in the host's memory; else none.
    pub fn slice(&self) -> &[T] {
        match &self.data {
            Data::Part { planes, .. } => planes.slice(),
            _ => self.on_host().and_then(|array| array.as_slice()).unwrap_or_default(),
        }
    }

    /// Mutable version of [`Held::slice`].
    pub fn slice_mut(&mut self) -> &mut [T] {
        match &mut self.data {
            Data::Part { planes, .. } => planes.slice_mut(),
            Data::Host(array) => array.as_slice_mut().unwrap_or_default(),
            Data::There(_) => &mut [],
        }
    }

    /// What a place keeps of it.
    pub fn get<D: Any>(&self) -> Option<&D> {
        match &self.data {
            Data::There(data) => data.downcast_ref(),
            _ => None,
        }
    }
}

/// A part of the state that a checkpoint keeps.
pub enum StatePart<'a> {
    /// An array in a place.
    Placed(&'a mut Array),
    /// Numbers of a stage that runs on the host.
    Host(&'a mut [f32]),
}

impl StatePart<'_> {
    /// Number of elements.
    pub fn count(&self) -> usize {
        match self {
            Self::Placed(x) => x.len(),
            Self::Host(x) => x.len(),
        }
    }

    /// Its numbers in the host's memory. Of several processes, only the leading one needs them.
    pub fn read(&self, place: &dyn Place) -> Result<Cow<'_, [f32]>> {
        match self {
            Self::Host(x) => Ok(Cow::Borrowed(x)),
            Self::Placed(x) if x.on_host().is_some() => Ok(Cow::Borrowed(x.slice())),
            Self::Placed(x) => Ok(Cow::Owned(place.gather(x)?.into_owned().into_raw_vec_and_offset().0)),
        }
    }

    /// Overwrites it with as many numbers.
    pub fn load(&mut self, place: &dyn Place, from: &[f32]) -> Result<()> {
        match self {
            Self::Host(x) => x.copy_from_slice(from),
            Self::Placed(x) => {
                let from = ArrayView3::from_shape(x.shape(), from);
                place.load(from.unwrap_or_else(|e| unreachable!("as many numbers: {e}")), x, 0)?;
            }
        }
        Ok(())
    }
}

/// Bytes that crossed between the host and a device.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Moved {
    /// From the host to the device.
    pub to_device: u64,
    /// From the device to the host.
    pub from_device: u64,
}

/// The rays of some views, and the projector that computes line integrals along them.
#[derive(Clone, Copy)]
pub struct ViewRays<'a> {
    /// The projector.
    pub projector: &'a dyn VoxelProjector,
    /// Source and detector of all views, and the volume.
    pub geometry: &'a Geometry,
    /// The views.
    pub views: &'a [usize],
}

/// The derivative of a smoothed total variation, `Σ_j √(1 + Σ_k (unit·weights_k·(x_{j+k} − x_j))²)`, by each voxel.
/// Differences across the far faces are 0.
pub struct VariationSlope<'a> {
    /// Weights of differences along x, y, z.
    pub weights: [f32; 3],
    /// Factor of differences.
    pub unit: f32,
    /// Overwrites its second argument with the slope of the first, and returns the sum of squares.
    pub host: &'a (dyn Fn(&[f32], &mut [f32]) -> f64 + Sync),
}

/// Allocates arrays and combines them. All arrays of a call come from this place.
pub trait Place: Send + Sync {
    /// The name of its device; `None` for the host.
    fn device(&self) -> Option<String> {
        None
    }

    /// Zeros.
    ///
    /// # Errors
    /// Too little memory on a device.
    fn zeros(&self, shape: [usize; 3]) -> Result<Array>;

    /// Overwrites planes of `to` along its first axis, from plane `first` on.
    fn load(&self, from: ArrayView3<'_, f32>, to: &mut Array, first: usize) -> Result<()>;

    /// Overwrites `to` with planes of `from` along its first axis, from plane `first` on.
    fn store(&self, from: &Array, first: usize, to: ArrayViewMut3<'_, f32>) -> Result<()>;

    /// Refuses a projector that cannot work here. A method calls it before it takes arrays.
    fn admits(&self, projector: &dyn VoxelProjector) -> Result<()> {
        let _ = projector;
        Ok(())
    }

    /// Whether arrays of so many bytes fit here together.
    fn holds(&self, bytes: u64) -> bool {
        let _ = bytes;
        true
    }

    /// A place for arrays that do not fit here: in the host's memory. Line integrals are still computed here.
    fn streamed(&self) -> Option<Arc<dyn Place>> {
        None
    }

    /// Bytes of an array that a method may pass through many times.
    fn room(&self) -> u64 {
        u64::MAX
    }

    /// Whether `flag` is true in any process that shares the arrays, so that all of them stop and write together.
    fn agree(&self, flag: bool) -> bool {
        flag
    }

    /// The slab of this process in a penalty of a volume with this many planes, if several processes share the arrays.
    /// Each process needs `halo` planes of its neighbours.
    fn slab(&self, planes: usize, halo: usize) -> Option<Slab> {
        let _ = (planes, halo);
        None
    }

    /// An array with the numbers of `from`.
    fn adopt(&self, from: Array3<f32>) -> Result<Array> {
        let mut array = self.zeros(from.dim().into())?;
        self.load(from.view(), &mut array, 0)?;
        Ok(array)
    }

    /// A copy of `flags`.
    fn mask(&self, flags: Array3<bool>) -> Result<Mask> {
        Ok(Mask::host(flags))
    }

    /// The measured images of a scan for [`Place::compare`] and [`Place::weigh`]. They are loaded here if they fit.
    fn views<'a>(&self, measured: &'a Array3<f32>) -> Result<MeasuredViews<'a>> {
        Ok(MeasuredViews { measured, here: None })
    }

    /// The numbers of `x` in the host's memory, moved there if need be.
    fn read<'a>(&self, x: &'a Array) -> Result<CowArray<'a, f32, Ix3>> {
        if let Some(array) = x.on_host() {
            return Ok(array.into());
        }
        let mut array = Array3::zeros(x.shape());
        self.store(x, 0, array.view_mut())?;
        Ok(array.into())
    }

    /// Like [`Place::read`], but only in the leading process; an empty array in the others.
    fn gather<'a>(&self, x: &'a Array) -> Result<CowArray<'a, f32, Ix3>> {
        self.read(x)
    }

    /// Lets `work` change the numbers of `x` in the host's memory.
    fn change(&self, x: &mut Array, work: &mut dyn FnMut(&mut Array3<f32>)) -> Result<()> {
        on_host(self, x, true, work)
    }

    /// Overwrites the numbers of `x` with those that `work` writes in the host's memory.
    fn overwrite(&self, x: &mut Array, work: &mut dyn FnMut(&mut Array3<f32>)) -> Result<()> {
        on_host(self, x, false, work)
    }

    /// Ends the array and returns its numbers.
    fn take(&self, x: Array) -> Result<Array3<f32>> {
        match x.data {
            Data::Host(array) => Ok(array),
            _ => Ok(self.read(&x)?.into_owned()),
        }
    }

    /// Overwrites `x` with `value`.
    fn fill(&self, x: &mut Array, value: f32) -> Result<()> {
        self.change(x, &mut |x| parallel::change_all(x, |_| value))
    }

    /// Overwrites planes of `out`: each one in `at` with the next plane of `from`, from plane `first` on.
    fn scatter(&self, from: &Array, first: usize, out: &mut Array, at: &[usize]) -> Result<()> {
        let from = self.read(from)?;
        self.change(out, &mut |out| {
            for (plane, &i) in from.outer_iter().skip(first).zip(at) {
                allowance::trim();
                out.index_axis_mut(Axis(0), i).assign(&plane);
            }
        })
    }

    /// Sets the elements of `x` outside `inside` to `value`.
    fn keep(&self, x: &mut Array, inside: &Mask, value: f32) -> Result<()> {
        self.change(x, &mut |x| {
            if let Some(inside) = inside.on_host() {
                parallel::over(x.outer_iter_mut().zip(inside.outer_iter()), |_, (mut x, inside)| {
                    x.zip_mut_with(&inside, |x, inside| *x = if *inside { *x } else { value });
                });
            }
        })
    }

    /// Overwrites each element `o` of `out` with the value of `map` at `o` and the elements of `inputs`, which have the
    /// same shape. `factors` are the map's constants a and b.
    fn map(&self, map: &Map, factors: [f64; 2], out: &mut Array, inputs: &[&Array]) -> Result<()> {
        let inputs = inputs.iter().map(|x| self.read(x)).collect::<Result<Vec<_>>>()?;
        self.change(out, &mut |out| map.run(factors, out, &inputs))
    }

    /// The reduction of `x`, or of `x` and `y`, which have the same shape.
    fn reduce(&self, kind: Reduction, x: &Array, y: &Array) -> Result<f64> {
        Ok(kind.of(&self.read(x)?, &self.read(y)?))
    }

    /// Overwrites the first images of `images` with the line integrals of `volume`; see
    /// [`crate::voxel::VoxelOperator::forward`].
    fn forward(&self, rays: ViewRays<'_>, volume: &Array, images: &mut Array) -> Result<()> {
        let volume = self.read(volume)?;
        let operator = rays.projector.operator();
        self.change(images, &mut |images| project(rays, volume.view(), images))?;
        operator.fault()
    }

    /// Adds the adjoint of the line integrals for the first images of `images` to `volume`.
    fn adjoint(&self, rays: ViewRays<'_>, images: &Array, volume: &mut Array) -> Result<()> {
        let images = self.read(images)?;
        let ViewRays { projector, geometry, views } = rays;
        let operator = projector.operator();
        self.change(volume, &mut |volume| {
            operator.adjoint(geometry, views, images.slice(s![..views.len(), .., ..]), volume.view_mut());
        })?;
        operator.fault()
    }

    /// Replaces the first images `a` of `images`, line integrals of the views `views`, with `weights·φ'(p − a)`; see
    /// [`Weighing`]. Returns `Σ (p − a)²` and `Σ φ(p − a)`.
    fn compare(&self, by: &Weighing<'_>, views: &[usize], images: &mut Array) -> Result<[f64; 2]> {
        let weights = by.weights.map(|w| self.read(w)).transpose()?;
        let mut sums = [0.0; 2];
        self.change(images, &mut |images| sums = by.compare(views, images, weights.as_ref()))?;
        by.fault()?;
        Ok(sums)
    }

    /// Multiplies the first images of `images` by bounds of φ'' (`spread` is false), or by the standard deviation of φ'
    /// under noise; see [`crate::data_term::Misfit`].
    fn weigh(&self, by: &Weighing<'_>, spread: bool, views: &[usize], images: &mut Array) -> Result<()> {
        by.weigh(self, spread, views, images)
    }

    /// Weights and filters the first images of `images`, the measured views `views`, and adds their distance-weighted
    /// back-projection to `slab`, planes of the volume along x from plane `first` on.
    fn filtered(
        &self,
        work: &dyn FilteredViews,
        views: &[usize],
        images: &mut Array,
        slab: &mut Array,
        first: usize,
    ) -> Result<()> {
        self.change(images, &mut |images| {
            views::filter(work, views, images);
        })?;
        let images = self.read(images)?;
        self.change(slab, &mut |slab| {
            work.backproject(views, images.slice(s![..views.len(), .., ..]), slab.view_mut(), first);
        })
    }

    /// A proximal gradient step with `penalty`, whose proximal map has the weight `tau`.
    fn update(&self, step: ProximalStep<'_>, tau: f32, penalty: &mut dyn Penalty) -> Result<()> {
        self.update_around(step, tau, penalty)
    }

    /// Overwrites `v` with the proximal map of `penalty` at `v`; see [`Penalty::prox`].
    fn prox(&self, v: &mut Array, tau: f32, penalty: &mut dyn Penalty) -> Result<()> {
        prox_on_host(self, v, tau, penalty)
    }

    /// The same, around [`Place::prox`].
    fn update_around(&self, step: ProximalStep<'_>, tau: f32, penalty: &mut dyn Penalty) -> Result<()> {
        let ProximalStep { gradient, ahead, x, towards, inside, step, momentum } = step;
        // The argument of the proximal map, in `gradient`.
        self.map(&ADD, [1.0, f64::from(step)], gradient, &[ahead])?;
        if let Some((towards, share)) = towards {
            self.map(&ADD, [f64::from(share), 1.0], gradient, &[towards])?;
            self.map(&ADD, [-f64::from(share), 1.0], gradient, &[ahead])?;
        }
        if let Some(inside) = inside {
            self.keep(gradient, inside, f32::MIN)?;
        }
        self.prox(gradient, tau, penalty)?;
        self.map(&EXTRAPOLATE, [f64::from(momentum), 0.0], ahead, &[gradient, x])?;
        self.map(&ADD, [1.0, 0.0], x, &[gradient])
    }

    /// The value of `penalty` at `x`; see [`Penalty::value`].
    fn penalty(&self, penalty: &mut dyn Penalty, x: &Array) -> Result<f64> {
        Ok(penalty.value(self.read(x)?.view()))
    }

    /// Adapts an adaptive `penalty` to `x`; see [`Penalty::adapt`].
    fn adapt(&self, penalty: &mut dyn Penalty, x: &Array) -> Result<Option<f64>> {
        Ok(penalty.adapt(self.read(x)?.view()))
    }

    /// Overwrites `out` with a slope of the total variation of `x`. Returns its sum of squares.
    fn slope(&self, slope: &VariationSlope<'_>, x: &Array, out: &mut Array) -> Result<f64> {
        let x = self.read(x)?;
        let mut sum = 0.0;
        self.change(out, &mut |out| {
            sum = (slope.host)(x.as_slice().unwrap_or_default(), out.as_slice_mut().unwrap_or_default())
        })?;
        Ok(sum)
    }
}

/// The host: arrays in its memory, kernels on its cores.
#[derive(Debug, Clone, Copy, Default)]
pub struct Host;

impl Place for Host {
    fn zeros(&self, shape: [usize; 3]) -> Result<Array> {
        Ok(Array::host(Array3::zeros(shape)))
    }

    fn room(&self) -> u64 {
        allowance::room()
    }

    fn adopt(&self, from: Array3<f32>) -> Result<Array> {
        Ok(Array::host(from))
    }

    /// A penalty can fuse the whole update into one pass over memory.
    fn update(&self, step: ProximalStep<'_>, tau: f32, penalty: &mut dyn Penalty) -> Result<()> {
        let ProximalStep { gradient, ahead, x, towards, inside, step, momentum } = step;
        let [gradient, ahead, x] = [gradient, ahead, x].map(Array::slice_mut);
        let towards = towards.map(|(to, share)| (to.slice(), share));
        penalty.update(Update { gradient, ahead, x, step, momentum, towards, inside: inside.map(Mask::slice) }, tau);
        penalty.fault()
    }

    fn load(&self, from: ArrayView3<'_, f32>, to: &mut Array, first: usize) -> Result<()> {
        self.change(to, &mut |to| {
            let mut to = to.slice_mut(s![first..first + from.len_of(Axis(0)), .., ..]);
            parallel::over(to.outer_iter_mut().zip(from.outer_iter()), |_, (mut to, from)| to.assign(&from));
        })
    }

    fn store(&self, from: &Array, first: usize, mut to: ArrayViewMut3<'_, f32>) -> Result<()> {
        if let Some(from) = from.on_host() {
            let from = from.slice(s![first..first + to.len_of(Axis(0)), .., ..]);
            parallel::over(to.outer_iter_mut().zip(from.outer_iter()), |_, (mut to, from)| to.assign(&from));
        }
        Ok(())
    }
}

/// Lets `work` change an array in the host's memory; its numbers are moved there first if `read`.
fn on_host<P: Place + ?Sized>(
    place: &P,
    x: &mut Array,
    read: bool,
    work: &mut dyn FnMut(&mut Array3<f32>),
) -> Result<()> {
    if let Some(array) = x.on_host_mut() {
        work(array);
        return Ok(());
    }
    let mut array = Array3::zeros(x.shape());
    if read {
        place.store(x, 0, array.view_mut())?;
    }
    work(&mut array);
    place.load(array.view(), x, 0)
}

/// [`Place::prox`] on the host.
pub fn prox_on_host<P: Place + ?Sized>(place: &P, v: &mut Array, tau: f32, penalty: &mut dyn Penalty) -> Result<()> {
    place.change(v, &mut |v| {
        let mut u = Array3::zeros(v.raw_dim());
        penalty.prox(v.as_slice().unwrap_or_default(), tau, u.as_slice_mut().unwrap_or_default());
        *v = u;
    })?;
    penalty.fault()
}

/// Refuses a projector whose line integrals of slabs cannot be summed.
fn additive(projector: &dyn VoxelProjector) -> Result<()> {
    let expected = "one whose line integrals are the sums of those of slabs, as joseph's";
    if projector.operator().is_additive() {
        return Ok(());
    }
    Err(Error::invalid("spec", "projector", projector.describe(), expected))
}

/// Overwrites the first of `images` with the line integrals of `volume`. A volume that memory does not hold is projected in slabs, so
/// that each is read once for all views, not once for each view. Sums of slabs round differently.
fn project(rays: ViewRays<'_>, volume: ArrayView3<'_, f32>, images: &mut Array3<f32>) {
    let ViewRays { geometry, views, .. } = rays;
    let (operator, mut images) = (rays.projector.operator(), images.slice_mut(s![..views.len(), .., ..]));
    let (bytes, nx) = (4 * volume.len() as u64, volume.len_of(Axis(0)));
    // A room is a third of the memory or less.
    if bytes / 3 <= allowance::room() || !operator.is_additive() {
        return operator.forward(geometry, views, volume, images);
    }
    let planes = ((nx as u64 * allowance::room() / bytes) as usize).max(1);
    let mut part = Array3::zeros(images.raw_dim());
    images.fill(0.0);
    for first in (0..nx).step_by(planes) {
        let planes = first..(first + planes).min(nx);
        let geometry = Geometry { volume: geometry.volume.slab(planes.clone()), ..geometry.clone() };
        operator.forward(&geometry, views, volume.slice(s![planes, .., ..]), part.view_mut());
        parallel::over(images.outer_iter_mut().zip(part.outer_iter()), |_, (mut sum, part)| sum += &part);
    }
}
