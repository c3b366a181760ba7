"""Specs: by name, file or dict, with overridden settings."""

from __future__ import annotations

import json
import math
import os
from typing import Any, Mapping

import numpy as np

from . import _native
from ._errors import Error, invalid


def _plain(value: Any) -> Any:
    """Converts NumPy numbers and paths to JSON values."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise invalid("spec", "value", f"a {type(value).__name__}", "numbers, texts, lists and dicts")


def _stray(value: Any, path: str = "") -> tuple[str, Any] | None:
    """Path and value of the first number that is not finite."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, float) and not math.isfinite(value):
        return path, value
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, (list, tuple)) else ()
    found = (_stray(part, f"{path}.{key}" if path else str(key)) for key, part in parts)
    return next(filter(None, found), None)


def encoded(value: Any) -> str:
    """``value`` in JSON, which has finite numbers only."""
    try:
        text = json.dumps(value, default=_plain)
    except Error:
        raise
    except (TypeError, ValueError) as error:
        raise invalid("arguments", "value", error, "numbers, texts, lists and dicts") from error
    stray = _stray(value)
    if stray is not None:
        path, number = stray
        # The path as the caller knows it, see argument().
        path = path.removeprefix("spec.").removeprefix("sets.").removeprefix("table.")
        raise invalid("arguments", path, number, "a finite number")
    return text


def argument(spec: Any, sets: Mapping[str, Any] | None, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """A spec as argument of the native module."""
    paths = dict(sets or {})
    for key, value in overrides.items():
        path = key.replace("__", ".")
        if path in paths:
            raise invalid("arguments", path, "the setting twice", "it once, in sets or by its keyword")
        paths[path] = value
    if spec is None or isinstance(spec, (str, os.PathLike)):
        return {"name": None if spec is None else os.fspath(spec), "table": None, "sets": paths}
    if isinstance(spec, Mapping):
        return {"name": None, "table": dict(spec), "sets": paths}
    raise invalid("arguments", "spec", f"a {type(spec).__name__}", "a name, a file or a dict")


def spec_names() -> list[str]:
    """All names of specs: shipped ones, and methods that need no settings."""
    return _native.spec_names()


def spec_text(spec: Any, sets: Mapping[str, Any] | None = None, **overrides: Any) -> str:
    """The spec as TOML with all defaults written out, as a run would use it."""
    return _native.spec_text(encoded(argument(spec, sets, overrides)))


def schema() -> dict[str, Any]:
    """The JSON Schema of specs, with the meaning and default of every key."""
    return _native.schema()
