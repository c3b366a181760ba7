"""The published code's initial weights as a conefield weights file.

    python benches/peers/initial.py RUN/weights.safetensors INITIAL.safetensors [--seed 11]

How fast the published training leaves its first plateau is a matter of the initial weights, and the published code has the
same ones in every run: it seeds PyTorch with 11 when its model is imported, then makes the encoder and after it the layers.
This makes them in that order. RUN is a run of `ni-naf-published`, of one step: names, shapes and the rest of the file are
taken from it. `--init INITIAL.safetensors` of an initializer `checkpoint` reads what it writes. Needs torch and numpy.
"""

import argparse
import json
import struct

import numpy as np
import torch
from torch import nn


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("like")
    parser.add_argument("out")
    parser.add_argument("--seed", type=int, default=11)
    arguments = parser.parse_args()
    with open(arguments.like, "rb") as file:
        (size,) = struct.unpack("<Q", file.read(8))
        header = json.loads(file.read(size))
    shapes = {name: entry["shape"] for name, entry in header.items() if name != "__metadata__"}
    torch.manual_seed(arguments.seed)
    tables = sorted((name for name in shapes if name.startswith("encoder.")), key=lambda n: int(n.split(".")[1]))
    rows = [shapes[name][0] for name in tables]
    embeddings = torch.empty(sum(rows), shapes[tables[0]][1]).uniform_(-1e-4, 1e-4)
    values = dict(zip(tables, embeddings.split(rows)))
    for name in sorted(name for name in shapes if name.startswith("field.") and name.endswith(".weight")):
        layer = nn.Linear(shapes[name][1], shapes[name][0])
        values[name], values[name.replace("weight", "bias")] = layer.weight.detach(), layer.bias.detach()
    width = shapes["normalizers.0.weight"]
    values["normalizers.0.weight"], values["normalizers.0.bias"] = torch.ones(width), torch.zeros(width)
    if values.keys() != shapes.keys():
        raise SystemExit(f"{arguments.like}: not the weights of ni-naf-published: {sorted(shapes.keys() ^ values.keys())}")
    data, at = [], 0
    for name, value in values.items():
        array = np.ascontiguousarray(value.numpy(), dtype="<f4")
        header[name] = {"dtype": "F32", "shape": list(array.shape), "data_offsets": [at, at + array.nbytes]}
        at += array.nbytes
        data.append(array.tobytes())
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with open(arguments.out, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + b"".join(data))


if __name__ == "__main__":
    main()
