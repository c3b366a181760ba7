"""Prepares the measured scans of a limited arc for limited-angle.sh.

usage: limited-angle.py DATA OUT

DATA/measured holds htc2022_*.npz and the masks htc2022_*_mask.png (Helsinki Tomography Challenge 2022, Zenodo 8041800, CC BY 4.0).
Writes OUT/SCAN.toml for `conefield import`, with a copy of its file, and OUT/SCAN-mask.npy: the mask on 256 x 256 x 1 voxels.
Needs numpy and pillow.
"""
import shutil
import sys
from pathlib import Path

import numpy
from PIL import Image

data, out = Path(sys.argv[1]) / "measured", Path(sys.argv[2])
SIZE, SIDE = 256, 512 * 0.14832
for scan in ["ta_30", "td_30", "tb_60", "tb_90"]:
    name = f"htc2022_{scan}.npz"
    shutil.copyfile(data / name, out / name)
    mask = numpy.array(Image.open(data / f"htc2022_{scan[:2]}_mask.png").convert("L")) > 127
    step = mask.shape[0] // SIZE
    blocks = mask.reshape(SIZE, step, SIZE, step).mean((1, 3)) >= 0.5
    numpy.save(out / f"{scan}-mask.npy", blocks[:, :, None].astype(numpy.float32))
    (out / f"{scan}.toml").write_text(f"""format = "conefield-scanner"
version = 1

[files]
projections = "{name}:line_integrals"

[circle]
dso = 410.66
dsd = 553.74
pixel = {{ u = 0.2, v = 0.2 }}
angles_deg = "{name}:angles_deg"
direction = "counterclockwise"

[layout]
axes = ["view", "row", "column"]

[values]
kind = "line-integrals"

[volume]
shape = [{SIZE}, {SIZE}, 1]
spacing = [{SIDE / SIZE}, {SIDE / SIZE}, {SIDE / SIZE}]
center = [0.0, 0.0, 0.0]
""")
