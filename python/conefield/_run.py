"""Runs: planning, reconstruction, pre-training, scoring."""

from __future__ import annotations

import math
import os
from typing import Any, Iterable, Mapping

import numpy as np

from . import _native
from ._arrays import views
from ._errors import invalid
from ._progress import Callback, Reporter
from ._scan import as_scan
from ._spec import argument, encoded
from ._volume import Volume, as_volume


class Plan:
    """Description of what a spec builds; ``str`` gives the text of ``conefield explain``.

    Attributes
    ----------
    facts
        Stages, widths, parameters, memory and work, with the keys of ``conefield explain --json``.
    schedule
        With a budget: the chosen method, its steps, and the expected time of each part.
    """

    def __init__(self, facts: dict[str, Any], text: str, schedule: dict[str, Any] | None) -> None:
        self.facts = facts
        self.schedule = schedule
        self._text = text

    @property
    def parameters(self) -> int:
        """Parameters of all fields."""
        return self.facts["parameters"]

    @property
    def memory(self) -> dict[str, int] | None:
        """Peak memory of a run in bytes, by use; None without a scan."""
        scan = self.facts["scan"]
        return None if scan is None else scan["memory"]

    def __str__(self) -> str:
        return self._text

    def __repr__(self) -> str:
        return f"Plan({self.facts['spec']!r}, {self.parameters} parameters)"


class Reconstruction:
    """The result of a reconstruction.

    Attributes
    ----------
    volume
        The :class:`Volume`, in 1/unit of the scan.
    scores
        PSNR, RMSE and three definitions of SSIM if a reference was given, else None.
    record
        What was run: spec (``spec_toml`` repeats the run), seed, steps, seconds, memory,
        backend, loss, held-out error, and all records.
    field
        The trained :class:`Field` of a neural method, to evaluate on other grids and to write.
    """

    def __init__(self, volume: Volume, record: dict[str, Any], field: _native.Field | None) -> None:
        self.volume = volume
        self.record = record
        self.scores = _scores(record["scores"])
        self.field = field

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self.volume.__array__(dtype, copy)

    def __repr__(self) -> str:
        x, y, z = self.volume.shape
        score = "" if self.scores is None else f", {self.scores['psnr']:.2f} dB"
        return f"Reconstruction({self.record['spec']!r}, {x} x {y} x {z}, {self.record['steps']} steps{score})"


def _scores(scores: dict[str, Any] | None) -> dict[str, Any] | None:
    """Restores the infinite PSNR of equal volumes, which JSON cannot represent."""
    if scores is not None and scores.get("psnr", 0.0) is None:
        scores["psnr"] = math.inf
    return scores


def _time(value: Any) -> str | None:
    """Seconds, or a text such as ``"10m"``."""
    return None if value is None else str(value)


def _hold_out(value: Any, n: int) -> str | None:
    """View numbers, a mask of the ``n`` views, or a text such as ``"every:10"``."""
    if value is None or isinstance(value, str):
        return value
    return ",".join(str(v) for v in views(value, "hold_out", n))


def _wanted(
    spec: Any,
    sets: Mapping[str, Any] | None,
    overrides: Mapping[str, Any],
    *,
    backend: str = "auto",
    seed: int = 0,
    steps: int | None = None,
    seconds: Any = None,
    at_most: Any = None,
    budget: Any = None,
    peak: float | None = None,
    hold_out: str | None = None,
    init: str | None = None,
    truth: bool = False,
) -> str:
    return encoded(
        {
            "spec": argument(spec, sets, overrides),
            "backend": backend,
            "seed": seed,
            "ends": {"steps": steps, "seconds": _time(seconds), "at_most": _time(at_most)},
            "budget": _time(budget),
            "peak": peak,
            "hold_out": hold_out,
            "init": init,
            "truth": truth,
        }
    )


def plan(
    spec: Any = None,
    scan: Any = None,
    *,
    budget: Any = None,
    backend: str = "auto",
    sets: Mapping[str, Any] | None = None,
    **overrides: Any,
) -> Plan:
    """Describes what a spec builds: stages, widths, parameters, memory, work. As ``conefield explain``.

    With a scan, includes the memory for it and the results of its analysis before a run. With a ``budget`` (seconds, or a string such as
    ``"5m"``) the machine is measured for one to three seconds, and ``schedule`` has the plan; without a spec the best method that
    fits is chosen.
    """
    scan = None if scan is None else as_scan(scan)
    wanted = _wanted(spec, sets, overrides, backend=backend, budget=budget)
    facts, text, schedule = _native.plan(wanted, scan)
    return Plan(facts, text, schedule)


def explain(spec: Any, scan: Any = None, **arguments: Any) -> str:
    """The text of ``conefield explain``. Arguments as for :func:`plan`."""
    return str(plan(spec, scan, **arguments))


