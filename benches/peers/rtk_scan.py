"""Makes a scan whose projections are RTK's (Joseph, CPU), so that no figure rests on having one projector twice.

usage: rtk_scan.py NOISY CLEAN OUT

NOISY and CLEAN are conefield scans of one volume with and without noise. OUT is NOISY with RTK's projections of that volume in
place of conefield's, and the same noise. Prints how far both programs are apart, and how large the noise is.
"""
import shutil, sys
import itk
import nibabel
import numpy as np
from rtk_common import Scan

noisy, clean, out = sys.argv[1:]
scan, without = Scan(noisy), Scan(clean)
truth = np.asarray(nibabel.load(f"{noisy}/truth.nii.gz").dataobj, np.float32)
found = itk.array_from_image(scan.forward(scan.volume(truth)))[:, ::-1, ::-1] / scan.mm
noise = scan.projections - without.projections
apart = found - without.projections
rms = lambda a: float(np.sqrt(np.mean(a.astype(np.float64) ** 2)))
print(f"{out}: projections {rms(without.projections):.4f}, apart {rms(apart):.5f}, noise {rms(noise):.5f} (root mean squares)")
shutil.copytree(noisy, out)
np.save(f"{out}/projections.npy", (found + noise).astype(np.float32))
