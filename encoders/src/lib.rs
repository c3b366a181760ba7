//! Position encoders: hash grid, dense grid, frequency, concat
