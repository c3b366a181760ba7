//! Initializers: random, mapping-consistency (MCI), checkpoint
