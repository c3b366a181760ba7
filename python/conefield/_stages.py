"""Stages written in Python."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any, Callable, TypeVar

from . import _native
from ._errors import invalid
from ._spec import encoded

C = TypeVar("C", bound=type)


def _decorator(kind: str, methods: tuple[str, ...], name: str) -> Callable[[C], C]:
    # A decorator without a name gets the class in its place.
    if not isinstance(name, str) or not name:
        raise invalid("stage", "name", repr(name), f'a text, as in @conefield.{kind}("name")')
    return lambda cls: _register(kind, methods, name, cls)


def _register(kind: str, methods: tuple[str, ...], name: str, cls: C) -> C:
    if not inspect.isclass(cls):
        raise invalid("stage", name, f"a {type(cls).__name__}", "a class")
    for method in methods:
        if not callable(getattr(cls, method, None)):
            raise invalid("stage", name, f"a class without {method}", f"the methods {', '.join(methods)}")
    doc = (inspect.getdoc(cls) or f"{cls.__name__}, written in Python").split("\n")[0]
    _native.register(kind, name, doc, cls)
    return cls


def encoder(name: str) -> Callable[[C], C]:
    """Registers a class as the encoder type ``name`` for specs.

    ::

        @conefield.encoder("waves")
        class Waves:
            def __init__(self, bands=4):          # the settings of a spec
                self.rates = np.pi * 2.0 ** np.arange(bands)
                self.params = {"gain": np.ones(bands, np.float32)}

            def forward(self, x):                 # [rows, 3] in the unit cube to [rows, channels]
                ...

            def backward(self, x, dy):            # to ∂L/∂x and {"gain": ∂L/∂gain}, summed over the rows
                ...

    ``params`` holds the initial values of the trained parameters by name; without it nothing is trained. Before each call the
    current values are set as ``self.params``, in the precision of ``x`` (``float32`` in training, ``float64`` when gradients are
    checked); results must keep that precision. A class may also have ``resolutions``, the cells per side of the unit cube
    that each channel resolves, and ``coarse_to_fine``.

    The GIL is acquired for each batch, and one batch runs at a time: this is for prototyping. An exception ends the
    run. Registering a name again replaces the class.
    """
    return _decorator("encoder", ("forward", "backward"), name)


def regularizer(name: str) -> Callable[[C], C]:
    """Registers a class as the regularizer type ``name``, for the key ``prior`` of ``fista``.

    ::

        @conefield.regularizer("gaussian")
        class Gaussian:
            noise_weight = 1.0

            def prox(self, v, tau):               # [x, y, z], float32, to an array like it
                return scipy.ndimage.gaussian_filter(v, 0.5)

    ``prox(v, tau)`` is ``argmin_u ½‖u − v‖² + tau·R(u)``, or a denoiser in its place (plug-and-play); negative results are
    set to 0. ``value(x)`` is R(x); without it only the data term is monitored. ``v`` is attenuation in 1/mm.
    ``tau`` is the weight λ over the step's constant. ``weight`` is λ itself; ``noise_weight`` (default 1) is a multiple of
    the scan's noise level. Before each call ``self.spacing`` is set to the voxel size in mm.
    """
    return _decorator("regularizer", ("prox",), name)


@dataclass(frozen=True)
class Check:
    """The report of the conformance kit on a stage; ``str`` gives its text."""

    #: Whether every property that applies holds.
    passed: bool
    #: For each property: its name, "passed", "failed" or "skipped", and the evidence.
    properties: list[tuple[str, str, str]]
    report: str

    @property
    def failed(self) -> list[str]:
        """Names of failed properties."""
        return [name for name, outcome, _ in self.properties if outcome == "failed"]

    def __str__(self) -> str:
        return self.report

    def __bool__(self) -> bool:
        return self.passed


def check_stage(kind: str, name: str, **settings: Any) -> Check:
    """Runs the conformance kit on a stage of any kind, written in Python or not, property by property.

    For an encoder: gradients against finite differences, independence of the batch size, extremes, masked channels. For a
    regularizer: its proximal map is that of its value, its value is convex, and more. A denoiser without ``value`` fails the property
    "proximal map" and still runs as plug-and-play. A normalizer or a field is checked with 1, 3, 8 and 20 input channels.
    """
    passed, report, properties = _native.check_stage(kind, encoded({**settings, "type": name}))
    return Check(passed, properties, report)


def stage_names(kind: str) -> list[str]:
    """The types of a kind ("encoder", "field", "regularizer", …) that specs can name."""
    return _native.stage_names(kind)
