"""Scans: reading, writing, construction from arrays, simulation."""

from __future__ import annotations

import os
from typing import Any

from . import _native
from ._arrays import as_floats, counts, pair
from ._errors import invalid
from ._spec import encoded
from ._volume import as_volume

Scan = _native.Scan


def scan(projections: Any, geometry: _native.Geometry, *, unit: str = "mm", unit_mm: float | None = None) -> Scan:
    """A scan of measured line integrals.

    Parameters
    ----------
    projections
        ``A = -ln(I/I0)``, ``[view, row, column]``, without a unit: an array, or anything that exports DLPack.
    geometry
        The geometry.
    unit, unit_mm
        Name and millimetres of the unit of length; volumes are in 1/unit. A unit other than "mm" needs both.
    """
    if unit_mm is None and unit == "mm":
        unit_mm = 1.0
    if unit_mm is None or (unit == "mm" and unit_mm != 1.0):
        found, expected = f"{unit_mm} with the unit {unit!r}", "name and millimetres of a unit other than mm"
        raise invalid("arguments", "unit_mm", found, expected)
    return Scan(as_floats(projections, "projections", 3), geometry, (unit, float(unit_mm)))


def read_scan(path: str | os.PathLike[str]) -> Scan:
    """Reads a scan: conefield's own folder, R2-Gaussian's, the pickle of NAF and SAX-NeRF, or a ``scanner.toml``."""
    return _native.read_scan(os.fspath(path))


def write_scan(path: str | os.PathLike[str], scan: Scan) -> None:
    """Writes a scan in conefield's own format, with its truth if there is one."""
    _native.write_scan(os.fspath(path), scan)


def as_scan(value: Any) -> Scan:
    """``value`` as a scan: itself or a file."""
    if isinstance(value, Scan):
        return value
    if isinstance(value, (str, os.PathLike)):
        return read_scan(value)
    raise invalid("arguments", "scan", f"a {type(value).__name__}", "a Scan, or the file or folder of one")


def simulate(
    volume: Any,
    geometry: _native.Geometry | None = None,
    *,
    protocol: str | os.PathLike[str] = "r2",
    views: int | None = None,
    detector: Any = None,
    offset: Any = None,
    angles: str | None = None,
    noise: str | None = None,
    values: str = "as-is",
    downsample: int = 1,
    seed: int | None = None,
) -> Scan:
    """Simulates a scan of a known volume; the scan keeps the volume as its truth.

    Projections are line integrals of the trilinearly interpolated volume. As ``conefield simulate``.

    Parameters
    ----------
    volume
        A :class:`Volume`, an array ``[x, y, z]``, a file, or ``"phantom:head"``, ``"phantom:abdomen"``,
        ``"phantom:random:SEED"``, each also with ``:SIZE``.
    geometry
        The geometry; values are then in 1/mm, and the volume keeps its place. An array, or a file of NumPy, fills the
        volume of the geometry. Without one:
    protocol, views, detector, offset, angles
        ``"r2"``, the published synthetic set-up, or a TOML or JSON file; and changes to it: number of views, rows and
        columns, shift of the detector along v and u in mm, and ``"START:RANGE"`` in degrees or a file.
    noise
        ``"none"``, ``"tigre:I0,SIGMA"`` such as ``"tigre:1e4,10"`` (the published one), or ``"poisson:I0"``.
    values
        Meaning of the voxel values: ``"as-is"`` (attenuation), ``"hu:MU_WATER"`` or ``"clip:LO,HI"``.
    downsample
        Average blocks with this many voxels per side first.
    seed
        Seed of the noise.
    """
    beside = [name for name, value in [("views", views), ("detector", detector), ("offset", offset), ("angles", angles)] if value is not None]
    if geometry is not None and (beside or protocol != "r2"):
        raise invalid("arguments", (beside or ["protocol"])[0], "a geometry beside it", "one of them")
    wanted = {
        "protocol": os.fspath(protocol),
        "views": None if views is None else counts(views, "views", 1)[0],
        "detector": None if detector is None else counts(detector, "detector", 2),
        "offset": None if offset is None else pair(offset, "offset"),
        "angles": angles,
        "noise": noise,
        "seed": seed,
        "downsample": counts(downsample, "downsample", 1)[0],
        "values": values,
        "source": os.fspath(volume) if isinstance(volume, (str, os.PathLike)) else "an array",
    }
    return _native.simulate(as_volume(volume, "volume", geometry), encoded(wanted), geometry)
