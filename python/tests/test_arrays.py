"""Input and output arrays."""

import multiprocessing
import pickle

import numpy as np
import pytest

import conefield


def test_volumes_keep_their_place(tmp_path):
    affine = np.diag([2.0, 3.0, 4.0, 1.0])
    volume = conefield.Volume(np.arange(24.0).reshape(2, 3, 4), (2, 3, 4), affine=affine)
    assert volume.data.dtype == np.float32 and volume.shape == (2, 3, 4)
    volume.write(tmp_path / "v.nii.gz")
    back = conefield.read_volume(tmp_path / "v.nii.gz")
    np.testing.assert_array_equal(back.data, volume.data)
    np.testing.assert_allclose(back.spacing, (2, 3, 4))
    np.testing.assert_allclose(back.affine, affine)
    assert np.asarray(volume) is volume.data
    assert np.asarray(volume, dtype=np.float64).dtype == np.float64
    np.testing.assert_array_equal(np.from_dlpack(volume), volume.data)
    assert conefield.Volume(volume.data, 2).spacing == (2.0, 2.0, 2.0)


def test_hounsfield_units_are_those_of_the_command(command, scan, tmp_path):
    x, y, z = np.meshgrid(*3 * [4.0 * np.arange(24) - 46.0], indexing="ij")
    ball = np.where(x**2 + y**2 + z**2 <= 34.0**2, 0.0206, 0.0)
    source, ours, its, file = [tmp_path / name for name in ("a.mha", "python.mha", "command.mha", "scanner.toml")]
    conefield.Volume(ball, 4.0).write(source)
    file.write_text("water = 0.0206\nair = 0.0\nenergy_kev = 60.0\n")
    volume = conefield.read_volume(source)
    for how in ("water=0.0206,air=0", "water=sphere:0,0,0,20,air=box:30,30,30,50,50,50", "60keV", file, "as-is"):
        hu = volume.hounsfield(how, None)
        hu.write(ours)
        command("convert", source, its, "--hu", how, "--force")
        assert ours.read_bytes() == its.read_bytes(), how
        if how != "as-is":
            np.testing.assert_allclose([hu.data[12, 12, 12], hu.data[0, 0, 0]], [0, -1000], atol=0.6)
    assert volume.hu is None and volume.hounsfield(file, None).hu == "HU: water 0.0206, air 0 per mm at 60 keV"
    # Values of another unit.
    ten = conefield.Volume(10 * ball, 4.0).hounsfield("60keV", ("cm", 10.0))
    np.testing.assert_allclose(ten.data, volume.hounsfield("60keV", None).data, atol=1e-3)
    with pytest.raises(conefield.InvalidError, match="regions"):
        scan.truth.hounsfield("60keV", scan.unit)
    with pytest.raises(conefield.InvalidError, match="how: .*such as 60keV"):
        volume.hounsfield("water", None)
    with pytest.raises(FileNotFoundError):
        volume.hounsfield("none.toml", None)


def test_arrays_of_other_libraries_are_taken():
    class Other:
        """An array of another library that only exports DLPack."""

        def __init__(self, array):
            self.array = array

        def __dlpack__(self, **arguments):
            return self.array.__dlpack__(**arguments)

        def __dlpack_device__(self):
            return self.array.__dlpack_device__()

    data = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    np.testing.assert_array_equal(conefield.Volume(Other(data)).data, data)
    np.testing.assert_array_equal(conefield.Volume(data.tolist()).data, data)
    np.testing.assert_array_equal(conefield.Volume(np.asfortranarray(data)).data, data)

    class Elsewhere(Other):
        def __dlpack__(self, **arguments):
            raise BufferError("it lies on another device")

    with pytest.raises(conefield.InvalidError, match="on the CPU"):
        conefield.Volume(Elsewhere(data))


def test_scans_are_read_only_and_come_back(scan, tmp_path):
    projections = scan.projections
    assert projections.shape == scan.geometry.projections_shape == (16, 24, 28)
    with pytest.raises(ValueError, match="read-only"):
        projections[0, 0, 0] = 1
    kept = scan.projections
    conefield.write_scan(tmp_path / "s", scan)
    back = conefield.read_scan(tmp_path / "s")
    np.testing.assert_array_equal(back.projections, kept)
    np.testing.assert_allclose(back.geometry.vectors, scan.geometry.vectors, atol=1e-9)
    assert back.unit == scan.unit and scan.unit[1] != 1.0
    np.testing.assert_array_equal(back.truth.data, scan.truth.data)
    made = conefield.scan(kept, scan.geometry, unit=scan.unit[0], unit_mm=scan.unit[1])
    assert made.truth is None and len(made) == 16
    assert conefield.scan(kept, scan.geometry, unit="cm", unit_mm=10).unit == ("cm", 10.0)
    assert conefield.scan(kept, scan.geometry, unit="mm").unit == ("mm", 1.0)
    for unit in ({"unit": "cm"}, {"unit_mm": 10}):
        with pytest.raises(conefield.InvalidError, match="unit_mm: .*name and millimetres"):
            conefield.scan(kept, scan.geometry, **unit)
    np.testing.assert_array_equal(made.projections, kept)
    one, two = made.split([1, 5])
    assert (len(one), len(two)) == (14, 2)
    for part in back.split([1, 5]):
        np.testing.assert_array_equal(part.truth.data, scan.truth.data)


