//! CPU backend: tiles in cache, SIMD with run-time dispatch, the same bits on any number of threads
