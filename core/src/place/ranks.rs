//! A place that several processes share: each keeps a range of planes along the first axis of every array, in the host's
//! memory or on a device of its own.
//!
//! Each process projects its slab of the volume; the partial line integrals are summed where their images are kept.
//! Images go to every process for the adjoint. A penalty works on a slab with copies of its neighbours' planes, which
//! are renewed before each proximal map. An operation without a method here works on whole arrays, in every process.
//!
//! Sums over processes are taken in the order of their ranks, so that a number of processes always gives the same bits.

use super::map::{MULTIPLY, Map, Reduction};
use super::views::filter;
use super::{
    Array, FilteredViews, Held, Mask, MeasuredViews, Penalty, Place, StatePart, ViewRays, Weighing, additive,
    prox_on_host,
};
use crate::error::{Error, Result};
use crate::geometry::Geometry;
use crate::voxel::VoxelProjector;
use ndarray::{Array3, ArrayView3, ArrayViewMut3, Axis, CowArray, Ix3, s};
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

/// Connects the processes of a run. All of them make the same calls in the same order.
pub trait Peers: Send + Sync {
    /// The number of this process, from 0.
    fn rank(&self) -> usize;

    /// Number of processes.
    fn count(&self) -> usize;

    /// Sends `out[r]` to each process r and overwrites `into[r]` with what that one sends here; sizes match. Bits stay as
    /// they are. A process that has ended ends this one too.
    fn exchange(&self, out: &[Vec<f32>], into: &mut [Vec<f32>]);
}

/// Planes of a volume that several processes share.
#[derive(Clone)]
pub struct Slab {
    /// Number of planes of the whole volume.
    pub whole: usize,
    /// The planes at hand: those of this process and copies of its neighbours'.
    pub planes: Range<usize>,
    /// The planes of this process.
    pub own: Range<usize>,
    /// Planes of its neighbours on each side, but for the volume's ends.
    halo: usize,
    wire: Arc<Wire>,
    /// Where this process keeps its planes.
    pub(crate) here: Arc<dyn Place>,
}

impl Slab {
    /// The planes of this process among those at hand.
    pub fn inner(&self) -> Range<usize> {
        self.own.start - self.planes.start..self.own.end - self.planes.start
    }

    /// The sum of the processes' numbers `x`.
    pub fn sum(&self, x: f64) -> f64 {
        self.wire.sum(x)
    }
}

/// The processes, and what this one has sent.
struct Wire {
    peers: Arc<dyn Peers>,
    sent: AtomicU64,
}

impl Wire {
    fn exchange(&self, out: &[Vec<f32>], into: &mut [Vec<f32>]) {
        let others = out.iter().enumerate().filter(|(rank, _)| *rank != self.peers.rank());
        let numbers: usize = others.map(|(_, out)| out.len()).sum();
        self.sent.fetch_add((numbers * size_of::<f32>()) as u64, Ordering::Relaxed);
        self.peers.exchange(out, into);
    }

    /// The number `x` of each process.
    fn all(&self, x: f64) -> Vec<f64> {
        let halves: [f32; 2] = bytemuck::cast(x);
        let out = vec![halves.to_vec(); self.peers.count()];
        let mut into = vec![vec![0.0; 2]; out.len()];
        self.exchange(&out, &mut into);
        into.iter().map(|x| bytemuck::cast([x[0], x[1]])).collect()
    }

    /// The sum of the processes' numbers `x`.
    fn sum(&self, x: f64) -> f64 {
        self.all(x).iter().sum()
    }
}

/// Numbers that a process sends or receives at once, about.
const PIECE: usize = 1 << 25;

/// The place of one of several processes.
pub struct Ranks {
    wire: Arc<Wire>,
    here: Arc<dyn Place>,
}

/// All flags of a mask, and copies of them in the place of this process.
struct Flags {
    all: Array3<bool>,
    /// All flags, for views.
    whole: OnceLock<Mask>,
    /// The flags of its own planes.
    own: OnceLock<Mask>,
}

impl Ranks {
    /// The place of the process that `peers` connects. It keeps its planes in the place `here`.
    pub fn new(peers: Arc<dyn Peers>, here: Arc<dyn Place>) -> Self {
        Self { wire: Arc::new(Wire { peers, sent: AtomicU64::new(0) }), here }
    }

