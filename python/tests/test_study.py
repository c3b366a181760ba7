"""The installed command, and studies, which it runs."""

import json
import subprocess
import sys

import pytest

import conefield

STUDY = """
name = "small"
volumes = ["phantom:head:24"]
seeds = [0, 1]
views = [12]
[simulate]
detector = "24x24"
noise = "tigre:1e4,10"
[[specs]]
spec = "fdk"
[[specs]]
spec = "sirt"
set = ["stop.passes=3"]
"""


def run(*words):
    return subprocess.run([sys.executable, "-m", "conefield", *map(str, words)], capture_output=True, text=True)


def test_the_package_brings_the_command():
    assert run("--version").stdout.split() == ["conefield", conefield.__version__]
    wrong = run("info", "nothing-there")
    assert wrong.returncode == 1 and "nothing-there" in wrong.stderr
    assert run("reconstruct").returncode == 2


def test_a_study_is_carried_out_and_continued(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    table = conefield.study(tmp_path / "study.toml", tmp_path / "out")
    assert table == json.loads((tmp_path / "out" / "table.json").read_text())
    with pytest.raises(conefield.Error, match="earlier study, .*resume=True to continue or force=True to replace it"):
        conefield.study(tmp_path / "study.toml", tmp_path / "out")
    runs = sorted((tmp_path / "out").rglob("record.json"))
    written = [r.stat().st_mtime_ns for r in runs]
    assert len(runs) == 4
    assert conefield.study(tmp_path / "study.toml", tmp_path / "out", resume=True) == table
    assert [r.stat().st_mtime_ns for r in runs] == written


def test_the_script_for_slurm_starts_the_package(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    done = run("study", tmp_path / "study.toml", "-o", tmp_path / "out", "--slurm", tmp_path / "job.sh")
    assert done.returncode == 0, done.stderr
    assert f"exec {sys.executable} -m conefield " in (tmp_path / "job.sh").read_text()
