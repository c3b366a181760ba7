//! What every conefield stage must do, as a library: [`conformance::check`] takes any stage, built in or loaded; and
//! what every reader must withstand: [`hostile`].

pub mod conformance;
pub mod hostile;
