"""The progress of a run, for callbacks and a bar."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any, Callable

import numpy as np


@dataclass(frozen=True)
class Progress:
    """The progress of a run."""

    #: Finished steps (of a field) or passes over the views.
    step: int
    #: Finished share, 0 to 1.
    share: float
    #: Seconds left, as estimated by the method; infinite if unknown.
    seconds_left: float
    #: The records since the last call, with the keys of ``metrics.jsonl``: step, seconds, loss, psnr, held_out, …
    records: list[dict[str, Any]] = field(default_factory=list)
    #: The middle slices ``[y, z]``, ``[x, z]`` and ``[x, y]`` of a training field, in 1/unit of the scan.
    slices: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


Callback = Callable[[Progress], Any]


class Bar:
    """A tqdm progress bar."""

    def __init__(self, what: str) -> None:
        from tqdm.auto import tqdm

        self._bar = tqdm(total=100, desc=what, unit="%", bar_format="{l_bar}{bar}| {postfix}")

    def __call__(self, progress: Progress) -> None:
        self._bar.n = round(100 * progress.share)
        latest = progress.records[-1] if progress.records else {}
        shown = {key: latest[key] for key in ("loss", "held_out", "psnr") if latest.get(key) is not None}
        if shown:
            self._bar.set_postfix({"step": progress.step, **shown}, refresh=False)
        self._bar.refresh()

    def close(self) -> None:
        self._bar.close()


def _has_tqdm() -> bool:
    try:
        import tqdm.auto  # noqa: F401
    except ImportError:
        return False
    return True


class Reporter:
    """Passes the progress of a run to a callback and a bar."""

    def __init__(self, what: str, callback: Callback | None, every: float, slices: bool, bar: bool) -> None:
        self._callback = callback
        self._every = float(every)
        self._slices = slices
        self._bar = Bar(what) if bar and _has_tqdm() else None

    def __enter__(self) -> tuple[Callable[..., None], float, bool] | None:
        if self._callback is None and self._bar is None:
            return None
        return self._report, max(self._every, 0.0), self._slices and self._callback is not None

    def __exit__(self, *_: Any) -> None:
        if self._bar is not None:
            self._bar.close()

    def _report(self, step: int, share: float, seconds_left: float, records: str, slices: list[np.ndarray] | None) -> None:
        flat = None
        if slices is not None:
            x, y, z = slices
            flat = (x[0], y[:, 0], z[:, :, 0])
        progress = Progress(step, share, seconds_left, json.loads(records), flat)
        if self._bar is not None:
            self._bar(progress)
        if self._callback is not None:
            self._callback(progress)