    /// Bytes that this process has sent to the others.
    pub fn sent(&self) -> u64 {
        self.wire.sent.load(Ordering::Relaxed)
    }

    fn rank(&self) -> usize {
        self.wire.peers.rank()
    }

    fn count(&self) -> usize {
        self.wire.peers.count()
    }

    /// What `of` says of each process.
    fn each<T>(&self, of: impl FnMut(usize) -> T) -> Vec<T> {
        (0..self.count()).map(of).collect()
    }

    /// The planes of process `rank` in an array with this many.
    fn part(&self, rank: usize, planes: usize) -> Range<usize> {
        let bound = |rank| rank * planes / self.count();
        bound(rank)..bound(rank + 1)
    }

    fn own(&self, planes: usize) -> Range<usize> {
        self.part(self.rank(), planes)
    }

    /// Some planes of this process, in the host's memory.
    fn read_planes(&self, x: &Array, planes: &[usize], mut into: &mut [f32]) -> Result<()> {
        let ([_, rows, columns], (first, here)) = (x.shape(), at_hand(x)?);
        for run in planes.chunk_by(|a, b| a + 1 == *b) {
            let (to, rest) = into.split_at_mut(run.len() * rows * columns);
            into = rest;
            let to = ArrayViewMut3::from_shape([run.len(), rows, columns], to);
            self.here.store(here, run[0] - first, to.unwrap_or_else(|e| unreachable!("whole planes: {e}")))?;
        }
        Ok(())
    }

    /// The planes of `x` that this process wants. `wanted` has the planes that each process wants.
    fn collected(&self, x: &Array, wanted: &[Vec<usize>]) -> Result<Array3<f32>> {
        let [planes, rows, columns] = x.shape();
        let (size, me) = (rows * columns, self.rank());
        let mut found = Array3::zeros([wanted[me].len(), rows, columns]);
        let all = found.as_slice_mut().unwrap_or_default();
        let parts = self.each(|rank| self.part(rank, planes));
        let mut i = 0;
        for run in wanted[me].chunk_by(|a, b| parts[me].contains(a) == parts[me].contains(b)) {
            if parts[me].contains(&run[0]) {
                self.read_planes(x, run, &mut all[i * size..])?;
            }
            i += run.len();
        }
        let together = self.together(size);
        let most = wanted.iter().map(Vec::len).max().unwrap_or(0);
        for turn in (0..most).step_by(together) {
            // What process `rank` wants of process `of` in this turn; its own planes it has.
            let now = |rank: usize, of: usize| {
                let some = wanted[rank].iter().skip(turn).take(if rank == of { 0 } else { together });
                let part = &parts[of];
                some.copied().filter(move |plane| part.contains(plane))
            };
            let out = |rank| {
                let planes: Vec<usize> = now(rank, me).collect();
                let mut out = vec![0.0; planes.len() * size];
                self.read_planes(x, &planes, &mut out).map(|()| out)
            };
            let out = (0..self.count()).map(out).collect::<Result<Vec<_>>>()?;
            let mut into = self.each(|of| vec![0.0; now(me, of).count() * size]);
            self.wire.exchange(&out, &mut into);
            let mut next = vec![0; self.count()];
            for (i, &plane) in wanted[me].iter().enumerate().skip(turn).take(together) {
                let of = parts.iter().position(|part| part.contains(&plane)).unwrap_or(me);
                if of != me {
                    all[i * size..(i + 1) * size].copy_from_slice(&into[of][next[of]..next[of] + size]);
                    next[of] += size;
                }
            }
        }
        Ok(found)
    }

    /// Planes of `size` numbers that each process sends to each other one at once.
    fn together(&self, size: usize) -> usize {
        (PIECE / (size * self.count()).max(1)).max(1)
    }

    /// The same planes for every process.
    fn to_all(&self, planes: &[usize]) -> Vec<Vec<usize>> {
        vec![planes.to_vec(); self.count()]
    }