def reconstruct(
    scan: Any,
    spec: Any = None,
    *,
    budget: Any = None,
    init: Any = None,
    reference: Any = None,
    peak: float | None = None,
    hold_out: Any = None,
    steps: int | None = None,
    seconds: Any = None,
    at_most: Any = None,
    seed: int = 0,
    backend: str = "auto",
    callback: Callback | None = None,
    every: float = 1.0,
    slices: bool = False,
    progress: bool = False,
    sets: Mapping[str, Any] | None = None,
    **overrides: Any,
) -> Reconstruction:
    """Reconstructs a volume from a scan. As ``conefield reconstruct``, and to the same bits.

    Parameters
    ----------
    scan
        A :class:`Scan`, or the file or folder of one.
    spec
        A shipped name (:func:`spec_names`), the type of a method, a TOML or JSON file, or a dict with the keys of one
        (``{"extends": "fast", "field": {"width": 32}}``). Optional with a budget.
    budget
        Time of the whole run: seconds, or a string such as ``"60s"`` or ``"10m"``.
    init
        Weights of :func:`pretrain`, or a volume (in 1/unit of the scan), to start from.
    reference
        The volume to score against: a volume, an array or a file, or ``"truth"`` for the one in the scan, also where
        there is a file of this name. It does not influence the result.
    peak
        The data range for PSNR and SSIM: 1 for a reference in [0, 1] that exceeds 0.5, else its range.
    hold_out
        Views to hold out and predict: their indices, a mask of all views, or a string such as ``"every:10"`` for views
        5, 15, 25, ….
    steps, seconds, at_most
        When training ends: a number of steps, a time that learning-rate schedules aim for, and a time limit that they
        ignore.
    seed
        Seed of all random numbers. The same spec, seed, input and build give the same bits on the CPU.
    backend
        ``"auto"``, ``"cpu"``, ``"wgpu"``, ``"wgpu:N"`` or, for a volume that several adapters share, ``"wgpu:N,M"``.
    callback
        Called with a :class:`Progress` at most every ``every`` seconds, and at the end. With ``slices`` it also gets the
        middle slices of a training field. An exception ends the run.
    progress
        Show a progress bar if tqdm is installed.
    sets, **overrides
        Settings to change, by path: ``sets={"encoder.levels": 8}``, or a keyword with two underscores for a dot:
        ``encoder__levels=8``.

    Ctrl-C ends the run, after its step at the latest, with :class:`KeyboardInterrupt`. Other Python threads keep running.
    """
    scan = as_scan(scan)
    truth = isinstance(reference, str) and reference == "truth"
    known = None if reference is None or truth else as_volume(reference, "reference", scan.geometry)
    file, start = _start(init, scan.geometry)
    wanted = _wanted(
        spec,
        sets,
        overrides,
        backend=backend,
        seed=seed,
        steps=steps,
        seconds=seconds,
        at_most=at_most,
        budget=budget,
        peak=peak,
        hold_out=_hold_out(hold_out, len(scan)),
        init=file,
        truth=truth,
    )
    with Reporter("reconstruct", callback, every, slices, progress) as report:
        return Reconstruction(*_native.reconstruct(scan, wanted, start, known, report))


def _start(init: Any, geometry: _native.Geometry) -> tuple[str | None, Volume | None]:
    """A file, or a volume in memory."""
    if init is None:
        return None, None
    if isinstance(init, (str, os.PathLike)):
        return os.fspath(init), None
    return None, as_volume(init, "init", geometry)


def pretrain(
    volumes: Iterable[Any],
    output: str | os.PathLike[str],
    spec: Any,
    *,
    steps: int | None = None,
    seconds: Any = None,
    at_most: Any = None,
    seed: int = 0,
    backend: str = "auto",
    callback: Callback | None = None,
    every: float = 1.0,
    progress: bool = False,
    sets: Mapping[str, Any] | None = None,
    **overrides: Any,
) -> dict[str, Any]:
    """Trains a field on known volumes and writes weights for other scans to start from (MCI). As ``conefield pretrain``.

    ``volumes`` are volumes, arrays, files or phantoms; ``output`` ends in ``.safetensors``. Returns the record.
    """
    if isinstance(volumes, (str, os.PathLike, Volume)):
        raise invalid("arguments", "volumes", "one volume", "a list of them")
    known = [as_volume(v, "volumes") for v in volumes]
    wanted = _wanted(
        spec, sets, overrides, backend=backend, seed=seed, steps=steps, seconds=seconds, at_most=at_most
    )
    with Reporter("pretrain", callback, every, False, progress) as report:
        return _native.pretrain(known, os.fspath(output), wanted, report)


def evaluate(volume: Any, reference: Any, *, peak: float | None = None, labels: bool = False) -> dict[str, Any]:
    """Scores a volume against a reference. As ``conefield evaluate --json``.

    ``psnr`` (dB), ``rmse``, ``ssim_2d``, ``ssim_3d`` and ``ssim_skimage``, the slices with the largest error, and ``peak``, the data
    range. With ``labels`` both are label maps of whole numbers, and the result is ``dice``.
    """
    found = _native.evaluate(as_volume(volume, "volume"), as_volume(reference, "reference"), peak, labels)
    return _scores(found) or {}


def read_field(path: str | os.PathLike[str]) -> _native.Field:
    """The trained field of a finished run: its folder, or its ``weights.safetensors``."""
    return _native.read_field(os.fspath(path))
