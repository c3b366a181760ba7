"""Voxels with their position in the world."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from . import _native
from ._arrays import as_floats, triple
from ._errors import invalid


class Volume:
    """Voxels of attenuation (or another quantity) with their position in the world.

    Parameters
    ----------
    data
        Values, ``[x, y, z]``: an array, or anything that exports DLPack. Attenuation is in 1/mm, or in 1/unit of the scan
        that it belongs to.
    spacing
        Side lengths of a voxel along x, y and z, mm; one number for cubes.
    center
        Centre of the grid, mm. The rotation axis is z through 0.
    affine
        Four by four: voxel indices to the patient's or the file's own coordinates in mm (NIfTI's, RAS), if known.

    ``data`` is a NumPy array of ``float32``. It is writable. ``hu`` is None for attenuation; for Hounsfield units it
    says what water and air were, for the headers of files.
    """

    __slots__ = ("data", "spacing", "center", "affine", "hu")

    data: np.ndarray
    spacing: tuple[float, float, float]
    center: tuple[float, float, float]
    affine: np.ndarray | None
    hu: str | None

    def __init__(self, data: Any, spacing: Any = 1.0, center: Any = 0.0, affine: Any = None) -> None:
        self.data = as_floats(data, "data", 3)
        self.spacing = triple(spacing, "spacing")
        self.center = triple(center, "center")
        self.hu = None
        self.affine = None if affine is None else as_floats(affine, "affine", 2, np.float64)
        if self.affine is not None and self.affine.shape != (4, 4):
            raise invalid("arguments", "affine", f"an array of shape {self.affine.shape}", "(4, 4)")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        return self.data.shape  # type: ignore[return-value]

    def hounsfield(self, how: str | os.PathLike[str], unit: tuple[str, float] | None) -> Volume:
        """The volume in Hounsfield units, ``1000·(μ − water)/(water − air)``. As ``--hu`` of the command.

        Parameters
        ----------
        how
            ``"water=0.0206,air=0"`` in 1/mm, with ``sphere:X,Y,Z,R`` or ``box:X,Y,Z,X,Y,Z`` (mm, in the coordinates of
            ``affine``) in place of a value to take the median there; ``"60keV"``; a calibration file (``.toml``) with
            water and air; or ``"as-is"``: the values are Hounsfield units already.
        unit
            The values are in 1/unit: ``scan.unit``, or None for 1/mm. Values in 1/mm need a unit of length.
        """
        return _native.hounsfield(self, os.fspath(how), unit)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Writes ``.nii``, ``.nii.gz``, ``.mha``, ``.mhd``, ``.nrrd``, ``.npy``, ``.tif``, ``.zarr``, ``.dicom``
        (a series) or ``.dcm`` (one file), by the extension.

        No partial file is left.
        """
        _native.write_volume(os.fspath(path), self)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if dtype is not None and np.dtype(dtype) != self.data.dtype:
            if copy is False:
                raise ValueError(f"a volume of float32 has no view as {np.dtype(dtype)}")
            return self.data.astype(dtype)
        return self.data.copy() if copy else self.data

    def __dlpack__(self, **arguments: Any) -> Any:
        return self.data.__dlpack__(**arguments)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self.data.__dlpack_device__()

    def __repr__(self) -> str:
        x, y, z = self.shape
        return f"Volume({x} x {y} x {z}, spacing {self.spacing} mm)"


def as_volume(value: Any, name: str, like: Any = None) -> Volume:
    """``value`` as a volume: itself, a file, ``phantom:KIND[:SIZE]``, or an array.

    An array, or a file of NumPy, has no voxel sizes: it fills the volume of the geometry ``like``, or has voxels of 1 mm.
    """
    if isinstance(value, Volume):
        return value
    if isinstance(value, (str, os.PathLike)):
        volume = _native.read_volume(os.fspath(value))
        if not os.fspath(value).endswith(".npy"):
            return volume
    else:
        volume = Volume(as_floats(value, name, 3))
    if like is not None and 0 not in volume.shape:
        sides = zip(like.volume_shape, like.spacing, volume.shape)
        volume.spacing = tuple(side if n == own else n * side / own for n, side, own in sides)
        volume.center = like.center
    return volume


def read_volume(path: str | os.PathLike[str]) -> Volume:
    """Reads a volume: NIfTI, MetaImage, NRRD, NumPy, a TIFF stack, OME-Zarr, or a folder of DICOM or TIFF slices.

    ``phantom:head``, ``phantom:abdomen`` and ``phantom:random:SEED``, each optionally with ``:SIZE``, are built in.
    """
    return _native.read_volume(os.fspath(path))
