"""Fixtures shared by the tests."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import conefield

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def scan():
    """A small noisy scan of a known volume, in a unit other than the millimetre."""
    return conefield.simulate(
        "phantom:head:24", views=16, detector=(24, 28), offset=(0, 2), noise="tigre:1e4,10", seed=3
    )


@pytest.fixture(scope="session")
def geometry():
    """A few views of a small volume with unequal sides; some detectors are tilted."""
    parts = [
        conefield.circular(
            dso=120, dsd=190, angles=np.array(angles), detector=(9, 11), pixel=(2.1, 1.7), volume=(7, 8, 6),
            spacing=(3.0, 2.5, 3.5), center=(1.0, -2.0, 0.5), offset=(1.0, 4.0), tilt=tilt,
        )
        for angles, tilt in [([0.1, 1.3, 2.9], (0, 0, 0)), ([4.0, 5.2], (0.05, -0.04, 0.1))]
    ]
    vectors = np.concatenate([p.vectors for p in parts])
    return conefield.from_vectors(
        vectors, detector=(9, 11), volume=(7, 8, 6), spacing=(3.0, 2.5, 3.5), center=(1.0, -2.0, 0.5)
    )


@pytest.fixture(scope="session")
def command():
    """The command, built beside the package; its tests are skipped if it is missing."""
    named = os.environ.get("CONEFIELD_COMMAND")
    known = [named] if named else [str(ROOT / "target" / "release" / "conefield")]
    program = next((p for p in known if shutil.which(p)), None)
    if program is None:
        pytest.skip("the command conefield is not built: cargo build --release --bin conefield")

    def run(*arguments, code=0):
        done = subprocess.run([program, "--quiet", *map(str, arguments)], capture_output=True, text=True)
        assert done.returncode == code, done.stderr
        return done.stdout if code == 0 else done.stderr

    return run
