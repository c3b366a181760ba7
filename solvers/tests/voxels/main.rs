//! Voxel methods, compared with ellipsoids whose scans are known in closed form.

mod bases;
mod carved;
mod chain;
mod fdk;
mod iterative;
mod kit;
mod references;
mod refusals;
mod solid;
mod support;
mod surround;
mod sweep;
mod warm_start;
