//! Solvers: gradient training and voxel-supervised pre-training