    /// An array of this process with as many `planes`, the first of them those that it wants of `x`.
    fn gathered(&self, x: &Array, wanted: &[Vec<usize>], planes: usize) -> Result<Array> {
        let ([_, rows, columns], (first, here)) = (x.shape(), at_hand(x)?);
        let mut out = self.here.zeros([planes, rows, columns])?;
        let is_own = |rank: usize, plane: &usize| self.part(rank, x.shape()[0]).contains(plane);
        let others = |(rank, wanted): (usize, &Vec<usize>)| {
            wanted.iter().copied().filter(|plane| !is_own(rank, plane)).collect::<Vec<usize>>()
        };
        let found = self.collected(x, &wanted.iter().enumerate().map(others).collect::<Vec<_>>())?;
        let (mut at, mut taken) = (0, 0);
        for run in wanted[self.rank()].chunk_by(|a, b| a + 1 == *b && is_own(self.rank(), a) == is_own(self.rank(), b))
        {
            if is_own(self.rank(), &run[0]) {
                let places: Vec<usize> = (at..at + run.len()).collect();
                self.here.scatter(here, run[0] - first, &mut out, &places)?;
            } else {
                self.here.load(found.slice(s![taken..taken + run.len(), .., ..]), &mut out, at)?;
                taken += run.len();
            }
            at += run.len();
        }
        Ok(out)
    }

    /// The planes of a slab of `x`, with its neighbours'.
    fn near(&self, x: &Array, slab: &Slab) -> Result<Array> {
        let wanted = self.each(|rank| around(self.part(rank, slab.whole), slab.halo, slab.whole).collect());
        self.gathered(x, &wanted, slab.planes.len())
    }

    /// Renews the copies of its neighbours' planes in an array of a slab.
    fn renew(&self, x: &mut Array, slab: &Slab) -> Result<()> {
        let wanted = self.each(|rank| {
            let own = self.part(rank, slab.whole);
            around(own.clone(), slab.halo, slab.whole).filter(|plane| !own.contains(plane)).collect()
        });
        let found = self.collected(x, &wanted)?;
        for (plane, &i) in found.outer_iter().zip(&wanted[self.rank()]) {
            self.load(plane.insert_axis(Axis(0)), x, i)?;
        }
        Ok(())
    }

    /// Calls `work` with some of the first `count` images of `images` after another, the same in all processes, and with
    /// their places.
    fn in_turns(
        &self,
        images: &Array,
        count: usize,
        mut work: impl FnMut(&[usize], Array) -> Result<()>,
    ) -> Result<()> {
        for some in self.turns(images.shape(), count) {
            work(&some, self.gathered(images, &self.to_all(&some), some.len())?)?;
        }
        Ok(())
    }

    /// The places of the first `count` of some images, in groups with about as many of each process.
    fn turns(&self, [images, rows, columns]: [usize; 3], count: usize) -> Vec<Vec<usize>> {
        let used = |rank| self.used(rank, images, count);
        let most = (0..self.count()).map(|rank| used(rank).len()).max().unwrap_or(0);
        let together = self.together(rows * columns);
        let some = |first: usize| {
            let of = |rank: usize| used(rank).skip(first).take(together);
            (0..self.count()).flat_map(of).collect::<Vec<usize>>()
        };
        (0..most).step_by(together).map(some).collect()
    }

    /// The images of process `rank` among the first `count`.
    fn used(&self, rank: usize, images: usize, count: usize) -> Range<usize> {
        let part = self.part(rank, images);
        part.start.min(count)..part.end.min(count)
    }
}

/// The planes at hand of an array of this place.
fn at_hand<T>(x: &Held<T>) -> Result<(usize, &Held<T>)> {
    x.planes().ok_or_else(foreign)
}

fn at_hand_mut<T>(x: &mut Held<T>) -> Result<(usize, &mut Held<T>)> {
    x.planes_mut().ok_or_else(foreign)
}

fn foreign() -> Error {
    Error::unsupported("array", "it belongs to one process, and several share the others")
}

/// `part` with `halo` planes on both sides.
fn around(part: Range<usize>, halo: usize, planes: usize) -> Range<usize> {
    part.start.saturating_sub(halo)..(part.end + halo).min(planes)
}

