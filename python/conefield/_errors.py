"""The exceptions. Their words are those of the command ``conefield``."""


class Error(Exception):
    """Everything that conefield raises by itself."""


class InvalidError(Error, ValueError):
    """A value that cannot be used.

    ``place`` says where it stands (a file, a spec, an argument), ``field`` which it is, ``found`` what it is and
    ``expected`` what would do.
    """

    place: str = ""
    field: str = ""
    found: str = ""
    expected: str = ""


class FileError(Error, OSError):
    """The operating system refused."""


class MissingFileError(FileError, FileNotFoundError):
    """There is no such file."""


class UnsupportedError(Error, NotImplementedError):
    """Something that this build or this spec cannot do: also what does not fit into memory."""


class DeviceError(Error, RuntimeError):
    """A device that computes refused or was lost."""


class DivergedError(Error, ArithmeticError):
    """Training left the finite numbers."""


class InternalError(Error, RuntimeError):
    """A fault of conefield itself."""


def invalid(place, field, found, expected):
    """An :class:`InvalidError` in its usual words."""
    error = InvalidError(f"{place}: {field}: found {found}, expected {expected}")
    error.place, error.field, error.found, error.expected = place, field, str(found), expected
    return error
