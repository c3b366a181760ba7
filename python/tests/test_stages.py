"""Stages written in Python."""

import traceback

import numpy as np
import pytest

import conefield

# The kit also tests infinities, which must stay in their rows.
pytestmark = pytest.mark.filterwarnings("ignore:invalid value")


@conefield.encoder("test-waves")
class Waves:
    """Sines of every coordinate, with a trained gain."""

    def __init__(self, bands=3, fault=""):
        if bands < 1:
            raise ValueError("bands below 1")
        self.rates = np.pi * 2.0 ** np.arange(bands)
        self.params = {"gain": np.linspace(0.8, 1.2, 3 * bands, dtype=np.float32).reshape(3, bands)}
        self.fault = fault

    def forward(self, x):
        rates = self.rates.astype(x.dtype)
        y = self.params["gain"] * np.sin(x[:, :, None] * rates)
        return y.reshape(len(x), -1)

    def backward(self, x, dy):
        rates, gain = self.rates.astype(x.dtype), self.params["gain"]
        dy = dy.reshape(len(x), 3, -1)
        phase = x[:, :, None] * rates
        dx = (dy * gain * rates * np.cos(phase)).sum(2)
        if self.fault == "wrong":
            dx = 1.1 * dx
        if self.fault == "raises" and len(x) > 100:
            raise RuntimeError("no more of this")
        return dx, {"gain": (dy * np.sin(phase)).sum(0)}


@conefield.regularizer("test-ridge")
class Ridge:
    """Half the sum of squares."""

    def __init__(self, weight=1e-3, fault=""):
        self.weight = weight
        self.fault = fault

    def value(self, x):
        return 0.5 * float((x.astype(np.float64) ** 2).sum())

    def prox(self, v, tau):
        assert len(self.spacing) == 3
        if self.fault == "raises":
            raise RuntimeError("no more of this")
        if self.fault == "shape":
            return v[1:]
        if self.fault == "nan":
            return np.where(v > v.mean(), np.float32(np.nan), v)
        return v / (1 + tau * (2 if self.fault == "wrong" else 1))


FIELD = {"encoder": {"type": "test-waves", "bands": 4}, "field": {"width": 16}}


def test_an_encoder_passes_the_kit():
    check = conefield.check_stage("encoder", "test-waves", bands=2)
    assert check, str(check)
    found = {name: outcome for name, outcome, _ in check.properties}
    assert found["finite differences: parameters"] == found["finite differences: inputs"] == "passed"
    assert found["keep outputs"] == "passed"


def test_the_kit_finds_a_wrong_gradient():
    check = conefield.check_stage("encoder", "test-waves", fault="wrong")
    assert not check and "finite differences: inputs" in check.failed


def test_a_field_trains_with_it(scan):
    spec = {"extends": "fast", "name": "waves", **FIELD}
    before = conefield.reconstruct(scan, spec, steps=3)
    result = conefield.reconstruct(scan, spec, steps=60)
    # The loss is a mean over all steps.
    assert result.record["loss"] < 0.8 * before.record["loss"]
    assert "test-waves" in result.record["spec_toml"]
    assert "test-waves" in str(conefield.plan(spec))
    again = conefield.reconstruct(scan, spec, steps=60)
    np.testing.assert_array_equal(again.volume.data, result.volume.data)


def test_what_it_raises_comes_out(scan):
    spec = {"extends": "fast", "encoder": {"type": "test-waves", "fault": "raises"}, "field": {"width": 16}}
    with pytest.raises(RuntimeError, match="no more of this") as raised:
        conefield.reconstruct(scan, spec, steps=1000)
    assert any("test_stages" in str(entry.path) for entry in raised.traceback)
    for settings, words in [({"bands": 0}, "bands below 1"), ({"band": 2}, "band"), ({"bands": []}, "test-waves")]:
        with pytest.raises(conefield.InvalidError, match=words) as raised:
            conefield.plan({"extends": "fast", "encoder": {"type": "test-waves", **settings}})
        cause = raised.value.__cause__
        assert type(cause) in (ValueError, TypeError) and str(cause) in str(raised.value)
        # The class itself refuses bands.
        assert "bands" not in settings or traceback.extract_tb(cause.__traceback__)[-1].name == "__init__"
    # No state of the failure remains.
    assert conefield.reconstruct(scan, "fdk").volume.data.std() > 0


def test_a_regularizer_passes_the_kit_and_a_wrong_one_does_not():
    check = conefield.check_stage("regularizer", "test-ridge")
    assert check, str(check)
    assert "proximal map" in conefield.check_stage("regularizer", "test-ridge", fault="wrong").failed


