"""Faults of detectors, tubes and scatter, put into an exact scan before its photons are counted.

usage: faults.py SCALE IN.npy OUT.npy             a volume times SCALE
       faults.py FAULT SEED IN_SCAN OUT_SCAN      a scan with FAULT; IN_SCAN and OUT_SCAN are folders of conefield's own

FAULT is none, rings, pixels, flux, scatter, hardening or low-counts. Noise is that of PHOTONS in the open beam, of FEW for low-counts.
"""
import pathlib, sys
import numpy as np

PHOTONS, FEW = 3e4, 100
# Energies (keV) with the mass attenuation of water and aluminium (cm2/g, NISTIR 5632).
TABLE = np.array([[20, 0.8096, 3.441], [30, 0.3756, 1.128], [40, 0.2683, 0.5685], [50, 0.2269, 0.3681], [60, 0.2059, 0.2778],
                  [80, 0.1837, 0.2018], [100, 0.1707, 0.1704], [150, 0.1505, 0.1378]])


def hardened(a):
    """Water of the line integrals a, seen with a tube of 110 kV behind 3 mm of aluminium by a detector that sums energies."""
    energy = np.arange(20.5, 110.0, 1.0)
    water, aluminium = (np.exp(np.interp(np.log(energy), np.log(TABLE[:, 0]), np.log(TABLE[:, k]))) for k in (1, 2))
    share = (110.0 - energy) * np.exp(-aluminium * 2.699 * 0.3)
    share /= share.sum()
    ratio = water / (share * water).sum()
    return -np.log(sum(s * np.exp(-a * r) for s, r in zip(share, ratio)))


def scattered(a):
    """What comes from T·A through the kernel exp(-r / 20 pixels), a tenth of it all."""
    rows, columns = a.shape[1:]
    r = np.hypot(*np.meshgrid(np.arange(-rows, rows), np.arange(-columns, columns), indexing="ij"))
    kernel = np.exp(-r / 20.0)
    spectrum = np.fft.rfft2(np.fft.ifftshift(kernel / kernel.sum()))
    light = np.exp(-a) * a
    wide = np.zeros((len(a), 2 * rows, 2 * columns), np.float32)
    wide[:, :rows, :columns] = light
    return 0.1 * np.fft.irfft2(np.fft.rfft2(wide) * spectrum, s=wide.shape[1:])[:, :rows, :columns]


def main(fault, seed, source, out):
    random = np.random.default_rng(int(seed))
    a = np.load(source / "projections.npy").astype(np.float64)
    views, *detector = a.shape
    if fault == "hardening":
        a = hardened(a)
    light = np.exp(-a)
    if fault == "scatter":
        light += scattered(a)
    if fault == "flux":
        light *= np.exp(random.normal(0.0, 0.05, views))[:, None, None]
    photons = FEW if fault == "low-counts" else PHOTONS
    counts = random.poisson(photons * light).astype(np.float64)
    if fault == "rings":
        odd = random.random(detector) < 0.01
        counts *= np.exp(random.normal(0.0, 0.02, detector) + odd * random.normal(0.0, 0.1, detector))
    if fault == "pixels":
        dead, restless = random.random(detector) < 0.005, random.random(detector) < 0.005
        counts[:, dead] = 0.4 * photons
        counts[:, restless] *= np.where(random.random((views, restless.sum())) < 0.5, 1.0, 0.5)
        counts[random.random(counts.shape) < 5e-4] += photons
    a = -np.log(np.maximum(counts, 0.5) / photons)
    out.mkdir(parents=True, exist_ok=True)
    np.save(out / "projections.npy", a.astype(np.float32))
    text = (source / "scan.toml").read_text().splitlines()
    (out / "scan.toml").write_text("\n".join(l for l in text if not l.startswith("truth = ")) + "\n")


if len(sys.argv) == 4:
    np.save(sys.argv[3], np.load(sys.argv[2]) * np.float32(sys.argv[1]))
else:
    main(sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3]), pathlib.Path(sys.argv[4]))
