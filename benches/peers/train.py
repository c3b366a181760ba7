"""The published training step in PyTorch: what `cargo bench --bench training` (or, with --device cuda, gpu) measures, by a peer.

10 levels x 2 features, tables of 2^19, LayerNorm, 20-32-32-(+20)-32-1 with GELU and SquarePlus, 1024 rays x 320
samples, L1, Adam. Prints training samples/s and export points/s, eager and (with --compile) compiled.
"""

import argparse
import statistics
import time

import torch
from torch import nn

LEVELS, FEATURES, BASE, TABLE = 10, 2, 16, 2**19
RAYS, SAMPLES = 1024, 320
PRIMES = (1, 19349663, 83492791)


class HashGrid(nn.Module):
    """torch-ngp's convention: position = x * (16 * 2^l - 1) + 0.5, direct indexing while a level fits."""

    def __init__(self):
        super().__init__()
        self.tables = nn.ParameterList()
        for level in range(LEVELS):
            side = BASE * 2**level + 1
            self.tables.append(nn.Parameter(torch.empty(min(side**3, TABLE), FEATURES).uniform_(-1e-4, 1e-4)))

    def forward(self, x):
        out = []
        for level, table in enumerate(self.tables):
            resolution = BASE * 2**level
            position = x * (resolution - 1) + 0.5
            cell = position.floor()
            fraction = position - cell
            cell = cell.long()
            total = 0
            for corner in range(8):
                bits = [(corner >> axis) & 1 for axis in range(3)]
                at = [cell[:, axis] + bits[axis] for axis in range(3)]
                if table.shape[0] == (resolution + 1) ** 3:
                    index = at[0] + (resolution + 1) * (at[1] + (resolution + 1) * at[2])
                else:
                    index = (at[0] * PRIMES[0]) ^ (at[1] * PRIMES[1]) ^ (at[2] * PRIMES[2])
                    index = index % TABLE
                weight = 1
                for axis in range(3):
                    weight = weight * (fraction[:, axis] if bits[axis] else 1 - fraction[:, axis])
                total = total + weight[:, None] * table[index]
            out.append(total)
        return torch.cat(out, -1)


class Field(nn.Module):
    def __init__(self):
        super().__init__()
        width = LEVELS * FEATURES
        self.encoder = HashGrid()
        self.norm = nn.LayerNorm(width)
        self.first = nn.Sequential(nn.Linear(width, 32), nn.GELU(), nn.Linear(32, 32), nn.GELU())
        self.second = nn.Sequential(nn.Linear(32 + width, 32), nn.GELU(), nn.Linear(32, 1))

    def forward(self, x):
        features = self.norm(self.encoder(x))
        y = self.second(torch.cat([features, self.first(features)], -1))
        return 0.5 * (y + torch.sqrt(y * y + 1.52382103))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    torch.set_default_device(arguments.device)
    cuda = arguments.device.startswith("cuda")

    def wait():
        if cuda:
            torch.cuda.synchronize()

    field = Field()
    run = torch.compile(field) if arguments.compile else field
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-3)
    start, end = torch.rand(RAYS, 1, 3), torch.rand(RAYS, 1, 3)
    t = (torch.arange(SAMPLES) + 0.5).view(1, SAMPLES, 1) / SAMPLES
    points = (start + t * (end - start)).reshape(-1, 3)
    target = torch.full((RAYS,), 0.3)
    times = []
    for step in range(arguments.steps + 2):
        begin = time.perf_counter()
        lines = run(points).view(RAYS, SAMPLES).sum(1) / SAMPLES
        loss = (lines - target).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        wait()
        if step >= 2:
            times.append(time.perf_counter() - begin)
    rate = RAYS * SAMPLES / statistics.median(times) / 1e6
    kind = "compiled" if arguments.compile else "eager"
    where = torch.cuda.get_device_name() if cuda else f"{torch.get_num_threads()} threads"
    print(f"PyTorch {torch.__version__} {kind}, {where}: training {rate:.2f} M samples/s")
    with torch.no_grad():
        times = []
        for _ in range(4):
            begin = time.perf_counter()
            run(points)
            wait()
            times.append(time.perf_counter() - begin)
    print(f"  export {RAYS * SAMPLES / statistics.median(times) / 1e6:.2f} M points/s")


if __name__ == "__main__":
    main()
