"""Runs: specs, callbacks, interruption, budgets."""

import math
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

import conefield

SMALL = {"encoder__log2_table_size": 9, "encoder__levels": 4, "field__width": 16}


def test_specs_are_names_files_and_dicts(scan, tmp_path):
    assert {"fast", "fista-tv", "cgls"} <= set(conefield.spec_names())
    (tmp_path / "mine.toml").write_text('extends = "fista-tv"\nname = "mine"\nstop.passes = 1\n')
    table = {"extends": "fista-tv", "name": "mine", "stop": {"passes": np.int64(1)}}
    volumes = [
        conefield.reconstruct(scan, spec, **overrides).volume.data
        for spec, overrides in [
            (tmp_path / "mine.toml", {}),
            (table, {}),
            ("fista-tv", {"stop__passes": 1}),
            ("fista-tv", {"sets": {"stop.passes": 1}}),
        ]
    ]
    for other in volumes[1:]:
        np.testing.assert_array_equal(other, volumes[0])
    again = conefield.spec_text(table)
    assert 'name = "mine"' in again and conefield.spec_text(tmp_path / "mine.toml") == again
    assert "neural-field" in str(conefield.schema())


def test_errors_name_the_wrong_setting(scan):
    for spec, overrides, words in [
        ("fast", {"encoder__level": 3}, "encoder.level.*levels"),
        ({"type": "fista", "prior": {"type": "total-variatio"}}, {}, 'spec:.*prior.type.*total-variation'),
        ({"type": "sart", "stop": {"passes": "many"}}, {}, "stop.passes"),
        ("fast", {"encoder__levels": None}, "not None"),
        ("fast", {"sets": {"encoder.levels": 3}, "encoder__levels": 4}, "twice"),
        (3, {}, "a name, a file or a dict"),
        ("fast", {"encoder__levels": object()}, "^spec: value: found a object, expected numbers, texts, lists and dicts$"),
        (None, {}, "a budget"),
        ("fast", {"training__learning_rate": np.float32("nan")}, "training.learning_rate: found nan, expected a finite"),
        ({"type": "sart", "relax": [{"a": math.inf}]}, {}, "relax.0.a: found inf, expected a finite number"),
    ]:
        with pytest.raises(conefield.InvalidError, match=words):
            conefield.reconstruct(scan, spec, **overrides)
    for arguments, words in [
        ({"budget": 5, "steps": 3}, "budget"),
        ({"budget": "soon"}, "600s"),
        ({"steps": 0}, "at least 1"),
        ({"hold_out": "x"}, "every:10"),
        ({"hold_out": [99]}, "index below 16"),
        ({"hold_out": [1.9]}, "hold_out: .*whole numbers"),
        ({"hold_out": [True, False]}, r"hold_out: .*expected \(16,\)"),
        ({"backend": "abacus"}, "cpu"),
        ({"peak": -1}, "above 0"),
        ({"peak": math.inf}, "peak: found inf, expected a finite number"),
        ({"reference": np.ones((3, 3, 3))}, "the shape of the scan's volume"),
        ({"init": np.ones((24, 24, 24))}, "a method that starts from a volume"),
        ({"seed": -1}, "u64"),
    ]:
        with pytest.raises(conefield.InvalidError, match=words):
            conefield.reconstruct(scan, "fdk", **arguments)
    with pytest.raises(conefield.InvalidError, match="a Scan, or the file"):
        conefield.reconstruct(np.ones((2, 2, 2)), "fdk")
    with pytest.raises(conefield.InvalidError, match="without a truth"):
        conefield.reconstruct(conefield.scan(scan.projections, scan.geometry), "fdk", reference="truth")


def test_a_result_describes_itself(scan):
    result = conefield.reconstruct(scan, "fista-tv", reference=scan.truth, hold_out="every:5", stop__passes=2)
    assert result.record["held_out_views"] == [2, 7, 12] and result.record["held_out"] > 0
    # The whole scan, and its parts.
    assert result.record["memory"]["scan"] == 2 * scan.projections.nbytes
    assert result.scores["psnr"] > 15 and result.scores["ssim_3d"] is not None
    assert [r["step"] for r in result.record["records"]] == [1, 2]
    assert result.field is None and np.asarray(result) is result.volume.data
    assert "dB" in repr(result)
    mask = np.isin(np.arange(16), [2, 7, 12])
    assert conefield.reconstruct(scan, "fdk", hold_out=mask).record["held_out_views"] == [2, 7, 12]
    # The truth scored against itself.
    same = conefield.evaluate(scan.truth, scan.truth)
    assert same["psnr"] == math.inf and same["rmse"] == 0
    labels = np.zeros((4, 4, 4))
    labels[1:3] = 7
    assert conefield.evaluate(labels, labels, labels=True)["dice"]["mean"] == 1


