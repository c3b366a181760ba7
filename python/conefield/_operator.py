"""Line integrals of voxels: as functions, and as the system matrix."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import _native
from ._arrays import as_array, as_floats, as_real
from ._errors import invalid
from ._scan import Scan
from ._spec import encoded
from ._volume import Volume, as_volume


def _real(values: Any, name: str) -> np.ndarray:
    """Real numbers; double precision is kept."""
    array = as_array(values, name)
    # In either byte order.
    double = array.dtype.newbyteorder("=") == np.float64
    return as_floats(array, name, 3, np.float64 if double else np.float32)


def project(volume: Any, like: _native.Geometry | Scan, *, projector: Any = "joseph", residual: bool = False) -> np.ndarray:
    """The line integrals of a volume, ``[view, row, column]``.

    Parameters
    ----------
    volume
        Attenuation ``[x, y, z]``.
    like
        A geometry or a scan. With a geometry, values are in 1/mm on its voxels; ``float64`` is computed in double
        precision. With a scan, its views are predicted as by ``conefield project``: values are in 1/unit of the scan, and
        a :class:`Volume` or a file of another shape keeps its voxels and is placed at the same centre; an array, or a file
        of NumPy, fills the volume of the scan.
    projector
        ``"joseph"``, ``"siddon"``, ``"trilinear"``, or a dict with its type and settings.
    residual
        For a scan: return measured minus predicted line integrals.
    """
    if isinstance(like, Scan):
        return _native.project_scan(like, encoded(projector), as_volume(volume, "volume", like.geometry), residual)
    if residual:
        raise invalid("arguments", "residual", "a geometry, in which nothing was measured", "a scan")
    values = volume.data if isinstance(volume, Volume) else volume
    return _native.apply(like, encoded(projector), _real(values, "volume"), False)


def backproject(projections: Any, geometry: _native.Geometry, *, projector: Any = "joseph") -> np.ndarray:
    """The exact adjoint of :func:`project` in a geometry: ``[view, row, column]`` to ``[x, y, z]``.

    It is unfiltered; for filtered back-projection use the spec ``fdk``. ``float64`` is computed in double precision.
    """
    return _native.apply(geometry, encoded(projector), _real(projections, "projections"), True)


class Operator:
    """The system matrix A of a geometry. An entry is the weight in mm of a voxel for a ray.

    ``A @ x`` takes a volume ``[x, y, z]`` to projections ``[view, row, column]``, ``A.T @ y`` is the exact adjoint. Both also
    take flat vectors to flat vectors, as SciPy's solvers need (``scipy.sparse.linalg.lsqr(A, b)``).

    Parameters
    ----------
    geometry
        The geometry.
    projector
        ``"joseph"``, ``"siddon"``, ``"trilinear"``, or a dict with its type and settings.
    dtype
        ``float32``, which is faster, or ``float64``.
    """

    #: Makes NumPy defer ``array @ A`` to this class, which does not define it.
    __array_ufunc__ = None

    def __init__(self, geometry: _native.Geometry, *, projector: Any = "joseph", dtype: Any = np.float32) -> None:
        self.geometry = geometry
        self.dtype = np.dtype(dtype)
        if self.dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
            raise invalid("arguments", "dtype", self.dtype, "float32 or float64")
        self._projector = encoded(projector)
        self._transposed = False
        self._other: Operator | None = None

    @property
    def T(self) -> Operator:
        """The adjoint."""
        if self._other is None:
            other = Operator.__new__(Operator)
            other.__dict__.update(self.__dict__)
            other._transposed = not self._transposed
            other._other = self
            self._other = other
        return self._other

    H = T

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """Shape of the input."""
        return self.geometry.projections_shape if self._transposed else self.geometry.volume_shape

    @property
    def output_shape(self) -> tuple[int, int, int]:
        """Shape of the output."""
        return self.geometry.volume_shape if self._transposed else self.geometry.projections_shape

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the matrix."""
        return int(np.prod(self.output_shape)), int(np.prod(self.input_shape))

    ndim = 2

    def __matmul__(self, x: Any) -> np.ndarray:
        x = as_real(x.data if isinstance(x, Volume) else x, "operand").astype(self.dtype, copy=False)
        flat = x.shape in ((self.shape[1],), (self.shape[1], 1))
        if not flat and x.shape != self.input_shape:
            expected = f"{self.input_shape}, or a vector of {self.shape[1]}"
            raise invalid("operator", "shape", x.shape, expected)
        y = _native.apply(self.geometry, self._projector, x.reshape(self.input_shape), self._transposed)
        return y.reshape((self.shape[0],) + x.shape[1:]) if flat else y

    __call__ = __matmul__

    def matvec(self, x: Any) -> np.ndarray:
        """``A @ x`` of a flat vector."""
        return self @ x

    def rmatvec(self, y: Any) -> np.ndarray:
        """``A.T @ y`` of a flat vector."""
        return self.T @ y

    def as_linear_operator(self) -> Any:
        """The operator as ``scipy.sparse.linalg.LinearOperator``."""
        from scipy.sparse.linalg import LinearOperator

        return LinearOperator(self.shape, matvec=self.matvec, rmatvec=self.rmatvec, dtype=self.dtype)

    def __repr__(self) -> str:
        m, n = self.shape
        return f"Operator({m} x {n}, {self.dtype})"
