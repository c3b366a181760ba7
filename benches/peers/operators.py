"""The Python package's projection and its adjoint beside RTK's (itk-rtk, CPU), on the same arrays.

usage: operators.py SCAN

SCAN is a conefield scan folder with truth.nii.gz. Needs the packages conefield, itk-rtk, numpy and nibabel. Prints how far results are
apart (root mean square, relative to the result's), medians of seconds of RUNS runs in turn, and how exactly <Ax, y> = <x, A'y>.
"""
import sys, time
import conefield
import itk
import nibabel
import numpy as np
from itk import RTK as rtk
from rtk_common import Image, Scan

RUNS = 5
theirs = Scan(sys.argv[1])
geometry = conefield.read_scan(sys.argv[1]).geometry
operator = conefield.Operator(geometry)
x = np.asarray(nibabel.load(f"{sys.argv[1]}/truth.nii.gz").dataobj, np.float32)
y = theirs.projections


def rtk_back(projections):
    f = rtk.JosephBackProjectionImageFilter[Image, Image].New()
    f.SetInput(0, theirs.volume(np.zeros(theirs.shape, np.float32)))
    f.SetInput(1, theirs.stack(projections))
    f.SetGeometry(theirs.geometry)
    f.Update()
    return np.transpose(itk.array_from_image(f.GetOutput()), (2, 0, 1))


ways = {
    "project": (lambda: operator @ x, lambda: itk.array_from_image(theirs.forward(theirs.volume(x)))[:, ::-1, ::-1]),
    "backproject": (lambda: operator.T @ y, lambda: rtk_back(y)),
}
product = lambda a, b: float(np.sum(a.astype(np.float64) * b.astype(np.float64)))
for name, both in ways.items():
    results, seconds = [None, None], [[], []]
    for _ in range(RUNS):
        for k, run in enumerate(both):
            start = time.perf_counter()
            results[k] = run()
            seconds[k].append(time.perf_counter() - start)
    ours, other = (r.astype(np.float64) for r in results)
    apart = np.sqrt(np.mean((ours - other) ** 2) / np.mean(other**2))
    told = [f"{np.median(s):.2f} s ({min(s):.2f} to {max(s):.2f})" for s in seconds]
    print(f"{name}: apart {apart:.5f}; conefield {told[0]}, RTK {told[1]}")
for name, forward, back in [
    ("conefield, float32", operator @ x, operator.T @ y),
    ("RTK, float32", ways["project"][1](), rtk_back(y)),
]:
    left, right = product(forward, y), product(x, back)
    print(f"{name}: <Ax, y> and <x, A'y> differ by {abs(left - right) / abs(left):.1e}")
double = conefield.Operator(geometry, dtype=np.float64)
left, right = product(double @ x, y), product(x, double.T @ y)
print(f"conefield, float64: <Ax, y> and <x, A'y> differ by {abs(left - right) / abs(left):.1e}")
