"""The exceptions. Their messages are those of the command ``conefield``, with arguments in place of its options."""

import re


class Error(Exception):
    """The base class of conefield's errors."""


class InvalidError(Error, ValueError):
    """A value that cannot be used.

    ``place`` is a file, a spec or an argument, ``field`` the field in it, ``found`` the value and ``expected`` what is
    valid.
    """

    place: str = ""
    field: str = ""
    found: str = ""
    expected: str = ""


class FileError(Error, OSError):
    """An error of the operating system for a file."""


class MissingFileError(FileError, FileNotFoundError):
    """A file does not exist."""


class UnsupportedError(Error, NotImplementedError):
    """A request that this build or spec does not support, or that does not fit into memory."""


class DeviceError(Error, RuntimeError):
    """A GPU failed or was lost."""


class DivergedError(Error, ArithmeticError):
    """Training diverged."""


class InternalError(Error, RuntimeError):
    """A bug in conefield."""


_NAMES = ("angles", "backend", "budget", "hold-out", "peak", "reference", "spec", "values", "views")
_ARGUMENTS = {
    **{f"--{name}": name.replace("-", "_") for name in _NAMES},
    "--force": "force=True",
    "--resume": "resume=True",
    "--memory or the system": "the system",
    **{f"--{name}": f"the command's --{name}" for name in ("i0", "plugin", "scratch")},
}
_OPTION = re.compile(f"({'|'.join(_ARGUMENTS)})(?![\\w-])")


def in_python(text):
    """A message of the command, with the arguments of this package in place of options."""
    return _OPTION.sub(lambda option: _ARGUMENTS[option[0]], text)


def invalid(place, field, found, expected):
    """An :class:`InvalidError` with the standard message."""
    error = InvalidError(f"{place}: {field}: found {found}, expected {expected}")
    error.place, error.field, error.found, error.expected = place, field, str(found), expected
    return error
