"""How well cubic splines and Kaiser-Bessel blobs can represent a volume at all.

usage: blobs.py VOLUME.nii.gz ...      (PYTHON has numpy and nibabel)

Fits the middle half of each side by least squares with basis functions two voxels apart (conjugate gradients, 30 steps, periodic) and
prints PSNR in dB. Blobs (Lewitt 1990) have order 2, radius a in spacings, and the taper alpha.
"""
import sys
from math import factorial
import nibabel
import numpy as np

SPACING, STEPS = 2, 30
BLOBS = [(1.5, 5.0), (2.0, 6.0), (2.0, 10.4), (2.5, 10.4), (2.5, 13.0)]


def offsets(radius):
    reach = int(radius * SPACING)
    return np.arange(-reach, reach + 1) / SPACING


def spline():
    r = abs(offsets(2))
    b = np.where(r < 1, 2 / 3 - r**2 + r**3 / 2, np.clip(2 - r, 0, None) ** 3 / 6)
    return b[:, None, None] * b[:, None] * b


def blob(radius, alpha):
    r = offsets(radius) / radius
    z = np.sqrt(np.clip(1 - (r[:, None, None] ** 2 + r[:, None] ** 2 + r**2), 0, None))
    # z² I₂(alpha z), the modified Bessel function by its series
    bessel = sum((alpha * z / 2) ** (2 * k + 2) / (factorial(k) * factorial(k + 2)) for k in range(60))
    return z**2 * bessel / (z**2 * bessel).max()


def best(truth, kernel):
    """PSNR of the least-squares fit."""
    reach = kernel.shape[0] // 2
    padded = np.zeros_like(truth)
    padded[tuple(slice(n) for n in kernel.shape)] = kernel
    spectrum = np.fft.rfftn(np.roll(padded, (-reach,) * 3, (0, 1, 2)))
    every = (slice(None, None, SPACING),) * 3

    def forward(c):
        points = np.zeros_like(truth)
        points[every] = c
        return np.fft.irfftn(np.fft.rfftn(points) * spectrum, s=truth.shape, axes=(0, 1, 2))

    def adjoint(v):
        return np.fft.irfftn(np.fft.rfftn(v) * spectrum.conj(), s=truth.shape, axes=(0, 1, 2))[every]

    residual = adjoint(truth)
    c, direction, norm = np.zeros_like(residual), residual.copy(), (residual**2).sum()
    for _ in range(STEPS):
        image = adjoint(forward(direction))
        step = norm / (direction * image).sum()
        c += step * direction
        residual -= step * image
        before, norm = norm, (residual**2).sum()
        direction = residual + norm / before * direction
    error = np.clip(forward(c), 0, None) - truth
    return 10 * np.log10(truth.max() ** 2 / (error**2).mean())


names = ["cubic spline"] + [f"blob, a = {a}, alpha = {alpha}" for a, alpha in BLOBS]
print("| | " + " | ".join(names) + " |\n|---" + "|---" * len(names) + "|")
for path in sys.argv[1:]:
    whole = nibabel.load(path).get_fdata()
    truth = whole[tuple(slice(n // 4, n - n // 4) for n in whole.shape)]
    kernels = [spline()] + [blob(*shape) for shape in BLOBS]
    print(f"| {path.split('/')[-1].split('.')[0]} | " + " | ".join(f"{best(truth, k):.2f}" for k in kernels) + " |", flush=True)
