"""A tiny HED in the layout in which Keras writes the published weights, without our own code."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDTHS = (4, 5, 6, 5, 4)
DEPTHS = (2, 2, 3, 3, 3)


def shapes(widths: tuple[int, ...] = WIDTHS) -> dict[str, tuple[int, ...]]:
    """Names and shapes of all tensors, kernels as (height, width, in, out)."""
    found: dict[str, tuple[int, ...]] = {}
    before = 3
    for k, (width, depth) in enumerate(zip(widths, DEPTHS, strict=True), 1):
        for i in range(depth):
            at = f"block{k}/layers/conv2d{f'_{i}' if i else ''}/vars"
            found |= {f"{at}/0": (3, 3, before, width), f"{at}/1": (width,)}
            before = width
        found |= {f"dsn{k}/vars/0": (1, 1, width, 1), f"dsn{k}/vars/1": (1,)}
    return found | {"fuse/vars/0": (1, 1, 5, 1), "fuse/vars/1": (1,)}


def tensors(widths: tuple[int, ...] = WIDTHS, seed: int = 7) -> dict[str, NDArray[np.float32]]:
    """Random weights by name, such that answers vary and stay small."""
    rng = np.random.default_rng(seed)
    found: dict[str, NDArray[np.float32]] = {}
    for name, shape in shapes(widths).items():
        scale = 0.1 if len(shape) == 1 else np.sqrt(2 / np.prod(shape[:3]))
        if name == "block1/layers/conv2d/vars/0":
            scale /= 64  # colours are in -128 to 151
        found[name] = (rng.normal(size=shape) * scale).astype(np.float32)
    return found


def write(path: Path, content: Mapping[str, Any], *, libver: str = "earliest") -> Path:
    """Write tensors by name into a file of HDF5, with the empty groups that Keras leaves."""
    import h5py

    with h5py.File(path, "w", libver=libver) as file:
        for name, value in content.items():
            file.create_dataset(name, data=value)
        for k in range(2, 6):
            file.create_group(f"block{k}/layers/max_pooling2d/vars")
            file.create_group(f"block{k}/vars").attrs["name"] = f"sequential_{k - 1}"
        file.create_group("vars").attrs["name"] = "hed"
    return path


class HedFiles:
    """What is written for a tiny HED: its weights, as Keras saves them."""

    def save_pretrained(self, folder: Path) -> None:
        """Write them."""
        folder.mkdir(parents=True)
        write(folder / "hed_bsds500.weights.h5", tensors())


MAKERS = {"hed": HedFiles}
