//! Speed of conefield, measured in `benches/`.
