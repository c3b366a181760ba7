//! A plugin with a regularizer for iterative methods.

pub mod huber;

conefield_plugin::export!();