def test_truth_is_the_scans_own_volume(scan, tmp_path, monkeypatch):
    (tmp_path / "truth").mkdir()
    monkeypatch.chdir(tmp_path)
    found, want = [conefield.reconstruct(scan, "fdk", reference=r) for r in ("truth", scan.truth)]
    assert found.scores == want.scores


def test_a_run_starts_from_a_volume_or_its_file(scan, tmp_path):
    first = conefield.reconstruct(scan, "fdk").volume
    first.write(tmp_path / "first.nii.gz")
    of = lambda init: conefield.reconstruct(scan, "sart", steps=1, init=init).volume.data
    started = of(first)
    np.testing.assert_array_equal(of(first.data), started)
    np.testing.assert_array_equal(of(tmp_path / "first.nii.gz"), started)
    assert np.abs(started - of(None)).max() > 0


def test_fields_are_evaluated_kept_and_pre_trained(scan, tmp_path):
    record = conefield.pretrain(
        ["phantom:abdomen:12", conefield.read_volume("phantom:head:12")], tmp_path / "w.safetensors", "fast", steps=5, **SMALL
    )
    assert record["steps"] == 5 and not any(t.startswith("encoder") for t in record["tensors"])
    result = conefield.reconstruct(scan, "fast", steps=5, init=tmp_path / "w.safetensors", **SMALL)
    np.testing.assert_array_equal(result.field.volume().data, result.volume.data)
    fine = result.field.volume(voxels=30)
    assert fine.shape == (30, 30, 30) and fine.spacing[0] == pytest.approx(result.volume.spacing[0] * 24 / 30)
    result.field.write(tmp_path / "f.safetensors")
    again = conefield.read_field(tmp_path / "f.safetensors")
    np.testing.assert_array_equal(again.volume().data, result.volume.data)
    with pytest.raises(conefield.InvalidError, match="safetensors"):
        conefield.pretrain(["phantom:head:12"], tmp_path / "w.txt", "fast")
    with pytest.raises(conefield.Error, match="pre-train"):
        conefield.pretrain(["phantom:head:12"], tmp_path / "x.safetensors", "fdk")


def test_plans(scan):
    plan = conefield.plan("fast", scan, **SMALL)
    assert plan.parameters > 1000 and plan.memory["total"] > plan.memory["scan"] > 0
    assert "hash-grid" in str(plan) and plan.schedule is None and conefield.plan("fast").memory is None
    timed = conefield.plan("sart", scan, budget="20s")
    assert timed.schedule["steps"] >= 1
    with pytest.raises(conefield.InvalidError, match="a scan"):
        conefield.plan("sart", budget=20)


def test_a_budget_chooses_and_holds(scan):
    begin = time.monotonic()
    result = conefield.reconstruct(scan, budget=6)
    assert time.monotonic() - begin < 12
    assert result.record["plan"]["why"] and result.volume.data.std() > 0


def test_a_callback_sees_the_run(scan):
    seen = []
    result = conefield.reconstruct(scan, "fast", steps=30, callback=seen.append, every=0, slices=True, **SMALL)
    assert seen[-1].share == 1.0 and seen[-1].step == 30
    steps = [p.step for p in seen]
    assert steps == sorted(steps) and len(steps) > 5
    records = [r for p in seen for r in p.records]
    assert records == result.record["records"]
    x, y, z = next(p.slices for p in reversed(seen) if p.slices is not None)
    assert x.shape == y.shape == z.shape == (24, 24) and np.isfinite(x).all() and x.std() > 0
    # Callbacks and progress do not change the result.
    quiet = conefield.reconstruct(scan, "fast", steps=30, progress=True, **SMALL)
    np.testing.assert_array_equal(quiet.volume.data, result.volume.data)


def test_what_a_callback_raises_ends_the_run(scan):
    class Enough(Exception):
        pass

    def stop(progress):
        raise Enough(progress.step)

    begin = time.monotonic()
    with pytest.raises(Enough):
        conefield.reconstruct(scan, "fast", seconds="60s", callback=stop, every=0, **SMALL)
    assert time.monotonic() - begin < 20
    assert conefield.reconstruct(scan, "fdk").volume.data.std() > 0


