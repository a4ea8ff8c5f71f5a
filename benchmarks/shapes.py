"""Auto-encoders of primitives' shapes: Chamfer distance, crossings, the sphere, and time.

    python benchmarks/shapes.py WORK FILE... --decode 50000

A row for the template (`sphere`), the shipped weights and each FILE, on patches of 3 rooms and 3
streets that nothing was trained on (`scripts/train_shapes` cuts them; clouds are kept in WORK).
Chamfer distances are means over both directions, added, in units of primitives (0.433 m in a
voxel of 0.5 m, 0.866 m in one of 1 m); `squared` is of squared distances, as published. `intact`
is the share of shapes without a self-intersection, `pairs` that of pairs of codes with none in 11
equal steps from one to the other, `sphere` the largest deviation of a radius of the code's sphere.
Milliseconds are the best of three of the process (the machine may be shared).
"""

import argparse
import importlib.machinery
import importlib.util
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor

from splatseg.street.shape_files import SHIPPED, load_shapes
from splatseg.street.shapes import ShapeAutoEncoder

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from support.shape_quality import score_shapes

RECIPE = Path(__file__).parents[1] / "scripts" / "train_shapes"


def recipe() -> ModuleType:
    """The program that trains, which has no suffix."""
    loader = importlib.machinery.SourceFileLoader("train_shapes", str(RECIPE))
    spec = importlib.util.spec_from_loader(loader.name, loader)
    module = importlib.util.module_from_spec(spec)
    sys.modules[loader.name] = module
    loader.exec_module(module)
    return module


def held_out(work: Path, most: int) -> Tensor:
    """Patches of 512 points, drawn from all of the scenes."""
    train = recipe()
    work.mkdir(parents=True, exist_ok=True)
    scenes = train.HELD_OUT_SCENES
    found = train.cut_all(work, scenes, scenes, first=train.HELD_OUT, points=512)
    return train.some_of(found, most)


def milliseconds(call: Callable[[], object]) -> float:
    """Least wall time of three."""
    times = []
    for _ in range(3):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return 1000 * min(times)


def decoding(shapes: ShapeAutoEncoder, count: int) -> tuple[float, float]:
    """Milliseconds of decoding codes, alone and with the gradient of the codes."""
    codes = torch.randn(count, shapes.code_size, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        plain = milliseconds(lambda: shapes.decode(codes))
    codes.requires_grad_()
    return plain, milliseconds(lambda: shapes.decode(codes).sum().backward())


def main() -> None:
    """Do what the words say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--patches", type=int, default=1500)
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--decode", type=int, default=50_000)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    asked = parser.parse_args()
    torch.set_num_threads(asked.threads)
    patches = held_out(asked.work, asked.patches)
    print(f"{len(patches)} patches, {asked.pairs} pairs, {asked.threads} threads")
    print("shapes         code  weights  squared chamfer intact  pairs sphere decode  +gradient")
    for number, path in enumerate((SHIPPED, *asked.files)):
        shapes = load_shapes(path)
        found = score_shapes(shapes, patches, pairs=asked.pairs)
        if number == 0:
            print(f"{'sphere':14} {'':13} {found.sphere_squared:8.4f} {found.sphere:7.4f}")
        weights = sum(one.numel() for one in shapes.parameters())
        name = "shipped" if path == SHIPPED else path.stem
        plain, gradient = decoding(shapes, asked.decode)
        print(
            f"{name:14} {shapes.code_size:4} {weights:8} {found.chamfer_squared:8.4f} "
            f"{found.chamfer:7.4f} {found.intact_shapes:6.3f} {found.intact_pairs:6.3f} "
            f"{found.sphere_deviation:6.3f} {plain:6.0f} {gradient:10.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
