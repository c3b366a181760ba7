//! The arguments of a kernel's passes, for what is compiled for several sets of instructions.

use conefield_core::stage::{Backward, Tile, TileMut};

/// Those of [`Kernel::forward`](conefield_core::stage::Kernel::forward).
pub(crate) struct Forward<'a, T, R> {
    pub stage: &'a T,
    pub params: &'a [R],
    pub x: Tile<'a, R>,
    pub y: TileMut<'a, R>,
    pub tape: TileMut<'a, R>,
}

/// A stage with those of [`Kernel::backward`](conefield_core::stage::Kernel::backward).
pub(crate) struct Back<'a, T, R> {
    pub stage: &'a T,
    pub pass: Backward<'a, R>,
}
