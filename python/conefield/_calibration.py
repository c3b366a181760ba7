"""The position of the detector, estimated from the views."""

from __future__ import annotations

from typing import Any, Iterable

from . import _native
from ._progress import Callback, Reporter
from ._scan import Scan, as_scan
from ._spec import encoded


class Calibration:
    """The result of a calibration; ``str`` gives one line per parameter.

    Attributes
    ----------
    scan
        The :class:`Scan` with the corrected geometry.
    parameters
        A dict for each parameter: ``parameter``, ``verdict`` (``"corrected"``, ``"kept"`` or ``"not-determined"``), ``reason``,
        ``change`` and ``uncertainty`` (one standard deviation) in ``unit``, both in ``pixels``, and ``curve``, the error for
        changes around the best one.
    held_out
        The error of predicted views ``before`` and ``after``, relative to the largest line integral, and their number ``views``.
    direction
        The errors with the ``given`` direction of rotation and with the ``reversed`` one; None if the sources are not on a circle.
        A much smaller second one is also logged as a warning.
    jitter
        With ``jitter=True`` a dict: ``shifts`` of the detector along v and u for each view in mm, their root mean square in ``pixels``
        along v and u, its ``uncertainty``, the ``held_out`` error before and after, and the ``verdict``.
    """

    def __init__(self, scan: Scan, result: dict[str, Any]) -> None:
        self.scan = scan
        self.parameters = result["parameters"]
        self.held_out = result["held_out"]
        self.direction = result["direction"]
        self.jitter = result["jitter"]

    def __str__(self) -> str:
        def line(p: dict[str, Any]) -> str:
            if p["verdict"] == "not-determined":
                return f"{p['parameter']}: not determined: {p['reason']}"
            pixels, deviation = p["pixels"]
            return (
                f"{p['parameter']}: {p['change']:.4g} ± {p['uncertainty']:.2g} {p['unit']} "
                f"({pixels:.2f} ± {deviation:.2f} pixels), {p['verdict']}"
            )

        errors = f"held-out error {self.held_out['before']:.4f}, {self.held_out['after']:.4f} with the corrections"
        lines = [*map(line, self.parameters), errors]
        if self.jitter is not None:
            v, u = self.jitter["pixels"]
            lines.append(f"shifts of single views: root mean square {u:.2f} pixels along u, {v:.2f} along v, {self.jitter['verdict']}")
        return "\n".join(lines)

    __repr__ = __str__


def calibrate(
    scan: Any,
    parameters: Iterable[str] = ("offset-u", "rotation"),
    *,
    pixels: int = 64,
    jitter: bool = False,
    backend: str = "auto",
    callback: Callback | None = None,
    every: float = 1.0,
    progress: bool = False,
) -> Calibration:
    """Estimates the position of the detector from the views, without a phantom. As ``conefield calibrate``.

    Parameters
    ----------
    scan
        A :class:`Scan`, or the file or folder of one. It is not changed.
    parameters
        ``"offset-u"``, ``"offset-v"``, ``"rotation"``, ``"tilt"``, ``"slant"``, ``"distance"`` or ``"step"``.
    pixels
        Pixels along the longer side of the detector at the finest level, 16 to 1024.
    jitter
        Also estimate a shift of the detector in each view, after the other parameters.
    callback, every, progress
        As in :func:`reconstruct`.
    """
    names = [parameters] if isinstance(parameters, str) else list(parameters)
    wanted = encoded({"parameters": names, "pixels": int(pixels), "jitter": bool(jitter), "backend": backend})
    with Reporter("calibrate", callback, every, False, progress) as report:
        return Calibration(*_native.calibrate(as_scan(scan), wanted, report))
