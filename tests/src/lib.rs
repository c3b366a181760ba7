//! What every reader of conefield must withstand: [`hostile`]; files that tests write: [`blessed`]. The conformance kit of
//! stages is a crate of its own, `conefield-conformance` in `kit`, since plugins' authors use it too.

pub mod blessed;
pub mod hostile;
