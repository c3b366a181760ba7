"""What one reconstruction adds to another: the best mean of the two, found with the reference.

usage: mix.py NAME=A.nii.gz=B.nii.gz=TRUTH.nii.gz ...

Prints a row of a table for each volume: PSNR of A and of B, the correlation of their errors, and the best share of B in a weighted
mean with its PSNR. At a share of 0 no weighted mean of the two is better than A.
"""
import sys
import nibabel
import numpy as np


def load(path):
    return np.asarray(nibabel.load(path).dataobj, np.float32)


def psnr(error, peak):
    return 10 * np.log10(peak**2 / np.mean(np.square(error, dtype=np.float64)))


print("| | A | B | correlation | best share of B | best mean |\n|---|---|---|---|---|---|")
for row in sys.argv[1:]:
    name, a, b, truth = row.split("=")
    truth = load(truth)
    peak = 1.0 if truth.min() >= 0 and truth.max() <= 1 else np.ptp(truth)
    a, b = load(a) - truth, load(b) - truth
    dot = lambda x, y: np.sum(x.astype(np.float64) * y)
    correlation = dot(a, b) / np.sqrt(dot(a, a) * dot(b, b))
    difference = b - a
    size = dot(difference, difference)
    share = float(np.clip(-dot(a, difference) / size, 0, 1)) if size > 0 else 0.0
    best = psnr(a + np.float32(share) * difference, peak)
    print(f"| {name} | {psnr(a, peak):.2f} dB | {psnr(b, peak):.2f} dB | {correlation:.2f} | {share:.2f} | {best:.2f} dB |")
