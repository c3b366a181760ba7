"""The published code's initial weights as a conefield weights file.

    python benches/peers/initial.py RUN/weights.safetensors INITIAL.safetensors [--seed 11]

How fast the published training leaves its first plateau is a matter of the initial weights, and the published code has the
same ones in every run: it seeds PyTorch with 11 when its model is imported, then makes the encoder and after it the layers.
This makes them in that order. RUN is a run of `ni-naf-published`, of one step: names, shapes and metadata are taken from it.
The initializer `checkpoint` reads what it writes. Needs torch, numpy and safetensors.
"""

import argparse

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("like")
    parser.add_argument("out")
    parser.add_argument("--seed", type=int, default=11)
    arguments = parser.parse_args()
    with safe_open(arguments.like, framework="pt") as file:
        metadata = file.metadata()
        shapes = {name: file.get_slice(name).get_shape() for name in file.keys()}
    torch.manual_seed(arguments.seed)
    tables = sorted((name for name in shapes if name.startswith("encoder.")), key=lambda n: int(n.split(".")[1]))
    values = {name: torch.empty(shapes[name]).uniform_(-1e-4, 1e-4) for name in tables}
    for name in sorted(name for name in shapes if name.startswith("field.") and name.endswith(".weight")):
        layer = nn.Linear(shapes[name][1], shapes[name][0])
        values[name], values[name.replace("weight", "bias")] = layer.weight.detach(), layer.bias.detach()
    width = shapes["normalizers.0.weight"]
    values["normalizers.0.weight"], values["normalizers.0.bias"] = torch.ones(width), torch.zeros(width)
    if values.keys() != shapes.keys():
        raise SystemExit(f"{arguments.like}: not the weights of ni-naf-published: {sorted(shapes.keys() ^ values.keys())}")
    save_file(values, arguments.out, metadata)


if __name__ == "__main__":
    main()
