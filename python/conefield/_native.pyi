"""The native module. Its public interface is ``conefield``."""

from os import PathLike
from typing import Any, Callable

import numpy as np
from numpy.typing import NDArray

from ._volume import Volume

__version__: str

_Tell = tuple[Callable[..., None], float, bool] | None
_Voxels = tuple[list[int], tuple[float, ...], tuple[float, ...]]

class Geometry:
    """Source, detector and voxels of every view, made by ``circular`` or ``from_vectors``.

    Lengths are millimetres. It is immutable, compares by value and can be pickled.
    """

    @staticmethod
    def circular(
        dso: float | None,
        dsd: float | None,
        angles: NDArray[np.float64],
        detector: list[int],
        pixel: tuple[float, float],
        offset: tuple[float, float],
        tilt: tuple[float, float, float],
        volume: _Voxels,
    ) -> Geometry: ...
    @staticmethod
    def from_vectors(vectors: NDArray[np.float64], detector: list[int], volume: _Voxels) -> Geometry: ...
    def with_volume(
        self, shape: list[int], spacing: tuple[float, float, float], center: tuple[float, float, float]
    ) -> Geometry:
        """The same views with another volume."""
    def select(self, views: Any) -> Geometry:
        """The views with these indices, or where a mask is true."""
    def orbit(self) -> tuple[float, float, list[float], list[float], list[float]] | None:
        """The circular orbit of the views, if they lie on one: dso, dsd, pixel, offset, angles."""
    @property
    def vectors(self) -> NDArray[np.float64]:
        """``[view, 12]``: source, detector centre, u, v."""
    @property
    def detector(self) -> tuple[int, int]:
        """Rows and columns."""
    @property
    def volume_shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
    @property
    def spacing(self) -> tuple[float, float, float]:
        """Voxel size, mm."""
    @property
    def center(self) -> tuple[float, float, float]:
        """The middle of the voxels, mm."""
    @property
    def projections_shape(self) -> tuple[int, int, int]:
        """Views, rows and columns."""
    def __len__(self) -> int: ...

class Scan:
    """Measured line integrals and their geometry. It is immutable."""

    def __init__(self, projections: NDArray[np.float32], geometry: Geometry, unit: tuple[str, float]) -> None: ...
    @property
    def projections(self) -> NDArray[np.float32]:
        """``[view, row, column]``, read-only and without a copy."""
    @property
    def geometry(self) -> Geometry: ...
    @property
    def unit(self) -> tuple[str, float]:
        """The unit of length of the volumes (1/unit): name and millimetres."""
    @property
    def provenance(self) -> Any:
        """The origin of the scan."""
    @property
    def truth(self) -> Volume | None:
        """The volume that it was simulated from, if known. Read from its file, which must not have changed since."""
    def split(self, held: Any) -> tuple[Scan, Scan]:
        """The scan without these views (indices or a mask), and one with only these."""
    def __len__(self) -> int: ...

class Field:
    """A trained field."""

    def volume(self, voxels: int | None = None, backend: str = "auto") -> Volume:
        """Its values on a grid with this many voxels along the longest side of the reconstructed box."""
    def write(self, path: str | PathLike[str]) -> None:
        """Writes ``weights.safetensors``, which ``conefield export`` and ``read_field`` read."""
    @property
    def parameters(self) -> int: ...

def apply(geometry: Geometry, projector: str, array: NDArray[Any], adjoint: bool) -> NDArray[Any]: ...
def calibrate(scan: Scan, wanted: str, function: _Tell) -> tuple[Scan, dict[str, Any]]: ...
def command(words: list[str], program: list[str]) -> int: ...
def check_stage(kind: str, table: str) -> tuple[bool, str, list[tuple[str, str, str]]]: ...
def evaluate(volume: Volume, reference: Volume, peak: float | None, labels: bool) -> dict[str, Any]: ...
def hounsfield(volume: Volume, how: str, unit: tuple[str, float] | None) -> Volume: ...
def plan(wanted: str, scan: Scan | None) -> tuple[dict[str, Any], str, dict[str, Any] | None]: ...
def pretrain(volumes: list[Volume], output: str, wanted: str, function: _Tell) -> dict[str, Any]: ...
def project_scan(scan: Scan, projector: str, volume: Volume, residual: bool) -> NDArray[np.float32]: ...
def read_field(path: str) -> Field: ...
def read_scan(path: str) -> Scan: ...
def read_volume(name: str) -> Volume: ...
def reconstruct(
    scan: Scan, wanted: str, start: Volume | None, reference: Volume | None, function: _Tell
) -> tuple[Volume, dict[str, Any], Field | None]: ...
def register(kind: str, name: str, doc: str, cls: type) -> None: ...
def schema() -> dict[str, Any]: ...
def simulate(volume: Volume, wanted: str, geometry: Geometry | None) -> Scan: ...
def spec_names() -> list[str]: ...
def spec_text(spec: str) -> str: ...
def stage_names(kind: str) -> list[str]: ...
def write_scan(path: str, scan: Scan) -> None: ...
def write_volume(path: str, volume: Volume) -> None: ...
