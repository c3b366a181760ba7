"""What limits a result: which voxels and which frequencies its error is made of.

usage: limits.py PICTURE NAME=RUN/volume.nii.gz=TRUTH.nii.gz ...

PICTURE gets a row for each volume: the slice across the axis where the error is largest, its error, and the share of the truth's
power that is wrong at each frequency. Prints a row of a table for each volume:

- near edges: the share of the squared error in the tenth of the voxels where the truth is steepest;
- steps: the same in voxels that are on a step of more than half of the truth's range;
- flat faces: the same in the five worst slices across the axis;
- fine: the share above 0.25 cycles a voxel (half of what the grid can hold), and the truth's own share there;
- half wrong: the frequency from which on half of the truth's power is missed.
"""
import sys
import matplotlib
import nibabel
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BINS = 64
FINE = 0.25


def load(path):
    return np.asarray(nibabel.load(path).dataobj, np.float64)


def radial(power, frequency):
    """Sums of power in shells of frequency."""
    index = np.minimum((frequency / 0.5 * BINS).astype(int), BINS)
    return np.bincount(index.ravel(), power.ravel(), BINS + 1)[:BINS]


def shells(error, truth):
    axes = [np.fft.fftfreq(n) for n in error.shape]
    axes[2] = np.fft.rfftfreq(error.shape[2])
    frequency = np.sqrt(sum(a**2 for a in np.meshgrid(*axes, indexing="ij")))
    # Half of a real transform stands for both halves, but for the planes at 0 and at the end.
    twice = np.full(frequency.shape[2], 2.0)
    twice[[0, -1]] = 1.0
    return [radial(np.abs(np.fft.rfftn(v)) ** 2 * twice, frequency) for v in (error, truth)]


picture, *rows = sys.argv[1:]
figure, panels = plt.subplots(len(rows), 3, figsize=(10, 3.1 * len(rows)), squeeze=False)
print("| | squared error in the steepest tenth | on steps of more than half the range (share of voxels) | in the five worst slices across the axis | above 0.25 cycles a voxel "
      "(truth) | half of the truth is missed from |\n|---|---|---|---|---|---|")
for row, (left, middle, right) in zip(rows, panels):
    name, volume, truth = row.split("=")
    volume, truth = load(volume), load(truth)
    error = volume - truth
    squared = error**2 / np.sum(error**2)
    slope = np.sqrt(sum(g**2 for g in np.gradient(truth)))
    steep = slope >= np.quantile(slope, 0.9)
    steps = slope > 0.25 * np.ptp(truth)  # central differences have half of a step
    slices = np.sort(squared.sum(axis=(0, 1)))
    wrong, whole = shells(error, truth)
    middles = (np.arange(BINS) + 0.5) / BINS * 0.5
    fine = middles > FINE
    missed = middles[np.argmax(wrong > 0.5 * whole)] if np.any(wrong > 0.5 * whole) else 0.5
    print(f"| {name} | {squared[steep].sum():.2f} | {squared[steps].sum():.2f} ({steps.mean():.3f}) | {slices[-5:].sum():.2f} | "
          f"{wrong[fine].sum() / wrong.sum():.2f} ({whole[fine].sum() / whole[1:].sum():.3f}) | {missed:.2f} |")
    z = int(np.argmax(squared.sum(axis=(0, 1))))
    low, high = np.quantile(truth, [0.001, 0.999])
    most = np.quantile(np.abs(error), 0.999)
    left.imshow(truth[:, :, z].T, cmap="gray", vmin=low, vmax=high)
    left.set_title(f"{name}, slice {z}", fontsize=9)
    middle.imshow(error[:, :, z].T, cmap="RdBu_r", vmin=-most, vmax=most)
    middle.set_title(f"error, ±{most:.2f}", fontsize=9)
    for panel in (left, middle):
        panel.axis("off")
    right.semilogy(middles, wrong / whole)
    right.axhline(1, color="gray", linewidth=0.5)
    right.set_ylim(1e-5, 3)
    right.set_title("error's share of the truth's power", fontsize=9)
    right.set_xlabel("cycles a voxel", fontsize=8)
    right.tick_params(labelsize=8)
figure.tight_layout()
figure.savefig(picture, dpi=80)