@pytest.mark.parametrize(
    "kind, name, settings",
    [
        ("encoder", "frequency", {"bands": 2}),
        ("normalizer", "level-attention", {}),
        ("field", "mlp", {"width": 8}),
        ("projector", "ray-march", {"samples": 9}),
        ("initializer", "random", {}),
        ("loss", "huber", {"delta": 0.5}),
        ("prior", "total-variation", {}),
        ("voxel-projector", "siddon", {}),
        ("basis", "voxels", {}),
        ("data-term", "least-squares", {}),
        ("regularizer", "total-variation", {"weight": {"fixed": 0.1}}),
    ],
)
def test_stages_of_every_kind_are_checked(kind, name, settings):
    check = conefield.check_stage(kind, name, **settings)
    assert check and check.properties, str(check)


def test_what_cannot_be_checked_is_refused():
    for kind, name, settings, words in [
        ("hat", "mlp", {}, "kind: found hat, expected .*regularizer"),
        ("encoder", "test-wave", {}, "type: found no encoder type .*test-waves"),
        ("field", "mlp", {"widht": 3}, "settings of mlp: widht: .*width"),
        ("method", "sart", {}, "no checks of a method"),
    ]:
        with pytest.raises(conefield.Error, match=words):
            conefield.check_stage(kind, name, **settings)


def test_a_regularizer_regularizes(scan):
    def of(**prior):
        spec = {"type": "fista", "prior": {"type": "test-ridge", **prior}, "stop": {"passes": 4}}
        return conefield.reconstruct(scan, spec).volume.data

    none = conefield.reconstruct(scan, {"type": "fista", "stop": {"passes": 4}}).volume.data
    np.testing.assert_allclose(of(weight=0), none, atol=1e-6 * none.max())
    strong = of(weight=1e3)
    assert 0 < np.linalg.norm(strong) < 0.9 * np.linalg.norm(none)
    assert (strong >= 0).all()
    with pytest.raises(RuntimeError, match="no more of this"):
        of(fault="raises")
    with pytest.raises(conefield.InvalidError, match="prox: found an array of shape"):
        of(fault="shape")
    with pytest.raises(conefield.InvalidError, match="test-ridge: prox: found NaN, expected finite numbers"):
        of(fault="nan")


def test_a_denoiser_is_a_prior(scan):
    ndimage = pytest.importorskip("scipy.ndimage")

    @conefield.regularizer("test-gaussian")
    class Gaussian:
        """A Gaussian filter."""

        def prox(self, v, tau):
            return v + 0.1 * (ndimage.gaussian_filter(v, 0.6) - v)

    plain, prior = [{"type": "fista", "prior": p, "stop": {"passes": 12}} for p in ("none", "test-gaussian")]
    noisy = conefield.simulate("phantom:head:24", views=20, detector=(36, 36), noise="poisson:200", seed=1)
    without, result = [conefield.reconstruct(noisy, spec, reference="truth") for spec in (plain, prior)]
    assert result.scores["psnr"] > without.scores["psnr"] + 3, (result, without)
    # The denoiser sees voxels outside the support as empty.
    carved = conefield.reconstruct(noisy, {**prior, "scene": {"support": "carve"}})
    assert np.isfinite(carved.volume.data).all() and carved.volume.data.max() < 2
    assert "a denoiser written in Python" in str(conefield.plan(prior))


def test_a_class_that_is_registered_again_takes_its_place():
    def register(width):
        @conefield.encoder("test-again")
        class Again:
            """Constants."""

            def forward(self, x):
                return np.ones((len(x), width), x.dtype)

            def backward(self, x, dy):
                return np.zeros_like(x), {}

    for width in (3, 5):
        register(width)
        stages = conefield.plan({"extends": "fast", "encoder": "test-again"}).facts["stages"]
        assert stages[0]["output"] == width


def test_what_is_no_stage_is_refused():
    for kind, cls, words in [
        (conefield.encoder, type("NoBackward", (), {"forward": lambda self, x: x}), "without backward"),
        (conefield.regularizer, type("NoProx", (), {}), "without prox"),
        (conefield.encoder, 3, "a class"),
    ]:
        with pytest.raises(conefield.InvalidError, match=words):
            kind("test-none")(cls)
    for decorator in (conefield.encoder, conefield.regularizer):
        with pytest.raises(conefield.InvalidError, match=r'name: found <class .*Waves.>, expected .*as in @conefield.*\("name"\)'):
            decorator(Waves)
    with pytest.raises(conefield.InvalidError, match="conefield itself"):
        conefield.encoder("hash-grid")(Waves)

    @conefield.encoder("test-flat")
    class Flat(Waves):
        """Returns an array without the channel axis."""

        def forward(self, x):
            return x[:, 0]

    with pytest.raises(conefield.InvalidError, match="channels"):
        conefield.plan({"extends": "fast", "encoder": "test-flat"})
    assert {"hash-grid", "test-waves"} <= set(conefield.stage_names("encoder"))
