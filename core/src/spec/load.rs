//! Reading specs: layers, `--set`, and errors that say where.
