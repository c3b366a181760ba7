"""The package and the command give bit-identical results."""

import json

import numpy as np
import pytest

import conefield


@pytest.fixture(scope="module")
def folder(scan, tmp_path_factory):
    path = tmp_path_factory.mktemp("scan") / "scan"
    conefield.write_scan(path, scan)
    return path


@pytest.mark.parametrize(
    "spec, steps, overrides",
    [
        ("fdk", None, {}),
        ("sart", 2, {}),
        ("fista-tv", 3, {"prior__inner": 2}),
        ("fast", 20, {"field__width": 16, "encoder__log2_table_size": 10}),
        ("field-tv", 10, {"methods__0__field__width": 16}),
    ],
)
def test_volumes_are_the_same_bits(command, folder, scan, tmp_path, spec, steps, overrides):
    sets = [f"--set={key.replace('__', '.')}={value}" for key, value in overrides.items()]
    ends = [] if steps is None else [f"--steps={steps}"]
    run = tmp_path / "run"
    command("reconstruct", folder, "--spec", spec, "-o", run, "--reference", "truth", "--seed=5", *sets, *ends)
    theirs = conefield.read_volume(run / "volume.nii.gz")
    record = json.loads((run / "record.json").read_text())
    for given in (scan, folder):
        ours = conefield.reconstruct(given, spec, steps=steps, seed=5, reference="truth", **overrides)
        assert ours.volume.data.std() > 0
        np.testing.assert_array_equal(ours.volume.data, theirs.data)
        assert ours.scores["psnr"] == pytest.approx(record["scores"]["psnr"], abs=1e-9)
        assert ours.record["steps"] == record["steps"]
        assert ours.record["reference"] == "truth"
        assert ours.record["scan"] == record["scan"] or given is scan and ours.record["scan"]["path"] == "memory"
        assert ours.record["spec_toml"] == (run / "spec.toml").read_text()
    np.testing.assert_allclose(ours.volume.spacing, theirs.spacing, rtol=1e-6)


def test_explain_prints_the_same(command, folder):
    assert conefield.explain("fast", folder, sets={"encoder.levels": 4}).strip() == command(
        "explain", "fast", "--scan", folder, "--set=encoder.levels=4"
    ).strip()


def test_project_predicts_the_same_views(command, folder, scan, tmp_path):
    truth = folder / "truth.nii.gz"
    command("project", truth, "--like", folder, "-o", tmp_path / "p", "--residual", tmp_path / "r")
    # The file's voxel sizes are single precision; the scan's voxels are used if the shapes match.
    volume = conefield.read_volume(truth)
    for name, residual in [("p", False), ("r", True)]:
        theirs = conefield.read_scan(tmp_path / name).projections
        np.testing.assert_array_equal(conefield.project(volume, scan, residual=residual), theirs)


def test_an_array_of_other_voxels_fills_the_volume_as_a_file_without_sizes_does(command, folder, scan, tmp_path):
    shape = conefield.read_volume(folder / "truth.nii.gz").shape
    coarse = np.random.default_rng(0).random([n // 2 for n in shape], dtype=np.float32)
    np.save(tmp_path / "coarse.npy", coarse)
    command("project", tmp_path / "coarse.npy", "--like", folder, "-o", tmp_path / "p")
    theirs = conefield.read_scan(tmp_path / "p").projections
    for volume in (coarse, tmp_path / "coarse.npy"):
        np.testing.assert_array_equal(conefield.project(volume, scan), theirs)
    # One with sizes keeps them.
    conefield.Volume(coarse, 0.5).write(tmp_path / "coarse.nii")
    command("project", tmp_path / "coarse.nii", "--like", folder, "-o", tmp_path / "q")
    theirs = conefield.read_scan(tmp_path / "q").projections
    np.testing.assert_array_equal(conefield.project(tmp_path / "coarse.nii", scan), theirs)


def test_a_seed_of_numpy_is_a_seed(folder):
    truth = conefield.read_volume(folder / "truth.nii.gz")
    ours = [conefield.simulate(truth, views=4, noise="tigre:1e4,10", seed=seed).projections for seed in (3, np.int64(3))]
    np.testing.assert_array_equal(*ours)


def test_scores_are_the_same(command, folder, tmp_path):
    truth = conefield.read_volume(folder / "truth.nii.gz")
    other = conefield.Volume(truth.data + 0.01 * np.sin(np.arange(truth.data.size)).reshape(truth.shape), truth.spacing)
    other.write(tmp_path / "other.nii.gz")
    theirs = json.loads(command("evaluate", tmp_path / "other.nii.gz", folder / "truth.nii.gz", "--json"))
    ours = conefield.evaluate(other, truth)
    assert {k: ours[k] for k in ("psnr", "ssim_2d", "ssim_3d", "ssim_skimage", "peak")} == {
        k: theirs[k] for k in ("psnr", "ssim_2d", "ssim_3d", "ssim_skimage", "peak")
    }


def test_errors_have_the_words_of_the_command(command, folder, tmp_path):
    for spec, setting in [("no-such-spec", None), ("fast", "encoder.level=3"), ("fista-tv", "prior.inner=0")]:
        sets = dict([setting.split("=")]) if setting else {}
        sets = {k: int(v) for k, v in sets.items()}
        arguments = [] if setting is None else [f"--set={setting}"]
        said = command("reconstruct", folder, "--spec", spec, "-o", tmp_path / "run", *arguments, code=1)
        with pytest.raises(conefield.Error) as raised:
            conefield.reconstruct(folder, spec, sets=sets)
        assert said.strip() == f"error: {raised.value}"
