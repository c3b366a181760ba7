"""Writes golden.json: metrics of small volumes that tests/golden.rs rebuilds from the same formulas.

Needs numpy, scipy and scikit-image. scikit-image scores `ssim_skimage`; the other two SSIMs are written out with
full (not separable) windows through scipy's general convolution, so that they share no code or shortcut with the crate.

    python evaluation/tests/golden.py > evaluation/tests/golden.json
"""

import json
import math

import numpy as np
from scipy.ndimage import convolve
from skimage.metrics import structural_similarity


def noise(count, seed):
    """Values in [-0.5, 0.5) of a 64-bit linear congruential generator, upper 24 bits."""
    state, out = seed, np.empty(count)
    for i in range(count):
        state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
        out[i] = (state >> 40) / 2**24 - 0.5
    return out


def pair(shape, seed, noise_level, shift, empty, peak):
    """Reference and result: two ellipsoids on a wave, the result displaced and noisy; `empty` planes of zeros in
    front of x in the reference."""
    axes = [(np.arange(n) + 0.5) / n * 2 - 1 for n in shape]
    x, y, z = np.meshgrid(*axes, indexing="ij")

    def body(x, y, z):
        v = 0.25 + 0.1 * np.sin(5 * x + 1) * np.sin(4 * y) * np.sin(3 * z + 0.5)
        v = v + 0.4 * ((x / 0.8) ** 2 + (y / 0.7) ** 2 + (z / 0.9) ** 2 < 1)
        return v + 0.2 * (((x - 0.2) / 0.3) ** 2 + ((y + 0.1) / 0.25) ** 2 + (z / 0.4) ** 2 < 1)

    reference = body(x, y, z)
    reference[:empty] = 0
    result = body(x + shift, y, z - shift) + noise_level * noise(x.size, seed).reshape(shape)
    return (result * peak).astype(np.float32), (reference * peak).astype(np.float32)


def ssim_map(x, y, window, mode, covariance, peak):
    mean = lambda v: convolve(v, window, mode=mode, cval=0.0)
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    mx, my = mean(x), mean(y)
    vx = covariance * (mean(x * x) - mx * mx)
    vy = covariance * (mean(y * y) - my * my)
    cov = covariance * (mean(x * y) - mx * my)
    return (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))


def gaussian(dimensions):
    g = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    g /= g.sum()
    w = g
    for _ in range(dimensions - 1):
        w = np.multiply.outer(w, g)
    return w


def slices(v, axis):
    return [np.take(v, i, axis) for i in range(v.shape[axis])]


def scores(result, reference, peak):
    a, b = result.astype(np.float64), reference.astype(np.float64)
    mse = np.mean((a - b) ** 2)
    over_axes = lambda f: float(np.mean([np.mean(f(k)) for k in range(3)]))
    out = {"rmse": math.sqrt(mse), "psnr": 10 * math.log10(peak**2 / mse)}
    out["ssim_2d"] = over_axes(
        lambda k: [
            ssim_map(x, y, gaussian(2), "constant", 1.0, peak).mean()
            for x, y in zip(slices(a, k), slices(b, k))
            if y.max() > 0
        ]
    )
    inner = tuple(slice(5, -5) for _ in range(3))
    out["ssim_3d"] = float(ssim_map(a, b, gaussian(3), "constant", 1.0, peak)[inner].mean())
    out["ssim_skimage"] = over_axes(
        lambda k: [structural_similarity(x, y, data_range=peak) for x, y in zip(slices(a, k), slices(b, k))]
    )
    out["worst_slices"] = []
    for k, axis in enumerate("xyz"):
        mses = [np.mean((x - y) ** 2) for x, y in zip(slices(a, k), slices(b, k))]
        i = int(np.argmax(mses))
        out["worst_slices"].append({"axis": axis, "index": i, "psnr": 10 * math.log10(peak**2 / mses[i])})
    return out


CASES = [
    dict(shape=[24, 20, 18], seed=1, noise_level=0.1, shift=0.05, empty=0, peak=1.0),
    dict(shape=[24, 20, 18], seed=2, noise_level=0.4, shift=0.0, empty=3, peak=1.0),
    dict(shape=[11, 13, 29], seed=3, noise_level=0.02, shift=0.1, empty=1, peak=2.5),
    dict(shape=[83, 77, 21], seed=4, noise_level=0.2, shift=0.02, empty=0, peak=1.0),
]

if __name__ == "__main__":
    print(json.dumps([{**c, "scores": scores(*pair(**c), c["peak"])} for c in CASES], indent=1))