/// The mask of `of`, made at the first call.
fn flags(of: &OnceLock<Mask>, make: impl FnOnce() -> Result<Mask>) -> Result<&Mask> {
    if let Some(mask) = of.get() {
        return Ok(mask);
    }
    let mask = make()?;
    Ok(of.get_or_init(|| mask))
}

impl Place for Ranks {
    fn device(&self) -> Option<String> {
        let others = self.count() - 1;
        let and = if others > 0 { format!(" and {others} more") } else { String::new() };
        self.here.device().map(|device| device + &and)
    }

    fn zeros(&self, [planes, rows, columns]: [usize; 3]) -> Result<Array> {
        let own = self.own(planes);
        let here = self.here.zeros([own.len(), rows, columns]);
        // A method may try a smaller array: all processes must then do so.
        let refused = self.agree(here.is_err());
        let here = here?;
        if refused {
            return Err(Error::unsupported("memory", "another process or device has too little"));
        }
        Ok(Array::part([planes, rows, columns], own.start, here))
    }

    fn load(&self, from: ArrayView3<'_, f32>, to: &mut Array, first: usize) -> Result<()> {
        let (start, here) = at_hand_mut(to)?;
        let low = first.max(start);
        let high = (first + from.len_of(Axis(0))).min(start + here.shape()[0]);
        if low < high {
            self.here.load(from.slice(s![low - first..high - first, .., ..]), here, low - start)?;
        }
        Ok(())
    }

    fn store(&self, from: &Array, first: usize, mut to: ArrayViewMut3<'_, f32>) -> Result<()> {
        let [_, rows, columns] = from.shape();
        let together = self.together(rows * columns);
        for (i, mut to) in to.axis_chunks_iter_mut(Axis(0), together).enumerate() {
            let at = first + i * together;
            let planes: Vec<usize> = (at..at + to.len_of(Axis(0))).collect();
            to.assign(&self.collected(from, &self.to_all(&planes))?);
        }
        Ok(())
    }

    fn admits(&self, projector: &dyn VoxelProjector) -> Result<()> {
        additive(projector)?;
        self.here.admits(projector)
    }

    fn holds(&self, bytes: u64) -> bool {
        // A prior works on two more slabs, with planes of the neighbours: less than a quarter of the arrays
        // of a method with a prior.
        let part = bytes.div_ceil(self.count() as u64);
        !self.agree(!self.here.holds(part.saturating_add(part / 4)))
    }

    fn streamed(&self) -> Option<Arc<dyn Place>> {
        let here = self.here.streamed()?;
        Some(Arc::new(Self { wire: self.wire.clone(), here }))
    }

    /// The room of the process with the least memory, so that all of them divide their work alike.
    fn room(&self) -> u64 {
        let least = self.wire.all(self.here.room() as f64).into_iter().fold(f64::INFINITY, f64::min);
        (least as u64).saturating_mul(self.count() as u64)
    }

    fn agree(&self, flag: bool) -> bool {
        self.wire.sum(f64::from(u8::from(flag))) > 0.0
    }

    fn slab(&self, planes: usize, halo: usize) -> Option<Slab> {
        let own = self.own(planes);
        let (wire, here) = (self.wire.clone(), self.here.clone());
        Some(Slab { whole: planes, planes: around(own.clone(), halo, planes), own, halo, wire, here })
    }

