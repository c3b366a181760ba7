//! The native half of the Python package `conefield`: it takes arrays and settings, runs the workspace's crates without
//! the GIL, and returns arrays, or errors with the same messages as the command. The public, documented interface is
//! written in Python (`conefield/`).

mod arguments;
mod arrays;
mod calibration;
mod command;
mod encoder;
mod errors;
mod field;
mod geometry;
mod log;
mod operator;
mod regularizer;
mod run;
mod scan;
mod specs;
mod stages;
mod volume;
mod work;

use conefield::scratch::Allocator;
use pyo3::prelude::*;

/// Counts allocated bytes, so that the memory of readers can be limited.
#[global_allocator]
static HEAP: Allocator = Allocator;

#[pymodule]
mod _native {
    #[pymodule_export]
    use crate::calibration::calibrate;
    #[pymodule_export]
    use crate::command::command;
    #[pymodule_export]
    use crate::field::{Field, read_field};
    #[pymodule_export]
    use crate::geometry::Geometry;
    #[pymodule_export]
    use crate::operator::{apply, project_scan};
    #[pymodule_export]
    use crate::run::{evaluate, plan, pretrain, reconstruct};
    #[pymodule_export]
    use crate::scan::{Scan, read_scan, simulate, write_scan};
    #[pymodule_export]
    use crate::specs::{schema, spec_names, spec_text};
    #[pymodule_export]
    use crate::stages::{check_stage, register, stage_names};
    #[pymodule_export]
    use crate::volume::{hounsfield, read_volume, write_volume};
    use pyo3::prelude::*;

    #[pymodule_init]
    fn init(m: &Bound<'_, PyModule>) -> PyResult<()> {
        conefield::memory::set_budget(None);
        m.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