def test_other_threads_go_on_meanwhile(scan):
    counted = [0]
    over = threading.Event()

    def count():
        while not over.wait(0.005):
            counted[0] += 1

    thread = threading.Thread(target=count)
    thread.start()
    conefield.reconstruct(scan, "fast", seconds=1, **SMALL)
    over.set()
    thread.join()
    assert counted[0] > 20


def test_runs_in_several_threads_do_not_mix(scan):
    want = [conefield.reconstruct(scan, spec).volume.data for spec in ("fdk", "sart")]
    got = [None, None]

    def work(i, spec):
        got[i] = conefield.reconstruct(scan, spec).volume.data

    threads = [threading.Thread(target=work, args=pair) for pair in enumerate(("fdk", "sart"))]
    [t.start() for t in threads]
    [t.join() for t in threads]
    for a, b in zip(want, got):
        np.testing.assert_array_equal(a, b)


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_ctrl_c_ends_a_run_cleanly():
    program = textwrap.dedent(
        """
        import conefield, signal, time
        # The tests may run in the background of a shell, which ignores this signal.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        scan = conefield.simulate("phantom:head:24", views=16, detector=(24, 24))
        try:
            conefield.reconstruct(scan, "fast", seconds="5m", callback=lambda p: print("step", p.step, flush=True), every=0.1)
        except KeyboardInterrupt:
            print("interrupted", flush=True)
        # The process still works.
        print("volume", conefield.reconstruct(scan, "fdk").volume.data.std() > 0, flush=True)
        """
    )
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout.readline().startswith("step")
    begin = time.monotonic()
    child.send_signal(signal.SIGINT)
    out, err = child.communicate(timeout=60)
    assert child.returncode == 0, err
    assert out.splitlines()[-2:] == ["interrupted", "volume True"], out + err
    assert time.monotonic() - begin < 20


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(
    "work",
    [
        "conefield.simulate(np.ones((256, 256, 256)), views=1000, detector=(400, 400))",
        "conefield.calibrate(scan, pixels=128)",
        "conefield.calibrate(scan, pixels=128, jitter=True, parameters=['tilt'])",
        "conefield.check_stage('field', 'mlp', width=512)",
        "conefield.check_stage('encoder', 'slow')",
        "conefield.evaluate(np.ones((512, 512, 400)), np.ones((512, 512, 400)))",
        "conefield.study('study.toml', 'study')",
    ],
    ids=lambda work: work[10:24],
)
def test_ctrl_c_ends_all_work_soon(work, tmp_path):
    program = """
        import conefield, numpy as np, signal, time
        signal.signal(signal.SIGINT, signal.default_int_handler)
        near = np.exp(-np.linspace(-3, 3, 128) ** 2).astype(np.float32)
        geometry = conefield.circular(dso=500, dsd=800, angles=60, detector=128, pixel=1, volume=64)
        scan = conefield.scan(np.broadcast_to(np.outer(near, near), (60, 128, 128)), geometry)

        @conefield.encoder("slow")
        class Slow:
            def forward(self, x):
                time.sleep(0.1)
                return x.copy()

            def backward(self, x, dy):
                return dy.copy(), {}

        print("begin", flush=True)
        try:
            WORK
        except KeyboardInterrupt:
            # The process still works.
            views = conefield.simulate("phantom:head:8", views=2, detector=(8, 8))
            print("interrupted", views.projections.max() > 0, flush=True)
        """
    (tmp_path / "study.toml").write_text(
        """
        name = "long"
        volumes = ["phantom:head:16"]
        views = [8]
        simulate = { detector = "16x16" }
        specs = [{ spec = "sirt", set = ["stop.passes=10000000"] }]
        """
    )
    program = textwrap.dedent(program).replace("WORK", work)
    child = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    assert child.stdout.readline() == "begin\n", child.stderr.read()
    time.sleep(2)
    begin = time.monotonic()
    child.send_signal(signal.SIGINT)
    out, err = child.communicate(timeout=60)
    assert (child.returncode, out) == (0, "interrupted True\n"), out + err
    assert time.monotonic() - begin < 15


def test_the_log_is_pythons(scan, caplog):
    with caplog.at_level("INFO", logger="conefield"):
        conefield.reconstruct(scan, "fista-tv", steps=1)
    assert any("memory:" in r.message for r in caplog.records)
