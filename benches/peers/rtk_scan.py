"""Makes scans whose projections are RTK's (Joseph, CPU), so that no figure rests on having one projector twice.

usage: rtk_scan.py CLEAN NOISY=OUT ...

CLEAN and each NOISY are conefield scans of one volume without and with noise. OUT is NOISY with RTK's projections of that volume in
place of conefield's, and the same noise. Prints how far both programs are apart, and how large the noise is.
"""
import shutil, sys
import itk
import nibabel
import numpy as np
from rtk_common import Scan

clean, *pairs = sys.argv[1:]
scan = Scan(clean)
truth = np.asarray(nibabel.load(f"{clean}/truth.nii.gz").dataobj, np.float32)
found = itk.array_from_image(scan.forward(scan.volume(truth)))[:, ::-1, ::-1] / scan.mm
rms = lambda a: float(np.sqrt(np.mean(a.astype(np.float64) ** 2)))
apart = rms(found - scan.projections)
for pair in pairs:
    noisy, out = pair.split("=")
    noise = np.load(f"{noisy}/projections.npy") - scan.projections
    print(f"{out}: projections {rms(scan.projections):.4f}, apart {apart:.5f}, noise {rms(noise):.5f} (root mean squares)")
    shutil.copytree(noisy, out)
    np.save(f"{out}/projections.npy", (found + noise).astype(np.float32))
