"""Calibration of a scan with a wrong detector position."""

import json

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


def test_bad_settings_name_what_is_expected(shifted):
    for settings, words in [
        ({"parameters": ["offset"]}, "parameters.*offset.*some of offset-u"),
        ({"pixels": 4}, "pixels.*16 to 1024"),
    ]:
        with pytest.raises(conefield.InvalidError, match=words):
            conefield.calibrate(shifted[0], **settings)
