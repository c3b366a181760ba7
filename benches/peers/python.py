"""The Python package's projector, its adjoint and FDK beside RTK's (itk-rtk, CPU) on the same arrays: how far apart, and how fast.

    python benches/peers/python.py [--size 128] [--views 50] [--detector 256] [--runs 5]

Prints the largest and the root mean square difference over the largest and the root mean square value of RTK's, all and at
least 3 pixels or voxels from the border, and the median of the times with range. Calls take turns, so that a change of the machine's
speed shows in both. The package has no voxel-driven back-projection by itself: FDK is where both use one. Needs conefield, itk-rtk and numpy.
"""

import argparse
import tempfile
import time

import conefield
import itk
import numpy as np
from itk import RTK as rtk
from rtk_common import Image, Scan

BORDER = 3


def in_turn(runs, *calls):
    """The last result and the sorted times of each call."""
    times, results = [[] for _ in calls], [None] * len(calls)
    for _ in range(runs):
        for k, call in enumerate(calls):
            start = time.perf_counter()
            results[k] = call()
            times[k].append(time.perf_counter() - start)
    return results, [sorted(t) for t in times]


def apart(ours, theirs):
    rms = lambda a: np.sqrt(np.mean(np.square(a, dtype=np.float64)))
    error = ours.astype(np.float64) - theirs
    return f"largest {np.abs(error).max() / np.abs(theirs).max():.1e}, rms {rms(error) / rms(theirs):.1e}"


def report(name, ours, theirs, times):
    inner = tuple(slice(BORDER, -BORDER) if n > 4 * BORDER else slice(None) for n in ours.shape)
    seconds = [f"{t[len(t) // 2]:.3f} s ({t[0]:.3f} to {t[-1]:.3f})" for t in times]
    factor = np.median(times[1]) / np.median(times[0])
    print(f"{name}: conefield {seconds[0]}, RTK {seconds[1]}, factor {factor:.1f}")
    print(f"    apart: {apart(ours, theirs)}; inside: {apart(ours[inner], theirs[inner])}", flush=True)


def main():
    parser = argparse.ArgumentParser()
    for name, default in [("size", 128), ("views", 50), ("detector", 256), ("runs", 5)]:
        parser.add_argument(f"--{name}", type=int, default=default)
    arguments = parser.parse_args()
    n = arguments.detector
    scan = conefield.simulate(f"phantom:head:{arguments.size}", views=arguments.views, detector=(n, n))
    with tempfile.TemporaryDirectory() as folder:
        conefield.write_scan(f"{folder}/scan", scan)
        peer = Scan(f"{folder}/scan")
    geometry, truth, measured = scan.geometry, scan.truth.data, scan.projections
    # RTK clips rays to the box of the outermost voxels' centres, conefield reads half a voxel further: the border is empty here.
    edge = np.zeros_like(truth)
    edge[1:-1, 1:-1, 1:-1] = 1
    truth = truth * edge
    theirs = peer.volume(truth), peer.stack(measured)

    def back(kind, views):
        f = kind[Image, Image].New()
        f.SetInput(0, peer.volume(np.zeros(peer.shape, np.float32)))
        f.SetInput(1, views)
        f.SetGeometry(peer.geometry)
        f.Update()
        return f.GetOutput()

    def fdk():
        f = rtk.FDKConeBeamReconstructionFilter[Image].New()
        f.SetInput(0, peer.volume(np.zeros(peer.shape, np.float32)))
        f.SetInput(1, theirs[1])
        f.SetGeometry(peer.geometry)
        f.GetRampFilter().SetTruncationCorrection(0.0)
        f.Update()
        return f.GetOutput()

    views = lambda image: itk.array_from_image(image)[:, ::-1, ::-1]
    voxels = lambda image: np.transpose(itk.array_from_image(image), (2, 0, 1))

    (ours, found), times = in_turn(
        arguments.runs, lambda: conefield.project(truth, geometry), lambda: peer.forward(theirs[0])
    )
    report("Joseph forward", ours, views(found), times)
    (ours, found), times = in_turn(
        arguments.runs,
        lambda: conefield.backproject(measured, geometry),
        lambda: back(rtk.JosephBackProjectionImageFilter, theirs[1]),
    )
    report("Joseph adjoint", ours, voxels(found), times)
    (ours, found), times = in_turn(
        arguments.runs, lambda: conefield.reconstruct(scan, "fdk", window="ramp", nonnegative=False), fdk
    )
    report("FDK", ours.volume.data, voxels(found) * peer.mm, times)
    _, times = in_turn(arguments.runs, lambda: back(rtk.BackProjectionImageFilter, theirs[1]))
    median = times[0][len(times[0]) // 2]
    print(f"voxel-driven back-projection: RTK {median:.3f} s ({times[0][0]:.3f} to {times[0][-1]:.3f})")


if __name__ == "__main__":
    main()
