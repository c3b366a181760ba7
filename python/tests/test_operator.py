"""Line integrals of voxels, and their adjoint."""

import numpy as np
import pytest

import conefield


@pytest.mark.parametrize("projector", ["joseph", "siddon", "trilinear", {"type": "trilinear", "samples_per_voxel": 3.0}])
@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_the_adjoint_is_exact(geometry, projector, dtype, tolerance):
    rng = np.random.default_rng(0)
    x = rng.standard_normal(geometry.volume_shape).astype(dtype)
    y = rng.standard_normal(geometry.projections_shape).astype(dtype)
    ax = conefield.project(x, geometry, projector=projector)
    aty = conefield.backproject(y, geometry, projector=projector)
    assert ax.dtype == aty.dtype == dtype and np.abs(ax).max() > 1
    forward, back = np.vdot(ax.astype(float), y), np.vdot(x, aty.astype(float))
    scale = np.linalg.norm(ax.astype(float)) * np.linalg.norm(y)
    assert abs(forward - back) < tolerance * scale


def test_a_box_has_the_lengths_of_its_rays():
    geometry = conefield.circular(
        dso=100, dsd=150, angles=[0.0], detector=(1, 1), pixel=1.0, volume=(8, 8, 8), spacing=2.0
    )
    for projector in ("joseph", "siddon", "trilinear"):
        found = conefield.project(np.ones((8, 8, 8)), geometry, projector=projector)
        assert found.item() == pytest.approx(16.0, rel=1e-9), projector


def test_the_matrix_is_both_functions(geometry):
    a = conefield.Operator(geometry, dtype=np.float64)
    x = np.random.default_rng(1).standard_normal(geometry.volume_shape)
    y = np.random.default_rng(2).standard_normal(geometry.projections_shape)
    assert a.shape == (5 * 9 * 11, 7 * 8 * 6) and a.T.shape == a.shape[::-1] and a.T.T is a
    np.testing.assert_array_equal(a @ x, conefield.project(x, geometry))
    np.testing.assert_array_equal(a.T @ y, conefield.backproject(y, geometry))
    np.testing.assert_array_equal(a.matvec(x.ravel()), (a @ x).ravel())
    np.testing.assert_array_equal(a.rmatvec(y.ravel()), (a.T @ y).ravel())
    assert (a @ x.reshape(-1, 1)).shape == (a.shape[0], 1)
    assert (conefield.Operator(geometry) @ x).dtype == np.float32
    with pytest.raises(conefield.InvalidError, match="shape"):
        a @ x[1:]
    with pytest.raises(conefield.InvalidError, match="float32 or float64"):
        conefield.Operator(geometry, dtype=np.int32)
    with pytest.raises(conefield.InvalidError, match="operand: .*real numbers"):
        a @ (x + 1j)
    with pytest.raises(conefield.InvalidError, match="real numbers"):
        conefield.project(x + 1j, geometry)
    for swapped in (conefield.project(x.astype(">f8"), geometry), a @ x.astype(">f8")):
        np.testing.assert_array_equal(swapped, a @ x)
    with pytest.raises(conefield.InvalidError, match="joseph, siddon, trilinear"):
        conefield.Operator(geometry, projector="magic") @ x


def test_scipy_solves_with_it():
    linalg = pytest.importorskip("scipy.sparse.linalg")
    geometry = conefield.circular(
        dso=60, dsd=90, angles=24, detector=(12, 12), pixel=1.5, volume=(6, 6, 6), spacing=2.0
    )
    a = conefield.Operator(geometry, dtype=np.float64)
    truth = np.random.default_rng(3).random(geometry.volume_shape)
    for operator in (a, a.as_linear_operator(), linalg.aslinearoperator(a)):
        found = linalg.lsqr(operator, (a @ truth).ravel(), atol=1e-12, btol=1e-12, iter_lim=800)[0]
        assert np.abs(found.reshape(truth.shape) - truth).max() < 1e-5
    m, n = a.shape
    np.testing.assert_allclose(
        linalg.aslinearoperator(a).rmatmat(np.eye(m)[:, :3]).T, [(a.T @ row) for row in np.eye(m)[:3]]
    )


