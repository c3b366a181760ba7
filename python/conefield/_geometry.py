"""Geometries: positions of source, detector and voxels."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import _native
from ._arrays import as_floats, counts, pair, triple

Geometry = _native.Geometry


def _voxels(volume: Any, spacing: Any, center: Any) -> tuple[list[int], tuple, tuple]:
    return counts(volume, "volume", 3), triple(spacing, "spacing"), triple(center, "center")


def circular(
    *,
    dso: float | None = None,
    dsd: float | None = None,
    angles: Any,
    detector: Any,
    pixel: Any,
    volume: Any,
    spacing: Any = 1.0,
    center: Any = 0.0,
    offset: Any = (0.0, 0.0),
    tilt: Any = (0.0, 0.0, 0.0),
) -> Geometry:
    """A circular orbit about the axis z.

    The source at angle ``a`` is at ``dso·(cos a, sin a, 0)``. Columns of the detector (u) run along
    ``(-sin a, cos a, 0)``, its rows (v) run towards -z.

    Parameters
    ----------
    dso, dsd
        Source to rotation axis, and source to detector plane, mm. Without both the beam is parallel: all rays of a view run
        along ``(-cos a, -sin a, 0)``.
    angles
        One per view, radians; an integer means this many even steps over the circle from 0.
    detector
        Rows and columns.
    pixel
        Size of a pixel along v (rows) and u (columns), mm; one number for squares.
    volume, spacing, center
        Voxels along x, y and z, their size and the middle of their grid, mm.
    offset
        Shift of the detector along v and u, mm.
    tilt
        Rotations of the detector about its centre, radians, right-handed: about u, about v, and in its plane (about u × v,
        away from the source). The last rotation is applied first; each is about the original axis.
    """
    if isinstance(angles, (int, np.integer)):
        angles = np.arange(int(angles)) * (2 * np.pi / max(int(angles), 1))
    return Geometry.circular(
        None if dso is None else float(dso),
        None if dsd is None else float(dsd),
        as_floats(angles, "angles", 1, np.float64),
        counts(detector, "detector", 2),
        pair(pixel, "pixel"),
        pair(offset, "offset"),
        triple(tilt, "tilt"),
        _voxels(volume, spacing, center),
    )


def from_vectors(vectors: Any, *, detector: Any, volume: Any, spacing: Any = 1.0, center: Any = 0.0) -> Geometry:
    """Views given by vectors, for any orbit.

    ``vectors`` is ``[view, 12]``, in mm: the source, the centre of the detector, the step from a pixel to the next column
    (u) and to the next row (v), in the order of ASTRA's ``cone_vec``.
    """
    array = as_floats(vectors, "vectors", 2, np.float64)
    return Geometry.from_vectors(array, counts(detector, "detector", 2), _voxels(volume, spacing, center))
