"""Times RTK (itk-rtk, CPU) on a conefield scan folder: Joseph forward projection, its matched back-projection and FDK.

usage: rtk.py SCAN [TRUTH.nii.gz]

Prints the median of some runs of each, and PSNR of FDK (ramp) as it is and clipped to [0, 1].
"""
import sys, time, tomllib
import itk
import numpy as np
from itk import RTK as rtk

RUNS = 3
scan = sys.argv[1]
about = tomllib.load(open(f"{scan}/scan.toml", "rb"))
orbit, shape, spacing = about["orbit"], about["volume"]["shape"], about["volume"]["spacing"]
projections = np.load(f"{scan}/projections.npy").astype(np.float32)
rows, columns = about["detector"]["rows"], about["detector"]["columns"]
mm = about.get("unit", {}).get("mm", 1.0)

geometry = rtk.ThreeDCircularProjectionGeometry.New()
for a in orbit["angles"]:
    geometry.AddProjection(orbit["dso"], orbit["dsd"], 90.0 - np.degrees(a))

Image = itk.Image[itk.F, 3]


def image(array, spacing, center=True):
    """An ITK image over `array` [slow, mid, fast], centred on the origin."""
    out = itk.image_from_array(np.ascontiguousarray(array))
    out.SetSpacing(spacing)
    size = array.shape[::-1]
    out.SetOrigin([-(n - 1) / 2 * s if center or k < 2 else 0.0 for k, (n, s) in enumerate(zip(size, spacing))])
    return out


def stack(array):
    """Projections; RTK's u and v run against ours."""
    v, u = orbit["pixel"]
    return image(array[:, ::-1, ::-1], [u, v, 1.0], center=False)


def volume(array):
    """A volume [x, y, z] in RTK's axes (x, z, y): its y is the axis of rotation."""
    return image(np.transpose(array, (1, 2, 0)), [spacing[0], spacing[2], spacing[1]])


def timed(name, run):
    times = []
    for _ in range(RUNS):
        start = time.perf_counter()
        out = run()
        times.append(time.perf_counter() - start)
    times.sort()
    print(f"rtk {name:<20} {times[RUNS // 2]:.3f} s ({times[0]:.3f} to {times[-1]:.3f})", flush=True)
    return out


def forward():
    f = rtk.JosephForwardProjectionImageFilter[Image, Image].New()
    f.SetInput(0, stack(np.zeros_like(projections)))
    f.SetInput(1, filled)
    f.SetGeometry(geometry)
    f.Update()
    return f.GetOutput()


def back(kind):
    f = kind[Image, Image].New()
    f.SetInput(0, volume(np.zeros(shape, np.float32)))
    f.SetInput(1, measured)
    f.SetGeometry(geometry)
    f.Update()
    return f.GetOutput()


def fdk():
    f = rtk.FDKConeBeamReconstructionFilter[Image].New()
    f.SetInput(0, volume(np.zeros(shape, np.float32)))
    f.SetInput(1, measured)
    f.SetGeometry(geometry)
    f.GetRampFilter().SetTruncationCorrection(0.0)
    f.Update()
    return f.GetOutput()


measured = stack(projections)
filled = volume(np.ones(shape, np.float32))
timed("fdk", fdk)
out = itk.array_from_image(fdk())
if len(sys.argv) > 2:
    import nibabel

    truth = np.asarray(nibabel.load(sys.argv[2]).dataobj, np.float32)
    found = np.transpose(out, (2, 0, 1)) * mm
    psnr = lambda v: -10 * np.log10(np.mean((v - truth) ** 2))
    print(f"rtk fdk psnr {psnr(found):.2f} dB, clipped to [0, 1] {psnr(np.clip(found, 0, 1)):.2f} dB")
timed("joseph forward", forward)
timed("voxel-driven back", lambda: back(rtk.BackProjectionImageFilter))
timed("joseph back", lambda: back(rtk.JosephBackProjectionImageFilter))