def test_tilts_and_offsets_are_as_documented():
    flat = dict(dso=100.0, dsd=150.0, angles=[0.3], detector=(4, 6), pixel=(2.0, 1.0), volume=(4, 4, 4))
    plain = conefield.circular(**flat)
    s, c = np.sin(0.3), np.cos(0.3)
    source, detector, u, v = plain.vectors.reshape(4, 3)
    np.testing.assert_allclose(source, [100 * c, 100 * s, 0])
    np.testing.assert_allclose(detector, [-50 * c, -50 * s, 0])
    np.testing.assert_allclose(u, [-s, c, 0])
    np.testing.assert_allclose(v, [0, 0, -2])
    shifted = conefield.circular(**flat, offset=(3, 5)).vectors.reshape(4, 3)
    np.testing.assert_allclose(shifted[1] - detector, 5 * u + 3 * v / 2)
    skewed = conefield.circular(**flat, tilt=(0, 0, np.pi / 2)).vectors.reshape(4, 3)
    np.testing.assert_allclose(skewed[2], v / 2, atol=1e-12)
    np.testing.assert_allclose(skewed[3], -2 * u, atol=1e-12)
    assert plain.orbit()[:2] == pytest.approx((100.0, 150.0))
    assert conefield.circular(**flat, tilt=(0.1, 0, 0)).orbit() is None


def test_torch_differentiates_through_it(geometry):
    torch = pytest.importorskip("torch")
    from conefield.torch import project

    a = conefield.Operator(geometry, dtype=np.float64)
    x = torch.rand(geometry.volume_shape, dtype=torch.float64, requires_grad=True)
    y = torch.rand(geometry.projections_shape, dtype=torch.float64)
    (0.5 * (project(x, a) - y).square().sum()).backward()
    np.testing.assert_allclose(x.grad.numpy(), a.T @ (a @ x.detach().numpy() - y.numpy()), rtol=1e-10)


def test_torch_checks_the_gradients_of_both(geometry):
    torch = pytest.importorskip("torch")
    from conefield.torch import project

    for projector in ("joseph", "siddon", "trilinear"):
        a = conefield.Operator(geometry, projector=projector, dtype=np.float64)
        for operator in (a, a.T):
            x = torch.rand(operator.input_shape, dtype=torch.float64, requires_grad=True)
            apply = lambda x: project(x, operator)
            assert torch.autograd.gradcheck(apply, x, fast_mode=True)
            assert torch.autograd.gradgradcheck(apply, x, fast_mode=True)


def test_torch_trains_an_unrolled_network_through_it():
    torch = pytest.importorskip("torch")
    from conefield.torch import project

    torch.manual_seed(0)
    scan = conefield.simulate("phantom:head:16", views=8, detector=(16, 16), noise="tigre:1e4,10")
    a = conefield.Operator(scan.geometry)
    measured, truth = torch.tensor(scan.projections), torch.tensor(scan.truth.data)
    # Steps in units of 1/|A|^2.
    v = np.ones(a.input_shape, np.float32)
    for _ in range(5):
        v = a.T @ (a @ v)
        size = np.linalg.norm(v)
        v /= size

    class Unrolled(torch.nn.Module):
        """Gradient steps with trained lengths, each followed by a small convolutional correction."""

        def __init__(self, steps=5):
            super().__init__()
            self.lengths = torch.nn.Parameter(torch.ones(steps))
            self.prior = torch.nn.Sequential(
                torch.nn.Conv3d(1, 4, 3, padding=1), torch.nn.Tanh(), torch.nn.Conv3d(4, 1, 3, padding=1)
            )

        def forward(self, y):
            x = torch.zeros(a.input_shape)
            for length in self.lengths:
                x = x + length / size * project(y - project(x, a), a.T)
                x = x + self.prior(x[None, None])[0, 0]
            return x

    network = Unrolled()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    losses = []
    for _ in range(50):
        loss = (network(measured) - truth).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert all(p.grad.abs().max() > 0 for p in network.parameters())
    # Better than an empty volume.
    assert losses[-1] < 0.5 * losses[0] and losses[-1] < 0.5 * truth.square().mean().item(), losses


def test_a_parallel_beam_sums_along_its_direction():
    volume = np.zeros((8, 6, 4), np.float32)
    volume[3, 2, 1] = 2.0
    common = dict(angles=[0.0, np.pi / 2], detector=(4, 8), pixel=1, volume=(8, 6, 4))
    geometry = conefield.circular(**common)
    images = conefield.project(volume, geometry)
    # Along x: columns are y, from -3.5 on; along y: columns are -x. Rows run towards -z.
    assert images[0].argmax() == np.ravel_multi_index((2, 3), (4, 8))
    assert images[1].argmax() == np.ravel_multi_index((2, 4), (4, 8))
    assert np.allclose([images[0].max(), images[1].max()], 2.0, atol=1e-3)
    assert np.allclose(images.sum(axis=(1, 2)), 2.0, atol=1e-3)
    with pytest.raises(conefield.InvalidError, match="dsd"):
        conefield.circular(dso=9, **common)