    fn gather<'a>(&self, x: &'a Array) -> Result<CowArray<'a, f32, Ix3>> {
        if let Some(array) = x.on_host() {
            return Ok(array.into());
        }
        let all = |rank| if rank == 0 { (0..x.shape()[0]).collect() } else { vec![] };
        Ok(self.collected(x, &self.each(all))?.into())
    }

    fn fill(&self, x: &mut Array, value: f32) -> Result<()> {
        self.here.fill(at_hand_mut(x)?.1, value)
    }

    fn scatter(&self, from: &Array, first: usize, out: &mut Array, at: &[usize]) -> Result<()> {
        let wanted = self.each(|rank| {
            let part = self.part(rank, out.shape()[0]);
            (0..at.len()).filter(|&i| part.contains(&at[i])).map(|i| first + i).collect()
        });
        let found = self.collected(from, &wanted)?;
        for (plane, &i) in found.outer_iter().zip(&wanted[self.rank()]) {
            self.load(plane.insert_axis(Axis(0)), out, at[i - first])?;
        }
        Ok(())
    }

    fn mask(&self, flags: Array3<bool>) -> Result<Mask> {
        let shape = flags.dim().into();
        Ok(Mask::there(shape, Flags { all: flags, whole: OnceLock::new(), own: OnceLock::new() }))
    }

    fn views<'a>(&self, measured: &'a Array3<f32>) -> Result<MeasuredViews<'a>> {
        self.here.views(measured)
    }

    fn keep(&self, x: &mut Array, inside: &Mask, value: f32) -> Result<()> {
        let (first, here) = at_hand_mut(x)?;
        let Flags { all, own, .. } = inside.get::<Flags>().ok_or_else(foreign)?;
        let planes = first..first + here.shape()[0];
        let own = flags(own, || self.here.mask(all.slice(s![planes, .., ..]).to_owned()))?;
        self.here.keep(here, own, value)
    }

    fn map(&self, map: &Map, factors: [f64; 2], out: &mut Array, inputs: &[&Array]) -> Result<()> {
        let inputs = inputs.iter().map(|x| Ok(at_hand(x)?.1)).collect::<Result<Vec<_>>>()?;
        self.here.map(map, factors, at_hand_mut(out)?.1, &inputs)
    }

    fn reduce(&self, kind: Reduction, x: &Array, y: &Array) -> Result<f64> {
        let here = self.here.reduce(kind, at_hand(x)?.1, at_hand(y)?.1)?;
        let all = self.wire.all(here);
        Ok(if kind == Reduction::Maximum { all.into_iter().fold(0.0, f64::max) } else { all.iter().sum() })
    }

    fn forward(&self, rays: ViewRays<'_>, volume: &Array, images: &mut Array) -> Result<()> {
        let [count, rows, columns] = images.shape();
        let (own, here) = (self.own(volume.shape()[0]), at_hand(volume)?.1);
        let slab = Geometry { volume: rays.geometry.volume.slab(own.clone()), ..rays.geometry.clone() };
        for some in self.turns(images.shape(), rays.views.len()) {
            let seen: Vec<usize> = some.iter().map(|&i| rays.views[i]).collect();
            let mut lines = self.here.zeros([some.len(), rows, columns])?;
            if !own.is_empty() {
                self.here.forward(ViewRays { geometry: &slab, views: &seen, ..rays }, here, &mut lines)?;
            }
            let lines = self.here.read(&lines)?;
            // Images of one process follow each other.
            let of = |rank| some.iter().filter(|i| self.part(rank, count).contains(i)).count() * rows * columns;
            let mut rest = lines.as_slice().unwrap_or_default();
            let block = |rank| {
                let (block, others) = rest.split_at(of(rank));
                rest = others;
                block.to_vec()
            };
            let mut out = self.each(block);
            let own = std::mem::take(&mut out[self.rank()]);
            let mut into = vec![vec![0.0; own.len()]; out.len()];
            into[self.rank()].clear();
            self.wire.exchange(&out, &mut into);
            let Some(first) = some.iter().find(|i| self.own(count).contains(i)) else { continue };
            into[self.rank()] = own;
            let mut all = into.into_iter();
            let mut sum = all.next().unwrap_or_default();
            for other in all {
                sum.iter_mut().zip(&other).for_each(|(sum, x)| *sum += *x);
            }
            let sum = ArrayView3::from_shape([sum.len() / (rows * columns).max(1), rows, columns], &sum);
            self.load(sum.unwrap_or_else(|e| unreachable!("whole images: {e}")), images, *first)?;
        }
        Ok(())
    }

    fn adjoint(&self, rays: ViewRays<'_>, images: &Array, volume: &mut Array) -> Result<()> {
        let own = self.own(volume.shape()[0]);
        let here = at_hand_mut(volume)?.1;
        let slab = Geometry { volume: rays.geometry.volume.slab(own.clone()), ..rays.geometry.clone() };
        self.in_turns(images, rays.views.len(), |some, images| {
            let seen: Vec<usize> = some.iter().map(|&i| rays.views[i]).collect();
            if own.is_empty() {
                return Ok(());
            }
            self.here.adjoint(ViewRays { geometry: &slab, views: &seen, ..rays }, &images, here)
        })
    }

    fn compare(&self, by: &Weighing<'_>, views: &[usize], images: &mut Array) -> Result<[f64; 2]> {
        let count = images.shape()[0];
        let used = self.used(self.rank(), count, views.len());
        let weights = match by.weights {
            None => None,
            Some(weights) => {
                let wanted = self.each(|rank| self.part(rank, count).filter_map(|i| views.get(i)).copied().collect());
                Some(self.gathered(weights, &wanted, at_hand(images)?.1.shape()[0])?)
            }
        };
        let mut sums = [0.0; 2];
        let here = at_hand_mut(images)?.1;
        if !used.is_empty() {
            let shadow = by.shadow.map(|shadow| {
                let Flags { all, whole, .. } = shadow.get::<Flags>().ok_or_else(foreign)?;
                flags(whole, || self.here.mask(all.clone()))
            });
            let by = Weighing { shadow: shadow.transpose()?, weights: None, ..*by };
            sums = self.here.compare(&by, &views[used], here)?;
            if let Some(weights) = weights {
                self.here.map(&MULTIPLY, [1.0, 0.0], here, &[&weights])?;
            }
        }
        Ok(sums.map(|x| self.wire.sum(x)))
    }

    fn weigh(&self, by: &Weighing<'_>, spread: bool, views: &[usize], images: &mut Array) -> Result<()> {
        let used = self.used(self.rank(), images.shape()[0], views.len());
        let here = at_hand_mut(images)?.1;
        let by = Weighing { shadow: None, weights: None, ..*by };
        if used.is_empty() { Ok(()) } else { self.here.weigh(&by, spread, &views[used], here) }
    }

    fn filtered(
        &self,
        work: &dyn FilteredViews,
        views: &[usize],
        images: &mut Array,
        slab: &mut Array,
        first: usize,
    ) -> Result<()> {
        let (start, here) = at_hand_mut(slab)?;
        if here.on_host().is_some() {
            // Each image is filtered once. Devices pass on raw images, and each filters all of them.
            let used = self.used(self.rank(), images.shape()[0], views.len());
            self.here.change(at_hand_mut(images)?.1, &mut |images| filter(work, &views[used.clone()], images))?;
        }
        self.in_turns(images, views.len(), |some, mut images| {
            let seen: Vec<usize> = some.iter().map(|&i| views[i]).collect();
            let Some(images) = images.on_host() else {
                return self.here.filtered(work, &seen, &mut images, here, first + start);
            };
            let add = &mut |slab: &mut Array3<f32>| {
                work.backproject(&seen, images.view(), slab.view_mut(), first + start);
            };
            self.here.change(here, add)
        })
    }

    fn prox(&self, v: &mut Array, tau: f32, penalty: &mut dyn Penalty) -> Result<()> {
        let Some(slab) = penalty.slab().cloned() else {
            return prox_on_host(self, v, tau, penalty);
        };
        for (_, part) in penalty.state() {
            if let StatePart::Placed(state) = part {
                self.renew(state, &slab)?;
            }
        }
        let mut near = self.near(v, &slab)?;
        self.here.prox(&mut near, tau, penalty)?;
        let own = at_hand_mut(v)?.1;
        self.here.scatter(&near, slab.inner().start, own, &(0..slab.own.len()).collect::<Vec<_>>())
    }

    fn penalty(&self, penalty: &mut dyn Penalty, x: &Array) -> Result<f64> {
        match penalty.slab().cloned() {
            None => Ok(penalty.value(self.read(x)?.view())),
            Some(slab) => Ok(self.wire.sum(self.here.penalty(penalty, &self.near(x, &slab)?)?)),
        }
    }

    fn adapt(&self, penalty: &mut dyn Penalty, x: &Array) -> Result<Option<f64>> {
        Ok(match penalty.slab().cloned() {
            None => penalty.adapt(self.read(x)?.view()),
            Some(slab) => self.here.adapt(penalty, &self.near(x, &slab)?)?.map(|value| self.wire.sum(value)),
        })
    }
}
