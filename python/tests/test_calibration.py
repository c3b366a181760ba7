"""Calibration of a scan with a wrong detector position."""

import json
import subprocess
import sys
import textwrap

import numpy as np
import pytest

import conefield


@pytest.fixture(scope="module")
def shifted():
    """A scan whose detector is shifted by three columns, and the distance in mm."""
    exact = conefield.simulate("phantom:head:32", views=24, detector=(48, 48), noise="tigre:1e5,10")
    dso, dsd, pixel, _, angles = exact.geometry.orbit()
    shift = 3 * pixel[1]
    moved = conefield.simulate("phantom:head:32", views=24, detector=(48, 48), noise="tigre:1e5,10", offset=(0, shift))
    return conefield.scan(moved.projections, exact.geometry), shift


def test_a_shift_is_found_and_corrected(shifted):
    scan, shift = shifted
    shares = []
    found = conefield.calibrate(scan, pixels=32, callback=lambda p: shares.append(p.share), every=0.0)
    offset, rotation = found.parameters
    assert (offset["parameter"], offset["verdict"], offset["unit"]) == ("offset-u", "corrected", "mm")
    assert abs(offset["change"] - shift) < max(4 * offset["uncertainty"], 0.1 * shift)
    assert rotation["verdict"] == "kept" and abs(rotation["change"]) < 1.0
    assert found.held_out["after"] < 0.5 * found.held_out["before"]
    assert "offset-u: " in str(found) and "corrected" in str(found)
    corrected = found.scan.geometry.orbit()[3][1]
    np.testing.assert_allclose(corrected, offset["change"], rtol=1e-6)
    assert scan.geometry.orbit()[3][1] == 0.0
    assert found.scan.provenance["calibrated"]["corrected"]["offset-u"]["change"] == offset["change"]
    assert shares == sorted(shares) and shares[-1] == 1.0


def test_the_result_is_that_of_the_command(shifted, command, tmp_path):
    conefield.write_scan(tmp_path / "scan", shifted[0])
    printed = json.loads(command("calibrate", tmp_path / "scan", "--pixels", 32, "--json"))
    found = conefield.calibrate(tmp_path / "scan", pixels=32)
    assert found.direction == printed["direction"] and found.held_out == printed["held_out"]
    for ours, theirs in zip(found.parameters, printed["parameters"], strict=True):
        assert {**ours, "curve": None} == {**theirs, "curve": None}


def test_steady_views_are_not_shifted(shifted):
    found = conefield.calibrate(shifted[0], pixels=32, jitter=True)
    assert found.jitter["verdict"] == "kept" and len(found.jitter["shifts"]) == len(shifted[0])
    assert "shifts of single views" in str(found)


@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space")
def test_what_does_not_fit_into_memory_is_refused():
    program = """
        import conefield, numpy as np, resource
        geometry = conefield.circular(dso=500, dsd=800, angles=1000, detector=128, pixel=1, volume=8)
        scan = conefield.scan(np.ones((1000, 128, 128), np.float32), geometry)
        volume = conefield.Volume(np.broadcast_to(np.float32(1), (400, 400, 500)))
        # Threads take addresses, too.
        conefield.simulate("phantom:head:8", views=2, detector=(8, 8))
        used = 1024 * next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmSize"))
        # Seven eighths of it count: more than one volume and less than two.
        resource.setrlimit(resource.RLIMIT_AS, (used + (480 << 20),) * 2)
        for work in (lambda: conefield.calibrate(scan, pixels=128, jitter=True), lambda: volume.hounsfield("as-is", None)):
            try:
                work()
            except conefield.UnsupportedError as error:
                print(error)
        """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.count("memory: needs") == 2, done.stdout + done.stderr


def test_bad_settings_name_what_is_expected(shifted):
    for settings, words in [
        ({"parameters": ["offset"]}, "parameters.*offset.*some of offset-u"),
        ({"pixels": 4}, "pixels.*16 to 1024"),
    ]:
        with pytest.raises(conefield.InvalidError, match=words):
            conefield.calibrate(shifted[0], **settings)
