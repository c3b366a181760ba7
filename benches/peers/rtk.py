"""Times RTK (itk-rtk, CPU) on a conefield scan folder: Joseph forward projection, its matched back-projection and FDK.

usage: rtk.py SCAN [TRUTH.nii.gz]

Prints the median of some runs of each, and PSNR of FDK (ramp) as it is and clipped to [0, 1].
"""
import sys, time
import itk
import numpy as np
from itk import RTK as rtk
from rtk_common import Image, Scan

RUNS = 3
scan = Scan(sys.argv[1])


def timed(name, run):
    times = []
    for _ in range(RUNS):
        start = time.perf_counter()
        out = run()
        times.append(time.perf_counter() - start)
    times.sort()
    print(f"rtk {name:<20} {times[RUNS // 2]:.3f} s ({times[0]:.3f} to {times[-1]:.3f})", flush=True)
    return out


def back(kind):
    f = kind[Image, Image].New()
    f.SetInput(0, scan.volume(np.zeros(scan.shape, np.float32)))
    f.SetInput(1, measured)
    f.SetGeometry(scan.geometry)
    f.Update()
    return f.GetOutput()


def fdk():
    f = rtk.FDKConeBeamReconstructionFilter[Image].New()
    f.SetInput(0, scan.volume(np.zeros(scan.shape, np.float32)))
    f.SetInput(1, measured)
    f.SetGeometry(scan.geometry)
    f.GetRampFilter().SetTruncationCorrection(0.0)
    f.Update()
    return f.GetOutput()


measured = scan.stack(scan.projections)
filled = scan.volume(np.ones(scan.shape, np.float32))
timed("fdk", fdk)
out = itk.array_from_image(fdk())
if len(sys.argv) > 2:
    import nibabel

    truth = np.asarray(nibabel.load(sys.argv[2]).dataobj, np.float32)
    found = np.transpose(out, (2, 0, 1)) * scan.mm
    psnr = lambda v: -10 * np.log10(np.mean((v - truth) ** 2))
    print(f"rtk fdk psnr {psnr(found):.2f} dB, clipped to [0, 1] {psnr(np.clip(found, 0, 1)):.2f} dB")
timed("joseph forward", lambda: scan.forward(filled))
timed("voxel-driven back", lambda: back(rtk.BackProjectionImageFilter))
timed("joseph back", lambda: back(rtk.JosephBackProjectionImageFilter))