def test_an_array_gets_the_warnings_of_its_file(scan, tmp_path, caplog):
    # Counts in place of line integrals, and a volume smaller than the object.
    geometry = scan.geometry.with_volume((9, 9, 9), scan.geometry.spacing, (0.0, 0.0, 0.0))
    for projections, words in [(np.exp(-scan.projections), "looks like intensities"), (scan.projections, "beside the volume")]:
        caplog.clear()
        made = conefield.scan(projections, geometry)
        told = [record.getMessage() for record in caplog.records]
        assert any(words in text and text.startswith("scan: ") for text in told), told
        conefield.write_scan(tmp_path / words, made)
        caplog.clear()
        conefield.read_scan(tmp_path / words)
        read = [record.getMessage().removeprefix(str(tmp_path / words)) for record in caplog.records]
        assert [text.removeprefix("scan") for text in told] == read


def test_a_scan_keeps_its_truth(scan, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    conefield.write_scan("s", scan)
    back = conefield.read_scan("s")
    part = back.split([1, 5])[0]
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    # The path was relative.
    np.testing.assert_array_equal(part.truth.data, scan.truth.data)
    conefield.write_scan(tmp_path / "s", conefield.simulate(2 * scan.truth.data, back.geometry))
    for of in (back, part):
        with pytest.raises(conefield.InvalidError, match="a file that has changed"):
            of.truth
    conefield.write_scan(tmp_path / "s", conefield.scan(scan.projections, scan.geometry))
    bare = conefield.read_scan(tmp_path / "s")
    conefield.write_scan(tmp_path / "s", scan)
    assert bare.truth is None


def test_a_scan_outlives_its_name():
    projections = conefield.simulate("phantom:head:8", views=2, detector=(4, 4)).projections
    junk = [np.ones(100_000) for _ in range(20)]
    assert len(junk) == 20 and np.isfinite(projections).all() and projections.max() > 0


def test_geometries_are_values(geometry):
    again = pickle.loads(pickle.dumps(geometry))
    assert again == geometry and again != geometry.select([0, 1]) and geometry != 3
    assert len(geometry.select([4, 0])) == 2
    np.testing.assert_array_equal(geometry.select([4, 0]).vectors, geometry.vectors[[4, 0]])
    finer = geometry.with_volume((14, 16, 12), (1.5, 1.25, 1.75), (1.0, -2.0, 0.5))
    assert finer.volume_shape == (14, 16, 12) and "14 x 16 x 12" in repr(finer)


def test_views_are_indices_or_a_mask(geometry, scan):
    mask = np.array([True, False, False, True, False])
    for given in (mask, mask.tolist(), [0, 3], np.array([0, 3], np.uint8), range(0, 4, 3)):
        assert geometry.select(given) == geometry.select([0, 3])
    held = np.arange(16) % 8 == 1
    aside = scan.split(held)[1]
    np.testing.assert_array_equal(aside.projections, scan.projections[held])

    class Series:
        """A column of a table, as pandas has it."""

        def __array__(self, dtype=None, copy=None):
            return mask

    assert geometry.select(Series()) == geometry.select([0, 3])


def _sum(geometry):
    return float(conefield.project(np.ones(geometry.volume_shape), geometry).sum())


def test_other_processes_can_work(geometry):
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(_sum, [geometry]) == [_sum(geometry)]


def test_simulation_in_any_geometry(geometry):
    shape = tuple(4 * n for n in geometry.volume_shape)
    truth = np.zeros(shape, np.float32)
    truth[8:20, 8:24, 8:16] = 0.02
    fine = geometry.with_volume(shape, tuple(s / 4 for s in geometry.spacing), geometry.center)
    scan = conefield.simulate(truth, fine)
    assert scan.truth.shape == shape and scan.geometry == fine
    predicted = conefield.project(truth, fine, projector="siddon")
    # Voxels with sharp edges, compared with their interpolation.
    assert (predicted - scan.projections).std() < 0.05 * scan.projections.max()
    # An array of other voxels fills the volume; a volume keeps its own.
    coarse = np.random.default_rng(0).random((5, 4, 3), dtype=np.float32)
    sides = [n * s / m for n, s, m in zip(shape, fine.spacing, coarse.shape)]
    sized = conefield.simulate(conefield.Volume(coarse, sides, fine.center), fine).projections
    np.testing.assert_array_equal(conefield.simulate(coarse, fine).projections, sized)
    assert (conefield.simulate(conefield.Volume(coarse), fine).projections != sized).any()
    noisy = conefield.simulate(truth, fine, noise="poisson:1e5", seed=1).projections
    assert 0 < np.abs(noisy - scan.projections).max() < 0.1


def test_arrays_beyond_memory_are_refused():
    shape = (1 << 16, 1 << 16, 1 << 10)
    geometry = conefield.circular(dso=9, dsd=12, angles=2, detector=4, pixel=1, volume=shape, spacing=1e-5)
    wide = conefield.circular(dso=9, dsd=12, angles=2, detector=1 << 20, pixel=1, volume=4)
    # It takes no memory until it is copied.
    large = np.broadcast_to(np.float32(0), shape)
    for make in [
        lambda: conefield.backproject(np.ones((2, 4, 4)), geometry),
        lambda: conefield.project(np.ones((4, 4, 4), np.float32), wide),
        lambda: conefield.project(large, geometry),
        lambda: conefield.scan(large, geometry),
        lambda: conefield.evaluate(conefield.Volume(large), np.ones((2, 2, 2))),
    ]:
        with pytest.raises(conefield.UnsupportedError, match="memory: needs"):
            make()


def _two_views():
    return conefield.circular(dso=9, dsd=12, angles=2, detector=4, pixel=1, volume=4)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: conefield.Volume(np.ones((2, 2))), "3 axes"),
        (lambda: conefield.Volume(np.ones((2, 2, 2), complex)), "real numbers"),
        (lambda: conefield.Volume(np.ones((2, 2, 2)), (1, 2)), "three for x, y and z"),
        (lambda: conefield.Volume(np.ones((2, 2, 2)), affine=np.eye(3)), r"\(4, 4\)"),
        (lambda: conefield.circular(dso=-1, dsd=2, angles=3, detector=4, pixel=1, volume=4), "dso"),
        (lambda: conefield.circular(dso=9, dsd=2, angles=3, detector=0, pixel=1, volume=4), "above 0"),
        (lambda: conefield.circular(dso=1, dsd=2, angles=3, detector=4, pixel=1, volume=4), "outside the volume"),
        (lambda: conefield.circular(dso=12, dsd=9, angles=3, detector=4, pixel=1, volume=4), "dsd: .*the axis"),
        (lambda: conefield.circular(dso=9, dsd=12, angles=3, detector=4, pixel=(1, 0), volume=4), "pixel.u: .*positive"),
        (lambda: conefield.circular(angles=3, detector=4, pixel=-1, volume=4), "pixel.v: found -1, expected a positive"),
        (lambda: conefield.circular(dso=9, dsd=12, angles=[0, np.nan], detector=4, pixel=1, volume=4), "finite"),
        (lambda: conefield.circular(dso=9, dsd=12, angles=0, detector=4, pixel=1, volume=4), "at least one view"),
        (lambda: conefield.from_vectors(np.ones((3, 9)), detector=4, volume=4), "12"),
        (lambda: _two_views().select([True]), r"views: found a mask of shape \(1,\), expected \(2,\)"),
        (lambda: _two_views().select([1.9]), "whole numbers"),
        (lambda: _two_views().select([2]), "index below 2"),
        (lambda: conefield.read_scan("no/such/folder"), "no/such/folder"),
        (lambda: conefield.read_volume("phantom:hand"), "hand"),
        (lambda: conefield.simulate("phantom:head:8", noise="salt"), "poisson"),
        (lambda: conefield.simulate("phantom:head:8", views=0), "views"),
        (lambda: conefield.simulate("phantom:head:8", views=3, angles="a.txt"), "views: found both, expected views or angles FILE"),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(conefield.Error, match=words):
        make()


def test_the_system_says_what_it_always_says():
    with pytest.raises(FileNotFoundError):
        conefield.read_scan("no/such/folder")
    with pytest.raises(ValueError) as raised:
        conefield.Volume(np.ones(3))
    assert raised.value.field == "data" and raised.value.expected == "3 axes"
