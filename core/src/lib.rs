//! The contracts that conefield's stages, backends and methods meet at.
//!
//! - [`geometry`], [`orbit`], [`scan`], [`parts`]: what was measured, in millimetres, and what comes out.
//! - [`simd`], [`half`], [`dense`], [`activation`], [`trilinear`], [`stage`]: what a stage computes and how.
//! - [`by_row`]: stages that are written for one row at a time; [`prelude`]: what their authors need.
//! - [`support`]: where the object can be; [`scene`]: between the world and what stages see.
//! - [`loss`], [`prior`]: what training makes small.
//! - [`wgsl`]: the same for a GPU.
//! - [`arena`]: parameters, gradients and optimizer state under their names.
//! - [`files`]: opening what a user or a description names; [`allowance`]: the memory and work that reading it may take.
//! - [`settings`], [`precision`], [`spec`], [`registry`]: what a user writes, and the types that it may name.
//! - [`host`]: stages on the host, for what looks at a model beside training.
//! - [`voxel`]: line integrals of voxel volumes.
//! - [`basis`], [`data_term`], [`regularizer`]: what an iterative method is put together from; [`space`]: its arrays and
//!   what they take.
//! - [`method`]: what a spec names, its plan and its run; [`pipeline`], [`backend`], [`trained`]: a field from its stages to a
//!   volume; [`checkpoint`]: where a run stands.

pub mod activation;
pub mod allowance;
pub mod arena;
pub mod backend;
pub mod basis;
pub mod by_row;
pub mod checkpoint;
pub mod data_term;
pub mod dense;
pub mod error;
pub mod files;
pub mod geometry;
pub mod half;
pub mod host;
pub mod loss;
pub mod method;
pub mod opened;
pub mod orbit;
pub mod pages;
pub mod parts;
pub mod pipeline;
pub mod precision;
pub mod prelude;
pub mod prior;
pub mod random;
pub mod registry;
pub mod regularizer;
pub mod scan;
pub mod scene;
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

pub use error::{Error, Result};
