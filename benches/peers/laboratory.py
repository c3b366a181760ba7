"""conefield beside ASTRA at the size of a demo and of a laboratory: seconds of the reconstruction alone.

    cargo build --release --bin conefield
    python3 benches/peers/laboratory.py [--backend wgpu] [--sizes small,large] [--runs 3] [--folder DIR]

The scan is of two balls about one centre, so that every view is the same and takes no time to make. conefield's times are `train_s` of
record.json, from arrays of the host to arrays of the host, with the compilation of kernels; ASTRA's are whole calls of FDK_CUDA,
SIRT3D_CUDA and CGLS3D_CUDA, from and to host arrays (https://pypi.org/project/astra-toolbox). Medians of the runs. Where ASTRA or
CUDA is absent, the table says so. One H100 takes under four minutes. Needs numpy; prints a Markdown table.
"""

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
DSO, DSD, SIDE, DETECTOR = 1000.0, 1500.0, 256.0, 512.0
SIZES = {"tiny": (12, 48, 32), "small": (50, 512, 256), "large": (720, 1024, 512)}
METHODS = [
    ("FDK", "fdk", [], None, "FDK_CUDA"),
    ("SIRT, 20 passes", "sirt", ["--steps", "20"], 20, "SIRT3D_CUDA"),
    ("CGLS, 10 passes", "cgls", ["--steps", "10"], 10, "CGLS3D_CUDA"),
    ("`fista-tv`, 10 passes", "fista-tv", ["--steps", "10"], None, None),
]


def ball(pixels, radius):
    """Line integrals of a centred ball of attenuation 1: every view is the same."""
    at = (np.arange(pixels) + 0.5) / pixels * DETECTOR - DETECTOR / 2
    square = at[None, :] ** 2 + at[:, None] ** 2
    # Square of a ray's distance from the centre.
    distance = DSO**2 * square / (square + DSD**2)
    return 2 * np.sqrt(np.maximum(0, radius**2 - distance))


def scan(folder, views, pixels, voxels):
    folder.mkdir(parents=True, exist_ok=True)
    image = (0.02 * ball(pixels, 100.0) + 0.01 * ball(pixels, 40.0)).astype(np.float32)
    lines = np.broadcast_to(image, (views, pixels, pixels))
    np.save(folder / "projections.npy", lines)
    (folder / "scan.toml").write_text(
        f"""format = "conefield-scan"
version = 1
projections = "projections.npy"

[unit]
name = "mm"
mm = 1.0

[detector]
rows = {pixels}
columns = {pixels}

[volume]
shape = [{voxels}, {voxels}, {voxels}]
spacing = [{SIDE / voxels}, {SIDE / voxels}, {SIDE / voxels}]
center = [0.0, 0.0, 0.0]

[orbit]
dso = {DSO}
dsd = {DSD}
pixel = [{DETECTOR / pixels}, {DETECTOR / pixels}]
offset = [0.0, 0.0]
angles = {[2 * math.pi * view / views for view in range(views)]}
"""
    )
    return lines


def conefield(folder, spec, options, backend, runs):
    seconds, moved = [], {}
    if spec == "cgls":
        spec = folder / "cgls.toml"
        spec.write_text('type = "cgls"\n')
    for _ in range(runs):
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            out = Path(scratch) / "run"
            command = [ROOT / "target/release/conefield", "-q", "reconstruct", folder, "--spec", spec, "-o", out]
            subprocess.run([*command, "--backend", backend, *options], check=True, stdout=subprocess.DEVNULL)
            record = json.loads((out / "record.json").read_text())
            seconds.append(record["train_s"])
            moved = record["moved"]
    return statistics.median(seconds), moved


def astra_times(lines, voxels, runs):
    try:
        import astra

        if not astra.use_cuda():
            return "CUDA is absent"
    except ImportError:
        return "ASTRA is absent"
    views, pixels, _ = lines.shape
    pitch = DETECTOR / pixels / (SIDE / voxels)
    scale = voxels / SIDE
    angles = np.linspace(0, 2 * math.pi, views, endpoint=False) + math.pi / 2
    geometry = astra.create_proj_geom("cone", pitch, pitch, pixels, pixels, angles, DSO * scale, (DSD - DSO) * scale)
    volume = astra.create_vol_geom(voxels, voxels, voxels)
    data = np.ascontiguousarray(lines.transpose(1, 0, 2)[::-1])
    found = {}
    for _, _, _, passes, name in METHODS:
        if name is None:
            continue
        seconds = []
        for _ in range(runs):
            begin = time.perf_counter()
            p, v = astra.data3d.create("-sino", geometry, data), astra.data3d.create("-vol", volume)
            config = astra.astra_dict(name)
            config.update(ReconstructionDataId=v, ProjectionDataId=p)
            algorithm = astra.algorithm.create(config)
            astra.algorithm.run(algorithm, passes or 1)
            astra.data3d.get(v)
            seconds.append(time.perf_counter() - begin)
            astra.algorithm.delete(algorithm)
            astra.data3d.delete([p, v])
        found[name] = statistics.median(seconds)
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="wgpu")
    parser.add_argument("--sizes", default="small,large", help="of " + ", ".join(SIZES))
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--folder", type=Path)
    asked = parser.parse_args()
    folder = asked.folder or Path(tempfile.mkdtemp())
    print("| Work | conefield | ASTRA | ratio | moved to and from the device |")
    print("| --- | --- | --- | --- | --- |")
    for size in asked.sizes.split(","):
        views, pixels, voxels = SIZES[size]
        lines = scan(folder / size, views, pixels, voxels)
        peer = astra_times(lines, voxels, asked.runs)
        for title, spec, options, _, name in METHODS:
            own, moved = conefield(folder / size, spec, options, asked.backend, asked.runs)
            theirs = peer.get(name) if isinstance(peer, dict) else None
            said = f"{theirs:.3f} s" if theirs else ("none" if name is None else str(peer))
            ratio = f"{own / theirs:.2f}" if theirs else ""
            gib = [moved[key] / 2**30 for key in ("to_device", "from_device")]
            what = f"{title}, {views} views of {pixels}² → {voxels}³"
            print(f"| {what} | {own:.3f} s | {said} | {ratio} | {gib[0]:.2f} and {gib[1]:.2f} GiB |")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
