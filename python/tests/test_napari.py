"""Reads a volume written as OME-Zarr with napari's reader. Skipped if it is not installed (pip install napari-ome-zarr)."""

import numpy as np
import pytest

import conefield

reader = pytest.importorskip("napari_ome_zarr")


def test_napari_reads_values_and_voxel_sizes(tmp_path):
    values = np.random.default_rng(0).random((7, 6, 5), np.float32)
    conefield.Volume(values, spacing=(1.0, 1.5, 2.0), center=(3.0, -2.0, 1.0)).write(tmp_path / "v.zarr")
    read = reader.napari_get_reader(str(tmp_path / "v.zarr"))
    [layer] = [layer for layer in read(str(tmp_path / "v.zarr")) if layer[2] == "image"]
    data, settings = layer[0], layer[1]
    data = data[0] if isinstance(data, list) else data
    np.testing.assert_array_equal(np.asarray(data), values.transpose(2, 1, 0))
    np.testing.assert_allclose(np.ravel(settings["scale"])[-3:], [2.0, 1.5, 1.0])
