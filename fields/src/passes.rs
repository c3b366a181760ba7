//! The arguments of a kernel's passes, for what is compiled for several sets of instructions.

use conefield_core::stage::{Grads, Tile, TileMut};

/// Those of [`Kernel::forward`](conefield_core::stage::Kernel::forward).
pub(crate) struct Forward<'a, T, R> {
    pub stage: &'a T,
    pub params: &'a [R],
    pub x: Tile<'a, R>,
    pub y: TileMut<'a, R>,
    pub tape: TileMut<'a, R>,
}

/// Those of [`Kernel::backward`](conefield_core::stage::Kernel::backward).
pub(crate) struct Backward<'a, T, R> {
    pub stage: &'a T,
    pub params: &'a [R],
    pub x: Tile<'a, R>,
    pub tape: TileMut<'a, R>,
    pub dy: Tile<'a, R>,
    pub grads: Grads<'a, R>,
    pub dx: Option<TileMut<'a, R>>,
}
