//! The contracts that conefield's stages, backends and solvers meet at.
//!
//! - [`geometry`], [`scan`], [`parts`]: what was measured, in millimetres, and what comes out.
//! - [`simd`], [`half`], [`dense`], [`trilinear`], [`stage`]: what a stage computes and how.
//! - [`by_row`]: stages that are written for one row at a time; [`prelude`]: what their authors need.
//! - [`support`]: where the object can be; [`occupancy`]: where a field is known to be empty.
//! - [`wgsl`]: the same for a GPU.
//! - [`arena`]: parameters, gradients and optimizer state under their names.
//! - [`files`]: opening what a user or a description names.
//! - [`spec`], [`registry`]: what a user writes, and the stage types that it may name.
//! - [`host`]: stages on the host, for what looks at a model beside training.
//! - [`voxel`]: line integrals of voxel volumes.
//! - [`pipeline`], [`backend`], [`solver`], [`trained`]: from a spec to a volume.

pub mod arena;
pub mod backend;
pub mod by_row;
pub mod checkpoint;
pub mod dense;
pub mod error;
pub mod files;
pub mod geometry;
pub mod half;
pub mod host;
pub mod occupancy;
pub mod pages;
pub mod parts;
pub mod pipeline;
pub mod prelude;
pub mod random;
pub mod registry;
pub mod scan;
pub mod scene;
pub mod simd;
pub mod solver;
pub mod spec;
pub mod stage;
pub mod support;
pub mod trained;
pub mod trilinear;
pub mod voxel;
pub mod wgsl;

pub use error::{Error, Result};
