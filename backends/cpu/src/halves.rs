//! Half-precision copy of the parameters, for reading tables.

use conefield_core::half::{Bf16, F16, Half, round};
use conefield_core::pages::Pages;
use conefield_core::precision::Tables;
use conefield_core::simd::{Op, Simd, run};
use conefield_core::stage::{Halves, Kernel, Reader, Stage};
use rayon::prelude::*;
use std::ops::Range;

/// Numbers rounded at once.
const BLOCK: usize = 16_384;

/// All parameters of the arena, rounded. The few that every row reads are read from the arena.
pub enum Rounded {
    /// As `binary16`.
    F16(Pages<F16>),
    /// As `bfloat16`.
    Bf16(Pages<Bf16>),
}

impl Rounded {
    /// Bytes per parameter.
    pub const BYTES: usize = size_of::<F16>();

    /// A copy of `params` for `tables`; `None` for `f32`.
    pub fn new(tables: Tables, params: &[f32]) -> Option<Self> {
        let n = params.len();
        let mut copy = match tables {
            Tables::F32 => return None,
            Tables::F16 => Self::F16(Pages::zeros(n)),
            Tables::Bf16 => Self::Bf16(Pages::zeros(n)),
        };
        copy.renew(params);
        Some(copy)
    }

    /// Updates the copy to `params`.
    pub fn renew(&mut self, params: &[f32]) {
        match self {
            Self::F16(copy) => round_all(params, copy),
            Self::Bf16(copy) => round_all(params, copy),
        }
    }

    /// The kernel of `stage` that reads its parameters, `range` of the arena, from this copy instead of those passed to
    /// it. `None` if the stage has no half-precision kernel.
    pub(crate) fn kernel<'a>(&'a self, stage: &'a dyn Stage, range: Range<usize>) -> Option<Box<dyn Kernel<f32> + 'a>> {
        let Halves { f16, bf16 } = stage.halves()?;
        Some(match self {
            Self::F16(copy) => Box::new(Reader { kernel: f16, params: &copy[range] }),
            Self::Bf16(copy) => Box::new(Reader { kernel: bf16, params: &copy[range] }),
        })
    }
}

fn round_all<H: Half>(params: &[f32], copy: &mut [H]) {
    let blocks = params.par_chunks(BLOCK).zip(copy.par_chunks_mut(BLOCK));
    blocks.for_each(|(params, copy)| run(Round { params, copy }));
}

struct Round<'a, H> {
    params: &'a [f32],
    copy: &'a mut [H],
}

impl<H: Half> Op for Round<'_, H> {
    type Number = f32;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, _: S) {
        round(self.params, self.copy);
    }
}
