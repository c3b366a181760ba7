"""What one reconstruction adds to another: the best mean of the two, found with the reference.

usage: mix.py NAME=A.nii.gz=B.nii.gz=TRUTH.nii.gz ...

Prints two tables. The first has a row for each volume: PSNR of A and of B, the correlation of their errors, and the best share of B
in a weighted mean with its PSNR. At a share of 0 no weighted mean of the two is better than A. The last column has a share for each
part of the volume. The second table has these parts: air (values below 5 % of the largest), edges (the tenth of all other voxels with
the largest gradient) and the rest of the object. A part's PSNR is that of its own voxels, with the peak of the whole volume.
"""
import sys
import nibabel
import numpy as np


def load(path):
    return np.asarray(nibabel.load(path).dataobj, np.float32)


def dot(x, y):
    return np.sum(x.astype(np.float64) * y)


def psnr(error, peak):
    return 10 * np.log10(peak**2 / (dot(error, error) / error.size))


def best_share(a, b):
    """The share of the errors `b` for which a weighted mean with `a` has the least mean square."""
    difference = b - a
    size = dot(difference, difference)
    return float(np.clip(-dot(a, difference) / size, 0, 1)) if size > 0 else 0.0


def mean(a, b, share):
    return a + np.float32(share) * (b - a)


def parts(truth):
    steepness = np.sqrt(sum(np.square(g) for g in np.gradient(truth)))
    air = truth < 0.05 * truth.max()
    edges = ~air & (steepness >= np.quantile(steepness[~air], 0.9))
    return {"air": air, "inside": ~air & ~edges, "edges": edges}


print("| | A | B | correlation | best share of B | best mean | a share for each part |\n|---|---|---|---|---|---|---|")
second = ["| | voxels | error of A | A | B | best share of B |\n|---|---|---|---|---|---|"]
for row in sys.argv[1:]:
    name, a, b, truth = row.split("=")
    truth = load(truth)
    peak = 1.0 if truth.min() >= 0 and truth.max() <= 1 else np.ptp(truth)
    a, b = load(a) - truth, load(b) - truth
    correlation = dot(a, b) / np.sqrt(dot(a, a) * dot(b, b))
    share = best_share(a, b)
    by_part = np.empty_like(a)
    for part, voxels in parts(truth).items():
        own = a[voxels], b[voxels]
        own_share = best_share(*own)
        by_part[voxels] = mean(*own, own_share)
        second.append(
            f"| {name}, {part} | {100 * voxels.mean():.0f} % | {100 * dot(own[0], own[0]) / dot(a, a):.0f} % "
            f"| {psnr(own[0], peak):.2f} dB | {psnr(own[1], peak):.2f} dB | {own_share:.2f} |"
        )
    print(
        f"| {name} | {psnr(a, peak):.2f} dB | {psnr(b, peak):.2f} dB | {correlation:.2f} | {share:.2f} "
        f"| {psnr(mean(a, b, share), peak):.2f} dB | {psnr(by_part, peak):.2f} dB |"
    )
print("\n" + "\n".join(second))
