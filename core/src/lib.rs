//! The contracts between conefield's stages, backends and methods.
//!
//! - [`geometry`], [`orbit`], [`scan`], [`outside`], [`parts`]: measurements in millimetres, and the resulting volumes.
//! - [`simd`], [`dense`], [`activation`], [`trilinear`], [`stage`]: the arithmetic of stages.
//! - [`by_row`]: stages written for one row at a time, over [`lanes`]; [`prelude`]: imports for their authors.
//! - [`support`]: where the object can be; [`scene`]: the mapping between the world and the stages.
//! - [`loss`], [`prior`]: what training minimizes.
//! - [`wgsl`]: stages, losses and priors on a GPU; [`device`]: kernels and buffers on one.
//! - [`arena`]: parameters, gradients and optimizer state by name.
//! - [`files`]: opening of user-named files; [`allowance`]: limits of memory and work for reading them; [`finite`]: the
//!   search for values that are not allowed.
//! - [`settings`], [`spec`], [`registry`]: what a user writes, and the available types.
//! - [`matrix`]: small matrices, for fits.
//! - [`host`]: stages on the host, to inspect a model beside training.
//! - [`voxel`]: line integrals of voxel volumes.
//! - [`basis`], [`data_term`], [`regularizer`]: parts of an iterative method; [`place`], [`space`]: its arrays, and
//!   their memory.
//! - [`method`]: methods, their plans and runs; [`pipeline`], [`backend`], [`trained`]: from the stages of a field to a
//!   volume; [`checkpoint`]: the state of a run.

pub mod activation;
pub mod allowance;
pub mod arena;
pub mod backend;
pub mod basis;
pub mod by_row;
pub mod checkpoint;
pub mod checksum;
pub mod data_term;
pub mod dense;
pub mod device;
pub mod error;
pub mod files;
pub mod finite;
pub mod geometry;
pub mod host;
pub mod input_file;
pub mod lanes;
pub mod loss;
pub mod matrix;
pub mod method;
pub mod opened;
pub mod orbit;
pub mod outside;
pub mod pages;
pub mod parallel;
pub mod parts;
pub mod pipeline;
pub mod place;
pub mod prelude;
pub mod prior;
pub mod random;
pub mod registry;
pub mod regularizer;
pub mod runner;
pub mod scan;
pub mod scene;
pub mod scratch;
pub mod settings;
pub mod simd;
pub mod space;
pub mod spec;
pub mod stage;
pub mod support;
pub mod trained;
pub mod trilinear;
pub mod voxel;
pub mod wgsl;
pub mod words;
pub mod written;

pub use error::{Error, Result};
