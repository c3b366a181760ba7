//! Bases.

use super::*;

/// Maximum number of coefficients per voxel.
const MOST: usize = 64;

settings! {
    basis BasisSpec(self) -> dyn Basis { self.build(0, BasisStage::tried) }
}

/// A basis from a library.
pub struct BasisStage(Foreign<ConefieldBasis>);

impl BasisStage {
    /// The basis of `handle`, after a trial.
    pub(crate) fn tried(handle: Handle) -> Result<Self> {
        let stage = Self(Foreign::new(handle)?);
        let made = stage.made_on(&SMALL)?;
        let coefficients = made.coefficients.shape;
        let complaint = try_operator(made.operator(), SMALL.shape, coefficients)
            .or_else(|| try_operator(made.reference()?, SMALL.shape, coefficients));
        made.fault()?;
        stage.0.settled(complaint)?;
        Ok(stage)
    }

    /// The basis of one grid.
    fn made_on(&self, grid: &VoxelGrid) -> Result<ExpansionOn> {
        let own = self.0.derived("on", make!(self.0, on(&raw_grid(grid)))?)?;
        let mut info = ConefieldExpansion::default();
        ask!(own, info(&mut info))?;
        let ConefieldGrid { shape, spacing, center } = info.coefficients;
        let coefficients = VoxelGrid { shape, spacing, center };
        coefficients.validate("coefficients").map_err(|e| own.wrong("info", &e.to_string()))?;
        let voxels: usize = grid.shape.iter().product();
        let count = shape.iter().try_fold(1usize, |n, &k| n.checked_mul(k)).filter(|n| *n <= MOST * voxels.max(64));
        own.require(count.is_some(), "info", || format!("{shape:?} coefficients for {:?} voxels", grid.shape))?;
        let double = own.functions.expand_f64.is_some() && own.functions.adjoint_f64.is_some();
        let able = info.double_precision == 0 || double;
        own.require(able, "info", || "it declares double precision but has no operators for it".into())?;
        Ok(ExpansionOn { own, coefficients, info })
    }
}

impl Basis for BasisStage {
    fn on(&self, grid: &VoxelGrid) -> Result<Box<dyn Expansion>> {
        Ok(Box::new(self.made_on(grid)?))
    }

    said! { 0: describe }
}

/// A basis that a library made for one grid.
pub(crate) struct ExpansionOn {
    own: Foreign<ConefieldBasis>,
    coefficients: VoxelGrid,
    info: ConefieldExpansion,
}

impl Expansion for ExpansionOn {
    fn coefficients(&self) -> VoxelGrid {
        self.coefficients
    }

    fn are_samples(&self) -> bool {
        self.info.samples != 0
    }

    fn scratch(&self) -> u64 {
        self.info.scratch
    }

    fn operator(&self) -> &dyn BasisOperator<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn BasisOperator<f64>> {
        (self.info.double_precision != 0).then_some(self)
    }

    said! { own: fault }
}

/// Passes arrays to a library as contiguous numbers. Failure leaves NaN.
fn across<R: Real>(
    own: &Foreign<ConefieldBasis>,
    from: ArrayView3<'_, R>,
    mut to: ArrayViewMut3<'_, R>,
    call: impl FnOnce(*const R, *mut R) -> Result<()>,
) {
    let from = from.as_standard_layout();
    let done = match to.as_slice_mut() {
        Some(slice) => call(from.as_ptr(), slice.as_mut_ptr()),
        None => {
            let mut dense = Array3::from_elem(to.dim(), R::ZERO);
            let done = call(from.as_ptr(), dense.as_mut_ptr());
            to.assign(&dense);
            done
        }
    };
    if let Err(e) = done {
        own.fault.set(e);
        to.fill(R::of(f64::NAN));
    }
}

macro_rules! operator {
    ($real:ty, $expand:ident $adjoint:ident) => {
        impl BasisOperator<$real> for ExpansionOn {
            fn expand(&self, coefficients: ArrayView3<'_, $real>, voxels: ArrayViewMut3<'_, $real>) {
                across(&self.own, coefficients, voxels, |from, to| call!(self.own, $expand(from, to)));
            }

            fn adjoint(&self, voxels: ArrayView3<'_, $real>, coefficients: ArrayViewMut3<'_, $real>) {
                across(&self.own, voxels, coefficients, |from, to| call!(self.own, $adjoint(from, to)));
            }
        }
    };
}

operator! { f32, expand adjoint }
operator! { f64, expand_f64 adjoint_f64 }

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
