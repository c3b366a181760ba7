"""A small 3D network that learns what a reconstruction lacks. benches/learned.sh runs it:

usage: learned.py FOLDER STEPS INPUTS LEARN TEST

INPUTS, LEARN and TEST are lists in one argument. FOLDER/SCAN/truth.nii.gz is the truth of a scan, FOLDER/SCAN-INPUT/volume.nii.gz a
reconstruction. The network (four 3x3x3 convolutions, 16 channels, residual) adds to the first input. Values are divided by the
90th percentile of what is not air. Blocks are turned and mirrored across the axis and scaled by up to exp(±0.5).
"""
import sys
import nibabel
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

folder, steps, inputs, learn, test = sys.argv[1:]
steps, inputs, learn, test = int(steps), inputs.split(), learn.split(), test.split()
SIDE, BATCH, WIDTH, RATE, SLAB, HALO = 32, 2, 16, 2e-3, 32, 4


def read(path):
    return torch.from_numpy(np.asarray(nibabel.load(path).dataobj, np.float32))


def load(scan):
    """Inputs and truth, divided by the scale, and the scale."""
    volumes = torch.stack([read(f"{folder}/{scan}-{i}/volume.nii.gz") for i in inputs])
    first = volumes[0]
    scale = float(torch.quantile(first[first > 0.05 * first.max()][::17][:1_000_000], 0.9))
    return volumes / scale, read(f"{folder}/{scan}/truth.nii.gz") / scale, scale


class Network(nn.Module):
    def __init__(self):
        super().__init__()
        self.first = nn.Conv3d(len(inputs), WIDTH, 3, padding=1)
        self.inner = nn.ModuleList(nn.Conv3d(WIDTH, WIDTH, 3, padding=1) for _ in range(2))
        self.last = nn.Conv3d(WIDTH, 1, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, x):
        h = F.relu(self.first(x))
        for layer in self.inner:
            h = h + F.relu(layer(h))
        return x[:, :1] + self.last(h)


def block(random, data):
    x, truth, _ = data[random.integers(len(data))]
    at = tuple(slice(k, k + SIDE) for k in (random.integers(0, n - SIDE + 1) for n in truth.shape))
    turns, scale = int(random.integers(4)), float(np.exp(random.uniform(-0.5, 0.5)))
    both = torch.cat([x[(slice(None), *at)], truth[at][None]])
    both = torch.rot90(both, turns, (1, 2))
    both = both.flip([d for d in (1, 2, 3) if random.random() < 0.5])
    return both * scale


def train():
    torch.manual_seed(0)
    random, data, network = np.random.default_rng(0), [load(scan) for scan in learn], Network()
    optimizer = torch.optim.Adam(network.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    for _ in range(steps):
        both = torch.stack([block(random, data) for _ in range(BATCH)])
        loss = ((network(both[:, :-1]) - both[:, -1:]) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


@torch.no_grad()
def apply(network, x):
    n = x.shape[1]
    out = torch.empty(x.shape[1:])
    for k in range(0, n, SLAB):
        low, high, end = max(0, k - HALO), min(n, k + SLAB + HALO), min(n, k + SLAB)
        out[k:end] = network(x[None, :, low:high])[0, 0, k - low : end - low]
    return out.clamp(min=0)


def psnr(volume, truth):
    return float(10 * torch.log10(truth.max() ** 2 / ((volume - truth) ** 2).mean()))


network = train()
print(f"| | {inputs[0]} | network |\n|---|---|---|")
for scan in learn + test:
    x, truth, scale = load(scan)
    result = apply(network, x)
    print(f"| {scan}{' (learned from)' if scan in learn else ''} | {psnr(x[0], truth):.2f} | {psnr(result, truth):.2f} |", flush=True)
    affine = nibabel.load(f"{folder}/{scan}/truth.nii.gz").affine
    nibabel.save(nibabel.Nifti1Image((result * scale).numpy(), affine), f"{folder}/{scan}.nii.gz")
