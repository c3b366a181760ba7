"""Stages that are written in Python."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any, Callable, TypeVar

from . import _native
from ._errors import invalid
from ._spec import encoded

C = TypeVar("C", bound=type)


def _register(kind: str, methods: tuple[str, ...], name: str, cls: C) -> C:
    if not isinstance(name, str) or not name:
        raise invalid("stage", "name", repr(name), "a text")
    if not inspect.isclass(cls):
        raise invalid("stage", name, f"a {type(cls).__name__}", "a class")
    for method in methods:
        if not callable(getattr(cls, method, None)):
            raise invalid("stage", name, f"a class without {method}", f"the methods {', '.join(methods)}")
    doc = (inspect.getdoc(cls) or f"{cls.__name__}, written in Python").split("\n")[0]
    _native.register(kind, name, doc, cls)
    return cls


def encoder(name: str) -> Callable[[C], C]:
    """Registers a class as the encoder type ``name``: specs then name it wherever an encoder is wanted.

    ::

        @conefield.encoder("waves")
        class Waves:
            def __init__(self, bands=4):          # what a spec says beside "type"
                self.rates = np.pi * 2.0 ** np.arange(bands)
                self.params = {"gain": np.ones(bands, np.float32)}

            def forward(self, x):                 # [rows, 3] in the unit cube to [rows, channels]
                ...

            def backward(self, x, dy):            # to ∂L/∂x and {"gain": ∂L/∂gain}, summed over the rows
                ...

    ``params`` holds the first values of what is trained, by name; without it there is nothing to train. Before each call the
    values of the moment are set as ``self.params``, in the precision of ``x`` (``float32`` in training; ``float64`` when
    gradients are checked, for which results must keep the precision of ``x``). A class may also have ``resolutions``, the
    cells along the unit cube's side that each channel tells apart, and ``coarse_to_fine``.

    Python's lock is taken for each batch, and one batch runs at a time: it is for trying out an idea. What a method raises
    ends the run. A class that is registered again takes the place of the old one.
    """
    return lambda cls: _register("encoder", ("forward", "backward"), name, cls)


def regularizer(name: str) -> Callable[[C], C]:
    """Registers a class as the regularizer type ``name``, for the key ``prior`` of ``fista``.

    ::

        @conefield.regularizer("gaussian")
        class Gaussian:
            noise_weight = 1.0

            def prox(self, v, tau):               # [x, y, z], float32, to an array like it
                return scipy.ndimage.gaussian_filter(v, 0.5)

    ``prox(v, tau)`` is ``argmin_u ½‖u − v‖² + tau·R(u)``, or a denoiser in its place (plug-and-play); what falls below 0 is
    set to 0 after it. ``value(x)`` is R(x); without it only the data term is watched. ``v`` is attenuation in 1/mm.
    ``tau`` is the weight λ over the step's constant. ``weight`` is λ itself; ``noise_weight`` (1 where neither is given) counts
    in what the scan's noise comes to. Before each call ``self.spacing`` is set to the voxel size in mm.
    """
    return lambda cls: _register("regularizer", ("prox",), name, cls)


@dataclass(frozen=True)
class Check:
    """What the conformance kit says of a stage; ``str`` of it is the whole report."""

    #: Whether every property that applies holds.
    passed: bool
    #: Of each property: its name, "passed", "failed" or "skipped", and how that was seen.
    properties: list[tuple[str, str, str]]
    report: str

    @property
    def failed(self) -> list[str]:
        """Names of the properties that do not hold."""
        return [name for name, outcome, _ in self.properties if outcome == "failed"]

    def __str__(self) -> str:
        return self.report

    def __bool__(self) -> bool:
        return self.passed


def check_stage(kind: str, name: str, **settings: Any) -> Check:
    """Runs the conformance kit over a stage, written in Python or not: what hosts rely on, property by property.

    Of an encoder gradients against finite differences, independence of the batch's size, extremes, channels left out; of a
    regularizer that its proximal map is that of its value, that it is convex, and more. A denoiser without ``value`` is no
    proximal map of anything that the kit knows: "proximal map" fails then, and runs go on as plug-and-play.
    """
    passed, report, properties = _native.check_stage(kind, encoded({**settings, "type": name}))
    return Check(passed, properties, report)


def stage_names(kind: str) -> list[str]:
    """The types of a kind ("encoder", "field", "regularizer", …) that specs may name."""
    return _native.stage_names(kind)
