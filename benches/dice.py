"""Segments reconstructions of a CT with expert labels and scores the labels: a stand-in for a trained segmenter.

    python benches/dice.py CONEFIELD CT LABELS FIRST STUDY_FOLDER

CT (in HU) and LABELS cover the planes along z from FIRST on of the reconstructed volume, whose values are (HU + 1000)/3000. A voxel gets
the label with the largest p(HU | label)·p(label | place): a normal distribution with the label's mean and deviation in CT,
and the label map blurred by 2 voxels. All methods meet the same segmenter. It has seen the answer, so "the CT itself" is the most
that a method can reach, and only differences count. `conefield evaluate --labels` computes Dice over the labels with 100 voxels or more.
Prints a table: mean ± standard deviation over the seeds of the study.
"""

import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
from scipy.ndimage import gaussian_filter

BLUR = 2.0  # voxels
LEAST = 100  # voxels of a label
NARROWEST = 10.0  # HU


def main(conefield, ct, labels, first, study):
    temporary = tempfile.TemporaryDirectory()
    work = pathlib.Path(temporary.name)

    def read(path):
        to = work / "read.npy"
        subprocess.run([conefield, "-q", "convert", path, to, "--force"], check=True, stdout=subprocess.DEVNULL)
        return np.load(to)

    ct, labels = read(ct), np.rint(read(labels)).astype(int)
    kept = [label for label in np.unique(labels) if (labels == label).sum() >= LEAST]
    labels[~np.isin(labels, kept)] = 0
    likely = {}
    for label in kept:
        inside = labels == label
        share = gaussian_filter(inside.astype(np.float64), BLUR)
        values = ct[inside]
        likely[label] = (values.mean(), max(values.std(), NARROWEST), np.log(np.maximum(share, 1e-300)))

    def segmented(hu):
        best, found = np.full(hu.shape, -np.inf), np.zeros(hu.shape, np.float32)
        for label, (mean, deviation, share) in likely.items():
            score = share - 0.5 * ((hu - mean) / deviation) ** 2 - np.log(deviation)
            found[score > best] = label
            best = np.maximum(score, best)
        return found

    expected = work / "expected.npy"
    np.save(expected, labels.astype(np.float32))

    def dice(hu):
        found = work / "found.npy"
        np.save(found, segmented(hu))
        said = subprocess.run([conefield, "-q", "evaluate", "--labels", found, expected, "--json"], check=True, capture_output=True)
        return json.loads(said.stdout)["dice"]["mean"]

    rows = {"the CT itself": [dice(ct)], "an empty volume": [dice(np.full(ct.shape, -1000.0))]}
    for record in sorted(pathlib.Path(study).glob("runs/*/*/record.json")):
        volume = read(record.parent / "volume.nii.gz")[:, :, first : first + ct.shape[2]]
        rows.setdefault(record.parent.name, []).append(dice(volume * 3000.0 - 1000.0))
    print(f"| method | Dice, mean of {len(kept) - 1} labels | runs |\n| --- | --- | --- |")
    for name, found in rows.items():
        print(f"| {name} | {np.mean(found):.4f} ± {np.std(found, ddof=min(1, len(found) - 1)):.4f} | {len(found)} |")


if __name__ == "__main__":
    program, ct, labels, first, study = sys.argv[1:]
    main(program, ct, labels, int(first), study)
