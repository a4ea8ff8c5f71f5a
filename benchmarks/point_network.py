"""RandLA-Net's encoder: seconds of the sampling, and of each level of the frozen encoder.

    python benchmarks/point_network.py --points 100000 400000 --threads 1 2

Points lie on the walls of a room of 6 by 5 by 3 metres with noise of 5 millimetres, in random
order, which is the worst for caches; weights are random, of the published shape for S3DIS. The
best of `--repeats` runs, CPU time of the process with all threads together (the machine may be
shared) and wall time. `plain` is level 0 of the encoder as published code writes it: neighbours
gathered, ten channels, nothing folded, all points at once.
"""

import argparse
import resource
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from splatseg.methods.cosseg.network import RandlaEncoder, sample
from splatseg.methods.cosseg.pyramid import PUBLISHED_S3DIS, PyramidOptions, point_pyramid
from splatseg.render.cpu import set_threads


def room(count: int) -> Tensor:
    """Points on three walls."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator) * torch.tensor([6.0, 5.0, 3.0])
    wall = torch.randint(0, 3, (count,), generator=generator)
    points[torch.arange(count), wall] = 0
    return points + 0.005 * torch.randn(count, 3, generator=generator)


def best(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Least CPU and wall seconds."""
    cpu, wall = [], []
    for _ in range(repeats):
        begin, started = time.process_time(), time.perf_counter()
        call()
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - begin)
    return min(cpu), min(wall)


def plain(block: nn.Module, positions: Tensor, features: Tensor, neighbours: Tensor) -> Tensor:
    """A block as published code writes it."""
    near = neighbours.long()

    def layer(mlp: nn.Module, x: Tensor) -> Tensor:
        y = mlp.norm(mlp.linear(x).reshape(-1, mlp.linear.out_features))
        return functional.leaky_relu(y, mlp.slope).reshape(*x.shape[:-1], -1)

    def pool(pooling: nn.Module, x: Tensor) -> Tensor:
        return layer(pooling.mlp, (x * torch.softmax(pooling.score(x), dim=1)).sum(dim=1))

    here, there = positions[:, None].expand(-1, near.shape[1], -1), positions[near]
    distance = (here - there).norm(dim=-1, keepdim=True)
    first = layer(block.encode1, torch.cat((distance, here - there, here, there), dim=-1))
    found = layer(block.entry, features)
    found = pool(block.pool1, torch.cat((found[near], first), dim=-1))
    found = pool(block.pool2, torch.cat((found[near], layer(block.encode2, first)), dim=-1))
    return functional.leaky_relu(layer(block.exit, found) + layer(block.shortcut, features), 0.2)


def measure(count: int, threads: int, repeats: int, *, with_plain: bool) -> None:
    """Print a row for each step."""
    torch.set_num_threads(threads)
    set_threads(threads)
    points = room(count)
    inputs = torch.cat((points, torch.rand(count, 3)), dim=1)
    options = PyramidOptions()

    def row(what: str, times: tuple[float, float]) -> None:
        print(f"{count:9} {threads:7} {what:12} {times[0]:8.2f} {times[1]:8.2f}", flush=True)

    torch.set_grad_enabled(False)
    row("sampling", best(lambda: point_pyramid(points, options=options, seed=0), 1))
    pyramid = point_pyramid(points, options=options, seed=0)
    encoder = RandlaEncoder(PUBLISHED_S3DIS).eval()
    encoder.requires_grad_(requires_grad=False)
    row("encoder", best(lambda: encoder(pyramid, inputs), repeats))
    features = encoder.start(inputs)
    for level, block in enumerate(encoder.blocks):
        given = (points[pyramid.kept[level]], features, pyramid.neighbours[level])
        row(f"level {level}", best(lambda b=block, g=given: b(*g), repeats))
        if with_plain and level == 0:
            row("plain 0", best(lambda b=block, g=given: plain(b, *g), 1))
        found = block(*given)
        features = sample(found, pyramid.neighbours[level], pyramid.pool[level])


def main() -> None:
    """Do what the words say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, nargs="+", default=[100_000, 400_000])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--plain", action="store_true", help="also level 0 as published")
    asked = parser.parse_args()
    print("   points threads step              CPU     wall")
    for count in asked.points:
        for threads in asked.threads:
            measure(count, threads, asked.repeats, with_plain=asked.plain)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of the process: {peak:.0f} MiB")


if __name__ == "__main__":
    main()
