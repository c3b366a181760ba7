//! Solvers on voxels, held against ellipsoids whose scans are known in closed form.

mod fdk;
mod iterative;
mod kit;
mod refusals;
mod warm_start;
