"""Conversion of arguments to arrays: NumPy arrays, anything that NumPy converts, and DLPack exports from the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np

from ._errors import invalid

__all__ = ["as_array", "as_floats"]


def as_array(values: Any, name: str) -> np.ndarray:
    """``values`` as a NumPy array, without a copy if possible."""
    if not isinstance(values, np.ndarray) and hasattr(values, "__dlpack__"):
        try:
            return np.from_dlpack(values)
        except (BufferError, RuntimeError, TypeError, ValueError) as error:
            # On another device, with a gradient, or of a type that NumPy lacks.
            raise invalid("arguments", name, f"an array that NumPy cannot take ({error})", "one on the CPU, detached") from error
    return np.asarray(values)


def as_real(values: Any, name: str) -> np.ndarray:
    """``values`` as an array of real numbers of any type."""
    array = as_array(values, name)
    if array.dtype.kind not in "fiub":
        raise invalid("arguments", name, f"an array of {array.dtype}", "an array of real numbers")
    return array


def as_floats(values: Any, name: str, axes: int, dtype: Any = np.float32) -> np.ndarray:
    """``values`` as an array of real numbers with ``axes`` axes."""
    array = as_real(values, name)
    if array.ndim != axes:
        raise invalid("arguments", name, f"an array with {array.ndim} axes", f"{axes} axes")
    return array.astype(dtype, copy=False)


def triple(value: Any, name: str) -> tuple[float, float, float]:
    """One number for all of x, y and z, or three."""
    numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if numbers.shape not in ((1,), (3,)):
        raise invalid("arguments", name, f"{value!r}", "one number, or three for x, y and z")
    x, y, z = np.broadcast_to(numbers, 3).tolist()
    return x, y, z


def pair(value: Any, name: str) -> tuple[float, float]:
    """One number for both of v and u, or two."""
    numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if numbers.shape not in ((1,), (2,)):
        raise invalid("arguments", name, f"{value!r}", "one number, or two for v (rows) and u (columns)")
    v, u = np.broadcast_to(numbers, 2).tolist()
    return v, u


def counts(value: Any, name: str, n: int) -> list[int]:
    """``n`` whole numbers above 0, or one for all."""
    numbers = np.atleast_1d(np.asarray(value))
    good = numbers.shape in ((1,), (n,)) and numbers.dtype.kind in "iu" and bool((numbers > 0).all())
    if not good:
        raise invalid("arguments", name, f"{value!r}", f"{n} whole numbers above 0, or one for all")
    return [int(x) for x in np.broadcast_to(numbers, n)]


def views(values: Any, name: str, n: int) -> list[int]:
    """Indices of views, of ``n``: as given, or where a mask is true."""
    array = np.atleast_1d(as_array(values, name))
    if array.dtype.kind == "b":
        if array.shape != (n,):
            raise invalid("arguments", name, f"a mask of shape {array.shape}", f"({n},), one truth value per view")
        return np.flatnonzero(array).tolist()
    if array.ndim != 1 or array.size > 0 and array.dtype.kind not in "iu":
        found = f"an array of {array.dtype} with {array.ndim} axes"
        raise invalid("arguments", name, found, "whole numbers, or a mask with one truth value per view")
    return [int(v) for v in array]
