"""CT volumes from few cone-beam X-ray views.

Lengths are millimetres, angles radians unless a text says degrees, attenuation is in 1/mm or in 1/unit of a scan. Volumes
are ``[x, y, z]``, projections ``[view, row, column]``, rows are v and columns u. The world is right-handed, the rotation
axis is z; the source at angle a is at ``dso·(cos a, sin a, 0)``, columns run along ``(-sin a, cos a, 0)`` and rows
towards -z. Arrays may be anything that NumPy can read, or that exports DLPack from the CPU.

Work runs without the GIL. Ctrl-C ends it with KeyboardInterrupt. Errors are :class:`Error`. Log messages go to
``logging.getLogger("conefield")``. ``RAYON_NUM_THREADS`` sets the number of threads [default: one per core]. Threads do not
survive a fork: use multiprocessing with the start method ``spawn``.
"""

from ._calibration import Calibration, calibrate
from ._errors import (
    DeviceError,
    DivergedError,
    Error,
    FileError,
    InternalError,
    InvalidError,
    MissingFileError,
    UnsupportedError,
)
from ._geometry import Geometry, circular, from_vectors
from ._native import Field, __version__
from ._operator import Operator, backproject, project
from ._progress import Progress
from ._run import Plan, Reconstruction, evaluate, explain, plan, pretrain, read_field, reconstruct
from ._scan import Scan, read_scan, scan, simulate, write_scan
from ._spec import schema, spec_names, spec_text
from ._stages import Check, check_stage, encoder, regularizer, stage_names
from ._study import study
from ._volume import Volume, read_volume

__all__ = [
    "Calibration",
    "Check",
    "DeviceError",
    "DivergedError",
    "Error",
    "Field",
    "FileError",
    "Geometry",
    "InternalError",
    "InvalidError",
    "MissingFileError",
    "Operator",
    "Plan",
    "Progress",
    "Reconstruction",
    "Scan",
    "UnsupportedError",
    "Volume",
    "__version__",
    "backproject",
    "calibrate",
    "check_stage",
    "circular",
    "encoder",
    "evaluate",
    "explain",
    "from_vectors",
    "plan",
    "pretrain",
    "project",
    "read_field",
    "read_scan",
    "read_volume",
    "reconstruct",
    "regularizer",
    "scan",
    "schema",
    "simulate",
    "spec_names",
    "spec_text",
    "stage_names",
    "study",
    "write_scan",
]
