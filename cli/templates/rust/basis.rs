//! A basis for conefield: a coefficient for each block of voxels.

@stage "blocks of voxels"
    /// Voxels along a block's edge.
    pub edge: usize = 2,
@

impl BasisSpec for Settings {
    fn build(&self) -> Result<Box<dyn Basis>> {
        ensure((1..=64).contains(&self.edge), "spec", "edge", self.edge, "1 to 64")?;
        Ok(Box::new(self.clone()))
    }
}

impl Basis for Settings {
    fn on(&self, grid: &VoxelGrid) -> Result<Box<dyn Expansion>> {
        Ok(Box::new(Blocks { voxels: *grid, edge: self.edge }))
    }

    fn describe(&self) -> String {
        format!("@name@: blocks of {} voxels per edge", self.edge)
    }
}

/// The blocks of one grid of voxels.
struct Blocks {
    voxels: VoxelGrid,
    edge: usize,
}

impl Expansion for Blocks {
    /// Positions of the coefficients. At the far end a block may reach beyond the voxels.
    fn coefficients(&self) -> VoxelGrid {
        let VoxelGrid { shape, spacing, center } = self.voxels;
        let blocks = shape.map(|n| n.div_ceil(self.edge));
        let size = spacing.map(|s| s * self.edge as f64);
        let beyond = |k: usize| 0.5 * (blocks[k] as f64 * size[k] - shape[k] as f64 * spacing[k]);
        VoxelGrid { shape: blocks, spacing: size, center: [0, 1, 2].map(|k| center[k] + beyond(k)) }
    }

    fn operator(&self) -> &dyn BasisOperator<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn BasisOperator<f64>> {
        Some(self)
    }
}

impl<R: Real> BasisOperator<R> for Blocks {
    /// Expands coefficients to voxels.
    fn expand(&self, coefficients: ArrayView3<'_, R>, mut voxels: ArrayViewMut3<'_, R>) {
        let edge = self.edge;
        voxels.indexed_iter_mut().for_each(|((x, y, z), v)| *v = coefficients[[x / edge, y / edge, z / edge]]);
    }

    /// The exact adjoint: a coefficient gets the sum of its voxels.
    fn adjoint(&self, voxels: ArrayView3<'_, R>, mut coefficients: ArrayViewMut3<'_, R>) {
        let edge = self.edge;
        coefficients.fill(R::ZERO);
        voxels.indexed_iter().for_each(|((x, y, z), v)| coefficients[[x / edge, y / edge, z / edge]] += *v);
    }
}
