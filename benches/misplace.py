"""Writes a scan with a wrong geometry. Its views are unchanged.

usage: misplace.py SCAN OUT KEY=VALUE

SCAN and OUT are folders in conefield's format; SCAN's views are on a circle. KEY is offset-u or offset-v (pixels), rotation, tilt or slant of the
detector (degrees), distance from source to detector or step of the angle (%), or jitter: the standard deviation of a random shift along u
and v in each view (pixels).
"""
import json, math, os, pathlib, random, sys, tomllib

source, out, (key, value) = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), sys.argv[3].split("=")
scan = tomllib.loads((source / "scan.toml").read_text())
orbit = scan["orbit"]
count = orbit.get("count") or len(orbit["angles"])
angles = orbit.get("angles") or [orbit["start"] + orbit["range"] * i / count for i in range(count)]
off = {k: 0.0 for k in "offset-u offset-v rotation tilt slant distance step jitter".split()}
random.seed(1)
assert key in off, key
off[key] = float(value)


def turned(a, axis, degrees):
    """Vector a, rotated right-handed about axis (Rodrigues)."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    n = math.hypot(*axis)
    axis = [x / n for x in axis]
    along = sum(x * y for x, y in zip(axis, a)) * (1 - c)
    return [a[k] * c + cross(axis, a)[k] * s + axis[k] * along for k in range(3)]


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def view(angle):
    angle = angles[0] + (angle - angles[0]) * (1 + off["step"] / 100)
    c, s = math.cos(angle), math.sin(angle)
    v, u = ([0.0, 0.0, -orbit["pixel"][0]], [-s * orbit["pixel"][1], c * orbit["pixel"][1], 0.0])
    back = orbit["dso"] - orbit["dsd"] * (1 + off["distance"] / 100)
    shift = [orbit["offset"][0] / orbit["pixel"][0] + off["offset-v"], orbit["offset"][1] / orbit["pixel"][1] + off["offset-u"]]
    shift = [s + off["jitter"] * random.gauss(0, 1) for s in shift]
    detector = [back * d + shift[0] * a + shift[1] * b for d, a, b in zip((c, s, 0.0), v, u)]
    for axis, degrees in ((cross(u, v), off["rotation"]), (v, off["slant"]), (u, off["tilt"])):
        u, v = turned(u, axis, degrees), turned(v, axis, degrees)
    return {"source": [orbit["dso"] * c, orbit["dso"] * s, 0.0], "detector": detector, "u": u, "v": v}


out.mkdir(parents=True, exist_ok=True)
scan.pop("orbit")
scan.pop("truth", None)
scan["provenance"] = {"misplaced": sys.argv[3]}
scan["views"] = [view(a) for a in angles]
(out / "scan.json").write_text(json.dumps(scan))
name = "projections.npy"
if not (out / name).exists():
    os.link(source / name, out / name)
